"""The chunk table: it covers every byte once, or it is refused."""

from __future__ import annotations

import random
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridlog_storage.checksum import crc32
from hybridlog_storage.errors import SegmentError
from hybridlog_storage.messages import Batch
from hybridlog_storage.segments.chunk_table import (
    CHUNK,
    OTHER,
    PART,
    ChunkTable,
    TableBuilder,
    parts_of,
)
from hybridlog_storage.segments.segment_format import checked_frame, index_order


def batch(channel: list[int], log_time: list[int]) -> Batch:
    count = len(channel)
    return Batch(
        bytes(count * 3),
        np.arange(count, dtype=np.int64) * 3,
        np.arange(count, dtype=np.int64) % 4,
        np.array(channel, np.int32),
        np.array(log_time, np.int64),
        np.array(log_time, np.int64) + 5,
        np.zeros(count, np.uint32),
    )


def parts(channel: list[int], log_time: list[int]) -> NDArray[np.void]:
    messages = batch(channel, log_time)
    order = index_order(messages.channel, messages.log_time)
    found, first, last = parts_of(messages, order)
    assert (first, last) == (min(log_time), max(log_time))
    return found


@given(
    st.integers(1, 4).flatmap(
        lambda most: st.lists(
            st.tuples(st.integers(1, most), st.integers(0, 2**62)), min_size=1, max_size=50
        )
    )
)
def test_parts_tell_what_a_chunk_holds_of_each_channel(rows: list[tuple[int, int]]) -> None:
    channel, log_time = [list(column) for column in zip(*rows, strict=True)]
    messages = batch(channel, log_time)
    found = parts(channel, log_time)
    assert found.dtype == PART
    want = []
    for number in sorted(set(channel)):
        of = [n for n, c in enumerate(channel) if c == number]
        times = [log_time[n] for n in of]
        size = sum(int(messages.length[n]) for n in of)
        first, last = min(times), max(times)
        want.append((number, len(of), size, first, last, first + 5, last + 5))
    assert found.tolist() == want


def built(rng: random.Random, chunks: int) -> tuple[ChunkTable, bytes]:
    """A table, and a file that it describes."""
    builder = TableBuilder()
    file = bytearray()

    def other(size: int) -> None:
        record = rng.randbytes(size)
        builder.other(record)
        file.extend(record)

    other(rng.randrange(1, 50))
    for _ in range(chunks):
        for _ in range(rng.randrange(3)):
            other(rng.choice([0, 1, 20, 40_000]))
        record, trailer = rng.randbytes(rng.randrange(1, 80)), rng.randbytes(rng.randrange(1, 30))
        channel = [rng.randrange(1, 5) for _ in range(rng.randrange(1, 9))]
        log_time = [rng.randrange(1 << 40) for _ in channel]
        builder.chunk(
            offset=len(file),
            length=len(record),
            trailer=len(trailer),
            crc=crc32(record),
            trailer_crc=crc32(trailer),
            first=min(log_time),
            last=max(log_time),
            parts=parts(channel, log_time),
        )
        file += record + trailer
    damaged = rng.randbytes(rng.randrange(9))
    builder.stretch(len(damaged), crc32(damaged))
    file += damaged
    end = rng.randbytes(13)
    before = builder.build()
    table = builder.build(end)
    # The record that is about to follow was not listed for good.
    assert builder.build().to_bytes() == before.to_bytes()
    assert builder.chunks == chunks
    return table, bytes(file) + end


@pytest.mark.parametrize("seed", range(20))
def test_every_byte_is_covered_once(seed: int) -> None:
    rng = random.Random(seed)
    table, file = built(rng, rng.randrange(6))
    again = ChunkTable.from_bytes(table.to_bytes())
    assert again.end == table.end == len(file)
    for name in ("chunks", "parts", "others"):
        assert getattr(again, name).tobytes() == getattr(table, name).tobytes()
    covered = np.zeros(len(file), np.int64)
    for offset, length, trailer, crc, trailer_crc, *_ in again.chunks.tolist():
        middle = offset + length
        assert crc32(file[offset:middle]) == crc
        assert crc32(file[middle : middle + trailer]) == trailer_crc
        covered[offset : middle + trailer] += 1
    for offset, length, crc in again.others.tolist():
        assert crc32(file[offset : offset + length]) == crc
        covered[offset : offset + length] += 1
        assert again.stretch(offset, length) == (offset, length, crc)
        assert again.stretch(offset, length + 1) is None
    assert (covered == 1).all()
    bounds = again.part_bounds()
    assert bounds[-1] == len(again.parts)
    for number, row in enumerate(again.chunks):
        own = again.parts[bounds[number] : bounds[number + 1]]
        assert (own["first"].min(), own["last"].max()) == (row["first"], row["last"])
    totals = again.by_channel()
    for row in totals:
        own = again.parts[again.parts["channel"] == row["channel"]]
        assert row["messages"] == own["messages"].sum()
        assert row["payload_bytes"] == own["payload_bytes"].sum()
        assert (row["first"], row["last"]) == (own["first"].min(), own["last"].max())
        assert row["first_publish"] == own["first_publish"].min()
        assert row["last_publish"] == own["last_publish"].max()
    assert totals["channel"].tolist() == sorted(set(again.parts["channel"].tolist()))


