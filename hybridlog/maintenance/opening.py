"""Looks at the recordings of a store, and finishes what a crash or a killed command has left.

A look writes nothing but the catalog. If the state of a recording's files matches its catalog
row, the files are not opened. No server is needed.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from dataclasses import replace as replaced
from typing import TYPE_CHECKING

from msgspec import to_builtins

from hybridlog.entries import (
    NO_MANIFEST,
    describe,
    described_of,
    ended,
    inventory_of,
    listed,
    lost_in_crash,
    state_of,
    steady_inventory,
    summary_by,
    take_inventory,
    unlisted,
    with_said,
)
from hybridlog.maintenance import tables
from hybridlog.snapshot import UNFINISHED, Snapshot
from hybridlog_storage.catalog import Catalog, Described
from hybridlog_storage.errors import DiskFullError, RecordingGoneError, StoreError, TopicError
from hybridlog_storage.manifest import Manifest, replace

if TYPE_CHECKING:
    from hybridlog.maintenance.report import RepairReport
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.disk.directory import Listing, StoreDirectory
    from hybridlog_storage.segments.recovery import Recovered
    from hybridlog_storage.segments.segment_file import Sealed
    from hybridlog_storage.summary import RecordingSummary, TopicType


def open_catalog(directory: StoreDirectory) -> Catalog:
    """Open the catalog of a store; in memory if the store cannot be written."""
    return Catalog(
        directory.path,
        directory.settings.store_id,
        in_memory=not directory.is_writable,
        cells=directory.cells,
    )


@dataclass(slots=True)
class StoreFiles:
    """The recordings of a store, compared with their files."""

    directory: StoreDirectory
    catalog: Catalog
    report: RepairReport
    _left: set[str] = field(default_factory=set)  # ids of those that `recover` would change
    _gone: set[str] = field(default_factory=set)  # of those that only the catalog has
    _is_swept: bool = False

    def look(self, before: Snapshot, recordings: Collection[str]) -> Snapshot:
        """`before`, with some recordings as they are now; those that are gone are left out.

        The files of a recording are read if it is new, or looks different from outside. All
        others are compared with their files before they first answer, see `current_entry`.
        """
        directory, catalog, report = self.directory, self.catalog, self.report
        is_first = not before.summaries  # of all
        rows = {one.id: one for one in catalog.summaries(None if is_first else recordings)}
        self._gone |= rows.keys() - {*recordings} if is_first else set()
        for recording in recordings:
            report.unreadable.pop(recording, None)
        found = self._find(directory.looks(sorted(recordings)), rows)
        for name in directory.manifests.without():
            report.unreadable[name] = _lost(directory, name)
        topics = {one.topics: catalog.topics(one.topics) for one in found.values()}
        return before.with_changes(found.values(), topics, recordings)

    def _find(
        self,
        looks: Mapping[str, str],
        known: Mapping[str, RecordingSummary],
    ) -> dict[str, RecordingSummary]:
        """Summaries by id, from the looks of directories and the summaries in the catalog."""
        found: dict[str, RecordingSummary] = {}
        due = set[str]()
        for recording, look in looks.items():
            summary = known.get(recording)
            if summary is None or summary.look != look or summary.status in UNFINISHED:
                due.add(recording)
            else:
                found[recording] = summary
        whole = self._by_manifests({one: looks[one] for one in due}, known)
        for recording in sorted(due - whole.keys()):
            try:
                summary = self._look_again(recording)
            except StoreError as error:
                if self.directory.has(recording):  # another process may have removed it
                    self.report.unreadable[recording] = str(error)
                continue
            if summary is not None:
                found[recording] = summary
        return found | whole

    def _by_manifests(
        self, looks: Mapping[str, str], known: Mapping[str, RecordingSummary]
    ) -> dict[str, RecordingSummary]:
        """Summaries of those of some recordings that are whole, by id; no log is opened."""
        found: dict[str, RecordingSummary] = {}
        topics: dict[str, Collection[TopicType]] = {}
        damaged = self.catalog.damaged(looks)
        for manifest in self.directory.whole(one for one in looks if one not in damaged):
            made = summary_by(manifest, looks[manifest.id])
            if made is not None:
                summary, topics[summary.topics] = made
                found[summary.id] = summary
        if found:
            before = {
                one: known[one]._replace(look="", indexed_by="") for one in found if one in known
            }
            is_change = any(before.get(one.id) != one._replace(look="") for one in found.values())
            self.catalog.put_summaries(found.values(), topics, is_change=is_change)
        return found

    def _look_again(self, recording: str) -> RecordingSummary | None:
        """The summary of a recording as its files are now; None if it is gone."""
        known = self._known(recording)
        if known is None:
            described = self._read(recording)
            return described.summary if described is not None else None
        entry, look, files, is_noted = known
        found = described_of(entry, look, files)
        if found.entry.status not in UNFINISHED or not is_noted:
            self.catalog.put(found)
        return found.summary

    def _known(self, recording: str) -> tuple[RecordingEntry, str, str, bool] | None:
        """A recording by its catalog row, with what people say of it by now.

        Its entry, its look, the state of its files, and True if the row has all of it already;
        None if the row does not match the files.
        """
        directory, row = self.directory, self.catalog.recording(recording)
        if row is None:
            return None
        files, entry = row
        listing = directory.listing(recording)
        try:
            manifest = directory.manifests.read(recording)
        except RecordingGoneError:
            return None
        if files != state_of(listing, manifest):
            return None
        if _has_left(listing, manifest):
            holder = directory.holder(recording)
            if holder is None or not (holder.is_recording or entry.status != "open"):
                return None
        said = with_said(entry, manifest)
        return said, listing.look, files, said == entry

    def current_entry(self, summary: RecordingSummary) -> tuple[RecordingEntry | None, bool]:
        """The entry of a recording, None if it is gone; and whether its files were read again."""
        known = self._known(summary.id)
        if known is not None:
            return known[0], False
        described = self._read(summary.id)
        return (described.entry if described is not None else None), True

    def _read(self, recording: str) -> Described | None:
        """Read what is whole of a recording, and put it into the catalog; None if it is gone."""
        directory, catalog = self.directory, self.catalog
        try:
            is_open = directory.is_recorded(recording)
            inventory = steady_inventory(directory, recording)
            described = describe(catalog, inventory, is_open=is_open)
        except RecordingGoneError:
            self._left.add(recording)  # its removal was interrupted
            return None
        except StoreError:
            if directory.has(recording):
                raise
            return None  # another process has just removed it
        noted, manifest = described, inventory.manifest
        if not is_open and manifest and _has_left(directory.listing(recording), manifest):
            self._left.add(recording)  # each process sees it, as long as the row has no look
            noted = replaced(described, summary=described.summary._replace(look=""))
        catalog.put(noted)
        return described

    def recover(self, died: Collection[str]) -> set[str]:
        """Finish what was interrupted, and seal what recorders that `died` have left.

        Returns the ids of the recordings that have changed. What another process holds stays, and
        so does what needs more room than the disk has.
        """
        directory, done = self.directory, set[str]()
        if self.catalog.is_in_memory:
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
        directory.manifests.clear()
        known = {*directory.ids(), *directory.manifests.without()}
        gone = self._gone - known
        tables.clear(directory, gone, known)
        for recording in gone:
            catalog.remove(recording)
        self._is_swept = True


def _has_left(listing: Listing, manifest: Manifest) -> bool:
    """True if a recorder or a change that was interrupted has left something, unless it goes on."""
    unlisted_logs = listing.sealed.keys() - manifest.logs.keys()
    return not manifest.is_ended or bool(
        unlisted_logs or listing.open or listing.left_over(manifest)
    )


def _lost(directory: StoreDirectory, name: str) -> str:
    """What to say of a folder without a manifest."""
    try:
        listing = directory.listing(name)
        inventory_of(directory, name, listing, None)
    except StoreError as error:
        return str(error)
    if listing.sealed or listing.rows or listing.open:
        return NO_MANIFEST.format(name)
    return "it has neither a manifest nor a segment, but other files"


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
    recovered = recover_segments(directory, recording, listing, manifest)
    inventory = take_inventory(directory, recording)
    is_empty = not (inventory.listing.sealed or manifest.logs or manifest.marks)
    if is_empty and not manifest.is_ended:
        directory.manifests.remove(recording)
        report.recovered[inventory.name] = recovered
        return
    if recovered:
        report.recovered[inventory.name] = recovered
    adopt = unlisted(inventory)

    def change(now: Manifest) -> Manifest:
        now = adopt(now)
        return now if now.is_ended else ended("recovered")(now)

    directory.manifests.change(recording, change)


def recover_segments(
    directory: StoreDirectory, recording: str, listing: Listing, manifest: Manifest | None
) -> list[Recovered]:
    """Seal what a killed recorder has left; the manifest, if there is one, lists it first."""
    from hybridlog_storage.segments.recovery import recover_segment

    path = directory.recording(recording)
    said = None
    if manifest is not None:
        said = {
            "id": manifest.id,
            "name": manifest.name,
            "tags": dict(manifest.tags),
            "source": to_builtins(manifest.source),
            "created": manifest.created,
        }

    def announce(sealed: Sealed, found: Recovered) -> None:
        if manifest is None:
            return
        before = manifest.logs.get(sealed.file.number)
        if before is None or before.digest != sealed.file.digest:
            lost = () if before is None else lost_in_crash(manifest, sealed)

            def change(now: Manifest) -> Manifest:
                return replace(
                    listed(sealed)(now),
                    losses=(*now.losses, *lost),
                    cut_bytes=now.cut_bytes + found.cut_bytes,
                    damage=(*now.damage, *found.damage),
                )

            directory.manifests.change(recording, change)

    return [
        recover_segment(path / name, announce, recording=said) for name in listing.open.values()
    ]
