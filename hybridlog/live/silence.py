"""Tells topics that are silent for longer than a contract allows, while they are recorded."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final, NamedTuple

from hybridlog.query.times import format_duration

if TYPE_CHECKING:
    from hybridlog.contract import Contract

RULE: Final = "longest_gap"
_MAX_INTERVAL_S: Final = 0.5


class Silence(NamedTuple):
    """A time without a message of a topic that is longer than its rule allows.

    Attributes:
        topic: Full name.
        begin: Time of the last message before it, or the beginning of the recording, ns.
        end: Time of the next message, or the end of the recording, ns.
        limit: The longest time that is allowed, ns.
    """

    topic: str
    begin: int
    end: int
    limit: int

    @property
    def text(self) -> str:
        """The silence in words, without its length, which may grow."""
        return f"{self.topic}: no message for more than {format_duration(self.limit)}"


class SilenceWatch:
    """Follows the topics that have a longest gap in a contract. Thread safe.

    Its times are steady ones, so that a clock that is set is no silence.
    """

    def __init__(self, contract: Contract) -> None:
        rules = contract.topics.items()
        self._limits = {n: r.longest_gap for n, r in rules if r.longest_gap is not None}
        self._optional = {name for name, rule in rules if rule.optional}
        self._last: dict[str, int] = {}
        self._begin: int | None = None
        self._now = 0
        self._reported: set[str] = set()
        self._over: list[Silence] = []
        self._lock = threading.Lock()
        shortest = min(self._limits.values(), default=0) / 1e9
        self.interval_s = max(min(shortest / 4, _MAX_INTERVAL_S), 1e-3)
        """Seconds between two looks, so that a silence is told within twice its limit."""

    def take(self, topic: str, time: int) -> None:
        """A message was stored, at a time, ns."""
        limit = self._limits.get(topic)
        if limit is None and self._begin is not None:
            return
        with self._lock:
            if self._begin is None:
                self._begin = time
                self._last = dict.fromkeys(self._limits.keys() - self._optional, time)
            if limit is None:
                return
            last = self._last.get(topic, self._begin)
            if time - last > limit:
                self._over.append(Silence(topic, last, time, limit))
            self._last[topic] = max(last, time)

    def look(self, now: int, *, is_end: bool = False) -> tuple[list[Silence], list[Silence]]:
        """The silences that have begun since the last look, and those that have ended.

        Args:
            now: Current time, ns. A simulation may begin again with an earlier one.
            is_end: True if the recording ends now, and with it all silences.
        """
        with self._lock:
            over, self._over = self._over, []
            if now < self._now:
                self._last = {topic: min(last, now) for topic, last in self._last.items()}
            self._now = now
            lasting = [
                Silence(topic, last, now, self._limits[topic])
                for topic, last in self._last.items()
                if now - last > self._limits[topic]
            ]
        begun = []
        for one in over:
            if one.topic in self._reported:
                self._reported.remove(one.topic)
            else:
                begun.append(one)
        begun += [one for one in lasting if one.topic not in self._reported]
        self._reported.update(one.topic for one in lasting)
        return begun, over + lasting if is_end else over

    @property
    def silent(self) -> Sequence[str]:
        """Topics that are silent, as of the last look."""
        return sorted(self._reported)
