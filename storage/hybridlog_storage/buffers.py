"""A pool of large buffers, reused to avoid page faults on new memory.

New memory costs a page fault every four kilobytes, which takes four times as long as
filling it. A buffer returns to its pool when the last array or memoryview over it is gone.
"""

from __future__ import annotations

import mmap
import threading
import time
import weakref
from collections import Counter, deque
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

SLAB = 8 << 20
"""Bytes allocated from the system at a time; buffers up to this size are cut from them."""

_LEAST = 1 << 18  # smaller buffers come from malloc
_MAX_IDLE_BYTES = 64 << 20
_HUGE_PAGE = 2 << 20
_FILLED = 8 << 20  # bytes of a new buffer; larger content is copied by a thread that can wait
_PRIVATE = getattr(mmap, "MAP_PRIVATE", 0) | getattr(mmap, "MAP_ANONYMOUS", 0)
_HUGE = getattr(mmap, "MADV_HUGEPAGE", None)


class Buffers:
    """A pool of buffers. Thread safe.

    Buffers are cut from slabs; all buffers of a slab have one size. A slab without taken
    buffers may serve another size, so larger buffers reuse the memory of smaller ones.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        # Returned buffers. The garbage collector may return one at any point, on a thread that
        # already holds the lock.
        self._returned: deque[tuple[_Slab, int]] = deque()
        self._whole: dict[int, list[_Slab]] = {}  # slabs without taken buffers, by slab size
        self._most_whole = _MAX_IDLE_BYTES
        # Slabs with both taken and free buffers, by buffer size.
        self._cut: dict[int, dict[_Slab, None]] = {}
        self._given: Counter[int] = Counter()  # bytes allocated from the system, by slab size,
        self._taken: Counter[int] = Counter()  # and the taken ones of these

    def take(self, size: int, *, whole_pages: bool = False) -> NDArray[np.uint8]:
        """Take a buffer of at least `size` bytes with arbitrary content.

        Args:
            size: Bytes.
            whole_pages: Whether it must begin at a memory page; large ones always do.
        """
        if size < _LEAST and not whole_pages:
            return np.empty(size, np.uint8)
        size = _rounded(size)
        with self._lock:
            self._sort_in()
            slab = self._find(size)
            if slab is not None:
                if not slab.cut:
                    self._unkeep(slab)
                start, missing = self._cut_off(slab, size)
        if slab is None:
            slab = _Slab(_slab_size(size))  # this may take long, so it runs without the lock
            with self._lock:
                start, missing = self._cut_off(slab, size)
        # Other threads run meanwhile, unlike while a message is copied there.
        for part in missing:
            part.fill(0)
        # Views of this array keep it alive, and so keep its memory from being reused.
        array = np.frombuffer(slab.memory, np.uint8, size, start)
        weakref.finalize(array, self._give, slab, start).atexit = False
        return array

    def is_short(self, size: int, share: float) -> bool:
        """True if a buffer needs new memory, or less than a share of the memory is spare."""
        size = _rounded(size)
        kind = _slab_size(size)
        with self._lock:
            self._sort_in()
            slab = self._find(size)
            given = self._given[kind]
            return slab is None or slab.is_new(size) or given - self._taken[kind] < share * given

    def prepare(
        self,
        size: int,
        total: int,
        *,
        pause: float = 0.0,
        enough: threading.Event | None = None,
    ) -> None:
        """Allocate memory in advance, until that much is spare or taken.

        That many bytes may stay spare until `settle`.

        Args:
            size: Bytes of a buffer that will be taken.
            total: Bytes of all buffers, about.
            pause: Pause after each page, as a multiple of the time that the page took.
            enough: Ends the allocation early.
        """
        enough = enough or threading.Event()
        size = _rounded(size)
        kind = _slab_size(size)
        with self._lock:
            missing = total - self._given[kind]
            self._most_whole = max(self._most_whole, total, self._whole_bytes + missing)
        while missing >= size and not enough.is_set():
            with self._lock:
                # Partly allocated slabs come first.
                whole = self._whole.get(kind)
                slab = self._unkeep(whole[0]) if whole and whole[0].given < kind else None
            slab = slab or _Slab(kind)
            before = slab.given
            since = time.monotonic()
            for part in slab.give(before + missing // size * size, kind):
                part.fill(0)
                if enough.wait(pause * (time.monotonic() - since)):
                    break
                since = time.monotonic()
            got = slab.given - before
            with self._lock:
                self._given[kind] += got
                self._store(slab)
                # Other threads may also allocate, or return spare memory.
                missing = min(missing - got, total - self._given[kind])

    def settle(self) -> None:
        """Return surplus spare memory to the system."""
        with self._lock:
            self._sort_in()
            self._most_whole = _MAX_IDLE_BYTES
            for slab in [slab for whole in self._whole.values() for slab in whole]:
                if self._whole_bytes > self._most_whole:
                    self._given[slab.size] -= self._unkeep(slab).given

    def _cut_off(self, slab: _Slab, size: int) -> tuple[int, Iterator[NDArray[np.uint8]]]:
        """Start of a new buffer, and its memory still to be allocated. Needs the lock."""
        if not slab.cut:
            slab.cut_into(size)
        cut = self._cut.setdefault(size, {})
        start = slab.free_starts.pop()
        if slab.free_starts:
            cut[slab] = None
        else:
            cut.pop(slab, None)
        missing: Iterator[NDArray[np.uint8]] = iter(())
        if slab.given < start + size:
            self._given[slab.size] += start + size - slab.given
            missing = slab.give(start + size, _FILLED)
        self._taken[slab.size] += size
        return start, missing

    @property
    def _whole_bytes(self) -> int:
        return sum(size * len(whole) for size, whole in self._whole.items())

    def _find(self, size: int) -> _Slab | None:
        """The slab to cut a buffer from. Needs the lock.

        It avoids new memory and prefers the slab with the least spare memory, so that other
        slabs become free.
        """
        slabs = [*self._cut.get(size, ()), *self._whole.get(_slab_size(size), ())[-1:]]
        return min(slabs, key=lambda slab: slab.price(size), default=None)

    def _give(self, slab: _Slab, start: int) -> None:
        self._returned.append((slab, start))
        # This thread may hold the lock already. The next holder takes the buffer back.
        if self._lock.acquire(blocking=False):
            try:
                self._sort_in()
            finally:
                self._lock.release()

    def _sort_in(self) -> None:
        """Take back returned buffers. Needs the lock."""
        while self._returned:
            slab, start = self._returned.popleft()
            self._taken[slab.size] -= slab.cut
            slab.free_starts.append(start)
            cut = self._cut[slab.cut]
            if slab.is_unused():
                cut.pop(slab, None)
                self._store(slab)
            else:
                cut[slab] = None

    def _store(self, slab: _Slab) -> None:
        """Store a free slab as spare, or return it to the system. Needs the lock."""
        slab.cut = 0
        if self._whole_bytes + slab.size > self._most_whole:
            self._given[slab.size] -= slab.given
            return
        # The last one is reused first.
        whole = self._whole.setdefault(slab.size, [])
        whole.insert(len(whole) if slab.given == slab.size else 0, slab)

    def _unkeep(self, slab: _Slab) -> _Slab:
        """Remove a free slab from the spare ones. Needs the lock."""
        self._whole[slab.size].remove(slab)
        return slab


class _Slab:
    """Memory cut into buffers of one size."""

    def __init__(self, size: int) -> None:
        self.memory = new_memory(size)
        self.size = size
        self.given = 0  # bytes from its start that are allocated
        self.cut = 0  # bytes of a buffer; 0 while the slab is free
        self.free_starts: list[int] = []  # starts of the free buffers, the next one last

    def cut_into(self, size: int) -> None:
        self.cut = size
        self.free_starts = list(range(self.size - size, -1, -size))

    def is_unused(self) -> bool:
        return len(self.free_starts) * self.cut == self.size

    def is_new(self, size: int) -> bool:
        """True if the next buffer needs memory that is not allocated yet."""
        return self.given < (self.free_starts[-1] if self.cut else 0) + size

    def price(self, size: int) -> tuple[bool, int]:
        """Cost of cutting the next buffer from this slab; lower is better."""
        return self.is_new(size), len(self.free_starts) if self.cut else self.size

    def give(self, end: int, most: int) -> Iterator[NDArray[np.uint8]]:
        """Unallocated memory up to `end`, in pieces of one page fault each.

        All of it counts as allocated; the pieces hold at most `most` bytes.
        """
        start, self.given = self.given, min(end, self.size)
        array = np.frombuffer(self.memory, np.uint8)[start:end][:most]
        return (array[at : at + _HUGE_PAGE] for at in range(0, len(array), _HUGE_PAGE))


def _slab_size(size: int) -> int:
    return max(size, SLAB)


def _rounded(size: int) -> int:
    return 1 << (max(size, _LEAST) - 1).bit_length()


def new_memory(size: int) -> mmap.mmap:
    """Private memory in huge pages, allocated when it is first written."""
    memory = mmap.mmap(-1, size, flags=_PRIVATE)
    if _HUGE is not None:
        memory.madvise(_HUGE)
    return memory


buffers = Buffers()
"""The pool of this process."""
