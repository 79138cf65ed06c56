"""Looks at the recordings of a store, and finishes what a crash or a killed command has left.

A look reads manifests and names of files, and writes nothing but the catalog. No server is needed.
What is left over are tables, too: which a recording lacks, and how they are removed, is here.
"""

from __future__ import annotations

from collections.abc import Collection
from contextlib import suppress
from typing import TYPE_CHECKING

from msgspec import Struct, field

from hybridlog.columns.layout import PARTS, parts_folder, topics_of, type_prefix
from hybridlog.entries import (
    NO_MANIFEST,
    Seen,
    ended,
    lost_in_crash,
    recording_metadata,
    see,
    summary_by,
    unlisted,
    with_segments,
)
from hybridlog.snapshot import UNFINISHED, Snapshot
from hybridlog_storage.catalog import Catalog, Damage, RecordingEntry, RecordingSummary
from hybridlog_storage.disk import files
from hybridlog_storage.errors import DiskFullError, RecordingGoneError, StoreError, TopicError
from hybridlog_storage.manifest import Loss, Manifest, replace

if TYPE_CHECKING:
    from hybridlog.columns.tables import Tables
    from hybridlog.maintenance.report import RepairReport
    from hybridlog_storage.disk.directory import Listing, StoreDirectory
    from hybridlog_storage.segments.segment_file import Sealed
    from hybridlog_storage.segments.walk import Recovered


class StoreFiles(Struct):
    """The recordings of a store, compared with their files."""

    directory: StoreDirectory
    catalog: Catalog
    report: RepairReport
    _left: set[str] = field(default_factory=set)  # ids of those that `recover` would change
    _gone: set[str] = field(default_factory=set)  # of those that only the catalog has
    _is_swept: bool = False

    def look(self, before: Snapshot, recordings: Collection[str]) -> Snapshot:
        """`before`, with some recordings as they are now; those that are gone are left out.

        The manifest of a recording is read if it is new, or looks different from outside.
        """
        directory, catalog, report = self.directory, self.catalog, self.report
        is_first = not before.summaries  # of all
        rows = {one.id: one for one in catalog.summaries(None if is_first else recordings)}
        self._gone |= rows.keys() - {*recordings} if is_first else set()
        for recording in recordings:
            report.unreadable.pop(recording, None)
        looks = directory.looks(sorted(recordings))
        found = {
            one: rows[one]
            for one, look in looks.items()
            if one in rows and rows[one].look == look and rows[one].status not in UNFINISHED
        }
        found |= self._read(sorted(looks.keys() - found.keys()))
        for name in directory.manifests.without():
            report.unreadable[name] = NO_MANIFEST.format(name)
        topics = {one.topics: catalog.topics(one.topics) for one in found.values()}
        return before.with_changes(found.values(), topics, recordings)

    def _read(self, recordings: Collection[str]) -> dict[str, RecordingSummary]:
        """Summaries of some recordings by id, of their manifests; the catalog gets them at once."""
        found, damaged = {}, self.catalog.damaged(recordings)
        for recording in recordings:
            try:
                seen = self.see(recording, damaged.get(recording, {}))
            except StoreError as error:
                self.report.unreadable[recording] = str(error)
                continue
            if seen is not None:
                found[recording] = summary_by(seen)
        if found:
            self.catalog.put(found.values())
        return {recording: summary for recording, (summary, _) in found.items()}

    def see(self, recording: str, damage: Damage | None = None) -> Seen | None:
        """A recording by its manifest; None if it is gone.

        Without its known `damage`, the catalog tells that, and what was decoded.
        """
        catalog = self.catalog if damage is None else None
        known = self.catalog.damage(recording) if damage is None else damage
        try:
            seen = see(self.directory, recording, known, catalog)
        except RecordingGoneError:
            self._left.add(recording)  # its removal was interrupted
            return None
        except StoreError:
            if recording in self.directory.looks([recording]):
                raise
            return None  # another process has just removed it
        if seen.has_left:
            self._left.add(recording)
        return seen

    def recover(self, died: Collection[str]) -> set[str]:
        """Finish what was interrupted, and seal what recorders that `died` have left.

        Returns the ids of the recordings that have changed. What another process holds stays, and
        so does what needs more room than the disk has.
        """
        directory, done = self.directory, set[str]()
        if not directory.is_writable:
            return done
        if not self._is_swept:
            self._sweep()
        for recording in sorted(self._left | {*died}):
            with suppress(StoreError, TopicError, DiskFullError), directory.writing(recording):
                recover(directory, recording, self.report)
                done.add(recording)
        self._left -= done
        return done

    def _sweep(self) -> None:
        """Remove what killed processes have left outside of recordings."""
        directory, catalog = self.directory, self.catalog
        known = {*directory.ids(), *directory.manifests.without()}
        gone = self._gone - known
        clear_tables(directory, gone, known)
        for recording in gone:
            catalog.remove(recording)
        self._is_swept = True


