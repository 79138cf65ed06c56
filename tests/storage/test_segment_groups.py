"""Groups: the segments of a recording that are opened and sealed together."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Metadata

from hybridlog.record.losses import Cause, Ledger
from hybridlog_storage.errors import DiskFullError
from hybridlog_storage.manifest import Loss
from hybridlog_storage.messages import Channel
from hybridlog_storage.segments.chunk import StoredChunk
from hybridlog_storage.segments.segment_file import Sealed, SegmentFile
from hybridlog_storage.segments.segment_format import (
    LOSSES_METADATA,
    group_of,
    losses_record,
)
from hybridlog_storage.segments.segment_reader import SegmentReader
from hybridlog_storage.segments.segment_writer import SegmentSettings
from hybridlog_storage.segments.walk import recover_segment
from tests.storage.noting import NotingWriter
from tests.storage.test_segments import RECORDING, Row, batch_of, problems

TOPICS = [Channel(f"/{n}", "json", None) for n in range(40)]
NAMED, LATCHED = TOPICS[38], TOPICS[39]
SMALL = SegmentSettings(
    chunk_size=1024, large_payload=100, own_payload=200, segment_size=20_000, sync="never"
)


class Recorded:
    """What a writer has told of."""

    def __init__(self, folder: Path, setup: SegmentSettings = SMALL, **options: Any) -> None:
        folder.mkdir(exist_ok=True)
        self.folder = folder
        self.chunks: list[StoredChunk] = []
        self.groups: list[list[Sealed]] = []
        self.rows: list[Row] = []
        options.setdefault("on_sealing", lambda group: self.groups.append([*group]))
        self.writer = NotingWriter(
            folder,
            RECORDING,
            self.chunks,
            setup,
            is_named=lambda topic: topic == NAMED.topic,
            is_latched=lambda channel: channel is LATCHED,
            **options,
        )

    def append(self, rows: Sequence[Row]) -> None:
        self.rows += rows
        self.writer.append(batch_of(rows), TOPICS)

    def write(self, topic: int, size: int, count: int = 1) -> None:
        for _ in range(count):
            n = len(self.rows)
            self.append([(topic, os.urandom(size), n, n, n)])
        self.writer.flush()

    def close(self) -> list[Path]:
        return self.writer.close()

    def topics(self) -> list[dict[int, set[str]]]:
        """The topics of each segment, by number, group by group."""
        return [
            {
                sealed.file.number: {one.topic for one in sealed.channels.values()}
                for sealed in group
            }
            for group in self.groups
        ]


Told = tuple[str, bytes, int, int, int]


def read_in(folder: Path) -> list[tuple[int, Told]]:
    """Messages of all sealed segments with their arrival numbers, in this order."""
    found = []
    for path in folder.glob("*.mcap"):
        with SegmentReader(path, int(path.stem)) as reader:
            summary = reader.summary()
            for chunk in map(reader.read_chunk, summary.chunks):
                for row, seq in enumerate(chunk.seq.tolist()):
                    batch = chunk.batch
                    topic = summary.channels[int(batch.channel[row])].topic
                    columns = (batch.log_time, batch.publish_time, batch.sequence)
                    numbers = [int(column[row]) for column in columns]
                    found.append((seq, (topic, bytes(batch.payload(row)), *numbers)))
    return sorted(found)


def of_rows(rows: Sequence[Row]) -> list[Told]:
    return [(TOPICS[topic].topic, payload, *numbers) for topic, payload, *numbers in rows]


MESSAGE = st.tuples(
    st.one_of(st.integers(0, 6), st.integers(0, 39)),
    st.one_of(st.integers(0, 90), st.integers(100, 900)).map(os.urandom),
    st.integers(0, 2**40),
    st.integers(0, 2**40),
    st.integers(0, 2**32 - 1),
)


@given(
    batches=st.lists(st.lists(MESSAGE, max_size=60), max_size=8),
    flushes=st.booleans(),
    size=st.sampled_from([1, 6000, 1 << 20]),
)
def test_messages_come_back_in_total_order_byte_for_byte(
    tmp_path_factory: pytest.TempPathFactory, batches: list[list[Row]], flushes: bool, size: int
) -> None:
    setup = SegmentSettings(
        chunk_size=1024, large_payload=100, own_payload=50, segment_size=size, sync="never"
    )
    made = Recorded(tmp_path_factory.mktemp("r") / "r", setup)
    for rows in batches:
        made.append(rows)
        if flushes:
            made.writer.flush()
    paths = made.close()
    found = read_in(made.folder)
    assert [seq for seq, _ in found] == [*range(len(made.rows))]
    assert [message for _, message in found] == of_rows(made.rows)
    # What was told of each chunk is where it says.
    assert sum(len(chunk.batch) for chunk in made.chunks) == len(made.rows)
    official: Counter[Told] = Counter()
    for path in paths:
        assert problems(path) == []
        with path.open("rb") as stream:
            for _, channel, m in make_reader(stream, validate_crcs=True).iter_messages():
                official[channel.topic, m.data, m.log_time, m.publish_time, m.sequence] += 1
    assert official == Counter(of_rows(made.rows))
    # Groups follow one another, and each begins with its first segment.
    numbers = [sealed.file.number for group in made.groups for sealed in group]
    assert numbers == [*range(len(paths))] == sorted(int(path.stem) for path in paths)
    for group in made.groups:
        assert {sealed.file.group for sealed in group} == {group[0].file.number}
        assert len(group) <= 32
        for sealed in group:
            with SegmentReader(made.folder / sealed.file.name, sealed.file.number) as reader:
                said = reader.summary().recording
            assert group_of(said, sealed.file.number) == sealed.file.group
        for sealed in group[1:]:
            assert LATCHED.topic not in {one.topic for one in sealed.channels.values()}
        own = [s for s in group[1:] if {one.topic for one in s.channels.values()} == {NAMED.topic}]
        assert len(own) <= 1
        assert all(
            sealed in own or NAMED.topic not in {one.topic for one in sealed.channels.values()}
            for sealed in group
        )


def test_where_topics_lie(tmp_path: Path) -> None:
    made = Recorded(tmp_path / "r", SegmentSettings(**{**vars_of(SMALL), "segment_size": 1 << 20}))
    made.write(0, 50, 5)  # small
    made.write(1, 5000)  # large, and alone, as a map is
    made.write(2, 400, 20)  # of its own size, once it has more
    made.write(2, 400, 20)
    made.write(3, 150, 40)  # larger than small
    made.write(38, 10)  # named
    made.write(39, 5000, 3)  # latched
    made.close()
    (found,) = made.topics()
    assert found == {
        0: {"/0", "/39"},
        1: {"/1", "/2", "/3"},
        2: {"/2"},
        3: {"/38"},
    }


def vars_of(setup: SegmentSettings) -> dict[str, Any]:
    return {name: getattr(setup, name) for name in SegmentSettings.__struct_fields__}


def test_the_next_group_goes_by_the_one_before(tmp_path: Path) -> None:
    """The topics with the most bytes have segments, among those of large messages."""
    made = Recorded(tmp_path / "r", SegmentSettings(**{**vars_of(SMALL), "segment_size": 60_000}))
    for topic in range(20):
        made.write(topic, 110, 3 + topic)
    assert made.groups == []
    while not made.groups:  # small, and much of it
        made.write(30, 90)
    for topic in (*range(20), 31):
        made.write(topic, 110)
    made.close()
    first, second = made.topics()
    assert [*first.values()] == [{"/30"}, {f"/{n}" for n in range(20)}]
    low, together, *own = second.values()
    assert low == set()
    assert together == {"/0", "/1", "/2", "/3", "/31"}
    assert own == [{f"/{n}"} for n in range(4, 20)]


def test_killed_with_several_open_segments(tmp_path: Path) -> None:
    """Each is recovered by itself, without a last chunk that has lost its arrival numbers."""
    made = Recorded(tmp_path / "r", SegmentSettings(**{**vars_of(SMALL), "segment_size": 1 << 30}))
    for _ in range(10):
        made.write(0, 50)
        made.write(1, 700, 3)
        made.write(2, 300, 6)
    made.writer.abort()
    opened = sorted(made.folder.glob("*.open"))
    assert len(opened) > 3
    # The last chunks of two segments lose what lies behind them.
    torn = {chunk.segment: chunk for chunk in made.chunks if chunk.segment in {0, 2}}
    for number, chunk in torn.items():
        os.truncate(opened[number], chunk.place.offset + chunk.place.length + 5)
    told: list[Sealed] = []
    for path in opened:
        recover_segment(path, lambda sealed, _: told.append(sealed))
    assert {sealed.file.group for sealed in told} == {0}
    lost = {seq for chunk in torn.values() for seq in chunk.seq.tolist()}
    assert read_in(made.folder) == [
        (seq, message) for seq, message in enumerate(of_rows(made.rows)) if seq not in lost
    ]


def test_a_group_that_cannot_be_listed_is_sealed_later(tmp_path: Path) -> None:
    tries: list[list[str]] = []

    def listing(group: Sequence[Sealed]) -> None:
        tries.append([sealed.file.name for sealed in group])
        if len(tries) == 1:
            raise DiskFullError("no room for a line")

    made = Recorded(tmp_path / "r", on_sealing=listing)
    made.write(0, 50)
    made.write(1, 900, 5)
    with pytest.raises(DiskFullError, match="line"):
        made.close()
    assert {path.suffix for path in made.folder.iterdir()} == {".open"}
    made.writer.close_truncated([])
    assert tries[0] == tries[1] == ["000000.mcap", "000001.mcap", "000002.mcap"]
    assert tries[2] == ["000003.mcap"]
    assert [message for _, message in read_in(made.folder)] == of_rows(made.rows)


def test_losses_that_found_no_room_come_in_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = Recorded(tmp_path / "r")
    made.write(0, 50)
    real, fails = SegmentFile.add_metadata, [*range(3)]

    def add(segment: SegmentFile, record: Metadata) -> None:
        if fails and record.name == LOSSES_METADATA:
            fails.pop()
            raise DiskFullError("no room for a record")
        real(segment, record)

    monkeypatch.setattr(SegmentFile, "add_metadata", add)
    for count in (16, 3):
        ledger = Ledger()
        ledger.note(Loss(Cause.TRANSPORT, "/a", count, 1, 2))
        with suppress(DiskFullError):
            made.writer.add_extra(losses_record(ledger.take()))
    with pytest.raises(DiskFullError):
        made.writer.close()
    made.writer.close_truncated([])
    with SegmentReader(made.folder / "000000.mcap", 0) as reader:
        assert {row.count for row in reader.summary().losses} == {16, 3}
