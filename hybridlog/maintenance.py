"""Keeping index and segments together: recover, catch up, reindex, verify.

The segments are the truth. Everything here compares the database with them, and
mends the database, never the other way round.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from hybridlog import field_indexes
from hybridlog.columns.gatherer import FieldGatherer
from hybridlog.columns.stored import FieldColumns
from hybridlog.columns.topic import is_small
from hybridlog.entries import build_entry, channels_of, entry_of, read_summaries
from hybridlog.index_writer import IndexWriter
from hybridlog.indexing import ChunkIndexer, Documents
from hybridlog_storage.catalog import (
    CHUNKS,
    RECORDINGS,
    Catalog,
    ChannelTotals,
    RecordingEntry,
    schema_hash,
)
from hybridlog_storage.collection_names import CATALOG_PREFIX
from hybridlog_storage.errors import SegmentError, StoreError
from hybridlog_storage.index_documents import key_bound, recording_key
from hybridlog_storage.recovery import Recovered, recover_segment
from hybridlog_storage.segment_check import SegmentCheck
from hybridlog_storage.segment_reader import SegmentReader

if TYPE_CHECKING:
    from hybridlog_storage.catalog import ChunkEntry
    from hybridlog_storage.chunk import StoredChunk
    from hybridlog_storage.database import Database
    from hybridlog_storage.directory import StoreDirectory
    from hybridlog_storage.messages import Channel, Schema
    from hybridlog_storage.segment_reader import SegmentSummary

Progress = Callable[[str, int, int], None]
"""Called with the recording's id, bytes done and bytes in all."""


@dataclass(slots=True)
class Tended:
    """What the opening of a store had to mend.

    Attributes:
        recovered: Segments that a crash had left open, by recording id.
        indexed: Recordings whose index was behind, and by how many chunks.
        removed: Recordings in the database without a file.
        unreadable: Recordings that could not be mended, and why; the others are.
    """

    recovered: dict[str, list[Recovered]] = field(default_factory=dict)
    indexed: dict[str, int] = field(default_factory=dict)
    removed: list[str] = field(default_factory=list)
    unreadable: dict[str, str] = field(default_factory=dict)


def recover(directory: StoreDirectory, recording_id: str) -> list[Recovered]:
    """Seal what a crash left open in a recording; nothing while somebody writes it."""
    empty = not directory.segments(recording_id) and not directory.open_segments(recording_id)
    if empty and directory.is_beginning(recording_id):
        return []
    if not empty and not directory.open_segments(recording_id):
        return []
    with directory.writing(recording_id) as mine:
        if not mine:
            return []
        results = [recover_segment(path) for _, path in directory.open_segments(recording_id)]
        if not directory.segments(recording_id):
            directory.remove_recording(recording_id)
    return results


def tend(
    directory: StoreDirectory,
    database: Database,
    recordings: Sequence[RecordingEntry],
    progress: Progress | None = None,
) -> Tended:
    """Bring index and segments together after a crash, or after the database was lost.

    Args:
        directory: The store.
        database: The index.
        recordings: All that the catalog has.
        progress: Called while an index is brought up to date.
    """
    tended = Tended()
    catalog = Catalog(database)
    known = {r.id: r for r in recordings}
    for recording_id in directory.recording_ids():
        try:
            _tend_one(
                directory,
                database,
                recording_id,
                entry=known.get(recording_id),
                tended=tended,
                progress=progress,
            )
        except SegmentError as error:
            tended.unreadable[recording_id] = str(error)
    present = set(directory.recording_ids())
    for recording_id in known:
        if recording_id not in present:
            catalog.remove_recording(recording_id, _topic_collections(database))
            tended.removed.append(recording_id)
    return tended


def _tend_one(
    directory: StoreDirectory,
    database: Database,
    recording_id: str,
    *,
    entry: RecordingEntry | None,
    tended: Tended,
    progress: Progress | None,
) -> None:
    recovered = recover(directory, recording_id)
    if recovered:
        tended.recovered[recording_id] = recovered
    if not directory.segments(recording_id):
        return
    if entry is None or entry.status == "open" or recovered:
        with directory.writing(recording_id) as mine:
            if mine:
                chunks = catch_up(directory, database, recording_id, progress)
                tended.indexed[recording_id] = chunks


