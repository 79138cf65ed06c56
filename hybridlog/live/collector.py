"""Keeping the garbage collector from the objects that a process has.

Now and then Python's collector looks at every object there is, and meanwhile no thread goes
on: 20 to 30 milliseconds with the modules of a recorder alone. A topic that sends every three
milliseconds, into a queue of ten, has lost messages then.
"""

from __future__ import annotations

import gc
from threading import Lock


class SparedObjects:
    """While anybody is in here, the collector passes over all objects that were there before.

    Those made meanwhile are collected as ever. In a process that has frozen its objects
    itself (`gc.freeze`) nothing is changed. Thread safe; to be entered any number of times.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._users = 0
        self._is_ours = False

    def __enter__(self) -> None:
        """Begin to spare them."""
        with self._lock:
            if not self._users and not gc.get_freeze_count():
                gc.freeze()
                self._is_ours = True
            self._users += 1

    def __exit__(self, *_: object) -> None:
        """Give them back to the collector, if nobody else is in here."""
        with self._lock:
            self._users -= 1
            if not self._users and self._is_ours:
                gc.unfreeze()
                self._is_ours = False


spared_objects = SparedObjects()
"""The objects of this process."""
