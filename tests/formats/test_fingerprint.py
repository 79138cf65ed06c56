"""Fingerprints depend on content and order, on nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from hybridlog.formats import reading as module
from hybridlog.formats.reading import SAMPLE_BYTES, SAMPLES, WHOLE


def fingerprint(files: Sequence[Path]) -> str:
    return module.fingerprint(files).whole


def write(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


def test_names_do_not_matter_and_content_does(tmp_path: Path) -> None:
    one = write(tmp_path / "a.bag", b"content")
    two = write(tmp_path / "b", b"content")
    other = write(tmp_path / "c", b"Content")
    assert fingerprint([one]) == fingerprint([two])
    assert fingerprint([one]) != fingerprint([other])
    assert len(fingerprint([one])) == 32
    assert int(fingerprint([one]), 16)


def test_order_and_borders_between_files(tmp_path: Path) -> None:
    ab, c = write(tmp_path / "1", b"ab"), write(tmp_path / "2", b"c")
    a, bc = write(tmp_path / "3", b"a"), write(tmp_path / "4", b"bc")
    assert fingerprint([ab, c]) != fingerprint([c, ab])
    assert fingerprint([ab, c]) != fingerprint([a, bc])
    assert fingerprint([]) != fingerprint([write(tmp_path / "5", b"")])


@pytest.mark.parametrize("place", [0, WHOLE // 2, WHOLE - 1])
def test_every_byte_of_a_small_file_counts(tmp_path: Path, place: int) -> None:
    data = bytearray(WHOLE)
    before = fingerprint([write(tmp_path / "a", bytes(data))])
    data[place] = 1
    assert fingerprint([write(tmp_path / "a", bytes(data))]) != before


def test_large_files_are_sampled(tmp_path: Path) -> None:
    size = 4 * SAMPLES * SAMPLE_BYTES
    path = tmp_path / "a"
    with path.open("wb") as file:
        file.truncate(size)
    before = fingerprint([path])
    gap = (size - SAMPLE_BYTES) // (SAMPLES - 1)

    def changed(place: int) -> bool:
        with path.open("r+b") as file:
            file.seek(place)
            file.write(b"x")
        after = fingerprint([path])
        with path.open("r+b") as file:
            file.seek(place)
            file.write(b"\0")
        return after != before

    assert changed(0)
    assert changed(size - 1)
    assert changed(gap * 7 + 5)
    assert not changed(gap * 7 + SAMPLE_BYTES + 1000)
    assert fingerprint([path]) == before
    with path.open("r+b") as file:
        file.truncate(size + 1)
    assert fingerprint([path]) != before
