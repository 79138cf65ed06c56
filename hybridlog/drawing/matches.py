"""The matches of a predicate over time: ticks and bands by pixel, and a few of them in order.

They come from `Matches`: read for each picture, or kept in memory (`match_cache`).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from hybridlog.query.answers.interval_queries import IntervalQueries
from hybridlog.query.answers.match_times import match_times
from hybridlog.query.ranges import RangeResolver
from hybridlog_storage.errors import TimeError, UsageError
from hybridlog_storage.times import earlier, placed, span_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.query import Query
    from hybridlog.query.question import Span


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


Rows = tuple["NDArray[np.int64]", "NDArray[np.int64]"]
"""Log times, ns since the epoch, and arrival numbers of some messages, in order of both."""


class Matches(Protocol):
    """The messages of one topic of one recording that satisfy a predicate."""

    def rows(self, begin: int | None, end: int | None) -> Iterator[Rows]:
        """Those with `begin <= time < end`, ns since the epoch, some at a time, in order."""

    def held(self, begin: int, end: int) -> Iterator[NDArray[np.int64]]:
        """The intervals in which the predicate holds, cut to a span: int64[n, 2], in order."""

    def count_until(self, end: int) -> int:
        """The number of those before a time, ns since the epoch."""


class QueriedMatches:
    """The matches of a query, which is asked anew each time.

    Args:
        query: About one topic of one recording, without a time range, `limit` and `every`.
    """

    def __init__(self, query: Query) -> None:
        self._query = query

    def rows(self, begin: int | None, end: int | None) -> Iterator[Rows]:
        """See `Matches`."""
        query = self._between(begin, end)
        if query is not None:
            yield from (
                (found.log_time, found.seq)
                for found in match_times(query.session, query.question, query.counters)
            )

    def held(self, begin: int, end: int) -> Iterator[NDArray[np.int64]]:
        """See `Matches`."""
        query = self._between(begin, end)
        if query is not None:
            queries = IntervalQueries(query.session, query.question, query.counters)
            yield from (rows[:, :2] for _, rows in queries.held(None))

    def count_until(self, end: int) -> int:
        """See `Matches`."""
        query = self._between(None, end)
        return 0 if query is None else query.count()

    def _between(self, begin: int | None, end: int | None) -> Query | None:
        """The query within a span; None if the recording has no time in it."""
        low, high = max(begin or 0, 0), None if end is None else max(end, 0)
        bounded = self._query.between(low, high)
        try:
            RangeResolver(bounded.session, bounded.question).resolve()
        except TimeError:
            return None
        return bounded


class Match(NamedTuple):
    """A message that satisfies the predicate; matches are ordered as these tuples are.

    Attributes:
        time: Log time, ns since the epoch.
        seq: Arrival number in the recording.
    """

    time: int
    seq: int


def ticks(matches: Matches, span: Span, pixels: int) -> Ticks:
    """Matches by pixel.

    Args:
        matches: The matches.
        span: Log time `[begin, end)` of the picture, ns.
        pixels: Width of the picture.

    Raises:
        UsageError: the span is empty, or there is no pixel.
    """
    width = pixel_width(span, pixels)
    counts = np.zeros(pixels, np.int64)
    first = np.full(pixels, np.iinfo(np.int64).max)
    for found, _ in matches.rows(*span):
        place, begins, count = np.unique(
            (placed(found) - span[0]) // width, return_index=True, return_counts=True
        )
        counts[place] += count
        first[place] = np.minimum(first[place], found[begins])
    used = np.flatnonzero(counts)
    return Ticks(width, used, counts[used], first[used])


def bands(matches: Matches, span: Span, pixels: int) -> NDArray[np.int64]:
    """The intervals in which a predicate holds, joined where a picture cannot tell.

    Args:
        matches: Its matches.
        span: Log time `[begin, end)` of the picture, ns.
        pixels: Width of the picture.

    Returns:
        int64[n, 2], begin and end, ns since the epoch, in order; at most one more than pixels.
        Those less than a pixel apart are one.

    Raises:
        UsageError: the span is empty, or there is no pixel.
    """
    width = pixel_width(span, pixels)
    found = np.empty((0, 2), np.int64)
    for rows in matches.held(*span):
        found = np.concatenate([found, rows])
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


def matches_after(matches: Matches, place: Match, count: int) -> list[Match]:
    """The first matches behind a place, in order.

    Args:
        matches: The matches.
        place: A match, or a time with the arrival number -1; it is not among them.
        count: Greatest number.
    """
    found: list[Match] = []
    for times, seqs in matches.rows(place.time, None):
        behind = (times > place.time) | ((times == place.time) & (seqs > place.seq))
        rows = np.flatnonzero(behind)[: count - len(found)]
        found += map(Match, times[rows].tolist(), seqs[rows].tolist())
        if len(found) == count:
            break
    return found


def matches_before(matches: Matches, place: Match, count: int) -> list[Match]:
    """The last matches in front of a place, in order; see `matches_after`."""
    found: list[Match] = []
    end = span_of(place.time, place.time)[1]
    for begin in earlier(place.time):
        last: deque[Match] = deque(maxlen=count - len(found))
        for times, seqs in matches.rows(begin, end):
            in_front = (times < place.time) | ((times == place.time) & (seqs < place.seq))
            rows = np.flatnonzero(in_front)[-count:]
            last.extend(map(Match, times[rows].tolist(), seqs[rows].tolist()))
        found = [*last, *found]
        if len(found) == count:
            break
        end = begin
    return found


def count_before(matches: Matches, place: Match) -> int:
    """Number of matches in front of a place; see `matches_after`."""
    low, high = span_of(place.time, place.time)
    count = matches.count_until(low)
    for times, seqs in matches.rows(low, high):
        in_front = (times < place.time) | ((times == place.time) & (seqs < place.seq))
        count += int(np.count_nonzero(in_front))
    return count
