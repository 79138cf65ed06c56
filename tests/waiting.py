"""Waiting for what another thread or process does."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor


def wait_for(condition: Callable[[], object], limit_s: float = 60) -> None:
    """Wait until something is the case."""
    deadline = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.002)


def at_once(*works: Callable[[], object]) -> None:
    """Do things in threads of their own; what fails in one of them fails here."""
    with ThreadPoolExecutor(len(works)) as pool:
        for done in [pool.submit(work) for work in works]:
            done.result()
