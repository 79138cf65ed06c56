"""Marks that a recorder sets: of triggers and signals, of silences, of a clock that was set.

A hit of a trigger or signal is an incident: a mark and a pin of the same time in the recording's
manifest. Hits of one name whose times touch are one incident.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

from hybridlog.query.times import format_duration, format_time
from hybridlog_storage.manifest import Mark, Pin, new_random, replace, with_mark

if TYPE_CHECKING:
    from hybridlog.contract import Contract
    from hybridlog.live.clocks import MachineClock
    from hybridlog_storage.manifest import Manifest

PINNED: Final = "is marked and pinned"
_EVERY_S: Final = 0.1
_PROLONGED_S: Final = 1.0  # between two changes that only prolong incidents


class Moment(NamedTuple):
    """A mark to be set: its text, tags and steady times, ns; its end may come later, or never."""

    text: str
    tags: Mapping[str, str]
    begin: int
    end: int | None = None


class Incidents:
    """Marks and pins on a thread of its own, and looks for silences.

    `now` returns the present as a steady time, ns. What fails is tried again. Without a clock, as
    of a simulation, log times are steady.
    """

    def __init__(
        self,
        change: Callable[[Callable[[Manifest], Manifest]], Manifest],
        *,
        clock: MachineClock | None,
        first: Callable[[], int | None],
        silence: SilenceWatch,
        now: Callable[[], int],
        say: Callable[[str], None],
    ) -> None:
        self.count = 0
        self._change = change
        self._clock = clock
        self._first = first
        self._silence = silence
        self._now = now
        self._say = say
        self._set_by = 0
        self._last: dict[str, tuple[str, int, int]] = {}  # id, begin and end of hits, by text
        self._hits: dict[str, Moment] = {}  # by id
        self._new: dict[str, Moment] = {}  # by id, not written yet
        self._written: set[str] = set()  # ids
        self._is_urgent = False
        self._written_at = 0.0
        self._lock = threading.Lock()
        self._writing = threading.Lock()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="hybridlog-marks", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self, ended_at: int) -> None:
        """End all silences when the recording ended, ns; pin what waits, and end."""
        self._now = lambda: ended_at
        self._over.set()
        if self._thread.is_alive():
            self._thread.join()

    def hit(self, text: str, begin: int, end: int) -> None:
        """Mark and pin what lies between two steady times, ns, soon; waits for nothing."""
        with self._lock:
            key, last_begin, last_end = self._last.get(text, ("", begin, end))
            if key and last_begin <= end and begin <= last_end:
                begin, end = min(last_begin, begin), max(last_end, end)
            else:
                key = new_random()
                self.count += 1
                self._is_urgent = True
            self._last[text] = key, begin, end
            self._hits[key] = self._new[key] = Moment(text, {"trigger": text}, begin, end)

    def note(self, key: str, moment: Moment) -> None:
        """Mark something soon, by an id of its own; with the same id again it has another end."""
        with self._lock:
            self._new[key] = moment
            self._is_urgent = True

    def write(self) -> bool:
        """Mark and pin all so far; returns whether there was anything new.

        Raises:
            StoreError: The manifest cannot be written.
        """
        with self._writing:
            with self._lock:
                has_begun = self._first() is not None  # a note alone makes no recording
                new = {k: one for k, one in self._new.items() if has_begun or k in self._hits}
                self._is_urgent = self._is_urgent and not has_begun
            if not new:
                return False
            marks = {key: self._mark(key, one) for key, one in new.items()}
            pins = {
                key: Pin(key, *self._log_times(one), reason=one.text)
                for key, one in new.items()
                if key in self._hits
            }

            def how(now: Manifest) -> Manifest:
                before = {pin.id: pin for pin in now.pins}
                told = tuple(marks.get(mark.id, mark) for mark in now.marks)
                now = replace(now, pins=(*(before | pins).values(),), marks=told)
                known = self._written.union(mark.id for mark in told)
                for key, mark in marks.items():
                    if key not in known:
                        now = with_mark(now, mark)
                return now

            self._change(how)
            self._written_at = time.monotonic()
            fresh = pins.keys() - self._written
            self._written.update(marks)
            with self._lock:
                self._new = {k: one for k, one in self._new.items() if new.get(k) != one}
        for mark in (mark for key, mark in marks.items() if key in fresh):
            self._say(f"{mark.text!r} {PINNED} from {format_time(mark.time)} on")
        return True

    def _mark(self, key: str, one: Moment) -> Mark:
        begin, end = self._log_times(one)
        first = self._first()
        # A mark from before the first message would become the beginning of the recording.
        begin = min(max(begin, 0, begin if first is None else first), end)
        return Mark(key, begin, one.text, dict(one.tags), None if one.end is None else end)

    def _log_times(self, one: Moment) -> tuple[int, int]:
        end = one.begin if one.end is None else one.end
        return (one.begin, end) if self._clock is None else self._clock.log_times(one.begin, end)

    def _run(self) -> None:
        every_s, is_over = min(_EVERY_S, self._silence.interval_s), False
        while not is_over:
            is_over = self._over.wait(every_s)
            try:
                self._silence.look(self._now(), is_end=is_over)
                self._follow_clock()
                since = time.monotonic() - self._written_at
                if is_over or self._is_urgent or since > _PROLONGED_S:
                    self.write()
            except Exception as error:
                self._say(f"marking or pinning failed: {error or repr(error)}")

    def _follow_clock(self) -> None:
        """When the clock was set, what is pinned ahead has other log times."""
        if self._clock is not None and self._clock.set_by != self._set_by:
            self._set_by = self._clock.set_by
            with self._lock:
                self._new.update({key: self._hits[key] for key, *_ in self._last.values()})


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

    def __init__(self, contract: Contract | None, note: Note) -> None:
        rules = [] if contract is None else contract.topics.items()
        self._limits = {n: r.longest_gap for n, r in rules if r.longest_gap is not None}
        self._optional = {name for name, rule in rules if rule.optional}
        self._note = note
        self._last: dict[str, int] = {}
        self._begin: int | None = None
        self._looked = 0
        self._noted: dict[str, str] = {}  # ids of marks, by topics that are silent
        self._over: list[Silence] = []
        self._lock = threading.Lock()
        self.breaches = 0
        shortest = min(self._limits.values(), default=10**10) / 1e9
        # So that a silence is told within twice its limit.
        self.interval_s = max(min(shortest / 4, _MAX_INTERVAL_S), 1e-3)

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

        `now` is in ns; with `is_end` the recording ends now, and with it all silences.
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
