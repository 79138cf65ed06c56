"""Passes of retention: takes stock, makes the plan, and lets `expire` do each step.

A pass reads manifests only. A recorder makes passes for its own recording and for those that
have ended; what others record is left to them.
"""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Final

from hybridlog.maintenance.expiry import expire
from hybridlog.maintenance.retention import (
    Held,
    Plan,
    Rules,
    Step,
    held_of,
    is_pinned,
    plan,
)
from hybridlog.maintenance.sizes import disk_bytes
from hybridlog.record.losses import extent_of
from hybridlog.wording import listed
from hybridlog_storage.disk.directory import LOCK_WAIT_S, is_stable
from hybridlog_storage.errors import (
    DiskFullError,
    HeldError,
    HybridlogError,
    RecordingGoneError,
    SegmentError,
    StoreError,
    TopicError,
)
from hybridlog_storage.manifest import Pin
from hybridlog_storage.settings import read_settings

if TYPE_CHECKING:
    from hybridlog.maintenance.report import Progress
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.disk.directory import StoreDirectory
    from hybridlog_storage.manifest import Manifest


_WHOLE: Final = -1
_MAX_ROUNDS: Final = 20  # fields take room, too: then a little more has to go


@dataclass(frozen=True, slots=True)
class Own:
    """The recording that this process makes; it holds the lock of it.

    Attributes:
        recording: Its id.
        first_unread: Returns the number of the first segment that it still reads.
        sealed: Returns the number of segments sealed so far.
    """

    recording: str
    first_unread: Callable[[], int]
    sealed: Callable[[], int]


@dataclass(slots=True)
class KeepReport:
    """The result of a pass.

    Attributes:
        plan: The store at its beginning, and what was planned in all.
        freed_bytes: Bytes that became free.
        problems: What could not be done, in sentences.
    """

    plan: Plan
    freed_bytes: int = 0
    problems: list[str] = field(default_factory=list)


