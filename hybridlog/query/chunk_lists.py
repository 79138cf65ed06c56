"""Chunk entries of recordings that are asked about again and again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from hybridlog_storage.catalog import ChunkEntry

_MOST = 20_000  # entries that are kept of one recording, about 1 kB each


class ChunkLists:
    """Answers which chunks may hold some channels in a time range, without the database.

    The first question about channels of a recording goes to the database, which finds a
    few chunks among any number. Whoever asks again will ask more: then all chunks of
    these channels are fetched, if they are not too many, and kept. Recordings that are
    asked for here do not change.
    """

    def __init__(self) -> None:
        self._lists: dict[tuple[str, frozenset[int]], _ChunkList | None] = {}
        self._asked: set[tuple[str, frozenset[int]]] = set()

    def find(
        self,
        recording: str,
        channels: Sequence[int],
        bounds: tuple[int, int],
        fetch: Callable[[tuple[int, int] | None], list[ChunkEntry]],
    ) -> list[ChunkEntry]:
        """Chunks that may hold messages of some channels in a time range.

        Args:
            recording: Its id.
            channels: Channel ids.
            bounds: Log time `[begin, end)`, ns.
            fetch: Asks the database for the chunks of these channels in a time range,
                or in all times.
        """
        key = recording, frozenset(channels)
        if key not in self._lists:
            if key not in self._asked:
                self._asked.add(key)
                return fetch(bounds)
            everything = fetch(None)
            self._lists[key] = _ChunkList(everything, key[1]) if len(everything) <= _MOST else None
        kept = self._lists[key]
        return fetch(bounds) if kept is None else kept.between(*bounds)

    def clear(self) -> None:
        """Forget everything."""
        self._lists.clear()
        self._asked.clear()


class _ChunkList:
    """Chunks by the time at which they begin."""

    def __init__(self, chunks: Sequence[ChunkEntry], channels: frozenset[int]) -> None:
        held, firsts, lasts = [], [], []
        for row, chunk in enumerate(chunks):
            stats = [s for c, s in chunk.stats.items() if c in channels]
            begins = [s.first for s in stats if s.first is not None]
            ends = [s.last for s in stats if s.last is not None]
            if begins and ends:
                held.append(row)
                firsts.append(min(begins))
                lasts.append(max(ends))
        first, last = np.array(firsts, np.int64), np.array(lasts, np.int64)
        order = np.argsort(first, kind="stable")
        self._chunks = [chunks[held[row]] for row in order.tolist()]
        self._first, self._last = first[order], last[order]
        self._longest = int((last - first).max()) if held else 0

    def between(self, begin: int, end: int) -> list[ChunkEntry]:
        low = int(np.searchsorted(self._first, begin - self._longest))
        high = int(np.searchsorted(self._first, end))
        rows = np.flatnonzero(self._last[low:high] >= begin) + low
        return [self._chunks[row] for row in rows.tolist()]
