"""Indexes chunks in the background.

`IndexWriter` makes documents of chunks and sends them to the database. With a `Lag` it may
fall behind its recording, drop chunks from memory, and read them back from the segments.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Future
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hybridlog_storage.catalog import ChunkEntry
from hybridlog_storage.chunk import StoredChunk
from hybridlog_storage.distinct import distinct
from hybridlog_storage.errors import DatabaseError, SegmentError
from hybridlog_storage.index_documents import with_prefix
from hybridlog_storage.index_state import IndexState
from hybridlog_storage.messages import Channel
from hybridlog_storage.segment_file import OPEN_SUFFIX, SEALED_SUFFIX
from hybridlog_storage.segment_reader import ChunkPlace, SegmentReader
from hybridlog_storage.threads import Threads
from hybridlog_storage.topic_places import TopicPlaces

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.indexing import ChunkIndexer, Documents
    from hybridlog.tables.writer import TableWriter
    from hybridlog_storage.catalog import ChannelStats, RecordingEntry
    from hybridlog_storage.database import Database
    from hybridlog_storage.topic_places import TopicPlace

_SENDERS = 2
_LAG_PAUSE_S = 0.002
_RETRY_S = 2.0  # seconds between attempts after the database has failed
_PARCEL_BYTES = 4 << 20
_PARCEL_CHUNKS = 32
_BACKLOG = 8  # chunks in memory, waiting or in work
# The same with a lag, if memory allows. Topics of equal rate and size close their chunks at
# the same time, and chunks without room must be read again.
_MOST_BACKLOG = 96
_FEW = 32  # most messages, and
_FEW_BYTES = 1 << 20  # most bytes of a chunk that waits for others
_FEW_CHUNKS = 512  # most waiting chunks,
_FEW_WAITING = 16 << 20  # and their bytes
_MOST_LATEST = 4096  # chunks: far more than a killed server has not in its journal


@dataclass(slots=True)
class _Parcel:
    """Documents of some chunks that are sent to the database together, and those chunks.

    Attributes:
        documents: Those of each topic.
    """

    documents: dict[str, list[NDArray[np.uint8]]] = field(default_factory=dict)
    entries: list[ChunkEntry] = field(default_factory=list)
    messages: int = 0
    size: int = 0

    def add(self, documents: list[Documents], entries: list[ChunkEntry]) -> None:
        for part in documents:
            self.documents.setdefault(part.topic, []).extend(part.tables)
            self.size += part.size
        self.entries += entries
        self.messages += sum(entry.messages for entry in entries)


class _Few:
    """Chunks of few messages, which wait to be indexed together. Thread safe.

    A topic of 4 Hz has a chunk of four messages each second, so that no more can be lost.
    Making and inserting the documents of such a chunk costs as much as those of a hundred
    messages, and so does waking the thread.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._chunks: list[StoredChunk] = []
        self._untabled: deque[StoredChunk] = deque()  # of these, in the order of the file
        self._channels: dict[int, Channel] = {}
        self._size = 0
        self._since = 0.0

    def add(
        self, chunk: StoredChunk, channels: Mapping[int, Channel], *, is_in_tables: bool
    ) -> bool:
        """Let a chunk wait, if it has few messages and there is room.

        Args:
            chunk: The chunk.
            channels: What it is about; of a recording that is recovered each segment has its
                own.
            is_in_tables: Whether it is in the tables.

        Returns:
            Whether it waits.
        """
        size = len(chunk.batch.buffer)
        if len(chunk.batch) > _FEW or size > _FEW_BYTES:
            return False
        with self._lock:
            if self.is_full:
                return False
            if not self._chunks:
                self._since = time.monotonic()
            # A copy, since its buffer may be a hundred times as large.
            batch = replace(chunk.batch, buffer=bytes(chunk.batch.buffer))
            waits = replace(chunk, batch=batch)
            # Not all channels of the recording, which may be thousands.
            own = distinct(batch.channel).tolist()
            self._channels.update({number: channels[number] for number in own})
            self._chunks.append(waits)
            if not is_in_tables:
                self._untabled.append(waits)
            self._size += size
        return True

    @property
    def is_full(self) -> bool:
        """True if the limit is reached."""
        return self._size >= _FEW_WAITING or len(self._chunks) >= _FEW_CHUNKS

    @property
    def waited(self) -> float:
        """Seconds for which the first chunk has waited; 0 without chunks."""
        return time.monotonic() - self._since if self._chunks else 0.0

    def untabled(
        self, before: StoredChunk | None = None
    ) -> tuple[list[StoredChunk], Mapping[int, Channel]]:
        """Those that are to go into the tables now, in the order of the file.

        Args:
            before: Only chunks before this one; None for all.
        """
        found = []
        with self._lock:
            while self._untabled:
                first = self._untabled[0]
                if before is not None and _place(first) > _place(before):
                    break
                found.append(self._untabled.popleft())
        return found, self._channels

    def take(self) -> tuple[list[StoredChunk], Mapping[int, Channel]]:
        """Remove and return all waiting chunks and their channels."""
        with self._lock:
            chunks, self._chunks, self._size = self._chunks, [], 0
        return chunks, self._channels


