"""Where real peers lie that a test run had to fetch: once, for all runs and all workers."""

from __future__ import annotations

import fcntl
import shutil
from collections.abc import Callable
from pathlib import Path


def made_once(name: str, make: Callable[[Path], str]) -> Path | str:
    """A directory of the cache; whoever asks for it first makes it, and others wait.

    Args:
        name: Of the directory; with the version, so that another one is made anew.
        make: Makes it; returns why it could not, empty when it could.

    Returns:
        The directory, or why there is none.
    """
    place = Path.home() / ".cache/hybridlog-tests" / name
    place.parent.mkdir(parents=True, exist_ok=True)
    with place.with_name(f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        ready = place / "ready"
        if not ready.exists():
            shutil.rmtree(place, ignore_errors=True)
            failure = make(place)
            if failure:
                return failure
            ready.touch()
    return place
