"""Gaps in the numbers that publishers give their messages.

A publisher numbers what it sends, one by one. A number that never comes is a message
that was lost on the way, or between the middleware's queue and us. The rules, which
accuse nobody wrongly:

* Numbers are told apart by publisher. Where the middleware does not name the publisher
  of a message, they are judged only while the topic has had one and the same publisher.
* The first number of a publisher is where its count begins, whatever it is: what was
  sent before we listened is not lost.
* A publisher that loses messages and goes may have lost its last ones too. No number
  follows them, so how many is not known.
* A gap waits for two looks at the graph before it is told of: a late message fills it.
* A number that falls back is a count that begins anew.

Runs under Python 3.10 as well, with nothing but the standard library.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Collection

MAX_GAPS = 4096
"""Gaps that wait; when there are more, the older half is told of at once."""

MAX_STEP = 1 << 32
"""A jump from here on is no loss that anyone could count."""

MAX_PUBLISHERS = 1024

MOMENT_NS = 1_000_000_000
"""Who has been silent for longer may be silent for long."""

WELL = 10
"""Messages without a gap after which a publisher is taken to be heard well again."""

SUSPICIOUS_NS = 5_000_000_000
"""Between a publisher's last gap and its last message, when more may be missing."""


class Loss(NamedTuple):
    """Messages of one publisher that never came.

    Attributes:
        publisher: Its id, as the middleware spells it.
        missing: How many, None when its numbers make no sense.
        first: When the last one before them was received, ns since the epoch.
        last: When the first one after them was received.
        place: Where they were, for people; empty for a gap.
    """

    publisher: bytes
    missing: int | None
    first: int
    last: int
    place: str = ""


class _Gap:
    """PublicationGapDetector `[start, end)` of a publisher that have not come."""

    __slots__ = ("end", "first", "last", "looks", "publisher", "start")

    def __init__(self, publisher: bytes, start: int, end: int, first: int, last: int) -> None:
        self.publisher = publisher
        self.start = start
        self.end = end
        self.first = first
        self.last = last
        self.looks = 0


class PublicationGapDetector:
    """The numbers of one topic.

    Attributes:
        is_doubled: Two subscriptions get the same messages, or did a moment ago, so a
            number that has been seen is a message that has been taken.
    """

    def __init__(self) -> None:
        self.is_doubled = False
        self._last: dict[bytes, tuple[int, int]] = {}
        self._jumped: dict[bytes, tuple[int, int]] = {}
        self._gaps: list[_Gap] = []
        self._sure: dict[bytes, Loss] = {}

    def see(self, publisher: bytes, number: int, received: int) -> bool:
        """Notes a message.

        Args:
            publisher: Who sent it, `in` these numbers when it has been heard before.
            number: The publisher's number.
            received: When, ns since the epoch.

        Returns:
            Whether it is to be kept; False when it has been seen before.
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
        """Whether nobody has been heard since they were begun."""
        return not self._last

    @property
    def last_received(self) -> int:
        """When the last message was received, ns since the epoch; 0 when there was none."""
        return max((received for _, received in self._last.values()), default=0)

    @property
    def waiting(self) -> int:
        """How many are missing that `losses` has not told of."""
        sure = sum(loss.missing or 0 for loss in self._sure.values())
        return sure + sum(gap.end - gap.start for gap in self._gaps)

    def has_caught_up(self, since: int) -> bool:
        """Whether all who spoke a moment ago have spoken after a time.

        Args:
            since: ns since the epoch.
        """
        return not any(since - MOMENT_NS <= at < since for _, at in self._last.values())

    def suspect(self, publisher: bytes, since: int) -> Loss | None:
        """A publisher's loss of its last messages, if that is to be feared.

        Args:
            publisher: It has gone, or nobody listens any more.
            since: From when on it does not matter any more, ns since the epoch.
        """
        last = self._last.get(publisher)
        jumped = self._jumped.pop(publisher, None)
        if last is None or jumped is None or last[1] >= since:
            return None
        if last[0] - jumped[0] >= WELL or last[1] - jumped[1] > SUSPICIOUS_NS:
            return None
        return Loss(publisher, None, last[1], since, "after its last message, after others")

    def _jump(self, publisher: bytes, last: tuple[int, int], number: int, received: int) -> None:
        self._last[publisher] = number, received
        self._jumped[publisher] = number, received
        if number - last[0] > MAX_STEP:
            self._confirm(publisher, None, last[1], received)
            return
        # What came in pieces has the time of its first one, and others may be between.
        first, after = sorted((last[1], received))
        self._gaps.append(_Gap(publisher, last[0] + 1, number, first, after))
        if len(self._gaps) > MAX_GAPS:
            half = len(self._gaps) // 2
            for gap in self._gaps[:half]:
                self._confirm(gap.publisher, gap.end - gap.start, gap.first, gap.last)
            del self._gaps[:half]

    def _fill(self, publisher: bytes, number: int) -> bool:
        """Takes a late number out of the gap that waits for it."""
        for at, gap in enumerate(self._gaps):
            if gap.publisher == publisher and gap.start <= number < gap.end:
                rest = _Gap(publisher, number + 1, gap.end, gap.first, gap.last)
                rest.looks = gap.looks
                gap.end = number
                # It speaks out of order, which need not be a loss.
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
        """What is lost for sure since the last call; to be called at each look.

        Args:
            final: Nothing more will come: gaps do not wait any longer.
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
        """Forgets all numbers, and the gaps that nobody can be sure of any more."""
        self._last.clear()
        self._jumped.clear()
        self._gaps.clear()

    def keep_only(self, publishers: Collection[bytes]) -> None:
        """Forgets publishers that have gone, when there have been very many."""
        if len(self._last) > MAX_PUBLISHERS:
            self._last = {key: value for key, value in self._last.items() if key in publishers}
            self._jumped = {key: at for key, at in self._jumped.items() if key in publishers}
