"""Opens a store: recovers recordings after a crash and brings the catalog up to date.

No server is needed. If the state of a recording's files matches its catalog row, the files
are not opened.
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Collection, Mapping
from collections.abc import Set as AbstractSet
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

from msgspec import to_builtins

from hybridlog.entries import (
    NO_MANIFEST,
    describe_now,
    ended,
    inventory_of,
    listed,
    lost_in_crash,
    state_of,
    summary_by,
    summary_of,
    take_inventory,
    topic_types,
    unlisted,
    with_marks,
    with_said,
)
from hybridlog.snapshot import UNFINISHED, Snapshot
from hybridlog_storage.catalog import Catalog, Described
from hybridlog_storage.disk import durability, files
from hybridlog_storage.errors import (
    DiskFullError,
    HeldError,
    RecordingGoneError,
    StoreError,
    TopicError,
)
from hybridlog_storage.manifest import Manifest, replace

if TYPE_CHECKING:
    from hybridlog.entries import Inventory
    from hybridlog.maintenance.report import RepairReport
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.disk.directory import Listing, StoreDirectory
    from hybridlog_storage.segments.recovery import Recovered
    from hybridlog_storage.segments.segment_file import Sealed
    from hybridlog_storage.summary import RecordingSummary, TopicType

_LEFT_OVER = re.compile(r"\.[0-9.]+\.mcap\.([0-9a-f]{16}|rebuilt)")
"""Names of files that were being written, and were to get another name when they were whole."""
_MOVING = re.compile(r"(?P<before>[0-9.]+\.mcap)\.moving-(?P<final>[0-9.]+\.mcap)")
_RECOVERED_BYTES_PER_S = 200e6
"""Size of the open segments that are recovered in a second, about."""


def open_catalog(directory: StoreDirectory, *, in_memory: bool = False) -> Catalog:
    """Open the catalog of a store; in memory if the store cannot be written.

    Args:
        directory: The store.
        in_memory: Use memory in any case, for a full disk.
    """
    return Catalog(
        directory.path,
        directory.settings.store_id,
        in_memory=in_memory or not directory.is_writable,
        cells=directory.catalog_cells(),
    )


@dataclass(frozen=True, slots=True)
class StoreFiles:
    """The recordings of a store, compared with their files, and recovered.

    Attributes:
        directory: The store.
        catalog: Its catalog.
        report: Collects problems and repairs.
    """

    directory: StoreDirectory
    catalog: Catalog
    report: RepairReport

    def look_at_all(self, *, mends: bool = False) -> Snapshot:
        """All recordings.

        The files of a recording are read if it is new, or looks different from outside. All
        others are compared with their files before they first answer, see `current_entry`.

        Args:
            mends: Repair what a crash has left, as when a store is opened; otherwise it is noted.
        """
        from hybridlog.maintenance import tables

        directory, catalog, report = self.directory, self.catalog, self.report
        mends = mends and not catalog.is_in_memory
        # A recording has its manifest before it has tables.
        gone = tables.unfinished(directory) if mends else set()
        rows = catalog.summaries()
        report.unreadable.clear()
        ids = directory.ids()
        found = self._find(directory.looks(ids), {one.id: one for one in rows}, mends=mends)
        self._note_lost(mends=mends)
        for summary in rows if mends or catalog.is_in_memory else ():
            # The row of a recording that is unreadable now may be valid again later.
            if summary.id not in found and summary.id not in report.unreadable:
                catalog.remove(summary.id)
                gone.add(summary.id)
        snapshot = snapshot_of(catalog, found.values())
        if gone and mends and not report.unreadable:
            tables.remove_unfinished(directory, snapshot)
            tables.remove_all(directory, gone - found.keys())
        return snapshot

    def _note_lost(self, *, mends: bool) -> None:
        """Note folders without a manifest, and remove what killed processes left of others."""
        manifests = self.directory.manifests
        if mends:
            manifests.clear()
        for name in manifests.without():
            self.report.unreadable[name] = _lost(self.directory, name)

    def catch_up(self, snapshot: Snapshot, recordings: AbstractSet[str]) -> Snapshot | None:
        """All recordings after changes of some of them, as of `look_at_all`.

        Args:
            snapshot: All recordings before.
            recordings: Ids of those that came, went, or whose files were changed.

        Returns:
            All recordings; None if only `look_at_all` can tell.
        """
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
        *,
        mends: bool = False,
    ) -> dict[str, RecordingSummary]:
        """Summaries of recordings by id.

        Args:
            looks: The look of each directory, by id.
            known: Summaries in the catalog, by id.
            mends: Repair what a crash has left; otherwise it is noted.
        """
        found: dict[str, RecordingSummary] = {}
        due = set[str]()
        for recording, look in looks.items():
            summary = known.get(recording)
            if summary is None or summary.look != look or summary.status in UNFINISHED:
                due.add(recording)
            else:
                found[recording] = summary
        whole = self._by_manifests({one: looks[one] for one in due})
        for recording in sorted(due - whole.keys()):
            try:
                summary = self._look_again(recording, mends=mends)
            except DiskFullError:
                raise
            except StoreError as error:
                if self.directory.has(recording):  # another process may have removed it
                    self.report.unreadable[recording] = str(error)
                continue
            if summary is not None:
                found[recording] = summary
        return found | whole

    def _by_manifests(self, looks: Mapping[str, str]) -> dict[str, RecordingSummary]:
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
            self.catalog.put_summaries(found.values(), topics)
        return found

    def _look_again(self, recording: str, *, mends: bool) -> RecordingSummary | None:
        """The summary of a recording as its files are now; None if it is gone."""
        known = self._known(recording)
        if known is not None:
            found = known.described
            if known.has_changed or found.entry.status not in UNFINISHED:
                self.catalog.put(found, waits=False)
            return found.summary
        mends = mends and self._may_mend(recording)
        described = (self._mended if mends else self._refresh)(recording)
        return described.summary if described is not None else None

    def _known(self, recording: str) -> _Known | None:
        """A recording by its catalog row, if that still matches its files."""
        directory, row = self.directory, self.catalog.recording(recording)
        if row is None:
            return None
        files, entry = row
        listing = directory.listing(recording)
        try:
            manifest = directory.manifests.read(recording)
        except RecordingGoneError:
            return None
        if files != state_of(listing, manifest) or not self._is_settled(entry, listing):
            return None
        now = with_said(entry, manifest)
        return _Known(now, files, listing.look, now != entry)

    def _is_settled(self, entry: RecordingEntry, listing: Listing) -> bool:
        """False if a process that is gone has left something to mend."""
        if listing.open or entry.status == "open" or _has_left_over(entry, listing):
            holder = self.directory.holder(entry.id)
            return holder is not None and (holder.is_recording or entry.status != "open")
        return True

    def current_entry(self, summary: RecordingSummary) -> tuple[RecordingEntry | None, bool]:
        """The entry of a recording, compared with its files.

        Returns:
            The entry, None if the recording is gone; and whether the files were read again.

        Raises:
            StoreError: Its files cannot be read.
        """
        known = self._known(summary.id)
        if known is not None:
            if known.has_changed:
                self.catalog.put(known.described, waits=False)
            return known.entry, False
        if not self.directory.has(summary.id):
            return None, True
        described = self._refresh(summary.id)
        return (described.entry if described is not None else None), True

    def _refresh(self, recording: str) -> Described | None:
        """Read what is whole of a recording, keep it in memory, and note what to mend.

        None if the recording is gone.
        """
        is_open = self.directory.is_recorded(recording)
        if not is_open and self._may_mend(recording) and is_unfinished(self.directory, recording):
            self.report.noted.add(recording)
        return self._describe(recording, is_open=is_open)

    def _may_mend(self, recording: str) -> bool:
        if self.catalog.is_in_memory:
            return False
        return os.access(self.directory.recording(recording), os.W_OK)

    def _describe(self, recording: str, *, is_open: bool) -> Described | None:
        try:
            described = describe_now(self.directory, self.catalog, recording, is_open=is_open)
        except StoreError as error:
            if isinstance(error, RecordingGoneError) or not self.directory.has(recording):
                return None
            raise
        self.catalog.put(described, waits=False)
        return described

    def _mended(self, recording: str) -> Described | None:
        """Recover a recording after a crash, and update its catalog row; None if it is gone."""
        directory, catalog = self.directory, self.catalog
        try:
            with directory.writing(recording):
                if not recover(directory, recording, self.report):
                    return None
                described = describe_now(directory, catalog, recording)
                catalog.put(described)
                return described
        except (HeldError, TopicError):
            pass
        except RecordingGoneError:
            return None
        return self._describe(recording, is_open=directory.is_recorded(recording))

    def mend(self, until: float) -> set[str]:
        """Recover the recordings that were noted, and update their catalog rows.

        Args:
            until: When this should end, by `time.monotonic`; what would take longer stays noted.

        Returns:
            Ids of the recordings.
        """
        mended, report = set(), self.report
        for recording in sorted([*report.noted]):  # other threads note more
            if (
                _open_bytes(self.directory, recording)
                > (until - time.monotonic()) * _RECOVERED_BYTES_PER_S
            ):
                continue
            report.noted.discard(recording)
            report.unreadable.pop(recording, None)
            try:
                described = self._mended(recording)
            except DiskFullError:
                raise
            except StoreError as error:
                if self.directory.has(recording):
                    report.unreadable[recording] = str(error)
                continue
            if described is not None:
                mended.add(described.entry.id)
        return mended


class _Known(NamedTuple):
    """A recording by its catalog row, with what people say of it by now."""

    entry: RecordingEntry
    files: str
    look: str
    has_changed: bool  # they say something else than the row

    @property
    def described(self) -> Described:
        """For the catalog."""
        shown = with_marks(self.entry)
        summary, topics = summary_of(shown, self.look), topic_types(shown)
        return Described(self.entry, summary, topics, self.files, {})


def snapshot_of(catalog: Catalog, summaries: Collection[RecordingSummary]) -> Snapshot:
    """Some recordings with their topics.

    Raises:
        CatalogError: The catalog has lost topics.
    """
    hashes = {summary.topics for summary in summaries}
    return Snapshot(summaries, {digest: catalog.topics(digest) for digest in hashes})


def _has_left_over(entry: RecordingEntry, listing: Listing) -> bool:
    """True if files are left from an interrupted step."""
    rows = {name for name, _, _ in entry.rows}
    is_expiring = listing.rows.keys() - rows or {*map(str, listing.sealed)} & entry.files.keys()
    return bool(is_expiring) or any(map(is_left_over, listing.others))


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


def _open_bytes(directory: StoreDirectory, recording: str) -> int:
    """Size of the segments of a recording that are not sealed."""
    path, found = directory.recording(recording), 0
    for name in directory.listing(recording).open.values():
        with suppress(OSError):
            found += files.status(path / name).st_size
    return found


def recover(directory: StoreDirectory, recording: str, report: RepairReport) -> bool:
    """Finish the interrupted work on a recording that this process has locked.

    Returns:
        False if it is gone.

    Raises:
        StoreError: It cannot be written, or its manifest cannot be read.
        DiskFullError: No room; nothing is lost.
    """
    path = directory.recording(recording)
    try:
        manifest = directory.manifests.read(recording)
    except RecordingGoneError:
        removed = directory.manifests.remove(recording)  # finishes it, or says that there is none
        report.removed.append(removed.name)
        return False
    clear_away(directory, recording)
    listing = directory.listing(recording)
    for one in listing.left_over(manifest):
        try:
            files.unlink(path / one)
        except OSError as error:
            raise durability.explain(error, path / one, "removing") from error
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
    end = None if manifest.is_ended else _end_of(inventory)

    def change(now: Manifest) -> Manifest:
        now = now if adopt is None else adopt(now)
        return now if end is None or now.is_ended else ended(end)(now)

    directory.manifests.change(recording, change)
    return True


def is_unfinished(directory: StoreDirectory, recording: str) -> bool:
    """True if `recover` has something to do: new files alone may be as the manifest says."""
    try:
        manifest = directory.manifests.read(recording)
        listing = directory.listing(recording)
    except StoreError:
        return True
    return bool(
        not manifest.is_ended
        or listing.open
        or listing.left_over(manifest)
        or listing.sealed.keys() - manifest.logs.keys()  # it may be whole, and not listed
        or any(map(is_left_over, listing.others))
    )


def is_left_over(name: str) -> bool:
    """True if a file in a recording's directory is left from an interrupted step."""
    return any(pattern.fullmatch(name) for pattern in (_LEFT_OVER, _MOVING))


