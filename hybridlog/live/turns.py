"""Some at a time, in the order in which they came."""

from __future__ import annotations

from collections import deque
from threading import Lock


class Turns:
    """A semaphore that is fair: a thread waits no longer than those before it take.

    Threads that wait for a lock of Python's may be passed by others any number of times.

    Args:
        most: Threads that go on at the same time.
    """

    def __init__(self, most: int) -> None:
        self._lock = Lock()
        self._free = most
        self._waiting: deque[Lock] = deque()

    def __enter__(self) -> None:
        """Wait for a turn."""
        with self._lock:
            if self._free:
                self._free -= 1
                return
            called = Lock()
            called.acquire()
            self._waiting.append(called)
        called.acquire()

    def __exit__(self, *_: object) -> None:
        """Give the turn to who has waited longest."""
        with self._lock:
            if self._waiting:
                self._waiting.popleft().release()
            else:
                self._free += 1
