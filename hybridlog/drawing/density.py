"""Counts of messages by pixel, for timelines. No payload is read.

A chunk table has the number, the first and the last log time of each channel's messages in
each chunk. Where these lie in one pixel, they are counted without reading anything. For the
other chunks the message indexes are read, 16 bytes a message. If these are too many, the
messages of a chunk are spread evenly over its time, and the counts are marked as estimates.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from hybridlog.drawing.chunk_parts import RecordedChunks
from hybridlog_storage.errors import SegmentError
from hybridlog_storage.times import placed

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.drawing.chunk_parts import Parts
    from hybridlog.session import Session
    from hybridlog_storage.catalog import RecordingEntry

MOST_WORK: Final = 1 << 24
"""Messages whose times are read for one picture; a chunk counts as `_CHUNK_WORK` more."""
_CHUNK_WORK: Final = 1000


@dataclass(frozen=True, slots=True, eq=False)
class Density:
    """Messages of some topics by pixel.

    Attributes:
        topics: Full names, n.
        edges: int64[p + 1], ns; a pixel has the messages with `edges[i] <= time < edges[i + 1]`.
        counts: int64[n, p].
        exact: bool[n], False where counts are estimates.
    """

    topics: tuple[str, ...]
    edges: NDArray[np.int64]
    counts: NDArray[np.int64]
    exact: NDArray[np.bool_]


def density(
    session: Session,
    recording: RecordingEntry,
    span: tuple[int, int],
    pixels: int,
    topics: Sequence[str] | None = None,
    *,
    most_work: int = MOST_WORK,
) -> Density:
    """Counts of messages by pixel.

    Args:
        session: The open store.
        recording: The recording.
        span: Log time `[begin, end)`, ns.
        pixels: Number of parts of the span; their lengths differ by one nanosecond at most.
        topics: Full names; None for all topics of the recording.
        most_work: As for `count`.
    """
    chunks = RecordedChunks(session, recording)
    chosen = tuple(chunks.topics() if topics is None else topics)
    edges = _edges(span, pixels)
    counts, exact = count(chunks, chosen, edges, most_work=most_work)
    return Density(chosen, edges, counts, exact)


def _edges(span: tuple[int, int], pixels: int) -> NDArray[np.int64]:
    whole, rest = divmod(span[1] - span[0], pixels)
    numbers = np.arange(pixels + 1, dtype=np.int64)
    return np.int64(span[0]) + numbers * whole + numbers * rest // pixels


def count(
    chunks: RecordedChunks,
    topics: Sequence[str],
    edges: NDArray[np.int64],
    *,
    since: int = 0,
    most_work: int = MOST_WORK,
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Number of messages of some topics between neighbouring times.

    Args:
        chunks: The chunks of a recording.
        topics: Full names, n.
        edges: int64[p + 1], log times, ns, ascending.
        since: Leave out as many parts of `chunks`; see `RecordedChunks.size`.
        most_work: Estimate rather than read the times of more messages.

    Returns:
        int64[n, p]; and bool[n], False where counts are estimates.
    """
    pixels = len(edges) - 1
    counts = np.zeros((len(topics), pixels), np.int64)
    exact = np.ones(len(topics), np.bool_)
    placed = _Placed.of(chunks.parts((int(edges[0]), int(edges[-1])), topics, since), edges)
    whole = placed.take(placed.is_whole)
    np.add.at(counts, (whole.parts.topic, whole.low), whole.parts.messages)
    # Of two messages both times are known.
    pairs = placed.take(~placed.is_whole & (placed.parts.messages == 2))
    for place in (pairs.low, pairs.high):
        inside = (place >= 0) & (place < pixels)
        np.add.at(counts, (pairs.parts.topic[inside], place[inside]), 1)
    others = placed.take(placed.is_cut)
    if _work(others.parts) <= most_work:
        others = _add_read(chunks, others, edges, counts)
    if len(others.low):
        _add_estimated(others.parts, edges, counts)
        exact[others.parts.topic] = False
    return counts, exact


def reading_work(chunks: RecordedChunks, topics: Sequence[str], edges: NDArray[np.int64]) -> int:
    """Cost of `count`: the messages whose times it reads, and `_CHUNK_WORK` for each chunk."""
    placed = _Placed.of(chunks.parts((int(edges[0]), int(edges[-1])), topics), edges)
    return _work(placed.parts.take(placed.is_cut))


