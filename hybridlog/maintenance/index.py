"""Brings the MongoDB index up to date with the segments, and rebuilds it from them."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np

from hybridlog.entries import take_inventory
from hybridlog.index_writer import IndexWriter
from hybridlog.indexing import ChunkIndexer
from hybridlog.maintenance import tables
from hybridlog.maintenance.decoding import decode_again
from hybridlog.maintenance.opening import describe_inventory, put_entry
from hybridlog.maintenance.report import Progress, RepairReport
from hybridlog.tables.writer import TableWriter
from hybridlog_storage import journal
from hybridlog_storage.catalog import stamps_of
from hybridlog_storage.collection_names import collection_of
from hybridlog_storage.errors import CatalogError, SegmentError, StoreError
from hybridlog_storage.index_state import Indexed, IndexState
from hybridlog_storage.segment_reader import SegmentReader

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.entries import Inventory
    from hybridlog_storage.catalog import Catalog, RecordingEntry
    from hybridlog_storage.chunk import StoredChunk
    from hybridlog_storage.database import Database
    from hybridlog_storage.directory import StoreDirectory
    from hybridlog_storage.messages import Channel

Place = tuple[int, int]
"""Number of a segment, and number of a chunk in it."""
_TRIES = 10


def bring_up_to_date(
    directory: StoreDirectory,
    catalog: Catalog,
    database: Database,
    entries: Iterable[RecordingEntry],
    *,
    report: RepairReport,
    progress: Progress | None = None,
) -> bool:
    """Index what is not in the index, and remove from it what is gone.

    Args:
        directory: The store.
        catalog: Its catalog.
        database: The index.
        entries: All recordings.
        report: Gets what was done.
        progress: Called while a recording is indexed.

    Returns:
        Whether something of an entry is not as it was.

    Raises:
        DatabaseError: MongoDB fails.
    """
    state = IndexState(database)
    known = state.of()
    has_changed = False
    entries = list(entries)
    for entry in entries:
        indexed = known.get(entry.key)
        is_whole = indexed is not None and indexed.is_whole(entry)
        if indexed is not None and is_whole and _recall(catalog, entry, indexed):
            has_changed = True
            entry = put_entry(directory, catalog, entry.label)  # noqa: PLW2901
        if is_whole and (not directory.is_writable or _is_settled(indexed, entry)):
            continue
        if not directory.is_writable:
            raise StoreError(
                f"The index of recording {entry.label!r} is not complete, and the store "
                f"{directory.path} is read-only. Open it once with the right to write."
            )
        with directory.writing(entry.label) as mine:
            if not mine:
                continue  # who holds it indexes it
            try:
                chunks = _tend(directory, catalog, database, entry, progress)
            except SegmentError as error:
                report.unreadable[entry.label] = str(error)
            else:
                if chunks is not None:
                    report.indexed[entry.label] = chunks
    _remove_strangers(directory, state, known, entries, report)
    return has_changed or bool(report.indexed)


def _recall(catalog: Catalog, entry: RecordingEntry, indexed: Indexed) -> bool:
    """Restore the catalog's list of unreadable chunks from the index; True if it had changed."""
    with suppress(CatalogError):
        if catalog.damage(entry.id) == indexed.damage:
            return False
    catalog.put_damage(entry.id, indexed.damage)
    return True


def _is_settled(indexed: Indexed | None, entry: RecordingEntry) -> bool:
    """Whether a completely indexed recording needs no further work."""
    is_shown = indexed is not None and not indexed.has_list and indexed.mirrors(entry)
    return is_shown and entry.is_decoded


def _tend(
    directory: StoreDirectory,
    catalog: Catalog,
    database: Database,
    entry: RecordingEntry,
    progress: Progress | None,
) -> int | None:
    """Bring one recording up to date, which this process holds.

    Returns:
        How many chunks were indexed; None when all were in the index.
    """
    state = IndexState(database)
    indexed = state.one(entry.key)  # as it is now that nobody writes it
    if indexed is None or not indexed.is_whole(entry):
        return catch_up(directory, catalog, database, entry.label, progress)
    if not entry.is_decoded:
        state.show(decode_again(directory, catalog, entry, progress))
        return 0
    if not indexed.mirrors(entry):
        state.show(entry)
    if indexed.has_list:
        state.drop_list(entry.key)
    return None


