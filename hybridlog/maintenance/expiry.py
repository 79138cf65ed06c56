"""Deletes logs of a recording to make room: a change of its manifest, then an unlink.

What is left of the messages of a log are files of rows: the fields as in tables, times, sizes and
hashes (`columns/rows_file.py`). They are written once and listed beside the log, as soon as it is
sealed where a store has rules, else before it goes. Then one change of the manifest says that logs
are gone; from then on their rows are the truth. A crash on either side of a change leaves files
that the next change of the store removes.
"""

from __future__ import annotations

import os
import secrets
import time
from contextlib import suppress
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

from hybridlog.maintenance.report import reporter
from hybridlog.record.losses import Cause
from hybridlog_storage.disk import files
from hybridlog_storage.errors import ChangedError, DiskFullError, SegmentError, StoreError
from hybridlog_storage.manifest import (
    LetGo,
    Loss,
    Manifest,
    digest_of,
    replace,
    with_rows,
    with_totals,
)
from hybridlog_storage.segments.segment_reader import SegmentReader, front

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping
    from pathlib import Path

    from hybridlog.maintenance.report import Progress
    from hybridlog_storage.disk.directory import StoreDirectory
    from hybridlog_storage.manifest import File

    Check = Callable[[Manifest], object]

NO_ROOM: Final = "deleted without its fields: the disk was full"
"""Reason in the loss ledger."""
TOO_LATE: Final = "deleted without its fields: they were not written in time"
"""Another one, of a recording in progress."""
_WAIT_S: Final = 5.0  # for rows that a follower writes
_POLL_S: Final = 0.1
_PIECE: Final = 1 << 20


def expire(
    directory: StoreDirectory,
    recording: str,
    segments: Collection[int],
    *,
    copy: str = "",
    check: Check = lambda _: None,
    progress: Progress | None = None,
    make_room: Callable[[], bool] = lambda: False,
    is_followed: bool = False,
) -> tuple[int, dict[int, str]]:
    """Delete sealed logs of a recording that this process has locked; it may record it, too.

    Returns the bytes of the disk that became free, what was written subtracted, and why logs could
    not go, by number.

    Logs that are gone already are left out, and those without messages. Those that have their rows
    go first. Where there is no room for rows, a log goes without, and is lost. Damaged ones without
    rows stay. `copy` is the address of a store with a proven copy of them. `check`, part of each
    change of the manifest, raises if they must stay by now; `make_room` returns False if there is
    none to make. After an error, logs that are listed are as before. Where another process writes
    the rows (`is_followed`), they are waited for, and a log that gets none goes without.
    """
    if is_followed:
        _have_rows(directory, recording, segments, check, make_room)
    manifest, freed, damaged = directory.manifests.read(recording), 0, dict[int, str]()
    logs = [manifest.logs.get(number) for number in sorted(segments)]
    going = [log for log in logs if log is not None and log.is_here and log.parts]
    if manifest.is_ended:
        _remove_arrays(directory, manifest, going)
    path, rows = directory.recording(recording), manifest.rows
    ready = [log for log in going if _are_whole(path, rows.get(log.number, ()))]
    _go(directory, recording, {log.number: () for log in ready}, check, copy)
    late, before = [log for log in going if log not in ready], 0
    report = reporter(progress, manifest.name, sum(log.bytes for log in late))
    for log in late:
        while True:
            try:
                made = _rows_of(directory, recording, log)
                _go(directory, recording, {log.number: made}, check, copy)
                freed -= sum(one.bytes for one in made)
            except DiskFullError:
                if make_room():
                    continue
                let_go(directory, recording, partial(_lines_of, log.number), check, NO_ROOM)
            except SegmentError as error:
                damaged[log.number] = str(error)
            break
        before += log.bytes
        report(before)
    return freed + sum(log.bytes for log in going if log.number not in damaged), damaged


def _have_rows(
    directory: StoreDirectory,
    recording: str,
    segments: Collection[int],
    check: Check,
    make_room: Callable[[], bool],
) -> None:
    """Wait until a follower has written the rows of logs; delete those that have none in time."""

    def lacking(now: Manifest) -> list[File]:
        found = [now.logs[number] for number in segments if number in now.logs]
        return [log for log in found if may_go(log) and log.number not in now.rows]

    until = time.monotonic() + _WAIT_S
    while lacking(directory.manifests.read(recording)):
        if time.monotonic() >= until:
            let_go(directory, recording, lacking, check, TOO_LATE)
            return
        make_room()
        time.sleep(_POLL_S)


def _are_whole(path: Path, rows: Collection[File]) -> bool:
    """True if files of rows are as listed: they will be all that is left."""
    try:
        for line in rows:
            with os.fdopen(files.open_file(path / line.name, os.O_RDONLY), "rb") as file:
                digest = digest_of(iter(partial(file.read, _PIECE), b""))
            if digest != line.digest:
                return False
    except OSError:
        return False
    return bool(rows)


