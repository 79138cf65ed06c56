"""Marks that a recorder sets: of triggers and signals, of silences, of a clock that was set.

A hit of a trigger or signal is an incident: a mark and a pin of the same time in the recording's
manifest. Hits of one name whose times touch are one incident.

A ring lets groups of files go that ended longer ago than a time: that which has passed, never that
of a clock. A group stays while a pin touches it; a file stays while it has the latched messages
that a late subscriber would receive.
"""

from __future__ import annotations

import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

from hybridlog.maintenance.keep import let_go
from hybridlog.maintenance.retention import is_pinned
from hybridlog.query.latching import depth_of, publisher_of
from hybridlog.query.times import format_duration, format_time
from hybridlog_storage.manifest import Mark, Pin, new_random, replace, with_mark

if TYPE_CHECKING:
    from hybridlog.contract import Contract
    from hybridlog.follow.child import FollowerProcess
    from hybridlog.live.clocks import MachineClock
    from hybridlog.live.recording import LiveRecording
    from hybridlog_storage.disk.directory import StoreDirectory
    from hybridlog_storage.manifest import File, Manifest

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
    """Marks and pins on a thread of its own, looks for silences, lets what a ring has too long go.

    `now` returns the present as a steady time, ns. Nothing goes before the hits that came until
    then are pinned. What fails is tried again. Without a clock, as of a simulation, log times are
    steady.
    """

    def __init__(
        self,
        change: Callable[[Callable[[Manifest], Manifest]], Manifest],
        *,
        clock: MachineClock | None,
        first: Callable[[], int | None],
        ring: Ring | None,
        silence: SilenceWatch,
        now: Callable[[], int],
        say: Callable[[str], None],
    ) -> None:
        self.count = 0
        self._change = change
        self._clock = clock
        self._first = first
        self._ring = ring
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
        self._thread = threading.Thread(target=self._run, name="hybridlog-ring", daemon=True)

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
                now = time.monotonic()
                self._follow_clock()
                due = self._ring.due(now) if self._ring is not None and not is_over else set()
                if due or is_over or self._is_urgent or now - self._written_at > _PROLONGED_S:
                    self.write()
                if due and self._ring is not None:
                    self._ring.let_go(due)
            except Exception as error:
                self._say(f"marking, pinning or letting go failed: {error or repr(error)}")

    def _follow_clock(self) -> None:
        """When the clock was set, what is pinned ahead has other log times."""
        if self._clock is not None and self._clock.set_by != self._set_by:
            self._set_by = self._clock.set_by
            with self._lock:
                self._new.update({key: self._hits[key] for key, *_ in self._last.values()})


GROUPS: Final = 10
"""Groups of files in the time of a ring, about."""
_LATE_S: Final = 1.0  # a signal may come so long after what it is about


class Ring:
    """Lets the oldest groups of a recording go, once triggers have seen them."""

    def __init__(
        self,
        directory: StoreDirectory,
        recording: LiveRecording,
        span_s: float,
        follower: FollowerProcess | None = None,
    ) -> None:
        self.messages = 0
        self._directory = directory
        self._recording = recording
        self._span_s = span_s + _LATE_S
        self._follower = follower
        self._seen = 0
        self._ended: dict[int, float] = {}  # when each group was first seen sealed
        self._files: dict[int, set[int]] = {}  # their numbers, by group
        self._kept: set[int] = set()  # must stay, as long as no other group is sealed

    def due(self, now: float) -> set[int]:
        """The groups whose time is over."""
        sealed = self._recording.sealed
        if sealed != self._seen:
            logs = self._directory.manifests.read(self._recording.id).logs.values()
            seen = time.monotonic()
            self._ended = {log.group: self._ended.get(log.group, seen) for log in logs}
            self._files = defaultdict(set)
            for log in logs:
                self._files[log.group].add(log.number)
            self._seen, self._kept = sealed, set()
        old = {group for group, at in self._ended.items() if now - at >= self._span_s}
        judged = None if self._follower is None else self._follower.judged
        if judged is not None:
            old = {group for group in old if self._files[group].issubset(judged)}
        return old - self._kept

    def let_go(self, groups: Collection[int]) -> None:
        """Delete the files of some groups, except those that must stay.

        Raises:
            StoreError: The manifest cannot be changed, or a file cannot be deleted.
        """
        changed = let_go(self._directory, self._recording.id, lambda now: self._going(now, groups))
        self._kept.update(groups)  # what is left of them stays, until another group is sealed
        self.messages = 0 if changed.let_go is None else changed.let_go.messages

    def _going(self, now: Manifest, groups: Collection[int]) -> list[File]:
        logs = [log for log in now.logs.values() if log.group in groups]
        pinned = {log.group for log in logs if is_pinned(log, now)}
        in_force = self._in_force(now)
        return [
            file
            for file in now.files
            if file.group in groups and file.group not in pinned and file.number not in in_force
        ]

    def _in_force(self, now: Manifest) -> set[int]:
        """Numbers of the files with latched messages that no later ones have replaced."""
        found: set[int] = set()
        newer: Counter[Hashable] = Counter()
        for number, log in sorted(now.logs.items(), reverse=True):
            came: Counter[Hashable] = Counter()
            for one, part in log.parts.items():
                channel = self._recording.capture.writer.channels.get(one)
                depth = 0 if channel is None else depth_of(channel)
                if channel is not None and depth and part.messages:
                    publisher = publisher_of(channel)
                    came[publisher] += part.messages
                    if newer[publisher] < depth:
                        found.add(number)
            newer += came
        return found


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
