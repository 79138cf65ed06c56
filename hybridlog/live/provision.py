"""Memory for what will come, before it comes, and chunks that are as large as suits the rate."""

from __future__ import annotations

import threading
from collections import deque
from contextlib import suppress

from hybridlog_storage.buffers import SLAB, buffers

_AT_HAND = 128 << 20  # bytes of buffers that are there before the first message, at most
_AHEAD_S = 0.75  # and afterwards as many as come in this time: disks stand still for so long
_PAUSE = 1.0  # times as long as it takes to get one: it holds up who records meanwhile
_FOR_SMALL = 0.25  # of them, which large chunks leave to the others
_FOR_CHUNKS = 0.5  # and which what waits leaves to all of these
_WAITING = 8  # that part of the budget may wait for the index
_LOOKS = 16  # of which the highest rate counts: sources pause, and disks stand still
_STEADY = 1.25  # times as much: of a rate that rises more one cannot tell yet; less is no matter
_CHUNKS = 100  # a second: of more than that each chunk's price is too much, so they are larger
_LARGEST = 4  # times the usual chunk size, where they are
_SHARE = 32  # of the budget that one chunk may take


class Provision:
    """Looks how much comes, and provides for it.

    A disk may stand still; to get memory only then takes too long. And a chunk has its
    price, whatever is in it: when so much comes that it would be paid hundreds of times a
    second, chunks are two or four times as large. Of what is at hand, messages come before
    large chunks, and these before whatever waits.

    Args:
        chunk_size: Usual bytes of a chunk.
        budget_bytes: Of the recording; half of it is at hand at most.
    """

    def __init__(self, chunk_size: int, budget_bytes: int) -> None:
        self.chunk_size = chunk_size
        """Bytes at which chunks should close; see `next_chunk_size`."""
        self._usual = chunk_size
        self._most = max(chunk_size, min(_LARGEST * chunk_size, budget_bytes // _SHARE, SLAB))
        self._budget = budget_bytes
        self._at_hand = min(_AT_HAND, budget_bytes // 8)
        self._rates: deque[float] = deque([0.0], maxlen=_LOOKS)
        self._thread: threading.Thread | None = None
        self._ended = threading.Event()
        buffers.prepare(chunk_size, self._at_hand)

    def look(self, rate: float) -> None:
        """Begin to provide for what comes, once it does not rise any more.

        What was begun for an earlier rate comes to its end before.

        Args:
            rate: Bytes that came in a second, since the last look.
        """
        before = max(self._rates)
        self._rates.append(rate)
        if rate > before * _STEADY:
            return
        highest = max(self._rates)
        self.chunk_size = self._size_for(highest)
        need = int(min(highest * _AHEAD_S, self._budget / 2))
        is_busy = self._thread is not None and self._thread.is_alive()
        if need > self._at_hand * _STEADY and not is_busy:
            self._at_hand = need
            self._thread = threading.Thread(
                target=self._provide, args=(need,), name="hybridlog-memory", daemon=True
            )
            self._thread.start()

    def next_chunk_size(self) -> int:
        """Bytes at which a chunk should close that is opened now.

        A large one where there is memory for it: who begins a chunk does not wait for any.
        """
        is_dear = self.chunk_size > self._usual and buffers.is_short(self.chunk_size, _FOR_SMALL)
        return self._usual if is_dear else self.chunk_size

    def has_room(self, size: int) -> bool:
        """Whether so many bytes of chunks may wait in memory until they are indexed."""
        is_much = size > self._budget // _WAITING
        return not (is_much or buffers.is_short(self.chunk_size, _FOR_CHUNKS))

    def close(self) -> None:
        """End what is being done, and give back what is too much."""
        self._ended.set()
        if self._thread is not None:
            self._thread.join()
        buffers.settle()

    def _size_for(self, rate: float) -> int:
        """The size of chunks; one that is too large is kept until it is far too large."""
        size = self._usual
        while size * _CHUNKS < rate and 2 * size <= self._most:
            size *= 2
        now = self.chunk_size
        return now if size < now and rate * 4 > now * _CHUNKS else size

    def _provide(self, total: int) -> None:
        # Where there is no more it must do as it is, and whoever records goes on.
        with suppress(MemoryError, OSError):
            buffers.prepare(self._usual, total, pause=_PAUSE, enough=self._ended)