def recover(directory: StoreDirectory, recording: str, report: RepairReport) -> None:
    """Finish the interrupted work on a recording that this process has locked."""
    try:
        manifest = directory.manifests.read(recording)
    except RecordingGoneError:
        removed = directory.manifests.remove(recording)  # finishes it, or says that there is none
        report.removed.append(removed.name)
        return
    listing = directory.listing(recording)
    directory.drop(recording, listing.left_over(manifest))
    if recovered := recover_segments(directory, recording, listing, manifest):
        report.recovered[manifest.name] = recovered
    manifest, listing = directory.manifests.read(recording), directory.listing(recording)
    if not (listing.sealed or manifest.logs or manifest.marks or manifest.is_ended):
        directory.manifests.remove(recording)
        report.recovered[manifest.name] = recovered
        return
    adopt = unlisted(directory, recording, listing, manifest)

    def change(now: Manifest) -> Manifest:
        now = adopt(now)
        return now if now.is_ended else ended("recovered")(now)

    directory.manifests.change(recording, change)


def recover_segments(
    directory: StoreDirectory, recording: str, listing: Listing, manifest: Manifest | None
) -> list[Recovered]:
    """Seal what a killed recorder has left; the manifest, if there is one, lists it first."""
    from hybridlog_storage.segments.walk import recover_segment

    path = directory.recording(recording)
    said = None if manifest is None else recording_metadata(manifest)

    def announce(sealed: Sealed, found: Recovered) -> None:
        if manifest is None:
            return
        before = manifest.logs.get(sealed.file.number)
        if before is None or before.digest != sealed.file.digest:
            lost = [] if before is None else lost_in_crash(manifest, sealed)
            lost += [Loss("damaged segment", reason=one) for one in found.damage]

            def change(now: Manifest) -> Manifest:
                return replace(with_segments(sealed)(now), losses=(*now.losses, *lost))

            directory.manifests.change(recording, change)

    return [
        recover_segment(path / name, announce, recording=said) for name in listing.open.values()
    ]


def missing(
    directory: StoreDirectory, entry: RecordingEntry, tables: Tables | None = None
) -> set[str]:
    """Topics of which tables lack rows, or have others than the catalog."""
    from hybridlog.columns.tables import Tables

    return (tables or Tables(directory.path)).lacking(entry, topics_of(entry))


def remove_tables(
    directory: StoreDirectory, recording: str, entry: RecordingEntry | None = None
) -> None:
    """Remove all tables of a recording."""
    from hybridlog.columns.table_writer import TableFolders

    prefixes = [""] if entry is None else {type_prefix(one.type) for one in entry.channels}
    created = None if entry is None else entry.created
    TableFolders(directory.path, recording, created).remove(prefixes)
    with suppress(FileNotFoundError):
        files.remove_tree(parts_folder(directory.path, recording))


def clear_tables(directory: StoreDirectory, gone: Collection[str], known: Collection[str]) -> None:
    """Remove tables of removed recordings, and unfinished files that a crash has left.

    `known` are the recordings that there are. What is impossible now is done the next time.
    """
    unfinished = set(gone)
    with suppress(OSError):
        unfinished.update(name.removeprefix("r") for name in files.names(directory.path / PARTS))
    for recording in sorted(unfinished):
        with suppress(OSError, StoreError, TopicError):
            if recording not in known:
                remove_tables(directory, recording)
                continue
            with directory.writing(recording):
                files.remove_tree(parts_folder(directory.path, recording))