def _lines_of(number: int, manifest: Manifest) -> list[File]:
    return [file for file in manifest.files if file.number == number]


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
    version = secrets.randbelow(9 * 10**8) + 1 if directory.is_remote else 0  # others do it, too
    with directory.adding(recording) as into:
        return write_rows(path, replace(log, gone="expired"), into, version=version)


def _go(
    directory: StoreDirectory,
    recording: str,
    made: Mapping[int, tuple[File, ...]],
    check: Check,
    copy: str,
) -> None:
    """Let the manifest say that logs are gone, then delete them."""
    if made:
        now = _list(directory, recording, made, check, {"gone": "expired", "copy": copy})
        directory.drop(recording, [now.logs[number].name for number in made])


def _list(
    directory: StoreDirectory,
    recording: str,
    made: Mapping[int, tuple[File, ...]],
    check: Check = lambda _: None,
    values: Mapping[str, str] = MappingProxyType({}),
) -> Manifest:
    """List the rows of logs, where there are new ones, and change the lines of the logs."""
    manifests = directory.manifests

    def how(now: Manifest) -> Manifest:
        check(now)
        if not all(number in now.logs and now.logs[number].is_here for number in made):
            raise ChangedError(f"{now.name}: a segment has gone meanwhile.")
        for number, rows in made.items():
            line = replace(now.logs[number], **values)
            now = with_rows(now, line, rows or now.rows[number])
        return now

    try:
        return manifests.change(recording, how)
    finally:
        with suppress(StoreError):  # or else the next change does it
            listed = {file.name for file in manifests.read(recording).files}
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

    This process has locked the recording, or records it. `choose` is called with each manifest that
    is changed; `check` raises if they must stay. `lost` is the reason of a row of the loss ledger,
    empty if they are counted as let go.
    """
    gone: list[File] = []

    def how(now: Manifest) -> Manifest:
        check(now)
        gone[:] = choose(now)
        if not gone:
            return now
        parts = [(n, part) for f in gone if f.kind == "log" for n, part in f.parts.items()]
        before = now.let_go or LetGo(0, 0)
        count = 0 if lost else sum(part.messages for _, part in parts)
        rows = [
            Loss(Cause.SEGMENT, now.channels[n].topic, part.messages, part.first, part.last, lost)
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

    changed = directory.manifests.change(recording, how)
    directory.drop(recording, [file.name for file in gone])
    return changed


def write_rows(recording: Path, line: File, into: Path, *, version: int = 0) -> tuple[File, ...]:
    """Write what is left of the messages of a log; returns the lines of the files in order.

    The line of the log says that it is gone; the folder of its recording stays as it is. A damaged
    log, or one with what rows cannot keep, raises SegmentError.
    """
    from hybridlog.columns.rows_file import RowsWriter

    with SegmentReader(recording / line.name, line.number) as reader:
        summary = reader.summary()
        if summary.size != line.bytes:
            raise SegmentError(f"{reader.path} is not the segment that the manifest lists")
        if summary.attachments:
            raise SegmentError(f"{reader.path} has attachments of its log")
        begin = front(reader, summary, line)
        writer = RowsWriter(into, line, summary.channels, begin, version)
        reader.fetch(summary.chunks)
        try:
            for place in summary.chunks:
                writer.add(reader.read_chunk(place))
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
    """Write the rows of logs of a recording, which are to be copied later, and its new manifest.

    The recording's directory stays as it is; so do first logs of groups, and those without
    messages. Names of the new files are drawn, so that no other file of the recording gets them.
    `copy` is the address of the store that has the logs.
    """
    version = secrets.randbelow(8 * 10**8) + 10**8
    for number in sorted(logs):
        log = manifest.logs[number]
        if may_go(log):
            line = replace(log, gone="elsewhere", copy=copy)
            manifest = with_rows(manifest, line, write_rows(path, line, into, version=version))
    return manifest


def may_go(log: File) -> bool:
    """True if a log may go before its recording: the first one of a group stays."""
    return log.is_here and log.number != log.group and bool(log.parts)


def _remove_arrays(directory: StoreDirectory, manifest: Manifest, going: Collection[File]) -> None:
    """Remove tables with arrays that expire; they are made again without these."""
    from hybridlog.columns.folders import TableFolders
    from hybridlog.columns.layout import type_prefix

    channels = (manifest.channels[number] for log in going for number in log.parts)
    gone = {one.topic: one.type for one in channels if one.topic in directory.settings.arrays}
    if gone:
        folders = TableFolders(directory.path, manifest.id, manifest.created)
        with suppress(OSError):
            folders.add({}, {*gone}, {type_prefix(kind) for kind in gone.values()})
