"""From chunks to index documents: one pure function, and the workers that send them.

`documents_of` is what makes the index disposable: it needs nothing but a chunk and its
channels, and `record`, recovery, `reindex` and `verify` all call it.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hybridlog.schema.codec import Codec, codec_for
from hybridlog.schema.column import Records, Scalars
from hybridlog_storage.catalog import Catalog, ChannelStats, ChunkEntry
from hybridlog_storage.collection_names import collection_of
from hybridlog_storage.errors import DatabaseError
from hybridlog_storage.index_documents import DocumentAssembler, Origin
from hybridlog_storage.messages import Batch, Channel
from hybridlog_storage.segment_writer import StoredChunk

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog_storage.database import Database

ARRAY_LIMIT = 32
STAMP = "header.stamp"


class Documents(NamedTuple):
    """Index documents of one topic.

    Attributes:
        collection: Where they belong.
        data: The documents, one after the other.
        lengths: int64[n], bytes of each.
    """

    collection: str
    data: bytes
    lengths: NDArray[np.int64]


class ChunkIndexer:
    """Makes the index documents of one recording's chunks. Thread safe.

    Args:
        recording: Recording id.
        key: The recording's number.
        array_limit: Longest array that is kept in the index whole.
    """

    def __init__(self, recording: str, key: int, *, array_limit: int = ARRAY_LIMIT) -> None:
        self._recording = recording
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
            pieces: list[bytes] = []
            lengths: list[NDArray[np.int64]] = []
            for group in codec.bodies(batch.buffer, batch.offset, batch.length):
                table = assembler.assemble(chunk, rows[group.rows], group.body, group.error)
                pieces.append(table.tobytes())
                lengths.append(np.full(len(table), table.shape[1], np.int64))
                if group.error is not None:
                    unreadable += len(table)
            documents.append(
                Documents(collection_of(channel.topic), b"".join(pieces), np.concatenate(lengths))
            )
            stats[channel_id] = _stats(batch, channel, codec if stamped else None, unreadable)
        entry = ChunkEntry(
            self._recording,
            chunk.segment,
            chunk.offset,
            chunk.length,
            chunk.trailer,
            int(chunk.batch.log_time.min()),
            int(chunk.batch.log_time.max()),
            stats,
        )
        return documents, entry

    def reason(self, channel_id: int, channel: Channel) -> str | None:
        """Why a channel's fields are not in the index, None when they are."""
        return self._part(channel_id, channel)[0].reason

    def _part(self, channel_id: int, channel: Channel) -> tuple[Codec, DocumentAssembler, bool]:
        with self._lock:
            part = self._parts.get(channel_id)
            if part is None:
                codec = codec_for(channel, array_limit=self._array_limit)
                stamped = any(path.path == STAMP and path.type == "time" for path in codec.paths())
                origin = Origin(self._recording, self._key, channel.topic, channel.has_publish_time)
                part = self._parts[channel_id] = codec, DocumentAssembler(origin), stamped
            return part


class IndexWriter:
    """Sends chunks to the index in the background, so that recording need not wait.

    A database that fails stops the index, never the recording: what was not indexed is
    counted, and is made up for from the segments.

    Args:
        indexer: Makes the documents.
        database: Where they go.
        backlog: Most chunks waiting or under way before `submit` waits.
    """

    def __init__(self, indexer: ChunkIndexer, database: Database, *, backlog: int = 6) -> None:
        self.failure: DatabaseError | None = None
        self.indexed = 0
        """Messages whose index documents are in the database."""
        self.missed = 0
        """Messages that were skipped because the database had failed."""
        self.entries: list[ChunkEntry] = []
        self._indexer = indexer
        self._database = database
        self._catalog = Catalog(database)
        self._collections: set[str] = set()
        self._lock = threading.Lock()
        self._room = threading.BoundedSemaphore(backlog)
        self._pool = ThreadPoolExecutor(2, thread_name_prefix="hybridlog-index")
        self._crash: BaseException | None = None

    def submit(self, chunk: StoredChunk, channels: Mapping[int, Channel]) -> None:
        """Index a chunk that is in its segment; waits while the backlog is full."""
        if self._crash is not None:
            raise self._crash
        self._room.acquire()
        future = self._pool.submit(self._index, chunk, channels)
        future.add_done_callback(self._done)

    def close(self) -> None:
        """Wait for all chunks; an error of our own (no database's) is raised here."""
        self._pool.shutdown(wait=True)
        if self._crash is not None:
            raise self._crash

    def abandon(self) -> None:
        """Stop without indexing what still waits."""
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _index(self, chunk: StoredChunk, channels: Mapping[int, Channel]) -> None:
        count = len(chunk.batch)
        if self.failure is not None:
            with self._lock:
                self.missed += count
            return
        documents, entry = self._indexer.documents_of(chunk, channels)
        try:
            for part in documents:
                self._ensure(part.collection)
                self._database.insert_raw(
                    part.collection, part.data, len(part.lengths), lengths=part.lengths
                )
            self._catalog.put_chunk(entry)
        except DatabaseError as error:
            with self._lock:
                self.failure = self.failure or error
                self.missed += count
            return
        with self._lock:
            self.indexed += count
            self.entries.append(entry)

    def _ensure(self, collection: str) -> None:
        with self._lock:
            if collection in self._collections:
                return
        self._database.ensure_collection(collection)
        with self._lock:
            self._collections.add(collection)

    def _done(self, future: Future[None]) -> None:
        self._room.release()
        if future.cancelled():
            return
        error = future.exception()
        if error is not None and self._crash is None:
            self._crash = error


def rows_by_channel(channel: NDArray[np.int32]) -> Iterator[tuple[int, NDArray[np.intp]]]:
    """Channel ids in a chunk, ascending, and the rows of each, in chunk order."""
    order = np.argsort(channel, kind="stable")
    ids = channel[order]
    starts = np.flatnonzero(np.diff(ids, prepend=-1)).tolist()
    for start, end in zip(starts, [*starts[1:], len(ids)], strict=True):
        yield int(ids[start]), order[start:end]


def _stats(batch: Batch, channel: Channel, stamped: Codec | None, unreadable: int) -> ChannelStats:
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
    if stamped is not None:
        decoded = stamped.columns(batch.buffer, batch.offset, batch.length, {STAMP})
        stamps = header_stamps(decoded.records)
        if stamps is not None and len(stamps):
            skew = batch.log_time[decoded.rows] - stamps
            stats.stamped = len(stamps)
            stats.first_stamp = int(stamps.min())
            stats.last_stamp = int(stamps.max())
            stats.skew_sum = float(skew.sum(dtype=np.float64))
            stats.skew_min = int(skew.min())
            stats.skew_max = int(skew.max())
    return stats


def header_stamps(records: Records) -> NDArray[np.int64] | None:
    """The header stamps of decoded messages, ns; None when they have no header."""
    header = records.fields.get("header")
    stamp = header.fields.get("stamp") if isinstance(header, Records) else None
    return stamp.values if isinstance(stamp, Scalars) and stamp.kind == "time" else None
