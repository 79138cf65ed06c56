"""Tables are what the messages say, whatever way the messages came."""

from __future__ import annotations

import errno
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest

import hybridlog as hl
from hybridlog.columns.column_file import ColumnFileWriter
from hybridlog.columns.layout import OWN_COLUMNS, TABLES
from hybridlog.columns.table_writer import TableFolders, TableWriter
from hybridlog.columns.tables import TableRows, Tables
from hybridlog.index.indexing import ChunkIndexer
from hybridlog_storage.catalog import RecordingEntry
from hybridlog_storage.messages import Schema
from hybridlog_storage.segments.segment_reader import SegmentReader
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests import places
from tests.calls import Calls
from tests.indexed import documents_of
from tests.limits import Limit
from tests.some import in_turn
from tests.tables.conftest import SMALL_CHUNKS
from tests.tables.logs import (
    BASE,
    Decoded,
    decoded,
    payload,
    same,
    table_of,
    varied,
    write_log,
)


def files_of(store: hl.Store) -> list[Path]:
    return sorted((store.directory.path / TABLES).glob("*~*/*.parquet"))


def topics_of(entry: RecordingEntry) -> list[str]:
    return sorted({c.topic for c in entry.channels if c.stats.messages})


def compare(store: hl.Store) -> int:
    """Every row of every table with the message itself; returns how many rows there are."""
    tables = Tables(store.directory.path)
    compared = 0
    for entry in store.recordings():
        for topic in topics_of(entry):
            table = tables.of(entry, topic)
            assert table is not None, topic
            own = [name for name in OWN_COLUMNS if name not in {"t", "seq"}]
            blocks = list(table.scan(None, own=own))
            messages = iter(decoded(store, entry.id, topic))
            for block in blocks:
                compare_rows(block, [next(messages) for _ in range(len(block))])
            assert next(messages, None) is None
            compared += table.rows
    return compared


