"""A limit of the memory of a process: DuckDB counts only a part of what queries take."""

from __future__ import annotations

import os
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

OWN_MEMORY: Final = 512 << 20
"""Bytes that hybridlog may take beside DuckDB, on top of what the process has at the start."""


# What Arrow reserves would count as taken; it reads this when it is loaded.
os.environ.setdefault("MIMALLOC_ARENA_EAGER_COMMIT", "0")


def private_bytes() -> int:
    """Bytes of private memory of this process, reserved ones included; 0 where it is unknown."""
    try:
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    except OSError:
        return 0
    return next(int(line.split()[1]) << 10 for line in lines if line.startswith("VmData:"))


@contextmanager
def limited_memory(memory: int) -> Iterator[int]:
    """Limit what this process takes from now on, where the system can.

    Args:
        memory: Limit of DuckDB's memory, bytes; `OWN_MEMORY` is on top of it.

    Yields:
        Bytes that it may have in all.
    """
    before, hard = resource.getrlimit(resource.RLIMIT_DATA)
    wanted = private_bytes() + memory + OWN_MEMORY
    most = wanted if before == resource.RLIM_INFINITY else min(wanted, before)
    resource.setrlimit(resource.RLIMIT_DATA, (most, hard))
    try:
        yield most
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (before, hard))
