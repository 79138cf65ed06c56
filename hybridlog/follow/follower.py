"""Brings what is derived of a recording up to date with its files.

One class does it behind a recorder, after a crash, after a copy and in a rebuild. It reads
chunks back from their files, so that memory does not grow with what waits, and a follower that
ends at any point costs nothing but the work of the next one.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any, Final

from msgspec import Struct, field

from hybridlog.entries import put_entry
from hybridlog.index.indexing import ChunkIndexer, Sender
from hybridlog.maintenance.keep import make_rows
from hybridlog.maintenance.opening import missing
from hybridlog.maintenance.report import Followed, IndexTarget, Progress, reporter
from hybridlog.maintenance.retention import Rules
from hybridlog.shared import RecordingRows
from hybridlog_storage.catalog import WHOLE, Catalog, ChannelStats, RecordingEntry, file_of
from hybridlog_storage.errors import (
    DatabaseError,
    HybridlogError,
    SegmentError,
    StoreError,
    TopicError,
)
from hybridlog_storage.mongo.index_documents import IndexState
from hybridlog_storage.segments.chunk_table import ChunkPlace, places_of
from hybridlog_storage.segments.segment_reader import SegmentReader, open_log
from hybridlog_storage.segments.walk import Walk
from hybridlog_storage.settings import read_settings

if TYPE_CHECKING:
    from hybridlog_storage.disk.directory import StoreDirectory
    from hybridlog_storage.messages import Channel
    from hybridlog_storage.mongo.database import Database
    from hybridlog_storage.segments.chunk import StoredChunk

_GROUP_BYTES: Final = 8 << 20  # content of chunks that are decoded together
_GROUP_ROWS: Final = 1 << 17  # messages that are decoded together


class _Segment(Struct):
    """A segment in work.

    Attributes:
        is_wanted: Whether documents are made.
        opened: Its file while it grows.
        chunks: Number of chunks that were read.
        decoded: Results of decoding, by channel.
        is_decoded: Whether these are known already; then only rows are made.
    """

    is_wanted: bool
    opened: Walk | None = None
    chunks: int = 0
    decoded: dict[int, ChannelStats] = field(default_factory=dict)
    is_decoded: bool = False


class Follower:
    """Brings what is derived of one recording up to date; this process has locked it.

    A failing database stops the documents and nothing else; the next follower makes what is
    missing.

    Args:
        directory: The store.
        catalog: Gets the results of decoding, and the chunks that cannot be read.
        entry: The recording.
        target: Where documents go.
        topics: Topics whose tables are made; None for all of a new recording.
        done: Numbers of the segments that have all their documents, as text.
        progress: Called after each chunk of `finish`.

    Attributes:
        failure: The error of the database; None without any.
        made: Number of chunks whose documents were made.
        messages: Number of messages that were read.
    """

    def __init__(
        self,
        directory: StoreDirectory,
        catalog: Catalog,
        entry: RecordingEntry,
        target: IndexTarget | None = None,
        *,
        topics: Collection[str] | None = None,
        done: Collection[str] = (),
        progress: Progress | None = None,
    ) -> None:
        self._target = target or IndexTarget()
        self.failure = self._target.failure
        self.made = self.messages = 0
        self._directory = directory
        self._path = directory.recording(entry.id)
        self._catalog = catalog
        self._entry = entry
        self._topics = topics
        self._done = done
        self._progress = progress
        self._indexer = ChunkIndexer(entry.id)
        self._sender: Sender | None = None
        database = self._target.database
        if database is not None:
            with self._noting_failure():
                if not IndexState(database).of([entry.key]):
                    IndexState(database).begin(entry)
                self._sender = Sender(entry.key, database)
        from hybridlog.columns.table_writer import TableWriter  # loads pyarrow

        self._tables = TableWriter(self._directory.path, entry, topics)
        self._damage = self._catalog.damage(entry.id)
        self._segments: dict[int, _Segment] = {}
        self._ended: set[int] = set()

    @property
    def problem(self) -> str:
        """Why no tables were made; empty if they were."""
        return self._tables.problem

    @property
    def state(self) -> Followed:
        """How far it is."""
        read, indexed = self.messages, 0 if self._sender is None else self._sender.messages
        missed = 0 if self.failure is None else read - indexed
        return Followed(self._target.is_wanted, read, indexed, missed, self.failure)

    def follow(self) -> None:
        """Read what was flushed since the last time.

        Raises:
            StoreError: Its files cannot be read now.
        """
        manifest = self._directory.manifests.read(self._entry.id)
        listing = self._directory.listing(self._entry.id).choosing(manifest)
        for number in sorted({*listing.open, *listing.sealed} - self._ended):
            if number in listing.sealed and number in manifest.logs:
                digest = manifest.logs[number].digest
                self._read_sealed(number, listing.sealed[number], digest)
            else:  # what it has got since the last time
                segment = self._segment(number)
                opened = segment.opened = segment.opened or Walk.opened(self._path, number)
                opened.follow()
                self._read(number, opened.reader, places_of(opened.flushed.table), opened.channels)
        self._send()

    def finish(self, entry: RecordingEntry) -> RecordingEntry:
        """Make the rest of what is derived of a recording that has ended.

        Args:
            entry: The recording, as its files are now.

        Returns:
            The same with the results of decoding.

        Raises:
            SegmentError: A segment cannot be read.
        """
        try:
            self._entry, done = entry, 0
            for number in [n for n, _, _ in entry.spans if n not in self._ended]:
                if (digest := entry.digests.get(str(number))) is not None:
                    report = reporter(self._progress, entry.name, entry.stored_bytes, done)
                    done += self._read_sealed(number, file_of(entry, number), digest, report)
            if self._sender is not None:
                self._sender.ended.update(entry.digests)  # also of segments without messages
            self._send()
            if self._damage != self._catalog.damage(entry.id):
                self._catalog.put_damage(entry.id, self._damage)
            entry = put_entry(self._directory, self._catalog, entry.id)
            self._tables.close(entry)
        finally:
            self.discard()
        return entry

    def discard(self) -> None:
        """Leave the rest to the next follower."""
        self._tables.discard()
        self._segments.clear()

    def _segment(self, number: int) -> _Segment:
        is_wanted = self._target.is_wanted and str(number) not in self._done
        return self._segments.setdefault(number, _Segment(is_wanted))

    def _read_sealed(
        self, number: int, name: str, digest: str, report: Callable[[int], None] = lambda _: None
    ) -> int:
        """Read what is left of a sealed segment; returns its bytes."""
        with open_log(self._path / name, number, RecordingRows(self._path).left) as reader:
            summary = reader.summary()
            segment = self._segment(number)
            places = summary.chunks
            self._damage.pop((number, WHOLE), None)
            known = self._catalog.decoded(self._entry.id, {number: digest})
            if not segment.is_wanted and known:
                segment.is_decoded = True
                if self._topics is not None:
                    wanted = {one.id for one in self._entry.channels if one.topic in self._topics}
                    places = [one for one in places if not wanted.isdisjoint(one.channels)]
            self._read(number, reader, places, summary.channels, report)
        del self._segments[number]
        self._ended.add(number)
        if not segment.is_decoded:
            with suppress(HybridlogError):  # it is derived, and the disk may be full
                self._catalog.put_decoded(self._entry.id, number, digest, segment.decoded)
        if segment.is_wanted and self._sender is not None:
            self._sender.ended[str(number)] = digest
        report(reader.size)
        return reader.size

    def _read(
        self,
        number: int,
        reader: SegmentReader,
        places: Iterable[ChunkPlace],
        channels: Mapping[int, Channel],
        report: Callable[[int], None] = lambda _: None,
    ) -> None:
        """Read those chunks of a segment that were not, small ones together."""
        segment, size, rows = self._segments[number], 0, 0
        group: list[StoredChunk] = []
        for place in [*(one for one in places if one.number >= segment.chunks), None]:
            is_full = size >= _GROUP_BYTES or rows >= _GROUP_ROWS
            if group and (place is None or is_full):
                self._take(segment, group, channels)
                report(group[-1].place.offset)
                group, size, rows = [], 0, 0
            if place is None:
                break
            if not segment.is_decoded:
                self._damage.pop((number, place.number), None)
            try:
                chunk = reader.read_chunk(place)
            except SegmentError as error:
                if not segment.is_decoded:  # else tables may have its fields
                    self._damage[number, place.number] = str(error)
                continue
            group.append(chunk)
            size += len(chunk.batch.buffer)
            rows += len(chunk.batch)

    def _take(
        self, segment: _Segment, chunks: Sequence[StoredChunk], channels: Mapping[int, Channel]
    ) -> None:
        """Make rows, results of decoding and documents of chunks of one segment."""
        found = self._indexer.messages_in(chunks, channels)
        self._tables.add(found)
        segment.chunks = chunks[-1].number + 1
        if segment.is_decoded:
            return
        documents = [
            (one.channel.topic, table)
            for one in found
            for table in self._indexer.take(one, segment.decoded, has_documents=segment.is_wanted)
        ]
        messages = sum(len(chunk.batch) for chunk in chunks)
        if segment.is_wanted or not self._target.is_wanted:  # else they are there already
            self.messages += messages
        if segment.is_wanted:
            self.made += len(chunks)
            if self._sender is not None and self.failure is None:
                with self._noting_failure():
                    self._sender.add(documents, messages)

    def _send(self) -> None:
        if self._sender is not None and self.failure is None:
            with self._noting_failure():
                self._sender.send()

    @contextmanager
    def _noting_failure(self) -> Iterator[None]:
        """Stop the documents at a failure of the database."""
        try:
            yield
        except HybridlogError as error:
            self.failure = error if isinstance(error, DatabaseError) else DatabaseError(str(error))


def make_rows_ahead(
    directory: StoreDirectory, recording: str, is_wanted: Callable[[], bool]
) -> None:
    """Write rows of what is sealed, where rules of the store let payloads go.

    Raises:
        StoreError: Files cannot be read or written.
        DiskFullError: There is no room.
    """
    if not Rules.of(read_settings(directory.path).retention).is_empty:
        make_rows(directory, recording, is_wanted)


def bring(
    directory: StoreDirectory,
    catalog: Catalog,
    known: RecordingEntry,
    database: Database | None = None,
    *,
    anew: bool = False,
    topics: Collection[str] = (),
    wait_s: float = 0.0,
    progress: Progress | None = None,
) -> Follower | None:
    """Bring what is derived of an ended recording up to date; None if nothing was missing.

    Args:
        directory: The store.
        catalog: Its catalog.
        known: The recording.
        database: The index; None to make no documents.
        anew: Whether documents that are there are made again.
        topics: Topics whose tables are made again.
        wait_s: Seconds to wait for another process that holds the recording.
        progress: Called after each chunk.

    Raises:
        DatabaseError: MongoDB fails.
        HeldError: Another process holds the recording.
        SegmentError: A segment cannot be read.
        TopicError: The recording is gone.
    """
    with directory.writing(known.id, known.name, wait_s=wait_s):
        # Read now that it is locked: another process may have changed it meanwhile.
        entry = put_entry(directory, catalog, known.id)
        wanted = missing(directory, entry).union(topics)
        done, is_whole = dict[str, str](), True
        if database is not None:
            done, is_whole = begin_again(database, entry, anew=anew)
        if is_whole and entry.is_decoded and not wanted:
            return None
        follower = Follower(
            directory,
            catalog,
            entry,
            IndexTarget(database),
            topics=wanted,
            done=done,
            progress=progress,
        )
        follower.finish(entry)
    if follower.failure is not None:
        raise follower.failure
    return follower


def begin_again(
    database: Database, entry: RecordingEntry, *, anew: bool = False
) -> tuple[dict[str, str], bool]:
    """Keep the documents of whole segments, and remove others.

    Args:
        database: The index.
        entry: The recording.
        anew: Whether none are kept.

    Returns:
        Digests of the segments by number as text, and whether they are all there are.
    """
    state = IndexState(database)
    indexed = None if anew else state.of([entry.key]).get(entry.key)
    done = {} if indexed is None else dict(indexed.items() & entry.digests.items())
    is_whole = indexed == entry.digests
    if not is_whole:
        state.begin(entry, done)
        state.clear(entry, but=done)
    return done, is_whole


def make_tables(
    directory: StoreDirectory, catalog: Catalog, entry: RecordingEntry, **options: Any
) -> str:
    """Make missing tables of a recording, with options of `bring`; return why not, if not."""
    if not directory.is_writable:
        return "the store is read-only"
    try:
        follower = bring(directory, catalog, entry, **options)
        return "" if follower is None else follower.problem
    except (StoreError, TopicError) as error:
        return str(error)
