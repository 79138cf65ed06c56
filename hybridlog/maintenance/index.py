"""Brings the MongoDB index up to date with the segments, and rebuilds it from them."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from hybridlog.columns.recording_logs import walk
from hybridlog.columns.table_writer import TableWriter
from hybridlog.entries import put_entry, take_inventory
from hybridlog.index.indexing import ChunkIndexer
from hybridlog.maintenance import tables
from hybridlog.maintenance.report import Progress, RepairReport, reporter
from hybridlog_storage.catalog import decoded_rows, files_of, stamps_of
from hybridlog_storage.disk.directory import LOCK_WAIT_S
from hybridlog_storage.errors import (
    HeldError,
    HybridlogError,
    SegmentError,
    TopicError,
)
from hybridlog_storage.mongo.collection_names import collection_of
from hybridlog_storage.mongo.index_state import Indexed, IndexState
from hybridlog_storage.times import END

if TYPE_CHECKING:
    from typing import Any

    from numpy.typing import NDArray

    from hybridlog.entries import Inventory
    from hybridlog.maintenance.report import Progress
    from hybridlog.snapshot import Snapshot
    from hybridlog_storage.catalog import Catalog, ChannelStats, RecordingEntry
    from hybridlog_storage.disk.directory import StoreDirectory
    from hybridlog_storage.mongo.database import Database
    from hybridlog_storage.summary import RecordingSummary


_DISORDER_NS: Final = 3600 * 10**9  # what a crash has cut may be so much earlier than the rest
Place = tuple[int, int]
"""Number of a segment, and number of a chunk in it."""


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
            is_whole = indexed is not None and indexed.is_whole(entry)
            if indexed is not None and is_whole and self._restore_damage(entry, indexed):
                changed.add(entry.id)
                entry = put_entry(directory, self.catalog, entry.id)
            if is_whole and _is_current(indexed, entry):
                current.append(entry.id)
            elif directory.is_writable:  # else the segments answer, without an index
                self._bring_one(entry, report)
                changed.add(entry.id)
        if current:
            self.catalog.put_indexed(current, index)
        if has_orphans:
            self._remove_orphans(known, report)
        return changed.union(current)

    def _restore_damage(self, entry: RecordingEntry, indexed: Indexed) -> bool:
        """Copy the index's list of unreadable chunks to the catalog; True if it changed."""
        if self.catalog.damage(entry.id) == indexed.damage:
            return False
        self.catalog.put_damage(entry.id, indexed.damage)
        return True

    def _bring_one(self, entry: RecordingEntry, report: RepairReport) -> None:
        """Bring one recording up to date, unless another process is writing it."""
        # The process that holds the lock indexes it.
        with suppress(HeldError, TopicError), self.directory.writing(entry.id):
            try:
                chunks = self._bring_up(entry)
            except SegmentError as error:
                report.unreadable[entry.id] = str(error)
            else:
                if chunks is not None:
                    report.indexed[entry.name] = chunks

    def _bring_up(self, known: RecordingEntry) -> int | None:
        """Bring one recording, locked by this process, up to date.

        Returns:
            Number of indexed chunks; None if all were in the index.
        """
        # Read again, now that it is locked: another process may have indexed it meanwhile.
        indexed = self._state.one(known.key)
        entry = put_entry(self.directory, self.catalog, known.id)
        if indexed is None or not indexed.is_whole(entry):
            return self.catch_up(entry.id)
        if not entry.is_decoded:
            self._state.show(decode_again(self.directory, self.catalog, entry, self.progress))
            return 0
        if not indexed.mirrors(entry):
            self._state.show(entry)
        return None

    def _remove_orphans(self, known: Mapping[str, Indexed], report: RepairReport) -> None:
        """Remove recordings without a directory from the index and the tables.

        The directories are listed after the index, so they include recordings that have begun
        meanwhile.
        """
        present = keys_present(self.directory)
        for key, indexed in known.items():
            if key not in present:
                remove_documents(self.database, key, indexed)
                report.removed.append(indexed.id or key)
        if self.directory.is_writable:
            tables.remove_orphans(self.directory, present)

    def catch_up(self, recording: str) -> int:
        """Index the missing chunks of a recording; return their number.

        An unreadable chunk is noted in the catalog, and the others are indexed.

        Args:
            recording: Its id; it is locked by this process for writing.

        Raises:
            SegmentError: A segment cannot be read.
        """
        directory, catalog = self.directory, self.catalog
        entry = put_entry(directory, catalog, recording)
        indexed = self._prepare(entry)
        whole = {int(number) for number in indexed.segments}
        missing = {
            (number, chunk)
            for number, _, _ in entry.spans
            if number not in whole
            for chunk in range(len(catalog.table(entry, number).chunks))
        }
        damage = catalog.damage(entry.id)
        self._index(entry, missing, damage)
        catalog.put_damage(entry.id, damage)
        entry = finish(directory, catalog, self.database, recording, turn=indexed.turn)
        if not entry.is_decoded:  # documents indexed before
            self._state.show(decode_again(directory, catalog, entry, self.progress))
        return len(missing - damage.keys())

    def _prepare(self, entry: RecordingEntry) -> Indexed:
        """Remove documents from the index that do not fit the segments; return what it has."""
        state = self._state
        indexed = state.one(entry.key)
        turn = 1 if indexed is None else indexed.turn + 1
        left: dict[str, str] = {}
        if indexed is not None:
            left = {n: d for n, d in indexed.segments.items() if entry.digests.get(n) == d}
        if indexed is not None and indexed.state == "complete" and left == dict(indexed.segments):
            state.put(entry, "indexing", turn=turn, segments=left)
            return Indexed(entry.id, "indexing", left, turn)
        # If this is interrupted, the next opening repeats it.
        state.put(entry, "clearing", turn=turn, segments=left)
        if indexed is None:
            # No documents are known. Unknown ones are within the same times.
            state.clear(entry.key, {c.topic for c in entry.channels}, entry.span)
        else:
            _clear_documents(self.database, entry.key, indexed, entry, but=[int(n) for n in left])
        state.put(entry, "indexing", turn=turn, segments=left)
        return Indexed(entry.id, "indexing", left, turn)

    def _index(
        self,
        entry: RecordingEntry,
        missing: Collection[Place],
        damage: dict[Place, str],
    ) -> None:
        """Send what is missing to the index; chunks that cannot be read are noted in `damage`."""
        from hybridlog.index.index_writer import INTERVAL_S, DocumentSender

        directory, catalog = self.directory, self.catalog
        topics = tables.missing(directory, entry)
        writer = TableWriter(directory.path, entry.id, entry.name, topics=topics, is_new=False)
        indexer, sender = ChunkIndexer(entry.id), DocumentSender(entry, self.database)
        sent = time.monotonic()
        # A chunk that is indexed already may be missing in the tables all the same.
        in_tables = tables.channels_of(entry, topics)
        names, path = files_of(entry), directory.recording(entry.id)
        report = reporter(self.progress, entry.name, entry.stored_bytes)
        try:
            for segment in walk(path, names, report=report):
                number, channels = segment.number, segment.summary.channels
                stats: dict[int, Mapping[int, ChannelStats]] = {}
                wanted = {
                    place
                    for place in segment.summary.chunks
                    if (number, place.number) in missing or not in_tables.isdisjoint(place.channels)
                }
                for place, chunk in segment.chunks(wanted.__contains__):
                    if isinstance(chunk, SegmentError):
                        damage[number, place.number] = str(chunk)
                        continue
                    damage.pop((number, place.number), None)
                    writer.add(chunk, channels)
                    documents, entries = indexer.documents_of([chunk], channels)
                    stats[chunk.number] = entries[0].stats
                    if (number, chunk.number) in missing:
                        sender.add(documents, entries)
                    if time.monotonic() - sent > INTERVAL_S:
                        sender.send()
                        sent = time.monotonic()
                writer.cut(number, entry.digests[str(number)])
                sender.end_segment(number, entry.digests[str(number)])
                if stats and len(stats) == len(catalog.table(entry, number).chunks):
                    rows = decoded_rows(stats.values())
                    catalog.put_stamps(entry.id, [(number, entry.digests[str(number)], rows)])
            sender.end()
            writer.close(entry)
        finally:
            sender.close()
            writer.discard()

    def rebuild(self, entries: Iterable[RecordingEntry]) -> dict[str, HybridlogError]:
        """Rebuild the index of recordings from their segments, one after the other.

        The other recordings can be asked meanwhile. The next opening finishes an interrupted
        rebuild.

        Returns:
            Why some are unchanged, by id: another process holds them, or they are gone.
        """
        left: dict[str, HybridlogError] = {}
        for chosen in entries:
            try:
                with self.directory.writing(chosen.id, chosen.name, wait_s=LOCK_WAIT_S):
                    self._clear(put_entry(self.directory, self.catalog, chosen.id))
                    self.catch_up(chosen.id)
            except (HeldError, TopicError) as error:
                left[chosen.id] = error
        return left

    def _clear(self, entry: RecordingEntry, *, everywhere: bool = False) -> None:
        """Remove the documents of a recording, `everywhere` if it is not known where they are."""
        state = self._state
        indexed = state.one(entry.key)
        turn = 1 if indexed is None else indexed.turn + 1
        # If this is interrupted, the next opening repeats it.
        state.put(entry, "clearing", turn=turn)
        _clear_documents(self.database, entry.key, None if everywhere else indexed, entry)
        state.put(entry, "indexing", turn=turn)

    def remove_rest(self, entries: Iterable[RecordingEntry]) -> None:
        """Remove documents of no recording, and surplus documents of recordings.

        Each collection is read once.
        """
        state = self._state
        known = {entry.key: entry for entry in entries}
        expected = {key: documents_in(entry) for key, entry in known.items()}
        again: set[str] = set()
        orphans: list[object] = []
        collections = state.document_collections()
        counted = self.database.count_by(collections, "_meta.rec")
        for collection, counts in zip(collections, counted, strict=True):
            for key, count in counts:
                entry = known.get(key) if isinstance(key, str) else None
                if entry is None:
                    orphans.append(key)
                    continue
                # Fewer, too: a document of no recording may have had the key of one.
                missing = expected[entry.key][collection] - count
                if missing < 0 or (missing > 0 and not self.catalog.damage(entry.id)):
                    again.add(entry.key)
        # Listed after the index: a recording that has begun meanwhile has a directory by now.
        present = keys_present(self.directory)
        for key in orphans:
            if not (isinstance(key, str) and key in present):
                state.clear(key)
        for key in sorted(again):
            entry = known[key]
            with suppress(HeldError, TopicError), self.directory.writing(entry.id):
                self._clear(entry, everywhere=True)
                self.catch_up(entry.id)


