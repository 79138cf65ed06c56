"""Foreign MCAP files: everything that the official reader gives, and every fault named."""

from __future__ import annotations

import io
import struct
from collections import Counter
from typing import TYPE_CHECKING, Any, NamedTuple
from unittest.mock import ANY

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, DataEnd, Footer, Header, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, Writer

import hybridlog as hl
from hybridlog.formats.mcap.reader import McapSource
from hybridlog.formats.reading import Damage
from hybridlog_storage import messages as log
from hybridlog_storage.mcap.mcap_content import MAGIC
from hybridlog_storage.segments.segment_format import METADATA_CHECK
from tests import places
from tests.independent import write_mcap

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

ANY_JSON = log.Channel("/a", "json", None)


class Seen(NamedTuple):
    topic: str
    encoding: str
    schema: tuple[str, str, bytes] | None
    metadata: tuple[tuple[str, str], ...]
    log_time: int
    publish_time: int
    sequence: int
    payload: bytes


class Read(NamedTuple):
    source: McapSource
    messages: list[Seen]

    @property
    def damage(self) -> list[Damage]:
        return self.source.damage

    @property
    def lost(self) -> list[int | None]:
        return [damage.messages_lost for damage in self.source.damage]


def read(path: Path) -> Read:
    messages: list[Seen] = []
    with McapSource(path) as source:
        for batch in source.batches():
            assert len(batch) > 0
            for i in range(len(batch)):
                channel = source.channels[batch.channel[i]]
                schema = channel.schema
                messages.append(
                    Seen(
                        channel.topic,
                        channel.message_encoding,
                        schema and (schema.name, schema.encoding, schema.data),
                        tuple(sorted(channel.metadata.items())),
                        int(batch.log_time[i]),
                        int(batch.publish_time[i]),
                        int(batch.sequence[i]),
                        bytes(batch.payload(i)),
                    )
                )
        assert source.bytes_read == source.size_bytes
    return Read(source, messages)


def official(path: Path) -> list[Seen]:
    """What the format's own forward reader gives."""
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    found = []
    with path.open("rb") as file:
        for record in StreamReader(file, validate_crcs=True).records:
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message):
                channel = channels[record.channel_id]
                schema = schemas.get(channel.schema_id)
                found.append(
                    Seen(
                        channel.topic,
                        channel.message_encoding,
                        schema and (schema.name, schema.encoding, schema.data),
                        tuple(sorted(channel.metadata.items())),
                        record.log_time,
                        record.publish_time,
                        record.sequence,
                        record.data,
                    )
                )
    return found


def test_a_count_that_no_file_can_hold_is_not_kept(tmp_path: Path) -> None:
    """The loss ledger goes into a database whose integers have 64 bits."""
    path = write_mcap(tmp_path / "a.mcap", [(ANY_JSON, 1, b"{}")], enable_crcs=False)
    count = struct.pack("<BQQ", Opcode.STATISTICS, 56, 1)
    assert path.read_bytes().count(count) == 1
    path.write_bytes(path.read_bytes().replace(count, count[:9] + b"\xff" * 8))
    found = read(path)
    assert len(found.messages) == 1
    assert found.lost == [None]


# Files made here


def make(
    compression: CompressionType = CompressionType.NONE,
    *,
    chunk_size: int = 300,
    chunked: bool = True,
    count: int = 12,
    **options: Any,
) -> bytes:
    out = io.BytesIO()
    writer = Writer(
        out, chunk_size=chunk_size, compression=compression, use_chunking=chunked, **options
    )
    writer.start("ros2", "tests")
    schema = writer.register_schema("s/msg/S", "ros2msg", b"int32 x")
    channels = [writer.register_channel(t, "cdr", schema, {"q": t}) for t in ("/a", "/b")]
    rng = np.random.default_rng(5)
    for i in range(count):
        writer.add_message(channels[i % 2], i + 1, rng.bytes(20) + b"same " * 5, i, i)
        if i == 5:
            writer.add_metadata("m", {"k": "v"})
            writer.add_attachment(1, 2, "a", "t", b"data")
    writer.finish()
    return out.getvalue()


