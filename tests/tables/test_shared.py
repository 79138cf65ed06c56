"""Recordings share files: what is opened, written and rewritten."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from shutil import copy
from typing import Any

import pyarrow.parquet as pq
import pytest

import hybridlog as hl
from hybridlog.columns import tables as folders
from hybridlog.maintenance import opening as making
from hybridlog_storage.disk import files
from hybridlog_storage.messages import Schema
from tests.calls import Calls
from tests.limits import Limit
from tests.tables.logs import BASE, SECOND, STATE, channel, payload, varied, write_log
from tests.tables.test_writer import compare, files_of

COUNT = 8


def record(store: hl.Store, path: Path, number: int, rows: int = 30) -> None:
    begin = BASE + number * SECOND
    said = [(begin + n, f"/{'ab'[n % 2]}", varied(n)) for n in range(rows)]
    log = write_log(path / f"{number}.mcap", said)
    store.record(log, name=f"r{number}", again=True)


@pytest.fixture
def several(store: hl.Store, tmp_path: Path) -> hl.Store:
    for number in range(COUNT):
        record(store, tmp_path, number)
    return store


def opened_files(calls: Calls) -> list[Path]:
    """Tables that are opened from now on."""
    found: list[Path] = []

    def seen(path: Path, *_: Any, **__: Any) -> None:
        if path.suffix == ".parquet":
            found.append(path)

    calls(files, "open_file", seen)
    return found


def test_a_file_is_opened_once_for_all_its_recordings_and_topics(
    several: hl.Store, calls: Calls
) -> None:
    assert len(files_of(several)) == 1
    several.refresh()
    opened = opened_files(calls)
    query = several.query(["/a", "/b"]).where("i8 > 0")
    assert query.count() == COUNT * 12
    assert {*opened} == {*files_of(several)}
    opened.clear()
    assert query.count() == COUNT * 12
    assert not opened
    assert several.query(["/a", "/b"]).where("i8 > 1").count() == COUNT * 6


def test_long_arrays_of_another_recording_change_no_count(
    several: hl.Store, tmp_path: Path
) -> None:
    query = several.topic("/a").where("many[0] > 1")
    before = query.count()
    said = [(BASE + n, "/a", payload(n, many=[2.0] * 40)) for n in range(10)]
    several.record(write_log(tmp_path / "long.mcap", said), name="long")
    several.refresh()
    assert several.topic("/a").where("many[0] > 1").count() == before + 10


@pytest.mark.parametrize("most", [{"shared_file_rows": 70}, {"shared_file_recordings": 2}])
def test_a_full_file_gets_no_more_rows(
    store: hl.Store, tmp_path: Path, limit: Limit, most: dict[str, int]
) -> None:
    limit(**most)
    for number in range(5):
        record(store, tmp_path, number)
    rows = [pq.read_metadata(path).num_rows for path in files_of(store)]
    assert rows == [60, 60, 30]
    assert compare(store) == 150


def test_other_shared_files_are_not_opened(
    store: hl.Store, tmp_path: Path, limit: Limit, calls: Calls
) -> None:
    limit(shared_file_rows=100)
    for number in range(9):
        record(store, tmp_path, number)
    store.refresh()
    one, two, _ = files_of(store)
    opened = opened_files(calls)
    assert store.query(["/a"], ["r1"]).where("i8 > 0").count() == 6
    assert set(opened) == {one}
    opened.clear()
    store.remove("r4")
    assert set(opened) & set(files_of(store)) == {two}
    assert compare(store) == 8 * 30


def test_recordings_that_come_out_of_order_are_found(
    store: hl.Store, tmp_path: Path, limit: Limit, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file begins with one of its recordings; where it is full, another begins in between."""
    limit(shared_file_recordings=3)
    order = [5, 2, 8, 6, 7, 1, 3, 4, 0]
    for number in order:
        monkeypatch.setattr("time.time_ns", lambda number=number: BASE + number)
        record(store, tmp_path, number)
    for number in order:
        store.refresh()
        assert store.query(["/a", "/b"], [f"r{number}"]).where("i8 > 0").count() == 12
    assert len(files_of(store)) == 4
    assert compare(store) == 9 * 30
    for number in order:
        there = folders.files_of(store.directory.path)
        ids = {section.id for file in there for section in file.sections}
        assert ids == {one.id for one in store.recordings()}
        store.remove(f"r{number}")
    assert not list((store.directory.path / "tables").iterdir())


def test_rows_are_by_recording_topic_and_time(several: hl.Store, tmp_path: Path) -> None:
    record(several, tmp_path, -3)
    (path,) = files_of(several)
    table = pq.read_table(path)
    ids = list(dict.fromkeys(table.column("recording").to_pylist()))
    assert ids == sorted(entry.id for entry in several.recordings())
    keys = [
        (ids.index(row["recording"]), row["topic"], row["t"], row["seq"])
        for row in table.select(["recording", "topic", "t", "seq"]).to_pylist()
    ]
    assert keys == sorted(keys)


def test_several_writers_lose_no_rows(store: hl.Store, tmp_path: Path) -> None:
    def work(first: int) -> None:
        with hl.open(store.directory.path, mongo="none") as other:
            for number in range(first, first + 4):
                record(other, tmp_path, number)

    with ThreadPoolExecutor(3) as pool:
        list(pool.map(work, (0, 4, 8)))
    store.refresh()
    assert len(files_of(store)) == 1
    assert pq.read_metadata(files_of(store)[0]).num_rows == 12 * 30
    assert all(not making.missing(store.directory, entry) for entry in store.recordings())
    assert compare(store) == 12 * 30


def test_rows_of_a_topic_with_two_definitions_are_made_again(
    store: hl.Store, tmp_path: Path
) -> None:
    other = Schema("test/State", "ros1msg", b"int32 one\n")
    with store.start("two") as recording:
        for schema in (STATE, other):
            for n in range(5):
                data = varied(n) if schema is STATE else bytes(4)
                recording.write(channel("/two", schema), data, log_time=BASE + n)
    record(store, tmp_path, 0)
    paths = files_of(store)
    assert len(paths) == 2
    rows = {path: pq.read_metadata(path).num_rows for path in paths}
    assert sorted(rows.values()) == [5, 35]
    for path in paths:
        path.unlink()
    store.refresh()
    assert store.topic("/two").where("i8 > 0").count() == 2
    assert store.topic("/a").where("i8 > 0").count() == 6
    assert store.topic("/b").where("i8 > 0").count() == 6
    store.verify(repair=True)
    assert {path: pq.read_metadata(path).num_rows for path in files_of(store)} == rows
    inodes = [path.stat().st_ino for path in files_of(store)]
    store.refresh()
    assert store.topic("/two").where("i8 > 1").count() == 1
    assert [path.stat().st_ino for path in files_of(store)] == inodes
    for path in paths:
        path.unlink()
    assert making.missing(store.directory, store.entry("two")) == {"/two"}


@pytest.mark.parametrize("name", ["shared-old", "{} (1)", "{}_1"])
def test_a_file_with_an_odd_name_is_in_no_ones_way(
    store: hl.Store, tmp_path: Path, name: str, caplog: pytest.LogCaptureFixture
) -> None:
    record(store, tmp_path, 0)
    (path,) = files_of(store)
    copy(path, path.with_name(f"{name.format(path.stem)}.parquet"))
    record(store, tmp_path, 1)
    assert not caplog.records
    assert pq.read_metadata(path).num_rows == 60
    store.refresh()
    assert store.topic("/a").where("i8 > 0").count() == 12