def _is_current(indexed: Indexed | None, entry: RecordingEntry) -> bool:
    """True if a completely indexed recording needs no further work."""
    return indexed is not None and indexed.mirrors(entry) and entry.is_decoded


def keys_present(directory: StoreDirectory) -> set[str]:
    """Keys of all recordings, also of those that have lost their manifests."""
    recordings = *directory.ids(), *directory.manifests.without()
    return {recording[-16:] for recording in recordings}


def remove_documents(database: Database, key: str, indexed: Indexed | None) -> None:
    """Remove all documents of a recording, and its mirror last.

    Args:
        database: The index.
        key: Key of the recording.
        indexed: The state of its index before the removal; None if nothing is known.
    """
    _clear_documents(database, key, indexed)
    IndexState(database).remove(key)


def _clear_documents(
    database: Database,
    key: str,
    indexed: Indexed | None,
    entry: RecordingEntry | None = None,
    *,
    but: Collection[int] = (),
) -> None:
    """Remove the documents of a recording.

    They are where the mirror of a complete index says, or where its entry says; at any time
    if the mirror has none. Of an incomplete one, some may be later than the entry says, since a
    crash has cut the recording. Without mirror or entry, all documents are looked through.

    Args:
        database: The index.
        key: Key of the recording.
        indexed: The state of its index; None if nothing is known.
        entry: Its entry; None if it has no files any more.
        but: Segments whose documents stay.
    """
    is_complete = indexed is not None and indexed.state == "complete"
    if indexed is None or not (is_complete or entry is not None):
        IndexState(database).clear(key, but=but)
        return
    topics, span = set(indexed.topics), indexed.span
    if entry is not None:
        topics |= {channel.topic for channel in entry.channels}
        if span is not None and entry.span is not None:
            span = min(span[0], entry.span[0]), max(span[1], entry.span[1])
        if not is_complete:
            span = None if entry.span is None else (entry.span[0] - _DISORDER_NS, END - 1)
    IndexState(database).clear(key, topics, span, but)


