"""Imports recordings from another store, with checks; resumes after an interruption."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from hybridlog.entries import Inventory, take_inventory
from hybridlog.maintenance.opening import clear_away
from hybridlog.payloads.layout import IN_PAYLOADS
from hybridlog_storage import durability, files, journal
from hybridlog_storage.directory import IMPORTING, PAYLOADS, payload_names
from hybridlog_storage.errors import SegmentError, StoreError
from hybridlog_storage.journal import JOURNAL, Journal
from hybridlog_storage.segment_check import SegmentCheck

if TYPE_CHECKING:
    from hybridlog.maintenance.report import Progress
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.directory import StoreDirectory
    from hybridlog_storage.journal import JournalState

_PIECE = 8 << 20  # bytes copied at once


@dataclass(slots=True)
class ImportReport:
    """The result of an import.

    Attributes:
        imported: Labels in this store of the copied recordings.
        known: Labels of recordings that were here already.
        bytes_copied: Bytes copied now, without those copied by an interrupted import.
    """

    imported: list[str] = field(default_factory=list)
    known: list[str] = field(default_factory=list)
    bytes_copied: int = 0


def run(
    source: StoreDirectory,
    target: StoreDirectory,
    entries: Iterable[RecordingEntry],
    progress: Progress | None = None,
) -> ImportReport:
    """Copy recordings from one store into another.

    Each is copied into a hidden directory, which gets its name after every byte is checked.
    Segments copied by an interrupted import are checked, but not copied again.

    Args:
        source: The store to read.
        target: The store to write.
        entries: Recordings of `source`.
        progress: Called with the bytes copied and checked.

    Raises:
        StoreError: A recording is damaged or being written; those before it are imported.
        DiskFullError: No room; the import can be run again.
    """
    target.check_writable()
    report = ImportReport()
    present = _present(target)
    for entry in entries:
        if entry.id in present:
            report.known.append(present[entry.id])
            continue
        if entry.status == "open":
            raise StoreError(
                f"Recording {entry.label!r} of {source.path} is being written. Import it when "
                "it has ended."
            )
        if entry.status == "unfinished":
            raise StoreError(
                f"Recording {entry.label!r} of {source.path} was cut short by a crash. Open that "
                "store once with write permission, which recovers it, then import it."
            )
        report.imported.append(_import_one(source, target, entry, report, progress))
    return report


def _present(directory: StoreDirectory) -> dict[str, str]:
    """Labels of the recordings of a store, by id."""
    found = {}
    for label in directory.labels():
        try:
            found[take_inventory(directory, label).id] = label
        except StoreError:
            continue
    return found


def _import_one(
    source: StoreDirectory,
    target: StoreDirectory,
    entry: RecordingEntry,
    report: ImportReport,
    progress: Progress | None,
) -> str:
    inventory = take_inventory(source, entry.label)
    if inventory.misfits or not inventory.is_proven:
        raise StoreError(
            f"Recording {entry.label!r} of {source.path} is incomplete: "
            f"`hybridlog verify --store {source.path} {entry.label}` shows what is missing. "
            "It was not imported."
        )
    hidden = f"{IMPORTING}{entry.id}"
    path = target.recording(hidden)
    try:
        files.make_folder(path, depth=files.IN_FOLDER)
    except FileExistsError:
        pass  # an import was interrupted
    except OSError as error:
        raise durability.explain(error, path, "importing into") from error
    with target.writing(hidden) as mine:
        if not mine:
            raise StoreError(
                f"Another process is importing {entry.label!r}. Wait until it is done."
            )
        clear_away(target, hidden)
        _copy_segments(source, path, inventory, report, progress)
        if inventory.state is not None:
            _copy_payloads(source.recording(inventory.label), path, inventory.state, report)
        data = files.read_file(source.recording(entry.label) / JOURNAL, journal.MAX_JOURNAL)
        whole = data[: data.rfind(b"\n") + 1]
        durability.write_new(path / JOURNAL, whole, depth=files.IN_RECORDING)
        Journal(path).append(journal.event(journal.ADOPTED, store=target.settings.store_id))
        with target.alone():
            label = target.free_label(entry.label)
            target.move(hidden, label)
    return label


def _copy_segments(
    source: StoreDirectory,
    path: Path,
    inventory: Inventory,
    report: ImportReport,
    progress: Progress | None,
) -> None:
    total = sum(summary.size for summary in inventory.summaries.values())
    done = 0
    for number, summary in inventory.summaries.items():
        name = inventory.listing.sealed[number]
        digest, size = inventory.stored_file(number)
        if not _is_there(path / name, digest, size):
            _copy(source.recording(inventory.label) / name, path / name)
            report.bytes_copied += summary.size
            if not _is_there(path / name, digest, size):
                raise StoreError(
                    f"{source.recording(inventory.label) / name} is damaged: what was copied "
                    "does not match its checksums. `hybridlog verify` shows where."
                )
        done += summary.size
        if progress is not None:
            progress(inventory.label, done, total)


def _copy_payloads(source: Path, path: Path, state: JournalState, report: ImportReport) -> None:
    """Copy the columns of payloads that the journal lists, and nothing else.

    Raises:
        StoreError: A file is damaged.
    """
    listed = state.payloads
    if not listed:
        return
    from hybridlog.payloads.reader import PayloadReader

    try:
        for name in payload_names(path):
            if name not in listed:  # an import was interrupted
                files.unlink(path / PAYLOADS / name, depth=IN_PAYLOADS)
        for file in listed.values():
            target = path / PAYLOADS / file.file
            files.make_folders(target.parent, depth=IN_PAYLOADS - 1)
            if not _is_file(target):
                _copy(source / PAYLOADS / file.file, target, depth=IN_PAYLOADS)
                report.bytes_copied += file.bytes
            PayloadReader(path / PAYLOADS, file).check()
            files.sync_folder(target.parent, depth=IN_PAYLOADS - 1)
        files.sync_folder(path / PAYLOADS)
    except OSError as error:
        raise durability.explain(error, path / PAYLOADS, "importing into") from error


def _is_file(path: Path) -> bool:
    try:
        files.status(path, depth=IN_PAYLOADS)
    except FileNotFoundError:
        return False
    return True


def _is_there(path: Path, digest: str, size: int) -> bool:
    """True if a copy is complete, byte for byte."""
    try:
        with SegmentCheck(path) as check:
            if check.summary is None or (check.summary.digest, check.summary.size) != (
                digest,
                size,
            ):
                return False
            return not any(True for _ in check.problems())
    except SegmentError:
        return False


def _copy(source: Path, target: Path, *, depth: int = files.IN_RECORDING) -> None:
    """Copy a file, which gets its name when it is complete and on the disk.

    Args:
        source: The file.
        target: Its copy.
        depth: Parts of both paths that lie inside their stores.

    Raises:
        StoreError: The source cannot be read.
        DiskFullError: There is no room.
    """
    try:
        fd = files.open_file(source, os.O_RDONLY | os.O_NONBLOCK, depth=depth)
    except OSError as error:
        raise durability.explain(error, source, "reading") from error
    try:
        with durability.new_file(target, depth=depth) as out:
            while piece := os.read(fd, _PIECE):
                durability.write_all(out, [piece])
    finally:
        os.close(fd)
