"""Passes of retention: takes stock, makes the plan, and does each step of it.

A pass reads manifests only; a step is a change of a manifest, then an unlink. A recorder makes
passes for its own recording and for those that nobody records; what others record is left to
them.
"""

from __future__ import annotations

import os
import shutil
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from msgspec import Struct, field
from msgspec.structs import replace

from hybridlog.maintenance.expiry import expire, let_go, may_go
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
from hybridlog.wording import listed
from hybridlog_storage.disk import files
from hybridlog_storage.disk.directory import LOCK_WAIT_S
from hybridlog_storage.errors import (
    ChangedError,
    DiskFullError,
    HeldError,
    HybridlogError,
    StoreError,
    TopicError,
)
from hybridlog_storage.settings import read_settings

if TYPE_CHECKING:
    from hybridlog.maintenance.report import Progress
    from hybridlog_storage.disk.directory import StoreDirectory
    from hybridlog_storage.manifest import Manifest

    Remove = Callable[[str, Callable[[Manifest], None]], None]

_WHOLE: Final = -1
_MAX_ROUNDS: Final = 20  # rows take room, too: then a little more has to go
SPARE: Final = "spare"
"""File whose room a pass uses for manifests and rows when the disk is full."""
_SPARE_BYTES: Final = 8 << 20
_SPARE_SHARE: Final = 64  # of the quota, at most
_LEAST_SPARE: Final = 1 << 16