def _place(chunk: StoredChunk) -> tuple[int, int]:
    return chunk.segment, chunk.offset


class Lag:
    """Lets the index fall behind its recording.

    Args:
        recording: The recording's directory.
        behind: Says whether the recorder has more than it can write.
        has_room: Says whether so many bytes of chunks may wait in memory, where they are more
            than a few.
        spare: Processors for what can wait. One is held while documents or tables are made.
    """

    def __init__(
        self,
        recording: Path,
        behind: Callable[[], bool],
        has_room: Callable[[int], bool],
        spare: threading.BoundedSemaphore,
    ) -> None:
        self.has_room = has_room
        self.spare = spare
        self._recording = recording
        self._behind = behind
        self._reader: SegmentReader | None = None
        self._thread = Threads(1, "hybridlog-reread")
        self._ahead: tuple[_Forgotten, Future[StoredChunk]] | None = None

    def wait(self) -> None:
        """Wait until the recorder does not need the processor and the disk."""
        while self._behind():
            time.sleep(_LAG_PAUSE_S)

    def read(self, chunk: _Forgotten) -> StoredChunk:
        """Read a chunk back from its segment, which may still be growing."""
        ahead, self._ahead = self._ahead, None
        if ahead is None or ahead[0] is not chunk:
            return self._thread.submit(self._read, chunk).result()
        return ahead[1].result()

    def read_ahead(self, chunk: _Forgotten) -> None:
        """Start reading the next chunk."""
        self._ahead = chunk, self._thread.submit(self._read, chunk)

    def _read(self, chunk: _Forgotten) -> StoredChunk:
        if self._reader is None or self._reader.number != chunk.segment:
            self._release()
            self._reader = self._open(chunk.segment)
        self._reader.grow()
        return self._reader.read_chunk(chunk.place)

    def close(self) -> None:
        """Close the open segment."""
        self._thread.shutdown(wait=True, cancel_futures=True)
        self._release()

    def _release(self) -> None:
        if self._reader is not None:
            self._reader.close()
            self._reader = None

    def _open(self, segment: int) -> SegmentReader:
        path = self._recording / f"{segment:06d}{OPEN_SUFFIX}"
        if path.exists():
            # It may be sealed and renamed at this moment.
            with suppress(SegmentError):
                return SegmentReader(path, segment, direct=True)
        sealed = path.with_name(f"{segment:06d}{SEALED_SUFFIX}")
        return SegmentReader(sealed, segment, direct=True)


class _Forgotten(NamedTuple):
    """A chunk that was dropped from memory and is in its segment.

    Attributes:
        segment: Number of the segment.
        place: Its position there.
        messages: Number of its messages.
        is_in_tables: Whether it is in the tables.
    """

    segment: int
    place: ChunkPlace
    messages: int
    is_in_tables: bool