def _remove_strangers(
    directory: StoreDirectory,
    state: IndexState,
    known: Mapping[str, Indexed],
    entries: Iterable[RecordingEntry],
    report: RepairReport,
) -> None:
    """Remove recordings from index and tables that have no directory any more.

    The directories are listed after the index was: one that has begun meanwhile is in them.
    Where one cannot be read, nobody can say what is gone, and nothing is removed.
    """
    present = ids_present(directory)
    if present is None:
        return
    for key, indexed in known.items():
        if key not in present:
            forget(state, key)
            report.removed.append(indexed.id or key)
    if directory.is_writable:
        tables.sweep(directory, entries, present)


def ids_present(directory: StoreDirectory) -> set[str] | None:
    """Keys of all recordings that have a directory; None when one does not say what it is.

    One that gets another name meanwhile must not be missed, so all are listed again then.
    """
    for _ in range(_TRIES):
        labels = directory.labels()
        found = _ids_of(directory, labels)
        if directory.labels() == labels:
            return found
    return None


def _ids_of(directory: StoreDirectory, labels: Iterable[str]) -> set[str] | None:
    found: set[str] = set()
    for label in labels:
        try:
            listing = directory.listing(label)
            state = journal.read(directory.recording(label)) if listing.journal else None
        except StoreError:
            return None
        if state is not None and state.id:
            found.add(state.id[:16])
            continue
        for number, name in [*listing.sealed.items(), *listing.open.items()]:
            try:
                with SegmentReader(directory.recording(label) / name, number) as reader:
                    found.add(str(reader.summary().recording["id"])[:16])
            except (SegmentError, KeyError):
                return None
    return found


def forget(state: IndexState, key: str) -> None:
    """Remove all documents of a recording; its place in the mirror goes last."""
    state.clear(key, state.topic_collections())
    state.remove(key)


def catch_up(
    directory: StoreDirectory,
    catalog: Catalog,
    database: Database,
    label: str,
    progress: Progress | None = None,
) -> int:
    """Index the chunks of a recording that are not in the index; returns how many.

    A chunk that cannot be read is noted in the catalog, and the others are indexed.

    Args:
        directory: The store.
        catalog: Its catalog.
        database: The index.
        label: The recording, which this process holds for writing.
        progress: Called after each chunk.

    Raises:
        DatabaseError: the database does not take them.
        SegmentError: a segment cannot be read.
    """
    state = IndexState(database)
    entry = put_entry(directory, catalog, label)
    indexed, done = _prepare(state, entry, catalog)
    whole = {int(number) for number in indexed.segments}
    missing = {
        (number, chunk): offset
        for number, _, _ in entry.spans
        if number not in whole
        for chunk, offset in enumerate(catalog.table(entry, number).chunks["offset"].tolist())
        if (number, chunk) not in done
    }
    damage = catalog.damage(entry.id)
    _index(
        directory,
        catalog,
        database,
        entry,
        missing=missing,
        damage=damage,
        progress=progress,
    )
    catalog.put_damage(entry.id, damage)
    entry = finish(directory, catalog, database, label, turn=indexed.turn)
    if not entry.is_decoded:  # what was in the index before
        state.show(decode_again(directory, catalog, entry, progress))
    return len(missing.keys() - damage.keys())


def _prepare(
    state: IndexState, entry: RecordingEntry, catalog: Catalog
) -> tuple[Indexed, dict[Place, int]]:
    """Remove from the index what does not fit the segments; returns what is left.

    Returns:
        What the index says of the recording now, and the offsets of chunks that are in it, of
        segments that are not in it whole.
    """
    indexed = state.one(entry.key)
    done = state.places(entry.key)
    if (
        indexed is not None
        and indexed.state in {"open", "indexing"}
        and _fits(entry, catalog, done)
        and all(entry.digests.get(n) == digest for n, digest in indexed.segments.items())
    ):
        return indexed, done
    turn = 1 if indexed is None else indexed.turn + 1
    left: dict[str, str] = {}
    if indexed is not None and indexed.state in {"complete", "clearing"}:
        left = {n: d for n, d in indexed.segments.items() if entry.digests.get(n) == d}
    if indexed is not None and indexed.state == "complete" and left == dict(indexed.segments):
        state.put(entry, "indexing", turn=turn, segments=left)
        state.forget_chunks(entry.key)
        return Indexed(entry.id, "indexing", left, turn, ()), {}
    # Until all of this has come to its end, the next opening begins it again.
    state.put(entry, "clearing", turn=turn, segments=left)
    if indexed is None:
        # Nothing is known to be there. What there is all the same lies in the same times.
        state.clear(entry.key, {collection_of(c.topic) for c in entry.channels}, entry.span)
    else:
        state.clear(entry.key, state.topic_collections(), but=[int(n) for n in left])
    state.put(entry, "indexing", turn=turn, segments=left)
    return Indexed(entry.id, "indexing", left, turn, ()), {}