def compare_rows(block: TableRows, messages: list[Decoded]) -> None:
    assert block.t.tolist() == [message.t for message in messages]
    assert block.seq.tolist() == [message.seq for message in messages]
    assert block.own["pub"].to_pylist() == [message.pub for message in messages]
    assert block.own["ref"].field("len").to_pylist() == [len(m.raw) for m in messages]
    micros = block.own["log_time"].view(pa.int64()).to_pylist()
    assert micros == [message.t // 1000 for message in messages]
    rows = zip(block.records.to_pylist(), block.own["state"].to_pylist(), messages, strict=True)
    for cell, state, message in rows:
        if message.value is None:
            assert state == "unreadable"
            assert not any(value is not None for value in cell.values())
            continue
        assert state == "whole"
        for name, value in cell.items():
            assert same(value, getattr(message.value, name)), name


@pytest.mark.parametrize(
    ("arena", "rows", "pending"),
    [
        (8 << 20, 1 << 18, 48 << 20),
        (3000, 1 << 18, 48 << 20),
        (3000, 5, 20_000),
        (1, 1, 1),
    ],
)
def test_tables_are_what_the_messages_say(
    store: hl.Store,
    tmp_path: Path,
    limit: Limit,
    arena: int,
    rows: int,
    pending: int,
) -> None:
    limit(
        group_bytes=arena,
        group_rows=rows,
        table_pending_bytes=pending,
        table_left_bytes=pending // 4,
    )
    said = [(BASE + n * 7 % 41, f"/{'abc'[n % 3]}", varied(n)) for n in range(300)]
    write_log(tmp_path / "log.mcap", said)
    store.record(tmp_path / "log.mcap", name="log", settings=SMALL_CHUNKS)
    assert compare(store) == 300


def test_a_long_topic_has_a_file_of_its_own(store: hl.Store, tmp_path: Path, limit: Limit) -> None:
    """One, of however many segments; a short one shares a file."""
    limit(long_table_rows=500)
    said = [(BASE + n, "/slow" if n % 20 == 0 else "/fast", varied(n)) for n in range(2000)]
    write_log(tmp_path / "log.mcap", said)
    settings = SegmentSettings(chunk_size=4096, segment_size=1 << 15)
    store.record(tmp_path / "log.mcap", name="log", settings=settings)
    (entry,) = store.recordings()
    assert entry.segments >= 4
    names = [path.name for path in files_of(store)]
    assert names == [f"{entry.id}-0.parquet", "shared-00000000000000000000.parquet"]
    assert compare(store) == 2000


def test_unreadable_messages_say_why(indexed: hl.Store, tmp_path: Path) -> None:
    said = [(BASE + n, "/a", varied(n)[:-1] if n % 3 == 1 else varied(n)) for n in range(40)]
    write_log(tmp_path / "log.mcap", said)
    indexed.record(tmp_path / "log.mcap", name="log")
    assert compare(indexed) == 40
    table = table_of(indexed)
    want = [d["_meta"].get("error") for d in documents_of(indexed, "/a")]
    have = [e for block in table.scan(own=["error"]) for e in block.own["error"].to_pylist()]
    assert have == want
    assert table.unreadable == sum(error is not None for error in want) > 0


def test_messages_that_nobody_can_read(store: hl.Store, tmp_path: Path) -> None:
    said = [(BASE + n, "/a", b"x" * n) for n in range(20)]
    schemas = {"/a": ("secret", Schema("x/Secret", "secret", b"?"))}
    write_log(tmp_path / "log.mcap", said, schemas)
    store.record(tmp_path / "log.mcap", name="log")
    table = table_of(store)
    (block,) = table.scan(None, own=["ref", "state"])
    assert block.own["ref"].field("len").to_pylist() == list(range(20))
    assert set(block.own["state"].to_pylist()) == {"whole"}
    assert block.records.type.num_fields == 0


def chunks_of(store: hl.Store, entry: RecordingEntry) -> list[Any]:
    found = []
    for number, path in places.segments(store.directory.path, entry.id):
        with SegmentReader(path, number) as reader:
            summary = reader.summary()
            found += [(reader.read_chunk(place), summary.channels) for place in summary.chunks]
    return found


def waiting(writer: TableWriter) -> int:
    """Rows in memory."""
    return sum(len(rows) for topic in writer._topics.values() for rows in topic.waiting)


def test_memory_does_not_grow_with_the_recording(
    store: hl.Store, tmp_path: Path, limit: Limit
) -> None:
    most = []
    for count in (1000, 4000):
        said = [(BASE + n, f"/{n % 3}", payload(n)) for n in range(count)]
        path = write_log(tmp_path / f"{count}.mcap", said)
        entry = store.record(path, name=str(count), settings=SMALL_CHUNKS).entry
        limit(table_pending_bytes=100_000, table_left_bytes=25_000)
        writer = TableWriter(store.directory.path, entry, topics_of(entry))
        held, indexer = [], ChunkIndexer(entry.id)
        for chunk, channels in chunks_of(store, entry):
            writer.add(indexer.messages_in([chunk], channels))
            held.append(waiting(writer))
        writer.close(entry)
        most.append(max(held))
        assert waiting(writer) == 0
        limit(table_pending_bytes=1 << 24, table_left_bytes=1 << 22)
    assert most[0] < 500
    assert most[1] <= most[0] + 50


def test_the_last_room_is_the_segments_alone(store: hl.Store, tmp_path: Path, limit: Limit) -> None:
    limit(table_reserve_bytes=1 << 62)
    write_log(tmp_path / "log.mcap", [(BASE, "/state", varied(1))])
    assert store.record(tmp_path / "log.mcap", name="log").entry.status == "complete"
    assert not list(store.directory.path.glob("**/*.parquet"))
    assert store.topic("/state").count() == 1


ERRORS = [MemoryError(), ValueError("odd"), OSError(errno.EIO, "no"), OSError(errno.ENOSPC, "full")]
PLACES = {
    "add": (TableWriter, "_spill"),
    "write": (ColumnFileWriter, "write"),
    "close": (ColumnFileWriter, "close"),
    "publish": (TableFolders, "_add"),
}


@pytest.mark.parametrize(("place", "error"), in_turn([*PLACES], ERRORS))
def test_whatever_fails_the_recording_goes_on(
    store: hl.Store,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    calls: Calls,
    place: str,
    error: Exception,
) -> None:
    calls.fail(*PLACES[place], error)
    said = [(BASE + n, "/large" if n % 50 else "/small", varied(n)) for n in range(1500)]
    write_log(tmp_path / "log.mcap", said)
    assert store.record(tmp_path / "log.mcap", name="log").entry.status == "complete"
    monkeypatch.undo()
    assert not list(store.directory.path.glob("**/*.parquet"))
    assert store.topic("/large").count() == 1470
    assert store.verify().findings == []
