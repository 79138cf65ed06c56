"""The chunk table: it covers every byte once, or it is refused."""

from __future__ import annotations

import random
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridlog_storage.errors import SegmentError
from hybridlog_storage.messages import Batch
from hybridlog_storage.segments.chunk_table import (
    CHUNK,
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


def built(rng: random.Random, chunks: int) -> ChunkTable:
    builder = TableBuilder()
    at = first = 43
    for _ in range(chunks):
        channel = [rng.randrange(1, 5) for _ in range(rng.randrange(1, 9))]
        log_time = [rng.randrange(1 << 40) for _ in channel]
        place = at + rng.randrange(50), rng.randrange(1, 80), rng.randrange(1, 30)
        builder.chunk(place, (min(log_time), max(log_time)), parts(channel, log_time))
        at = sum(place)
    assert builder.chunks == chunks
    table = builder.build()
    assert table.end == (at if at > first else 0)
    return table


@pytest.mark.parametrize("seed", range(20))
def test_a_table_comes_back(seed: int) -> None:
    rng = random.Random(seed)
    table = built(rng, rng.randrange(6))
    again = ChunkTable.from_bytes(table.to_bytes())
    assert again.end == table.end
    for name in ("chunks", "parts"):
        assert getattr(again, name).tobytes() == getattr(table, name).tobytes()
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


def test_every_flipped_bit_of_a_table_is_found() -> None:
    data = built(random.Random(7), 4).to_bytes()
    good = ChunkTable.from_bytes(data)
    for bit in range(8 * len(data)):
        bad = bytearray(data)
        bad[bit // 8] ^= 1 << bit % 8
        try:
            found = ChunkTable.from_bytes(bytes(bad))
        except SegmentError:
            continue
        # A frame has a few bits without meaning.
        for name in ("chunks", "parts"):
            assert getattr(found, name).tobytes() == getattr(good, name).tobytes()


def test_every_cut_of_a_table_is_found() -> None:
    data = built(random.Random(8), 3).to_bytes()
    for size in range(len(data)):
        with pytest.raises(SegmentError, match="chunk table"):
            ChunkTable.from_bytes(data[:size])


def test_a_table_that_claims_much_allocates_nothing() -> None:
    frame = checked_frame(b"x" * 100)
    for counts in ([2**32 - 1] * 2, [2**32 - 1, 0], [0, 1 << 24]):
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
        (_set("chunks", 1, "offset", -1), "not in order"),
        (_set("chunks", 0, "length", 1), "not in order"),
        (_set("chunks", 0, "trailer", 1), "not in order"),
        (_set("chunks", 1, "trailer", -10), "no bytes"),
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
    for n in range(3):
        builder.chunk((30 + 110 * n, 100, 10), (5, 9), parts([1, 2], [5, 9]))
    table = builder.build()
    copy = ChunkTable(table.chunks.copy(), table.parts.copy())
    assert ChunkTable.from_bytes(copy.to_bytes()).end == 360
    change(copy)
    with pytest.raises(SegmentError, match=problem):
        ChunkTable.from_bytes(copy.to_bytes())


def test_chunks_stand_in_the_order_of_the_file() -> None:
    """Their row is their number, which references name."""
    builder = TableBuilder()
    for at in (10, 20):
        builder.chunk((at, 5, 5), (5, 5), parts([1], [5]))
    table = builder.build()
    turned = ChunkTable(table.chunks[::-1], table.parts)
    with pytest.raises(SegmentError, match="not in order"):
        ChunkTable.from_bytes(turned.to_bytes())


def test_rows_are_as_large_as_the_format_says() -> None:
    assert (CHUNK.itemsize, PART.itemsize) == (44, 48)
