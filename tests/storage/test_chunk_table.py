"""The chunk table: it covers every byte once, or it is refused."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from hybridlog_storage.errors import SegmentError
from hybridlog_storage.mcap.mcap_content import checked_frame
from hybridlog_storage.messages import Batch
from hybridlog_storage.segments.chunk_table import (
    ChunkTable,
    TableBuilder,
    parts_of,
)
from hybridlog_storage.segments.segment_format import index_order


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
    "change",
    [
        _set("chunks", 1, "offset", -1),
        _set("chunks", 0, "length", 1),
        _set("chunks", 0, "trailer", 1),
        _set("chunks", 1, "trailer", -10),
        _set("chunks", 0, "offset", 2**62),
        _set("chunks", 0, "length", 2**63),
        _set("chunks", 0, "parts", 1),
        _set("parts", 0, "channel", 9),
        _set("parts", 2, "channel", 70_000),
        _set("parts", 0, "first", -1),
        _set("parts", 1, "last", 100),
        _set("parts", 0, "last", -1),
        _set("parts", 1, "first", 1),
        _set("chunks", 0, "first", 1),
        _set("chunks", 2, "last", 1),
        _set("parts", 0, "messages", -1),
    ],
)
def test_a_table_that_contradicts_itself_is_refused(change: Callable[[ChunkTable], None]) -> None:
    builder = TableBuilder()
    for n in range(3):
        builder.chunk((30 + 110 * n, 100, 10), (5, 9), parts([1, 2], [5, 9]))
    table = builder.build()
    copy = ChunkTable(table.chunks.copy(), table.parts.copy())
    assert ChunkTable.from_bytes(copy.to_bytes()).end == 360
    change(copy)
    with pytest.raises(SegmentError, match="contradicts itself"):
        ChunkTable.from_bytes(copy.to_bytes())
