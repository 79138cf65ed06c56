"""Number of available processors."""

from __future__ import annotations

import os


def processors() -> int:
    """Processors available to this process if the system reports them, else all processors."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
