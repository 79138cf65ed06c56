"""Deletes logs of a recording to make room; fields, counts and times of their messages stay.

First the rows of a log are written to files of their own: the fields as in tables, times, sizes
and hashes (`columns/rows_file.py`). They are forced to the disk, and read and compared. Then one
change of the manifest lists them, and says that the log is gone; from then on they are the truth.
Then the log is deleted. A crash on either side of that change leaves files that the next opening
removes.
"""

from __future__ import annotations

import secrets
from contextlib import suppress
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from hybridlog.columns.recording_logs import RecordingRows
from hybridlog.maintenance.report import reporter
from hybridlog_storage.checksum import crc32
from hybridlog_storage.disk import durability, files
from hybridlog_storage.errors import SegmentError, StoreError
from hybridlog_storage.manifest import Manifest, replace, with_rows
from hybridlog_storage.messages import EXPIRED_IDS
from hybridlog_storage.segments.gone_log import front, open_log
from hybridlog_storage.segments.segment_reader import SegmentReader

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping
    from pathlib import Path

    from hybridlog.maintenance.report import Progress
    from hybridlog_storage.disk.directory import StoreDirectory
    from hybridlog_storage.manifest import File
    from hybridlog_storage.manifests import Manifests
    from hybridlog_storage.segments.chunk import StoredChunk
    from hybridlog_storage.segments.segment_reader import SegmentSummary


@dataclass(slots=True)
class Expired:
    """The result of an expiry.

    Attributes:
        segments: Numbers of the logs that went.
        messages: Number of messages whose payloads went, by topic.
        freed: Bytes of the disk that became free, what was written subtracted.
        row_bytes: Bytes of the files of rows that were written.
    """

    segments: list[int] = field(default_factory=list)
    messages: dict[str, int] = field(default_factory=dict)
    freed: int = 0
    row_bytes: int = 0


def expire(
    directory: StoreDirectory,
    recording: str,
    segments: Collection[int],
    *,
    digests: Mapping[int, str] = MappingProxyType({}),
    copy: str = "",
    check: Callable[[Manifest], object] = lambda _: None,
    version: int = 0,
    progress: Progress | None = None,
) -> Expired:
    """Delete sealed logs of a recording that this process has locked.

    Logs that are gone already are left out, and those without messages.

    Args:
        directory: The store.
        recording: Its id; it may be running, then it is the caller who records it.
        segments: Numbers of sealed logs.
        digests: Digests that they must have, by number.
        copy: Address of a store with a proven copy of them.
        check: Part of each change of the manifest; raises if they must stay by now.
        version: As of `RowsWriter`.
        progress: Called after each chunk.

    Raises:
        StoreError: Files cannot be read or written; a log that is listed is as before.
        DiskFullError: There is no room for the rows.
    """
    path = directory.recording(recording)
    manifest, done = directory.manifests.read(recording), Expired()
    logs = [manifest.logs.get(number) for number in sorted(segments)]
    if any(log is None or digests.get(log.number, log.digest) != log.digest for log in logs):
        raise StoreError(f"{manifest.name}: a segment was replaced meanwhile.")
    going = [log for log in logs if log is not None and log.is_here and log.parts]
    report = reporter(progress, manifest.name, sum(log.bytes for log in going))
    if manifest.is_ended:
        _remove_arrays(directory, manifest, going)
    before = 0
    for log in going:

        def tell(at: int, before: int = before) -> None:
            report(before + at)

        line = replace(log, gone="expired", copy=copy)
        _remove(path, [n for n in directory.listing(recording).rows if int(n[:6]) == log.number])
        made = write_rows(path, line, path, version=version, report=tell)
        _list(path, directory.manifests, line, made, check)
        _remove(path, [log.name])
        before += log.bytes
        rows = sum(one.bytes for one in made)
        done.segments.append(log.number)
        done.freed += log.bytes - rows
        done.row_bytes += rows
        for number, part in log.parts.items():
            topic = manifest.channels[number].topic
            done.messages[topic] = done.messages.get(topic, 0) + part.messages
    return done


def _list(
    path: Path,
    manifests: Manifests,
    line: File,
    made: tuple[File, ...],
    check: Callable[[Manifest], object],
) -> None:
    """Let the manifest say that a log is gone, and list its rows."""

    def how(now: Manifest) -> Manifest:
        check(now)
        return with_rows(now, line, made)

    try:
        files.sync_folder(path)
        manifests.change(path.name, how)
    except BaseException:
        with suppress(StoreError):  # the next opening does it
            if manifests.read(path.name).logs[line.number].is_here:
                _remove(path, [one.name for one in made])
        raise