def catch_up(
    directory: StoreDirectory,
    database: Database,
    recording_id: str,
    progress: Progress | None = None,
) -> int:
    """Index the chunks of a sealed recording that have no catalog entry; returns how many.

    Raises:
        DatabaseError: the database does not take them.
        SegmentError: a segment cannot be read.
    """
    catalog = Catalog(database)
    summaries = read_summaries(directory, recording_id)
    entry = entry_of(summaries[min(summaries)].recording)
    is_open = database.find_one(RECORDINGS, {"_id": recording_id, "status": "open"}) is not None
    indexer = ChunkIndexer(recording_id, entry.key)
    places = {(n, c.offset) for n, summary in summaries.items() for c in summary.chunks}
    done = _indexed(catalog, recording_id)
    if not places.issuperset(done) or is_open:
        # A power cut may take back chunks whose index documents are on the disk already.
        _drop_dangling(database, recording_id, summaries)
        done = _indexed(catalog, recording_id)
    gatherer = FieldGatherer(directory.recording(recording_id))
    index = IndexWriter(indexer, database)
    missing = places - done.keys()
    # What is indexed already is missing in the columns all the same.
    wanted = dict.fromkeys(missing, True)
    wanted.update((place, False) for place, has_small in done.items() if has_small)
    try:
        for chunk, channels in _chunks(directory, recording_id, summaries, wanted, progress):
            gatherer.add(chunk, channels)
            if (chunk.segment, chunk.offset) in missing:
                index.submit(chunk, channels)
        index.close()
        if index.failure is not None:
            raise index.failure
        totals = ChannelTotals.of(catalog.every_chunk(recording_id))
        whole = build_entry(directory, indexer, recording_id, totals, summaries.values())
        gatherer.close(whole)
    except BaseException:
        index.abandon()
        gatherer.discard()
        raise
    catalog.put_schemas(channels_of(summaries.values()).values())
    catalog.put_losses(recording_id, whole.end.get("losses", []))
    catalog.put_recording(whole)
    return len(missing)


def _indexed(catalog: Catalog, recording_id: str) -> dict[tuple[int, int], bool]:
    """The chunks with an entry, by segment and place: whether their messages are small."""
    return {(c.segment, c.offset): _is_small(c) for c in catalog.every_chunk(recording_id)}


def _is_small(chunk: ChunkEntry) -> bool:
    return is_small(sum(s.payload_bytes for s in chunk.stats.values()), chunk.messages)


def _drop_dangling(
    database: Database, recording_id: str, summaries: Mapping[int, SegmentSummary]
) -> None:
    """Remove what the database says of chunks that are not in the segments."""
    of_document: list[dict[str, object]] = [{"_meta.ref.seg": {"$nin": list(summaries)}}]
    of_entry: list[dict[str, object]] = [{"seg": {"$nin": list(summaries)}}]
    for number, summary in summaries.items():
        offsets = [place.offset for place in summary.chunks]
        of_document.append({"_meta.ref.seg": number, "_meta.ref.chunk": {"$nin": offsets}})
        of_entry.append({"seg": number, "_id.off": {"$nin": offsets}})
    for collection in _topic_collections(database):
        database.delete(collection, {"_meta.rec": recording_id, "$or": of_document})
    database.delete(CHUNKS, {"rec": recording_id, "$or": of_entry})


def reindex(
    directory: StoreDirectory, database: Database, progress: Progress | None = None
) -> list[RecordingEntry]:
    """Drop the index and make it again from the segments.

    Raises:
        StoreError: a recording is being written; nothing is dropped.
        SegmentError: a segment cannot be read. When its summary cannot, nothing is
            dropped; when a chunk cannot, all other recordings are in the index.
    """
    for recording_id in directory.recording_ids():
        recover(directory, recording_id)
        read_summaries(directory, recording_id)
    damaged: SegmentError | None = None
    with ExitStack() as held:
        for recording_id in directory.recording_ids():
            if not held.enter_context(directory.writing(recording_id)):
                raise being_written(recording_id)
        fields = field_indexes.of_collections(database)
        for collection in database.list_collections():
            if collection != STORE_MARK:
                database.drop(collection)
        catalog = Catalog(database)
        catalog.prepare()
        field_indexes.make_again(database, fields)
        for recording_id in directory.recording_ids():
            if directory.segments(recording_id):
                try:
                    catch_up(directory, database, recording_id, progress)
                except SegmentError as error:
                    damaged = damaged or error
    if damaged is not None:
        raise damaged
    return catalog.recordings()