def finish(
    directory: StoreDirectory,
    catalog: Catalog,
    database: Database | None,
    recording: str,
    *,
    turn: int,
) -> RecordingEntry:
    """Mark the index of a recording as complete; return the recording's complete entry.

    Args:
        directory: The store.
        catalog: Its catalog.
        database: The index; None without one.
        recording: Its id.
        turn: As for `IndexState.put`.
    """
    entry = put_entry(directory, catalog, recording)
    if database is not None:
        damage = catalog.damage(entry.id)
        state = IndexState(database)
        state.put(entry, "complete", turn=turn, segments=entry.digests, damage=damage)
    return entry


def documents_in(entry: RecordingEntry) -> Counter[str]:
    """Number of documents of a recording in each collection."""
    found: Counter[str] = Counter()
    for channel in entry.channels:
        if channel.is_indexed:
            found[collection_of(channel.topic)] += channel.stats.messages
    return found


def decode_again(
    directory: StoreDirectory,
    catalog: Catalog,
    entry: RecordingEntry,
    progress: Progress | None = None,
) -> RecordingEntry:
    """Decode all segments of a locked recording without decoding results in the catalog.

    Returns:
        The recording's complete entry.

    Raises:
        SegmentError: A segment cannot be opened.
    """
    inventory = take_inventory(directory, entry.id)
    found = _decoded(directory, catalog, entry, inventory, progress)
    catalog.put_stamps(entry.id, found)
    return put_entry(directory, catalog, entry.id)


def _decoded(
    directory: StoreDirectory,
    catalog: Catalog,
    entry: RecordingEntry,
    inventory: Inventory,
    progress: Progress | None,
) -> Iterator[tuple[int, str, NDArray[Any]]]:
    indexer = ChunkIndexer(entry.id)
    missing = {
        number: summary
        for number, summary in inventory.summaries.items()
        if catalog.stamps(entry, number, summary.table) is None
    }
    report = reporter(progress, entry.name, sum(summary.size for summary in missing.values()))
    names = {number: inventory.listing.sealed[number] for number in missing}
    for segment in walk(inventory.path, names, report=report, known=missing):
        summary = segment.summary
        stats: dict[int, Mapping[int, ChannelStats]] = {}
        for place, chunk in segment.chunks():
            if not isinstance(chunk, SegmentError):  # an unreadable chunk has no results
                _, (of_chunk,) = indexer.documents_of([chunk], summary.channels)
                stats[place.number] = of_chunk.stats
        yield segment.number, entry.digests[str(segment.number)], stamps_of(summary.table, stats)
