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
        if key in self._lists:
            kept = self._lists[key]
        elif key not in self._asked:
            self._asked.add(key)
            kept = None
        else:
            everything = fetch(None)
            kept = _ChunkList(everything, key[1]) if len(everything) <= _MOST else None
            self._lists[key] = kept
        return fetch(bounds) if kept is None else kept.between(*bounds)

    def clear(self) -> None:
        """Forget everything."""
        self._lists.clear()
        self._asked.clear()


class _ChunkList:
    """Chunks by the time at which they begin."""

    def __init__(self, chunks: Sequence[ChunkEntry], channels: frozenset[int]) -> None:
        held = [(chunk, span) for chunk in chunks if (span := chunk.span(channels)) is not None]
        held.sort(key=lambda item: item[1][0])
        self._chunks = [chunk for chunk, _ in held]
        spans = np.array([span for _, span in held], np.int64).reshape(-1, 2)
        self._first, self._last = np.ascontiguousarray(spans.T)
        self._longest = int((self._last - self._first).max()) if held else 0

    def between(self, begin: int, end: int) -> list[ChunkEntry]:
        low = int(np.searchsorted(self._first, begin - self._longest))
        high = int(np.searchsorted(self._first, end))
        rows = np.flatnonzero(self._last[low:high] >= begin) + low
        return [self._chunks[row] for row in rows.tolist()]
