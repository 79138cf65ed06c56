"""Lost messages of ROS 2, found by the publication sequence numbers of the middleware.

The middleware of each publisher numbers its messages one by one. A number that never comes
is a message that was lost in transport or in a queue. Unlike `header.seq` of ROS 1 these
numbers can be trusted from the first, but messages may come late. The rules:

* Numbers belong to a publisher. If messages do not name their publisher, numbers count
  only while the topic has had the same single publisher.
* The first number of a publisher starts its count: earlier messages are not lost.
* A publisher that has lost messages and disappears may have lost its last ones too. No
  number follows them, so their number is unknown.
* A gap waits for two looks at the graph before it is reported: a late message fills it.
* A number that goes back restarts the count.

Fast DDS also counts losses that leave no gap: before the first message and after the last.
It counts most gaps as well, so both counts must not be added. Its counter reports what no
gap explains. If a later gap explains it, that gap is not reported again.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Collection


MAX_GAPS = 4096
"""Maximum number of waiting gaps; beyond it the older half is reported at once."""

MAX_STEP = 1 << 32
"""A gap of this width or more has no meaningful count."""

MAX_PUBLISHERS = 1024

MOMENT_NS = 1_000_000_000
"""A publisher that has been silent for longer may stay silent."""

RECOVERED_AFTER = 10
"""Messages without a gap after which reception counts as good again."""

SUSPICIOUS_NS = 5_000_000_000
"""Maximum time from a last gap to the last message that makes further losses likely."""


class Loss(NamedTuple):
    """Lost messages of one publisher.

    Attributes:
        publisher: Its id in the middleware.
        missing: Number of messages, None if unknown.
        first: Receive time of the last message before them, ns since the epoch.
        last: Receive time of the first message after them.
        place: Their place for the user; empty for a gap.
    """

    publisher: bytes
    missing: int | None
    first: int
    last: int
    place: str = ""


class _Gap:
    """Missing numbers `[start, end)` of a publisher."""

    __slots__ = ("end", "first", "last", "looks", "publisher", "start")

    def __init__(self, publisher: bytes, start: int, end: int, first: int, last: int) -> None:
        self.publisher = publisher
        self.start = start
        self.end = end
        self.first = first
        self.last = last
        self.looks = 0


class PublicationGapDetector:
    """Finds gaps in the publication sequence numbers of one topic.

    Attributes:
        is_doubled: Two subscriptions get, or got a moment ago, the same messages. Then a
            repeated number is a repeated message.
    """

    def __init__(self) -> None:
        self.is_doubled = False
        self._last: dict[bytes, tuple[int, int]] = {}
        self._jumped: dict[bytes, tuple[int, int]] = {}
        self._gaps: list[_Gap] = []
        self._sure: dict[bytes, Loss] = {}

    def see(self, publisher: bytes, number: int, received: int) -> bool:
        """Takes the number of a message.

        Args:
            publisher: Id of its publisher.
            number: Its sequence number.
            received: Its receive time, ns since the epoch.

        Returns:
            False if the message is a repetition.
        """
        last = self._last.get(publisher)
        if last is None or number == last[0] + 1:
            self._last[publisher] = number, received
            return True
        if number > last[0]:
            self._jump(publisher, last, number, received)
            return True
        if self._fill(publisher, number):
            return True
        if self.is_doubled:
            return False
        self._last[publisher] = number, received
        return True

    def __contains__(self, publisher: bytes) -> bool:
        return publisher in self._last

    @property
    def is_empty(self) -> bool:
        """True before the first message."""
        return not self._last

    @property
    def last_received(self) -> int:
        """Receive time of the last message, ns since the epoch; 0 before the first."""
        return max((received for _, received in self._last.values()), default=0)

    @property
    def waiting(self) -> int:
        """Missing messages that `losses` has not returned yet."""
        sure = sum(loss.missing or 0 for loss in self._sure.values())
        return sure + sum(gap.end - gap.start for gap in self._gaps)

    def has_caught_up(self, since: int) -> bool:
        """Tells whether all publishers that were active just before a time have sent after it.

        Args:
            since: The time, ns since the epoch.
        """
        return not any(since - MOMENT_NS <= at < since for _, at in self._last.values())

    def suspect(self, publisher: bytes, since: int) -> Loss | None:
        """The probable loss of a publisher's last messages, None if it is unlikely.

        Args:
            publisher: A publisher that has disappeared, or whose subscription ends.
            since: Time of its end, ns since the epoch.
        """
        last = self._last.get(publisher)
        jumped = self._jumped.pop(publisher, None)
        if last is None or jumped is None or last[1] >= since:
            return None
        if last[0] - jumped[0] >= RECOVERED_AFTER or last[1] - jumped[1] > SUSPICIOUS_NS:
            return None
        return Loss(publisher, None, last[1], since, "after its last message, probably")

    def _jump(self, publisher: bytes, last: tuple[int, int], number: int, received: int) -> None:
        self._last[publisher] = number, received
        self._jumped[publisher] = number, received
        if number - last[0] > MAX_STEP:
            self._confirm(publisher, None, last[1], received)
            return
        # A message in fragments has the time of the first one, and others may come between.
        first, after = sorted((last[1], received))
        self._gaps.append(_Gap(publisher, last[0] + 1, number, first, after))
        if len(self._gaps) > MAX_GAPS:
            half = len(self._gaps) // 2
            for gap in self._gaps[:half]:
                self._confirm(gap.publisher, gap.end - gap.start, gap.first, gap.last)
            del self._gaps[:half]

    def _fill(self, publisher: bytes, number: int) -> bool:
        """Removes a late number from its waiting gap."""
        for at, gap in enumerate(self._gaps):
            if gap.publisher == publisher and gap.start <= number < gap.end:
                rest = _Gap(publisher, number + 1, gap.end, gap.first, gap.last)
                rest.looks = gap.looks
                gap.end = number
                # Messages come out of order, which need not be a loss.
                self._jumped.pop(publisher, None)
                self._gaps[at : at + 1] = [part for part in (gap, rest) if part.start < part.end]
                return True
        return False

    def _confirm(self, publisher: bytes, count: int | None, first: int, last: int) -> None:
        sure = self._sure.get(publisher)
        if sure is not None:
            count = None if count is None or sure.missing is None else count + sure.missing
            first, last = min(first, sure.first), max(last, sure.last)
        self._sure[publisher] = Loss(publisher, count, first, last)

    def losses(self, *, final: bool = False) -> list[Loss]:
        """Confirmed losses since the last call; call it at each look at the graph.

        Args:
            final: No further message follows, so gaps do not wait any longer.
        """
        waiting = []
        for gap in self._gaps:
            gap.looks += 1
            if final or gap.looks >= 2:
                self._confirm(gap.publisher, gap.end - gap.start, gap.first, gap.last)
            else:
                waiting.append(gap)
        self._gaps = waiting
        found = list(self._sure.values())
        self._sure.clear()
        return found

    def reset(self) -> None:
        """Forgets all numbers and waiting gaps."""
        self._last.clear()
        self._jumped.clear()
        self._gaps.clear()

    def retain(self, publishers: Collection[bytes]) -> None:
        """Forgets other publishers if there have been very many."""
        if len(self._last) > MAX_PUBLISHERS:
            self._last = {key: value for key, value in self._last.items() if key in publishers}
            self._jumped = {key: at for key, at in self._jumped.items() if key in publishers}


_LOOKS = 4
"""Looks at the graph that wait for a gap to explain a count."""


class MiddlewareLossCounter:
    """Counts the losses that the middleware of one subscription reports."""

    def __init__(self) -> None:
        self._counted = 0  # by the middleware
        self._gaps = 0
        self._before_first = 0
        self._unexplained = 0  # reported without a gap
        self._history = [0] * _LOOKS

    def add(self, count: int) -> None:
        """Add losses that the middleware reports."""
        self._counted += count

    def before_first(self, sent: int) -> int:
        """Take the first message of a publisher.

        Returns:
            Number of these that were lost. The others were sent before the subscription.
        """
        found = max(0, min(sent, self._counted - self._explained()))
        self._before_first += found
        return found

    def unreported(self, missing: int) -> int:
        """Take the missing messages of a gap, and return how many were not reported yet."""
        reported = min(missing, self._unexplained)
        self._unexplained -= reported
        self._gaps += missing
        return missing - reported

    def unexplained(self, waiting: int, *, final: bool) -> int:
        """Number of losses to report without a gap; call it at each look, after all gaps.

        Args:
            waiting: Missing messages in gaps that are not reported yet.
            final: No further look follows.
        """
        # A publisher may withdraw a message, which the middleware does not count as lost.
        self._counted = max(self._counted, self._explained())
        self._history = [*self._history[1:], self._counted - self._explained() - waiting]
        found = max(0, self._history[-1] if final else min(self._history))
        self._unexplained += found
        self._history = [count - found for count in self._history]
        return found

    def _explained(self) -> int:
        return self._before_first + self._gaps + self._unexplained
