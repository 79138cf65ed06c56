"""The clock of a playback: log time that runs, stands still, or is set."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Final

SLOWEST: Final = 0.01
FASTEST: Final = 100.0
"""Limits of the speed, in seconds of log time a second."""


class PlaybackClock:
    """Log time during a playback. It stands still at first.

    Args:
        position: Log time, ns.
        speed: Seconds of log time a second; limited to `SLOWEST` and `FASTEST`.
        monotonic_ns: The clock of the machine, ns.

    Attributes:
        speed: As above.
        is_running: The time runs.
    """

    def __init__(
        self,
        position: int,
        speed: float = 1.0,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.speed = limited(speed, 1.0)
        self.is_running = False
        self._monotonic_ns = monotonic_ns
        self._position = position
        self._since = monotonic_ns()

    @property
    def position(self) -> int:
        """Log time now, ns."""
        if not self.is_running:
            return self._position
        return self._position + int((self._monotonic_ns() - self._since) * self.speed)

    def play(self) -> None:
        """Let the time run."""
        self.set(self.position)
        self.is_running = True

    def pause(self) -> None:
        """Let the time stand still."""
        self.set(self.position)
        self.is_running = False

    def set(self, position: int) -> None:
        """Go to a log time, ns; the time runs on from there, or stands still."""
        self._position, self._since = position, self._monotonic_ns()

    def set_speed(self, speed: float) -> None:
        """Run faster or slower; what is no number changes nothing."""
        self.set(self.position)
        self.speed = limited(speed, self.speed)

    def wait_for(self, position: int, seconds: float) -> None:
        """Go back to a log time, ns, if the running clock is more than some seconds ahead."""
        if self.is_running and self.position - position > seconds * self.speed * 1e9:
            self.set(position)

    def seconds_until(self, position: int) -> float:
        """Seconds until the running clock shows a log time, ns; not negative."""
        return max(position - self.position, 0) / self.speed / 1e9


def limited(speed: float, otherwise: float) -> float:
    """A speed between `SLOWEST` and `FASTEST`; `otherwise` if it is no number."""
    return otherwise if math.isnan(speed) else min(max(speed, SLOWEST), FASTEST)
