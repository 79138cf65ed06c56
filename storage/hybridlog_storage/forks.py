"""Forks that never leave a lock held in the child by a thread that only the parent has."""

from __future__ import annotations

import _imp
import os
import threading
import time
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, TypeVar
from weakref import WeakKeyDictionary, WeakSet

if TYPE_CHECKING:
    from _thread import RLock
    from threading import Lock

    _L = TypeVar("_L", Lock, RLock)

_PATIENCE_S: Final = 10.0
_locks: WeakSet[Lock | RLock] = WeakSet()
_begun: WeakKeyDictionary[Any, tuple[Any, ...]] = WeakKeyDictionary()
_inherited: list[dict[str, Any]] = []  # to close it could wait for threads of the parent
_taken: list[list[Lock | RLock]] = []
_imports: dict[str, Any] = getattr(import_module("importlib._bootstrap"), "_module_locks", {})


def begins_anew(thing: object, *arguments: object) -> None:
    """Make an object anew in forked processes, without the locks that threads may hold.

    Args:
        thing: The object.
        arguments: Those of its class.
    """
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
