"""One topic and type that is recorded: its subscription, its channel, its numbers.

When a publisher comes that the subscription does not fit, a second one is made that
fits all; for a while both run, and what both get is taken once.

Runs under Python 3.10 as well, with nothing but the standard library.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from hybridlog.live_sources.ros2_middleware import publisher_id
from hybridlog.live_sources.ros2_numbers import Numbers

if TYPE_CHECKING:
    from collections.abc import Sequence

    from hybridlog.live_sources.ros2_middleware import Offer, Subscription
    from hybridlog.live_sources.ros2_numbers import Loss
    from hybridlog.live_sources.ros2_outbox import Outbox

_AT_ONCE = 1000
_BYTES_AT_ONCE = 32 << 20

_DOUBT_S = 30.0
"""So long after a subscription was made, kept messages may come that came before."""

_OLDEST = 60_000_000_000
_NEWEST = 1_000_000_000
_MAX_INT = 2**63 - 1


class Stream:
    """A stream of messages, from the middleware into the outbox.

    Args:
        subscription: Where they come from.
        channel: Number of the channel that they belong to.
        offers: The publishers that there are.

    Attributes:
        named: Messages tell their publisher; True until one does not.
        numbered: Messages have numbers; True until one does not.
        alone: The topic has had one and the same publisher since its numbers were begun.
    """

    def __init__(self, subscription: Subscription, channel: int, offers: Sequence[Offer]) -> None:
        self.subscription = subscription
        self.channel = channel
        self.named = True
        self.numbered = True
        self.alone = len(offers) == 1
        self._old: Subscription | None = None
        self._old_until = 0.0
        self._doubt_until = 0.0
        self._numbers = Numbers()
        self._publishers = frozenset(offer.publisher for offer in offers)

    @property
    def subscriptions(self) -> list[Subscription]:
        """All that are open, the older first: its messages must be taken before."""
        return [sub for sub in (self._old, self.subscription) if sub is not None]

    def replace(self, subscription: Subscription, seconds: float) -> None:
        """Goes over to another subscription.

        Args:
            subscription: The new one, open already.
            seconds: For how long the old one runs beside it. Where messages do not tell
                who sent them, or have no numbers, nobody can say which of them come
                twice: there it is closed as soon as it is empty.
        """
        self.close_old()
        self._old, self.subscription = self.subscription, subscription
        now = time.monotonic()
        tells_twice = self.named and self.numbered
        self._numbers.is_doubled = tells_twice
        self._old_until = now + seconds if tells_twice else now
        self._doubt_until = now + _DOUBT_S

    def close_old(self) -> None:
        """Closes the subscription that was gone over from."""
        if self._old is not None:
            self._old.close()
            self._old = None

    def take(self, outbox: Outbox) -> tuple[int, int]:
        """Takes what is there, but no more than others can wait for.

        Returns:
            Messages and bytes.

        Raises:
            Exception: Whatever rclpy has against a message.
        """
        if self._old is not None:
            count, size = self._take(self._old, outbox)
            if count < _AT_ONCE and time.monotonic() >= self._old_until:
                self.close_old()
            more, more_size = self._take(self.subscription, outbox)
            return count + more, size + more_size
        return self._take(self.subscription, outbox)

    def _take(self, subscription: Subscription, outbox: Outbox) -> tuple[int, int]:
        take, put, see = subscription.take, outbox.message, self._numbers.see
        channel = self.channel
        count = size = 0
        while count < _AT_ONCE and size < _BYTES_AT_ONCE:
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
                judged = self.alone and number >= 0
                kept = not judged or see(b"", number, received)
            else:
                kept = number < 0 or see(publisher_id(gid["data"]), number, received)
            if kept:
                sent = info["source_timestamp"]
                put(channel, payload, received, sent if 0 < sent <= _MAX_INT else 0, number)
        return count, size

    def _number(self, info: dict[str, Any]) -> int:
        """The publisher's number of a message, -1 when there is none."""
        number = info.get("publication_sequence_number")
        if number is None or not 0 <= number <= _MAX_INT:
            self.numbered = False
            return -1
        return int(number)

    def look(self, offers: list[Offer], *, final: bool = False) -> list[Loss]:
        """What has been lost for sure; to be called with each look at the graph.

        Args:
            offers: The publishers that there are now.
            final: There will be no other look.
        """
        if self._old is None and time.monotonic() >= self._doubt_until:
            self._numbers.is_doubled = False
        publishers = frozenset(offer.publisher for offer in offers)
        if not self.named:
            same = len(offers) == 1 and publishers == self._publishers
            if not same:
                self._numbers.begin_anew()
            self.alone = same
        self._publishers = publishers
        self._numbers.keep_only(publishers)
        return self._numbers.losses(final=final)

    def close(self) -> None:
        """Closes its subscriptions."""
        self.close_old()
        self.subscription.close()


def _received(info: dict[str, Any]) -> int:
    """When a message was received, ns since the epoch.

    Not every middleware says so, and a clock that was set makes it say nonsense: then it
    is now.
    """
    now = time.time_ns()
    received = info["received_timestamp"]
    return int(received) if now - _OLDEST <= received <= now + _NEWEST else now
