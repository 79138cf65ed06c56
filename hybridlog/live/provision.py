"""Memory for what will come, before it comes, and chunks that are as large as suits the rate."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

from hybridlog_storage.buffers import buffers

if TYPE_CHECKING:
    from hybridlog_storage.segment_writer import RecordingWriter

_AT_HAND = 128 << 20  # bytes of buffers that are there before the first message, at most
_AHEAD_S = 0.75  # and afterwards as many as come in this time: disks stand still for so long
_PAUSE = 1.0  # times as long as it takes to get one: it holds up who records meanwhile
_RESERVE = 0.25  # of them, which are for what comes and not for what waits
_STEADY = 1.25  # times the rate of the look before: of one that rises more one cannot tell
_CHUNKS = 100  # a second: of more than that each chunk's price is too much, so they are larger
_LARGEST = 4  # times the chunk size of the settings, where they are
_SHARE = 32  # of the budget that one chunk may take


class Provision:
    """Looks how much comes, and provides for it.

    A disk may stand still; to get memory only then takes too long. And a chunk has its
    price, whatever is in it: when so much comes that it would be paid hundreds of times a
    second, chunks are two or four times as large. Still none spans more time than usual.

    Args:
        writer: Its chunk size is set. It has been given no message yet.
        budget_bytes: Of the recording; half of it is at hand at most.
    """

    def __init__(self, writer: RecordingWriter, budget_bytes: int) -> None:
        self._writer = writer
        self._usual = writer.chunk_size
        self._budget = budget_bytes
        self._at_hand = min(_AT_HAND, budget_bytes // 8)
        self._rate = 0.0  # as last looked at
        self._thread: threading.Thread | None = None
        self._ended = threading.Event()
        buffers.prepare(self._usual, self._at_hand)

    def look(self, rate: float) -> None:
        """Begin to provide for a rate that does not rise any more.

        What was begun for an earlier one comes to its end before.

        Args:
            rate: Bytes that come in a second.
        """
        is_rising = rate > self._rate * _STEADY
        self._rate = rate
        if is_rising or (self._thread is not None and self._thread.is_alive()):
            return  # once it is known how much that will be
        need = int(min(rate * _AHEAD_S, self._budget / 2))
        size = self._size_for(rate)
        if need > self._at_hand or size != self._writer.chunk_size:
            self._at_hand = max(need, self._at_hand)
            self._thread = threading.Thread(
                target=self._provide, args=(size,), name="hybridlog-memory", daemon=True
            )
            self._thread.start()

    def is_short(self) -> bool:
        """Whether so little memory is left that none should be held without need."""
        return buffers.is_short(self._writer.chunk_size, _RESERVE)

    def close(self) -> None:
        """End what is being done, and give back what is too much."""
        self._ended.set()
        if self._thread is not None:
            self._thread.join()
        buffers.settle()

    def _size_for(self, rate: float) -> int:
        """The size of chunks; one that is too large is kept until it is far too large."""
        most = min(_LARGEST * self._usual, self._budget // _SHARE)
        size = self._usual
        while size * _CHUNKS < rate and 2 * size <= most:
            size *= 2
        now = self._writer.chunk_size
        return now if size < now and rate * 4 > now * _CHUNKS else size

    def _provide(self, size: int) -> None:
        buffers.prepare(size, self._at_hand, pause=_PAUSE, enough=self._ended)
        before, self._writer.chunk_size = self._writer.chunk_size, size
        if size != before:
            buffers.release(before)
