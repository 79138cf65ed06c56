"""Tells topics that are silent for longer than a contract allows, while they are recorded."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

from hybridlog.query.times import format_duration
from hybridlog_storage.manifest import new_random

if TYPE_CHECKING:
    from hybridlog.contract import Contract

RULE: Final = "longest_gap"
_MAX_INTERVAL_S: Final = 0.5


class Silence(NamedTuple):
    """A time from message to message of a topic that is longer than its limit, ns."""

    topic: str
    begin: int
    end: int
    limit: int

    @property
    def text(self) -> str:
        """The silence in words, without its length, which may grow."""
        return f"{self.topic}: no message for more than {format_duration(self.limit)}"


Note: TypeAlias = Callable[[Silence, str, bool], None]
"""Called with a silence that has begun, the id of its mark, and False; with True at its end."""


class SilenceWatch:
    """Follows the topics that have a longest gap in a contract. Thread safe.

    Its times are steady ones, so that a clock that is set is no silence.
    """

    def __init__(self, contract: Contract | None, now: Callable[[], int], note: Note) -> None:
        rules = [] if contract is None else contract.topics.items()
        self._limits = {n: r.longest_gap for n, r in rules if r.longest_gap is not None}
        self._optional = {name for name, rule in rules if rule.optional}
        self._now = now
        self._note = note
        self._last: dict[str, int] = {}
        self._begin: int | None = None
        self._looked = 0
        self._noted: dict[str, str] = {}  # ids of marks, by topics that are silent
        self._over: list[Silence] = []
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self.breaches = 0
        shortest = min(self._limits.values(), default=0) / 1e9
        # So that a silence is told within twice its limit.
        self.interval_s = max(min(shortest / 4, _MAX_INTERVAL_S), 1e-3)

    def start(self) -> None:
        """Look in a thread, if there are topics."""
        if self._limits:
            self._thread.start()

    def stop(self, ended_at: int) -> None:
        """End all silences when the recording ended, ns."""
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join()
        self.look(ended_at, is_end=True)

    def _run(self) -> None:
        while not self._ended.wait(self.interval_s):
            self.look(self._now())

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

    def look(self, now: int, *, is_end: bool = False) -> None:
        """Note the silences that have begun since the last look, and those that have ended.

        Args:
            now: The present time, ns.
            is_end: True if the recording ends now, and with it all silences.
        """
        with self._lock:
            over, self._over = self._over, []
            if now < self._looked:
                self._last = {topic: min(last, now) for topic, last in self._last.items()}
            self._looked = now
            lasting = [
                Silence(topic, last, now, self._limits[topic])
                for topic, last in self._last.items()
                if now - last > self._limits[topic]
            ]
        for one in over:
            self._note(one, self._mark_of(one), True)
            del self._noted[one.topic]
        for one in lasting:
            mark = self._mark_of(one)
            if is_end:
                self._note(one, mark, True)

    def _mark_of(self, one: Silence) -> str:
        """The id of its mark; notes that it has begun, if that is new."""
        if one.topic not in self._noted:
            self.breaches += 1
            self._noted[one.topic] = new_random()
            self._note(one, self._noted[one.topic], False)
        return self._noted[one.topic]

    @property
    def silent(self) -> Sequence[str]:
        """Topics that are silent, as of the last look."""
        return sorted(self._noted)
