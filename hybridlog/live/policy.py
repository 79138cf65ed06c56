"""What to keep when not everything can be kept, or is wanted.

A throttle thins a topic out at all times. Priorities say who gives up payloads first when
the memory budget fills, which happens when more comes than the disk takes.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

from hybridlog.query.topics import TopicMatcher, matcher
from hybridlog_storage.errors import UsageError

SMALL = 4096
"""Payload bytes up to which a message is never reduced: that would save next to nothing."""

EVERY = 5
"""Of the payloads of a topic that is thinned out, one in so many is kept."""

_RATE = re.compile(r"(\d+(?:\.\d+)?)\s*(?:hz)?", re.IGNORECASE)
_HIGHEST_HZ = 1e6


class Priority(IntEnum):
    """How long a topic keeps its payloads while the memory budget fills."""

    LOW = 0
    NORMAL = 1
    HIGH = 2


class Keep(IntEnum):
    """What is kept of a message."""

    ALL = 0
    EVERY_NTH = 1
    FIELDS = 2


# Share of the budget from which each priority keeps one payload in `EVERY`, then none.
_STEPS = {
    Priority.LOW: (0.50, 0.70),
    Priority.NORMAL: (0.70, 0.85),
    Priority.HIGH: (0.85, 0.95),
}


def step(priority: Priority, filled: float) -> Keep:
    """What is kept of large messages of a priority.

    Args:
        priority: Their topic's.
        filled: Share of the memory budget that is spent.
    """
    thin, none = _STEPS[priority]
    if filled < thin:
        return Keep.ALL
    return Keep.EVERY_NTH if filled < none else Keep.FIELDS


@dataclass(frozen=True, slots=True)
class Rule:
    """Something that holds for topics that fit a pattern.

    Attributes:
        pattern: As the user wrote it.
        fits: Says whether a topic fits.
        value: What holds.
    """

    pattern: str
    fits: TopicMatcher
    value: float


def throttle_rule(pattern: str, rate: str) -> Rule:
    """At most so many messages a second, as `5Hz`, `0.5`.

    Raises:
        UsageError: It is no rate.
        TopicError: The pattern is malformed.
    """
    found = _RATE.fullmatch(rate.strip())
    hz = float(found[1]) if found else 0.0
    if not 0 < hz <= _HIGHEST_HZ:
        raise UsageError(f"{rate!r} is no rate: write how many messages a second, such as 5Hz.")
    return Rule(pattern, matcher([pattern]), hz)


def priority_rule(pattern: str, word: str) -> Rule:
    """`low`, `normal` or `high` for topics that fit.

    Raises:
        UsageError: Another word.
        TopicError: The pattern is malformed.
    """
    try:
        return Rule(pattern, matcher([pattern]), Priority[word.strip().upper()])
    except KeyError:
        raise UsageError(f"{word!r} is no priority: low, normal and high there are.") from None


def first_fit(rules: Sequence[Rule], topic: str) -> float | None:
    """The value of the first rule that a topic fits, None when it fits none."""
    found = [rule.value for rule in rules if rule.fits(topic)]
    return found[0] if found else None


class Throttle:
    """Lets through at most so many messages a second, evenly.

    The time is the messages' own receive time. A message may come half an interval early,
    so that a topic of 10 Hz that jitters gives 5 Hz, and not 3.3.

    Args:
        hz: How many.
    """

    def __init__(self, hz: float) -> None:
        self._interval = math.ceil(1e9 / hz)
        self._slack = self._interval // 4
        self._due = self._anew = -2 * self._interval  # long ago: the next one is kept
        self._last = 0

    def lets_through(self, received: int) -> bool:
        """Whether a message is kept.

        Args:
            received: When it came, ns since the epoch.
        """
        if received < self._last - self._interval:
            self._due = self._anew  # the clock was set back
        self._last = received
        if received < self._due - self._slack:
            return False
        # From when it was due, not from when it came, or the rate would sag.
        late = received - self._due
        self._due = (self._due if late < self._interval else received) + self._interval
        return True
