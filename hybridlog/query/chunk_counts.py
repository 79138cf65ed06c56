"""Counts of messages between times from chunk tables, without reading a payload.

A chunk table has the number, the first and the last log time of each channel's messages in
each chunk. Where these lie between two neighbouring times, they are counted without reading
anything. For other chunks the message indexes are read, 16 bytes a message.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hybridlog_storage.times import placed

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog_storage.segments.chunk_table import ChunkTable

    Times = Callable[[int, int], Mapping[int, NDArray[np.int64]]]
    """Log times of a chunk's messages by channel, ascending, by segment and number of the chunk."""


class Parts(NamedTuple):
    """The messages of one channel in one chunk, a row each.

    Attributes:
        segment: int64[n], number of the segment.
        chunk: int64[n], number of the chunk in it.
        channel: int64[n], id.
        messages: int64[n].
        first: int64[n], least log time, ns.
        last: int64[n], greatest log time, ns.
        topic: intp[n], place of its topic among those asked for.
    """

    segment: NDArray[np.int64]
    chunk: NDArray[np.int64]
    channel: NDArray[np.int64]
    messages: NDArray[np.int64]
    first: NDArray[np.int64]
    last: NDArray[np.int64]
    topic: NDArray[np.intp]

    @classmethod
    def of(cls, rows: NDArray[np.int64], topic: NDArray[np.intp] | None = None) -> Parts:
        """Rows of `part_rows`; all of topic 0 unless it is given."""
        topic = np.zeros(len(rows), np.intp) if topic is None else topic
        return cls(*np.ascontiguousarray(rows.T), topic)  # type: ignore[call-arg]

    def take(self, rows: NDArray[np.intp] | NDArray[np.bool_]) -> Parts:
        """Some rows."""
        return Parts(*(column[rows] for column in self))

    @property
    def chunk_starts(self) -> NDArray[np.intp]:
        """intp[c], the first row of each chunk, where rows of a chunk follow one another."""
        is_next = (np.diff(self.segment) != 0) | (np.diff(self.chunk) != 0)
        return np.flatnonzero(np.concatenate([[True], is_next])[: len(self.chunk)])


def part_rows(segment: int, table: ChunkTable) -> NDArray[np.int64]:
    """The parts of a segment's chunks: int64[n, 6], the columns of `Parts` without topics.

    Args:
        segment: Its number.
        table: Its chunks.
    """
    counts = table.chunks["parts"]
    chunk = np.repeat(np.arange(len(counts)), counts)
    names = ("channel", "messages", "first", "last")
    columns = [table.parts[name].astype(np.int64) for name in names]
    return np.stack([np.full_like(chunk, segment), chunk, *columns], axis=1)


class Placed(NamedTuple):
    """Parts, and where their first and last messages lie between some times.

    Attributes:
        parts: n parts.
        low: intp[n], -1 before the first time.
        high: intp[n].
    """

    parts: Parts
    low: NDArray[np.intp]
    high: NDArray[np.intp]

    @classmethod
    def of(cls, parts: Parts, edges: NDArray[np.int64]) -> Placed:
        """Parts between times, ns, ascending."""
        low, high = (
            np.searchsorted(edges, placed(t), "right") - 1 for t in (parts.first, parts.last)
        )
        return cls(parts, low, high)

    @property
    def is_whole(self) -> NDArray[np.bool_]:
        """bool[n], whether all messages of a part are between the same two times."""
        found: NDArray[np.bool_] = self.low == self.high
        return found

    def take(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> Placed:
        """Some rows."""
        return Placed(self.parts.take(rows), self.low[rows], self.high[rows])

    def add_known(self, counts: NDArray[np.int64]) -> Placed:
        """Count the messages of which the table tells the place.

        Args:
            counts: int64[topics, p], messages between neighbouring times.

        Returns:
            The parts whose messages must be read.
        """
        pixels = counts.shape[1]
        inside = self.is_whole & (self.low >= 0) & (self.low < pixels)
        np.add.at(counts, (self.parts.topic[inside], self.low[inside]), self.parts.messages[inside])
        # Of two messages both times are known.
        is_pair = ~self.is_whole & (self.parts.messages == 2)
        for place in (self.low, self.high):
            inside = is_pair & (place >= 0) & (place < pixels)
            np.add.at(counts, (self.parts.topic[inside], place[inside]), 1)
        return self.take(~self.is_whole & ~is_pair)

    def add_read(
        self, edges: NDArray[np.int64], counts: NDArray[np.int64], times_of: Times
    ) -> Placed:
        """Count messages by their times.

        Args:
            edges: int64[p + 1], the times, ns.
            counts: int64[topics, p].
            times_of: Reads the times of a chunk, once.

        Returns:
            The parts of which it gives no times.
        """
        pixels = counts.shape[1]
        parts = self.parts
        columns = (parts.segment, parts.chunk, parts.channel, parts.topic, self.low, self.high)
        is_unread = np.zeros(len(parts.chunk), np.bool_)
        chunk: tuple[int, int] | None = None
        times: Mapping[int, NDArray[np.int64]] = {}
        for row, (segment, number, channel, topic, low, high) in enumerate(
            zip(*(column.tolist() for column in columns), strict=True)
        ):
            if chunk != (segment, number):
                chunk, times = (segment, number), times_of(segment, number)
            found = times.get(channel)
            if found is None:
                is_unread[row] = True
                continue
            bounds = np.searchsorted(placed(found), edges[low + 1 : high + 1])
            steps = np.append(bounds, len(found))
            steps[1:] -= bounds
            begin, end = max(low, 0), min(high + 1, pixels)
            counts[topic, begin:end] += steps[begin - low : end - low]
        return self.take(is_unread)
