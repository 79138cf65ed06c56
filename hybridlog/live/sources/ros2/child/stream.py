"""The messages of one recorded topic and type: subscription, channel, lost messages.

A new publisher may be incompatible with the subscription. Then a second subscription is
made that is compatible with all. For a while both run, and repeated messages are dropped.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from hybridlog.live.sources.ros2.child.middleware import publisher_id
from hybridlog.live.sources.ros2.child.publication_gaps import (
    MAX_PUBLISHERS,
    Loss,
    MiddlewareLossCounter,
    PublicationGapDetector,
)
from hybridlog.live.sources.ros2.child.qos import RELIABLE

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from hybridlog.live.sources.ros2.child.middleware import Offer, Subscription
    from hybridlog.live.sources.ros2.child.outbox import Outbox

_MAX_MESSAGES = 1000
_BYTES_AT_ONCE = 8 << 20

_UNSURE_S = 30.0
"""Time after a new subscription in which durable messages may come again, seconds."""

_REPAIR_NS = 4_000_000_000
"""Time in which a reliable publisher announces the number of its messages, ns.

Fast DDS does so every three seconds.
"""

_COUNTED = "as the middleware counts"
_HEAD = "before the first message that came"
_OUTSIDE = "before the first message that came or after the last, as the middleware counts"

_OLDEST = 60_000_000_000
_NEWEST = 1_000_000_000
_MAX_INT = 2**63 - 1


class Stream:
    """Moves the messages of a topic from the middleware into the outbox.

    Args:
        subscription: The subscription.
        channel: Number of the channel.
        offers: The present publishers.
        look_again: Updates `channels`: a publisher is not among them.

    Attributes:
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
        self._old: Subscription | None = None
        self._old_until = 0.0
        self._unsure_until = 0.0
        self._gaps = PublicationGapDetector()
        self._middleware_losses = MiddlewareLossCounter()
        self._heads: list[Loss] = []
        self._publishers = frozenset(offer.publisher for offer in offers)
        self._reliable = _reliable(offers)

    @property
    def subscriptions(self) -> list[Subscription]:
        """Open subscriptions, the older one first: its messages are taken first."""
        return [sub for sub in (self._old, self.subscription) if sub is not None]

    def replace(self, subscription: Subscription, seconds: float) -> None:
        """Changes to another subscription.

        Args:
            subscription: The new, open subscription.
            seconds: Time for which the old one runs beside it. If messages lack publisher
                or number, repetitions cannot be detected; then the old one is closed as
                soon as it is empty.
        """
        self.close_old()
        self._count_losses()
        self._old, self.subscription = self.subscription, subscription
        now = time.monotonic()
        tells_twice = self.named and self.numbered
        self._gaps.is_doubled = tells_twice
        self._old_until = now + seconds if tells_twice else now
        self._unsure_until = now + _UNSURE_S

    def close_old(self) -> None:
        """Closes the old subscription."""
        if self._old is not None:
            self._count_losses()
            self._old.close()
            self._old = None

    def _count_losses(self) -> int:
        """Adds the losses that the middleware counts; returns those since the last call."""
        counted = self.subscription.losses()
        # A message that one of two subscriptions lost may have come through the other.
        if self._old is None and self.subscription.tells_all:
            self._middleware_losses.add(counted)
        return counted

    def take(self, outbox: Outbox) -> tuple[int, int]:
        """Takes available messages, up to a limit for the sake of other topics.

        Returns:
            Number of messages and bytes.

        Raises:
            Exception: Any error of rclpy.
        """
        if self._old is not None:
            count, size = self._take(self._old, outbox)
            if count < _MAX_MESSAGES and time.monotonic() >= self._old_until:
                self.close_old()
            more, more_size = self._take(self.subscription, outbox)
            return count + more, size + more_size
        return self._take(self.subscription, outbox)

    def _take(self, subscription: Subscription, outbox: Outbox) -> tuple[int, int]:
        take, put, gaps = subscription.take, outbox.message, self._gaps
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
            if is_usable and publisher not in gaps:
                self._begin(publisher, number, received)
            if not is_usable or gaps.see(publisher, number, received):
                sent = info["source_timestamp"]
                put(channel, payload, received, sent if 0 < sent <= _MAX_INT else 0, number)
        return count, size

    def _meet(self, publisher: bytes) -> int:
        """The channel of a publisher that came after the last look at the graph."""
        if publisher not in self._looked_for:
            if len(self._looked_for) >= MAX_PUBLISHERS:
                self._looked_for.clear()
            self._looked_for.add(publisher)
            self._look_again()
        return self.channels.get(publisher, self.channel)

    def _begin(self, publisher: bytes, number: int, received: int) -> None:
        """Counts losses before the first message of a publisher."""
        self._count_losses()
        if number > 1 and self._gaps.is_empty:
            lost = self._middleware_losses.before_first(number - 1)
            if lost:
                self._heads.append(Loss(publisher, lost, received, received, _HEAD))

    def _number(self, info: dict[str, Any]) -> int:
        """The sequence number of a message, -1 without one."""
        number = info.get("publication_sequence_number")
        if number is None or not 0 <= number <= _MAX_INT:
            self.numbered = False
            return -1
        return int(number)

    def has_caught_up(self, since: int) -> bool:
        """Tells whether all publishers that were active just before a time have sent after it."""
        return self._gaps.has_caught_up(since)

    def look(self, offers: list[Offer], *, final: int | None = None) -> list[Loss]:
        """Confirmed losses since the last call; call it at each look at the graph.

        Args:
            offers: The present publishers.
            final: End of the recording, ns since the epoch; None while it goes on.
        """
        now = time.time_ns()
        counted = self._count_losses()
        if self.numbered:
            losses = self._losses(offers, now, final)
        else:
            losses = [Loss(b"", counted, now, now, _COUNTED)] if counted else []
        self._follow(offers)
        return losses

    def _losses(self, offers: list[Offer], now: int, final: int | None) -> list[Loss]:
        """Losses that the numbers show, and others that the middleware counts."""
        gaps, is_final = self._gaps, final is not None
        losses, self._heads = self._heads, []
        losses += self._suspects(offers, now if final is None else final, is_final=is_final)
        for gap in gaps.losses(final=is_final):
            missing = (
                None if gap.missing is None else self._middleware_losses.unreported(gap.missing)
            )
            if missing != 0:
                losses.append(gap._replace(missing=missing))
        unexplained = self._middleware_losses.unexplained(gaps.waiting, final=is_final)
        if unexplained:
            first = min(now, gaps.last_received or now)
            # Gaps are found only if the publisher of messages is known.
            place = _OUTSIDE if self.named or self.alone else _COUNTED
            losses.append(Loss(b"", unexplained, first, now, place))
        return losses

    def _suspects(self, offers: list[Offer], silent: int, *, is_final: bool) -> list[Loss]:
        """Probable losses after the last messages of publishers that have disappeared.

        Args:
            offers: The present publishers.
            silent: Time of their end, ns since the epoch.
            is_final: The subscription ends, so all publishers count as gone.
        """
        gaps = self._gaps
        present = {offer.publisher for offer in offers}
        if not self.named:
            gone = [b""] if self.alone and (is_final or not present) else []
        else:
            gone = list(self._publishers | present if is_final else self._publishers - present)
        found = []
        for publisher in gone:
            loss = gaps.suspect(publisher, silent)
            repaired = publisher in self._reliable or (not publisher and self._reliable)
            if loss and not (repaired and silent - loss.first > _REPAIR_NS):
                found.append(loss)
        return found

    def _follow(self, offers: list[Offer]) -> None:
        """Updates the publishers."""
        if self._old is None and time.monotonic() >= self._unsure_until:
            self._gaps.is_doubled = False
        publishers = frozenset(offer.publisher for offer in offers)
        if not self.named:
            same = len(offers) == 1 and publishers == self._publishers
            if not same:
                self._gaps.reset()
            self.alone = same
        self._publishers = publishers
        self._reliable = _reliable(offers)
        self._gaps.retain(publishers)

    def close(self) -> None:
        """Closes the subscriptions."""
        self.close_old()
        self.subscription.close()


def _reliable(offers: Sequence[Offer]) -> frozenset[bytes]:
    """Reliable publishers, which repeat lost messages or announce them as lost."""
    return frozenset(o.publisher for o in offers if o.profile.reliability == RELIABLE)


def _received(info: dict[str, Any]) -> int:
    """Receive time of a message, ns since the epoch.

    It is the present if the middleware does not provide it or the clock was set.
    """
    now = time.time_ns()
    received = info["received_timestamp"]
    return int(received) if now - _OLDEST <= received <= now + _NEWEST else now
