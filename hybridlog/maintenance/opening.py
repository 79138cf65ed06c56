"""Opens a store: recovers recordings after a crash and brings the catalog up to date.

No server is needed. If the state of a recording's files matches its catalog row, the files
are not opened.
"""

from __future__ import annotations

import re
import time
from collections.abc import Collection, Mapping
from collections.abc import Set as AbstractSet
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from hybridlog.columns import payload_files
from hybridlog.columns.layout import PAYLOAD_PARTS
from hybridlog.entries import (
    announce_removal,
    describe_now,
    journal_from_segments,
    sealed_event,
    take_inventory,
    unlisted_lines,
)
from hybridlog.snapshot import UNFINISHED, Snapshot
from hybridlog_storage import journal
from hybridlog_storage.catalog import Catalog
from hybridlog_storage.disk import durability, files
from hybridlog_storage.disk.directory import LOCK, REMOVED, SENDING
from hybridlog_storage.errors import (
    DiskFullError,
    HeldError,
    StoreError,
    TopicError,
)
from hybridlog_storage.journal import Journal
from hybridlog_storage.segments.segment_file import sealed_name

if TYPE_CHECKING:
    from pathlib import Path

    from hybridlog.entries import Inventory
    from hybridlog.maintenance.report import RepairReport
    from hybridlog_storage.catalog import Described, RecordingEntry
    from hybridlog_storage.disk.directory import Listing, StoreDirectory
    from hybridlog_storage.journal import JournalState
    from hybridlog_storage.segments.recovery import Recovered
    from hybridlog_storage.segments.segment_file import Sealed
    from hybridlog_storage.summary import RecordingSummary