def _fits(entry: RecordingEntry, catalog: Catalog, done: Mapping[Place, int]) -> bool:
    """Whether all chunks that are in the index lie where it says.

    A power cut may take back chunks whose index documents are on the disk already.
    """
    tables = {
        number: catalog.table(entry, number).chunks["offset"].tolist()
        for number, _, _ in entry.spans
    }
    return all(
        number < len(tables.get(segment, ())) and tables[segment][number] == offset
        for (segment, number), offset in done.items()
    )


def _index(
    directory: StoreDirectory,
    catalog: Catalog,
    database: Database,
    entry: RecordingEntry,
    *,
    missing: Mapping[Place, int],
    damage: dict[Place, str],
    progress: Progress | None,
) -> None:
    """Send what is missing to the index; chunks that cannot be read are noted in `damage`."""
    topics = tables.missing(directory, entry)
    writer = TableWriter(directory.path, entry.id, topics=topics, is_new=False)
    index = IndexWriter(ChunkIndexer(entry.id), database)
    # A chunk that is indexed already may be missing in the tables all the same.
    found = _chunks(
        directory,
        catalog,
        entry,
        missing=missing,
        topics=topics,
        damage=damage,
        progress=progress,
    )
    try:
        last = ""
        for chunk, channels in found:
            if last and str(chunk.segment) != last:
                writer.cut(int(last), entry.digests[last])
            last = str(chunk.segment)
            writer.add(chunk, channels)
            if (chunk.segment, chunk.number) in missing:
                index.submit(chunk, channels)
        index.close()
        if index.failure is not None:
            raise index.failure
        writer.close(entry)
    except BaseException:
        index.abandon()
        raise
    finally:
        writer.discard()


def _chunks(
    directory: StoreDirectory,
    catalog: Catalog,
    entry: RecordingEntry,
    *,
    missing: Mapping[Place, int],
    topics: Collection[str],
    damage: dict[Place, str],
    progress: Progress | None,
) -> Iterator[tuple[StoredChunk, Mapping[int, Channel]]]:
    """Chunks of a recording that are missing in the index or in tables, in order."""
    total = entry.stored_bytes
    before = 0
    path = directory.recording(entry.label)
    for number, _, _ in entry.spans:
        with SegmentReader(path / f"{number:06d}.mcap", number) as reader:
            summary = reader.summary()
            is_in_tables = tables.chunks_with(entry, summary.table, topics)
            for place in summary.chunks:
                if (number, place.number) not in missing and not is_in_tables[place.number]:
                    continue
                try:
                    chunk = reader.read_chunk(place)
                except SegmentError as error:
                    damage[number, place.number] = str(error)
                    continue
                damage.pop((number, place.number), None)
                yield chunk, summary.channels
                if progress is not None:
                    progress(entry.label, before + place.offset + place.length, total)
            before += reader.size


def finish(
    directory: StoreDirectory, catalog: Catalog, database: Database, label: str, *, turn: int
) -> RecordingEntry:
    """Say that the index of a recording is complete; returns the recording's whole entry.

    What the decoded messages told goes into the catalog, then the mirror says `complete`,
    and last the list of chunks goes.
    """
    state = IndexState(database)
    inventory = take_inventory(directory, label)
    catalog.put_stamps(inventory.id, _stamps(state, inventory))
    described = describe_inventory(catalog, inventory)
    catalog.put(described)
    entry = described.entry
    state.put(
        entry,
        "complete",
        turn=turn,
        segments=entry.digests,
        has_list=True,
        damage=catalog.damage(entry.id),
    )
    state.drop_list(entry.key)
    return entry


