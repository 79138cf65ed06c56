"""Incidents: what a trigger, a signal or a person names while it is recorded.

An incident is a mark and a pin of the same time in the recording's manifest. Hits of one name
whose times touch are one incident.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Final, NamedTuple

from hybridlog.query.times import format_time
from hybridlog_storage.manifest import Mark, Pin, new_random, replace, with_mark

if TYPE_CHECKING:
    from hybridlog.live.clocks import MachineClock
    from hybridlog.live.ring import Ring
    from hybridlog_storage.manifest import Manifest

PINNED: Final = "is marked and pinned"
_EVERY_S: Final = 0.1
_PROLONGED_S: Final = 1.0  # between two changes that only prolong incidents


class Hit(NamedTuple):
    """Something happened.

    Attributes:
        text: What.
        tags: Tags of its mark.
        begin: Steady time from which on messages are marked and pinned, ns.
        end: Steady time up to which they are.
    """

    text: str
    tags: Mapping[str, str]
    begin: int
    end: int


class Incidents:
    """Marks and pins hits on a thread of its own, and lets what is too old for a ring go.

    Nothing goes before the hits that came until then are pinned. What fails is tried again.

    Args:
        change: Changes the manifest of the recording.
        clock: The clock of log times; None for a simulation, whose times are all steady.
        first: Returns the log time of the first message; None before it.
        ring: Lets files go; None to keep all of them.
        say: Shows a line to the user, each text once.

    Attributes:
        count: Number of incidents.
    """

    def __init__(
        self,
        change: Callable[[Callable[[Manifest], Manifest]], Manifest],
        clock: MachineClock | None,
        first: Callable[[], int | None],
        ring: Ring | None,
        say: Callable[[str], None],
    ) -> None:
        self.count = 0
        self._change = change
        self._clock = clock
        self._first = first
        self._ring = ring
        self._say = say
        self._set_by = 0
        self._last: dict[str, tuple[str, Hit]] = {}  # by text, with its id
        self._new: dict[str, Hit] = {}  # by id, not written yet
        self._is_urgent = False
        self._written_at = 0.0
        self._lock = threading.Lock()
        self._writing = threading.Lock()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="hybridlog-ring", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """Pin what waits, and end."""
        self._over.set()
        if self._thread.is_alive():
            self._thread.join()

    def hit(self, hit: Hit) -> str:
        """Take a hit, which is written soon; waits for nothing. Returns the id of its mark."""
        with self._lock:
            key, last = self._last.get(hit.text, ("", hit))
            if key and last.begin <= hit.end and hit.begin <= last.end:
                hit = hit._replace(begin=min(last.begin, hit.begin), end=max(last.end, hit.end))
            else:
                key = new_random()
                self.count += 1
                self._is_urgent = True
            self._last[hit.text] = key, hit
            self._new[key] = hit
        return key

    def write(self) -> bool:
        """Mark and pin all hits so far; returns whether there were new ones.

        Raises:
            StoreError: The manifest cannot be written.
        """
        with self._writing:
            with self._lock:
                hits, self._is_urgent = dict(self._new), False
            if not hits:
                return False
            pins = {key: self._pin(key, hit) for key, hit in hits.items()}
            marks = {key: self._mark(key, hit) for key, hit in hits.items()}
            fresh: list[Mark] = []

            def how(now: Manifest) -> Manifest:
                before = {pin.id: pin for pin in now.pins}
                fresh[:] = [mark for key, mark in marks.items() if key not in before]
                told = tuple(marks.get(mark.id, mark) for mark in now.marks)
                now = replace(now, pins=(*(before | pins).values(),), marks=told)
                for mark in fresh:
                    now = with_mark(now, mark)
                return now

            self._change(how)
            self._written_at = time.monotonic()
            with self._lock:
                self._new = {k: hit for k, hit in self._new.items() if hits.get(k) != hit}
        for mark in fresh:
            self._say(f"{mark.text!r} {PINNED} from {format_time(mark.time)} on")
        return True

    def _pin(self, key: str, hit: Hit) -> Pin:
        return Pin(key, *self._log_times(hit), reason=hit.text)

    def _mark(self, key: str, hit: Hit) -> Mark:
        begin, end = self._log_times(hit)
        first = self._first()
        # A mark from before the first message would become the beginning of the recording.
        begin = min(max(begin, 0, begin if first is None else first), end)
        return Mark(key, begin, hit.text, dict(hit.tags), end)

    def _log_times(self, hit: Hit) -> tuple[int, int]:
        if self._clock is None:
            return hit.begin, hit.end
        return self._clock.log_times(hit.begin, hit.end)

    def _run(self) -> None:
        is_over = False
        while not is_over:
            is_over = self._over.wait(_EVERY_S)
            try:
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
                self._new.update(self._last.values())
