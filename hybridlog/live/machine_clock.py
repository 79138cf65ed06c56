"""The clock of this machine, which may be set while a recorder runs.

Log times are those of the clock, whatever it says. Durations, such as that of a ring or of a
silence, are measured in steady times: log times without what the clock was set by.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Final, NamedTuple

_MIN_JUMP_NS: Final = 500_000_000  # a smaller difference is a clock that is slowed or sped up
_MAX_JUMPS: Final = 1000


class Jump(NamedTuple):
    """The clock was set.

    Attributes:
        at: Steady time, ns.
        by: Nanoseconds forward; negative for back.
        set_by: Sum of all jumps, this one included, ns.
    """

    at: int
    by: int
    set_by: int


class MachineClock:
    """Notices when the clock is set. Thread safe.

    Args:
        now: Returns its time, ns since the epoch.
        monotonic: Returns a time that nobody sets, ns.

    Attributes:
        now: As above.
        set_by: Nanoseconds by which it was set since the beginning, as far as noticed.
    """

    def __init__(
        self,
        now: Callable[[], int] = time.time_ns,
        monotonic: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.now = now
        self.set_by = 0
        self._monotonic = monotonic
        self._offset = now() - monotonic()
        self._jumps: deque[Jump] = deque(maxlen=_MAX_JUMPS)
        self._untold: deque[Jump] = deque(maxlen=_MAX_JUMPS)
        self._lock = threading.Lock()

    def steady(self, log_time: int) -> int:
        """A log time, ns, of about now, as if the clock had never been set."""
        if abs(log_time - self._monotonic() - self._offset) >= _MIN_JUMP_NS:
            self._look()
        return log_time - self.set_by

    def log_time(self, steady: int) -> int:
        """The time of the clock at a steady time, ns."""
        return steady + next((j.set_by for j in reversed(self._jumps) if j.at <= steady), 0)

    def jumps(self) -> list[Jump]:
        """The jumps since the last call."""
        self._look()
        with self._lock:
            found = [*self._untold]
            self._untold.clear()
        return found

    def _look(self) -> None:
        with self._lock:
            now = self.now()
            by = now - self._monotonic() - self._offset
            self._offset += by
            if abs(by) >= _MIN_JUMP_NS:
                at = now - by - self.set_by
                self.set_by += by
                for each in (self._jumps, self._untold):
                    each.append(Jump(at, by, self.set_by))
