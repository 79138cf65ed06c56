"""Gaps in the numbers that ROS 1 publishers put into `header.seq`."""

from __future__ import annotations

from collections.abc import Callable
from struct import Struct

_NUMBER = Struct("<I")
_TRUST = 64
"""Messages in a row that must count up by one before a gap means anything."""
_CONFIRM = 8
"""Messages after a gap that must not count back; two publishers in turn would."""
_MOST_MISSING = 1 << 16
"""A wider gap is a publisher that began anew, not a loss."""


class HeaderNumbers:
    """Follows the numbers of one channel.

    ROS 1 publishers count their messages in `header.seq`, but nothing obliges them to:
    throttles and players hand on the numbers of others, with holes in them, and a topic
    with two publishers has two counts. So a gap is taken for a loss only where the count
    has gone up by one for a while, and does not go back right after the gap.

    Args:
        report: Called with how many are missing, the receive times of the messages
            before and after, ns since the epoch, and what was seen.
    """

    def __init__(self, report: Callable[[int, int, int, str], None]) -> None:
        self._report = report
        self._last = 0
        self._time = 0
        self._run = 0
        self._missing = 0
        self._after = 0
        self._first = self._until = 0
        self._seen = ""

    def see(self, payload: bytes, received: int) -> None:
        """Look at a message.

        Args:
            payload: It begins with the number.
            received: ns since the epoch.
        """
        if len(payload) < 4:
            return
        (number,) = _NUMBER.unpack_from(payload)
        step = (number - self._last) & 0xFFFFFFFF
        if step != 1:
            self._jump(step, number, received)
        else:
            self._run += 1
        self._last = number
        self._time = received
        if self._missing:
            self._after += 1
            if self._after > _CONFIRM:
                self.finish()

    def finish(self) -> None:
        """Report what is not reported yet."""
        if self._missing:
            self._report(self._missing, self._first, self._until, self._seen)
        self._missing = 0

    def _jump(self, step: int, number: int, received: int) -> None:
        if self._run < _TRUST or not 1 < step <= _MOST_MISSING:
            self._run = self._missing = 0
            return
        if not self._missing:
            self._after = 0
            self._first = self._time
            self._seen = f"header.seq went from {self._last} to {number}"
        self._missing += step - 1
        self._until = received