def being_written(recording_id: str) -> StoreError:
    """The error for a recording that another process holds."""
    return StoreError(
        f"Recording {recording_id!r} is being written. Wait until it is done, or stop it."
    )


STORE_MARK = f"{CATALOG_PREFIX}store"
"""Collection that says which store a database belongs to."""


@dataclass(frozen=True, slots=True)
class Finding:
    """Something that `verify` found to be off."""

    recording: str
    place: str
    problem: str


@dataclass(slots=True)
class Verification:
    """What `verify` has read, and found."""

    recordings: int = 0
    chunks: int = 0
    messages: int = 0
    bytes_read: int = 0
    findings: list[Finding] = field(default_factory=list)


def verify(
    directory: StoreDirectory,
    database: Database,
    recording_ids: list[str],
    progress: Progress | None = None,
) -> Verification:
    """Read every chunk, check its checksum, and compare the index with it byte for byte.

    The documents of a chunk are made anew and compared with those in the database, so
    that each reference is seen to name the message it was made for.
    """
    result = Verification()
    for recording_id in recording_ids:
        result.recordings += 1
        try:
            _verify_recording(directory, database, recording_id, result, progress)
        except SegmentError as error:
            result.findings.append(Finding(recording_id, "segments", str(error)))
    return result


def _verify_recording(
    directory: StoreDirectory,
    database: Database,
    recording_id: str,
    result: Verification,
    progress: Progress | None,
) -> None:
    catalog = Catalog(database)
    check = _Check(database, recording_id, result)
    check.entries = {(c.segment, c.offset): c for c in catalog.chunks(recording_id)}
    chunks = list(check.entries.values())
    for number, path in directory.segments(recording_id):
        with SegmentReader(path, number) as reader:
            try:
                check.segment(reader, progress)
            except SegmentError as error:
                check.found(path.name, str(error))
            result.bytes_read += reader.bytes_read
    check.rest()
    known = {r.id: r for r in catalog.recordings()}
    if recording_id not in known:
        check.found("catalog", "the recording is missing; run `hybridlog reindex`")
        return
    if check.indexer is not None and not check.damaged:
        totals = ChannelTotals.of(chunks)
        whole = build_entry(directory, check.indexer, recording_id, totals)
        if known[recording_id] != whole:
            check.found("catalog", "its entry differs from the segments; run `hybridlog reindex`")
    try:
        FieldColumns(directory.recording(recording_id)).check(known[recording_id])
    except FileNotFoundError:
        pass  # there need not be any
    except StoreError as error:
        check.found("columns", str(error))


class _Check:
    """Compares the segments of one recording with the database."""

    def __init__(self, database: Database, recording_id: str, result: Verification) -> None:
        self.entries: dict[tuple[int, int], ChunkEntry] = {}
        self.indexer: ChunkIndexer | None = None
        self.damaged = False
        self._database = database
        self._recording_id = recording_id
        self._result = result
        self._expected: dict[str, int] = {}
        self._schemas: set[Schema] = set()

    def found(self, place: str, problem: str) -> None:
        self.damaged = True
        self._result.findings.append(Finding(self._recording_id, place, problem))

    def segment(self, reader: SegmentReader, progress: Progress | None) -> None:
        """Every chunk of a segment, and the number of its messages."""
        summary = reader.summary()
        base = entry_of(summary.recording)
        self._schemas.update(c.schema for c in summary.channels.values() if c.schema is not None)
        if self.indexer is None:
            self.indexer = ChunkIndexer(self._recording_id, base.key)
        name = reader.path.name
        if summary.recording.get("segment") != reader.number:
            self.found(name, f"it says that it is segment {summary.recording.get('segment')}")
        messages = 0
        with SegmentCheck(reader.path) as check:
            for place in summary.chunks:
                where = f"{name} byte {place.offset}"
                try:
                    chunk = reader.read_chunk(place)
                except SegmentError as error:
                    self.entries.pop((reader.number, place.offset), None)
                    self.found(where, str(error))
                    continue
                problem = check.chunk(chunk)
                if problem is not None:
                    self.found(where, problem)
                self._chunk(name, chunk, summary.channels, base.key)
                messages += len(chunk.batch)
                if progress is not None:
                    progress(self._recording_id, place.offset + place.length, reader.size)
            for offset, problem in check.between_chunks():
                self.found(f"{name} byte {offset}", problem)
        self._result.messages += messages
        if messages != sum(summary.counts.values()):
            self.found(name, f"{messages} messages; its statistics say otherwise")

    def rest(self) -> None:
        """What the database has beyond the segments, and the schemas."""
        wanted = {schema_hash(schema): schema for schema in self._schemas}
        have_schemas = Catalog(self._database).schemas(wanted)
        for digest, schema in wanted.items():
            if have_schemas.get(digest) != schema:
                self.found(f"schema {schema.name}", "it is missing from the catalog or differs")
        for segment, offset in self.entries:
            place = f"segment {segment} byte {offset}"
            self.found(place, "the catalog names a chunk that is not there")
        for collection in _topic_collections(self._database):
            have = self._database.count(collection, {"_meta.rec": self._recording_id})
            want = self._expected.get(collection, 0)
            if have != want:
                problem = f"{have} index documents, {want} messages in the segments"
                self.found(f"collection {collection}", problem)

    def _chunk(
        self, name: str, chunk: StoredChunk, channels: Mapping[int, Channel], key: int
    ) -> None:
        assert self.indexer is not None
        self._result.chunks += 1
        where = f"{name} byte {chunk.offset}"
        documents, (entry,) = self.indexer.documents_of([chunk], channels)
        for collection, want in _by_collection(documents).items():
            self._expected[collection] = self._expected.get(collection, 0) + len(want)
            problem = _compare(self._database, key, chunk, collection, want)
            if problem:
                self.found(f"{where}, collection {collection}", problem)
        if self.entries.pop((chunk.segment, chunk.offset), None) != entry:
            self.found(where, "its catalog entry is missing or differs")


