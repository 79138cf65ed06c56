"""Bytes by recording, topic and tier: their sums are those of the files."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import hybridlog as hl
from hybridlog_storage.messages import Channel, Schema
from tests import places
from tests.cli.running import run
from tests.independent import write_mcap
from tests.many_topics import BASE, FLOAT

LARGE = 20_000
"""Bytes of a payload of `/large`, which has chunks of its own."""


def write(path: Path, small: int, large: int) -> Path:
    """A log of the topics `/a` and `/b`, each with `small` messages, and `/large`."""
    channels = [Channel(name, "ros1", FLOAT) for name in ("/a", "/b")]
    of_large = Channel("/large", "ros1", Schema("std_msgs/String", "ros1msg", b"string data\n"))
    said = [(channel, struct.pack("<f", count)) for count in range(small) for channel in channels]
    for count in range(large):
        data = struct.pack("<I", LARGE) + bytes((count * i) % 251 for i in range(LARGE))
        said.append((of_large, data))
    rows = [(one, BASE + 1000 * n, data) for n, (one, data) in enumerate(said, 1)]
    return write_mcap(path, rows, [*channels, of_large])


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sizes")
    with hl.open(folder / "store", create=True) as store:
        store.record(write(folder / "one.mcap", 400, 30))
        store.record(write(folder / "two.mcap", 1200, 0))
        store.record(write(folder / "mute.mcap", 10, 0))
    return folder / "store"


@pytest.fixture
def store(place: Path) -> Iterator[hl.Store]:
    with hl.open(place) as opened:
        yield opened


def bytes_in(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def by_name(rows: list[Any]) -> dict[tuple[str, str], Any]:
    found = {(row.recording, row.topic): row for row in rows}
    assert len(found) == len(rows)
    return found


def test_sums_are_those_of_the_files(store: hl.Store) -> None:
    sizes, root = store.sizes(), store.directory.path
    for row in sizes.by_recording():
        entry = store.entry(row.recording)
        segments = places.folder(root, row.recording).glob("*.mcap")
        assert row.segment_bytes == entry.stored_bytes == sum(p.stat().st_size for p in segments)
        assert row.table_bytes > 0
        assert row.messages == entry.messages
    for groups in (sizes.rows, sizes.by_recording(), sizes.by_topic()):
        for name in ("messages", "payload_bytes", "segment_bytes", "table_bytes"):
            assert sum(getattr(row, name) for row in groups) == getattr(sizes.total, name)
        totals = [row.total_bytes for row in groups]
        assert totals == sorted(totals, reverse=True)
        assert all(row.total_bytes == row.segment_bytes + row.table_bytes for row in groups)
    assert sizes.total.table_bytes == bytes_in(root / "tables")
    assert {row.topic for row in sizes.by_topic()} == {"", "/a", "/b", "/large"}


def test_shares_of_chunks_and_tables(store: hl.Store) -> None:
    rows = by_name(store.sizes().rows)
    entry = store.entry("one")
    logs = places.manifest(store.directory.path, "one").logs.values()
    large = {c.id for c in entry.channels if c.topic == "/large"}
    (alone,) = (log.bytes for log in logs if log.parts.keys() == large)
    assert rows["one", "/large"].segment_bytes == alone
    assert rows["one", "/large"].payload_bytes == 30 * (LARGE + 4)
    # Topics of equal messages share equally.
    for recording in ("one", "two", "mute"):
        a, b = rows[recording, "/a"], rows[recording, "/b"]
        assert a.segment_bytes > 0
        assert abs(a.segment_bytes - b.segment_bytes) <= 1
    assert abs(rows["one", "/a"].table_bytes - rows["one", "/b"].table_bytes) <= 1
    # Recordings share a file by their rows.
    share = rows["two", "/a"].table_bytes / rows["two", "/a"].messages
    assert (
        abs(rows["one", "/a"].table_bytes - share * rows["one", "/a"].messages) < 1.5
    )  # both are rounded


def test_as_commands(place: Path) -> None:
    rows = run("info", "--sizes", "recording", "--json", store=place).json["rows"]
    assert {row["recording"] for row in rows} == {"one", "two", "mute"}
    assert rows == sorted(rows, key=lambda row: -row["total_bytes"])
    assert "topic" not in rows[0]
    both = run("info", "one", "two", "--sizes", "both", "--json", store=place).json
    assert len(both["rows"]) == 8  # with `/large` of `two`, which has no messages
    assert both["total"]["messages"] == 830 + 2400
    lines = run("info", "--sizes", "topic", store=place).lines
    headings = ["topic", "messages", "payload", "segments", "tables", "total"]
    assert lines[0].split() == headings
    assert {line.split()[0] for line in lines[1:-1]} == {"/large", "/a", "/b", "(no"}
    assert lines[-1].startswith("total")
    assert any(line.startswith("(no topic)") for line in lines)
    largest = max(both["rows"], key=lambda row: row["total_bytes"])
    assert run("info", "--sizes", "both", store=place).lines[1].startswith(largest["recording"])
    shown = run("info", "one", "--sizes", "both", store=place).lines
    assert "total" in shown[-1]
    assert len(shown) == 6


def test_an_empty_store(tmp_path: Path) -> None:
    with hl.open(tmp_path / "store", create=True) as store:
        assert store.sizes().total.total_bytes == 0
    assert run("info", "--sizes", "both", store=tmp_path / "store").out == ""
