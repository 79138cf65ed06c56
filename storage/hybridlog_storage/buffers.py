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
from collections import Counter, deque
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

SLAB = 8 << 20
"""Bytes that the system is asked for at a time; buffers of up to so many are cut from them."""

_LEAST = 1 << 18  # smaller buffers are malloc's business
_SPARE_BYTES = 96 << 20
_HUGE_PAGE = 2 << 20
_FILLED = 8 << 20  # bytes of a new buffer; what is beyond is laid down by who can wait for it
_PRIVATE = getattr(mmap, "MAP_PRIVATE", 0) | getattr(mmap, "MAP_ANONYMOUS", 0)
_HUGE = getattr(mmap, "MADV_HUGEPAGE", None)


class Buffers:
    """A pool of buffers. Thread safe.

    They are cut from slabs, all buffers of one from one size. When none of them is taken any
    more, its memory may serve for another size: who begins to take larger buffers needs no
    other memory than he had for small ones.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        # Buffers that nobody has any more. The collector may give one back at any place, on a
        # thread that has the lock already.
        self._returned: deque[tuple[_Slab, int]] = deque()
        self._whole: dict[int, list[_Slab]] = {}  # of which nothing is taken, by their size
        self._most_whole = _SPARE_BYTES
        # Of which something is taken and something is not, by the size of their buffers.
        self._cut: dict[int, dict[_Slab, None]] = {}
        self._given: Counter[int] = Counter()  # bytes that the system gave, by the slabs' size,
        self._taken: Counter[int] = Counter()  # and those of them that are taken

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
            self._sort_in()
            slab = self._find(size)
            if slab is not None:
                if not slab.cut:
                    self._unkeep(slab)
                start, missing = self._cut_off(slab, size)
        if slab is None:
            slab = _Slab(_slab_size(size))  # that may take long, and others shall not wait for it
            with self._lock:
                start, missing = self._cut_off(slab, size)
        # Other threads go on meanwhile, as they could not when messages are laid there.
        for part in missing:
            part.fill(0)
        # What is over this array keeps this array, and so the memory, from being taken again.
        array = np.frombuffer(slab.memory, np.uint8, size, start)
        weakref.finalize(array, self._give, slab, start).atexit = False
        return array

    def is_short(self, size: int, share: float) -> bool:
        """Whether a buffer would be of new memory, or of what there is less than a share spare."""
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
        """Have memory, spare or taken, that the system has given already.

        As many bytes may then be spare until `settle`.

        Args:
            size: Bytes of a buffer that will be taken.
            total: Bytes of all, about.
            pause: For how many times as long as each page took to leave the system alone
                after it.
            enough: Ends it early.
        """
        enough = enough or threading.Event()
        size = _rounded(size)
        kind = _slab_size(size)
        with self._lock:
            missing = total - self._given[kind]
            self._most_whole = max(self._most_whole, total, self._whole_bytes + missing)
        while missing >= size and not enough.is_set():
            with self._lock:
                # What is begun comes first.
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
                self._keep(slab)
                # Others may get some as well, or have what is spare given back.
                missing = min(missing - got, total - self._given[kind])

    def settle(self) -> None:
        """Give back to the system what is more than usually spare."""
        with self._lock:
            self._sort_in()
            self._most_whole = _SPARE_BYTES
            for slab in [slab for whole in self._whole.values() for slab in whole]:
                if self._whole_bytes > self._most_whole:
                    self._given[slab.size] -= self._unkeep(slab).given

    def _cut_off(self, slab: _Slab, size: int) -> tuple[int, Iterator[NDArray[np.uint8]]]:
        """Where a buffer starts, and memory that it has not yet; by who has the lock."""
        if not slab.cut:
            slab.cut_into(size)
        cut = self._cut.setdefault(size, {})
        start = slab.spare.pop()
        if slab.spare:
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
        """The slab to cut a buffer from; by who has the lock.

        No new memory if it can be helped, and then the one with the least spare: so others
        become whole again.
        """
        slabs = [*self._cut.get(size, ()), *self._whole.get(_slab_size(size), ())[-1:]]
        return min(slabs, key=lambda slab: slab.price(size), default=None)

    def _give(self, slab: _Slab, start: int) -> None:
        self._returned.append((slab, start))
        # Whoever has the lock may be this very thread. The next one that has it sees to it.
        if self._lock.acquire(blocking=False):
            try:
                self._sort_in()
            finally:
                self._lock.release()

    def _sort_in(self) -> None:
        """Take back what was returned; by who has the lock."""
        while self._returned:
            slab, start = self._returned.popleft()
            self._taken[slab.size] -= slab.cut
            slab.spare.append(start)
            cut = self._cut[slab.cut]
            if slab.is_all_spare():
                cut.pop(slab, None)
                self._keep(slab)
            else:
                cut[slab] = None

    def _keep(self, slab: _Slab) -> None:
        """Have a whole slab spare, or give it back to the system; by who has the lock."""
        slab.cut = 0
        if self._whole_bytes + slab.size > self._most_whole:
            self._given[slab.size] -= slab.given
            return
        # The last one is taken first.
        whole = self._whole.setdefault(slab.size, [])
        whole.insert(len(whole) if slab.given == slab.size else 0, slab)

    def _unkeep(self, slab: _Slab) -> _Slab:
        """Have a whole slab spare no more; by who has the lock."""
        self._whole[slab.size].remove(slab)
        return slab


class _Slab:
    """Memory that is cut into buffers of one size."""

    def __init__(self, size: int) -> None:
        self.memory = new_memory(size)
        self.size = size
        self.given = 0  # bytes from its start that the system has given
        self.cut = 0  # bytes of a buffer; 0 while it is whole
        self.spare: list[int] = []  # where buffers start that are not taken, the next one last

    def cut_into(self, size: int) -> None:
        self.cut = size
        self.spare = list(range(self.size - size, -1, -size))

    def is_all_spare(self) -> bool:
        return len(self.spare) * self.cut == self.size

    def is_new(self, size: int) -> bool:
        """Whether the next buffer would have memory that the system has yet to give."""
        return self.given < (self.spare[-1] if self.cut else 0) + size

    def price(self, size: int) -> tuple[bool, int]:
        """The less the better it is to cut the next buffer from this one."""
        return self.is_new(size), len(self.spare) if self.cut else self.size

    def give(self, end: int, most: int) -> Iterator[NDArray[np.uint8]]:
        """Memory up to an end that the system has yet to give, in pieces of a page fault each.

        All of it counts as given; no more than so many bytes are in the pieces.
        """
        start, self.given = self.given, min(end, self.size)
        array = np.frombuffer(self.memory, np.uint8)[start:end][:most]
        return (array[at : at + _HUGE_PAGE] for at in range(0, len(array), _HUGE_PAGE))


def _slab_size(size: int) -> int:
    return max(size, SLAB)


def _rounded(size: int) -> int:
    return 1 << (max(size, _LEAST) - 1).bit_length()


def new_memory(size: int) -> mmap.mmap:
    """Memory of this process alone that the system gives when it is written to, in huge pages.

    Args:
        size: Bytes.
    """
    memory = mmap.mmap(-1, size, flags=_PRIVATE)
    if _HUGE is not None:
        memory.madvise(_HUGE)
    return memory


buffers = Buffers()
"""The pool of this process."""
