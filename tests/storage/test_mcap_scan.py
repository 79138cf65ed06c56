"""Every record of every file, as the format's own conformance suite wants it."""

from __future__ import annotations

import contextlib
import io
import struct
from itertools import takewhile
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, DataEnd, Footer, Header, Message, MessageIndex, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from hybridlog_storage import messages
from hybridlog_storage.errors import SegmentError
from hybridlog_storage.mcap.mcap_content import (
    MAGIC,
    ChunkContent,
    Damage,
    parse_content,
    read_record,
)
from hybridlog_storage.mcap.mcap_scan import Scan
from hybridlog_storage.segments.segment_format import Attachment, reader_of
from tests.data import DATA, needs_data
from tests.independent import write_mcap
from tests.work import calls_in

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

CONFORMANCE = DATA / "mcap-conformance" / "data"


def scan_of(data: bytes, **options: Any) -> Scan:
    return Scan(lambda at, size: data[at : at + size], len(data), **options)


def items_of(data: bytes, **options: Any) -> list[tuple[int, object]]:
    return list(scan_of(data, **options).items())


def messages_of(content: ChunkContent) -> Iterator[Message]:
    batch = content.batch
    for i in range(len(batch)):
        yield Message(
            int(batch.channel[i]),
            int(batch.log_time[i]),
            bytes(batch.payload(i)),
            int(batch.publish_time[i]),
            int(batch.sequence[i]),
        )


def records_of(items: Iterable[tuple[int, object]]) -> Iterator[object]:
    """All records in order, as the `mcap` package has them."""
    for _, item in items:
        if isinstance(item, ChunkContent):
            rows = list(messages_of(item))
            defined = list(item.definitions)
            for row in range(len(rows) + 1):
                while defined and defined[0].row == row:
                    yield defined.pop(0).record
                if row < len(rows):
                    yield rows[row]
        elif isinstance(item, Attachment):
            data = b"".join(item.pieces())
            yield records.Attachment(
                item.create_time, item.log_time, item.name, item.media_type, data
            )
        else:
            yield item


@needs_data
def test_conformance() -> None:
    """Each file of the format's own suite gives what the official reader gives."""
    files = sorted(CONFORMANCE.glob("*/*.mcap"))
    assert len(files) == 416
    for path in files:
        data = path.read_bytes()
        skipped = (MessageIndex, DataEnd)
        official = takewhile(
            lambda record: not isinstance(record, DataEnd),
            StreamReader(io.BytesIO(data), validate_crcs=True).records,
        )
        wanted = [record for record in official if not isinstance(record, skipped)]
        assert list(records_of(items_of(data))) == wanted, path.name
        summary = scan_of(data).summary
        theirs = make_reader(io.BytesIO(data)).get_summary()
        assert summary is None or theirs is not None
        if theirs is not None and summary is not None:
            assert vars(summary) == vars(theirs), path.name


# Contents of chunks


def content_of(*parts: Any) -> bytes:
    builder = RecordBuilder()
    for part in parts:
        part.write(builder)
    return builder.end()


MESSAGE = st.builds(
    Message,
    channel_id=st.integers(0, 65535),
    log_time=st.integers(0, 2**63 - 1),
    data=st.binary(max_size=40),
    publish_time=st.integers(0, 2**63 - 1),
    sequence=st.integers(0, 2**32 - 1),
)
SCHEMA = st.builds(
    Schema,
    id=st.integers(1, 65535),
    data=st.binary(max_size=20),
    encoding=st.text(max_size=5),
    name=st.text(max_size=5),
)
CHANNEL = st.builds(
    Channel,
    id=st.integers(0, 65535),
    topic=st.text(max_size=9),
    message_encoding=st.text(max_size=5),
    metadata=st.dictionaries(st.text(max_size=4), st.text(max_size=4), max_size=3),
    schema_id=st.integers(0, 65535),
)
RECORDS = st.lists(st.one_of(MESSAGE, MESSAGE, SCHEMA, CHANNEL), max_size=12)


@given(RECORDS)
def test_contents_come_back(records: list[Any]) -> None:
    content = parse_content(content_of(*records))
    assert list(messages_of(content)) == [r for r in records if isinstance(r, Message)]
    assert [d.record for d in content.definitions] == [
        r for r in records if not isinstance(r, Message)
    ]
    rows = [
        sum(isinstance(r, Message) for r in records[:i])
        for i, record in enumerate(records)
        if not isinstance(record, Message)
    ]
    assert [d.row for d in content.definitions] == rows
    batch = content.batch
    kinds = [c.dtype.name for c in (batch.offset, batch.length, batch.log_time)]
    assert kinds == ["int64"] * 3
    assert (batch.channel.dtype, batch.sequence.dtype) == (np.int32, np.uint32)
    assert len(content.invalid) == 0
    assert not content.unreadable


