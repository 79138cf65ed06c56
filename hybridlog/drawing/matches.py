"""The matches of a predicate over time: ticks and bands by pixel, and a few of them in order."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from hybridlog_storage.errors import TimeError, UsageError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.query import Query
    from hybridlog.query.question import Span

_BACK_NS: Final = 1_000_000_000
_FURTHER: Final = 64


@dataclass(frozen=True)
class Ticks:
    """The pixels with matches, in order.

    Attributes:
        width: Log time of a pixel, ns.
        pixels: int64[n], numbers of pixels from 0.
        counts: int64[n], number of matches in each.
        first: int64[n], log time of the first match in each, ns since the epoch.
    """

    width: int
    pixels: NDArray[np.int64]
    counts: NDArray[np.int64]
    first: NDArray[np.int64]


class Match(NamedTuple):
    """A message that satisfies the predicate; matches are ordered as these tuples are.

    Attributes:
        time: Log time, ns since the epoch.
        seq: Arrival number in the recording.
    """

    time: int
    seq: int


def ticks(query: Query, span: Span, pixels: int) -> Ticks:
    """The matches of a query by pixel.

    Args:
        query: About one recording, without a time range or with that of the picture.
        span: Log time `[begin, end)` of the picture, ns.
        pixels: Width of the picture.

    Raises:
        UsageError: the query has `limit` or `every`, or there is no pixel.
    """
    width = pixel_width(span, pixels)
    counts = np.zeros(pixels, np.int64)
    first = np.full(pixels, np.iinfo(np.int64).max)
    for found in _within(query, span):
        place, begins, count = np.unique(
            (found - span[0]) // width, return_index=True, return_counts=True
        )
        counts[place] += count
        first[place] = np.minimum(first[place], found[begins])
    used = np.flatnonzero(counts)
    return Ticks(width, used, counts[used], first[used])


def bands(query: Query, span: Span, pixels: int) -> NDArray[np.int64]:
    """The intervals in which the predicate of a query holds, joined where a picture cannot tell.

    Args:
        query: About one topic of one recording, as for `ticks`.
        span: Log time `[begin, end)` of the picture, ns.
        pixels: Width of the picture.

    Returns:
        int64[n, 2], begin and end, ns since the epoch, in order; at most one more than pixels.
        Those less than a pixel apart are one.

    Raises:
        UsageError: the query has several topics, `limit`, `every` or `reverse`, or there is no
            pixel.
    """
    width = pixel_width(span, pixels)
    bounded = _between(query, *span)
    found = np.empty((0, 2), np.int64)
    if bounded is None:
        return found
    for _, rows in bounded.held():
        found = np.concatenate([found, rows[:, :2]])
        if len(found):
            begins = np.concatenate([[True], found[1:, 0] - found[:-1, 1] >= width])
            ends = np.append(begins[1:], True)
            found = np.stack([found[begins, 0], found[ends, 1]], axis=1)
    return found


def pixel_width(span: Span, pixels: int) -> int:
    """Log time of a pixel, ns; the last pixels may lie behind the span.

    Raises:
        UsageError: the span is empty, or there is no pixel.
    """
    begin, end = span
    if pixels < 1 or end <= begin:
        raise UsageError("A picture is at least one pixel wide, and its end is after its begin.")
    return -(-(end - begin) // pixels)


def matches_after(query: Query, place: Match, count: int) -> list[Match]:
    """The first matches behind a place, in order.

    Args:
        query: About one topic of one recording, without a time range.
        place: A match, or a time with the arrival number -1; it is not among them.
        count: Greatest number.
    """
    bounded = _between(query, place.time, None)
    found: list[Match] = []
    for times, seqs in _rows(bounded):
        behind = (times > place.time) | ((times == place.time) & (seqs > place.seq))
        rows = np.flatnonzero(behind)[: count - len(found)]
        found += map(Match, times[rows].tolist(), seqs[rows].tolist())
        if len(found) == count:
            break
    return found


def matches_before(query: Query, place: Match, count: int) -> list[Match]:
    """The last matches in front of a place, in order; see `matches_after`."""
    found: list[Match] = []
    end = place.time + 1
    for begin in _earlier(place.time):
        earlier: deque[Match] = deque(maxlen=count - len(found))
        for times, seqs in _rows(_between(query, begin, end)):
            in_front = (times < place.time) | ((times == place.time) & (seqs < place.seq))
            rows = np.flatnonzero(in_front)[-count:]
            earlier.extend(map(Match, times[rows].tolist(), seqs[rows].tolist()))
        found = [*earlier, *found]
        if len(found) == count:
            break
        end = begin
    return found


def count_before(query: Query, place: Match) -> int:
    """Number of matches in front of a place; see `matches_after`."""
    earlier = _between(query, None, place.time)
    count = 0 if earlier is None else earlier.count()
    for _, seqs in _rows(_between(query, place.time, place.time + 1)):
        count += int(np.count_nonzero(seqs < place.seq))
    return count


def _rows(query: Query | None) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Log times and arrival numbers of the matches."""
    if query is not None:
        yield from ((found.log_time, found.seq) for found in query.match_times())


def _within(query: Query, span: Span) -> Iterator[NDArray[np.int64]]:
    """Log times of the matches in a span."""
    return (times for times, _ in _rows(_between(query, *span)))


def _between(query: Query, begin: int | None, end: int | None) -> Query | None:
    """The query within a span; None if the recording has no time in it."""
    low, high = max(begin or 0, 0), None if end is None else max(end, 0)
    bounded = query.between(low, high)
    try:
        bounded.check_range()
    except TimeError:
        return None
    return bounded


def _earlier(time: int) -> Iterator[int]:
    """Beginnings of spans before a time, each longer than the last; the last one is 0."""
    back = _BACK_NS
    while time - back > 0:
        yield time - back
        back *= _FURTHER
    yield 0
