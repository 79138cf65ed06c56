"""Memory for what will come, before it comes, and chunks that are as large as suits the rate."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable

from hybridlog_storage.buffers import buffers

_AT_HAND = 128 << 20  # bytes of buffers that are there before the first message, at most
_AHEAD_S = 0.75  # and afterwards as many as come in this time: disks stand still for so long
_PAUSE = 1.0  # times as long as it takes to get one: it holds up who records meanwhile
_RESERVE = 0.25  # of them, which are for what comes and not for what waits
_LOOKS = 16  # of which the highest rate counts: sources pause, and disks stand still
_STEADY = 1.25  # times as much: of a rate that rises more one cannot tell yet; less is no matter
_CHUNKS = 100  # a second: of more than that each chunk's price is too much, so they are larger
_LARGEST = 4  # times the usual chunk size, where they are
_SHARE = 32  # of the budget that one chunk may take


class Provision:
    """Looks how much comes, and provides for it.

    A disk may stand still; to get memory only then takes too long. And a chunk has its
    price, whatever is in it: when so much comes that it would be paid hundreds of times a
    second, chunks are two or four times as large.

    Args:
        chunk_size: Usual bytes of a chunk.
        budget_bytes: Of the recording; half of it is at hand at most.
    """

    def __init__(self, chunk_size: int, budget_bytes: int) -> None:
        self.chunk_size = chunk_size
        """Bytes at which chunks should close that are opened now; memory for them is there."""
        self._usual = chunk_size
        self._most = max(chunk_size, min(_LARGEST * chunk_size, budget_bytes // _SHARE))
        self._budget = budget_bytes
        self._first = self._at_hand = min(_AT_HAND, budget_bytes // 8)
        self._rates: deque[float] = deque([0.0], maxlen=_LOOKS)
        self._given_up: int | None = None  # bytes of chunks that were usual until now
        self._thread: threading.Thread | None = None
        self._ended = threading.Event()
        buffers.prepare(chunk_size, self._at_hand)

    def look(self, rate: float) -> None:
        """Begin to provide for what comes, once it does not rise any more.

        What was begun for an earlier rate comes to its end before. Whoever looks again has
        heard what `chunk_size` is now.

        Args:
            rate: Bytes that came in a second, since the last look.
        """
        before = max(self._rates)
        self._rates.append(rate)
        if self._thread is not None and self._thread.is_alive():
            return
        if self._given_up is not None:
            # Since the look before none of them is taken any more.
            self._start(self._release, self._given_up)
            self._given_up = None
            return
        highest = max(self._rates)
        need = int(min(highest * _AHEAD_S, self._budget / 2))
        size = self._size_for(highest)
        at_hand = self._at_hand if size == self.chunk_size else 0
        if need > at_hand * _STEADY and rate <= before * _STEADY:
            self._start(self._provide, size, max(need, self._first))

    def is_short(self) -> bool:
        """Whether so little memory is left that none should be held without need."""
        sizes = {self.chunk_size, self._given_up or self.chunk_size}
        return any(buffers.is_short(size, _RESERVE) for size in sizes)

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

    def _start(self, work: Callable[..., None], *arguments: int) -> None:
        self._thread = threading.Thread(
            target=work, args=arguments, name="hybridlog-memory", daemon=True
        )
        self._thread.start()

    def _provide(self, size: int, total: int) -> None:
        try:
            buffers.prepare(size, total, pause=_PAUSE, enough=self._ended)
        except (MemoryError, OSError):
            # There is no more. It must do as it is, and whoever records goes on.
            self._most = self.chunk_size
            if size != self.chunk_size:
                self._release(size)
                return
        self._at_hand = total
        if size != self.chunk_size:
            self._given_up = self.chunk_size
            self.chunk_size = size

    def _release(self, size: int) -> None:
        buffers.release(size, keep=self.chunk_size, pause=_PAUSE, enough=self._ended)
