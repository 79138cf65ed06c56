"""The matches of a predicate over time: ticks and bands by pixel, and a few of them in order."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from hybridlog.query.answers.interval_queries import IntervalQueries
from hybridlog.query.answers.match_times import match_times
from hybridlog_storage.errors import ResourceError, UsageError
from hybridlog_storage.times import placed

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.answers.match_times import MatchTimes
    from hybridlog.query.query import Query
    from hybridlog.query.question import Span

MAX_MATCHES: Final = 20_000_000
"""Matches, and intervals, of one question."""


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


class Matches:
    """The messages of one topic of one recording that satisfy a predicate, in memory.

    A picture of them at any zoom reads nothing.

    Args:
        query: The question, without a time range, `limit` and `every`.

    Raises:
        ResourceError: There are more than `MAX_MATCHES`.
    """

    def __init__(self, query: Query) -> None:
        found = [*_bounded(match_times(query.session, query.question, query.counters))]
        self._times = np.concatenate([np.empty(0, np.int64), *(one.log_time for one in found)])
        self._seqs = np.concatenate([np.empty(0, np.int64), *(one.seq for one in found)])
        queries = IntervalQueries(query.session, query.question, query.counters)
        held = [rows[:, :2].copy() for _, rows in queries.held(None)]
        self._held = np.concatenate([np.empty((0, 2), np.int64), *held])

    @property
    def size(self) -> int:
        """Its memory, bytes."""
        return self._times.nbytes + self._seqs.nbytes + self._held.nbytes

    def ticks(self, span: Span, pixels: int) -> Ticks:
        """Matches by pixel.

        Args:
            span: Log time `[begin, end)` of the picture, ns.
            pixels: Width of the picture.

        Raises:
            UsageError: the span is empty, or there is no pixel.
        """
        width = _pixel_width(span, pixels)
        found = self._times[slice(*np.searchsorted(placed(self._times), span))]
        place, begins, counts = np.unique(
            (placed(found) - span[0]) // width, return_index=True, return_counts=True
        )
        return Ticks(width, place, counts, found[begins])

    def bands(self, span: Span, pixels: int) -> NDArray[np.int64]:
        """The intervals in which the predicate holds, joined where a picture cannot tell.

        Args:
            span: Log time `[begin, end)` of the picture, ns.
            pixels: Width of the picture.

        Returns:
            int64[n, 2], begin and end, ns since the epoch, in order; at most one more than
            pixels. Those less than a pixel apart are one.

        Raises:
            UsageError: the span is empty, or there is no pixel.
        """
        width = _pixel_width(span, pixels)
        low = int(np.searchsorted(self._held[:, 1], span[0], "right"))
        high = int(np.searchsorted(self._held[:, 0], span[1]))
        found: NDArray[np.int64] = np.clip(self._held[low:high], *span)
        if not len(found):
            return found
        begins = np.concatenate([[True], found[1:, 0] - found[:-1, 1] >= width])
        return np.stack([found[begins, 0], found[np.append(begins[1:], True), 1]], axis=1)

    def after(self, place: Match, count: int) -> list[Match]:
        """The first matches behind a place, in order, at most `count`.

        Args:
            place: A match, or a time with the arrival number -1; it is not among them.
            count: Greatest number.
        """
        begin = self.count_before(Match(place.time, place.seq + 1))
        return self._rows(begin, begin + count)

    def before(self, place: Match, count: int) -> list[Match]:
        """The last matches in front of a place, in order; see `after`."""
        end = self.count_before(place)
        return self._rows(max(end - count, 0), end)

    def count_before(self, place: Match) -> int:
        """Number of matches in front of a place; see `after`."""
        low, high = (int(np.searchsorted(self._times, place.time, side)) for side in _SIDES)
        return low + int(np.searchsorted(self._seqs[low:high], place.seq))

    def _rows(self, begin: int, end: int) -> list[Match]:
        times, seqs = self._times[begin:end].tolist(), self._seqs[begin:end].tolist()
        return [*map(Match, times, seqs)]


_SIDES: Final = ("left", "right")


def _bounded(found: Iterable[MatchTimes]) -> Iterator[MatchTimes]:
    count = 0
    for one in found:
        count += len(one.seq)
        if count > MAX_MATCHES:
            raise ResourceError(
                f"More than {MAX_MATCHES // 10**6} million messages match, too many for a picture: "
                "write a narrower predicate."
            )
        yield one


def _pixel_width(span: Span, pixels: int) -> int:
    """Log time of a pixel, ns; the last pixels may lie behind the span."""
    begin, end = span
    if pixels < 1 or end <= begin:
        raise UsageError("A picture is at least one pixel wide, and its end is after its begin.")
    return -(-(end - begin) // pixels)
