"""Peak memory of processes, as the kernel counts it."""

from __future__ import annotations

import re
import resource
import sys
from pathlib import Path

import psutil


def own_peak() -> int:
    """Most bytes of memory that this process has had resident since it was started."""
    # getrusage would include the parent's memory, which a fork shares for a moment.
    peak = _high_water(Path("/proc/self/status"))
    if peak is not None:
        return peak
    used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return used if sys.platform == "darwin" else used * 1024


def mongod_peak(data: Path) -> int:
    """Most bytes that the mongod with this data directory has had; 0 when it has ended.

    Args:
        data: As it stands in mongod's command line.
    """
    for process in psutil.process_iter(["name", "cmdline"]):
        if process.info["name"] == "mongod" and str(data) in (process.info["cmdline"] or ()):
            peak = _high_water(Path(f"/proc/{process.pid}/status"))
            try:
                return peak if peak is not None else int(process.memory_info().rss)
            except psutil.Error:
                return 0
    return 0


def _high_water(status: Path) -> int | None:
    try:
        found = re.search(r"^VmHWM:\s+(\d+) kB", status.read_text(), re.MULTILINE)
    except OSError:
        return None
    return int(found[1]) * 1024 if found else None
