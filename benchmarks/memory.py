"""Peak memory of processes, as the kernel counts it, and the mongod processes of a run."""

from __future__ import annotations

import re
import resource
import sys
import time
from collections.abc import Iterator
from pathlib import Path

_END_LIMIT_S = 60.0


def own_peak() -> int:
    """Most bytes of memory that this process has had resident since it was started."""
    # getrusage would include the parent's memory, which a fork shares for a moment.
    peak = _high_water(Path("/proc/self"))
    if peak is not None:
        return peak
    used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return used if sys.platform == "darwin" else used * 1024


def mongod_peak(directory: Path) -> int:
    """Most bytes that the mongod with its data below a directory has had.

    Returns:
        0 when there is none, or when the system does not tell.
    """
    return max((_high_water(process) or 0 for process in _mongods(directory)), default=0)


def wait_for_mongods(directory: Path) -> None:
    """Wait until no mongod with its data below a directory is left.

    Raises:
        TimeoutError: One does not end within a minute.
    """
    deadline = time.monotonic() + _END_LIMIT_S
    while any(True for _ in _mongods(directory)):
        if time.monotonic() > deadline:
            raise TimeoutError(f"The mongod below {directory} does not end.")
        time.sleep(0.05)


def _mongods(directory: Path) -> Iterator[Path]:
    """Entries in `/proc` of the keepers and mongods that work below a directory."""
    name = str(directory.resolve()).encode()
    for process in Path("/proc").glob("[0-9]*"):
        try:
            command = (process / "cmdline").read_bytes()
        except OSError:
            continue  # it has just ended
        if name in command and b"mongod" in command:
            yield process


def _high_water(process: Path) -> int | None:
    try:
        status = (process / "status").read_text()
    except OSError:
        return None
    found = re.search(r"^VmHWM:\s+(\d+) kB", status, re.MULTILINE)
    return int(found[1]) * 1024 if found else None
