"""Brings the MongoDB index up to date with the segments, and rebuilds it from them."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

from hybridlog.columns.recording_logs import walk
from hybridlog.columns.table_writer import TableWriter
from hybridlog.entries import put_entry
from hybridlog.index.indexing import ChunkIndexer
from hybridlog.maintenance import tables
from hybridlog.maintenance.report import Progress, RepairReport, reporter
from hybridlog_storage.catalog import decoded_in
from hybridlog_storage.disk.directory import LOCK_WAIT_S
from hybridlog_storage.errors import (
    HeldError,
    HybridlogError,
    SegmentError,
    TopicError,
)
from hybridlog_storage.mongo.index_state import Indexed, IndexState

if TYPE_CHECKING:
    from hybridlog.maintenance.report import Progress
    from hybridlog.snapshot import Snapshot
    from hybridlog_storage.catalog import Catalog, ChannelStats, RecordingEntry
    from hybridlog_storage.disk.directory import StoreDirectory
    from hybridlog_storage.mongo.database import Database
    from hybridlog_storage.summary import RecordingSummary


@dataclass(frozen=True, slots=True)
class StoreIndex:
    """The index of a store, brought up to date with its segments or rebuilt from them.

    All methods raise `DatabaseError` if MongoDB fails.

    Attributes:
        directory: The store.
        catalog: Its catalog.
        database: The index.
        progress: Called after each chunk.
    """

    directory: StoreDirectory
    catalog: Catalog
    database: Database
    progress: Progress | None = None

    @property
    def _state(self) -> IndexState:
        return IndexState(self.database)

    def bring_up_to_date(
        self,
        snapshot: Snapshot,
        entry_of: Callable[[RecordingSummary], RecordingEntry],
        *,
        index: str,
        stale: Collection[str],
        report: RepairReport,
    ) -> set[str]:
        """Index missing chunks, and remove documents of removed recordings.

        Recordings that the catalog knows to be in this index are not looked at, unless the
        index has another number of recordings than these.

        Args:
            snapshot: All recordings.
            entry_of: Returns the entry of a recording.
            index: Id of the index.
            stale: Ids of recordings to look at in any case.
            report: Collects the actions.

        Returns:
            Ids of the recordings whose entries have changed.
        """
        directory, state = self.directory, self._state
        tables.remove_unfinished(directory, snapshot)
        behind = [one for one in snapshot.summaries if one.indexed_by != index or one.id in stale]
        known = state.of([one.key for one in behind]) if behind else {}
        is_other = state.count() - len(known) != len(snapshot) - len(behind)
        if is_other:
            behind = snapshot.summaries
        has_orphans = is_other or tables.are_left(directory, snapshot)
        if not behind and not has_orphans:
            return set()
        if has_orphans:
            known = state.of()
        changed, current = set(), []
        for summary in behind:
            entry = entry_of(summary)
            indexed = known.get(entry.key)
            if _is_current(indexed, entry):
                current.append(entry.id)
            elif directory.is_writable:  # else the segments answer, without an index
                self._bring_one(entry, report)
                changed.add(entry.id)
        if current:
            self.catalog.put_indexed(current, index)
        if has_orphans:
            self._remove_orphans(known, report)
        return changed.union(current)

    def _bring_one(self, entry: RecordingEntry, report: RepairReport) -> None:
        """Bring one recording up to date, unless another process is writing it."""
        # The process that holds the lock indexes it.
        with suppress(HeldError, TopicError), self.directory.writing(entry.id):
            try:
                chunks = self.bring(entry)
            except SegmentError as error:
                report.unreadable[entry.id] = str(error)
            else:
                if chunks is not None:
                    report.indexed[entry.name] = chunks

    def bring(self, known: RecordingEntry, *, anew: bool = False) -> int | None:
        """Bring the index of a recording, locked by this process, up to date with its files.

        What is interrupted is repeated by the next opening.

        Args:
            known: The recording.
            anew: Whether documents that are there are made again.

        Returns:
            Number of chunks whose documents were made; None if none were missing.

        Raises:
            SegmentError: A segment cannot be read.
        """
        directory, catalog, state = self.directory, self.catalog, self._state
        # Read again, now that it is locked: another process may have indexed it meanwhile.
        entry, indexed = put_entry(directory, catalog, known.id), state.one(known.key)
        has = {} if anew or indexed is None else indexed.segments
        done = {n: digest for n, digest in has.items() if entry.digests.get(n) == digest}
        is_whole = not anew and indexed is not None and indexed.is_whole(entry)
        if is_whole and entry.is_decoded:
            state.show(entry)
            return None
        if not is_whole:
            state.begin(entry, done)
            state.clear(entry, but=done)
        made = derive(directory, catalog, entry, self.database, done=done, progress=self.progress)
        state.end(put_entry(directory, catalog, entry.id))
        return made

    def _remove_orphans(self, known: Mapping[str, Indexed], report: RepairReport) -> None:
        """Remove recordings without a directory from the index and the tables.

        The directories are listed after the index, so they include recordings that have begun
        meanwhile.
        """
        present = keys_present(self.directory)
        gone = known.keys() - present
        if gone:
            self._state.clear_everywhere(gone)
            self._state.remove(gone)
            report.removed += sorted(gone)
        if self.directory.is_writable:
            tables.remove_orphans(self.directory, present)

    def rebuild(self, entries: Iterable[RecordingEntry]) -> dict[str, HybridlogError]:
        """Rebuild the index of recordings from their segments, one after the other.

        The next opening finishes an interrupted rebuild.

        Returns:
            Why some are unchanged, by id: another process holds them, or they are gone.
        """
        left: dict[str, HybridlogError] = {}
        for chosen in entries:
            try:
                with self.directory.writing(chosen.id, chosen.name, wait_s=LOCK_WAIT_S):
                    self.bring(chosen, anew=True)
            except (HeldError, TopicError) as error:
                left[chosen.id] = error
        return left

    def clear(self) -> None:
        """Remove all documents but those of recordings that are being written."""
        ids = self.directory.ids()
        self._state.clear_all(but=[i[-16:] for i in ids if self.directory.holder(i) is not None])


def _is_current(indexed: Indexed | None, entry: RecordingEntry) -> bool:
    """True if a completely indexed recording needs no further work."""
    is_whole = indexed is not None and indexed.is_whole(entry)
    return indexed is not None and is_whole and indexed.mirrors(entry) and entry.is_decoded


def keys_present(directory: StoreDirectory) -> set[str]:
    """Keys of all recordings, also of those that have lost their manifests."""
    recordings = *directory.ids(), *directory.manifests.without()
    return {recording[-16:] for recording in recordings}


def derive(
    directory: StoreDirectory,
    catalog: Catalog,
    entry: RecordingEntry,
    database: Database | None = None,
    *,
    done: Collection[str] = (),
    progress: Progress | None = None,
) -> int:
    """Make what is missing of a locked recording: tables, decoding results, documents.

    A chunk that cannot be read is noted in the catalog, and the others go on.

    Args:
        directory: The store.
        catalog: Its catalog.
        entry: The recording.
        database: The index; None to make no documents.
        done: Numbers of the segments that have all their documents, as text.
        progress: Called after each chunk.

    Returns:
        Number of chunks whose documents were made.

    Raises:
        SegmentError: A segment cannot be read.
    """
    from hybridlog.index.index_writer import INTERVAL_S, DocumentSender

    topics = tables.missing(directory, entry)
    in_tables = tables.channels_of(entry, topics)
    writer = TableWriter(directory.path, entry.id, entry.name, topics=topics, is_new=False)
    indexer = ChunkIndexer(entry.id, has_documents=database is not None)
    sender = None if database is None else DocumentSender(entry, database)
    sent, made, damage = time.monotonic(), 0, catalog.damage(entry.id)
    path = directory.recording(entry.id)
    report = reporter(progress, entry.name, entry.stored_bytes)
    try:
        for segment in walk(path, entry, report):
            number, summary = segment.number, segment.summary
            digest = entry.digests[str(number)]
            is_sent = sender is None or str(number) in done
            is_decoded = catalog.decoded(entry, number) is not None
            stats: list[Mapping[int, ChannelStats]] = []
            wanted = {
                place
                for place in summary.chunks
                if not (is_sent and is_decoded) or not in_tables.isdisjoint(place.channels)
            }
            for place, chunk in segment.chunks(wanted.__contains__):
                if isinstance(chunk, SegmentError):
                    damage[number, place.number] = str(chunk)
                    continue
                damage.pop((number, place.number), None)
                writer.add(chunk, summary.channels)
                documents, entries = indexer.documents_of([chunk], summary.channels)
                stats.append(entries[0].stats)
                if sender is not None and not is_sent:
                    made += 1
                    sender.add(documents, entries)
                    if time.monotonic() - sent > INTERVAL_S:
                        sender.send()
                        sent = time.monotonic()
            writer.cut(number, digest)
            if sender is not None and not is_sent:
                sender.end_segment(number, digest)
            if not is_decoded:
                catalog.put_decoded(entry.id, number, digest, decoded_in(stats))
        if sender is not None:
            sender.send(wait=True)
        catalog.put_damage(entry.id, damage)
        writer.close(entry)
    finally:
        if sender is not None:
            sender.close()
        writer.discard()
    return made
