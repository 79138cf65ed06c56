"""Brings the MongoDB index of a store up to date with its recordings, and rebuilds it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from hybridlog.follow.follower import bring
from hybridlog_storage.disk.directory import LOCK_WAIT_S
from hybridlog_storage.errors import HeldError, HybridlogError, SegmentError, TopicError
from hybridlog_storage.mongo.index_state import IndexState

if TYPE_CHECKING:
    from hybridlog.maintenance.report import Progress, RepairReport
    from hybridlog.snapshot import Snapshot
    from hybridlog_storage.catalog import Catalog, RecordingEntry
    from hybridlog_storage.disk.directory import StoreDirectory
    from hybridlog_storage.mongo.database import Database
    from hybridlog_storage.summary import RecordingSummary


@dataclass(frozen=True, slots=True)
class StoreIndex:
    """The index of a store. All methods raise `DatabaseError` if MongoDB fails."""

    directory: StoreDirectory
    catalog: Catalog
    database: Database
    progress: Progress | None = None

    def bring_up_to_date(
        self,
        snapshot: Snapshot,
        entry_of: Callable[[RecordingSummary], RecordingEntry],
        *,
        index: str,
        removes: bool,
        report: RepairReport,
    ) -> set[str]:
        """Index missing segments, remove documents of removed recordings; returns changed ids.

        Recordings that the catalog knows to be in this index are not looked at, unless the index
        has another number of recordings than these. `removes` is False in a copy of the store that
        the index belongs to: what it does not have may be there.
        """
        directory, state = self.directory, IndexState(self.database)
        behind = [one for one in snapshot.summaries if one.indexed_by != index]
        known = state.of([one.key for one in behind]) if behind else {}
        is_other = state.count() - len(known) != len(snapshot) - len(behind)
        if is_other:
            behind, known = snapshot.summaries, state.of()
            if removes:
                self._remove_orphans(known, report)
        changed, current = set(), []
        for summary in behind:
            entry = entry_of(summary)
            indexed = known.get(entry.key)
            if indexed is not None and indexed.is_whole(entry) and entry.is_decoded:
                current.append(entry.id)
            elif directory.is_writable:  # else the segments answer, without an index
                self._bring_one(entry, report)
                changed.add(entry.id)
        if current:
            self.catalog.put_indexed(current, index)
        return changed.union(current)

    def _bring_one(self, entry: RecordingEntry, report: RepairReport) -> None:
        """Bring one recording up to date, unless another process is writing it."""
        # The process that holds the lock indexes it.
        with suppress(HeldError, TopicError):
            try:
                chunks = self._bring(entry)
            except SegmentError as error:
                report.unreadable[entry.id] = str(error)
            else:
                if chunks is not None:
                    report.indexed[entry.name] = chunks

    def _bring(self, entry: RecordingEntry, **options: Any) -> int | None:
        directory, catalog, database = self.directory, self.catalog, self.database
        return bring(directory, catalog, entry, database, progress=self.progress, **options).chunks

    def _remove_orphans(self, known: Iterable[str], report: RepairReport) -> None:
        """Remove recordings without a directory from the index.

        The directories are listed after the index, so they include recordings that have begun
        meanwhile.
        """
        directory, state = self.directory, IndexState(self.database)
        gone = {*known} - {one[-16:] for one in (*directory.ids(), *directory.manifests.without())}
        if gone:
            state.clear_everywhere(gone)
            state.remove(gone)
            report.removed += sorted(gone)

    def rebuild(self, entries: Iterable[RecordingEntry]) -> dict[str, HybridlogError]:
        """Rebuild the index of recordings from their segments; returns why some are unchanged.

        The next opening finishes an interrupted rebuild. Unchanged ones, by id, are gone, or
        another process holds them.
        """
        left: dict[str, HybridlogError] = {}
        for chosen in entries:
            try:
                self._bring(chosen, anew=True, wait_s=LOCK_WAIT_S)
            except (HeldError, TopicError) as error:
                left[chosen.id] = error
        return left

    def clear(self) -> None:
        """Remove all documents but those of recordings that are being written."""
        ids = self.directory.ids()
        held = [one[-16:] for one in ids if self.directory.holder(one) is not None]
        IndexState(self.database).clear_all(but=held)