class Keeper:
    """Applies rules of retention to a store.

    Args:
        directory: The store.
        remove: Removes a whole recording, by its id, unless a check of its manifest raises.
        own: The recording that this process makes; None if it makes none.
        is_wanted: Returns whether to go on; asked before each deletion.
        changed: Called with the id of each recording that lost payloads, while it is held.
    """

    def __init__(
        self,
        directory: StoreDirectory,
        remove: Callable[[str, Callable[[Manifest], None]], None],
        own: Own | None = None,
        *,
        is_wanted: Callable[[], bool] = lambda: True,
        changed: Callable[[str], object] = lambda _: None,
    ) -> None:
        self._directory = directory
        self._remove = remove
        self._own = own
        self._is_wanted = is_wanted
        self._changed = changed
        self._known: dict[str, tuple[str, Held]] = {}  # by id, with its look
        # Ids and segments that this pass could not change; -1 for the whole recording.
        self._failed: set[tuple[str, int]] = set()
        self._unproven: set[str] = set()  # names of recordings whose manifests were made again

    def plan(self, rules: Rules) -> Plan:
        """The deletions that are due now."""
        path, now = self._directory.path, time.time_ns()
        used, free = self._directory.listed_bytes(), None
        if used is None:
            used, free = disk_bytes(path), shutil.disk_usage(path).free
        found = plan(self._held(now), rules, used=used, free=free, now=now)
        if self._unproven:
            found.warnings.append(
                f"{listed(sorted(self._unproven))}: left alone, since a manifest that was lost "
                "and made again may lack pins."
            )
        return found

    def keep(self, rules: Rules, progress: Progress | None = None) -> KeepReport:
        """Let go what has to go.

        Raises:
            HeldError: Another process makes a pass.
        """
        with self._alone():
            found = KeepReport(self.plan(rules))
            planned = found.plan
            for _ in range(_MAX_ROUNDS):
                if not planned.steps:
                    break
                for step in planned.steps:
                    if not self._is_wanted():
                        return found
                    self._do(step, rules, found, progress)
                planned = self.plan(rules)
                found.plan.steps += planned.steps
            found.plan.warnings, found.plan.is_short = planned.warnings, planned.is_short
        return found

    def expire_all(
        self,
        recording: str,
        digests: Mapping[int, str],
        rules: Rules,
        copy: str,
        progress: Progress | None = None,
    ) -> KeepReport:
        """Let payloads of a recording go, but for what pins and rules keep.

        Args:
            recording: Its id.
            digests: The segments that have a copy elsewhere: digests by number.
            rules: Rules whose `never_tag` holds.
            copy: Address of the store with the copies.
            progress: Called while payloads are replaced.

        Raises:
            HeldError: Another process makes a pass.
        """
        with self._alone():
            found, now = KeepReport(self.plan(Rules())), time.time_ns()
            for held in self._held(now):
                if held.id == recording and not rules.is_never(held.tags):
                    going = [s for s in held.segments if s.number in digests and not s.is_pinned]
                    numbers = tuple(one.number for one in going)
                    size = sum(one.size for one in going)
                    if numbers:
                        reason = f"it was copied to {copy}"
                        step = Step(
                            held.name, held.id, numbers, (), size, reason, now, digests, copy
                        )
                        found.plan.steps.append(step)
                        self._do(step, rules, found, progress)
        return found

    @contextmanager
    def _alone(self) -> Iterator[None]:
        with self._directory.retaining() as is_alone:
            if not is_alone:
                raise HeldError(
                    "Another process makes room in this store already.", is_recording=False
                )
            self._failed.clear()
            yield

    def _held(self, now: int) -> Iterator[Held]:
        """The content of the recordings; damaged and unproven ones are left alone."""
        self._unproven.clear()
        looks = self._directory.looks(self._directory.ids())
        self._known = {one: known for one, known in self._known.items() if one in looks}
        for recording, look in looks.items():
            before, held = self._known.get(recording, ("", None))
            if before != look or held is None:
                with suppress(StoreError):
                    held = self._read(recording, now)
                if held is not None and is_stable(look):
                    self._known[recording] = look, held
            if held is None or (held.id, _WHOLE) in self._failed:
                continue
            left = [s for s in held.segments if (held.id, s.number) not in self._failed]
            held = replace(held, segments=left)
            if self._own is not None and recording == self._own.recording:
                unread = self._own.first_unread()
                yield replace(held, segments=[s for s in held.segments if s.number < unread])
            else:
                yield held if held.is_ended else replace(held, segments=[])

    def _read(self, recording: str, now: int) -> Held | None:
        manifest = self._directory.manifests.find(recording)
        if manifest is None:
            return None
        if manifest.status == "unproven":
            self._unproven.add(manifest.name)
            return None
        return held_of(manifest, now)

    def _do(self, step: Step, rules: Rules, found: KeepReport, progress: Progress | None) -> None:
        try:
            if not step.segments:
                self._remove(step.id, partial(_check, step, rules))
                found.freed_bytes += step.bytes
                return
            with self._locked(step):
                found.freed_bytes += self._expire(step, rules, progress)
        except DiskFullError:
            raise
        except (StoreError, TopicError) as error:
            is_held = isinstance(error, HeldError | RecordingGoneError | TopicError)
            if len(step.segments) > 1 and not is_held:  # one of them may be damaged
                for number in step.segments:
                    self._do(replace(step, segments=(number,)), rules, found, progress)
                return
            numbers = (_WHOLE,) if is_held else step.segments or (_WHOLE,)
            self._failed.update((step.id, number) for number in numbers)
            cure = ""
            if isinstance(error, SegmentError):
                cure = ". Its payloads stay until the file is restored from a copy"
            found.problems.append(f"{error}{cure}")

    @contextmanager
    def _locked(self, step: Step) -> Iterator[None]:
        """Let nobody else write a recording."""
        if self._own is not None and step.id == self._own.recording:
            yield
            return
        with self._directory.writing(step.id, step.recording, wait_s=LOCK_WAIT_S):
            yield

    def _expire(self, step: Step, rules: Rules, progress: Progress | None) -> int:
        check = partial(_check, step, rules)
        with self._directory.at_hand(step.id, step.segments, check) as (here, version):
            done = expire(
                here,
                step.id,
                step.segments,
                digests=step.digests,
                copy=step.copy,
                check=check,
                version=version,
                progress=progress,
            )
        self._changed(step.id)
        return done.freed


