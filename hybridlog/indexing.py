"""From chunks to index documents: one pure function, and the workers that send them.

`documents_of` is what makes the index disposable: it needs nothing but a chunk and its
channels, and `record`, recovery, `reindex` and `verify` all call it.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hybridlog.schema.codec import Codec, codec_for
from hybridlog.schema.column import header_stamps
from hybridlog_storage.catalog import Catalog, ChannelStats, ChannelTotals, ChunkEntry
from hybridlog_storage.chunk_builder import COPIED_AT_ONCE
from hybridlog_storage.collection_names import collection_of
from hybridlog_storage.errors import DatabaseError, SegmentError
from hybridlog_storage.index_documents import DocumentAssembler, Origin
from hybridlog_storage.messages import Batch, Channel
from hybridlog_storage.segment_reader import ChunkPlace, SegmentReader
from hybridlog_storage.segment_writer import OPEN_SUFFIX, SEALED_SUFFIX, StoredChunk

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.columns.gatherer import FieldGatherer
    from hybridlog_storage.database import Database

ARRAY_LIMIT = 32
STAMP = "header.stamp"
_SENDERS = 2
_LAG_PAUSE_S = 0.002
_RETRY_S = 2.0  # after the database has failed
_PARCEL_BYTES = 4 << 20
_PARCEL_CHUNKS = 32
BACKLOG = 8
"""Chunks that may wait for the index in memory, if nobody says."""
_MOST_LATEST = 4096  # chunks: far more than a server that is killed has not in its journal


class Documents(NamedTuple):
    """Index documents of one topic.

    Attributes:
        collection: Where they belong.
        tables: uint8[k, width] each: a whole BSON document a row.
    """

    collection: str
    tables: list[NDArray[np.uint8]]

    @property
    def size(self) -> int:
        """Bytes of all documents."""
        return sum(table.size for table in self.tables)


class ChunkIndexer:
    """Makes the index documents of one recording's chunks. Thread safe.

    Args:
        recording: Recording id.
        key: The recording's number.
        array_limit: Longest array that is kept in the index whole.
    """

    def __init__(self, recording: str, key: int, *, array_limit: int = ARRAY_LIMIT) -> None:
        self.recording = recording
        self._key = key
        self._array_limit = array_limit
        self._parts: dict[int, tuple[Codec, DocumentAssembler, bool]] = {}
        self._lock = threading.Lock()

    def documents_of(
        self, chunk: StoredChunk, channels: Mapping[int, Channel]
    ) -> tuple[list[Documents], ChunkEntry]:
        """All index documents of a chunk, and the chunk's catalog entry."""
        documents: list[Documents] = []
        stats: dict[int, ChannelStats] = {}
        for channel_id, rows in rows_by_channel(chunk.batch.channel):
            channel = channels[channel_id]
            codec, assembler, stamped = self._part(channel_id, channel)
            batch = chunk.batch.take(rows)
            unreadable = 0
            tables: list[NDArray[np.uint8]] = []
            stamps = _Stamps()
            for group in codec.bodies(batch.buffer, batch.offset, batch.length):
                if group.stamps is not None:
                    stamps.add(batch.log_time[group.rows], group.stamps)
                table = assembler.assemble(chunk, rows[group.rows], group.body, group.error)
                tables.append(table)
                if group.error is not None:
                    unreadable += len(table)
            if stamped and not stamps.any:
                stamps.add_decoded(codec, batch)
            documents.append(Documents(collection_of(channel.topic), tables))
            stats[channel_id] = _stats(batch, channel, stamps, unreadable)
        entry = ChunkEntry(
            self.recording,
            chunk.segment,
            chunk.offset,
            chunk.length,
            chunk.trailer,
            int(chunk.batch.log_time.min()),
            int(chunk.batch.log_time.max()),
            stats,
        )
        return documents, entry

    def prepare(self, channel: Channel) -> None:
        """Understand a channel's definition before its first message comes."""
        codec_for(channel, array_limit=self._array_limit).paths()

    def reason(self, channel_id: int, channel: Channel) -> str | None:
        """Why a channel's fields are not in the index, None when they are."""
        return self._part(channel_id, channel)[0].reason

    def _part(self, channel_id: int, channel: Channel) -> tuple[Codec, DocumentAssembler, bool]:
        with self._lock:
            part = self._parts.get(channel_id)
            if part is None:
                codec = codec_for(channel, array_limit=self._array_limit)
                stamped = any(path.path == STAMP and path.type == "time" for path in codec.paths())
                origin = Origin(self.recording, self._key, channel.topic, channel.has_publish_time)
                part = self._parts[channel_id] = codec, DocumentAssembler(origin), stamped
            return part