def _stamps(state: IndexState, inventory: Inventory) -> Iterator[tuple[int, str, NDArray[np.void]]]:
    """Number, digest and stamp rows of each segment that has indexed chunks."""
    indexed = state.chunks(inventory.id[:16])
    for segment, chunks in groupby(indexed, key=lambda chunk: chunk.segment):
        summary = inventory.summaries.get(segment)
        told = {chunk.number: chunk.stats for chunk in chunks}
        if summary is not None:
            yield segment, summary.digest, stamps_of(summary.table, told)


def reindex(
    directory: StoreDirectory,
    catalog: Catalog,
    database: Database,
    labels: Iterable[str],
    progress: Progress | None = None,
    *,
    everything: bool = False,
) -> list[str]:
    """Make the index of recordings again from their segments, one after the other.

    While one is made again, the others answer; what is interrupted, the next opening
    finishes.

    Args:
        directory: The store.
        catalog: Its catalog.
        database: The index.
        labels: The recordings.
        progress: Called after each chunk.
        everything: Whether these are all, and `remove_rest` follows.

    Returns:
        Labels of those that are being written, which were left as they are.

    Raises:
        DatabaseError: MongoDB fails.
    """
    state = IndexState(database)
    left = []
    for label in labels:
        with directory.writing(label) as mine:
            if not mine:
                left.append(label)
                continue
            entry = put_entry(directory, catalog, label)
            # What lies outside of its times takes a look at every document.
            _clear(state, entry, entry.span if everything else None)
            catch_up(directory, catalog, database, label, progress)
    return left


def _clear(state: IndexState, entry: RecordingEntry, span: tuple[int, int] | None = None) -> None:
    """Remove the documents of a recording that is about to be indexed from its beginning."""
    indexed = state.one(entry.key)
    turn = 1 if indexed is None else indexed.turn + 1
    # Until all of them are gone, the next opening begins with that.
    state.put(entry, "clearing", turn=turn)
    state.clear(entry.key, state.topic_collections(), span)
    state.put(entry, "indexing", turn=turn)


def remove_rest(
    directory: StoreDirectory,
    catalog: Catalog,
    database: Database,
    entries: Iterable[RecordingEntry],
    progress: Progress | None = None,
) -> None:
    """Remove documents that belong to no recording, or that their recording does not account for.

    Each collection is read once.

    Args:
        directory: The store.
        catalog: Its catalog.
        database: The index.
        entries: All recordings.
        progress: Called while a recording is indexed once more.

    Raises:
        DatabaseError: MongoDB fails.
    """
    state = IndexState(database)
    known = {entry.key: entry for entry in entries}
    again: set[str] = set()
    strangers: list[tuple[object, str]] = []
    for collection in state.topic_collections():
        pipeline = [{"$group": {"_id": "$_meta.rec", "count": {"$sum": 1}}}]
        for found in database.aggregate(collection, pipeline):
            key = found["_id"]
            entry = known.get(key) if isinstance(key, str) else None
            if entry is None:
                strangers.append((key, collection))
                continue
            # Fewer, too: a document of no recording may have stood in the place of one.
            missing = _messages_in(entry, collection) - found["count"]
            if missing < 0 or (missing > 0 and not catalog.damage(entry.id)):
                again.add(entry.key)
    # Listed only now: of a recording that has begun meanwhile there is a directory by now.
    present = ids_present(directory) if strangers else None
    for key, collection in strangers:
        if present is not None and not (isinstance(key, str) and key in present):
            state.clear(key, [collection])
    for key in sorted(again):
        entry = known[key]
        with directory.writing(entry.label) as mine:
            if mine:
                _clear(state, entry)
                catch_up(directory, catalog, database, entry.label, progress)


def _messages_in(entry: RecordingEntry, collection: str) -> int:
    return sum(c.stats.messages for c in entry.channels if collection_of(c.topic) == collection)


def mirror(catalog: Catalog, database: Database, recording: str) -> None:
    """Bring the mirror of a recording up to date after its journal has grown.

    Raises:
        DatabaseError: MongoDB fails; the next connection does it.
    """
    state = IndexState(database)
    known = catalog.recordings().get(recording)
    if known is not None:
        state.show(known[1])