_OURS = frozenset({LOCK})
"""Names in a recording's directory that hold nothing that could be lost."""
_LEFT_OVER = re.compile(r"\.(journal(\.old)?|\d{6}\.mcap)\.([0-9a-f]{16}|rebuilt)")
"""Names of files that were being written, and were to get another name when they were whole."""
_MOVING = re.compile(r"(?P<before>\d{6}\.mcap)\.moving-(?P<number>\d{6})")
_TRIES = 10
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
        # A recording has its directory before it has tables.
        gone = tables.unfinished(directory) if mends else set()
        if mends:
            for name in directory.names():
                if name.startswith(REMOVED):
                    directory.sweep(name)
            with suppress(OSError):  # the next opening tries again
                clear_stopped(directory)
        rows = catalog.summaries()
        known = {summary.label: summary for summary in rows}
        for _ in range(_TRIES):
            names = directory.names()
            looks = directory.looks(names)
            report.unreadable.clear()
            found = self._find(looks, known, mends=mends)
            # A recording that was renamed meanwhile must not be missed. If it has exchanged its
            # label with another one, that one may have been seen twice.
            is_twice = any(len(copies) > 1 for copies in found.values())
            if directory.names() == names and not (is_twice and directory.looks(names) != looks):
                break
        report.copies.clear()
        for recording, copies in found.items():
            if len(copies) > 1:
                found[recording] = [self._one_of(copies, known)]
        report.noted.difference_update(report.copies)
        for summary in rows if mends or catalog.is_in_memory else ():
            # The row of a recording that is unreadable now may be valid again later.
            if summary.id not in found and summary.label not in report.unreadable:
                catalog.remove(summary.id)
                gone.add(summary.id)
        snapshot = snapshot_of(catalog, [summary for (summary,) in found.values()])
        if gone and mends and not report.unreadable:
            tables.remove_unfinished(directory, snapshot)
            tables.remove_all(directory, gone - found.keys())
        return snapshot

    def catch_up(self, snapshot: Snapshot, labels: AbstractSet[str]) -> Snapshot | None:
        """All recordings after changes of some of them, as of `look_at_all`.

        Args:
            snapshot: All recordings before.
            labels: Names in the store that came, went, or whose files were changed.

        Returns:
            All recordings; None if only `look_at_all` can tell.
        """
        directory, catalog, report = self.directory, self.catalog, self.report
        if report.copies or report.unreadable:
            return None
        known = labels & snapshot.by_label.keys()
        old = {snapshot.summaries[snapshot.by_label[label]].id for label in known}
        try:
            looks = directory.looks(sorted(labels))
            new = {directory.id_of(label) for label in looks.keys() - known}
            rows = {summary.label: summary for summary in catalog.summaries(old | new)}
            found = self._find(looks, rows)
            is_twice = any(len(copies) > 1 for copies in found.values())
            elsewhere = found.keys() & snapshot.by_id.keys() - old
            if is_twice or elsewhere or report.unreadable:
                return None
            changed = [summary for (summary,) in found.values()]
            topics = {summary.topics: catalog.topics(summary.topics) for summary in changed}
        except StoreError:
            return None
        return snapshot.with_changes(changed, topics, old)

    def _find(
        self,
        looks: Mapping[str, str],
        known: Mapping[str, RecordingSummary],
        *,
        mends: bool = False,
    ) -> dict[str, list[RecordingSummary]]:
        """Summaries of recordings by id.

        Args:
            looks: The look of each directory, by label.
            known: Summaries in the catalog, by label.
            mends: Repair what a crash has left; otherwise it is noted.
        """
        found: dict[str, list[RecordingSummary]] = {}
        for label, look in looks.items():
            summary = known.get(label)
            if summary is None or summary.look != look or summary.status in UNFINISHED:
                try:
                    summary = self._look_again(label, summary, mends=mends)
                except DiskFullError:
                    raise
                except StoreError as error:
                    if self.directory.has(label):  # another process may have removed or renamed it
                        self.report.unreadable[label] = str(error)
                    continue
            if summary is not None:
                found.setdefault(summary.id, []).append(summary)
        return found

    def _look_again(
        self, label: str, summary: RecordingSummary | None, *, mends: bool
    ) -> RecordingSummary | None:
        """The summary of a recording as its files are now; None if it is gone."""
        if summary is not None:
            listing = self.directory.listing(label)
            row = self.catalog.recording(summary.id)
            if row is not None and _is_current(self.directory, row[1], row[0], listing):
                now = summary._replace(look=listing.look)
                if now.look != summary.look:
                    self.catalog.put_look(now)
                return now
        described = (self._mended if mends else self._refresh)(label)
        return described.summary if described is not None else None

    def current_entry(self, summary: RecordingSummary) -> tuple[RecordingEntry | None, bool]:
        """The entry of a recording, compared with its files.

        Returns:
            The entry, None if the recording is gone; and whether the files were read again.

        Raises:
            StoreError: Its files cannot be read.
        """
        directory = self.directory
        row = self.catalog.recording(summary.id)
        if row is not None and row[1].label == summary.label:
            listing = directory.listing(summary.label)
            if _is_current(directory, row[1], row[0], listing):
                return row[1], False
        if not directory.has(summary.label):
            return None, True
        described = self._refresh(summary.label)
        return (described.entry if described is not None else None), True

    def _refresh(self, label: str) -> Described | None:
        """Read what is whole of a recording, keep it in memory, and note what to mend.

        None if the recording is gone.
        """
        if _is_empty(self.directory, label):
            return None
        is_open = self.directory.is_recorded(label)
        if not (is_open or self.catalog.is_in_memory):
            self.report.noted.add(label)
        return self._describe(label, is_open=is_open)

    def _describe(self, label: str, *, is_open: bool) -> Described:
        described = describe_now(self.directory, self.catalog, label, is_open=is_open)
        self.catalog.put(described, waits=False)
        return described

    def _mended(self, label: str) -> Described | None:
        """Recover a recording after a crash, and update its catalog row; None if it is gone."""
        directory, catalog = self.directory, self.catalog
        if catalog.is_in_memory:
            return self._refresh(label)
        is_empty = _is_empty(directory, label)
        try:
            with directory.writing(label):
                is_new = is_empty and directory.is_beginning(label)
                now = "" if is_new else recover(directory, label, self.report)
                if not now:
                    return None
                described = describe_now(directory, catalog, now)
                catalog.put(described)
                return described
        except HeldError:
            if not directory.id_of(label):
                return None  # a process is about to begin it
        except TopicError:
            return None
        return self._describe(label, is_open=directory.is_recorded(label))

    def mend(self, until: float) -> set[str]:
        """Recover the recordings that were noted, and update their catalog rows.

        Args:
            until: When this should end, by `time.monotonic`; what would take longer stays noted.

        Returns:
            Ids of the recordings.
        """
        mended, report = set(), self.report
        for label in sorted([*report.noted]):  # other threads note more
            if (
                _open_bytes(self.directory, label)
                > (until - time.monotonic()) * _RECOVERED_BYTES_PER_S
            ):
                continue
            report.noted.discard(label)
            report.unreadable.pop(label, None)
            try:
                described = self._mended(label)
            except DiskFullError:
                raise
            except StoreError as error:
                if self.directory.has(label):
                    report.unreadable[label] = str(error)
                continue
            if described is not None:
                mended.add(described.entry.id)
        return mended

    def _one_of(
        self, copies: list[RecordingSummary], known: Mapping[str, RecordingSummary]
    ) -> RecordingSummary:
        """Choose one of several directories with the same recording, and put it in the catalog.

        The most complete one, with the most payloads; of equals the one in the catalog, then the
        one with the older journal.
        """
        whole = ["complete", "open", "recovered", "unfinished", "unproven", "damaged"]

        def rank(one: RecordingSummary) -> tuple[int, int, int, bool, int, str]:
            place = whole.index(one.status) if one.status in whole else 0
            was_known = one.label in known and known[one.label].id == one.id
            try:
                path = self.directory.recording(one.label) / journal.JOURNAL
                written = files.status(path).st_ctime_ns
            except OSError:
                written = time.time_ns()
            lacks = one.expired + one.not_copied
            return -one.messages, place, lacks, not was_known, written, one.label

        chosen, *others = sorted(copies, key=rank)
        for other in others:
            self.report.copies[other.label] = chosen.label
        # The row may be that of the copy.
        described = describe_now(self.directory, self.catalog, chosen.label)
        self.catalog.put(described, waits=False)
        return described.summary