@dataclass(slots=True)
class _Parcel:
    """What goes to the database in one go: documents of some chunks, and those chunks."""

    documents: dict[str, list[NDArray[np.uint8]]] = field(default_factory=dict)
    entries: list[ChunkEntry] = field(default_factory=list)
    messages: int = 0
    size: int = 0

    def add(self, documents: list[Documents], entry: ChunkEntry, messages: int) -> None:
        for part in documents:
            self.documents.setdefault(part.collection, []).extend(part.tables)
            self.size += part.size
        self.entries.append(entry)
        self.messages += messages


class Lag:
    """Lets the index fall behind the recording that it belongs to.

    Args:
        recording: The recording's directory.
        behind: Says whether the recorder has more than it can write.
        renew: Another connection to the index, after one has failed; starts the embedded
            MongoDB again if that has ended. Raises `DatabaseError`.
    """

    def __init__(
        self, recording: Path, behind: Callable[[], bool], renew: Callable[[], Database]
    ) -> None:
        self.renew = renew
        self._recording = recording
        self._behind = behind
        self._reader: SegmentReader | None = None
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="hybridlog-reread")
        self._ahead: tuple[_Forgotten, Future[StoredChunk]] | None = None

    def wait(self) -> None:
        """Return once the recorder can spare the processor and the disk."""
        while self._behind():
            time.sleep(_LAG_PAUSE_S)

    def read(self, chunk: _Forgotten) -> StoredChunk:
        """Read a chunk back from its segment, which may still be growing."""
        ahead, self._ahead = self._ahead, None
        if ahead is None or ahead[0] is not chunk:
            return self._thread.submit(self._read, chunk).result()
        return ahead[1].result()

    def read_ahead(self, chunk: _Forgotten) -> None:
        """Start to read the chunk that is asked for next."""
        self._ahead = chunk, self._thread.submit(self._read, chunk)

    def _read(self, chunk: _Forgotten) -> StoredChunk:
        if self._reader is None or self._reader.number != chunk.segment:
            self._release()
            self._reader = self._open(chunk.segment)
        self._reader.grow()
        return self._reader.read_chunk(chunk.place)

    def close(self) -> None:
        """Give everything back."""
        self._thread.shutdown(wait=True, cancel_futures=True)
        self._release()

    def _release(self) -> None:
        if self._reader is not None:
            self._reader.close()
            self._reader = None

    def _open(self, segment: int) -> SegmentReader:
        path = self._recording / f"{segment:06d}{OPEN_SUFFIX}"
        if path.exists():
            # It may be sealed, and renamed, at this moment.
            with suppress(SegmentError):
                return SegmentReader(path, segment, direct=True)
        sealed = path.with_name(f"{segment:06d}{SEALED_SUFFIX}")
        return SegmentReader(sealed, segment, direct=True)


class _Forgotten(NamedTuple):
    """A chunk that is in its segment, and no longer in memory."""

    segment: int
    place: ChunkPlace
    messages: int


