"""Matches in memory, so that a picture of them at any zoom reads nothing."""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable, Iterator
from typing import TYPE_CHECKING

import numpy as np

from hybridlog.drawing.matches import Matches, QueriedMatches, Rows
from hybridlog.query.answers.interval_queries import IntervalQueries
from hybridlog.query.answers.match_times import match_times
from hybridlog_storage.stopping import held
from hybridlog_storage.times import END

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.query import Query
    from hybridlog_storage.cache import Cache


class CachedMatches:
    """All matches of a question; see `Matches`.

    Args:
        times: int64[n], log times, ns since the epoch, in order.
        seqs: int64[n], arrival numbers.
        held: int64[k, 2], the intervals in which the predicate holds, in order.
    """

    def __init__(
        self, times: NDArray[np.int64], seqs: NDArray[np.int64], held: NDArray[np.int64]
    ) -> None:
        self._times = times
        self._seqs = seqs
        self._held = held

    @classmethod
    def of(cls, query: Query, max_bytes: int) -> CachedMatches | None:
        """The matches of a query; None if they take more bytes: 16 each, 16 an interval."""
        times, seqs = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
        held = [np.empty((0, 2), np.int64)]
        size = 0
        for found in match_times(query.session, query.question, query.counters):
            size += found.log_time.nbytes + found.seq.nbytes
            if size > max_bytes:
                return None
            times.append(found.log_time)
            seqs.append(found.seq)
        for _, rows in IntervalQueries(query.session, query.question, query.counters).held(None):
            held.append(rows[:, :2].copy())
            size += held[-1].nbytes
            if size > max_bytes:
                return None
        return cls(np.concatenate(times), np.concatenate(seqs), np.concatenate(held))

    @property
    def size(self) -> int:
        """Its memory, bytes."""
        return self._times.nbytes + self._seqs.nbytes + self._held.nbytes

    def rows(self, begin: int | None, end: int | None) -> Iterator[Rows]:
        """See `Matches`."""
        low = 0 if begin is None else int(np.searchsorted(self._times, begin))
        high = len(self._times) if end is None else self.count_until(end)
        yield self._times[low:high], self._seqs[low:high]

    def held(self, begin: int, end: int) -> Iterator[NDArray[np.int64]]:
        """See `Matches`."""
        low = int(np.searchsorted(self._held[:, 1], begin, "right"))
        high = int(np.searchsorted(self._held[:, 0], end))
        yield np.clip(self._held[low:high], begin, end)

    def count_until(self, end: int) -> int:
        """See `Matches`."""
        return len(self._times) if end == END else int(np.searchsorted(self._times, end))


class MatchCache:
    """Keeps the matches of questions in a cache. Thread safe.

    Args:
        cache: The cache; the matches of one question take half of it at most.
    """

    def __init__(self, cache: Cache) -> None:
        self._cache = cache
        self._asking = threading.Lock()

    def matches(self, key: Hashable, ask: Callable[[], Query]) -> Matches:
        """The matches of a question.

        Args:
            key: The question, and all that its answer depends on.
            ask: Makes the query, which has no time range.
        """
        found: tuple[CachedMatches | None] | None = self._cache.get("matches", key)
        if found is None:
            # A second client that asks the same waits, which takes no longer than to ask itself.
            with held(self._asking):
                found = self._cache.made(
                    "matches",
                    key,
                    make=lambda: (CachedMatches.of(ask(), self._cache.max_bytes // 2),),
                    size_of=lambda made: made[0].size if made[0] is not None else 0,
                )
        (cached,) = found
        return QueriedMatches(ask()) if cached is None else cached
