"""Sorts the messages of a log by log time, with a bounded lookahead."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from hybridlog_storage.disk.copying import joined

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog_storage.messages import Batch

_WINDOW: Final = 32 << 20
"""Maximum payload bytes of the lookahead, except for a single larger message."""
_WINDOW_ROWS: Final = 1 << 17


@dataclass(frozen=True, slots=True)
class Rows:
    """Messages with payloads in several buffers.

    Attributes:
        buffers: The buffers.
        which: int64[n], number of each payload's buffer.
        table: The messages, with an empty buffer; offsets refer to the payload's own buffer.
    """

    buffers: list[bytes | memoryview]
    which: NDArray[np.int64]
    table: Batch

    def __len__(self) -> int:
        """Number of messages."""
        return len(self.which)

    def take(self, rows: NDArray[np.intp] | slice) -> Rows:
        """The chosen messages, over the same buffers."""
        return Rows(self.buffers, self.which[rows], self.table.take(rows))

    def payloads(self) -> Iterator[bytes]:
        """The payloads, in order."""
        table, buffers = self.table, self.buffers
        columns = (self.which, table.offset, table.offset + table.length)
        for which, start, end in zip(*(column.tolist() for column in columns), strict=True):
            # No copy for a whole bytes object, else a copy.
            yield bytes(buffers[which][start:end])

    def compact(self) -> Rows:
        """The same messages without unused buffers."""
        used, which = np.unique(self.which, return_inverse=True)
        buffers = [self.buffers[number] for number in used.tolist()]
        if sum(map(len, buffers)) <= _WINDOW + 2 * self.table.payload_bytes:
            return Rows(buffers, which.astype(np.int64), self.table)
        # A few messages keep large buffers alive.
        table = replace(self.table, offset=np.cumsum(self.table.length) - self.table.length)
        return Rows([b"".join(self.payloads())], np.zeros(len(self), np.int64), table)


class Lookahead:
    """Takes batches in file order, and returns messages in time order.

    A message that lies so late in the file that newer ones are out already is the first of
    the next result.
    """

    def __init__(self) -> None:
        self._waiting: list[Rows] = []
        self._bytes = 0
        self._rows = 0

    def add(self, batch: Batch) -> Rows | None:
        """Take a batch; return the oldest messages, if the lookahead is full."""
        buffer = batch.buffer if isinstance(batch.buffer, bytes) else memoryview(batch.buffer)
        table = replace(batch, buffer=b"")
        self._waiting.append(Rows([buffer], np.zeros(len(batch), np.int64), table))
        self._bytes += batch.payload_bytes
        self._rows += len(batch)
        if self._bytes <= _WINDOW and self._rows <= _WINDOW_ROWS:
            return None
        rows = self._sorted()
        ends = np.cumsum(rows.table.length)
        cut = int(np.searchsorted(ends, self._bytes - _WINDOW // 2, side="right"))
        cut = max(cut, self._rows - _WINDOW_ROWS // 2, 1)
        rest = rows.take(slice(cut, None))
        self._waiting = [rest.compact()] if len(rest) else []
        self._rows = len(rest)
        self._bytes = rest.table.payload_bytes
        return rows.take(slice(0, cut))

    def rest(self) -> Rows | None:
        """All remaining messages, or None."""
        rows = self._sorted() if self._rows else None
        self._waiting, self._bytes, self._rows = [], 0, 0
        return rows

    def _sorted(self) -> Rows:
        rows = _join(self._waiting)
        times = rows.table.log_time
        if (times[1:] < times[:-1]).any():
            return rows.take(np.argsort(times, kind="stable"))
        return rows


def _join(parts: Sequence[Rows]) -> Rows:
    """Concatenate tables without copying payloads."""
    starts = np.cumsum([0, *(len(part.buffers) for part in parts[:-1])])
    return Rows(
        [buffer for part in parts for buffer in part.buffers],
        np.concatenate([part.which + start for part, start in zip(parts, starts, strict=True)]),
        joined([part.table for part in parts]),
    )
