"""Counts messages in ranges of log time from the chunk index.

The entry of a chunk has the number of messages of each channel, and their first and last
time. A chunk inside a range is counted without reading it. For a chunk that crosses an end,
the message indexes are read from the segment: 16 bytes a message, and no payload. The
entry holds their checksum.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from hybridlog.query.engines.base import Need, Outcomes, Values
from hybridlog_storage.distinct import distinct
from hybridlog_storage.times import END, inside, placed

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.chunk_scan import ChunkTask, RowSelection
    from hybridlog.query.counters import Counters
    from hybridlog.query.question import Part
    from hybridlog.session import Session
    from hybridlog_storage.catalog import ChunkEntry
    from hybridlog_storage.segment_reader import SegmentReader

_ENTRY_S = 2e-5  # seconds to fetch the entry of a chunk
_READ_S = 1e-4  # seconds to read the message indexes of a chunk
_TIME_S = 2e-7  # seconds to sort the log time of a message


class ChunkIndex:
    """Answers questions about log time alone, without a predicate.

    Args:
        session: The open store.
        counters: Count the bytes that are read.
    """

    def __init__(self, session: Session, counters: Counters) -> None:
        self._session = session
        self._counters = counters

    def cost(self, part: Part, need: Need, fields: Collection[str] | None = ()) -> float | None:
        """For counts and times by log time; it grows with the number of chunks in the range."""
        if part.predicate is not None or not part.is_by_log_time:
            return None
        if need not in {Need.COUNT, Need.OUTCOMES}:
            return None
        if need is Need.OUTCOMES:
            return _READ_S * part.chunks + _TIME_S * part.messages * part.share
        return _ENTRY_S * part.chunks

    def count(self, parts: Sequence[Part]) -> int:
        """Number of messages in the windows of the parts.

        Raises:
            SegmentError: a segment cannot be read, or is damaged in a part that is needed.
        """
        return sum(map(self._count, parts))

    def outcomes(self, part: Part) -> Iterator[Outcomes]:
        """All log times in the windows, sorted; arrival numbers are unknown and 0.

        Raises:
            SegmentError: a segment cannot be read, or is damaged in a part that is needed.
        """
        windows = part.log_windows
        channels = [channel.channel_id for channel in part.channels]
        found = [np.empty(0, np.int64)]
        if len(windows):
            span = int(windows[0, 0]), int(windows[-1, 1])
            for chunk in self._session.chunks(part.recording, channels, span, "log"):
                reader = self._session.segment(part.recording.id, chunk.segment)
                read_before = reader.bytes_read
                times = reader.read_times(chunk.place)
                self._counters.bytes_read += reader.bytes_read - read_before
                found.extend(times[channel] for channel in channels if channel in times)
        time = np.sort(np.concatenate(found))
        time = time[inside(time, windows)]
        yield Outcomes(time, np.zeros(len(time), np.int64), np.ones(len(time), np.bool_))

    def values(self, part: Part, fields: Collection[str] | None) -> Iterator[Values]:
        """Not supported: `cost` returns None."""
        raise NotImplementedError

    def select(self, parts: Sequence[Part], tasks: Sequence[ChunkTask]) -> RowSelection:
        """Not supported: `cost` returns None."""
        raise NotImplementedError

    def _count(self, part: Part) -> int:
        windows = part.log_windows
        if not len(windows):
            return 0
        channels = [channel.channel_id for channel in part.channels]
        span = int(windows[0, 0]), int(windows[-1, 1])
        return count_in_chunks(
            self._session.chunks(part.recording, channels, span, "log"),
            set(channels),
            windows,
            partial(self._session.segment, part.recording.id),
            self._counters,
        )


def count_in_chunks(
    chunks: Sequence[ChunkEntry],
    channels: Collection[int],
    windows: NDArray[np.int64],
    reader_of: Callable[[int], SegmentReader],
    counters: Counters,
) -> int:
    """Number of messages of some channels of a recording within some ranges.

    Args:
        chunks: All chunks that may hold such messages.
        channels: Ids of the channels.
        windows: int64[n, 2], `[begin, end)` of log time, ns, apart and in order.
        reader_of: Returns the reader of a segment, by its number.
        counters: Count the bytes that are read.

    Raises:
        SegmentError: a segment cannot be read, or is damaged in a part that is needed.
    """
    held = [
        (number, channel, stats.first, stats.last, stats.messages)
        for number, chunk in enumerate(chunks)
        for channel in channels
        if (stats := chunk.stats.get(channel)) is not None and stats.first is not None
    ]
    if not held or not len(windows):
        return 0
    number, channel, first, last, messages = np.array(held, np.int64).T
    first, last = placed(first), placed(last)
    # Only the first window that ends after the start of a chunk can contain the whole chunk.
    window = np.searchsorted(windows[:, 1], first, "right")
    begin, end = np.append(windows, [[END, END]], axis=0)[window].T
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
            before = np.searchsorted(placed(times[of]), windows)
            total += int((before[:, 1] - before[:, 0]).sum())
    return total
