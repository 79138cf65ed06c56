"""How much memory a live recording may use for what is not written yet."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path

LEAST = 64 << 20
MOST = 2 << 30
LEAST_ASKED_FOR = 1 << 20
"""Bytes that whoever says a budget must give."""
_SHARE = 16
_CGROUPS = Path("/sys/fs/cgroup")
_OWN_CGROUPS = Path("/proc/self/cgroup")


@cache
def usual_budget() -> int:
    """Bytes: a sixteenth of the memory there is, `LEAST` at least and `MOST` at most.

    A disk that is slower than what comes for some seconds then costs nothing, and whatever
    else runs on the robot keeps its memory. A limit of the container or service counts as
    the memory there is.
    """
    return min(max(memory_bytes() // _SHARE, LEAST), MOST)


def memory_bytes(root: Path = _CGROUPS, own: Path = _OWN_CGROUPS) -> int:
    """Bytes of memory that this process may use, of the machine or of its control group.

    Args:
        root: Where control groups (version 2) are mounted.
        own: What names the group of this process.
    """
    machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return min([machine, *_limits(root, own)])


def _limits(root: Path, own: Path) -> Iterator[int]:
    """Memory limits of the group and of those that it is in; none where there are no groups."""
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