def write_rows(
    recording: Path,
    line: File,
    into: Path,
    *,
    version: int = 0,
    report: Callable[[int], None] = lambda _: None,
) -> tuple[File, ...]:
    """Write what is left of the messages of a log, and compare it with them.

    Args:
        recording: The folder of its recording; it stays as it is.
        line: The line of the log in its manifest, which says that it is gone.
        into: Folder of the new files.
        version: As of `RowsWriter`.
        report: Told the byte up to which the log was read.

    Returns:
        The lines of the files, which are on the disk, the first one first.

    Raises:
        StoreError: The log is damaged, or has what rows cannot keep; or files cannot be written.
        DiskFullError: There is no room.
    """
    from hybridlog.columns.rows_writer import RowsWriter

    with SegmentReader(recording / line.name, line.number) as reader:
        summary = reader.summary()
        if summary.size != line.bytes:
            raise StoreError(
                f"{reader.path} is not the segment that the manifest lists; nothing was deleted. "
                "Run `hybridlog verify --repair` first."
            )
        if summary.attachments or summary.metadata:
            raise StoreError(f"{reader.path} has attachments or metadata of its log, and stays.")
        begin = front(reader, summary, line)
        writer = RowsWriter(into, line, summary.channels, begin, version)
        try:
            for place in summary.chunks:
                writer.add(reader.read_chunk(place))
                report(place.offset + place.length)
            made = writer.close()
            _prove(into, line, made, reader, summary)
        except BaseException as error:
            writer.discard()
            _remove(into, writer.names)
            if isinstance(error, OSError):
                raise durability.explain(error, into, "writing rows to") from error
            raise
    return made


def _prove(
    folder: Path,
    line: File,
    made: tuple[File, ...],
    reader: SegmentReader,
    summary: SegmentSummary,
) -> None:
    """Compare files of rows with their log.

    Raises:
        StoreError: They differ.
    """
    with open_log(folder / made[0].name, line.number, RecordingRows(folder, made)) as rows:
        found = rows.summary()
        is_same = (
            (found.recording, found.end, found.losses, found.size)
            == (summary.recording, summary.end, summary.losses, summary.size)
            and np.array_equal(found.table.as_stored().parts, summary.table.parts)
            and all(
                _left_of(rows.read_chunk(there)) == _left_of(reader.read_chunk(here))
                for there, here in zip(found.chunks, summary.chunks, strict=True)
            )
        )
    if not is_same:
        raise SegmentError(f"What was written of {reader.path} does not come back.")


def _left_of(chunk: StoredChunk) -> list[int]:
    """Checksums of what an expiry keeps of messages besides their fields."""
    batch = chunk.batch
    columns = (batch.log_time, batch.publish_time, batch.sequence, *batch.places, chunk.seq)
    stored = (*columns, (batch.channel % EXPIRED_IDS).astype(np.int32))
    return [crc32(np.ascontiguousarray(column).tobytes()) for column in stored]


def without_payloads(
    path: Path, manifest: Manifest, logs: Collection[int], into: Path, copy: str
) -> Manifest:
    """Write the rows of logs of a recording, which are to be copied later.

    Args:
        path: The recording's directory; it stays as it is.
        manifest: Its manifest.
        logs: Numbers of the logs; first ones of groups stay, and those without messages.
        into: A folder for the new files. Their names are drawn, so that no other file of the
            recording gets them.
        copy: Address of the store that has the logs.

    Returns:
        The manifest with the new files in the place of others.

    Raises:
        StoreError: Files cannot be read or written.
        DiskFullError: There is no room.
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


def _remove(folder: Path, names: Collection[str]) -> None:
    """Remove files, if they are there.

    Raises:
        StoreError: One cannot be removed.
    """
    try:
        for name in names:
            with suppress(FileNotFoundError):
                files.unlink(folder / name)
        if names:
            files.sync_folder(folder)
    except OSError as error:
        raise durability.explain(error, folder, "removing files of") from error


def _remove_arrays(directory: StoreDirectory, manifest: Manifest, going: Collection[File]) -> None:
    """Remove tables with arrays that expire; they are made again without these."""
    from hybridlog.columns.folders import TableFolders
    from hybridlog.columns.layout import type_prefix

    channels = (manifest.channels[number] for log in going for number in log.parts)
    gone = {one.topic: one.type for one in channels if one.topic in directory.settings.arrays}
    if gone:
        digests = {str(number): log.digest for number, log in manifest.logs.items()}
        folders = TableFolders(directory.path, manifest.id, manifest.created, digests)
        with suppress(OSError):
            folders.add({}, {*gone}, {type_prefix(kind) for kind in gone.values()})
