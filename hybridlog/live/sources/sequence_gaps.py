"""Lost messages, found by the sequence numbers of ROS 1 publishers.

rospy and roscpp number the messages of each publisher one by one, in `header.seq`. Those
messages come straight from the publisher (ROS 1) or through a bridge (Foxglove). Both
sources use this detector with the same parameters, so they report the same losses.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from hybridlog_storage.messages import Channel

MODULUS: Final = 1 << 32
"""Sequence numbers are counted modulo this."""

_FIELD: Final = re.compile(r"^[ \t]*([\w/]+(?:\[\d*\])?)[ \t]+(\w+)[ \t]*(=?)", re.MULTILINE)
_HEADER_TYPES: Final = frozenset({"Header", "std_msgs/Header", "roslib/Header"})


class SequenceGap(NamedTuple):
    """Consecutive messages that never came, between two receive times, ns since the epoch."""

    missing: int
    first: int
    last: int


class SequenceGapDetector:
    """Finds gaps in the sequence numbers of one connection or channel.

    Nothing obliges a publisher to count. Players and throttles pass on the numbers of
    another publisher, and a bridge may mix two publishers in one channel. A gap is a loss
    only if the numbers went up by one before it, and do not go back after it.

    Args:
        trust_after: Steps of exactly one after which the numbers are trusted.
        confirm_after: Messages after a gap that must not go back before it is confirmed.
        max_gap: Largest number of missing messages. A wider gap, a repeated number and a
            number that goes back end the trust until it is earned again.

    Attributes:
        expected: The number that continues the count, -1 before the first message. A fast
            reader compares with it and advances it, and calls `jump` for other numbers.
        waiting: Gaps that are not confirmed yet.
    """

    def __init__(
        self, *, trust_after: int = 8, confirm_after: int = 8, max_gap: int = 1_000_000
    ) -> None:
        self.expected = -1
        self.waiting: list[SequenceGap] = []
        self._confirmed: list[SequenceGap] = []
        self._trust_after = trust_after
        self._confirm_after = confirm_after
        self._max_gap = max_gap
        self._start = 0  # since this number the count has gone up by one
        self._messages_after = 0  # messages between the first waiting gap and `_start`
        self._trusted = False
        self._received = 0

    def see(self, number: int, received: int) -> None:
        """Takes the number of the next message, and its receive time, ns since the epoch."""
        if number == self.expected:
            self.expected = (number + 1) % MODULUS
        else:
            self.jump(number, self._received, received)
        self._received = received

    def jump(self, number: int, first: int, last: int) -> None:
        """Takes an unexpected number; times (ns) are of the message before it, and its own."""
        if self.expected >= 0:
            self._end_run()
            missing = (number - self.expected) % MODULUS
            self._trusted = self._trusted and missing <= self._max_gap
            if self._trusted:
                if not self.waiting:
                    self._messages_after = 0
                self.waiting.append(SequenceGap(missing, first, last))
            else:
                self.waiting.clear()
        self._start = number
        self.expected = (number + 1) % MODULUS

    def confirmed(self) -> list[SequenceGap]:
        """Gaps that were confirmed since the last call, the oldest first."""
        self._confirm((self.expected - self._start) % MODULUS)
        found, self._confirmed = self._confirmed, []
        return found

    def finish(self) -> list[SequenceGap]:
        """All gaps that were not returned yet: no further message will confirm them."""
        found = [*self._confirmed, *self.waiting]
        self._confirmed, self.waiting = [], []
        return found

    def _end_run(self) -> None:
        """Judges the messages since `_start`, which have gone up by one."""
        run = (self.expected - self._start) % MODULUS
        self._trusted = self._trusted or run > self._trust_after
        self._confirm(run)
        self._messages_after += run

    def _confirm(self, run: int) -> None:
        """Confirms the waiting gaps if enough messages followed, the last `run` included."""
        if self.waiting and self._messages_after + run > self._confirm_after:
            self._confirmed += self.waiting
            self.waiting = []


def has_sequence_numbers(channel: Channel) -> bool:
    """Tells whether each message begins with four bytes that its publisher counts up.

    rospy and roscpp do so where the first field of a type is `Header header`. Latching
    publishers are left out: rospy counts the message that it repeats for one late
    subscriber, and all others then see a gap where nothing is missing.
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
            return kind in _HEADER_TYPES and name == "header"
    return False
