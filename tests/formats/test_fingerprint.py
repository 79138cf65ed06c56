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


def test_content_order_and_borders_matter_and_names_do_not(tmp_path: Path) -> None:
    def put(*contents: bytes) -> list[Path]:
        return [write(tmp_path / f"{number}", data) for number, data in enumerate(contents)]

    logs = ([b"content"], [b"Content"], [b"ab", b"c"], [b"c", b"ab"], [b"a", b"bc"], [b""], [])
    found = [fingerprint(put(*contents)) for contents in logs]
    assert len(set(found)) == len(found)
    assert fingerprint([write(tmp_path / "other", b"content")]) == found[0]
    assert len(found[0]) == 32
    assert int(found[0], 16)


@pytest.mark.parametrize("place", [0, WHOLE // 2, WHOLE - 1])
def test_every_byte_of_a_small_file_counts(tmp_path: Path, place: int) -> None:
    data = bytearray(WHOLE)
    before = fingerprint([write(tmp_path / "a", bytes(data))])
    data[place] = 1
    assert fingerprint([write(tmp_path / "a", bytes(data))]) != before


def test_large_files_are_sampled(tmp_path: Path) -> None:
    size = 4 * SAMPLES * SAMPLE_BYTES
    path = tmp_path / "a"
    gap = (size - SAMPLE_BYTES) // (SAMPLES - 1)

    def with_byte(place: int | None, size: int = size) -> str:
        with path.open("wb") as file:
            file.truncate(size)
            if place is not None:
                file.seek(place)
                file.write(b"x")
        return fingerprint([path])

    before = with_byte(None)
    assert before not in {with_byte(place) for place in (0, size - 1, gap * 7 + 5)}
    assert with_byte(gap * 7 + SAMPLE_BYTES + 1000) == before
    assert with_byte(None, size + 1) != before
