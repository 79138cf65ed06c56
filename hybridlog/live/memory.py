"""Memory of a live recording: its default bound, and the garbage collector.

A full collection visits every object and stops all threads: for 20 to 30 milliseconds with
the modules of a recorder alone. A topic that sends every three milliseconds into a queue of
ten loses messages in that time.
"""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path


@contextmanager
def frozen_objects() -> Iterator[None]:
    """The collector skips all objects that existed before; for the program that records."""
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


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
