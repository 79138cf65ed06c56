"""One topic and type that is recorded: its subscription, its channel, its gaps.

When a publisher comes that the subscription does not fit, a second one is made that
fits all; for a while both run, and what both get is taken once.

Runs under Python 3.10 as well, with nothing but the standard library.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from hybridlog.live.sources.ros2.child.middleware import publisher_id
from hybridlog.live.sources.ros2.child.middleware_losses import MiddlewareLossCounter
from hybridlog.live.sources.ros2.child.publication_gaps import Loss, PublicationGapDetector
from hybridlog.live.sources.ros2.child.qos import RELIABLE

if TYPE_CHECKING:
    from collections.abc import Sequence

    from hybridlog.live.sources.ros2.child.middleware import Offer, Subscription
    from hybridlog.live.sources.ros2.child.outbox import Outbox

_AT_ONCE = 1000
_BYTES_AT_ONCE = 8 << 20

_DOUBT_S = 30.0
"""So long after a subscription was made, kept messages may come that came before."""

_REPAIR_NS = 4_000_000_000
"""So long after its last message a reliable publisher has said how many there were.

Fast DDS says so every three seconds.
"""

_SAYS = "the middleware says so"
_HEAD = "before the first message that came"
_BEYOND = "before the first message that came or after the last, as the middleware says"

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
        numbered: Messages have gaps; True until one does not.
        alone: The topic has had one and the same publisher since its gaps were begun.
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
        self._gaps = PublicationGapDetector()
        self._middleware_losses = MiddlewareLossCounter()
        self._heads: list[Loss] = []
        self._publishers = frozenset(offer.publisher for offer in offers)
        self._reliable = _reliable(offers)

    @property
    def subscriptions(self) -> list[Subscription]:
        """All that are open, the older first: its messages must be taken before."""
        return [sub for sub in (self._old, self.subscription) if sub is not None]

    def replace(self, subscription: Subscription, seconds: float) -> None:
        """Goes over to another subscription.

        Args:
            subscription: The new one, open already.
            seconds: For how long the old one runs beside it. Where messages do not tell
                who sent them, or have no gaps, nobody can say which of them come
                twice: there it is closed as soon as it is empty.
        """
        self.close_old()
        self._hear()
        self._old, self.subscription = self.subscription, subscription
        now = time.monotonic()
        tells_twice = self.named and self.numbered
        self._gaps.is_doubled = tells_twice
        self._old_until = now + seconds if tells_twice else now
        self._doubt_until = now + _DOUBT_S

    def close_old(self) -> None:
        """Closes the subscription that was gone over from."""
        if self._old is not None:
            self._hear()
            self._old.close()
            self._old = None

    def _hear(self) -> int:
        """Hears what the middleware says it has lost; how many since the last call."""
        told = self.subscription.losses()
        # What two subscriptions have lost may have come through the other one.
        if self._old is None and self.subscription.tells_all:
            self._middleware_losses.add(told)
        return told

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
        take, put, gaps = subscription.take, outbox.message, self._gaps
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
                publisher, judged = b"", self.alone and number >= 0
            else:
                publisher, judged = publisher_id(gid["data"]), number >= 0
            if judged and publisher not in gaps:
                self._begin(publisher, number, received)
            if not judged or gaps.see(publisher, number, received):
                sent = info["source_timestamp"]
                put(channel, payload, received, sent if 0 < sent <= _MAX_INT else 0, number)
        return count, size

    def _begin(self, publisher: bytes, number: int, received: int) -> None:
        """Looks for losses before the first message of a publisher."""
        self._hear()
        if number > 1 and self._gaps.is_empty:
            lost = self._middleware_losses.before_first(number - 1)
            if lost:
                self._heads.append(Loss(publisher, lost, received, received, _HEAD))

    def _number(self, info: dict[str, Any]) -> int:
        """The publisher's number of a message, -1 when there is none."""
        number = info.get("publication_sequence_number")
        if number is None or not 0 <= number <= _MAX_INT:
            self.numbered = False
            return -1
        return int(number)

    def has_caught_up(self, since: int) -> bool:
        """Whether all publishers that spoke a moment before a time have spoken after it."""
        return self._gaps.has_caught_up(since)

    def look(self, offers: list[Offer], *, final: int | None = None) -> list[Loss]:
        """What has been lost for sure; to be called with each look at the graph.

        Args:
            offers: The publishers that there are now.
            final: When listening ended, ns since the epoch; None when it goes on.
        """
        now = time.time_ns()
        told = self._hear()
        if self.numbered:
            losses = self._losses(offers, now, final)
        else:
            losses = [Loss(b"", told, now, now, _SAYS)] if told else []
        self._follow(offers)
        return losses

    def _losses(self, offers: list[Offer], now: int, final: int | None) -> list[Loss]:
        """What the gaps show, and what the middleware knows besides."""
        gaps, is_final = self._gaps, final is not None
        losses, self._heads = self._heads, []
        losses += self._suspects(offers, now if final is None else final, is_final=is_final)
        for gap in gaps.losses(final=is_final):
            missing = (
                None if gap.missing is None else self._middleware_losses.unreported(gap.missing)
            )
            if missing != 0:
                losses.append(gap._replace(missing=missing))
        beyond = self._middleware_losses.unexplained(gaps.waiting, final=is_final)
        if beyond:
            first = min(now, gaps.last_received or now)
            # Gaps are looked for where it is known whose they are.
            place = _BEYOND if self.named or self.alone else _SAYS
            losses.append(Loss(b"", beyond, first, now, place))
        return losses

    def _suspects(self, offers: list[Offer], silent: int, *, is_final: bool) -> list[Loss]:
        """Losses of unknown number behind the last messages of those that have gone.

        Args:
            offers: The publishers that there are now.
            silent: Since when the others are not heard any more, ns since the epoch.
            is_final: None of them is.
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
        """Follows a change of publishers."""
        if self._old is None and time.monotonic() >= self._doubt_until:
            self._gaps.is_doubled = False
        publishers = frozenset(offer.publisher for offer in offers)
        if not self.named:
            same = len(offers) == 1 and publishers == self._publishers
            if not same:
                self._gaps.reset()
            self.alone = same
        self._publishers = publishers
        self._reliable = _reliable(offers)
        self._gaps.keep_only(publishers)

    def close(self) -> None:
        """Closes its subscriptions."""
        self.close_old()
        self.subscription.close()


def _reliable(offers: Sequence[Offer]) -> frozenset[bytes]:
    """Publishers that repeat what is lost, and say what they cannot repeat."""
    return frozenset(o.publisher for o in offers if o.profile.reliability == RELIABLE)


def _received(info: dict[str, Any]) -> int:
    """When a message was received, ns since the epoch.

    Not every middleware says so, and a clock that was set makes it say nonsense: then it
    is now.
    """
    now = time.time_ns()
    received = info["received_timestamp"]
    return int(received) if now - _OLDEST <= received <= now + _NEWEST else now
