"""A semaphore that admits waiting threads in arrival order."""

from __future__ import annotations

from collections import deque
from threading import Lock


class FairSemaphore:
    """Admits a limited number of threads, in the order in which they arrive.

    Python's own locks let later threads overtake a waiting one any number of times.

    Args:
        limit: Threads that are admitted at the same time.
    """

    def __init__(self, limit: int) -> None:
        self._lock = Lock()
        self._free = limit
        self._waiting: deque[Lock] = deque()

    def __enter__(self) -> None:
        """Wait for admission."""
        with self._lock:
            if self._free:
                self._free -= 1
                return
            admitted = Lock()
            admitted.acquire()
            self._waiting.append(admitted)
        admitted.acquire()

    def __exit__(self, *_: object) -> None:
        """Admit the thread that has waited longest."""
        with self._lock:
            if self._waiting:
                self._waiting.popleft().release()
            else:
                self._free += 1
