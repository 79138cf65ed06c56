"""Which gaps in a publisher's numbers are messages that were dropped."""

from __future__ import annotations

import re
from collections.abc import Callable
from struct import Struct
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from hybridlog_storage.messages import Channel

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


_FIELD: Final = re.compile(r"^[ \t]*([\w/]+(?:\[\d*\])?)[ \t]+(\w+)[ \t]*(=?)", re.MULTILINE)
_TYPES: Final = frozenset({"Header", "std_msgs/Header", "roslib/Header"})


def is_numbered(channel: Channel) -> bool:
    """Whether a publisher writes its own count into the first four bytes of each message.

    rospy and roscpp do so where the first field of a type is `Header header`. Publishers
    that say that they latch are left out: rospy counts the message that it repeats for one
    late subscriber, and all others then see a gap where nothing is missing.
    """
    schema = channel.schema
    if channel.message_encoding != "ros1" or schema is None or schema.encoding != "ros1msg":
        return False
    if channel.metadata.get("latching") == "1":
        return False
    head, _, _ = schema.data.decode(errors="replace").partition("\n=====")
    for found in _FIELD.finditer(head):
        kind, name, equals = found.groups()
        if not equals:
            return kind in _TYPES and name == "header"
    return False