def _check(step: Step, rules: Rules, manifest: Manifest) -> None:
    """Raise if what goes in a step must stay by now.

    Raises:
        StoreError: It must.
    """
    if rules.is_never(manifest.tags):
        raise StoreError(f"{step.recording}: a tag that keeps it was set meanwhile.")
    if not step.segments and manifest.pins:
        raise StoreError(f"{step.recording}: a pin was set meanwhile.")
    for number in step.segments:
        log = manifest.logs.get(number)
        if log is None:
            raise StoreError(f"{step.recording}: segment {number} was replaced meanwhile.")
        if is_pinned(log, manifest):
            raise StoreError(f"{step.recording}: a pin was set meanwhile.")


def may_hold(entry: RecordingEntry, begin: int | None, end: int | None) -> bool:
    """True if a recording may have messages in a range of time; a running one, later ones."""
    start, stop = extent_of(entry)
    is_over = entry.status not in {"open", "unfinished"}
    return (end is None or end > start) and not (is_over and begin is not None and begin >= stop)


def pin_of(
    name: str, span: tuple[int | None, int | None], topics: Sequence[str] | None, reason: str
) -> Pin:
    """A pin.

    Args:
        name: Its id.
        span: First log time, and that after the last one, ns; None for no bound.
        topics: Full names of topics; None for all.
        reason: Why.
    """
    begin, end = span
    last = None if end is None else end - 1
    return Pin(name, begin, last, None if topics is None else tuple(topics), reason)


LOOK_S: Final = 5.0
"""Seconds between two looks at the rules and at free space."""
_TICK_S: Final = 0.1
_AGES_S: Final = 60.0  # between two passes for the ages alone


class RetentionThread:
    """Makes passes of retention, on a thread of its own.

    A pass is made when a segment was sealed, when less is free than the rules say, and once a
    minute. What it cannot do is told, and never stops the recorder.

    Args:
        directory: The store.
        remove: Removes a whole recording, by its id, unless a check of its manifest raises.
        own: The recording in progress; None if there is none.
        say: Shows a line to the user, each text once.
    """

    def __init__(
        self,
        directory: StoreDirectory,
        remove: Callable[[str, Callable[[Manifest], None]], None],
        own: Own | None,
        say: Callable[[str], None],
    ) -> None:
        self._directory = directory
        self._keeper = Keeper(directory, remove, own, is_wanted=lambda: not self._over.is_set())
        self._own = own
        self._say = say
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="hybridlog-keep", daemon=True)
        self._rules = Rules.of(directory.settings.retention)
        self._has_warned = False

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """End after the deletion in progress."""
        self._over.set()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        looked = last_pass = -_AGES_S
        segments = 0
        while not self._over.wait(_TICK_S):
            now, sealed = time.monotonic(), self._own.sealed() if self._own is not None else 0
            is_low = False
            try:
                if now - looked >= LOOK_S:
                    looked = now
                    self._rules = Rules.of(read_settings(self._directory.path).retention)
                    free = shutil.disk_usage(self._directory.path).free
                    is_low = free < (self._rules.min_free or 0)
                is_due = sealed != segments or is_low or now - last_pass >= _AGES_S
                if is_due and not self._rules.is_empty:
                    segments, last_pass = sealed, now
                    self._make_pass()
            except HeldError:
                segments = -1  # another process makes room: see later what is left
            except (HybridlogError, OSError) as error:
                self._say(f"making room failed: {error}")

    def _make_pass(self) -> None:
        done = self._keeper.keep(self._rules)
        warnings = [] if self._has_warned else done.plan.warnings
        self._has_warned = bool(done.plan.warnings)
        reasons = (f"making room: {step.reason}" for step in done.plan.steps)
        for text in (*reasons, *done.problems, *warnings):
            self._say(text)
