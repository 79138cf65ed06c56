"""Passes of retention: takes stock, makes the plan, and does each step of it.

A pass reads manifests only; a step is a change of a manifest, then an unlink. A recorder makes
passes for its own recording and for those that nobody records; what others record is left to
them.

What is left of the messages of a log are files of rows: the fields as in tables, times, sizes and
hashes (`columns/rows.py`). They are written once and listed beside the log, as soon as it is
sealed where a store has rules, else before it goes. Then one change of the manifest says that logs
are gone; from then on their rows are the truth. A crash on either side of a change leaves files
that the next change of the store removes.
"""

from __future__ import annotations

import os
import secrets
import shutil
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

from msgspec import Struct, field, structs

from hybridlog.columns.layout import TABLES, type_prefix
from hybridlog.maintenance.retention import (
    Held,
    Plan,
    Rules,
    Step,
    held_of,
    is_pinned,
    may_go,
    past_ring,
    plan,
)
from hybridlog.maintenance.sizes import disk_bytes
from hybridlog.record.losses import Cause
from hybridlog_storage.disk import files
from hybridlog_storage.disk.directory import LOCK_WAIT_S, StoreDirectory
from hybridlog_storage.errors import (
    ChangedError,
    DiskFullError,
    HeldError,
    HybridlogError,
    SegmentError,
    StoreError,
    TopicError,
)
from hybridlog_storage.manifest import (
    File,
    LetGo,
    Loss,
    Manifest,
    digest_of,
    replace,
    with_rows,
    with_totals,
)
from hybridlog_storage.manifests import RECORDINGS
from hybridlog_storage.segments.segment_reader import SegmentReader, front
from hybridlog_storage.settings import read_settings

if TYPE_CHECKING:
    from pathlib import Path

    Check = Callable[[Manifest], None]
    Remove = Callable[[str, Check], None]