@given(RECORDS.filter(bool), st.data())
def test_cut_contents_are_an_error_or_a_prefix(records: list[Any], data: st.DataObject) -> None:
    whole = content_of(*records)
    cut = data.draw(st.integers(0, len(whole) - 1))
    ends = np.cumsum([0, *[len(content_of(r)) for r in records]]).tolist()
    prefix = parse_content(whole[:cut], loose=True)
    kept = sum(end <= cut for end in ends) - 1
    assert list(messages_of(prefix)) == [r for r in records[:kept] if isinstance(r, Message)]
    assert prefix.end == ends[kept]
    if cut not in ends:
        with pytest.raises(SegmentError, match=f"byte {ends[kept]} "):
            parse_content(whole[:cut])


def test_messages_without_a_head_are_left_out_wherever_they_stand() -> None:
    good = content_of(Message(1, 2, b"", 3, 4))
    tiny = struct.pack("<BQ", Opcode.MESSAGE, 0)
    for layout in ([good, tiny, good], [good, tiny, tiny, tiny], [tiny], [tiny, good, tiny, tiny]):
        content = parse_content(b"".join(layout))
        assert len(content.batch) == layout.count(good)
        assert len(content.invalid) == layout.count(tiny)


def test_other_records_in_chunks_are_skipped_and_broken_definitions_named() -> None:
    message = Message(1, 2, b"x", 3, 4)
    other = struct.pack("<BQ", 0x42, 3) + b"abc"
    broken = struct.pack("<BQHI", Opcode.SCHEMA, 6, 1, 1000)
    content = parse_content(content_of(message) + other + broken + content_of(message))
    assert list(messages_of(content)) == [message, message]
    assert not content.definitions
    (problem,) = content.unreadable
    assert "schema" in problem


@given(st.integers(1, 15), st.binary(max_size=60))
def test_any_bytes_as_a_record_give_a_record_or_one_error(opcode: int, data: bytes) -> None:
    with contextlib.suppress(SegmentError):
        record, used = read_record(opcode, data)
        assert record is None or 0 < used <= len(data)


@pytest.mark.parametrize("claim", [4, 1 << 31, (1 << 63) - 1, (1 << 64) - 1])
def test_an_attachment_that_claims_more_than_its_record_holds_is_damage(claim: int) -> None:
    fields = struct.pack("<QQIIQ", 0, 0, 0, 0, claim) + b"abc"
    record = struct.pack("<BQ", Opcode.ATTACHMENT, len(fields)) + fields
    body = content_of(Header("p", "l")) + record + content_of(DataEnd(0), Footer(0, 0, 0))
    (damage,) = damages(items_of(MAGIC + body + MAGIC))
    assert damage.reason.startswith("an attachment record is damaged")


def test_messages_are_not_looked_at_one_by_one() -> None:
    data = content_of(Message(7, 123, bytes(320), 456, 9)) * 20_000
    assert calls_in(lambda: parse_content(data)) < 3 * 20_000


# Files


def written(
    compression: CompressionType = CompressionType.NONE, *, chunked: bool = True, **options: Any
) -> bytes:
    out = io.BytesIO()
    writer = Writer(out, chunk_size=300, compression=compression, use_chunking=chunked, **options)
    writer.start("p", "l")
    schema = writer.register_schema("s", "jsonschema", b"{}")
    channels = [writer.register_channel(t, "json", schema, {}) for t in ("/a", "/b")]
    for i in range(40):
        writer.add_message(channels[i % 2], i, b"payload %d" % i * 3, i, i)
        if i == 20:
            writer.add_metadata("m", {"k": "v"})
            writer.add_attachment(1, 2, "a", "t", b"data")
    writer.finish()
    return out.getvalue()


def payloads(items: Iterable[tuple[int, object]]) -> list[bytes]:
    return [r.data for r in records_of(items) if isinstance(r, Message)]


def damages(items: Iterable[tuple[int, object]]) -> list[Damage]:
    return [item for _, item in items if isinstance(item, Damage)]


def parts_of(data: bytes | bytearray) -> tuple[list[int], int]:
    """Start of each chunk, and of the end of the data."""
    summary = make_reader(io.BytesIO(data)).get_summary()
    assert summary is not None
    starts = [index.chunk_start_offset for index in summary.chunk_indexes]
    return starts, struct.unpack_from("<Q", data, len(data) - 28)[0] - 13


ALL = payloads(items_of(written()))


