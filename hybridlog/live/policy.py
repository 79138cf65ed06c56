"""Policies of a recorder: throttles, priorities, the memory budget.

A throttle limits a topic's rate at all times. Priorities decide which topics drop payloads
first when the memory budget fills, because messages come faster than the disk writes.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from typing import Final

from msgspec import Struct

from hybridlog.query.topics import TopicMatcher, matcher
from hybridlog_storage.errors import UsageError

SMALL_BYTES = 4096
"""Messages up to this payload size stay whole: reducing them saves next to nothing."""

_RATE = re.compile(r"(\d+(?:\.\d+)?)\s*(?:hz)?", re.IGNORECASE)
_HIGHEST_HZ = 1e6


WHOLE_BELOW: Final = {"low": 0.5, "normal": 0.7, "high": 0.9}
"""Shares of the budget above which large messages of a priority keep their fields only."""


class Rule(Struct, frozen=True):
    """A setting for the topics that match a pattern: a rate in Hz, or a share of the budget."""

    pattern: str
    fits: TopicMatcher
    value: float


def throttle_rule(pattern: str, rate: str) -> Rule:
    """A rule that limits topics to a rate such as `5Hz` or `0.5`.

    Raises:
        UsageError: The rate is malformed.
        TopicError: The pattern is malformed.
    """
    found = _RATE.fullmatch(rate.strip())
    hz = float(found[1]) if found else 0.0
    if not 0 < hz <= _HIGHEST_HZ:
        raise UsageError(f"{rate!r} is no rate: give messages a second, such as 5Hz.")
    return Rule(pattern, matcher([pattern]), hz)


def priority_rule(pattern: str, word: str) -> Rule:
    """A rule that gives topics the priority `low`, `normal` or `high`.

    Raises:
        UsageError: The priority is unknown.
        TopicError: The pattern is malformed.
    """
    try:
        return Rule(pattern, matcher([pattern]), WHOLE_BELOW[word.strip().lower()])
    except KeyError:
        raise UsageError(f"Unknown priority {word!r}; choose low, normal or high.") from None


def first_fit(rules: Sequence[Rule], topic: str) -> float | None:
    """The value of the first rule that matches a topic, None if none does."""
    found = [rule.value for rule in rules if rule.fits(topic)]
    return found[0] if found else None


class Throttle:
    """Limits a topic to a rate, with even intervals between messages.

    Time is the messages' receive time. A message may come a quarter of an interval early.
    Without that tolerance a jittering topic of 10 Hz gives 3.3 Hz instead of 5.
    """

    def __init__(self, hz: float) -> None:
        self._interval = math.ceil(1e9 / hz)
        self._slack = self._interval // 4
        self._due = self._reset = -2 * self._interval  # long ago: the next message passes
        self._last = 0

    def lets_through(self, received: int) -> bool:
        """Tells whether a message is stored."""
        if received < self._last - self._interval:
            self._due = self._reset  # the clock was set back
        self._last = received
        if received < self._due - self._slack:
            return False
        # The interval starts when the message was due: from its arrival the rate would sag.
        late = received - self._due
        self._due = (self._due if late < self._interval else received) + self._interval
        return True


MIN_USER_BUDGET: Final = 1 << 20
"""Smallest budget that a user may choose, bytes."""
_MIN_BUDGET, _MAX_BUDGET = 64 << 20, 2 << 30
_MACHINE_SHARE: Final = 16


def default_budget() -> int:
    """A sixteenth of the machine's memory in bytes, from 64 MiB to 2 GiB.

    It bridges some seconds of a slow disk, and leaves memory to other programs of the robot.
    """
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return min(max(memory // _MACHINE_SHARE, _MIN_BUDGET), _MAX_BUDGET)
