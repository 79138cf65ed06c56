"""Counts of messages by pixel, for timelines, and gaps of topics. No payload is read.

They are counted as `chunk_counts` says. If too many message indexes would be read, the messages
of a chunk are spread evenly over its time, and the counts are marked as estimates.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from hybridlog.drawing.chunk_parts import RecordedChunks
from hybridlog.query.chunk_counts import Placed
from hybridlog.query.periods import GAP_PERIODS, usual_period
from hybridlog_storage.errors import SegmentError
from hybridlog_storage.times import placed

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.drawing.chunk_parts import RecordedChunks
    from hybridlog.query.chunk_counts import Parts
    from hybridlog.session import Session
    from hybridlog_storage.catalog import RecordingEntry


MAX_WORK: Final = 1 << 24
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
    most_work: int = MAX_WORK,
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
    most_work: int = MAX_WORK,
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
    parts = chunks.parts((int(edges[0]), int(edges[-1])), topics, since)
    others = Placed.of(parts, edges).add_known(counts)

    def times(segment: int, chunk: int) -> Mapping[int, NDArray[np.int64]]:
        with suppress(SegmentError):
            return chunks.times(segment, chunk)
        return {}

    if _work(others.parts) <= most_work:
        others = others.add_read(edges, counts, times)
    if len(others.low):
        _add_estimated(others.parts, edges, counts)
        exact[others.parts.topic] = False
    return counts, exact


def reading_work(chunks: RecordedChunks, topics: Sequence[str], edges: NDArray[np.int64]) -> int:
    """Cost of `count`: the messages whose times it reads, and `_CHUNK_WORK` for each chunk."""
    placed = Placed.of(chunks.parts((int(edges[0]), int(edges[-1])), topics), edges)
    return _work(placed.parts.take(~placed.is_whole & (placed.parts.messages > 2)))


def _work(parts: Parts) -> int:
    return int(parts.messages.sum()) + _CHUNK_WORK * len(parts.chunk_starts)


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


_SAMPLED: Final = 16  # chunks that are read for one topic


def sampled_period(chunks: RecordedChunks, parts: Parts) -> float:
    """The usual time from one message of a topic to the next, ns, in some of its chunks.

    Returns:
        0 if there is only one message, or none.
    """
    several = parts.take(parts.messages > 1)
    steps = [np.empty(0, np.int64)]
    if 2 * int(several.messages.sum()) >= int(parts.messages.sum()):
        last = len(several.first) - 1
        rows = np.unique(np.linspace(0, last, min(last + 1, _SAMPLED)).astype(np.intp))
        for segment, chunk, channel in zip(
            *(column[rows].tolist() for column in several[:3]), strict=True
        ):
            with suppress(SegmentError, KeyError):
                times = chunks.times(segment, chunk)[channel]
                steps.append(times[1:] - times[:-1])
    else:
        first = np.sort(parts.first)
        steps.append(first[1:] - first[:-1])
    return usual_period(np.concatenate(steps))


def gaps(counts: NDArray[np.int64], edges: NDArray[np.int64], period: float) -> NDArray[np.intp]:
    """Runs of pixels without messages that last longer than is usual.

    A gap that a picture shows is one of the recording, but for how exact its ends are; one
    that is shorter than two pixels may not be shown.

    Args:
        counts: int64[p], messages of a topic by pixel.
        edges: int64[p + 1], ns.
        period: The usual time from one message to the next, ns; 0 if unknown.

    Returns:
        intp[n, 2], first pixel and the one behind the last.
    """
    if period <= 0:
        return np.empty((0, 2), np.intp)
    is_empty = np.concatenate([[False], counts == 0, [False]])
    runs = np.flatnonzero(is_empty[1:] != is_empty[:-1]).reshape(-1, 2)
    is_long = edges[runs[:, 1]] - edges[runs[:, 0]] > GAP_PERIODS * period
    return runs[is_long]