def clear_away(directory: StoreDirectory, recording: str) -> None:
    """Remove temporary files, and finish the renaming of segments."""
    finish_moves(directory, recording)
    path = directory.recording(recording)
    for name in directory.listing(recording).others:
        if _LEFT_OVER.fullmatch(name):
            try:
                files.unlink(path / name)
            except OSError as error:
                raise durability.explain(error, path / name, "removing") from error


def moving_name(name: str, final: str) -> str:
    """Temporary name of a segment that is being renamed."""
    return f"{name}.moving-{final}"


def finish_moves(
    directory: StoreDirectory, recording: str, *, replace: bool = False
) -> list[tuple[str, str]]:
    """Finish the renaming of segments.

    Args:
        directory: The store.
        recording: The recording, locked by this process.
        replace: Rename an existing file of that name to `.damaged`: the manifest does not list
            it. Otherwise it stays, as it may be renamed itself.

    Returns:
        Old and new name of each.
    """
    path = directory.recording(recording)
    done = []
    try:
        for name in directory.listing(recording).others:
            moving = _MOVING.fullmatch(name)
            if moving is None:
                continue
            final = path / moving["final"]
            listing = directory.listing(recording)
            if final.name in {*listing.sealed.values(), *listing.others}:
                if not replace:
                    continue
                files.rename(
                    final, path / _free_name(directory, recording, f"{final.name}.damaged")
                )
            files.rename(path / name, final)
            done.append((moving["before"], final.name))
        if done:
            files.sync_folder(path)
    except OSError as error:
        raise durability.explain(error, path, "renaming segments of") from error
    return done


def _free_name(directory: StoreDirectory, recording: str, name: str) -> str:
    """A free file name: this one, or one with a number before its suffix."""
    taken = set(directory.listing(recording).others)
    stem, _, last = name.rpartition(".")
    return next(
        n for n in (name, *(f"{stem}.{i}.{last}" for i in range(2, 1 << 20))) if n not in taken
    )


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

    def announce(sealed: Sealed) -> None:
        if manifest is None:
            return
        before = manifest.logs.get(sealed.segment)
        if before is None or before.digest != sealed.digest:
            lost = () if before is None else lost_in_crash(manifest, sealed)

            def change(now: Manifest) -> Manifest:
                return replace(listed(sealed)(now), losses=(*now.losses, *lost))

            directory.manifests.change(recording, change)

    return [
        recover_segment(path / name, announce, recording=said) for name in listing.open.values()
    ]


def _end_of(inventory: Inventory) -> dict[str, Any]:
    """The `end` of a recording whose manifest does not have it."""
    return dict(inventory.end or {"status": "recovered", "cut_bytes": 0, "damage": []})
