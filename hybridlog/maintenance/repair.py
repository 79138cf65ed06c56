"""Repairs that lose no data: provable problems are repaired, others are reported."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

from hybridlog.columns.payload_files import open_segment
from hybridlog.entries import journal_from_segments, put_entry, take_inventory, unlisted_lines
from hybridlog.maintenance import tables
from hybridlog.maintenance.index import StoreIndex
from hybridlog.maintenance.opening import finish_moves, moving_name
from hybridlog.maintenance.verify import RESTORE, damaged_files
from hybridlog_storage.disk import durability, files
from hybridlog_storage.disk.directory import LOCK_WAIT_S, PAYLOADS
from hybridlog_storage.errors import HeldError, SegmentError, StoreError, TopicError
from hybridlog_storage.journal import Journal
from hybridlog_storage.mongo.index_state import IndexState
from hybridlog_storage.segments.recovery import rebuild_summary
from hybridlog_storage.segments.segment_check import SegmentCheck

if TYPE_CHECKING:
    from pathlib import Path

    from hybridlog.entries import Inventory, Misfit
    from hybridlog.maintenance.report import Progress, RepairReport
    from hybridlog_storage.catalog import Catalog, RecordingEntry
    from hybridlog_storage.disk.directory import StoreDirectory
    from hybridlog_storage.mongo.database import Database


@dataclass(frozen=True, slots=True)
class Repaired:
    """A repair, or a problem that could not be repaired.

    Attributes:
        recording: Label of the recording.
        place: File or other subject.
        done: The repair, or the remaining work.
        is_cured: Whether the problem is solved.
    """

    recording: str
    place: str
    done: str
    is_cured: bool = True


def repair(
    directory: StoreDirectory,
    catalog: Catalog,
    repairs: RepairReport,
    entries: Iterable[RecordingEntry] | None,
) -> list[Repaired]:
    """Repair files, journals and the catalog.

    Raises:
        StoreError: The store cannot be written.
    """
    directory.check_writable()
    done = [Repaired(label, "journal", "rebuilt") for label in repairs.journals]
    checker = tables.TableChecker(directory)
    chosen = [(label, "") for label in directory.labels()]
    for label, recording in chosen if entries is None else [(e.label, e.id) for e in entries]:
        if label in repairs.copies:
            original = repairs.copies[label]
            what = f"it is a copy of {original}; remove one: `hybridlog rm {label}`"
            done.append(Repaired(label, "recording", what, is_cured=False))
            continue
        try:
            with directory.writing(label, recording, wait_s=LOCK_WAIT_S) as now:
                done += _repair_one(directory, now)
                entry = put_entry(directory, catalog, now)
            if entry.status not in {"damaged", "open"}:
                # Tables of lost data are valid again after its restoration.
                made = checker.repair(entry)
                done += [Repaired(entry.label, f"table of {topic}", "made again") for topic in made]
        except HeldError as error:
            if recording:
                done.append(Repaired(label, "recording", str(error), is_cured=False))
        except (StoreError, TopicError) as error:
            done.append(Repaired(label, "recording", str(error), is_cured=False))
    return done


def _repair_one(directory: StoreDirectory, label: str) -> list[Repaired]:
    done = _put_segments_right(directory, label)
    done += _put_journal_right(directory, label)
    inventory = take_inventory(directory, label)
    for misfit in inventory.misfits:
        what = f"{misfit.reason}; restore it from a copy, if there is one"
        place = misfit.file or f"segment {misfit.segment}"
        done.append(Repaired(label, place, what, is_cured=False))
    return [*done, *_damage(directory.recording(label), inventory)]


def _damage(path: Path, inventory: Inventory) -> Iterator[Repaired]:
    """Read every byte of segments and columns; damage in them can only be restored."""
    for file, problem in damaged_files(path, inventory):
        what = f"{problem}; {RESTORE}"
        yield Repaired(inventory.label, f"{PAYLOADS}/{file}", what, is_cured=False)
    for number in inventory.summaries:
        name = inventory.listing.sealed[number]
        with SegmentCheck(path / name) as check:
            for offset, problem in check.problems():
                what = f"{problem}; {RESTORE}"
                yield Repaired(inventory.label, f"{name} byte {offset}", what, is_cured=False)


def _put_segments_right(directory: StoreDirectory, label: str) -> list[Repaired]:
    """Restore the names of segments and rebuild damaged summaries."""
    path = directory.recording(label)
    inventory = take_inventory(directory, label)
    done = [
        Repaired(label, misfit.file, "its summary was rebuilt")
        for misfit in inventory.misfits
        if misfit.file and _rebuild(inventory, misfit, path)
    ]
    inventory = take_inventory(directory, label)
    moved = [m for m in inventory.misfits if m.belongs is not None]
    wanted = {m.belongs for m in moved if m.belongs not in inventory.summaries}
    try:
        for misfit in moved:
            if misfit.belongs is not None and misfit.belongs in wanted:
                wanted.discard(misfit.belongs)
                # Temporary names first, since two exchanged segments need each other's name. If
                # this is interrupted, the temporary name tells the remaining step.
                files.rename(path / misfit.file, path / moving_name(misfit.file, misfit.belongs))
    except OSError as error:
        raise durability.explain(error, path, "renaming segments of") from error
    return done + [
        Repaired(label, before, f"is {now} again")
        for before, now in finish_moves(directory, label, replace=True)
    ]


def _rebuild(inventory: Inventory, misfit: Misfit, path: Path) -> bool:
    """Rebuild a damaged summary, if the result has the digest in the journal."""
    sealed = inventory.state.sealed.get(misfit.segment) if inventory.state is not None else None
    if sealed is None or misfit.belongs is not None:
        return False
    return rebuild_summary(path / misfit.file, sealed.digest)


def _put_journal_right(directory: StoreDirectory, label: str) -> list[Repaired]:
    path = directory.recording(label)
    inventory = take_inventory(directory, label)
    state = inventory.state
    if state is None:
        return []
    log = Journal(path)
    if state.damaged:
        reason = f"{len(state.damaged)} of its lines could not be read"
        log.replace(journal_from_segments(inventory, directory.settings.store_id, reason))
        return [Repaired(label, "journal", "rebuilt; the old one is journal.old")]
    done = []
    if state.torn:
        log.append()
        done.append(Repaired(label, "journal", f"{state.torn} bytes after its last line cut off"))
    if lines := unlisted_lines(inventory):
        log.append(*lines)
        unlisted = [misfit.file for misfit in inventory.misfits if misfit.is_unlisted]
        done += [Repaired(label, file, "listed in the journal") for file in unlisted]
    return done


def repair_index(
    directory: StoreDirectory,
    catalog: Catalog,
    database: Database,
    entries: Sequence[RecordingEntry],
    *,
    progress: Progress | None = None,
) -> list[Repaired]:
    """Index those of some recordings that are not completely indexed.

    Raises:
        DatabaseError: MongoDB fails.
    """
    index = StoreIndex(directory, catalog, database, progress)
    known = IndexState(database).of([entry.key for entry in entries])
    done = []
    for entry in entries:
        indexed = known.get(entry.key)
        if entry.status == "open":
            continue
        if _is_restored(directory, catalog, entry):
            if not index.rebuild([entry]):
                done.append(Repaired(entry.label, "index", "damaged chunks are readable again"))
            continue
        if indexed is not None and indexed.is_whole(entry) and entry.is_decoded:
            continue
        with suppress(HeldError, TopicError), directory.writing(entry.label, entry.id) as label:
            chunks = index.catch_up(label)
            done.append(Repaired(label, "index", f"{chunks} chunks indexed"))
    return done


def _is_restored(directory: StoreDirectory, catalog: Catalog, entry: RecordingEntry) -> bool:
    """True if an unreadable chunk is readable again, after its file was restored."""
    for number, chunk in catalog.damage(entry.id):
        path = directory.recording(entry.label) / f"{number:06d}.mcap"
        with suppress(SegmentError), open_segment(path, number) as reader:
            reader.read_chunk(reader.summary().chunks[chunk])
            return True
    return False
