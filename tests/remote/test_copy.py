"""Copies of recordings in all states into a bucket, cut after each file and resumed."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog.maintenance.copying import CopyOptions
from hybridlog_storage.disk import files
from hybridlog_storage.errors import UsageError
from tests.copying.conftest import STATES, answers, expire, robots  # noqa: F401 - a fixture
from tests.remote.server import Proxy


def test_a_bucket_answers_like_the_robot(
    robots: Path,  # noqa: F811
    address: str,
    proxy: Proxy,
    tmp_path: Path,
) -> None:
    with hl.open(robots, mongo="none") as store:
        for number in range(4):  # of files that arrive in an attempt

            def cut(_label: str, _done: int, _total: int, left: list[int] = [number]) -> None:  # noqa: B006
                left[0] -= 1
                if left[0] < 0:
                    raise RuntimeError

            with pytest.raises(RuntimeError):
                store.copy(address, ["dropped"], progress=cut)
        report = store.copy(address)
        assert sorted(report.copied) == sorted(STATES)
        before = len(proxy.requests)
        again = store.copy(address)
        assert (again.copied, sorted(again.known)) == ([], sorted(STATES))
        assert len(proxy.requests) - before <= 3
        with pytest.raises(UsageError, match="as a whole"):
            store.copy(address, options=CopyOptions(only_fields=True))
    with hl.open(address) as store, pytest.raises(UsageError, match="this very store"):
        store.copy(f"{address}/")
    files.mounted.clear()
    for label in STATES:
        right = answers(robots, label)
        assert answers(Path(address), label) == right, label
    with hl.open(tmp_path / "back", mongo="none", create=True) as store:
        assert sorted(store.import_from(address).copied) == sorted(STATES)
        assert not store.verify().findings


def cut_short(store: Path, label: str) -> None:
    """Leave what a recording had after two segments, as a copy of a running store has it."""
    path = store / "recordings" / label
    lines = (path / "journal").read_bytes().splitlines(keepends=True)
    third = [number for number, line in enumerate(lines) if b'"sealed"' in line][2]
    (path / "journal").write_bytes(b"".join(lines[:third]))
    for segment in sorted(path.glob("*.mcap"))[2:]:
        segment.unlink()


def raw(path: str | Path, label: str) -> list[tuple[int, str, bytes]]:
    with hl.open(path, mongo="none") as store:
        query = store.topic(*store.topics()).in_recording(label)
        return [
            (one.log_time_ns, one.topic, b"" if one.is_reduced else bytes(one.raw)) for one in query
        ]


@pytest.mark.parametrize("lacks", ["payloads", "segments"])
def test_less_in_a_bucket_is_completed(
    robots: Path,  # noqa: F811
    address: str,
    tmp_path: Path,
    lacks: str,
) -> None:
    less = tmp_path / "less"
    whole = raw(robots, "recorded")
    with hl.open(robots, mongo="none") as robot:
        if lacks == "payloads":
            robot.copy(less, ["recorded"], CopyOptions(only_fields=True))
        else:
            shutil.copytree(robots, less)
            cut_short(less, "recorded")
        with hl.open(less, mongo="none") as lab:
            assert lab.copy(address, ["recorded"]).copied == ["recorded"]
        assert raw(address, "recorded") != whole
        with hl.open(address) as there:
            there.tag("recorded", seen="yes")
        assert robot.copy(address, ["recorded"]).copied == ["recorded"]
        assert robot.copy(address, ["recorded"]).known == ["recorded"]
        with hl.open(less, mongo="none") as lab:  # less takes nothing away
            assert lab.copy(address, ["recorded"]).known == ["recorded"]
    files.mounted.clear()
    assert raw(address, "recorded") == whole
    with hl.open(address) as there:
        assert there.entry("recorded").tags["seen"] == "yes"
        assert not there.verify().findings


def test_other_content_of_the_same_recording_is_refused(
    robots: Path,  # noqa: F811
    address: str,
    tmp_path: Path,
) -> None:
    less = tmp_path / "less"
    shutil.copytree(robots, less)
    cut_short(less, "recorded")
    with hl.open(less, mongo="none") as lab:
        expire(lab, "recorded")
        assert lab.copy(address, ["recorded"]).copied == ["recorded"]
        lab.mark("recorded", "start", "of the lab")
        assert lab.copy(address, ["recorded"]).copied == ["recorded"]
    with hl.open(robots, mongo="none") as robot:
        report = robot.copy(address, ["recorded"])
    assert "has other content" in report.refused["recorded"]