@dataclass(frozen=True, slots=True)
class IndexTarget:
    """Where the index documents of a new recording go.

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


class IndexWriter:
    """Indexes chunks in the background, so that recording need not wait.

    One thread makes documents, others send them. Documents made while all senders are busy
    are sent together, so a chunk of one image costs no round trip of its own. A failing
    database stops the index, never the recording. Missing documents are made later from the
    segments: with a lag as soon as the database answers again, else when a question needs
    the index.

    Args:
        entry: The recording.
        indexer: Makes the documents.
        target: Where they go.
        lag: With it `submit` never waits: chunks that find no room in memory are read back.
        tables: Gets each chunk of which documents are made, once.
    """

    def __init__(
        self,
        entry: RecordingEntry,
        indexer: ChunkIndexer,
        target: IndexTarget,
        *,
        lag: Lag | None = None,
        tables: TableWriter | None = None,
    ) -> None:
        self.failure = target.failure
        self.decoded: dict[int, dict[int, Mapping[int, ChannelStats]]] = {}
        """Statistics of the decoded chunks: by segment, chunk and channel."""
        self.indexed = 0
        """Number of indexed messages."""
        self.missed = 0
        """Number of messages skipped after a failure of the database."""
        self._latest: deque[ChunkEntry] = deque(maxlen=_MOST_LATEST)
        self._entry = entry
        self._indexer = indexer
        self._target = target
        self._lag = lag
        self._tables = tables
        self._spare = lag.spare if lag else nullcontext()
        self._forgotten: deque[_Forgotten] = deque()
        self.database = target.database
        """The present connection to the index; None without one."""
        self._places: TopicPlaces | None = None
        self._lock = threading.Lock()
        self._room = threading.BoundedSemaphore(_BACKLOG if lag is None else _MOST_BACKLOG)
        self._in_memory = 0  # chunks waiting or in work
        self._bytes_in_memory = 0
        self._is_asked = False  # for the next dropped chunk
        self._has_ended = False  # no more chunks are accepted
        self._maker = Threads(1, "hybridlog-index")
        self._senders = Threads(_SENDERS, "hybridlog-send")
        self._idle = threading.BoundedSemaphore(_SENDERS)
        self._few = _Few()
        self._parcel = _Parcel()
        self._crash: BaseException | None = None
        self._channels: Mapping[int, Channel] = {}
        self._retry_at = 0.0
        self._is_away = False
        self._renewed: list[Database] = []

    def submit(self, chunk: StoredChunk, channels: Mapping[int, Channel]) -> None:
        """Index a chunk that is in its segment; wait while the backlog is full."""
        if self._crash is not None:
            raise self._crash
        self._channels = channels
        if self.failure is None and self._few.add(chunk, channels, is_in_tables=False):
            if self._few.is_full:
                self._maker.submit(self._make_few).add_done_callback(self._done)
            return
        size = len(chunk.batch.buffer)
        if not self._find_room(size):
            self._forget(chunk)
            self._catch_up()
            return
        with self._lock:
            self._in_memory += 1
            self._bytes_in_memory += size
        future = self._maker.submit(self._make, chunk, channels)
        future.add_done_callback(partial(self._made, size))

    def _find_room(self, size: int) -> bool:
        """Reserve memory for a waiting chunk; wait for room without a lag, else return False."""
        if self._lag is None:
            return self._room.acquire()
        with self._lock:
            is_usual = self._in_memory < _BACKLOG
            size += self._bytes_in_memory
        return (is_usual or self._lag.has_room(size)) and self._room.acquire(blocking=False)

    def prepare(self, channel: Channel, *, with_place: bool) -> None:
        """Prepare a channel before its first message.

        Args:
            channel: The channel.
            with_place: Whether to assign a place in MongoDB to its topic.
        """
        self._indexer.prepare(channel)
        if with_place and self._target.is_wanted:
            self._maker.submit(self._prepare, channel).add_done_callback(self._done)

    def _prepare(self, channel: Channel) -> None:
        if self._is_away or self.failure is not None:
            return
        try:
            self._assigned([channel.topic])
        except DatabaseError:
            # It fails again with the first documents, and is reported then. A timeout takes
            # seconds, and other channels wait.
            self._is_away = True

    def nudge(self, patience_s: float) -> None:
        """Send the documents made so far once a sender is free.

        Args:
            patience_s: Seconds for which chunks of few messages may wait for others.
        """
        # Waking the thread that makes documents costs as much as ten documents.
        if self._parcel.entries or self._forgotten or self.failure or self._is_late(patience_s):
            self._maker.submit(self._tend, patience_s).add_done_callback(self._done)

    def close(self) -> None:
        """Wait for all chunks; raise errors other than those of the database."""
        if self._crash is None:
            self._maker.submit(self._last_try).add_done_callback(self._done)
            self._maker.submit(self._remember_all).add_done_callback(self._done)
            self._maker.submit(self._make_few).add_done_callback(self._done)
            self._maker.submit(self._dispatch, wait=True).add_done_callback(self._done)
        self._end()
        self.missed += sum(chunk.messages for chunk in self._forgotten)
        if self._crash is not None:
            raise self._crash

    def abandon(self) -> None:
        """Stop without indexing waiting chunks."""
        self._end(cancel=True)

    def release(self) -> None:
        """Close the connections made by this object; `database` may be one of them."""
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

    def _forget(self, chunk: StoredChunk, *, is_in_tables: bool = False) -> None:
        """Keep only where a chunk lies."""
        place = ChunkPlace(
            offset=chunk.offset,
            length=chunk.length,
            trailer=chunk.trailer,
            first=int(chunk.batch.log_time.min()),
            last=int(chunk.batch.log_time.max()),
            channels=(),
            number=chunk.number,
            crc=chunk.crc,
            trailer_crc=chunk.trailer_crc,
        )
        self._forgotten.append(_Forgotten(chunk.segment, place, len(chunk.batch), is_in_tables))

    def _catch_up(self) -> None:
        """Request a dropped chunk once none waits in memory.

        Reading a chunk back costs more than making its documents. In arrival order, dropped
        chunks would delay others until these have no room either.
        """
        with self._lock:
            is_idle = not (self._is_asked or self._in_memory or self._has_ended)
            if not is_idle or not self._forgotten or self.failure is not None:
                return
            self._is_asked = True
            future = self._maker.submit(self._remember_next)
        future.add_done_callback(self._done)

    def _tend(self, patience_s: float) -> None:
        if self.failure is not None and time.monotonic() >= self._retry_at:
            self._retry()
        self._catch_up()
        if self._is_late(patience_s):
            self._make_few()
        self._dispatch(wait=False)

    def _is_late(self, patience_s: float) -> bool:
        """True if chunks have waited to be indexed for too long."""
        return self._few.waited > patience_s

    def _last_try(self) -> None:
        if self.failure is not None:
            self._retry()

    def _retry(self) -> None:
        """Continue after a failure of the database, if it can be reconnected."""
        if self._lag is None or self._target.renew is None:
            return
        try:
            database = self._target.renew()
            self._renewed.append(database)
            state = IndexState(database)
            if state.one(self._entry.key) is None:  # it was away when the recording began
                state.put(self._entry, "open", turn=1)
            there = state.places(self._entry.key)
        except DatabaseError as error:
            self.failure = error
            self._retry_at = time.monotonic() + _RETRY_S
            return
        with self._lock:
            self.database, self._places = database, None
            # A killed server has lost documents that were not in its journal yet.
            latest, self._latest = self._latest, deque(maxlen=_MOST_LATEST)
            for entry in latest:
                if there.get((entry.segment, entry.number)) == entry.offset:
                    self._latest.append(entry)
                else:
                    self.indexed -= self._put_back(entry)
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
        """Index the first dropped chunk, while the next one is read."""
        assert self._lag is not None
        if self.failure is not None or not self._forgotten:
            return
        place = self._forgotten.popleft()
        self._lag.wait()
        chunk = self._lag.read(place)
        if self._forgotten:
            self._lag.read_ahead(self._forgotten[0])
        self._make(chunk, self._channels, is_in_tables=place.is_in_tables)

    def _make(
        self, chunk: StoredChunk, channels: Mapping[int, Channel], *, is_in_tables: bool = False
    ) -> None:
        if self.failure is not None:
            if self._lag is not None:
                self._forget(chunk, is_in_tables=is_in_tables)
            else:
                with self._lock:
                    self.missed += len(chunk.batch)
            return
        if self._lag is not None:
            self._lag.wait()
        if not is_in_tables:
            # In the order of the file, for as long as that can be: rows are sorted then.
            self._add_to_tables(*self._few.untabled(before=chunk))
            self._add_to_tables([chunk], channels)
        if not self._few.add(chunk, channels, is_in_tables=True):
            self._index([chunk], channels)
        elif self._few.is_full:
            self._make_few()

    def _make_few(self) -> None:
        """Index the waiting chunks of few messages."""
        if self._lag is not None:
            self._lag.wait()
        chunks, channels = self._few.take()
        self._add_to_tables(*self._few.untabled())
        if chunks:
            self._index(chunks, channels)

    def _add_to_tables(
        self, chunks: Sequence[StoredChunk], channels: Mapping[int, Channel]
    ) -> None:
        """Give chunks to the tables."""
        if self._tables is not None:
            for chunk in chunks:
                with self._spare:
                    self._tables.add(chunk, channels)

    def _index(self, chunks: Sequence[StoredChunk], channels: Mapping[int, Channel]) -> None:
        with self._spare:
            documents, entries = self._indexer.documents_of(chunks, channels)
        for entry in entries:
            self.decoded.setdefault(entry.segment, {})[entry.number] = entry.stats
        self._parcel.add(documents, entries)
        parcel = self._parcel
        if len(parcel.entries) >= _PARCEL_CHUNKS or parcel.size >= _PARCEL_BYTES // 4:
            self._dispatch(wait=parcel.size >= _PARCEL_BYTES)

    def _dispatch(self, *, wait: bool) -> None:
        """Hand the documents over, if a sender is free or must be waited for."""
        if self._parcel.entries and self._idle.acquire(blocking=wait):
            parcel, self._parcel = self._parcel, _Parcel()
            future = self._senders.submit(self._send, parcel)
            future.add_done_callback(self._sent)

    def _send(self, parcel: _Parcel) -> None:
        failure = self.failure
        try:
            if failure is None and self.database is not None:
                for collection, tables in self._placed(parcel.documents).items():
                    lengths = np.concatenate(
                        [np.full(len(table), table.shape[1], np.int64) for table in tables]
                    )
                    data = b"".join(table.data for table in tables)
                    self.database.insert_raw(collection, data, len(lengths), lengths=lengths)
                IndexState(self.database).put_chunks(parcel.entries)
        except DatabaseError as error:
            failure = error
        with self._lock:
            if failure is None:
                self.indexed += parcel.messages if self._target.is_wanted else 0
                self._latest.extend(parcel.entries)
                return
            self.failure = failure
            self._retry_at = time.monotonic() + _RETRY_S
            if self._lag is None:
                self.missed += parcel.messages
                return
            # Inserting a document twice has no effect, so all are sent again.
            for entry in parcel.entries:
                self._put_back(entry)

    def _put_back(self, entry: ChunkEntry) -> int:
        """Queue a chunk again; return the number of its messages."""
        self._forgotten.append(_Forgotten(entry.segment, entry.place, entry.messages, True))
        return entry.messages

    def _placed(
        self, documents: Mapping[str, list[NDArray[np.uint8]]]
    ) -> dict[str, list[NDArray[np.uint8]]]:
        """The documents of topics by collection, with their keys there.

        Raises:
            DatabaseError: MongoDB fails.
        """
        places = self._assigned(documents.keys())
        found: dict[str, list[NDArray[np.uint8]]] = {}
        for topic, tables in documents.items():
            place = places[topic]
            own = [with_prefix(table, place.prefix) for table in tables]
            found.setdefault(place.collection, []).extend(own)
        return found

    def _assigned(self, topics: Collection[str]) -> dict[str, TopicPlace]:
        if self._places is None:
            assert self.database is not None
            self._places = TopicPlaces(self.database)
        return self._places.assigned(topics)

    def _made(self, size: int, future: Future[None]) -> None:
        self._room.release()
        with self._lock:
            self._in_memory -= 1
            self._bytes_in_memory -= size
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
