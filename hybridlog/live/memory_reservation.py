"""Reserves memory ahead of incoming messages and sizes chunks to the incoming rate."""

from __future__ import annotations

import threading
from collections import deque
from contextlib import suppress

from hybridlog_storage.buffers import SLAB, buffers

_INITIAL_BYTES = 128 << 20  # buffers reserved before the first message, at most
_AHEAD_S = 0.75  # later: as much as comes in this time, since disks stall for so long
_BUFFER_PAUSE_RATIO = 1.0  # pause between two buffers, relative to the time of one
_SHARE_FOR_SMALL = 0.25  # of the reserved buffers, which large chunks do not use
_RATES = 16  # the highest of so many rates counts: sources pause, and disks stall
_STEADY = 1.25  # a rate that grows by more is still rising
_MAX_CHUNKS_PER_S = 100  # above it chunks grow, because each one has a fixed cost
_MAX_GROWTH = 4  # of the chunk size
_SHARE = 32  # one chunk may take this part of the budget


class MemoryReservation:
    """Watches the incoming rate, reserves memory and chooses the chunk size.

    Memory that is requested only when the disk stalls comes too late. At hundreds of
    chunks a second their fixed cost dominates, so chunks become two or four times as
    large. Reserved memory serves new messages first, then large chunks.

    Args:
        chunk_size: Usual bytes of a chunk.
        budget_bytes: Of the recording; at most half of it is reserved.

    Attributes:
        chunk_size: Bytes at which chunks should close; see `next_chunk_size`.
    """

    def __init__(self, chunk_size: int, budget_bytes: int) -> None:
        self.chunk_size = chunk_size
        self._usual = chunk_size
        self._max = max(chunk_size, min(_MAX_GROWTH * chunk_size, budget_bytes // _SHARE, SLAB))
        self._budget = budget_bytes
        self._reserved = min(_INITIAL_BYTES, budget_bytes // 8)
        self._rates: deque[float] = deque([0.0], maxlen=_RATES)
        self._thread: threading.Thread | None = None
        self._ended = threading.Event()
        buffers.prepare(chunk_size, self._reserved)

    def observe(self, rate: float) -> None:
        """Take a new incoming rate; once it stops rising, reserve memory for it.

        A reservation for an earlier rate is completed first.

        Args:
            rate: Bytes a second since the last call.
        """
        before = max(self._rates)
        self._rates.append(rate)
        if rate > before * _STEADY:
            return
        highest = max(self._rates)
        self.chunk_size = self._size_for(highest)
        need = int(min(highest * _AHEAD_S, self._budget / 2))
        is_busy = self._thread is not None and self._thread.is_alive()
        if need > self._reserved * _STEADY and not is_busy:
            self._reserved = need
            self._thread = threading.Thread(
                target=self._reserve, args=(need,), name="hybridlog-memory", daemon=True
            )
            self._thread.start()

    def next_chunk_size(self) -> int:
        """Bytes at which a chunk that is opened now should close.

        Large only if memory is available: opening a chunk never waits for memory.
        """
        is_short = self.chunk_size > self._usual and buffers.is_short(
            self.chunk_size, _SHARE_FOR_SMALL
        )
        return self._usual if is_short else self.chunk_size

    def close(self) -> None:
        """End a running reservation, and return surplus memory."""
        self._ended.set()
        if self._thread is not None:
            self._thread.join()
        buffers.settle()

    def _size_for(self, rate: float) -> int:
        """The chunk size for a rate; it shrinks only when it is far too large."""
        size = self._usual
        while size * _MAX_CHUNKS_PER_S < rate and 2 * size <= self._max:
            size *= 2
        now = self.chunk_size
        return now if size < now and rate * 4 > now * _MAX_CHUNKS_PER_S else size

    def _reserve(self, total: int) -> None:
        # Without more memory recording goes on with what is reserved.
        with suppress(MemoryError, OSError):
            buffers.prepare(self._usual, total, pause=_BUFFER_PAUSE_RATIO, enough=self._ended)