VARIANTS = {
    **{c.name: make(c) for c in CompressionType},
    "LOOSE": make(chunked=False),
    "ONE_CHUNK": make(CompressionType.NONE, chunk_size=1 << 20),
}


@pytest.fixture
def put(tmp_path: Path) -> Callable[[bytes], Path]:
    def write(data: bytes) -> Path:
        path = tmp_path / "x.mcap"
        path.write_bytes(data)
        return path

    return write


def damaged(good: bytes, rng: np.random.Generator) -> bytes:
    """A log with a changed byte, a block of zeros, no end, or bytes added or taken out."""
    bad, at = bytearray(good), int(rng.integers(len(MAGIC), len(good)))
    kind, size = rng.integers(5), int(rng.choice([1, 20, 300]))
    if kind == 0:
        bad[at] ^= int(rng.integers(1, 256))
    elif kind == 1:
        bad[at : at + size] = bytes(len(bad[at : at + size]))
    elif kind == 2:
        del bad[at:]
    elif kind == 3:
        bad[at:at] = rng.bytes(size)
    else:
        del bad[at : at + size]
    return bytes(bad)


@pytest.mark.parametrize("name", VARIANTS)
def test_damage_costs_no_whole_chunk_and_is_told(name: str, put: Callable[[bytes], Path]) -> None:
    good = VARIANTS[name]
    wanted = Counter(official(put(good)))
    records = StreamReader(io.BytesIO(good), emit_chunks=True).records
    chunks = [one for one in records if isinstance(one, Chunk)]
    rng = np.random.default_rng(7)
    for _ in range(40):
        bad = damaged(good, rng)
        found = read(put(bad))
        lost = wanted.total() - len(found.messages)
        assert found.damage or lost == 0 or name == "LOOSE"
        if name == "LOOSE":  # nothing there could tell a changed payload
            continue
        assert not Counter(found.messages) - wanted
        if None not in found.lost:
            assert sum(x or 0 for x in found.lost) == lost
        whole = 0
        for chunk in chunks:
            if content_of(chunk) in bad:
                whole += sum(isinstance(one, Message) for one in breakup_chunk(chunk))
        if len(bad) == len(good):  # bytes that are missing may cost the chunk behind them, too
            assert len(found.messages) >= whole or "not defined" in str(found.damage)


def content_of(chunk: Chunk) -> bytes:
    """A chunk record."""
    builder = RecordBuilder()
    chunk.write(builder)
    return builder.end()


def raw(*records: Any, profile: str = "") -> bytes:
    builder = RecordBuilder()
    for record in (Header(profile, ""), *records, DataEnd(0), Footer(0, 0, 0)):
        record.write(builder)
    return MAGIC + builder.end() + MAGIC


def message(channel: int, n: int) -> Message:
    return Message(channel, n, b"%d" % n, n, n)


A = Schema(1, b"A", "e", "A")
B = Schema(1, b"B", "e", "B")


def test_a_channel_defined_anew_is_another_channel(put: Callable[[bytes], Path]) -> None:
    first, second = Channel(1, "/x", "cdr", {}, 1), Channel(1, "/y", "cdr", {}, 1)
    said = (first, first, second, first)
    path = put(raw(A, *(row for n, one in enumerate(said) for row in (one, message(1, n)))))
    found = read(path)
    assert found.messages == official(path)
    assert [m.topic for m in found.messages] == ["/x", "/x", "/y", "/x"]
    assert [c.topic for c in found.source.channels] == ["/x", "/y"]
    assert found.damage == []


