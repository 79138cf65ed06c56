"""`compact` moves payloads into columns, and nothing else changes."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pandas as pd
import polars as pl
import pyarrow.compute as pc
import pyarrow.dataset as ds
import pytest

import hybridlog as hl
from hybridlog.columns import payload_rows as columns
from hybridlog.columns.payload_rows import Rebuilder
from hybridlog_storage import journal
from hybridlog_storage.errors import DiskFullError, StoreError
from hybridlog_storage.journal import Journal
from tests.calls import Calls
from tests.cli.running import run
from tests.copies import bring
from tests.payloads.logs import (
    BASE,
    COUNT,
    SETTINGS,
    STEP,
    messages,
    points_of,
    ranges_of,
    recording_of,
    robot,
    write_log,
)

MOVED = ["/cloud", "/scan"]


@pytest.fixture(scope="module")
def compacted(plain: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    """The same store with columns."""
    path = tmp_path_factory.mktemp("compacted") / "store"
    shutil.copytree(plain, path)
    with hl.open(path) as store:
        found = store.compact()
        assert [(one.topic, one.messages, one.kept) for one in found] == [
            (topic, COUNT, 0) for topic in MOVED
        ]
        yield store


def test_columns_change_no_answer(plain: Path, compacted: hl.Store) -> None:
    with hl.open(plain) as store:
        assert messages(store) == messages(compacted)
        entries = [one.recordings()[0].to_document() for one in (store, compacted)]
    assert entries[1]["payloads"]
    differing = {name for name in entries[0] if entries[0][name] != entries[1][name]}
    assert differing == {"payloads", "stored_bytes"}


def test_the_columns_say_what_the_messages_say(compacted: hl.Store) -> None:
    found = ds.dataset(recording_of(compacted.directory.path) / "payloads/topic=scan").to_table()
    assert found.column("t").to_pylist() == [BASE + n * STEP for n in range(COUNT)]
    assert found.column("pub").to_pylist() == [BASE + n * STEP - 5 for n in range(COUNT)]
    assert found.column("seq").to_pylist() == [m.seq for m in compacted.topic("/scan")]
    assert {row["frame_id"] for row in found.column("header").to_pylist()} == {"laser"}
    assert not found.schema.field("ranges").type.value_field.nullable
    for n, ranges in enumerate(found.column("ranges").to_pylist()):
        np.testing.assert_array_equal(np.array(ranges, np.float32), ranges_of(n))


def test_points_stand_in_columns_of_their_own(compacted: hl.Store) -> None:
    found = ds.dataset(recording_of(compacted.directory.path) / "payloads/topic=cloud").to_table()
    assert "data" not in found.column_names
    for n, points in enumerate(found.column("points").to_pylist()):
        assert points["ring"] == points_of(n)["ring"].tolist()
        np.testing.assert_array_equal(
            np.array([points[axis] for axis in "xyz"], np.float32).T, points_of(n)["xyz"]
        )
    paddings = [recipe["padding"] for recipe in found.column("recipe").to_pylist()]
    assert [bool(padding) for padding in paddings] == [n % 3 > 0 for n in range(COUNT)]


def glob_of(store: hl.Store, topic: str) -> str:
    return str(store.directory.path / f"recordings/*/payloads/topic={topic}/*.parquet")


QUESTION = "select t, list_min(ranges) from read_parquet(?, hive_partitioning=true) order by t"


def with_duckdb(store: hl.Store) -> list[tuple[int, float]]:
    return duckdb.connect().execute(QUESTION, [glob_of(store, "scan")]).fetchall()


def with_polars(store: hl.Store) -> list[tuple[int, float]]:
    frame = pl.scan_parquet(glob_of(store, "scan"), hive_partitioning=True)
    return frame.select("t", pl.col("ranges").list.min()).sort("t").collect().rows()


def with_pandas(store: hl.Store) -> list[tuple[int, float]]:
    folder = recording_of(store.directory.path) / "payloads/topic=scan"
    frame = pd.concat(pd.read_parquet(path) for path in sorted(folder.glob("*.parquet")))
    rows = frame.sort_values("t").itertuples()
    return [(row.t, min(row.ranges)) for row in rows]


def with_pyarrow(store: hl.Store) -> list[tuple[int, float]]:
    folder = recording_of(store.directory.path) / "payloads"
    found = ds.dataset(folder / "topic=scan").to_table(["t", "ranges"]).sort_by("t")
    return [(row["t"], min(row["ranges"])) for row in found.to_pylist()]


@pytest.mark.parametrize("read", [with_duckdb, with_polars, with_pandas, with_pyarrow])
def test_other_programs_read_the_columns(compacted: hl.Store, read: Any) -> None:
    found = [(int(t), np.float32(least)) for t, least in read(compacted)]
    assert found == [(BASE + n * STEP, ranges_of(n).min()) for n in range(COUNT)]


def test_every_byte_is_verified(compacted: hl.Store) -> None:
    assert compacted.verify().findings == []


@pytest.mark.exhaustive
def test_a_second_run_finds_nothing(compacted: hl.Store) -> None:
    before = sorted(recording_of(compacted.directory.path).rglob("*"))
    assert compacted.compact() == []
    assert sorted(recording_of(compacted.directory.path).rglob("*")) == before


def test_sizes_tell_the_columns(compacted: hl.Store) -> None:
    rows = {row.topic: row.column_bytes for row in compacted.sizes().rows}
    files = recording_of(compacted.directory.path).glob("payloads/topic=scan/*")
    assert rows["/scan"] == sum(path.stat().st_size for path in files)
    assert rows["/number"] == 0
    assert compacted.recordings()[0].stored_bytes == sum(
        path.stat().st_size
        for path in recording_of(compacted.directory.path).rglob("*")
        if path.suffix in {".mcap", ".parquet"}
    )


def test_damage_of_columns_is_found(plain: Path, copy: Path) -> None:
    with hl.open(copy) as store:
        store.compact(topics=["scan"])
        (path,) = recording_of(copy).glob("payloads/topic=scan/*")
        whole = path.read_bytes()
        (path.parent / "stranger.parquet").write_bytes(whole)
        path.write_bytes(whole[:900] + bytes([whole[900] ^ 1]) + whole[901:])
        damaged, stranger = store.verify().findings
        assert "the checksum of the block at byte 0 differs" in damaged.problem
        assert stranger.problem == "the journal does not list it"
        path.unlink()
        assert "is missing" in store.verify().findings[0].problem
        with hl.open(plain) as other:
            assert messages(store) == messages(other)  # from the segments


@pytest.mark.exhaustive
def test_columns_follow_a_recording(compacted: hl.Store, tmp_path: Path) -> None:
    with hl.open(tmp_path / "other", create=True) as store:
        assert bring(store, compacted.directory.path).copied == ["log"]
        copied = {
            str(p.relative_to(store.directory.path)): p.read_bytes()
            for p in store.directory.path.rglob("*.parquet")
            if "payloads" in p.parts
        }
        assert copied == {
            str(p.relative_to(compacted.directory.path)): p.read_bytes()
            for p in compacted.directory.path.rglob("*.parquet")
            if "payloads" in p.parts
        }
        store.edit("log", name="new")
        assert store.recordings()[0].payloads == compacted.recordings()[0].payloads
        assert store.verify().findings == []
        store.remove("new")
        assert list(store.directory.recordings.iterdir()) == []


def test_a_rebuilt_journal_keeps_the_columns(copy: Path) -> None:
    with hl.open(copy) as store:
        store.compact()
        listed = store.recordings()[0].payloads
    path = recording_of(copy) / journal.JOURNAL
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join([lines[0], b"x" + lines[1], *lines[2:]]))
    with hl.open(copy) as store:
        store.verify(repair=True)
        assert store.recordings()[0].payloads == listed


def test_a_proof_that_fails_leaves_nothing(copy: Path, calls: Calls) -> None:
    def wrong(found: Any, _: Rebuilder, own: Any, *__: Any) -> Any:
        if "points" in own:
            found.data[-1] ^= 1
        return found

    calls.change(Rebuilder, "records", wrong)
    with hl.open(copy) as store:
        cloud, scans = store.compact()
        assert (cloud.messages, cloud.kept, scans.messages) == (0, COUNT, COUNT)
        assert "byte for byte" in cloud.reason
        assert {file["topic"] for file in store.recordings()[0].payloads} == {"/scan"}
        assert not list(recording_of(copy).rglob("topic=cloud/*"))


def test_columns_that_lack_a_message_are_refused(
    copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    piece = columns.TopicColumns.piece

    def shorter(self: Any, chunk: Any, rows: Any, has_publish_time: Any) -> Any:
        return piece(self, chunk, rows[:-1], has_publish_time)

    monkeypatch.setattr(columns.TopicColumns, "piece", shorter)
    with hl.open(copy) as store:
        assert {one.reason for one in store.compact()} == {"its columns hold other messages"}
        assert store.recordings()[0].payloads == []


def test_columns_with_other_arrival_numbers_are_refused(
    copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    records = Rebuilder.records

    def other(self: Rebuilder, own: Any, fields: Any) -> Any:
        return records(self, {**own, "seq": pc.add(own["seq"], 1)}, fields)

    monkeypatch.setattr(Rebuilder, "records", other)
    with hl.open(copy) as store:
        assert {one.reason for one in store.compact()} == {"its columns hold other messages"}
        assert store.recordings()[0].payloads == []


def test_messages_that_do_not_fit_stay_where_they_are(tmp_path: Path) -> None:
    said = robot(60)
    broken = [n for n, (topic, *_) in enumerate(said) if topic == "/scan"][30]
    topic, kind, time, payload = said[broken]
    said[broken] = topic, kind, time, payload[:-3]
    log = write_log(tmp_path / "log.mcap", said)
    with hl.open(tmp_path / "store", create=True) as store:
        store.record(log, name="log", settings=SETTINGS)
        before = messages(store)
        (found,) = store.compact(topics=["scan"])
        assert 0 < found.kept < 60
        assert found.messages + found.kept == 60
        assert found.reason == "a message of the chunk does not fit its definition"
        assert messages(store) == before
        assert store.verify().findings == []


def test_what_is_chosen_by_name_is_told(copy: Path) -> None:
    with hl.open(copy) as store:
        (found,) = store.compact(topics=["number"])
        assert (found.messages, found.kept) == (0, COUNT)
        assert found.reason == "std_msgs/msg/Int32 has no array of numbers"
        (image,) = store.compact(topics=["image"], dry_run=True)
        assert (image.messages, image.column_bytes) == (12, 0)
        assert not (recording_of(copy) / "payloads").exists()
        assert store.compact(store.recordings(older_than="200y")) == []


def test_an_open_recording_is_left(tmp_path: Path) -> None:
    with hl.open(tmp_path / "store", create=True) as store:
        with store.start("live"):
            assert store.compact() == []
            with pytest.raises(StoreError, match="being written"):
                store.compact(["live"])


def test_a_crash_before_the_journal_is_undone_and_after_it_finished(copy: Path) -> None:
    recording = recording_of(copy)
    with hl.open(copy) as store:
        store.compact(topics=["scan"])
    (file,) = recording.glob("payloads/*/*")
    text = (recording / journal.JOURNAL).read_bytes()
    unfinished = recording / "payloads.part" / file.relative_to(recording / "payloads")

    def crashed(lines: bytes) -> None:
        unfinished.parent.mkdir(parents=True)
        (recording / journal.JOURNAL).write_bytes(lines)
        (unfinished.parent / "other.parquet").write_bytes(b"half")

    crashed(text)
    file.rename(unfinished)
    with hl.open(copy) as store:
        assert len(store.recordings()[0].payloads) == 1
        assert store.verify().findings == []
    assert file.exists()
    assert not (recording / "payloads.part").exists()
    crashed(text[: text[:-1].rindex(b"\n") + 1])
    file.rename(unfinished)
    with hl.open(copy) as store:
        assert store.recordings()[0].payloads == []
        assert store.verify().findings == []
    assert not (recording / "payloads.part").exists()
    assert not file.exists()


@pytest.mark.exhaustive
def test_a_full_disk_leaves_the_recording_as_it_was(
    copy: Path, monkeypatch: pytest.MonkeyPatch, calls: Calls
) -> None:
    with hl.open(copy) as store:
        calls.fail(Journal, "append", DiskFullError("No space left."))
        with pytest.raises(DiskFullError):
            store.compact()
        assert sorted(p.name for p in recording_of(copy).iterdir() if p.is_dir()) == []
        monkeypatch.undo()
        assert store.verify().findings == []


def test_the_command_tells_what_it_did(copy: Path) -> None:
    done = run("compact", "-t", "scan", "-t", "number", store=copy)
    first, second = done.lines
    assert (
        first == f"log /number: {COUNT} without columns: std_msgs/msg/Int32 has no array of numbers"
    )
    assert second.startswith(f"log /scan: {COUNT} messages, ")
    (one,) = run("compact", "--json", "--dry-run", store=copy).json
    assert (one["topic"], one["messages"], one["kept"]) == ("/cloud", COUNT, 0)


def test_a_journal_line_that_leads_elsewhere_is_damaged() -> None:
    file = {"bytes": 1, "digest": "sha256:", "topic": "/a", "messages": 1}
    for name in ("../x", "a/../b", "a", "/a/b", "a//b", "a/b/c", ""):
        line = journal.event(journal.COMPACTED, files=[{**file, "file": name}])
        state = journal.parse(journal.encode(line))
        assert state.payloads == {}
        assert state.damaged == [0, 1]
