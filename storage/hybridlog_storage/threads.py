"""Processors, forks, and a thread pool that can be joined again after an interrupted wait.

If a signal handler raises an exception in `Thread.join`, Python before 3.13 marks the
thread as ended, and the next join returns at once. Cleanup would then run while the thread
still writes. A fork never leaves a lock held in the child by a thread of the parent alone.
"""

from __future__ import annotations

import _imp
import os
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, TypeVar
from weakref import WeakKeyDictionary, WeakSet

if TYPE_CHECKING:
    from _thread import RLock
    from threading import Lock

    _L = TypeVar("_L", Lock, RLock)


_T = TypeVar("_T")


class Threads(ThreadPoolExecutor):
    """A pool of threads; `shutdown` waits for running tasks, however often it is interrupted."""

    def __init__(self, count: int, name: str) -> None:
        super().__init__(count, thread_name_prefix=name)
        self._left = 0
        self._idle = threading.Condition()

    def submit(self, fn: Callable[..., _T], /, *args: Any, **kwargs: Any) -> Future[_T]:
        """Run a function on a thread of the pool."""
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
        """Stop accepting tasks and wait for all, or with `cancel_futures` for the running ones."""
        super().shutdown(wait=False, cancel_futures=cancel_futures)
        if wait:
            with self._idle:
                self._idle.wait_for(lambda: not self._left)
            super().shutdown(wait=True)

    def _has_ended(self, _: object = None) -> None:
        with self._idle:
            self._left -= 1
            self._idle.notify_all()


def processors() -> int:
    """Processors available to this process if the system reports them, else all processors."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


_PATIENCE_S: Final = 10.0
_locks: WeakSet[Lock | RLock] = WeakSet()
_begun: WeakKeyDictionary[Any, tuple[Any, ...]] = WeakKeyDictionary()
_inherited: list[dict[str, Any]] = []  # to close it could wait for threads of the parent
_taken: list[list[Lock | RLock]] = []
_imports: dict[str, Any] = getattr(import_module("importlib._bootstrap"), "_module_locks", {})


def begins_anew(thing: object, *arguments: object) -> None:
    """Make an object anew in forked processes, without the locks that threads may hold."""
    _begun[thing] = arguments


def _begin_anew() -> None:
    for thing, arguments in list(_begun.items()):
        _inherited.append(vars(thing).copy())
        vars(thing).clear()
        thing.__init__(*arguments)


def taken_by_forks(lock: _L) -> _L:
    """Take a lock at every fork of this process, until the fork is done.

    Args:
        lock: Whoever holds it must not wait for a thread that forks.
    """
    _locks.add(lock)
    return lock


def _take() -> None:
    taken = sorted(_locks, key=id)
    for lock in taken:
        lock.acquire()
    _taken.append(taken)
    # The child could not import a module that another thread was importing.
    until = time.monotonic() + _PATIENCE_S
    _imp.acquire_lock()  # keeps threads from beginning an import
    while _others_import() and time.monotonic() < until:
        _imp.release_lock()
        time.sleep(0.001)
        _imp.acquire_lock()


def _others_import() -> bool:
    owners = (getattr(lock(), "owner", None) for lock in list(_imports.values()))
    return any(owner not in {None, threading.get_ident()} for owner in owners)


def _release() -> None:
    _imp.release_lock()
    for lock in _taken.pop():
        lock.release()


os.register_at_fork(before=_take, after_in_parent=_release, after_in_child=_release)
os.register_at_fork(after_in_child=_begin_anew)