def _by_collection(documents: Iterable[Documents]) -> dict[str, list[bytes]]:
    """Single documents; several channels of a chunk may share a topic."""
    found: dict[str, list[bytes]] = {}
    for part in documents:
        found.setdefault(part.collection, []).extend(
            row.tobytes() for table in part.tables for row in table
        )
    return found


def _compare(
    database: Database, key: int, chunk: StoredChunk, collection: str, want: list[bytes]
) -> str | None:
    """What is wrong with the documents of a chunk in one collection."""
    times = chunk.batch.log_time
    query = {
        "_id": {"$gte": key_bound(int(times.min())), "$lt": key_bound(int(times.max()) + 1)},
        "_meta.ref.chunk": chunk.offset,
        "_meta.ref.seg": chunk.segment,
    }
    have = {
        document
        for raw in database.find_raw(collection, query)
        for document in _split(raw)
        if recording_key(document) == key
    }
    if have == set(want):
        return None
    missing, extra = len(set(want) - have), len(have - set(want))
    return f"{missing} index documents are missing or differ, {extra} are not of this chunk"


def _split(data: bytes) -> Iterator[bytes]:
    at = 0
    while at < len(data):
        size = int.from_bytes(data[at : at + 4], "little")
        yield data[at : at + size]
        at += size


def _chunks(
    directory: StoreDirectory,
    recording_id: str,
    summaries: Mapping[int, SegmentSummary],
    wanted: Mapping[tuple[int, int], bool],
    progress: Progress | None,
) -> Iterator[tuple[StoredChunk, Mapping[int, Channel]]]:
    """Chunks of a recording, in order.

    Args:
        directory: The store.
        recording_id: The recording.
        summaries: Of its segments.
        wanted: Which chunks, by segment and offset, and whether each must be readable.
        progress: Called after each.

    Raises:
        SegmentError: One that must be readable is not; others are left out.
    """
    total = sum(p.stat().st_size for _, p in directory.segments(recording_id))
    before = 0
    for number, path in directory.segments(recording_id):
        summary = summaries[number]
        with SegmentReader(path, number) as reader:
            for place in summary.chunks:
                is_needed = wanted.get((number, place.offset))
                if is_needed is None:
                    continue
                try:
                    chunk = reader.read_chunk(place)
                except SegmentError:
                    if is_needed:
                        raise
                    continue
                yield chunk, summary.channels
                if progress is not None:
                    progress(recording_id, before + place.offset + place.length, total)
        before += path.stat().st_size


def _topic_collections(database: Database) -> list[str]:
    return [c for c in database.list_collections() if not c.startswith(CATALOG_PREFIX)]
