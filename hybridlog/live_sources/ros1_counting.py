"""Which gaps in a publisher's numbers are messages that were dropped."""

from __future__ import annotations

from typing import Final

_MASK: Final = 0xFFFFFFFF
_ENOUGH: Final = 8
_WIDEST: Final = 1_000_000


class Counting:
    """Watches `header.seq` of one connection.

    rospy and roscpp count their messages there, one by one for each publisher. But the
    field may hold anything: programs that play a bag or throttle a topic pass on numbers
    of somebody else, others leave it at zero. So a connection is believed only after it
    has counted by exactly one eight times without a break. From then on a number that is
    too high by up to a million says how many messages are missing. One that goes back,
    repeats, or leaps farther ends the belief, until it has been earned again.

    Attributes:
        expected: The number that continues the count; the reader sets it to the next one
            itself as long as nothing jumps, and calls `jump` with any other number.
    """

    __slots__ = ("_believed", "_start", "expected")

    def __init__(self) -> None:
        self.expected = -1
        self._start = 0
        self._believed = False

    def jump(self, number: int) -> int:
        """Notes a number that was not expected.

        Returns:
            How many messages are missing before it.
        """
        lost = 0
        if self.expected >= 0:
            missing = number - self.expected & _MASK
            # The count has gone by one ever since `_start`.
            steps = self.expected - 1 - self._start & _MASK
            self._believed = (self._believed or steps >= _ENOUGH) and missing <= _WIDEST
            lost = missing if self._believed else 0
        self._start = number
        self.expected = number + 1 & _MASK
        return lost
