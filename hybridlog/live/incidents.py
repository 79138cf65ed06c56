"""Marks that a recorder sets: of triggers and signals, of silences, of a clock that was set.

A hit of a trigger or signal is an incident: a mark and a pin of the same time in the recording's
manifest. Hits of one name whose times touch are one incident.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final

from msgspec.structs import replace

from hybridlog.query.times import format_duration, format_time
from hybridlog.record.marks import CONTRACT
from hybridlog_storage.manifest import Manifest, Mark, Pin, new_random, with_mark

if TYPE_CHECKING:
    from hybridlog.contract import Contract

PINNED: Final = "is marked and pinned"
RULE: Final = "longest_gap"
_HIT: Final = "trigger"
"""The tag of a mark that has a pin."""


class Incidents:
    """Marks and pins that wait to be written. Thread safe; only `write` waits for the disk.

    `first` returns the least log time of the recording, None without messages.
    """

    def __init__(
        self,
        change: Callable[[Callable[[Manifest], Manifest]], Manifest],
        first: Callable[[], int | None],
        say: Callable[[str], None],
    ) -> None:
        self.count = 0
        self._change, self._first, self._say = change, first, say
        self._hits: dict[str, Mark] = {}  # the last one, by text
        self._new: dict[str, Mark] = {}  # by id
        self._written: set[str] = set()  # ids
        self._lock = threading.Lock()
        self._writing = threading.Lock()

    def hit(self, text: str, begin: int, end: int) -> None:
        """Mark and pin what lies between two log times, ns, soon."""
        with self._lock:
            begin, last = max(begin, 0), self._hits.get(text)
            if last is not None and last.time <= end and begin <= (last.end or 0):
                begin, end = min(last.time, begin), max(last.end or 0, end)
                made = replace(last, time=begin, end=end)
            else:
                made = Mark(new_random(), begin, text, {_HIT: text}, end)
                self.count += 1
            self._hits[text] = self._new[made.id] = made

    def note(self, mark: Mark) -> bool:
        """Set a mark soon; with the same id again it has another end, and False is returned."""
        with self._lock:
            is_new = mark.id not in self._new and mark.id not in self._written
            self._new[mark.id] = mark
        return is_new

    def write(self) -> bool:
        """Mark and pin all so far; returns whether there was anything new.

        Raises:
            StoreError: The manifest cannot be written.
        """
        with self._writing:
            first = self._first()
            with self._lock:  # a note alone makes no recording
                new = {k: m for k, m in self._new.items() if first is not None or _HIT in m.tags}
            if not new:
                return False
            pins = {
                key: Pin(key, mark.time, mark.end, reason=mark.text)
                for key, mark in new.items()
                if _HIT in mark.tags
            }
            marks = {key: _within(mark, first) for key, mark in new.items()}

            def how(now: Manifest) -> Manifest:
                known = {mark.id: marks.get(mark.id, mark) for mark in now.marks}
                before = {pin.id: pin for pin in now.pins}
                now = replace(now, pins=(*(before | pins).values(),), marks=(*known.values(),))
                for key in marks.keys() - known.keys() - self._written:
                    now = with_mark(now, marks[key])
                return now

            self._change(how)
            fresh = pins.keys() - self._written
            self._written.update(marks)
            with self._lock:
                self._new = {k: mark for k, mark in self._new.items() if new.get(k) != mark}
        for mark in (mark for key, mark in marks.items() if key in fresh):
            self._say(f"{mark.text!r} {PINNED} from {format_time(mark.time)} on")
        return True


def _within(mark: Mark, first: int | None) -> Mark:
    """A mark from before the first message would become the beginning of the recording."""
    begin = max(mark.time, 0, mark.time if first is None else first)
    return replace(mark, time=begin if mark.end is None else min(begin, mark.end))


class SilenceWatch:
    """Follows the topics that have a longest gap in a contract. Thread safe.

    A silence is a time between messages of a topic, or to the end, that is longer than its limit:
    a mark, without end while it lasts. It is measured by times that nobody sets, beside log times;
    all in ns.
    """

    def __init__(self, contract: Contract | None) -> None:
        rules = {} if contract is None else contract.topics
        self._limits = {n: r.longest_gap for n, r in rules.items() if r.longest_gap is not None}
        self._optional = {name for name, rule in rules.items() if rule.optional}
        self._begin: tuple[int, int] | None = None
        self._last: dict[str, tuple[int, int]] = {}  # time and log time of the last message
        self._lasting: dict[str, Mark] = {}  # by topic
        self._over: list[Mark] = []
        self._lock = threading.Lock()
        self.breaches = 0

    def take(self, topic: str, time: int, log_time: int) -> None:
        """A message was stored."""
        limit = self._limits.get(topic)
        if limit is None and self._begin is not None:
            return
        with self._lock:
            if self._begin is None:
                self._begin = time, log_time
                self._last = dict.fromkeys(self._limits.keys() - self._optional, self._begin)
            if limit is None:
                return
            last = self._last.get(topic, self._begin)
            if time - last[0] > limit:
                self._over.append(_ended(self._lasts(topic, last[1]), log_time))
                del self._lasting[topic]
            self._last[topic] = max(last, (time, log_time))

    def _lasts(self, topic: str, begin: int) -> Mark:
        """The silence of a topic, which may have begun just now; its length may grow."""
        if topic not in self._lasting:
            self.breaches += 1
            limit = format_duration(self._limits[topic])
            text = f"{topic}: no message for more than {limit}"
            tags = {"cause": CONTRACT, "rule": RULE, "topic": topic}
            self._lasting[topic] = Mark(new_random(), begin, text, tags)
        return self._lasting[topic]

    def look(self, now: int, ended_at: int | None = None) -> list[Mark]:
        """Silences that have begun since the last look, or ended, those at the end included.

        `ended_at` is the log time at which the recording ends, and with it all silences.
        """
        with self._lock:
            found, self._over = self._over, []
            for topic, (last, log_time) in self._last.items():
                if last > now:  # a simulated clock went back
                    self._last[topic] = now, log_time
                elif now - last > self._limits[topic] and topic not in self._lasting:
                    found.append(self._lasts(topic, log_time))
            if ended_at is not None:
                found += [_ended(one, ended_at) for one in self._lasting.values()]
        return found

    @property
    def silent(self) -> Sequence[str]:
        """Topics that are silent, as of the last look."""
        return sorted(self._lasting)


def _ended(silence: Mark, at: int) -> Mark:
    return replace(silence, end=max(silence.time, at))