@pytest.mark.parametrize("compression", list(CompressionType))
def test_definitions_that_change_inside_a_chunk_hold_from_there(
    compression: CompressionType, put: Callable[[bytes], Path]
) -> None:
    builder = RecordBuilder()
    channel = Channel(1, "/x", "cdr", {}, 1)
    for record in (A, channel, message(1, 0), B, message(1, 1), A, message(1, 2)):
        record.write(builder)
    content = builder.end()
    pack = {"zstd": zstandard.compress, "lz4": lz4.frame.compress, "none": bytes}
    name = compression.name.lower()
    codec, packed = "" if name == "none" else name, pack[name](content)
    path = put(raw(Chunk(codec, bytes(packed), 2, 0, 0, len(content))))
    found = read(path)
    assert found.messages == official(path)
    assert [m.schema and m.schema[0] for m in found.messages] == ["A", "B", "A"]
    assert len(found.source.channels) == 2


def test_messages_without_definitions_are_counted(put: Callable[[bytes], Path]) -> None:
    good = Channel(1, "/x", "cdr", {}, 1)
    bare = Channel(2, "/bare", "json", {}, 0)
    no_schema = Channel(3, "/odd", "cdr", {}, 9)
    found = read(
        put(
            raw(
                *(A, good, bare, no_schema),
                *(message(1, 0), message(7, 1), message(2, 2), message(7, 3), message(3, 4)),
            )
        )
    )
    assert [(m.topic, m.log_time) for m in found.messages] == [("/x", 0), ("/bare", 2), ("/odd", 4)]
    assert [m.schema is None for m in found.messages] == [False, True, True]
    assert found.lost == [2]
    assert "2 messages on channels that are not defined (7)" in found.damage[0].reason


def test_times_past_int64_are_counted(put: Callable[[bytes], Path]) -> None:
    channel = Channel(1, "/x", "cdr", {}, 0)
    late = Message(1, 1 << 63, b"late", 0, 0)
    unpublished = Message(1, 5, b"5", (1 << 64) - 1, 3)
    found = read(put(raw(channel, message(1, 0), late, late, unpublished, message(1, 9))))
    # The log time stands for a publish time that is none.
    assert [(m.log_time, m.publish_time) for m in found.messages] == [(0, 0), (5, 5), (9, 9)]
    assert found.lost == [2]
    assert "2^63" in found.damage[0].reason


@pytest.mark.parametrize("use_chunking", [True, False])
def test_what_stands_behind_the_last_message_is_recorded(
    tmp_path: Path, *, use_chunking: bool
) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, use_chunking=use_chunking)  # a chunk comes last
        writer.start()
        writer.add_attachment(1, 1, "before", "text/plain", b"first")
        channel = writer.register_channel("/a", "json", 0)
        writer.add_message(channel, 1, b"{}", 1)
        writer.add_attachment(2, 2, "behind", "text/plain", b"last")
        writer.add_metadata("robot", {"name": "r2"})
        writer.finish()
    with hl.open(tmp_path / "store", create=True) as store:
        entry = store.record(path).entry
        with places.segment(store.directory.path, entry.name).open("rb") as stream:
            reader = make_reader(stream)
            found = {a.name: a.data for a in reader.iter_attachments()}
            metadata = {record.name: record.metadata for record in reader.iter_metadata()}
    assert found == {"before": b"first", "behind": b"last"}
    assert metadata["robot"] == {"name": "r2", METADATA_CHECK: ANY}


def test_a_chunk_in_a_payload_of_a_damaged_chunk_is_none_of_the_file(
    tmp_path: Path,
) -> None:
    rows = [(ANY_JSON, 100 + i, VARIANTS["NONE"]) for i in range(3)]
    none = CompressionType.NONE
    path = write_mcap(tmp_path / "a.mcap", rows, chunk_size=1, compression=none)
    bad = bytearray(path.read_bytes())
    bad[120:140] = bytes(20)
    path.write_bytes(bad)
    found = read(path)
    assert [message.log_time for message in found.messages] == [101, 102]


def test_a_summary_that_counts_more_than_there_is_raises_suspicion(
    put: Callable[[bytes], Path],
) -> None:
    data = bytearray(make(enable_crcs=False))
    at = bytes(data).rindex(struct.pack("<QHI", 12, 1, 2))
    struct.pack_into("<Q", data, at, 15)
    found = read(put(bytes(data)))
    assert len(found.messages) == 12
    assert found.lost == [3]
