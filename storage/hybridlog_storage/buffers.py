"""A pool of large buffers, reused to avoid page faults on new memory.

New memory costs a page fault every four kilobytes, which takes four times as long as
filling it. A buffer returns to its pool when the last array or memoryview over it is gone.
"""

from __future__ import annotations

import mmap
import weakref
from collections import deque
from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

_LEAST = 1 << 18  # smaller buffers come from malloc
_MAX_IDLE_BYTES = 64 << 20
_FILLED = 8 << 20  # bytes of a new buffer; larger content is copied by a thread that can wait
_PRIVATE = getattr(mmap, "MAP_PRIVATE", 0) | getattr(mmap, "MAP_ANONYMOUS", 0)
_HUGE = getattr(mmap, "MADV_HUGEPAGE", None)


class Buffers:
    """A pool of buffers, whose sizes are powers of two. Thread safe."""

    def __init__(self) -> None:
        # Each operation on it is atomic: the garbage collector may return a buffer at any
        # point, on a thread that is taking one.
        self._idle: deque[mmap.mmap] = deque()

    def take(self, size: int) -> NDArray[np.uint8]:
        """Take a buffer of at least `size` bytes with arbitrary content."""
        if size < _LEAST:
            return np.empty(size, np.uint8)
        size = 1 << (size - 1).bit_length()
        memory = self._find(size)
        if memory is None:
            memory = new_memory(size)
            # Other threads run meanwhile, unlike while a message is copied there.
            np.frombuffer(memory, np.uint8, min(size, _FILLED)).fill(0)
        # Views of this array keep it alive, and so keep its memory from being reused.
        array = np.frombuffer(memory, np.uint8)
        weakref.finalize(array, self._give, memory).atexit = False
        return array

    def _find(self, size: int) -> mmap.mmap | None:
        """Take the idle buffer of a size that was used last."""
        for memory in reversed(self._idle.copy()):
            if len(memory) == size:
                with suppress(ValueError, IndexError):  # another thread has taken it
                    self._idle.remove(memory)
                    return memory
        return None

    def _give(self, memory: mmap.mmap) -> None:
        """Keep a buffer for the next one; those that were not used for longest go."""
        if len(memory) <= _MAX_IDLE_BYTES:
            self._idle.append(memory)
        with suppress(IndexError):
            while sum(map(len, self._idle.copy())) > _MAX_IDLE_BYTES:
                self._idle.popleft()


def new_memory(size: int) -> mmap.mmap:
    """Private memory in huge pages, allocated when it is first written."""
    memory = mmap.mmap(-1, size, flags=_PRIVATE)
    if _HUGE is not None:
        memory.madvise(_HUGE)
    return memory


buffers = Buffers()
"""The pool of this process."""
