"""Makes tables, statistics and index documents of a recording, behind its recorder.

`IndexWriter` reads the chunks that were flushed back from their segments, so memory does not
grow with what waits. `DocumentSender` sends documents in the order of each file, so that one
position a file says what the index has.
"""

from __future__ import annotations

import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING

import numpy as np

from hybridlog.index.indexing import ChunkIndexer
from hybridlog_storage.catalog import decoded_in
from hybridlog_storage.errors import DatabaseError, HybridlogError, SegmentError
from hybridlog_storage.mongo.collection_names import collection_of
from hybridlog_storage.mongo.index_state import IndexState
from hybridlog_storage.segments.segment_file import OPEN_SUFFIX, sealed_name
from hybridlog_storage.segments.segment_reader import ChunkPlace, SegmentReader
from hybridlog_storage.threads import Threads

if TYPE_CHECKING:
    from concurrent.futures import Future
    from pathlib import Path

    from numpy.typing import NDArray

    from hybridlog.columns.table_writer import TableWriter
    from hybridlog.index.indexing import Documents
    from hybridlog_storage.catalog import Catalog, ChannelStats, ChunkEntry, RecordingEntry
    from hybridlog_storage.messages import Channel
    from hybridlog_storage.mongo.database import Database
    from hybridlog_storage.segments.chunk import StoredChunk
    from hybridlog_storage.segments.segment_file import Sealed

INTERVAL_S = 5.0
"""Longest time between two passes over what was flushed, seconds."""
_INTERVAL_BYTES = 64 << 20  # content that was flushed since the last pass, at most
_SEND_BYTES = 8 << 20  # documents that are sent together, at most
_GROUP_BYTES = 1 << 20  # content of small chunks that are decoded together
_RETRY_S = 2.0  # between attempts after the database has failed


@dataclass(frozen=True, slots=True)
class IndexTarget:
    """The database for the index documents of a new recording.

    Attributes:
        database: The index; None if it is unavailable now, or the recording gets none.
        failure: Why it is unavailable now; None if it is not, or the recording gets none.
        renew: Another connection to the index, after one has failed; starts the embedded
            MongoDB again if that has ended. Raises `DatabaseError`.
    """

    database: Database | None = None
    failure: DatabaseError | None = None
    renew: Callable[[], Database] | None = None

    @property
    def is_wanted(self) -> bool:
        """True if the recording gets documents, now or later."""
        return self.database is not None or self.failure is not None


class DocumentSender:
    """Sends the documents of a recording's chunks to the index.

    Attributes:
        messages: Number of those whose documents it has sent.
    """

    def __init__(self, entry: RecordingEntry, database: Database) -> None:
        self.messages = 0
        self._added = 0  # messages, and segments, since the last sending
        self._ended: dict[str, str] = {}
        self._key = entry.key
        self._database = database
        self._collections: set[str] = set()  # that exist
        self._documents: dict[str, list[NDArray[np.uint8]]] = {}
        self._size = 0
        self._thread = Threads(1, "hybridlog-send")
        self._sending: Future[None] | None = None

    def add(self, documents: Sequence[Documents], entries: Sequence[ChunkEntry]) -> None:
        """Add the documents of chunks.

        Raises:
            DatabaseError: An earlier sending has failed.
        """
        for part in documents:
            self._documents.setdefault(part.topic, []).extend(part.tables)
            self._size += part.size
        self._added += sum(entry.messages for entry in entries)
        if self._size >= _SEND_BYTES:
            self.send()

    def end_segment(self, number: int, digest: str) -> None:
        """Note that all chunks of a segment were added."""
        self._ended[str(number)] = digest

    def send(self, *, wait: bool = False) -> None:
        """Send what was added, while more is made.

        Args:
            wait: True to wait until the index has it.

        Raises:
            DatabaseError: This sending has failed, or an earlier one.
        """
        if self._sending is not None:
            self._sending.result()
        if self._added or self._ended:
            sent = self._documents, self._added, self._ended
            self._documents, self._added, self._ended, self._size = {}, 0, {}, 0
            self._sending = self._thread.submit(self._send, *sent)
            if wait:
                self._sending.result()

    def close(self) -> None:
        """Stop sending."""
        self._thread.shutdown(wait=True, cancel_futures=True)

    def _send(
        self,
        documents: Mapping[str, list[NDArray[np.uint8]]],
        messages: int,
        segments: Mapping[str, str],
    ) -> None:
        if not self._collections:
            # One command, where creating each would be one for each topic.
            self._collections.update(self._database.list_collections())
        for topic, tables in documents.items():
            if not tables:
                continue
            name = collection_of(topic)
            if name not in self._collections:
                self._database.ensure_collection(name)
                self._collections.add(name)
            counts, widths = zip(*(table.shape for table in tables), strict=True)
            data = b"".join(table.data for table in tables)
            lengths = np.repeat(widths, counts).astype(np.int64)
            self._database.insert_raw(name, data, lengths)
        if segments:
            IndexState(self._database).put_segments(self._key, segments)
        self.messages += messages


