"""How many messages lie in ranges of log time, by what is known of chunks.

The entry of a chunk says how many messages of each channel it has, and from when to when.
A chunk that lies within a range is counted without a look at it. Of one that reaches over
an end, the message index is read from the segment: 16 bytes a message, and no payload. So
it is of every chunk when MongoDB is away, since segments know of a chunk only when it is.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import TYPE_CHECKING

import numpy as np

from hybridlog.query.plan import Counters
from hybridlog_storage.distinct import distinct

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog_storage.catalog import ChannelStats, ChunkEntry
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
    whole = touched & (begin <= first) & (last < end) & (messages > 0)
    total = int(messages[whole].sum())
    cut = np.flatnonzero(touched & ~whole)
    for row in distinct(number[cut]).tolist():
        chunk = chunks[row]
        wanted = {c: chunk.stats[c] for c in channel[cut[number[cut] == row]].tolist()}
        for times in _times(reader_of(chunk.segment), chunk, wanted, counters):
            before = np.searchsorted(times, windows)
            total += int((before[:, 1] - before[:, 0]).sum())
    return total


def _times(
    reader: SegmentReader,
    chunk: ChunkEntry,
    wanted: dict[int, ChannelStats],
    counters: Counters,
) -> list[NDArray[np.int64]]:
    """Log times of the messages of each of some channels in a chunk, ascending, ns."""
    place = chunk.place
    read_before = reader.bytes_read
    times = reader.read_times(place)
    found = [times.get(c, np.empty(0, np.int64)) for c in wanted]
    if not all(map(_is_that, found, wanted.values())):
        # An index has no checksum. What contradicts the entry is read from the messages.
        batch = reader.read_chunk(place).batch
        counters.chunks_read += 1
        found = [np.sort(batch.log_time[batch.channel == c]) for c in wanted]
    counters.bytes_read += reader.bytes_read - read_before
    return found


def _is_that(times: NDArray[np.int64], stats: ChannelStats) -> bool:
    """Whether times read from an index can be those that an entry was made from."""
    if not len(times) or (times[1:] < times[:-1]).any():
        return False
    span = int(times[0]), int(times[-1])
    if stats.messages:
        return len(times) == stats.messages and span == (stats.first, stats.last)
    # Only the chunk's times are known, which are those of all of its channels.
    return stats.first is not None and stats.first <= span[0] and span[1] <= (stats.last or 0)
