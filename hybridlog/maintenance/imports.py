"""Imports recordings from another store, with checks; resumes after an interruption."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from hybridlog.columns.layout import IN_PAYLOADS
from hybridlog.columns.payload_files import open_file
from hybridlog.entries import Inventory, take_inventory
from hybridlog.maintenance.opening import clear_away
from hybridlog_storage import journal
from hybridlog_storage.disk import durability, files
from hybridlog_storage.disk.directory import IMPORTING, LOCK_WAIT_S, PAYLOADS, payload_names
from hybridlog_storage.errors import SegmentError, StoreError, TopicError, unreadable
from hybridlog_storage.journal import JOURNAL, Journal
from hybridlog_storage.segments.segment_check import SegmentCheck
from hybridlog_storage.settings import EXPIRED

if TYPE_CHECKING:
    from hybridlog.maintenance.report import Progress
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.disk.directory import StoreDirectory
    from hybridlog_storage.journal import PayloadFile

_PIECE = 8 << 20  # bytes copied at once


@dataclass(slots=True)
class ImportReport:
    """The result of an import.

    Attributes:
        imported: Labels in this store of the copied recordings.
        known: Labels of recordings that were here already.
        lacking: Those of them whose payloads were deleted here, and are there.
        refused: Why recordings that have not ended were not copied, by their labels there.
        bytes_copied: Bytes copied now, without those copied by an interrupted import.
    """

    imported: list[str] = field(default_factory=list)
    known: list[str] = field(default_factory=list)
    lacking: list[str] = field(default_factory=list)
    refused: dict[str, str] = field(default_factory=dict)
    bytes_copied: int = 0


def run(
    source: StoreDirectory,
    target: StoreDirectory,
    entries: Iterable[RecordingEntry],
    known: Mapping[str, str],
    progress: Progress | None = None,
) -> ImportReport:
    """Copy recordings from one store into another.

    Each is copied into a hidden directory, which gets its name after every byte is checked.
    Segments copied by an interrupted import are checked, but not copied again.

    Args:
        source: The store to read.
        target: The store to write.
        entries: Recordings of `source`.
        known: Labels of recordings of `target`, by id.
        progress: Called with the bytes copied and checked.

    Raises:
        StoreError: A recording is damaged; those before it are imported.
        DiskFullError: No room; the import can be run again.
    """
    target.check_writable()
    report = ImportReport()
    present = _present(target, known)
    for entry in entries:
        if entry.id in present:
            report.known.append(present[entry.id])
            if _lacks(target.recording(present[entry.id]), source.recording(entry.label)):
                report.lacking.append(present[entry.id])
            continue
        if entry.status == "open":
            report.refused[entry.label] = (
                f"Recording {entry.label!r} of {source.path} is being written. Import it when "
                "it has ended."
            )
            continue
        if entry.status == "unfinished":
            report.refused[entry.label] = (
                f"Recording {entry.label!r} of {source.path} was cut short by a crash. Open that "
                "store once with write permission, which recovers it, then import it."
            )
            continue
        with _importing(target, entry.id) as hidden:
            present = _present(target, present)
            if entry.id in present:  # another process has imported it meanwhile
                target.sweep(hidden)
                report.known.append(present[entry.id])
                continue
            clear_away(target, hidden)
            path = target.recording(hidden)
            _copy_recording(source, target, path, entry, report, progress=progress)
            Journal(path).append(journal.event(journal.ADOPTED, store=target.settings.store_id))
            with target.alone():
                label = target.free_label(entry.label)
                target.move(hidden, label)
            report.imported.append(label)
    return report


def _present(directory: StoreDirectory, known: Mapping[str, str]) -> dict[str, str]:
    """Labels of the recordings of a store, by id.

    Args:
        directory: The store.
        known: What was found before.
    """
    ids = {label: recording for recording, label in known.items()}
    found = {}
    for label in directory.names():
        if label.startswith("."):
            continue
        with suppress(StoreError):
            found[ids.get(label) or directory.id_of(label)] = label
    return found


def _lacks(here: Path, there: Path) -> bool:
    """True if payloads of a recording that are there were deleted here to make room."""
    with suppress(StoreError):
        ours, theirs = journal.read(here), journal.read(there)
        if ours is not None and theirs is not None:
            return any(
                not topics <= theirs.expired.get(number, frozenset())
                for number, topics in ours.expired.items()
            )
    return False


@contextmanager
def _importing(directory: StoreDirectory, recording: str) -> Iterator[str]:
    """Make and lock the hidden directory that a recording is copied into; yield its name."""
    hidden = f"{IMPORTING}{recording}"
    path = directory.recording(hidden)
    with ExitStack() as held:
        while True:
            try:
                files.make_folder(path, depth=files.IN_FOLDER)
            except FileExistsError:
                pass  # an import was interrupted, or another process imports it
            except OSError as error:
                raise durability.explain(error, path, "importing into") from error
            with suppress(TopicError):  # another process has given it its label
                held.enter_context(directory.writing(hidden, wait_s=LOCK_WAIT_S))
                break
        yield hidden


def _copy_recording(
    source: StoreDirectory,
    target: StoreDirectory,
    path: Path,
    entry: RecordingEntry,
    report: ImportReport,
    *,
    progress: Progress | None,
) -> None:
    """Copy a recording, whatever label it has now, and check every byte."""
    while True:
        label = source.label_now(entry.label, entry.id)
        try:
            inventory = take_inventory(source, label)
            if inventory.id != entry.id or inventory.misfits or not inventory.is_proven:
                raise StoreError(
                    f"Recording {label!r} of {source.path} is incomplete: "
                    f"`hybridlog verify --store {source.path} {label}` shows what is missing. "
                    "It was not imported."
                )
            # An interrupted import may have copied what the source does not list any more.
            for number, name in target.listing(path.name).sealed.items():
                if number not in inventory.summaries:
                    files.unlink(path / name)
            _copy_segments(source, path, inventory, report, progress)
            if any(file.has_fields for file in inventory.payloads.values()):
                target.require(EXPIRED)
            _copy_payloads(source.recording(label), path, inventory, report)
            lines = _journal(source, inventory)
        except StoreError:
            if source.has_label(label, entry.id):
                raise
        else:
            durability.write_new(path / JOURNAL, lines, depth=files.IN_RECORDING)
            return


def _journal(source: StoreDirectory, inventory: Inventory) -> bytes:
    """The lines of a journal by which the copies were checked.

    Raises:
        StoreError: They have changed since.
    """
    path, state = source.recording(inventory.label) / JOURNAL, inventory.state
    assert state is not None  # it is proven
    try:
        data = files.read_file(path, journal.MAX_JOURNAL)[: state.length]
    except OSError as error:
        raise unreadable(error, path) from error
    if replace(journal.parse(data), torn=state.torn) != state:
        raise StoreError(f"{path} has changed meanwhile. Run the import again.")
    return data


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
        file = source.recording(inventory.label) / name
        digest, size = inventory.stored_file(number)
        is_whole = partial(_is_segment, path / name, digest, size)
        report.bytes_copied += _bring(file, path / name, size, is_whole)
        done += summary.size
        if progress is not None:
            progress(inventory.label, done, total)


def _copy_payloads(source: Path, path: Path, inventory: Inventory, report: ImportReport) -> None:
    """Copy the columns of payloads that journal and segments list, and nothing else.

    Raises:
        StoreError: A file is damaged.
    """
    folder, listed = path / PAYLOADS, inventory.payloads
    try:
        for name in payload_names(path):
            if name not in listed:  # an import was interrupted
                files.unlink(folder / name, depth=IN_PAYLOADS)
        for file in listed.values():
            target = folder / file.file
            files.make_folders(target.parent, depth=IN_PAYLOADS - 1)
            is_whole = partial(_is_payload_file, folder, file)
            report.bytes_copied += _bring(
                source / PAYLOADS / file.file, target, file.bytes, is_whole, depth=IN_PAYLOADS
            )
            files.sync_folder(target.parent, depth=IN_PAYLOADS - 1)
        if listed:
            files.sync_folder(folder)
    except OSError as error:
        raise durability.explain(error, folder, "importing into") from error


def _bring(
    source: Path,
    target: Path,
    size: int,
    is_whole: Callable[[], bool],
    *,
    depth: int = files.IN_RECORDING,
) -> int:
    """Copy a file unless the copy is there and whole; return the number of bytes copied.

    Raises:
        StoreError: The source is damaged or cannot be read.
        DiskFullError: There is no room.
    """
    if is_whole():
        return 0
    _copy(source, target, size, depth=depth)
    if not is_whole():
        raise StoreError(
            f"{source} is damaged: what was copied does not match its checksums. "
            "`hybridlog verify` shows where."
        )
    return size


def _is_segment(path: Path, digest: str, size: int) -> bool:
    """True if a copy of a segment is complete, byte for byte."""
    try:
        with SegmentCheck(path) as check:
            found = check.summary
            if found is None or (found.digest, found.size) != (digest, size):
                return False
            return not any(True for _ in check.problems())
    except SegmentError:
        return False


def _is_payload_file(folder: Path, file: PayloadFile) -> bool:
    """True if a copy of a file of columns is complete, byte for byte."""
    try:
        open_file(folder, file).check()
    except StoreError:
        return False
    return True


def _copy(source: Path, target: Path, size: int, *, depth: int) -> None:
    """Copy the first bytes of a file; the copy gets its name when it is on the disk.

    Args:
        source: The file.
        target: Its copy.
        size: Number of bytes; fewer if the file is shorter.
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
            files.fetch(fd, [(0, size)])
            while piece := os.read(fd, min(size, _PIECE)):
                size -= durability.write_all(out, [piece])
    finally:
        os.close(fd)