class IndexWriter:
    """Sends chunks to the index in the background, so that recording need not wait.

    One thread makes documents, others send them; what is made while they are busy goes
    in one parcel, so that a chunk of one image costs no round trip of its own. A database
    that fails stops the index, never the recording: what was not indexed is made up for
    from the segments, with a lag as soon as the database answers again, else when the
    store is opened next.

    Args:
        indexer: Makes the documents.
        database: Where they go.
        backlog: Most chunks in memory, waiting or under way, before `submit` waits.
        lag: With it `submit` never waits: chunks beyond the backlog are read back.
        gatherer: Gets each chunk of which documents are made.
    """

    def __init__(
        self,
        indexer: ChunkIndexer,
        database: Database,
        *,
        backlog: int = BACKLOG,
        lag: Lag | None = None,
        gatherer: FieldGatherer | None = None,
    ) -> None:
        self.failure: DatabaseError | None = None
        self.indexed = 0
        """Messages whose index documents are in the database."""
        self.missed = 0
        """Messages that were skipped because the database had failed."""
        self._latest: deque[ChunkEntry] = deque(maxlen=_MOST_LATEST)
        self._totals: ChannelTotals | None = ChannelTotals()
        self._indexer = indexer
        self._lag = lag
        self._gatherer = gatherer
        self._forgotten: deque[_Forgotten] = deque()
        self._database = database
        self._catalog = Catalog(database)
        self._collections: set[str] = set()
        self._lock = threading.Lock()
        self._room = threading.BoundedSemaphore(backlog)
        self._in_memory = 0  # chunks that wait or are under way
        self._is_asked = False  # for the next forgotten chunk
        self._has_ended = False  # nothing is taken any more
        self._maker = ThreadPoolExecutor(1, thread_name_prefix="hybridlog-index")
        self._senders = ThreadPoolExecutor(_SENDERS, thread_name_prefix="hybridlog-send")
        self._idle = threading.BoundedSemaphore(_SENDERS)
        self._parcel = _Parcel()
        self._crash: BaseException | None = None
        self._channels: Mapping[int, Channel] = {}
        self._retry_at = 0.0
        self._is_away = False
        self._renewed: list[Database] = []

    @property
    def database(self) -> Database:
        """Where documents go now."""
        return self._database

    def totals(self) -> ChannelTotals:
        """Statistics of the channels, of all chunks that are in the index."""
        if self._totals is None and self.failure is None:
            try:
                self._totals = ChannelTotals.of(self._catalog.every_chunk(self._indexer.recording))
            except DatabaseError as error:
                self.failure = error
        return self._totals or ChannelTotals()

    def submit(self, chunk: StoredChunk, channels: Mapping[int, Channel]) -> None:
        """Index a chunk that is in its segment; waits while the backlog is full."""
        if self._crash is not None:
            raise self._crash
        self._channels = channels
        if not self._room.acquire(blocking=self._lag is None):
            self._forget(chunk)
            self._catch_up()
            return
        with self._lock:
            self._in_memory += 1
        future = self._maker.submit(self._make, chunk, channels)
        future.add_done_callback(self._made)

    def prepare(self, channel: Channel) -> None:
        """Do now what a channel's first message would have to wait for."""
        self._indexer.prepare(channel)
        self._maker.submit(self._prepare, channel).add_done_callback(self._done)

    def _prepare(self, channel: Channel) -> None:
        if self._is_away:
            return
        try:
            self._ensure(collection_of(channel.topic))
        except DatabaseError:
            # It fails again with the first documents, and is told then. To find out that
            # nobody answers takes seconds, and others stand behind this.
            self._is_away = True

    def nudge(self) -> None:
        """Send what has been made so far, however little, once a sender is free."""
        self._maker.submit(self._tend).add_done_callback(self._done)

    def close(self) -> None:
        """Wait for all chunks; an error of our own (no database's) is raised here."""
        if self._crash is None:
            self._maker.submit(self._last_try).add_done_callback(self._done)
            self._maker.submit(self._remember_all).add_done_callback(self._done)
            self._maker.submit(self._dispatch, wait=True).add_done_callback(self._done)
        self._end()
        self.missed += sum(chunk.messages for chunk in self._forgotten)
        if self._crash is not None:
            raise self._crash

    def abandon(self) -> None:
        """Stop without indexing what still waits."""
        self._end(cancel=True)

    def release(self) -> None:
        """Close the connections that it has made itself; `database` may be one of them."""
        for database in self._renewed:
            database.close()
        self._renewed.clear()

    def _end(self, *, cancel: bool = False) -> None:
        with self._lock:
            self._has_ended = True
        self._maker.shutdown(wait=True, cancel_futures=cancel)
        self._senders.shutdown(wait=True, cancel_futures=cancel)
        if self._lag is not None:
            self._lag.close()

    def _forget(self, chunk: StoredChunk) -> None:
        """Keep only where a chunk lies."""
        place = ChunkPlace(
            chunk.offset,
            chunk.length,
            chunk.trailer,
            int(chunk.batch.log_time.min()),
            int(chunk.batch.log_time.max()),
            (),
        )
        if self._gatherer is not None:
            self._gatherer.expect(chunk.segment, chunk.offset)
        self._forgotten.append(_Forgotten(chunk.segment, place, len(chunk.batch)))

    def _catch_up(self) -> None:
        """Ask for a forgotten chunk once none waits in memory.

        To read one back costs more than to make its documents. Taken in the order in which
        they came, those that were let go would keep others waiting until these, too, have
        no room.
        """
        with self._lock:
            is_idle = not (self._is_asked or self._in_memory or self._has_ended)
            if not is_idle or not self._forgotten or self.failure is not None:
                return
            self._is_asked = True
            future = self._maker.submit(self._remember_next)
        future.add_done_callback(self._done)

    def _tend(self) -> None:
        if self.failure is not None and time.monotonic() >= self._retry_at:
            self._retry()
        self._catch_up()
        self._dispatch(wait=False)

    def _last_try(self) -> None:
        if self.failure is not None:
            self._retry()

    def _retry(self) -> None:
        """Go on after the database has failed, if it can be had again."""
        if self._lag is None:
            return
        try:
            database = self._lag.renew()
            self._renewed.append(database)
            catalog = Catalog(database)
            chunks = catalog.every_chunk(self._indexer.recording)
            there = {(chunk.segment, chunk.offset) for chunk in chunks}
        except DatabaseError as error:
            self.failure = error
            self._retry_at = time.monotonic() + _RETRY_S
            return
        with self._lock:
            self._database, self._catalog = database, catalog
            self._collections.clear()
            # A server that was killed has lost what it had not yet in its journal.
            latest, self._latest = self._latest, deque(maxlen=_MOST_LATEST)
            for entry in latest:
                if (entry.segment, entry.offset) in there:
                    self._latest.append(entry)
                else:
                    self.indexed -= self._put_back(entry)
                    self._totals = None  # what was taken in cannot be taken out
            self.failure, self._is_away = None, False

    def _remember_next(self) -> None:
        with self._lock:
            self._is_asked = False
        self._remember()
        self._catch_up()

    def _remember_all(self) -> None:
        while self._forgotten and self.failure is None:
            self._remember()

    def _remember(self) -> None:
        """Make documents of the first forgotten chunk, while the next one is read."""
        assert self._lag is not None
        if self.failure is not None or not self._forgotten:
            return
        place = self._forgotten.popleft()
        self._lag.wait()
        chunk = self._lag.read(place)
        if self._forgotten:
            self._lag.read_ahead(self._forgotten[0])
        self._make(chunk, self._channels)

    def _make(self, chunk: StoredChunk, channels: Mapping[int, Channel]) -> None:
        if self.failure is not None:
            if self._lag is not None:
                self._forget(chunk)
            else:
                with self._lock:
                    self.missed += len(chunk.batch)
            return
        if self._lag is not None and not _is_large(chunk):
            self._lag.wait()
        documents, entry = self._indexer.documents_of(chunk, channels)
        if self._gatherer is not None:
            self._gatherer.add(chunk, channels)
        self._parcel.add(documents, entry, len(chunk.batch))
        parcel = self._parcel
        if len(parcel.entries) >= _PARCEL_CHUNKS or parcel.size >= _PARCEL_BYTES // 4:
            self._dispatch(wait=parcel.size >= _PARCEL_BYTES)

    def _dispatch(self, *, wait: bool) -> None:
        """Hand over what has been made, if a sender is free or has to be waited for."""
        if self._parcel.entries and self._idle.acquire(blocking=wait):
            parcel, self._parcel = self._parcel, _Parcel()
            future = self._senders.submit(self._send, parcel)
            future.add_done_callback(self._sent)

    def _send(self, parcel: _Parcel) -> None:
        failure = self.failure
        try:
            if failure is None:
                for collection, tables in parcel.documents.items():
                    self._ensure(collection)
                    lengths = np.concatenate(
                        [np.full(len(table), table.shape[1], np.int64) for table in tables]
                    )
                    data = b"".join(table.data for table in tables)
                    self._database.insert_raw(collection, data, len(lengths), lengths=lengths)
                self._catalog.put_chunks(parcel.entries)
        except DatabaseError as error:
            failure = error
        with self._lock:
            if failure is None:
                self.indexed += parcel.messages
                self._latest.extend(parcel.entries)
                if self._totals is not None:
                    for entry in parcel.entries:
                        self._totals.add(entry)
                return
            self.failure = failure
            self._retry_at = time.monotonic() + _RETRY_S
            if self._lag is None:
                self.missed += parcel.messages
                return
            # To insert a document twice is to insert it once, so all of it comes again.
            for entry in parcel.entries:
                self._put_back(entry)

    def _put_back(self, entry: ChunkEntry) -> int:
        """A chunk is to be indexed again; returns its messages."""
        count = sum(stats.messages for stats in entry.stats.values())
        self._forgotten.append(_Forgotten(entry.segment, entry.place, count))
        return count

    def _ensure(self, collection: str) -> None:
        with self._lock:
            if collection in self._collections:
                return
        self._database.ensure_collection(collection)
        with self._lock:
            self._collections.add(collection)

    def _made(self, future: Future[None]) -> None:
        self._room.release()
        with self._lock:
            self._in_memory -= 1
        self._done(future)
        self._catch_up()

    def _sent(self, future: Future[None]) -> None:
        self._idle.release()
        self._done(future)

    def _done(self, future: Future[None]) -> None:
        if future.cancelled():
            return
        error = future.exception()
        if error is not None and self._crash is None:
            self._crash = error