_WHOLE: Final = -1
_MAX_ROUNDS: Final = 20  # rows take room, too: then a little more has to go
_PIECE: Final = 1 << 20
SPARE: Final = "spare"
"""File whose room a pass uses for manifests and rows when the disk is full."""
_SPARE_BYTES: Final = 8 << 20
_SPARE_SHARE: Final = 64  # of the quota, at most
_LEAST_SPARE: Final = 1 << 16
_WAIT_S: Final = 5.0  # for rows that a follower writes
_POLL_S: Final = 0.1
_LATE_S: Final = 1.0  # a signal may come so long after what it is about


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

    `remove` deletes a recording, by its id, unless a check of its manifest raises. `own` is the
    one that this process makes; after `ring_s` its groups go, and `let_go` counts their messages,
    once triggers have `judged` them: it returns the numbers of these segments, None for all.
    `is_wanted` is asked before each deletion.
    """

    def __init__(
        self,
        directory: StoreDirectory,
        remove: Remove,
        own: str | None = None,
        *,
        ring_s: float | None = None,
        judged: Callable[[], Collection[int] | None] = lambda: None,
        is_wanted: Callable[[], bool] = lambda: True,
    ) -> None:
        self.let_go = 0
        self._ring_s = ring_s
        self._sealed: dict[int, float] = {}  # when each group was first seen, by `monotonic`
        self._directory, self._remove, self._own = directory, remove, own
        self._judged, self._is_wanted = judged, is_wanted
        # Segments that this pass could not change, by recording; -1 for all of it.
        self._failed: defaultdict[str, set[int]] = defaultdict(set)

    def plan(self, rules: Rules) -> Plan:
        """The deletions that are due now."""
        directory, now = self._directory, time.time_ns()
        free = shutil.disk_usage(directory.path).free
        if rules.is_empty:
            return Plan(0, free)
        return plan(
            self._held(now),
            rules,
            used=disk_bytes(directory.path),
            others=disk_bytes(directory.path, but={RECORDINGS, TABLES, SPARE}),
            free=free,
            now=now,
            has_arrays=bool(directory.settings.arrays),
        )

    def keep(self, rules: Rules) -> KeepReport:
        """Let go what has to go; HeldError while another process makes a pass."""
        with self._alone():
            if not rules.is_empty:
                _lay_spare(self._directory, rules)  # counts among what is used
            found = KeepReport(Plan(0, 0))
            for step in [] if self._ring_s is None else self._past_ring(self._ring_s):
                self._do(step, rules, found)
            found.plan = planned = self.plan(rules)
            for _ in range(_MAX_ROUNDS if planned.steps else 0):
                for step in [*planned.steps]:
                    self._do(step, rules, found)
                planned = self.plan(rules)
                if not (planned.steps and self._is_wanted()):
                    break
                found.plan.steps += planned.steps
            found.plan.warnings, found.plan.is_short = planned.warnings, planned.is_short
        return found

    def expire_all(
        self, recording: str, logs: Collection[int], rules: Rules, copy: str
    ) -> KeepReport:
        """Let payloads of a recording go, but for what pins and a `never_tag` of rules keep.

        `logs` are the numbers of the segments that have a copy in the store at `copy`.
        """
        with self._alone():
            found, now = KeepReport(Plan(0, 0)), self._directory.manifests.read(recording)
            own = [now.logs[number] for number in sorted(logs) if number in now.logs]
            going = [log.number for log in own if may_go(log) and not is_pinned(log, now)]
            if going and not rules.is_never(now.tags):
                self._do(Step(now.name, recording, tuple(going), 0, copy), rules, found, copy)
        return found

    @contextmanager
    def _alone(self) -> Iterator[None]:
        with self._directory.retaining():
            self._failed.clear()
            yield

    def _held(self, now: int) -> Iterator[tuple[Manifest, list[Held]]]:
        """Recordings and what they hold; nothing of those that others hold.

        Nor of those whose manifests were made again, which may lack pins.
        """
        directory = self._directory
        for manifest in directory.manifests.each(directory.ids()):
            failed = self._failed[manifest.id]
            is_ours = manifest.id == self._own or (
                manifest.status != "unproven"
                and (manifest.is_ended or not directory.is_recorded(manifest.id))
            )
            is_held = is_ours and _WHOLE not in failed
            yield manifest, held_of(manifest, now, failed) if is_held else []

    def _past_ring(self, ring_s: float) -> list[Step]:
        """Deletions of groups whose time in the ring is over, whatever a clock says."""
        assert self._own is not None
        manifest, seen = self._directory.manifests.read(self._own), self._judged()
        now, groups = time.monotonic(), {log.group for log in manifest.logs.values()}
        self._sealed = {group: self._sealed.get(group, now) for group in groups}
        if seen is not None:
            groups -= {log.group for n, log in manifest.logs.items() if n not in seen}
        over = (one for one in groups if now - self._sealed[one] >= ring_s + _LATE_S)
        return past_ring(manifest, sorted(over))

    def _do(self, step: Step, rules: Rules, found: KeepReport, copy: str = "") -> None:
        """Do a step, with the room of the spare file if there is no other; reports in `found`."""
        is_known = not self._failed[step.id] or step.segments
        if not (is_known and self._is_wanted()):
            return  # planned before it was known: the next plan judges again
        directory, is_own, freed = self._directory, step.id == self._own, step.bytes
        check = partial(_check, step, rules)
        lock = directory.writing(step.id, step.recording, wait_s=LOCK_WAIT_S)
        try:
            with nullcontext() if is_own or step.is_whole else lock:
                if step.is_whole:
                    self._remove(step.id, check)
                elif step.groups:
                    gone = let_go(directory, step.id, step.going, check)
                    self.let_go = gone.let_go.messages if is_own and gone.let_go else self.let_go
                else:
                    freed, damaged = expire(
                        directory,
                        step.id,
                        step.segments,
                        copy=copy,
                        check=check,
                        is_followed=is_own,
                    )
                    self._failed[step.id] |= damaged.keys()
                    cure = "Its payloads stay until the file is restored from a copy"
                    found.problems += (f"{reason}. {cure}" for reason in damaged.values())
            found.freed_bytes += freed
        except DiskFullError:
            if not use_spare(directory):
                raise
            self._do(step, rules, found, copy)
        except (StoreError, TopicError) as error:
            found.problems.append(str(error))
            if not isinstance(error, ChangedError):  # else the next plan judges again
                self._failed[step.id].add(_WHOLE)


def _check(step: Step, rules: Rules, manifest: Manifest) -> None:
    """Raise ChangedError if what goes in a step must stay by now."""
    if step.reason and rules.is_never(manifest.tags):
        raise ChangedError(f"{step.recording}: a tag that keeps it was set meanwhile.")
    going = step.going(manifest)
    if (step.is_whole and manifest.pins) or any(is_pinned(log, manifest) for log in going):
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


def expire(
    directory: StoreDirectory,
    recording: str,
    segments: Collection[int],
    *,
    copy: str = "",
    check: Check = lambda _: None,
    is_followed: bool = False,
) -> tuple[int, dict[int, str]]:
    """Delete sealed logs of a recording that this process has locked; it may record it, too.

    Returns the bytes of the disk that became free, what was written subtracted, and why logs could
    not go, by number. Those that have their rows go first; where there is no room for rows, a log
    goes without, and is lost; damaged ones without rows stay. `copy` is the address of a store with
    a proven copy. `check`, part of each change, raises if they must stay by now. Where another
    process writes the rows (`is_followed`), they are waited for.
    """
    if is_followed:
        _have_rows(directory, recording, segments, check)
    manifest, damaged = directory.manifests.read(recording), dict[int, str]()
    logs = [manifest.logs.get(number) for number in sorted(segments)]
    going = [log for log in logs if log is not None and log.is_here and log.parts]
    freed = sum(log.bytes for log in going)
    if manifest.is_ended:
        _remove_arrays(directory, manifest, going)
    path, rows = directory.recording(recording), manifest.rows
    ready = [log for log in going if _are_whole(path, rows.get(log.number, ()))]
    gone = {"gone": "expired", "copy": copy}
    _list(directory, recording, {log.number: () for log in ready}, check, gone)
    for log in (one for one in going if one not in ready):
        while True:
            try:
                made = _rows_of(directory, recording, log)
                _list(directory, recording, {log.number: made}, check, gone)
                freed -= sum(one.bytes for one in made)
            except DiskFullError:
                if use_spare(directory):
                    continue
                going_alone = Step("", recording, (log.number,), 0, "").going
                let_go(directory, recording, going_alone, check, "the disk was full")
            except SegmentError as error:
                damaged[log.number] = str(error)
                freed -= log.bytes
            break
    return freed, damaged


def _have_rows(
    directory: StoreDirectory, recording: str, segments: Collection[int], check: Check
) -> None:
    """Wait until a follower has written the rows of logs; delete those that have none in time."""

    def lacking(now: Manifest) -> list[File]:
        found = [now.logs[number] for number in segments if number in now.logs]
        return [log for log in found if may_go(log) and log.number not in now.rows]

    until = time.monotonic() + _WAIT_S
    while lacking(directory.manifests.read(recording)):
        if time.monotonic() >= until:
            let_go(directory, recording, lacking, check, "they were not written in time")
            return
        use_spare(directory)
        time.sleep(_POLL_S)


def _are_whole(path: Path, rows: Collection[File]) -> bool:
    """True if files of rows are as listed: they will be all that is left."""
    try:
        for line in rows:
            with os.fdopen(files.open_file(path / line.name, os.O_RDONLY), "rb") as file:
                if digest_of(iter(partial(file.read, _PIECE), b"")) != line.digest:
                    return False
    except OSError:
        return False
    return bool(rows)


def make_rows(
    directory: StoreDirectory, recording: str, is_wanted: Callable[[], bool] = lambda: True
) -> None:
    """Write the rows that logs which may go lack, as long as they are wanted.

    This process has locked the recording, or records it.
    """
    manifest = directory.manifests.read(recording)
    for log in manifest.logs.values():
        if may_go(log) and log.number not in manifest.rows and is_wanted():
            with suppress(SegmentError, ChangedError):  # it stays, or is gone
                _list(directory, recording, {log.number: _rows_of(directory, recording, log)})


def _rows_of(directory: StoreDirectory, recording: str, log: File) -> tuple[File, ...]:
    """Write the rows of a log, in place of what a crash has left of such."""
    path, left = directory.recording(recording), directory.listing(recording).rows
    directory.drop(recording, [name for name in left if int(name[:6]) == log.number])
    made = write_rows(path, replace(log, gone="expired"), path)
    files.sync_folder(path)
    return made


def _change(
    directory: StoreDirectory, recording: str, how: Callable[[Manifest], Manifest]
) -> Manifest:
    """Change a manifest, then delete the files that it does not list any more, or says are gone."""
    before = set[str]()

    def noted(now: Manifest) -> Manifest:
        before.update(now.present)
        return how(now)

    changed = directory.manifests.change(recording, noted)
    directory.drop(recording, before - changed.present.keys())
    return changed


def _list(
    directory: StoreDirectory,
    recording: str,
    made: Mapping[int, tuple[File, ...]],
    check: Check = lambda _: None,
    values: Mapping[str, str] = MappingProxyType({}),
) -> None:
    """List the rows of logs, where there are new ones, and change the lines of the logs."""

    def how(now: Manifest) -> Manifest:
        check(now)
        if not all(number in now.logs and now.logs[number].is_here for number in made):
            raise ChangedError(f"{now.name}: a segment has gone meanwhile.")
        for number, rows in made.items():
            line = replace(now.logs[number], **values)
            now = with_rows(now, line, rows or now.rows[number])
        return now

    try:
        _change(directory, recording, how)
    finally:
        with suppress(StoreError):  # or else the next change does it
            listed = {file.name for file in directory.manifests.read(recording).files}
            new = [file.name for rows in made.values() for file in rows]
            directory.drop(recording, [name for name in new if name not in listed])


def let_go(
    directory: StoreDirectory,
    recording: str,
    choose: Callable[[Manifest], Collection[File]],
    check: Check = lambda _: None,
    lost: str = "",
) -> Manifest:
    """Delete files of a recording with all that is left; returns the manifest without them.

    This process has locked the recording, or records it. `choose` returns the logs of a manifest
    that go, with their rows; `check` raises if they must stay. `lost` tells the loss
    ledger why they go without their fields; empty if they are counted as let go.
    """

    def how(now: Manifest) -> Manifest:
        check(now)
        numbers = {log.number for log in choose(now)}
        gone = [file for file in now.files if file.number in numbers]
        if not gone:
            return now
        parts = [(n, part) for f in gone if f.kind == "log" for n, part in f.parts.items()]
        before = now.let_go or LetGo(0, 0)
        count = 0 if lost else sum(part.messages for _, part in parts)
        why = f"deleted without its fields: {lost}"
        rows = [
            Loss(Cause.SEGMENT, now.channels[n].topic, part.messages, part.first, part.last, why)
            for n, part in (parts if lost else ())
        ]
        return with_totals(
            replace(
                now,
                files=tuple(file for file in now.files if file not in gone),
                losses=(*now.losses, *rows),
                let_go=LetGo(
                    before.messages + count, max(before.through, *(f.number for f in gone))
                ),
            )
        )

    return _change(directory, recording, how)


def write_rows(recording: Path, line: File, into: Path, *, version: int = 0) -> tuple[File, ...]:
    """Write what is left of the messages of a log; returns the lines of the files in order.

    The line of the log says that it is gone; the folder of its recording stays as it is. A damaged
    log, or one with what rows cannot keep, raises SegmentError.
    """
    from hybridlog.columns.rows import RowsWriter
    from hybridlog.index.indexing import ChunkIndexer

    with SegmentReader(recording / line.name, line.number) as reader:
        summary = reader.summary()
        if summary.size != line.bytes:
            raise SegmentError(f"{reader.path} is not the segment that the manifest lists")
        if summary.attachments:
            raise SegmentError(f"{reader.path} has attachments of its log")
        begin = front(reader, summary, line)
        writer, indexer = RowsWriter(into, line, begin, version), ChunkIndexer(into.name)
        reader.fetch(summary.chunks)
        try:
            for place in summary.chunks:
                for one in indexer.messages_in([reader.read_chunk(place)], summary.channels):
                    writer.add(one.channel, one.placed, one.decoded)
            return writer.close()
        except BaseException as error:
            writer.discard()
            files.remove(into, writer.names)
            if isinstance(error, OSError):
                raise files.explain(error, into, "writing rows to") from error
            raise


def without_payloads(
    path: Path, manifest: Manifest, logs: Collection[int], into: Path, copy: str
) -> Manifest:
    """Write the rows of logs that are copied later, as `copy` has them, and its new manifest.

    The recording's directory stays as it is; no other file of it ever gets the new names.
    """
    version = secrets.randbelow(8 * 10**8) + 10**8
    for number in sorted(logs):
        log = manifest.logs[number]
        if may_go(log):
            line = replace(log, gone="elsewhere", copy=copy)
            manifest = with_rows(manifest, line, write_rows(path, line, into, version=version))
    return manifest


def _remove_arrays(directory: StoreDirectory, manifest: Manifest, going: Collection[File]) -> None:
    """Remove tables with arrays that expire; they are made again without these."""
    from hybridlog.columns.table_writer import TableFolders

    channels = (manifest.channels[number] for log in going for number in log.parts)
    gone = {one.topic: one.type for one in channels if one.topic in directory.settings.arrays}
    if gone:
        folders = TableFolders(directory.path, manifest.id, manifest.created)
        with suppress(OSError):
            folders.add({}, {*gone}, {type_prefix(kind) for kind in gone.values()})


LOOK_S: Final = 5.0
"""Seconds between two passes because too little is free."""
_AGES_S: Final = 60.0  # and between two for the ages alone


class RoomMaker:
    """Makes room ahead of need for the recording of this process, as it is looked at.

    A pass, on a thread of its own, is made when a segment was sealed (`sealed` counts them), when
    less is free than the rules or the recorder (`reserve`, bytes) want, and once a minute; for a
    ring alone, with each look, after `pin` has pinned what triggers want. What it cannot do is
    told, and never stops the recorder. All else is as of `Keeper`.
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
        ring_s: float | None,
        pin: Callable[[], object],
        judged: Callable[[], Collection[int] | None],
    ) -> None:
        self._directory, self._sealed, self._reserve, self._say = directory, sealed, reserve, say
        self._pin = None if ring_s is None else pin
        self._is_over = False
        self.keeper = Keeper(
            directory,
            remove,
            own,
            ring_s=ring_s,
            judged=judged,
            is_wanted=lambda: not self._is_over,
        )
        self._alone = threading.Lock()  # who makes a pass
        self._thread = threading.Thread()
        self._passed, self._counted = -_AGES_S, 0
        self._rules = self._read_rules()
        self._has_warned = False

    def look(self) -> None:
        """Begin a pass if one is due; call it about once a second."""
        if self._thread.is_alive():
            return
        since, count, is_low = time.monotonic() - self._passed, self._sealed(), False
        with suppress(HybridlogError, OSError):  # the next pass tells
            free = shutil.disk_usage(self._directory.path).free
            is_low = since >= LOOK_S and free < (self._read_rules().min_free or 0)
        is_due = is_low or count != self._counted or since >= _AGES_S
        if is_due:
            self._passed, self._counted = self._passed + since, count
        if is_due or self._pin is not None:
            options = {"is_ring": not is_due}
            self._thread = threading.Thread(target=self._pass, kwargs=options, daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """End after the deletion in progress."""
        self._is_over = True
        if self._thread.is_alive():
            self._thread.join()

    def make_room(self, free_bytes: int = 0) -> bool:
        """Make a pass, for so many free bytes at least; returns whether to try again.

        Without a number, for a writer that waits.
        """
        if not self._rules.makes_room:
            return False
        return self._pass(free_bytes, is_urgent=not free_bytes) != 0

    def _read_rules(self, free_bytes: int = 0) -> Rules:
        rules = Rules.of(read_settings(self._directory.path).retention)
        return rules.with_free(max(free_bytes, self._reserve)) if rules.makes_room else rules

    def _pass(
        self, free_bytes: int = 0, *, is_urgent: bool = False, is_ring: bool = False
    ) -> int | None:
        """Make a pass; returns the bytes that it freed, None if another process makes one."""
        with self._alone:
            try:
                self._rules = self._read_rules(free_bytes)
                if self._rules.is_empty and self._pin is None:
                    return 0
                if self._pin is not None:
                    self._pin()
                rules = Rules() if is_ring else structs.replace(self._rules, is_urgent=is_urgent)
                done = self.keeper.keep(rules)
            except HeldError:
                self._counted = -1
                time.sleep(_POLL_S)
                return None
            except (HybridlogError, OSError) as error:
                self._say(f"making room failed: {error}")
                return 0
            warnings = [] if self._has_warned else done.plan.warnings
            self._has_warned = bool(done.plan.warnings)
            reasons = (f"making room: {one.reason}" for one in done.plan.steps)
            for text in (*reasons, *done.problems, *warnings):
                self._say(text)
            return done.freed_bytes
