"""Processors, and a thread pool that can be joined again after an interrupted wait.

If a signal handler raises an exception in `Thread.join`, Python before 3.13 marks the
thread as ended, and the next join returns at once. Cleanup would then run while the thread
still writes. A fork never leaves a lock held in the child by a thread of the parent alone.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent import futures
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

_T = TypeVar("_T")


class Threads(ThreadPoolExecutor):
    """A pool of threads; `shutdown` waits for running tasks, however often it is interrupted."""

    def __init__(self, count: int, name: str) -> None:
        super().__init__(count, thread_name_prefix=name)
        self._left: set[Future[Any]] = set()

    def submit(self, fn: Callable[..., _T], /, *args: Any, **kwargs: Any) -> Future[_T]:
        """Run a function on a thread of the pool."""
        future = super().submit(fn, *args, **kwargs)
        self._left.add(future)
        future.add_done_callback(self._left.discard)
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:  # noqa: FBT001, FBT002 - as it is there
        """Stop accepting tasks and wait for all, or with `cancel_futures` for the running ones."""
        super().shutdown(wait=False, cancel_futures=cancel_futures)
        if wait:
            futures.wait(self._left.copy())
            super().shutdown(wait=True)


def processors() -> int:
    """Processors available to this process if the system reports them, else all processors."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
