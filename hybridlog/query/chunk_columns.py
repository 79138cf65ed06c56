"""The chunks of a segment that hold some channels, as columns from its chunk table."""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hybridlog_storage.cache import lazy
from hybridlog_storage.messages import run_starts
from hybridlog_storage.segments.chunk_table import ChunkPlace, ChunkTable, place_of
from hybridlog_storage.times import BEGIN, END, placed

if TYPE_CHECKING:
    from numpy.typing import NDArray


class Chunk(NamedTuple):
    """A chunk to read for some channels: number of their messages, first and last log time, ns."""

    segment: int
    place: ChunkPlace
    first: int
    last: int
    messages: int

    @property
    def number(self) -> int:
        """Its number in the segment."""
        return self.place.number


PARTS = [(name, "i8") for name in ("segment", "chunk", "channel", "messages", "first", "last")]


class ChunkColumns:
    """Chunks of a segment with messages of some channels, or all, in the order of the file.

    Attributes:
        parts: The messages of a channel in a chunk, a row each: number of the `segment` and of
            the `chunk`, id of the `channel`, number of `messages`, log time, ns, of the `first`
            and the `last` one.
        number: int64[n], numbers of the chunks.
        first: int64[n], least log time of the channels, ns.
        last: int64[n], greatest log time, ns.
        nbytes: Bytes in memory, about.
    """

    def __init__(
        self, segment: int, table: ChunkTable, channels: Collection[int] | None = None
    ) -> None:
        self._segment = segment
        self._table = table
        ids = table.parts["channel"]
        self._rows = np.flatnonzero(np.isin(ids, ids if channels is None else [*channels]))
        self.parts: NDArray[np.void] = np.empty(len(self._rows), np.dtype(PARTS))
        self.parts["segment"] = segment
        numbers = np.repeat(np.arange(len(table.chunks)), table.chunks["parts"])
        self.parts["chunk"] = numbers[self._rows]
        for name in ("channel", "messages", "first", "last"):
            self.parts[name] = table.parts[name][self._rows]
        self.nbytes = 2 * self.parts.nbytes + table.parts.nbytes
        self._starts = run_starts(self.parts["chunk"])
        self.number: NDArray[np.int64] = self.parts["chunk"][self._starts]
        self.first = placed(np.minimum.reduceat(self.parts["first"], self._starts))
        self.last = np.maximum.reduceat(self.parts["last"], self._starts)
        self._messages = np.add.reduceat(self.parts["messages"], self._starts)

    def chunks(self, rows: NDArray[np.bool_]) -> list[Chunk]:
        """Some of the chunks."""
        return [self._chunk(row) for row in np.flatnonzero(rows).tolist()]

    def _chunk(self, row: int) -> Chunk:
        place = place_of(self._table, int(self.number[row]), self._bounds)
        return Chunk(
            self._segment,
            place,
            int(self.first[row]),
            int(self.last[row]),
            int(self._messages[row]),
        )

    @lazy
    def _bounds(self) -> NDArray[np.int64]:
        return self._table.part_bounds()

    def within(self, span: tuple[int, int] | None) -> NDArray[np.bool_]:
        """True for chunks that may have messages in `[begin, end)` of log time, ns; None: any."""
        begin, end = (BEGIN, END) if span is None else span
        found: NDArray[np.bool_] = (self.first < end) & (self.last >= begin)
        return found
