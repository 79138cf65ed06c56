"""Messages over time, by pixel, from sorted log times: counts, gaps, matches.

The times of a topic are read once, and kept in the cache while there is room. No payload is read.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from msgspec import Struct

from hybridlog.query.answers.interval_queries import IntervalQueries
from hybridlog.query.intervals import GAP_PERIODS, usual_period
from hybridlog.query.planner import match_times
from hybridlog.query.question import Question, Span
from hybridlog_storage.errors import ResourceError, SegmentError, TopicError
from hybridlog_storage.times import BEGIN, END, placed

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.query import Query
    from hybridlog.session import Session
    from hybridlog_storage.catalog import RecordingEntry


MAX_TIMES: Final = 20_000_000
"""Most messages of a topic whose times `lane_of` reads, unless its caller says otherwise."""
_SAMPLED: Final = 100_000  # steps that tell the usual one
_LATEST: Final = np.iinfo(np.int64).max


class Lane(Struct, frozen=True, eq=False):
    """Log times, ns, of a topic's messages in a recording, sorted; estimates if not `exact`."""

    times: NDArray[np.int64]
    exact: bool

    def counts(self, edges: NDArray[np.int64]) -> NDArray[np.int64]:
        """int64[p], messages with `edges[i] <= time < edges[i + 1]` of int64[p + 1], ns."""
        return np.diff(np.searchsorted(self.times, edges))

    def period(self) -> float:
        """Usual time from one message to the next, ns; 0 where it is unknown."""
        rows = np.arange(0, len(self.times) - 1, 1 + len(self.times) // _SAMPLED)
        return usual_period(self.times[rows + 1] - self.times[rows])

    def gaps(self, edges: NDArray[np.int64], whole: Span, period: float) -> NDArray[np.intp]:
        """Runs of pixels without messages longer than usual: the first one, and one past the last.

        A gap that a picture shows is one of the recording, but for how exact its ends are; one that
        is shorter than two pixels may not be shown. The edges of pixels, the whole recording and
        the usual period are in ns; a period of 0 is unknown.
        """
        is_outside = (edges[1:] <= whole[0]) | (edges[:-1] >= whole[1])
        is_empty = np.concatenate([[False], (self.counts(edges) == 0) & ~is_outside, [False]])
        runs = np.flatnonzero(is_empty[1:] != is_empty[:-1]).reshape(-1, 2)
        begin, end = np.clip(edges, *whole)[runs].T
        found: NDArray[np.intp] = runs[(end - begin > GAP_PERIODS * period) & (period > 0)]
        return found


def aligned(span: tuple[int, int], pixels: int) -> NDArray[np.int64]:
    """Edges of bins of a power of two of nanoseconds from the epoch: a moved picture has the same.

    They cover the span: more than half as many as pixels, unless a bin is one nanosecond, and one
    more than pixels at most.
    """
    level = max(-(-(span[1] - span[0]) // pixels) - 1, 0).bit_length()
    numbers = range(span[0] >> level, -(-span[1] >> level) + 1)
    return np.array([min(number << level, _LATEST) for number in numbers], np.int64)


def lane_of(
    session: Session, recording: RecordingEntry, topic: str, max_times: int = MAX_TIMES
) -> Lane:
    """The messages of a topic, by its full name.

    At most so many times are read; of more, those of a chunk are spread evenly.
    """
    if topic not in (known := recording.messages_by_topic()):
        raise TopicError(f"{recording.name} has no topic {topic!r}.")
    messages = known[topic]
    is_read = messages <= max_times

    def read() -> Lane:
        if is_read:
            question = Question((topic,), (recording.id,))
            with suppress(SegmentError):
                found = match_times(session, question)
                return Lane(_sorted(one.log_time for one in found), exact=True)
        ids = [channel.id for channel in recording.channels if channel.topic == topic]
        parts = session.parts(recording, ids, (BEGIN, END))
        rows = zip(parts["first"], parts["last"], parts["messages"], strict=True)
        return Lane(_sorted(np.linspace(*row).astype(np.int64) for row in rows), exact=False)

    tails = ((n, one.table.chunks[-1:].tobytes()) for n, one in recording.flushed.items())
    state = recording.status, messages, frozenset((*recording.digests.items(), *tails))
    key = recording.id, topic, state, is_read
    return session.cache.made("times", *key, make=read, size_of=lambda one: one.times.nbytes)


def _sorted(parts: Iterable[NDArray[np.int64]]) -> NDArray[np.int64]:
    return placed(np.sort(np.concatenate([np.empty(0, np.int64), *parts]), kind="stable"))


MAX_MATCHES: Final = 20_000_000
"""Matches, and intervals, of one question."""


class Match(NamedTuple):
    """A message that satisfies the predicate: log time, ns since the epoch, and arrival number.

    Matches are ordered as these tuples are.
    """

    time: int
    seq: int


class Episode(NamedTuple):
    """Matches of one interval in which the predicate holds: the first, its end, their number."""

    first: Match
    end: int
    n: int


class Matches:
    """The messages of one topic of one recording that satisfy a predicate, in memory.

    A picture of them at any zoom reads nothing. The query has no time range, `limit` and `every`;
    more than `MAX_MATCHES` are refused.

    Attributes:
        episodes: Number of episodes. A match beside others of its time, which end it, is one.
        size: Memory, bytes.
    """

    def __init__(self, query: Query) -> None:
        found = []
        none, count = np.empty(0, np.int64), 0
        for one in match_times(query.source.now(), query.question, query.counters):
            found.append(one)
            count += len(one.seq)
            if count > MAX_MATCHES:
                raise ResourceError(
                    f"More than {MAX_MATCHES // 10**6} million messages match, too many for a "
                    "picture: write a narrower predicate."
                )
        self._times = np.concatenate([none, *(one.log_time for one in found)])
        self._seqs = np.concatenate([none, *(one.seq for one in found)])
        queries = IntervalQueries(query.source.now(), query.question, query.counters)
        held = [rows[:, :2].copy() for _, rows in queries.held(None)]
        self._held = np.concatenate([np.empty((0, 2), np.int64), *held])
        own = np.searchsorted(self._held[:, 0], placed(self._times), "right") - 1
        ends = np.append(self._held[:, 1], 0)[own]
        is_alone = placed(self._times) >= ends
        is_first = np.append(True, own[1:] != own[:-1])[: len(own)] | is_alone
        is_first[1:] |= is_alone[:-1]
        self._firsts = np.flatnonzero(is_first)
        self._ends = np.maximum(ends, self._times)[self._firsts]
        self.episodes = len(self._firsts)
        arrays = (self._times, self._seqs, self._held, self._firsts, self._ends)
        self.size = sum(one.nbytes for one in arrays)

    def ticks(self, edges: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Log time of the first match, ns, and number of matches, of each pixel that has any.

        The edges of the pixels are those of `aligned`.
        """
        begins = np.searchsorted(placed(self._times), edges)
        counts = np.diff(begins)
        return self._times[begins[:-1][counts > 0]], counts[counts > 0]

    def bands(self, span: Span, width: int) -> NDArray[np.int64]:
        """The intervals in which the predicate holds, joined where a picture cannot tell.

        They are int64[n, 2], begin and end, ns since the epoch, in order. Those less than the log
        time of a pixel apart are one.
        """
        low = int(np.searchsorted(self._held[:, 1], span[0], "right"))
        high = int(np.searchsorted(self._held[:, 0], span[1]))
        found: NDArray[np.int64] = np.clip(self._held[low:high], *span)
        if not len(found):
            return found
        begins = np.concatenate([[True], found[1:, 0] - found[:-1, 1] >= width])
        return np.stack([found[begins, 0], found[np.append(begins[1:], True), 1]], axis=1)

    def beside(self, place: Match, count: int, *, earlier: bool) -> list[Episode]:
        """The first episodes behind a place, or the last ones in front of it, in order.

        The place is the first match of one, which is not among them, or a time with the arrival
        number -1.
        """
        begin = self.count_before(place if earlier else Match(place.time, place.seq + 1))
        last = begin if earlier else begin + count
        rows = slice(max(begin - count, 0) if earlier else begin, last)
        firsts = self._firsts[rows]
        numbers = np.diff(np.append(self._firsts, len(self._times)))[rows]
        matches = map(Match, self._times[firsts].tolist(), self._seqs[firsts].tolist())
        return [*map(Episode, matches, self._ends[rows].tolist(), numbers.tolist())]

    def count_before(self, place: Match) -> int:
        """Number of episodes that begin in front of a place; see `beside`."""
        times, seqs = self._times[self._firsts], self._seqs[self._firsts]
        low, high = np.searchsorted(times, place.time), np.searchsorted(times, place.time, "right")
        return int(low + np.searchsorted(seqs[low:high], place.seq))