def snapshot_of(catalog: Catalog, summaries: Collection[RecordingSummary]) -> Snapshot:
    """Some recordings with their topics.

    Raises:
        CatalogError: The catalog has lost topics.
    """
    hashes = {summary.topics for summary in summaries}
    return Snapshot(summaries, {digest: catalog.topics(digest) for digest in hashes})


def _is_current(
    directory: StoreDirectory, entry: RecordingEntry, looks: str, listing: Listing
) -> bool:
    """True if a catalog row still matches the files."""
    if looks != listing.print:
        return False
    if listing.open or entry.status == "open" or any(map(is_left_over, listing.others)):
        holder = directory.holder(entry.label)
        return holder is not None and (holder.is_recording or entry.status != "open")
    return True


def _is_empty(directory: StoreDirectory, label: str) -> bool:
    listing = directory.listing(label)
    # What a list names was not begun a moment ago: its objects are lost.
    is_empty = not (listing.journal or listing.sealed or listing.open or directory.is_remote)
    if is_empty and not _OURS.issuperset(listing.others):
        raise StoreError("it has neither a journal nor a segment, but other files")
    return is_empty


def _open_bytes(directory: StoreDirectory, label: str) -> int:
    """Size of the segments of a recording that are not sealed."""
    path, found = directory.recording(label), 0
    for name in directory.listing(label).open.values():
        with suppress(OSError):
            found += files.status(path / name).st_size
    return found


def recover(directory: StoreDirectory, label: str, report: RepairReport) -> str:
    """Finish the interrupted work on a recording that this process has locked.

    Returns:
        Its label, which an interrupted renaming may change; empty if it is gone.

    Raises:
        StoreError: It cannot be written, or its journal cannot be read.
        DiskFullError: No room; nothing is lost.
    """
    path = directory.recording(label)
    clear_away(directory, label)
    listing = directory.listing(label)
    state = journal.read(path) if listing.journal else None
    if state is not None and state.removing:
        directory.remove(label)
        report.removed.append(label)
        return ""
    if state is not None and state.torn:
        Journal(path).append()
    if PAYLOAD_PARTS in listing.others or (state is not None and state.deleted):
        payload_files.publish(path, state)
    if state is not None and state.unmarked & listing.sealed.keys():
        remove_marks(path, state)
    thinned = state.thinned if state is not None else {}
    payload_files.replace_segments(path, listing.others, thinned)
    recovered = _recover_segments(directory, label, listing, state)
    inventory = take_inventory(directory, label)
    is_empty = not inventory.summaries and not (state is not None and state.sealed)
    if is_empty and not inventory.listing.sealed and (state is None or state.end is None):
        announce_removal(directory, label)
        directory.remove(label)
        report.recovered[label] = recovered
        return ""
    if recovered:
        report.recovered[label] = recovered
    lines: list[journal.Event] = []
    if inventory.state is None:
        reason = "it was not there"
        events = journal_from_segments(inventory, directory.settings.store_id, reason)
        Journal(path).replace(events)
        report.journals.append(label)
        inventory = take_inventory(directory, label)
    state = inventory.state
    if inventory.stored and (missing := unlisted_lines(inventory)):
        lines += missing  # expired chunks are read from the files that the journal lists
        report.journals.append(label)
    if state is not None and state.end is None:
        lines.append(journal.event(journal.ENDED, end=_end_of(inventory)))
    if state is not None and state.store and state.store != directory.settings.store_id:
        lines.append(journal.event(journal.ADOPTED, store=directory.settings.store_id))
        report.adopted.append(label)
    if lines:
        Journal(path).append(*lines)
    return finish_renaming(directory, label, state)


def is_left_over(name: str) -> bool:
    """True if a file in a recording's directory is left from an interrupted step."""
    patterns = (_LEFT_OVER, _MOVING, payload_files.REPLACEMENT)
    return name == PAYLOAD_PARTS or any(pattern.fullmatch(name) for pattern in patterns)


