"""Large buffers that are used again, so that the system need not clear new memory each time.

Memory that was just given by the system costs a page fault every four kilobytes, which
took four times as long as filling it. A buffer goes back to its pool by itself, when the
last array or memoryview over it is gone.
"""

from __future__ import annotations

import mmap
import threading
import weakref
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

_LEAST = 1 << 18  # smaller buffers are malloc's business
_SPARE_BYTES = 96 << 20
_PRIVATE = getattr(mmap, "MAP_PRIVATE", 0) | getattr(mmap, "MAP_ANONYMOUS", 0)
_HUGE = getattr(mmap, "MADV_HUGEPAGE", None)


class Buffers:
    """A pool of buffers. Thread safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._spare: dict[int, list[mmap.mmap]] = {}
        self._spare_bytes = 0

    def take(self, size: int, *, whole_pages: bool = False) -> NDArray[np.uint8]:
        """A buffer of at least `size` bytes, whatever they are.

        Args:
            size: Bytes.
            whole_pages: Whether it must begin at a page of memory; large ones always do.
        """
        if size < _LEAST:
            if not whole_pages:
                return np.empty(size, np.uint8)
            size = _LEAST
        size = 1 << (size - 1).bit_length()
        with self._lock:
            spare = self._spare.get(size)
            memory = spare.pop() if spare else None
            if memory is not None:
                self._spare_bytes -= size
        if memory is None:
            memory = _new(size)
        # What is over this array keeps this array, and so the memory, from being taken again.
        array = np.frombuffer(memory, np.uint8)
        weakref.finalize(array, self._give, memory).atexit = False
        return array

    def prepare(self, size: int, total: int) -> None:
        """Have spare buffers at hand, whose memory the system has given already.

        Args:
            size: Bytes of each, as they will be taken.
            total: Bytes of all, about.
        """
        # Held until all are there, or the same one would be taken again and again.
        held = [self.take(size) for _ in range(total // max(size, _LEAST))]
        for buffer in held:
            buffer[:: mmap.PAGESIZE] = 0

    def _give(self, memory: mmap.mmap) -> None:
        with self._lock:
            if self._spare_bytes + len(memory) <= _SPARE_BYTES:
                self._spare.setdefault(len(memory), []).append(memory)
                self._spare_bytes += len(memory)


def _new(size: int) -> mmap.mmap:
    memory = mmap.mmap(-1, size, flags=_PRIVATE)
    if _HUGE is not None:
        memory.madvise(_HUGE)
    return memory


buffers = Buffers()
"""The pool of this process."""