def test_small_records_share_a_row_and_large_ones_do_not() -> None:
    """Checking one record reads no more than its row."""
    builder = TableBuilder()
    for size in (10, 20, 65_000, 600, 1 << 20, 5, 6):
        builder.other(bytes(size))
    rows = builder.build().others["length"].tolist()
    assert rows == [65_030, 600, 1 << 20, 11]


def test_every_flipped_bit_of_a_table_is_found() -> None:
    data = built(random.Random(7), 4)[0].to_bytes()
    good = ChunkTable.from_bytes(data)
    for bit in range(8 * len(data)):
        bad = bytearray(data)
        bad[bit // 8] ^= 1 << bit % 8
        try:
            found = ChunkTable.from_bytes(bytes(bad))
        except SegmentError:
            continue
        # A frame has a few bits without meaning.
        for name in ("chunks", "parts", "others"):
            assert getattr(found, name).tobytes() == getattr(good, name).tobytes()


def test_every_cut_of_a_table_is_found() -> None:
    data = built(random.Random(8), 3)[0].to_bytes()
    for size in range(len(data)):
        with pytest.raises(SegmentError, match="chunk table"):
            ChunkTable.from_bytes(data[:size])


def test_a_table_that_claims_much_allocates_nothing() -> None:
    frame = checked_frame(b"x" * 100)
    for counts in ([2**32 - 1] * 3, [2**32 - 1, 0, 0], [0, 0, 1 << 24]):
        data = np.array(counts, "<u4").tobytes() + frame
        with pytest.raises(SegmentError, match="damaged"):
            ChunkTable.from_bytes(data)


def _set(array: str, row: int, field: str, change: int) -> Callable[[ChunkTable], None]:
    def do(table: ChunkTable) -> None:
        column = getattr(table, array)[field]
        column[row] = int(column[row]) + change

    return do


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (_set("chunks", 1, "offset", 1), "each byte once"),
        (_set("chunks", 0, "length", 1), "each byte once"),
        (_set("chunks", 0, "trailer", 1), "each byte once"),
        (_set("others", 0, "length", 1), "each byte once"),
        (_set("others", 0, "offset", 1), "each byte once"),
        (_set("chunks", 0, "offset", 2**62), "beyond all files"),
        (_set("chunks", 0, "length", 2**63), "beyond all files"),
        (_set("chunks", 0, "parts", 1), "parts do not fit"),
        (_set("parts", 0, "channel", 9), "not in order"),
        (_set("parts", 2, "channel", 70_000), "not in order"),
        (_set("parts", 0, "first", -1), "times"),
        (_set("parts", 1, "last", 100), "times"),
        (_set("parts", 0, "last", -1), "times"),
        (_set("parts", 1, "first", 1), "times"),
        (_set("chunks", 0, "first", 1), "times"),
        (_set("chunks", 2, "last", 1), "times"),
        (_set("parts", 0, "messages", -1), "times"),
    ],
)
def test_a_table_that_contradicts_itself_is_refused(
    change: Callable[[ChunkTable], None], problem: str
) -> None:
    builder = TableBuilder()
    builder.other(bytes(30))
    for _ in range(3):
        builder.chunk(
            offset=builder.end,
            length=100,
            trailer=10,
            crc=1,
            trailer_crc=2,
            first=5,
            last=9,
            parts=parts([1, 2], [5, 9]),
        )
    table = builder.build()
    copy = ChunkTable(table.chunks.copy(), table.parts.copy(), table.others.copy())
    assert ChunkTable.from_bytes(copy.to_bytes()).end == 360
    change(copy)
    with pytest.raises(SegmentError, match=problem):
        ChunkTable.from_bytes(copy.to_bytes())


def test_chunks_stand_in_the_order_of_the_file() -> None:
    """Their row is their number, which references name."""
    builder = TableBuilder()
    for length in (10, 20):
        builder.chunk(
            offset=builder.end,
            length=length,
            trailer=1,
            crc=1,
            trailer_crc=2,
            first=5,
            last=5,
            parts=parts([1], [5]),
        )
    table = builder.build()
    turned = ChunkTable(table.chunks[::-1], table.parts, table.others)
    with pytest.raises(SegmentError, match="not in order"):
        ChunkTable.from_bytes(turned.to_bytes())


def test_rows_are_as_large_as_the_format_says() -> None:
    assert (CHUNK.itemsize, PART.itemsize, OTHER.itemsize) == (52, 48, 20)