@pytest.mark.parametrize("summary", [True, False])
@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("claim", [0, 5, 1 << 20, (1 << 63) - 1, (1 << 64) - 1])
def test_a_chunk_whose_length_is_wrong_is_read_all_the_same(
    claim: int, compression: CompressionType, *, summary: bool
) -> None:
    data = bytearray(written(compression))
    (_, place, *_), end = parts_of(data)
    if not summary:
        data = data[:end]
    struct.pack_into("<Q", data, place + 1, claim)
    items = items_of(bytes(data))
    assert payloads(items) == ALL
    assert [(d.offset, d.messages) for d in damages(items)] == [(end, 0)] * (not summary)


@pytest.mark.parametrize("claim", [0, 30, 31, 200, 1 << 62])
def test_a_loose_message_whose_length_is_wrong_costs_few(claim: int) -> None:
    data = bytearray(written(chunked=False))
    at = next(o for o, i in items_of(bytes(data)) if isinstance(i, ChunkContent))
    for _ in range(5):
        at += 9 + struct.unpack_from("<Q", data, at + 1)[0]
    struct.pack_into("<Q", data, at + 1, claim)
    items = items_of(bytes(data))
    found = payloads(items)
    assert found[:5] == ALL[:5]
    assert len(set(ALL) & set(found)) >= len(ALL) - 5
    assert damages(items)


def test_a_record_that_claims_too_much_costs_no_chunk_behind_it() -> None:
    data = bytearray(written())
    place = next(o for o, i in items_of(bytes(data)) if isinstance(i, Attachment))
    (length,) = struct.unpack_from("<Q", data, place + 1)
    struct.pack_into("<Q", data, place + 1, length + 7)
    items = items_of(bytes(data[: parts_of(data)[1]]))
    assert payloads(items) == ALL
    assert damages(items)[0].offset == place


def test_a_log_behind_the_end_of_another_one_is_told() -> None:
    data = written()
    items = items_of(data * 2)
    assert payloads(items)[: len(ALL)] == ALL
    assert damages(items)[0].reason == "bytes follow the end of the log"


def test_a_chunk_above_the_limit_is_skipped() -> None:
    data = written(CompressionType.NONE)
    assert len(damages(items_of(data, limit=100))) == len(parts_of(data)[0])


def test_a_wrong_summary_spoils_no_good_file() -> None:
    data = bytearray(written(enable_crcs=False))
    starts, end = parts_of(data)
    for start in starts:
        (length,) = struct.unpack_from("<Q", data, start + 1)
        at = bytes(data).index(struct.pack("<QQ", start, length + 9), end)
        struct.pack_into("<Q", data, at, start + 3)
    items = items_of(bytes(data))
    assert payloads(items) == ALL
    assert not damages(items)


def test_a_damaged_summary_is_none() -> None:
    data = written()
    assert scan_of(data).summary is not None
    for at in range(parts_of(data)[1] + 13, len(data) - 8):
        bad = bytearray(data)
        bad[at] ^= 0x41
        assert scan_of(bytes(bad)).summary is None
    for start in (0, 8, 12, 1 << 63, (1 << 64) - 1):
        bad = bytearray(data)
        struct.pack_into("<Q", bad, len(data) - 28, start)
        assert payloads(items_of(bytes(bad))) == ALL
    assert scan_of(MAGIC).summary is None


def test_memory_stays_bounded_over_a_long_file(tmp_path: Path) -> None:
    import tracemalloc

    path = tmp_path / "long.mcap"
    channel = messages.Channel("/a", "x", None)
    write_mcap(path, ((channel, i, bytes(1000)) for i in range(30_000)), use_chunking=False)
    size = path.stat().st_size
    with path.open("rb") as file:
        tracemalloc.start()
        try:
            items = Scan(reader_of(file.fileno()), size).items()
            rows = sum(len(i.batch) for _, i in items if isinstance(i, ChunkContent))
            _, peak = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
    assert rows == 30_000
    assert peak < 6 << 20
    assert size > 30_000_000


def test_a_torn_chunk_gives_its_beginning(tmp_path: Path) -> None:
    channel = messages.Channel("/a", "x", None)
    wanted = [np.random.default_rng(i).bytes(1000) for i in range(1000)]
    for compression in CompressionType:
        rows = ((channel, i, payload) for i, payload in enumerate(wanted))
        path = write_mcap(tmp_path / "a.mcap", rows, compression=compression)
        items = items_of(path.read_bytes()[:400_000])
        found = payloads(items)
        assert found == wanted[: len(found)]
        assert len(found) > 100
        (damage,) = damages(items)
        assert damage.reason == "the file ends in a chunk: its last messages are lost"
