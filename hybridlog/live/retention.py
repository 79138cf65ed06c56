"""Keeps a store within its rules of retention while a recorder runs."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from hybridlog.maintenance.keep import Keeper
from hybridlog.maintenance.retention import Rules
from hybridlog_storage.errors import HeldError, HybridlogError
from hybridlog_storage.settings import read_settings

if TYPE_CHECKING:
    from hybridlog.maintenance.keep import Own
    from hybridlog_storage.disk.directory import StoreDirectory

LOOK_S: Final = 5.0
"""Seconds between two looks at the rules and at free space."""
_TICK_S: Final = 0.1
_AGES_S: Final = 60.0  # between two passes for the ages alone


class RetentionThread:
    """Makes passes of retention, on a thread of its own.

    A pass is made when a segment was sealed, when less is free than the rules say, and once a
    minute. What it cannot do is told, and never stops the recorder.

    Args:
        directory: The store.
        remove: Removes a whole recording, by its id.
        own: The recording in progress; None if there is none.
        say: Shows a line to the user, each text once.
    """

    def __init__(
        self,
        directory: StoreDirectory,
        remove: Callable[[str], None],
        own: Own | None,
        say: Callable[[str], None],
    ) -> None:
        self._directory = directory
        self._keeper = Keeper(directory, remove, own, is_wanted=lambda: not self._over.is_set())
        self._own = own
        self._say = say
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="hybridlog-keep", daemon=True)
        self._rules = Rules.of(directory.settings.retention)
        self._has_warned = False

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """End after the deletion in progress."""
        self._over.set()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        looked = kept = -_AGES_S
        segments = 0
        while not self._over.wait(_TICK_S):
            now, sealed = time.monotonic(), self._own.sealed() if self._own is not None else 0
            is_low = False
            try:
                if now - looked >= LOOK_S:
                    looked = now
                    self._rules = Rules.of(read_settings(self._directory.path).retention)
                    free = shutil.disk_usage(self._directory.path).free
                    is_low = free < (self._rules.min_free or 0)
                is_due = sealed != segments or is_low or now - kept >= _AGES_S
                if is_due and not self._rules.is_empty:
                    segments, kept = sealed, now
                    self._keep()
            except HeldError:
                segments = -1  # another process makes room: see later what is left
            except (HybridlogError, OSError) as error:
                self._say(f"making room failed: {error}")

    def _keep(self) -> None:
        done = self._keeper.keep(self._rules)
        warnings = [] if self._has_warned else done.plan.warnings
        self._has_warned = bool(done.plan.warnings)
        reasons = (f"making room: {step.reason}" for step in done.plan.steps)
        for text in (*reasons, *done.problems, *warnings):
            self._say(text)