class KeepReport(Struct):
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
        remove: Removes a whole recording, by its id, unless a check of its manifest raises.
        own: Id of the recording that this process makes, and so holds; None if it makes none.
        window: The newest of it that goes last, ns: a trigger may want it.
        judged: Returns the numbers of its segments that triggers have seen, None for all: the
            others go last.
        is_wanted: Returns whether to go on; asked before each deletion.
    """

    def __init__(
        self,
        directory: StoreDirectory,
        remove: Remove,
        own: str | None = None,
        *,
        window: int = 0,
        judged: Callable[[], Collection[int] | None] = lambda: None,
        is_wanted: Callable[[], bool] = lambda: True,
    ) -> None:
        self._directory = directory
        self._remove = remove
        self._own = own
        self._window = window
        self._judged = judged
        self._is_wanted = is_wanted
        # Segments that this pass could not change, by recording; -1 for all of it.
        self._failed: defaultdict[str, set[int]] = defaultdict(set)
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
        """Let go what has to go; HeldError while another process makes a pass."""
        with self._alone():
            if not self._directory.is_remote:
                _lay_spare(self._directory, rules)  # counts among what is used
            found = KeepReport(self.plan(rules))
            planned = found.plan
            for _ in range(_MAX_ROUNDS):
                if not planned.steps:
                    break
                for step in planned.steps:
                    if not self._is_wanted():
                        return found
                    self._do(step, rules, found, {"progress": progress})
                planned = self.plan(rules)
                found.plan.steps += planned.steps
            found.plan.warnings, found.plan.is_short = planned.warnings, planned.is_short
        return found

    def expire_all(
        self,
        recording: str,
        logs: Collection[int],
        rules: Rules,
        copy: str,
        progress: Progress | None = None,
    ) -> KeepReport:
        """Let payloads of a recording go, but for what pins and a `never_tag` of rules keep.

        `logs` are the numbers of the segments that have a copy in the store at `copy`.
        """
        with self._alone():
            found, now = KeepReport(Plan(0, None)), self._directory.manifests.read(recording)
            own = [now.logs[number] for number in sorted(logs) if number in now.logs]
            going = [log.number for log in own if may_go(log) and not is_pinned(log, now)]
            if going and not rules.is_never(now.tags):
                step = Step(now.name, recording, tuple(going), (), 0, "")
                self._do(step, rules, found, {"copy": copy, "progress": progress})
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

    def _held(self, now: int) -> Iterator[tuple[Manifest, list[Held]]]:
        """Recordings and what they hold; nothing of those that are unproven, or held by others."""
        self._unproven.clear()
        for manifest in self._directory.manifests.each(self._directory.ids()):
            failed, logs = self._failed[manifest.id], list[Held]()
            if manifest.status == "unproven":
                self._unproven.add(manifest.name)
            elif manifest.id == self._own:
                logs = held_of(manifest, now, self._window, self._judged(), failed)
            elif _WHOLE not in failed and (
                manifest.is_ended or not self._directory.is_recorded(manifest.id)
            ):
                logs = held_of(manifest, now, stays=failed)
            yield manifest, logs

    def _do(self, step: Step, rules: Rules, found: KeepReport, how: Mapping[str, Any]) -> None:
        """Do a step, with the room of the spare file if there is no other; reports in `found`."""
        if self._failed[step.id] and not step.segments:
            return  # planned before it was known: the next plan judges again
        check = partial(_check, step, rules)
        while True:
            try:
                freed, damaged = self._done(step, check, how)
                break
            except DiskFullError:
                if not use_spare(self._directory):
                    raise
            except (StoreError, TopicError) as error:
                found.problems.append(str(error))
                if not isinstance(error, ChangedError):  # else the next plan judges again
                    self._failed[step.id].add(_WHOLE)
                return
        found.freed_bytes += freed
        for number, reason in damaged.items():
            cure = "Its payloads stay until the file is restored from a copy"
            found.problems.append(f"{reason}. {cure}")
            self._failed[step.id].add(number)

    def _done(
        self, step: Step, check: Callable[[Manifest], None], how: Mapping[str, Any]
    ) -> tuple[int, dict[int, str]]:
        if not step.segments and not step.groups:
            self._remove(step.id, check)
            return step.bytes, {}
        is_own = step.id == self._own
        lock = self._directory.writing(step.id, step.recording, wait_s=LOCK_WAIT_S)
        with nullcontext() if is_own else lock:
            if step.groups:
                let_go(
                    self._directory,
                    step.id,
                    lambda now: [file for file in now.files if file.group in step.groups],
                    check,
                )
                return step.bytes, {}
            return expire(
                self._directory,
                step.id,
                step.segments,
                check=check,
                make_room=partial(use_spare, self._directory),
                is_followed=is_own,
                **how,
            )


def _check(step: Step, rules: Rules, manifest: Manifest) -> None:
    """Raise ChangedError if what goes in a step must stay by now."""
    if rules.is_never(manifest.tags):
        raise ChangedError(f"{step.recording}: a tag that keeps it was set meanwhile.")
    if manifest.pins and not step.segments and not step.groups:
        raise ChangedError(f"{step.recording}: a pin was set meanwhile.")
    for number, log in manifest.logs.items():
        goes = number in step.segments or log.group in step.groups
        if goes and is_pinned(log, manifest):
            raise ChangedError(f"{step.recording}: a pin was set meanwhile.")


def _lay_spare(directory: StoreDirectory, rules: Rules) -> None:
    """Keep some room for a pass on a full disk, where there is enough."""
    path, size = directory.path / SPARE, _SPARE_BYTES
    if rules.quota is not None:
        size = min(size, rules.quota // _SPARE_SHARE)
    with suppress(OSError):
        is_apt = size >= _LEAST_SPARE and shutil.disk_usage(directory.path).free > 4 * size
        if is_apt and not path.exists():
            fd = files.open_file(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL)
            try:
                os.posix_fallocate(fd, 0, size)
            finally:
                os.close(fd)


def use_spare(directory: StoreDirectory) -> bool:
    """Free the room that was kept; False if there is none."""
    try:
        files.unlink(directory.path / SPARE)
    except OSError:
        return False
    return True


LOOK_S: Final = 5.0
"""Seconds between two looks at the rules and at free space."""
_TICK_S: Final = 0.1
_AGES_S: Final = 60.0  # between two passes for the ages alone


class RetentionThread:
    """Makes room ahead of need, on a thread of its own.

    A pass is made when a segment was sealed, when less is free than the rules or the recorder
    want, and once a minute. What it cannot do is told, and never stops the recorder.

    Args:
        remove: Removes a whole recording, by its id, unless a check of its manifest raises.
        own: Id of the recording that this process makes.
        sealed: Returns the number of its segments that are sealed.
        reserve: Bytes that the recorder wants free at least, where rules may make room.
        say: Shows a line to the user, each text once.
        window: The newest of the recording that goes last, ns.
        judged: Returns what triggers have seen of it, as for `Keeper`.
    """

    def __init__(
        self,
        directory: StoreDirectory,
        remove: Remove,
        own: str,
        *,
        sealed: Callable[[], int],
        reserve: int,
        say: Callable[[str], None],
        window: int,
        judged: Callable[[], Collection[int] | None],
    ) -> None:
        self._directory = directory
        self._keeper = Keeper(
            directory,
            remove,
            own,
            window=window,
            judged=judged,
            is_wanted=lambda: not self._over.is_set(),
        )
        self._sealed = sealed
        self._reserve = self._wanted = reserve
        self._say = say
        self._over = threading.Event()
        self._alone = threading.Lock()  # who makes a pass
        self._is_asked = False  # for one
        self._is_exhausted = False  # nothing was left to go when it was asked for
        self._thread = threading.Thread(target=self._run, name="hybridlog-keep", daemon=True)
        self._rules = self._read_rules()
        self._has_warned = False

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """End after the deletion in progress."""
        self._over.set()
        if self._thread.is_alive():
            self._thread.join()

    def wants(self, free_bytes: int) -> bool:
        """Ask for so many free bytes; False if none can be made."""
        self._wanted = max(free_bytes, self._reserve)
        if self._is_exhausted and not self._is_asked:
            return False
        self._is_asked = True
        return self._rules.makes_room

    def make_room(self) -> bool:
        """Make a pass on a full disk, for a writer that waits; returns whether to try again."""
        freed = self._pass(is_urgent=True)
        return freed is None or freed > 0

    def _read_rules(self) -> Rules:
        rules = Rules.of(read_settings(self._directory.path).retention)
        return rules.with_free(self._wanted) if rules.makes_room else rules

    def _run(self) -> None:
        looked = last_pass = -_AGES_S
        sealed = 0
        while not self._over.wait(_TICK_S):
            now, count, is_asked, is_low = time.monotonic(), self._sealed(), self._is_asked, False
            if now - looked >= LOOK_S:
                looked = now
                with self._saying():
                    free = shutil.disk_usage(self._directory.path).free
                    self._rules = self._read_rules()
                    is_low = free < (self._rules.min_free or 0)
            if is_asked or is_low or count != sealed or now - last_pass >= _AGES_S:
                last_pass, sealed = now, count
                freed = self._pass()
                sealed = -1 if freed is None else sealed
                self._is_exhausted, self._is_asked = is_asked and freed == 0, False

    @contextmanager
    def _saying(self) -> Iterator[None]:
        try:
            yield
        except (HybridlogError, OSError) as error:
            self._say(f"making room failed: {error}")

    def _pass(self, *, is_urgent: bool = False) -> int | None:
        """Make a pass; returns the bytes that it freed, None while another process makes one."""
        with self._alone, self._saying():
            self._rules = self._read_rules()
            if self._over.is_set() or self._rules.is_empty:
                return 0
            try:
                done = self._keeper.keep(replace(self._rules, is_urgent=is_urgent))
            except HeldError:
                self._over.wait(_TICK_S)
                return None
            warnings = [] if self._has_warned else done.plan.warnings
            self._has_warned = bool(done.plan.warnings)
            reasons = (f"making room: {step.reason}" for step in done.plan.steps)
            for text in (*reasons, *done.problems, *warnings):
                self._say(text)
            return done.freed_bytes
        return 0