def _is_large(chunk: StoredChunk) -> bool:
    """Whether documents of a chunk cost less than to let it go and read it again.

    Of large messages they take little, and nearly none of it under the interpreter's lock.
    """
    return len(chunk.batch.buffer) >= COPIED_AT_ONCE * len(chunk.batch)


def rows_by_channel(channel: NDArray[np.int32]) -> Iterator[tuple[int, NDArray[np.intp]]]:
    """Channel ids in a chunk, ascending, and the rows of each, in chunk order."""
    if len(channel) and bool((channel == channel[0]).all()):
        yield int(channel[0]), np.arange(len(channel))  # chunks of large messages are small
        return
    order = np.argsort(channel, kind="stable")
    ids = channel[order]
    starts = np.flatnonzero(np.diff(ids, prepend=-1)).tolist()
    for start, end in zip(starts, [*starts[1:], len(ids)], strict=True):
        yield int(ids[start]), order[start:end]


class _Stamps:
    """The header stamps of some messages, beside their log times."""

    def __init__(self) -> None:
        self._log_times: list[NDArray[np.int64]] = []
        self._stamps: list[NDArray[np.int64]] = []

    @property
    def any(self) -> bool:
        """Whether there are any."""
        return bool(self._stamps)

    def add(self, log_time: NDArray[np.int64], stamps: NDArray[np.int64]) -> None:
        if len(stamps):
            self._log_times.append(log_time)
            self._stamps.append(stamps)

    def add_decoded(self, codec: Codec, batch: Batch) -> None:
        """Read them from payloads whose index documents did not need them as numbers."""
        decoded = codec.columns(batch.buffer, batch.offset, batch.length, {STAMP})
        stamps = header_stamps(decoded.records)
        if stamps is not None:
            self.add(batch.log_time[decoded.rows], stamps)

    def tell(self, stats: ChannelStats) -> None:
        if not self.any:
            return
        stamps = np.concatenate(self._stamps)
        skew = np.concatenate(self._log_times) - stamps
        stats.stamped = len(stamps)
        stats.first_stamp = int(stamps.min())
        stats.last_stamp = int(stamps.max())
        stats.skew_sum = float(skew.sum(dtype=np.float64))
        stats.skew_min = int(skew.min())
        stats.skew_max = int(skew.max())


def _stats(batch: Batch, channel: Channel, stamps: _Stamps, unreadable: int) -> ChannelStats:
    first, last = int(batch.log_time.min()), int(batch.log_time.max())
    stats = ChannelStats(
        messages=len(batch),
        payload_bytes=batch.payload_bytes,
        unreadable=unreadable,
        first=first,
        last=last,
        longest=last - first,
    )
    if channel.has_publish_time:
        stats.first_publish = int(batch.publish_time.min())
        stats.last_publish = int(batch.publish_time.max())
    stamps.tell(stats)
    return stats
