"""The messages of one recorded topic and type: subscription, channel, lost messages.

The middleware of each publisher numbers its messages one by one. A number that is passed over is
a message that was lost in transport or in a queue; the first number of a publisher begins its
count. If messages do not name their publisher, numbers count only while the topic has had the
same single publisher.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from hybridlog.live.sources.ros2.child.middleware import publisher_id
from hybridlog.live.sources.sequence_gaps import (
    MODULUS,
    SequenceGap,
    SequenceGapDetector,
    joined_gap,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from hybridlog.live.sources.ros2.child.middleware import Offer, Subscription
    from hybridlog.live.sources.ros2.child.outbox import Outbox

MAX_PUBLISHERS = 1024
"""Maximum number of publishers of a topic whose numbers are remembered after they are gone."""

MAX_GAP = MODULUS // 2
"""Largest number of missing messages; a number that is further on is one that went back."""

_MAX_MESSAGES = 1000
_BYTES_AT_ONCE = 8 << 20
_OLDEST = 60_000_000_000
_NEWEST = 1_000_000_000
_MAX_INT = 2**63 - 1


class Stream:
    """Moves the messages of a topic from the middleware into the outbox.

    Args:
        look_again: Updates `channels`: a publisher is not among them.

    Attributes:
        subscription: The subscription; the owner closes it, and puts another in its place.
        named: Messages name their publisher; True until one does not.
        numbered: Messages have numbers; True until one does not.
        alone: The topic has had the same single publisher since its count began.
        channel: Number of the channel of publishers that are not in `channels`.
        channels: Numbers of channels by publisher.
    """

    def __init__(
        self,
        subscription: Subscription,
        channel: int,
        offers: Sequence[Offer],
        look_again: Callable[[], None],
    ) -> None:
        self.subscription = subscription
        self.channel = channel
        self.channels: dict[bytes, int] = {}
        self._look_again = look_again
        self._looked_for: set[bytes] = set()
        self.named = True
        self.numbered = True
        self.alone = len(offers) == 1
        self._gaps: dict[bytes, SequenceGapDetector] = {}
        self._unsure: list[tuple[bytes, SequenceGap]] = []  # they wait for a look at the graph
        self._publishers = frozenset(offer.publisher for offer in offers)

    def take(self, outbox: Outbox) -> tuple[int, int]:
        """Takes messages, up to a limit for other topics' sake; returns number and bytes."""
        take, put = self.subscription.take, outbox.message
        count = size = 0
        while count < _MAX_MESSAGES and size < _BYTES_AT_ONCE:
            got = take()
            if got is None:
                break
            payload, info = got
            count += 1
            size += len(payload)
            received = _received(info)
            number = self._number(info)
            gid = info.get("publisher_gid")
            if gid is None:
                self.named = False
                publisher, is_usable = b"", self.alone and number >= 0
                channel = self.channel
            else:
                publisher, is_usable = publisher_id(gid["data"]), number >= 0
                found = self.channels.get(publisher)
                channel = self._meet(publisher) if found is None else found
            if is_usable:
                self._count(publisher, number, received)
            sent = info["source_timestamp"]
            put(channel, payload, received, sent if 0 < sent <= _MAX_INT else 0, number)
        return count, size

    def _count(self, publisher: bytes, number: int, received: int) -> None:
        gaps = self._gaps.get(publisher)
        if gaps is None:
            gaps = SequenceGapDetector(trust_after=0, confirm_after=0, max_gap=MAX_GAP)
            self._gaps[publisher] = gaps
        # A number that goes back is a late message, which is no loss.
        if gaps.expected < 0 or (number - gaps.expected) % MODULUS <= MAX_GAP:
            gaps.see(number % MODULUS, received)

    def _meet(self, publisher: bytes) -> int:
        """The channel of a publisher that came after the last look at the graph."""
        if publisher not in self._looked_for:
            if len(self._looked_for) >= MAX_PUBLISHERS:
                self._looked_for.clear()
            self._looked_for.add(publisher)
            self._look_again()
        return self.channels.get(publisher, self.channel)

    def _number(self, info: dict[str, Any]) -> int:
        """The sequence number of a message, -1 without one."""
        number = info.get("publication_sequence_number")
        if number is None or not 0 <= number <= _MAX_INT:
            self.numbered = False
            return -1
        return int(number)

    def look(
        self, offers: Sequence[Offer], *, final: bool = False
    ) -> list[tuple[bytes, SequenceGap]]:
        """Losses since the last call, by publisher; called at each look at the graph."""
        found = [
            (publisher, joined_gap(lost))
            for publisher, gaps in self._gaps.items()
            if (lost := gaps.confirmed())
        ]
        publishers = frozenset(offer.publisher for offer in offers)
        if not self.named:
            self.alone = len(offers) == 1 and publishers == self._publishers
            if not self.alone:
                self._gaps.clear()
                found = self._unsure = []
            elif not final:
                # Another publisher may have sent before the graph shows it.
                found, self._unsure = self._unsure, found
            else:
                found = self._unsure + found
        self._publishers = publishers
        if len(self._gaps) > MAX_PUBLISHERS:
            self._gaps = {key: gaps for key, gaps in self._gaps.items() if key in publishers}
        return found


def _received(info: dict[str, Any]) -> int:
    """Receive time of a message, ns since the epoch.

    It is the present if the middleware does not provide it or the clock was set.
    """
    now = time.time_ns()
    received = info["received_timestamp"]
    return int(received) if now - _OLDEST <= received <= now + _NEWEST else now