class _Placed(NamedTuple):
    """Parts, and the pixels of their first and last messages.

    Attributes:
        parts: n parts.
        low: intp[n], -1 before the first pixel.
        high: intp[n], the number of pixels behind the last one.
    """

    parts: Parts
    low: NDArray[np.intp]
    high: NDArray[np.intp]

    @classmethod
    def of(cls, parts: Parts, edges: NDArray[np.int64]) -> _Placed:
        """Parts in a picture."""
        low, high = (
            np.searchsorted(edges, placed(t), "right") - 1 for t in (parts.first, parts.last)
        )
        return cls(parts, low, high)

    @property
    def is_whole(self) -> NDArray[np.bool_]:
        """bool[n], whether all messages of a part are in one pixel."""
        found: NDArray[np.bool_] = self.low == self.high
        return found

    @property
    def is_cut(self) -> NDArray[np.bool_]:
        """bool[n], whether the pixels of a part's messages are unknown."""
        found: NDArray[np.bool_] = ~self.is_whole & (self.parts.messages > 2)
        return found

    def take(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> _Placed:
        """Some rows."""
        return _Placed(self.parts.take(rows), self.low[rows], self.high[rows])


def _work(parts: Parts) -> int:
    if not len(parts.chunk):
        return 0
    segment, chunk = parts.segment, parts.chunk
    is_next = (segment[1:] != segment[:-1]) | (chunk[1:] != chunk[:-1])
    return int(parts.messages.sum()) + _CHUNK_WORK * (1 + int(is_next.sum()))


def _add_read(
    chunks: RecordedChunks,
    placed: _Placed,
    edges: NDArray[np.int64],
    counts: NDArray[np.int64],
) -> _Placed:
    """Count messages by their times; returns those of chunks that cannot be read."""
    pixels = len(edges) - 1
    parts = placed.parts
    columns = (parts.segment, parts.chunk, parts.channel, parts.topic, placed.low, placed.high)
    is_unread = np.zeros(len(parts.chunk), np.bool_)
    chunk: tuple[int, int] | None = None
    times: dict[int, NDArray[np.int64]] = {}
    for row, (segment, number, channel, topic, low, high) in enumerate(
        zip(*(column.tolist() for column in columns), strict=True)
    ):
        if chunk != (segment, number):
            chunk, times = (segment, number), {}
            with suppress(SegmentError):
                times = chunks.times(segment, number)
        found = times.get(channel)
        if found is None:
            is_unread[row] = True
            continue
        bounds = np.searchsorted(found, edges[low + 1 : high + 1])
        steps = np.append(bounds, len(found))
        steps[1:] -= bounds
        begin, end = max(low, 0), min(high + 1, pixels)
        counts[topic, begin:end] += steps[begin - low : end - low]
    return placed.take(is_unread)


def _add_estimated(parts: Parts, edges: NDArray[np.int64], counts: NDArray[np.int64]) -> None:
    """Spread the messages of each part evenly over its time."""
    pixels = len(edges) - 1
    found = np.zeros((counts.shape[0], pixels))
    # Pixels of equal length, in which the parts begin and end.
    length = (int(edges[-1]) - int(edges[0])) / pixels
    begin, end = ((t - edges[0]) / length for t in (parts.first, placed(parts.last) + 1))
    rate = parts.messages / np.maximum(end - begin, 1e-9)
    begin, end = np.clip(begin, 0, pixels), np.clip(end, 0, pixels)
    low = np.minimum(begin.astype(np.intp), pixels - 1)
    high = np.minimum(end.astype(np.intp), pixels - 1)
    # Nothing but the first and the last pixel of a part is covered in part.
    is_one = low == high
    np.add.at(found, (parts.topic, low), rate * np.where(is_one, end - begin, low + 1 - begin))
    many = np.flatnonzero(~is_one)
    topic, low, high = parts.topic[many], low[many], high[many]
    np.add.at(found, (topic, high), rate[many] * (end[many] - high))
    slope = np.zeros_like(found)
    np.add.at(slope, (topic, low + 1), rate[many])
    np.add.at(slope, (topic, high), -rate[many])
    found += np.cumsum(slope, axis=1)
    # Rounded so that nothing is lost or added in all.
    whole = np.rint(np.cumsum(found, axis=1)).astype(np.int64)
    counts += np.maximum(np.diff(whole, axis=1, prepend=0), 0)
