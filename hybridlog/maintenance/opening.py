"""Opens a store: recovers recordings after a crash and brings the catalog up to date.

No server is needed. If the state of a recording's files matches its catalog row, the files
are not opened.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from collections.abc import Set as AbstractSet
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

from msgspec import to_builtins

from hybridlog.entries import (
    NO_MANIFEST,
    describe_now,
    described_of,
    ended,
    inventory_of,
    listed,
    lost_in_crash,
    state_of,
    summary_by,
    take_inventory,
    unlisted,
    with_said,
)
from hybridlog.snapshot import UNFINISHED, Snapshot
from hybridlog_storage.catalog import Catalog, Described
from hybridlog_storage.errors import (
    DiskFullError,
    HeldError,
    RecordingGoneError,
    StoreError,
    TopicError,
)
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


@dataclass(frozen=True, slots=True)
class StoreFiles:
    """The recordings of a store, compared with their files, and recovered if it `mends`."""

    directory: StoreDirectory
    catalog: Catalog
    report: RepairReport
    mends: bool = False

    def look_at_all(self) -> Snapshot:
        """All recordings.

        The files of a recording are read if it is new, or looks different from outside. All
        others are compared with their files before they first answer, see `current_entry`.
        """
        from hybridlog.maintenance import tables

        directory, catalog, report = self.directory, self.catalog, self.report
        mends = self.mends and not catalog.is_in_memory
        rows = catalog.summaries()
        report.unreadable.clear()
        ids = directory.ids()
        found = self._find(directory.looks(ids), {one.id: one for one in rows})
        if mends:
            directory.manifests.clear()  # what killed processes left
        for name in directory.manifests.without():
            report.unreadable[name] = _lost(directory, name)
        # The row of a recording that is unreadable now may be valid again later.
        known = found.keys() | report.unreadable.keys()
        gone = {one.id for one in rows} - known
        if mends:
            tables.clear(directory, gone, known)
        for recording in gone if mends or catalog.is_in_memory else ():
            catalog.remove(recording)
        topics = {one.topics: catalog.topics(one.topics) for one in found.values()}
        return Snapshot(found.values(), topics)

    def catch_up(self, snapshot: Snapshot, recordings: AbstractSet[str]) -> Snapshot | None:
        """All recordings after some came, went or changed; None if only `look_at_all` can tell."""
        directory, catalog, report = self.directory, self.catalog, self.report
        if report.unreadable:
            return None
        try:
            rows = {summary.id: summary for summary in catalog.summaries(recordings)}
            looks = directory.looks(sorted(recordings))
            found = self._find(looks, rows)
            if report.unreadable or any(map(directory.has, recordings - looks.keys())):
                return None
            topics = {one.topics: catalog.topics(one.topics) for one in found.values()}
        except StoreError:
            return None
        return snapshot.with_changes(found.values(), topics, recordings)

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
            except DiskFullError:
                raise
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
            described = self._refresh(recording)
            return described.summary if described is not None else None
        found = described_of(*known)
        is_noted = self.catalog.recording(recording) == (found.files, found.entry)
        if found.entry.status not in UNFINISHED or not is_noted:
            self.catalog.put(found)
        return found.summary

    def _known(self, recording: str) -> tuple[RecordingEntry, str, str] | None:
        """A recording by its catalog row, with what people say of it by now.

        Its entry, its look and the state of its files; None if the row does not match them.
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
        if not manifest.is_ended or listing.open or listing.left_over(manifest):
            holder = directory.holder(recording)
            if holder is None or not (holder.is_recording or entry.status != "open"):
                return None
        return with_said(entry, manifest), listing.look, files

    def current_entry(self, summary: RecordingSummary) -> tuple[RecordingEntry | None, bool]:
        """The entry of a recording, None if it is gone; and whether its files were read again."""
        known = self._known(summary.id)
        if known is not None:
            return known[0], False
        described = self._refresh(summary.id)
        return (described.entry if described is not None else None), True

    def _refresh(self, recording: str) -> Described | None:
        """Read what is whole of a recording, and put it into the catalog; None if it is gone.

        With `mends`, what a crash has left is mended.
        """
        directory, catalog = self.directory, self.catalog
        mends = self.mends and self.report.disk_full is None and not catalog.is_in_memory
        try:
            if mends and os.access(directory.recording(recording), os.W_OK):
                with suppress(HeldError, TopicError), directory.writing(recording):
                    if not recover(directory, recording, self.report):
                        return None
                    described = describe_now(directory, catalog, recording)
                    catalog.put(described)
                    return described
            is_open = directory.is_recorded(recording)
            described = describe_now(directory, catalog, recording, is_open=is_open)
        except RecordingGoneError:
            return None
        except StoreError:
            if directory.has(recording):
                raise
            return None  # another process has just removed it
        catalog.put(described)
        return described


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


def recover(directory: StoreDirectory, recording: str, report: RepairReport) -> bool:
    """Finish the interrupted work on a recording that this process has locked; False if gone."""
    try:
        manifest = directory.manifests.read(recording)
    except RecordingGoneError:
        removed = directory.manifests.remove(recording)  # finishes it, or says that there is none
        report.removed.append(removed.name)
        return False
    listing = directory.listing(recording)
    directory.drop(recording, listing.left_over(manifest))
    recovered = recover_segments(directory, recording, listing, manifest)
    inventory = take_inventory(directory, recording)
    is_empty = not (inventory.listing.sealed or manifest.logs or manifest.marks)
    if is_empty and not manifest.is_ended:
        directory.manifests.remove(recording)
        report.recovered[inventory.name] = recovered
        return False
    if recovered:
        report.recovered[inventory.name] = recovered
    adopt = unlisted(inventory)

    def change(now: Manifest) -> Manifest:
        now = adopt(now)
        return now if now.is_ended else ended({"status": "recovered"})(now)

    directory.manifests.change(recording, change)
    return True


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