class IndexWriter:
    """Follows a recording that is being written.

    One thread reads the chunks that were flushed: every few seconds, after many bytes, when a
    segment is sealed and at the end. A failing database stops the index, never the recording:
    the index goes on with what comes after the database answers again, and the end of the
    recording brings what it has missed.

    Args:
        recording: The recording's directory.
        entry: The recording.
        target: Where documents go.
        catalog: Gets the decoding results of each segment.
        tables: Gets each chunk once, in the order of the file.
        interval_s: Longest time between two passes, seconds.

    Attributes:
        failure: The error that stopped the index; None while it works. At the end, the last one.
        damage: Chunks that could not be read back: reason by segment and number.
    """

    def __init__(
        self,
        recording: Path,
        entry: RecordingEntry,
        target: IndexTarget,
        catalog: Catalog,
        *,
        tables: TableWriter,
        interval_s: float = INTERVAL_S,
    ) -> None:
        self.failure = self._last_failure = target.failure
        self.damage: dict[tuple[int, int], str] = {}
        self._recording = recording
        self._entry = entry
        self._target = target
        self._catalog = catalog
        self._tables = tables
        self._interval_s = interval_s
        self._indexer = ChunkIndexer(entry.id, has_documents=target.is_wanted)
        self._channels: Mapping[int, Channel] = {}
        self._places: dict[int, list[ChunkPlace]] = {}  # chunks of segments that are not read yet
        self._sealed: dict[int, str] = {}  # their digests
        self._flushed = 0  # messages
        self._unread = 0  # bytes since the last pass
        self._read_to: Counter[int] = Counter()  # chunks of segments that are not read yet
        self._stats: dict[int, dict[int, Mapping[int, ChannelStats]]] = {}  # by segment and chunk
        self._readers: dict[int, SegmentReader] = {}
        self._sender: DocumentSender | None = None
        if target.database is not None:
            self._sender = DocumentSender(entry, target.database)
        self._gaps: set[int] = set()  # segments of which the index has missed something
        self._indexed = 0
        self._retry_at = 0.0
        self._renewed: Database | None = None
        self._crash: BaseException | None = None
        self._has_ended = self._is_abandoned = False
        # No event: a thread that is interrupted in `set` may leave it locked forever.
        self._calls: SimpleQueue[None] = SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="hybridlog-index", daemon=True)
        self._thread.start()

    @property
    def indexed(self) -> int:
        """Number of messages that the index has."""
        return self._indexed + (0 if self._sender is None else self._sender.messages)

    @property
    def missed(self) -> int:
        """Number of messages that it lacks after a failure of the database."""
        return self._flushed - self.indexed if self.failure is not None else 0

    @property
    def first_unread(self) -> int:
        """Number of the first segment that it may still read."""
        return min([*self._places], default=sys.maxsize)

    def submit(self, chunk: StoredChunk, channels: Mapping[int, Channel]) -> None:
        """Note a chunk that is in its segment."""
        if self._crash is not None:
            raise self._crash
        self._channels = channels
        self._places.setdefault(chunk.segment, []).append(_place_of(chunk))
        self._flushed += len(chunk.batch)
        self._unread += len(chunk.batch.buffer)
        if self._unread >= _INTERVAL_BYTES:
            self._unread = 0
            self._calls.put(None)

    def seal(self, sealed: Sealed) -> None:
        """Note that a segment has all its chunks."""
        self._places.setdefault(sealed.file.number, [])
        self._sealed[sealed.file.number] = sealed.file.digest
        self._calls.put(None)

    def prepare(self, channel: Channel) -> None:
        """Prepare a channel before its first message."""
        self._indexer.prepare(channel)

    def close(self) -> None:
        """Read all chunks; raise errors other than those of the database."""
        self._end()
        if self._crash is not None:
            raise self._crash
        self.failure = self._last_failure

    def abandon(self) -> None:
        """Stop without reading waiting chunks."""
        self._is_abandoned = True
        self._end()

    def _end(self) -> None:
        self._has_ended = True
        self._calls.put(None)
        self._thread.join()

    # The methods below run on the thread of the index.

    def _run(self) -> None:
        try:
            has_ended = False
            while not has_ended:
                with suppress(Empty):
                    self._calls.get(timeout=self._interval_s)
                has_ended = self._has_ended  # after the call, or its end would be waited for
                if not self._is_abandoned:
                    self._advance(has_ended=has_ended)
        except BaseException as error:
            self._crash = error
        finally:
            self._stop_sending()
            for segment in [*self._readers]:
                self._close_reader(segment)

    def _advance(self, *, has_ended: bool) -> None:
        """Read what was flushed since the last pass."""
        if self.failure is not None and not has_ended and time.monotonic() >= self._retry_at:
            self._reconnect()
        sealed = dict(self._sealed)  # first: all chunks of these are known then
        for segment in sorted([*self._places]):
            for group in self._read(segment):
                self._take(group)
                if self._is_abandoned:
                    return
            if segment in sealed:
                self._end_segment(segment, sealed[segment])
        if self._sender is not None:
            with self._noting_failure():
                self._sender.send(wait=has_ended)

    def _read(self, segment: int) -> Iterator[list[StoredChunk]]:
        """The chunks of a segment that were not read yet; small ones in groups."""
        places = self._places[segment][self._read_to[segment] :]  # before the file's size is read
        if not places:
            return
        self._read_to[segment] += len(places)
        reader = self._open(segment)
        reader.grow()
        group: list[StoredChunk] = []
        size = 0
        for place in places:
            try:
                chunk = reader.read_chunk(place)
            except SegmentError as error:
                self.damage[segment, place.number] = str(error)
                continue
            size += len(chunk.batch.buffer)
            if group and size > _GROUP_BYTES:
                yield group
                group, size = [], len(chunk.batch.buffer)
            group.append(chunk)
        if group:
            yield group

    def _take(self, chunks: Sequence[StoredChunk]) -> None:
        """Make rows and documents of chunks of one segment."""
        segment = chunks[0].segment
        for chunk in chunks:
            self._tables.add(chunk, self._channels)
        documents, entries = self._indexer.documents_of(chunks, self._channels)
        self._stats.setdefault(segment, {}).update({entry.number: entry.stats for entry in entries})
        if self._sender is None:
            self._gaps.add(segment)
            return
        with self._noting_failure():
            self._sender.add(documents, entries)

    def _end_segment(self, segment: int, digest: str) -> None:
        """Store the decoding results of a segment, if all of it could be read."""
        self._tables.cut(segment, digest)
        stats, count = self._stats.pop(segment, {}), len(self._places[segment])
        if len(stats) == count:
            with suppress(HybridlogError):  # it is derived, and the disk may be full
                decoded = decoded_in(stats.values())
                self._catalog.put_decoded(self._entry.id, segment, digest, decoded)
        del self._places[segment], self._read_to[segment], self._sealed[segment]
        self._close_reader(segment)
        if self._sender is not None and segment not in self._gaps:
            self._sender.end_segment(segment, digest)
        self._gaps.discard(segment)

    def _open(self, segment: int) -> SegmentReader:
        """The reader of a segment, which may still grow."""
        reader = self._readers.get(segment)
        if reader is not None:
            return reader
        path = self._recording / f"{segment:06d}{OPEN_SUFFIX}"
        try:
            reader = SegmentReader(path, segment)
        except SegmentError:  # it is sealed by now
            reader = SegmentReader(path.with_name(sealed_name(segment)), segment)
        self._readers[segment] = reader
        return reader

    def _close_reader(self, segment: int) -> None:
        reader = self._readers.pop(segment, None)
        if reader is not None:
            reader.close()

    @contextmanager
    def _noting_failure(self) -> Iterator[None]:
        """Stop the index at a failure of the database."""
        try:
            yield
        except DatabaseError as error:
            self._fail(error)

    def _fail(self, error: DatabaseError) -> None:
        self._stop_sending()
        self._gaps.update(self._read_to)  # of what was sent, some may be lost
        self.failure = self._last_failure = error
        self._retry_at = time.monotonic() + _RETRY_S

    def _stop_sending(self) -> None:
        if self._sender is not None:
            self._sender.close()
            self._indexed, self._sender = self.indexed, None
        if self._renewed is not None:
            self._renewed.close()
            self._renewed = None

    def _reconnect(self) -> None:
        """Go on after a failure of the database, with what comes from now on."""
        if self._target.renew is None:
            return
        try:
            self._renewed = self._target.renew()
            state = IndexState(self._renewed)
            if state.one(self._entry.key) is None:  # it was unavailable when the recording began
                state.begin(self._entry)
        except DatabaseError as error:
            self._fail(error)
            return
        self.failure = None
        self._sender = DocumentSender(self._entry, self._renewed)


def _place_of(chunk: StoredChunk) -> ChunkPlace:
    return ChunkPlace(
        offset=chunk.offset,
        length=chunk.length,
        trailer=chunk.trailer,
        first=int(chunk.batch.log_time.min()),
        last=int(chunk.batch.log_time.max()),
        channels=(),
        number=chunk.number,
    )
