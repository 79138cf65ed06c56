"""Threads that can be waited for once more, after the waiting was interrupted.

When a signal handler raises an exception in `Thread.join`, Python (before 3.13) takes the
thread for ended, and joining it again returns at once. Whoever then tidies up would do so
while the thread still writes.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

_T = TypeVar("_T")


class Threads(ThreadPoolExecutor):
    """A pool of threads; `shutdown` waits for what runs, however often it was interrupted."""

    def __init__(self, count: int, name: str) -> None:
        super().__init__(count, thread_name_prefix=name)
        self._left = 0
        self._idle = threading.Condition()

    def submit(self, fn: Callable[..., _T], /, *args: Any, **kwargs: Any) -> Future[_T]:
        """Have something done."""
        with self._idle:
            self._left += 1
        try:
            future = super().submit(fn, *args, **kwargs)
        except BaseException:
            self._has_ended()
            raise
        future.add_done_callback(self._has_ended)
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:  # noqa: FBT001, FBT002 - as it is there
        """Take nothing more; return once all is done or, with `cancel_futures`, what runs."""
        super().shutdown(wait=False, cancel_futures=cancel_futures)
        if wait:
            with self._idle:
                self._idle.wait_for(lambda: not self._left)
            super().shutdown(wait=True)

    def _has_ended(self, _: object = None) -> None:
        with self._idle:
            self._left -= 1
            self._idle.notify_all()
