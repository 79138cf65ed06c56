"""Large buffers that are used again, so that the system need not clear new memory each time.

Memory that was just given by the system costs a page fault every four kilobytes, which
took four times as long as filling it. A buffer goes back to its pool by itself, when the
last array or memoryview over it is gone.
"""

from __future__ import annotations

import mmap
import threading
import time
import weakref
from collections import Counter
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

_LEAST = 1 << 18  # smaller buffers are malloc's business
_SPARE_BYTES = 96 << 20
_HUGE_PAGE = 2 << 20
_FILLED = 8 << 20  # bytes of a new buffer; what is beyond is laid down by who can wait for it
_PRIVATE = getattr(mmap, "MAP_PRIVATE", 0) | getattr(mmap, "MAP_ANONYMOUS", 0)
_HUGE = getattr(mmap, "MADV_HUGEPAGE", None)


class Buffers:
    """A pool of buffers. Thread safe."""

    def __init__(self) -> None:
        # The collector may give a buffer back on a thread that is in here already.
        self._lock = threading.RLock()
        self._spare: dict[int, list[mmap.mmap]] = {}
        self._spare_bytes = 0
        self._most_spare = _SPARE_BYTES
        self._there: Counter[int] = Counter()  # buffers that are spare or taken, by their size

    def take(self, size: int, *, whole_pages: bool = False) -> NDArray[np.uint8]:
        """A buffer of at least `size` bytes, whatever they are.

        Args:
            size: Bytes.
            whole_pages: Whether it must begin at a page of memory; large ones always do.
        """
        if size < _LEAST and not whole_pages:
            return np.empty(size, np.uint8)
        size = _rounded(size)
        with self._lock:
            spare = self._spare.get(size)
            memory = spare.pop() if spare else None
            if memory is not None:
                self._spare_bytes -= size
        if memory is None:
            memory = self._make(size)
            # Other threads go on meanwhile, as they could not when messages are laid there.
            for part in _huge_pages(memory, _FILLED):
                part.fill(0)
        # What is over this array keeps this array, and so the memory, from being taken again.
        array = np.frombuffer(memory, np.uint8)
        weakref.finalize(array, self._give, memory).atexit = False
        return array

    def is_short(self, size: int, share: float) -> bool:
        """Whether of the buffers of a size that are there less than a share is spare."""
        size = _rounded(size)
        with self._lock:
            return len(self._spare.get(size, ())) < share * self._there[size]

    def prepare(
        self,
        size: int,
        total: int,
        *,
        pause: float = 0.0,
        enough: threading.Event | None = None,
    ) -> None:
        """Have buffers, spare or taken, whose memory the system has given already.

        As many bytes may then be spare until `settle`.

        Args:
            size: Bytes of each, as they will be taken.
            total: Bytes of all, about.
            pause: For how many times as long as each took to leave the system alone after it.
            enough: Ends it early.
        """
        enough = enough or threading.Event()
        size = _rounded(size)
        with self._lock:
            missing = max(total // size - self._there[size], 0)
            self._most_spare = max(self._most_spare, total, self._spare_bytes + missing * size)
        for _ in range(missing):
            since = time.monotonic()
            memory = self._make(size)
            for part in _huge_pages(memory):
                part.fill(0)
                if enough.wait(pause * (time.monotonic() - since)):
                    break
                since = time.monotonic()
            self._give(memory)
            if enough.is_set():
                return

    def release(
        self,
        size: int,
        *,
        keep: int,
        pause: float = 0.0,
        enough: threading.Event | None = None,
    ) -> None:
        """Give back to the system the spare buffers of a size.

        Args:
            size: Bytes.
            keep: Bytes of buffers that are not given back, should they be the same ones.
            pause: For how many times as long as each took to leave the system alone after it.
            enough: Ends it early.
        """
        enough = enough or threading.Event()
        size = _rounded(size)
        if size == _rounded(keep):
            return
        since = time.monotonic()
        while self._drop_one(size) and not enough.wait(pause * (time.monotonic() - since)):
            since = time.monotonic()

    def _drop_one(self, size: int) -> bool:
        """Give a spare buffer of a size back to the system, if there is one."""
        with self._lock:
            spare = self._spare.get(size)
            if not spare:
                return False
            memory = spare.pop()
            self._spare_bytes -= size
            self._there[size] -= 1
            self._most_spare = max(self._most_spare - size, _SPARE_BYTES)
        # Not under the lock, where it can be helped: it takes as long as to get one.
        del memory
        return True

    def settle(self) -> None:
        """Give back to the system what is more than usually spare."""
        with self._lock:
            self._most_spare = _SPARE_BYTES
            for size in list(self._spare):
                while self._spare_bytes > self._most_spare and self._drop_one(size):
                    pass

    def _make(self, size: int) -> mmap.mmap:
        memory = _new(size)
        with self._lock:
            self._there[size] += 1
        return memory

    def _give(self, memory: mmap.mmap) -> None:
        size = len(memory)
        with self._lock:
            if self._spare_bytes + size <= self._most_spare:
                self._spare.setdefault(size, []).append(memory)
                self._spare_bytes += size
            else:
                self._there[size] -= 1


def _huge_pages(memory: mmap.mmap, most: int | None = None) -> Iterator[NDArray[np.uint8]]:
    """The first bytes of a buffer, or all, in pieces of which each costs one page fault."""
    array = np.frombuffer(memory, np.uint8)[:most]
    return (array[start : start + _HUGE_PAGE] for start in range(0, len(array), _HUGE_PAGE))


def _rounded(size: int) -> int:
    return 1 << (max(size, _LEAST) - 1).bit_length()


def _new(size: int) -> mmap.mmap:
    memory = mmap.mmap(-1, size, flags=_PRIVATE)
    if _HUGE is not None:
        memory.madvise(_HUGE)
    return memory


buffers = Buffers()
"""The pool of this process."""
