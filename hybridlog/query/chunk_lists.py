"""Chunk entries of recordings that are queried repeatedly."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from hybridlog_storage.times import earlier, placed

if TYPE_CHECKING:
    from hybridlog_storage.catalog import ChunkEntry

    Fetch = Callable[[tuple[int, int] | None], list[ChunkEntry]]
    """Asks the database for the chunks of some channels in a time range, or in all times."""

_MOST = 20_000  # entries cached for one recording, about 1 kB each


class ChunkLists:
    """Finds the chunks that may hold some channels in a time range, without the database.

    The first question about some channels of a recording goes to the database, which finds
    a few chunks among any number. The second question fetches all chunks of these channels,
    unless they are too many, and caches them. The recordings queried here must not
    change.
    """

    def __init__(self) -> None:
        self._lists: dict[tuple[str, frozenset[int]], _ChunkList | None] = {}
        self._asked: set[tuple[str, frozenset[int]]] = set()

    def find(
        self,
        recording: str,
        channels: Sequence[int],
        bounds: tuple[int, int],
        fetch: Fetch,
    ) -> list[ChunkEntry]:
        """Chunks that may hold messages of some channels in a time range.

        Args:
            recording: Its id.
            channels: Channel ids.
            bounds: Log time `[begin, end)`, ns.
            fetch: Queries the database for the chunks of these channels in a time range,
                or in all times.
        """
        cached = self._cached(recording, frozenset(channels), fetch)
        return fetch(bounds) if cached is None else cached.between(*bounds)

    def before(
        self,
        recording: str,
        channels: Sequence[int],
        span: tuple[int, int],
        fetch: Fetch,
    ) -> Iterator[tuple[ChunkEntry, int]]:
        """Chunks that may hold the last message of some channels by a time, for `latest`.

        Args:
            recording: Its id.
            channels: Channel ids.
            span: Log time of the first message, and the latest time, ns.
            fetch: As for `find`.

        Yields:
            A chunk, and the greatest log time, ns, that it or any later chunk may hold.
        """
        held = frozenset(channels)
        cached = self._cached(recording, held, fetch)
        if cached is None:
            yield from latest_first(held, span, fetch)
        else:
            yield from cached.before(span[1])

    def _cached(
        self,
        recording: str,
        channels: frozenset[int],
        fetch: Fetch,
    ) -> _ChunkList | None:
        """The chunks of some channels; None for a first question, and when they are too many."""
        key = recording, channels
        if key in self._lists:
            return self._lists[key]
        if key not in self._asked:
            self._asked.add(key)
            return None
        everything = fetch(None)
        cached = _ChunkList(everything, channels) if len(everything) <= _MOST else None
        self._lists[key] = cached
        return cached

    def clear(self) -> None:
        """Forget all entries."""
        self._lists.clear()
        self._asked.clear()


def latest_first(
    channels: frozenset[int],
    span: tuple[int, int],
    fetch: Callable[[tuple[int, int]], list[ChunkEntry]],
) -> Iterator[tuple[ChunkEntry, int]]:
    """The chunks of `ChunkLists.before`, fetched from the database piece by piece.

    A long recording has many chunks before a time, and usually the last one holds the
    message.
    """
    start, latest = span
    seen: set[tuple[int, int]] = set()
    for begin in earlier(latest, start):
        part = _ChunkList(fetch((begin, latest + 1)), channels)
        for chunk, last in part.before(latest):
            place = chunk.segment, chunk.offset
            if place not in seen:
                seen.add(place)
                # Chunks that are not yet fetched end before this piece begins.
                yield chunk, max(last, begin - 1)


class _ChunkList:
    """Chunks ordered by the time at which they begin."""

    def __init__(self, chunks: Sequence[ChunkEntry], channels: frozenset[int]) -> None:
        held = [(chunk, span) for chunk in chunks if (span := chunk.span(channels)) is not None]
        held.sort(key=lambda item: item[1][0])
        self._chunks = [chunk for chunk, _ in held]
        spans = np.array([span for _, span in held], np.int64).reshape(-1, 2)
        first, self._last = placed(spans[:, 0]), spans[:, 1].copy()
        self._longest = int((self._last - first).max()) if held else 0
        # Lists, since single numbers are looked up: numpy takes ten times as long.
        self._first: list[int] = first.tolist()
        self._last_by: list[int] = np.maximum.accumulate(self._last).tolist()

    def between(self, begin: int, end: int) -> list[ChunkEntry]:
        low = bisect_left(self._first, begin - self._longest)
        high = bisect_left(self._first, end)
        rows = np.flatnonzero(self._last[low:high] >= begin) + low
        return [self._chunks[row] for row in rows.tolist()]

    def before(self, latest: int) -> Iterator[tuple[ChunkEntry, int]]:
        place = bisect_right(self._first, latest)
        while place > 0:
            place -= 1
            yield self._chunks[place], self._last_by[place]