def clear_away(directory: StoreDirectory, label: str) -> None:
    """Remove temporary files, and finish the renaming of segments."""
    finish_moves(directory, label)
    path = directory.recording(label)
    for name in directory.listing(label).others:
        if _LEFT_OVER.fullmatch(name):
            try:
                files.unlink(path / name)
            except OSError as error:
                raise durability.explain(error, path / name, "removing") from error


def clear_stopped(directory: StoreDirectory) -> None:
    """Remove the hidden folders of copies out of a store that were stopped.

    They have second names of payloads, which could not be deleted otherwise.

    Raises:
        OSError: They cannot be removed.
    """
    for name in files.names(directory.path):
        path = directory.path / name
        if name.startswith(SENDING):
            with suppress(BlockingIOError), files.locked_folder(path, 0):
                files.remove_tree(path)


def is_at_work(source: StoreDirectory, name: str) -> bool:
    """True if a hidden folder of a copy is locked: the copy goes on."""
    try:
        with files.locked_folder(source.path / name, 0):
            return False
    except OSError as error:
        return isinstance(error, BlockingIOError)


def moving_name(name: str, number: int) -> str:
    """Temporary name of a segment that is being renamed."""
    return f"{name}.moving-{number:06d}"


def finish_moves(
    directory: StoreDirectory, label: str, *, replace: bool = False
) -> list[tuple[str, str]]:
    """Finish the renaming of segments.

    Args:
        directory: The store.
        label: The recording, locked by this process.
        replace: Rename an existing file of that name to `.damaged`: the journal does not list
            it. Otherwise it stays, as it may be renamed itself.

    Returns:
        Old and new name of each.
    """
    path = directory.recording(label)
    done = []
    try:
        for name in directory.listing(label).others:
            moving = _MOVING.fullmatch(name)
            if moving is None:
                continue
            final = path / sealed_name(int(moving["number"]))
            if final.name in directory.listing(label).sealed.values():
                if not replace:
                    continue
                files.rename(final, path / _free_name(directory, label, f"{final.name}.damaged"))
            files.rename(path / name, final)
            done.append((moving["before"], final.name))
        if done:
            files.sync_folder(path)
    except OSError as error:
        raise durability.explain(error, path, "renaming segments of") from error
    return done


def _free_name(directory: StoreDirectory, label: str, name: str) -> str:
    """A free file name: this one, or one with a number before its suffix."""
    taken = set(directory.listing(label).others)
    stem, _, last = name.rpartition(".")
    return next(
        n for n in (name, *(f"{stem}.{i}.{last}" for i in range(2, 1 << 20))) if n not in taken
    )


def finish_renaming(directory: StoreDirectory, label: str, state: JournalState | None) -> str:
    """Give a directory the label that its journal announces; return its label.

    A directory that a user has renamed meanwhile is unchanged.
    """
    if state is None or state.moving is None:
        return label
    before, after = state.moving
    if label == before:
        with directory.alone():  # a recording that begins takes a label, too
            if after in directory.labels():
                after = directory.free_label(state.name, but=label)
            if label != after:
                directory.move(label, after)
        label = after
    directory.append(label, journal.event(journal.RENAMED, name=state.name))
    return label


def _recover_segments(
    directory: StoreDirectory, label: str, listing: Listing, state: JournalState | None
) -> list[Recovered]:
    from hybridlog_storage.segments.recovery import recover_segment

    path = directory.recording(label)
    log = Journal(path)
    said = None
    if state is not None and state.begun:
        said = {key: state.begun[key] for key in ("id", "name", "tags", "source", "created")}

    def announce(sealed: Sealed) -> None:
        known = journal.read(path)
        listed = known.sealed.get(sealed.segment) if known is not None else None
        if known is not None and (listed is None or listed.digest != sealed.digest):
            log.append(sealed_event(sealed))

    recovered = []
    for number, name in listing.open.items():
        if (
            state is not None
            and state.is_proof
            and state.end is not None
            and number not in state.sealed
        ):
            # An unfinished mark of a recording that had ended.
            try:
                files.unlink(path / name)
            except OSError as error:
                raise durability.explain(error, path / name, "removing") from error
        else:
            recovered.append(recover_segment(path / name, announce, recording=said))
    return recovered


def remove_marks(path: Path, state: JournalState) -> None:
    """Remove the segments of removed marks of a recording that this process has locked.

    Raises:
        HybridlogError: One cannot be removed.
    """
    try:
        for number in state.unmarked:
            with suppress(FileNotFoundError):
                files.unlink(path / sealed_name(number))
        files.sync_folder(path)
    except OSError as error:
        raise durability.explain(error, path, "removing marks of") from error


def _end_of(inventory: Inventory) -> dict[str, Any]:
    """The `end` of a recording whose journal has no `ended` line."""
    return dict(inventory.end or {"status": "recovered", "cut_bytes": 0, "damage": []})
