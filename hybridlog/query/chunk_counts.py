"""How many messages lie in ranges of log time, by what is known of chunks.

The entry of a chunk says how many messages of each channel it has, and from when to when.
A chunk that lies within a range is counted without a look at it. Of one that reaches over
an end, the message indexes are read from the segment: 16 bytes a message, and no payload.
Their checksum stands in the entry.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import TYPE_CHECKING

import numpy as np

from hybridlog.query.plan import Counters
from hybridlog_storage.distinct import distinct

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog_storage.catalog import ChunkEntry
    from hybridlog_storage.segment_reader import SegmentReader


def count_in_chunks(
    chunks: Sequence[ChunkEntry],
    channels: Collection[int],
    windows: NDArray[np.int64],
    reader_of: Callable[[int], SegmentReader],
    counters: Counters,
) -> int:
    """Number of messages of some channels of a recording within some ranges.

    Args:
        chunks: All that may hold such messages.
        channels: Ids of the channels.
        windows: int64[n, 2], `[begin, end)` of log time, ns, apart and in order.
        reader_of: Gives the reader of a segment, by its number.
        counters: Gets the bytes that are read.

    Raises:
        SegmentError: a segment cannot be read, or is damaged where it is needed.
    """
    held = [
        (number, channel, stats.first, stats.last, stats.messages)
        for number, chunk in enumerate(chunks)
        for channel, stats in chunk.stats.items()
        if channel in channels and stats.first is not None
    ]
    if not held or not len(windows):
        return 0
    number, channel, first, last, messages = np.array(held, np.int64).T
    # Of the windows only the first that ends after a chunk has begun can hold all of it.
    window = np.searchsorted(windows[:, 1], first, "right")
    begin, end = np.append(windows, [[np.iinfo(np.int64).max] * 2], axis=0)[window].T
    touched = begin <= last
    whole = touched & (begin <= first) & (last < end)
    total = int(messages[whole].sum())
    cut = np.flatnonzero(touched & ~whole)
    for row in distinct(number[cut]).tolist():
        chunk = chunks[row]
        reader = reader_of(chunk.segment)
        read_before = reader.bytes_read
        times = reader.read_times(chunk.place)
        counters.bytes_read += reader.bytes_read - read_before
        for of in channel[cut[number[cut] == row]].tolist():
            before = np.searchsorted(times[of], windows)
            total += int((before[:, 1] - before[:, 0]).sum())
    return total
