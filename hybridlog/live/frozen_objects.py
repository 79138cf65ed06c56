"""Hides the objects of a process from the garbage collector while it records.

A full collection visits every object and stops all threads: for 20 to 30 milliseconds with
the modules of a recorder alone. A topic that sends every three milliseconds into a queue of
ten loses messages in that time.
"""

from __future__ import annotations

import gc
from threading import Lock


class FrozenObjects:
    """A context in which the collector skips all objects that existed before it.

    Objects that are made in the context are collected as usual. A process that has frozen
    its objects itself (`gc.freeze`) keeps them frozen. Thread safe; the context nests.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._users = 0
        self._is_ours = False

    def __enter__(self) -> None:
        """Freeze the objects, unless they are frozen already."""
        with self._lock:
            if not self._users and not gc.get_freeze_count():
                gc.freeze()
                self._is_ours = True
            self._users += 1

    def __exit__(self, *_: object) -> None:
        """Unfreeze the objects when the last user leaves."""
        with self._lock:
            self._users -= 1
            if not self._users and self._is_ours:
                gc.unfreeze()
                self._is_ours = False


frozen_objects = FrozenObjects()
"""The objects of this process."""
