"""Memory of a live recording: reserved ahead, its default bound, and the garbage collector.

A full collection visits every object and stops all threads: for 20 to 30 milliseconds with
the modules of a recorder alone. A topic that sends every three milliseconds into a queue of
ten loses messages in that time.
"""

from __future__ import annotations

import gc
import os
import threading
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from threading import Lock

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


class FrozenObjects:
    """A context in which the collector skips all objects that existed before it.

    Objects that are made in the context are collected as usual. A process that has frozen
    its objects itself (`gc.freeze`) keeps them frozen. Thread safe; the context nests.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._users = 0
        self._is_ours = False

    def __enter__(self) -> None:
        """Freeze the objects, unless they are frozen already."""
        with self._lock:
            if not self._users and not gc.get_freeze_count():
                gc.freeze()
                self._is_ours = True
            self._users += 1

    def __exit__(self, *_: object) -> None:
        """Unfreeze the objects when the last user leaves."""
        with self._lock:
            self._users -= 1
            if not self._users and self._is_ours:
                gc.unfreeze()
                self._is_ours = False


frozen_objects = FrozenObjects()
"""The objects of this process."""


MIN_BUDGET = 64 << 20
MAX_BUDGET = 2 << 30
MIN_USER_BUDGET = 1 << 20
"""Smallest budget that a user may choose, bytes."""
_MACHINE_SHARE = 16
_CGROUPS = Path("/sys/fs/cgroup")
_OWN_CGROUPS = Path("/proc/self/cgroup")
_OWN_MEMORY = Path("/proc/self/statm")


@cache
def default_budget() -> int:
    """A sixteenth of the machine's memory in bytes, from `MIN_BUDGET` to `MAX_BUDGET`.

    It bridges some seconds of a slow disk, and leaves memory to other programs of the
    robot. A memory limit of the container or service counts as the machine's memory.
    """
    return min(max(memory_bytes() // _MACHINE_SHARE, MIN_BUDGET), MAX_BUDGET)


def memory_bytes(root: Path = _CGROUPS, own: Path = _OWN_CGROUPS) -> int:
    """Bytes of memory that the machine has, or that this process's control group allows.

    Args:
        root: Mount point of control groups (version 2).
        own: File that names the group of this process.
    """
    machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return min([machine, *_limits(root, own)])


def resident_bytes() -> int:
    """Bytes of memory that this process holds; 0 where that is unknown."""
    try:
        pages = int(_OWN_MEMORY.read_text(encoding="ascii").split()[1])
    except (OSError, ValueError, IndexError):
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")


def _limits(root: Path, own: Path) -> Iterator[int]:
    """Memory limits of the group and its parents; nothing on a system without groups."""
    try:
        lines = own.read_text().splitlines()
    except OSError:
        return
    name = next((line[3:] for line in lines if line.startswith("0::")), "/")
    group = root / name.lstrip("/")
    for directory in [group, *group.parents]:
        if not directory.is_relative_to(root):
            return
        # `max` stands for no limit; the outermost group has no such file.
        with suppress(OSError, ValueError):
            yield int((directory / "memory.max").read_text())
