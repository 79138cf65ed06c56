"""Writing a recording: which messages share a chunk, and how chunks reach its segments.

Chunks hold like with like. A channel whose payloads are large has chunks of its own,
bounded in bytes and in log time, so that a slice of a scan reads next to nothing else;
the channels with small payloads share one. Worker threads compress, another writes: chunks
reach the file in the order in which they were closed, each with its indexes in one
go, and only then their owner hears of them: **log first, index second**.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from threading import BoundedSemaphore, Lock
from typing import TYPE_CHECKING, Literal, TypeVar

import numpy as np
from mcap.records import Attachment, Metadata

from hybridlog_storage.chunk import PackedChunk, StoredChunk, pack
from hybridlog_storage.chunk_builder import ChunkBuilder
from hybridlog_storage.compression import Compressor
from hybridlog_storage.errors import StoreError, UsageError
from hybridlog_storage.mcap_content import MESSAGE_HEAD
from hybridlog_storage.messages import Batch, Buffer, Channel, LooseBatch, Schema
from hybridlog_storage.segment_file import OnSealing, SegmentFile
from hybridlog_storage.segment_format import entries_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    _Count = TypeVar("_Count", int, NDArray[np.int64])
from hybridlog_storage.threads import Threads

_MOST_CHUNKS = 1 << 14  # of a segment: whoever reads its summary has a kilobyte of each in memory
_MOST_PARTS = 1 << 20  # channels of all chunks of a segment, which its summary lists, too
PACKERS = 2
"""Threads that pack chunks."""
AT_WORK = 8
"""Closed chunks that may be on their way to the file without anything being late."""
_TURN_S = 0.1  # that a chunk waits for its turn to be packed, at most
_MAX_CHANNELS = 65535
_SHARED = -1
_MOST_SPAN = 3600 * 10**9  # ns
_PHASE = 0.6180339887  # whose multiples, without their whole part, never lie close together
_SMALL_SPANS = 64  # times the usual span, for a chunk that is still small
_SYNC_STRIDE = 32 << 20  # bytes
_WRITTEN_AT_ONCE = 16 << 20  # bytes, at most, and one chunk


@dataclass(frozen=True, slots=True)
class SegmentSettings:
    """How segments are cut and packed.

    Attributes:
        chunk_size: Bytes of uncompressed content at which a chunk closes, if its writer is not
            told otherwise, as it is where very much comes.
        chunk_span_ns: Log time after which a chunk of a large-payload channel closes.
        span_size: Bytes of content below which such a chunk may span 64 times as much: small
            chunks compress badly, and reading one whole costs little.
        large_payload: Mean payload bytes from which a channel gets chunks of its own.
        compression: Codec of chunks that can be compressed.
        level: zstd level.
        segment_size: Bytes of file at which the next segment starts, if it has not after
            16,384 chunks.
        segment_span_s: Seconds after which the next segment starts; None for no such bound.
        sync: When to force data to the disk: at every chunk, when a segment is sealed,
            or never (the operating system decides).
    """

    chunk_size: int = 2 << 20
    chunk_span_ns: int = 250_000_000
    span_size: int = 512 << 10
    large_payload: int = 1024
    compression: Literal["zstd", "lz4", "none"] = "zstd"
    level: int = 3
    segment_size: int = 4 << 30
    segment_span_s: float | None = None
    sync: Literal["chunk", "seal", "never"] = "seal"

    def __post_init__(self) -> None:
        if not 1 << 10 <= self.chunk_size <= 1 << 28:
            raise UsageError("the chunk size must lie between 1 KiB and 256 MiB")
        if not 0 < self.chunk_span_ns <= _MOST_SPAN:
            raise UsageError("a chunk must last longer than no time, and an hour at most")
        if not 1 <= self.level <= 19:
            raise UsageError("the zstd level must lie between 1 and 19")
        if self.segment_span_s is not None and not self.segment_span_s > 0:
            raise UsageError("a segment must last longer than no time")


@dataclass(slots=True)
class RecordingTotals:
    """What a recording's writer has done so far."""

    messages: int = 0
    payload_bytes: int = 0
    stored_bytes: int = 0
    segments: int = 0
    chunks: int = 0


@dataclass(slots=True)
class _Known:
    channel_id: int
    schema_id: int
    cluster: int


class RecordingWriter:
    """Takes the batches of one recording, writes its segments.

    Args:
        directory: The recording's directory; it exists and is empty.
        recording: Catalog entry kept in every segment.
        on_chunk: Called, on a thread of the writer's and in file order, with every chunk
            that is in the file.
        settings: How to cut and pack.
        hurry: Says whether there is no time to compress what does not shrink to little; None
            when there always is.
        next_chunk_size: Gives the bytes at which a chunk closes that is opened now; without,
            as the settings say.
        spare: As many as there are processors for what can wait. One is taken to pack a
            chunk where there is no hurry, unless none can be had for a tenth of a second.
        on_written: Called, on a thread of the writer's, when there is less that waits. With
            it nothing that is appended waits for the disk: whoever appends looks at
            `waiting`. Without it `append` waits while the disk is slow.
        on_sealing: Called when a segment is complete and, unless the settings say never, on
            the disk; only then it gets its final name. A thread of the writer's calls it, or
            the one that calls `give_up`. What it raises stops the writer like a failed write.
    """

    def __init__(
        self,
        directory: Path,
        recording: Mapping[str, object],
        on_chunk: Callable[[StoredChunk, Mapping[int, Channel]], None],
        settings: SegmentSettings | None = None,
        *,
        hurry: Callable[[], bool] | None = None,
        next_chunk_size: Callable[[], int] | None = None,
        spare: BoundedSemaphore | None = None,
        on_written: Callable[[], None] | None = None,
        on_sealing: OnSealing | None = None,
    ) -> None:
        self.settings = settings or SegmentSettings()
        self.totals = RecordingTotals()
        self.channels: dict[int, Channel] = {}
        self.written: Counter[int] = Counter()
        """Messages that are in the files, by channel id."""
        self.last_log_time = 0
        """Log time of the latest message in the files, ns; 0 without any."""
        self._directory = directory
        self._recording = recording
        self._on_chunk = on_chunk
        self._known: dict[Channel, _Known] = {}
        self._schema_ids: dict[Schema, int] = {}
        self._clusters: dict[int, ChunkBuilder] = {}
        self._compressor = Compressor(self.settings.compression, self.settings.level)
        self._pool = Threads(PACKERS, "hybridlog-pack")
        self._disk = Threads(1, "hybridlog-disk")
        self._hurry = hurry or (lambda: False)
        self._spare = spare or BoundedSemaphore(PACKERS)
        chunk_size = self.settings.chunk_size
        self._next_chunk_size = next_chunk_size or (lambda: chunk_size)
        self._on_written = on_written
        self._on_sealing: OnSealing = on_sealing or (lambda _: None)
        self._closed_bytes = 0
        self._stored_bytes = 0
        self._packed: deque[Future[PackedChunk]] = deque()  # in the order of the file
        self._storing: deque[Future[None]] = deque()
        self._broken: BaseException | None = None
        self._next_seq = 0
        self._stored_seq = 0
        self._segment: SegmentFile | None = None
        self._number = 0
        self._opened = 0.0
        self._closed: list[Path] = []
        self._synced = 0
        self._syncing: Future[None] | None = None

    @property
    def waiting(self) -> int:
        """Bytes of content of closed chunks that are not in the file yet."""
        return self._closed_bytes - self._stored_bytes

    def append(self, batch: Batch | LooseBatch, channels: Sequence[Channel]) -> None:
        """Take a batch; `batch.channel` indexes `channels`.

        Raises:
            DiskFullError: no space; what was flushed before stays.
        """
        if not len(batch):
            return
        seq = np.arange(self._next_seq, self._next_seq + len(batch), dtype=np.int64)
        self._next_seq += len(batch)
        present = np.flatnonzero(np.bincount(batch.channel)).tolist()
        ids, cluster = np.zeros((2, present[-1] + 1), np.int32)
        for index in present:
            channel = channels[index]
            known = self._known.get(channel) or self._meet(
                channel, float(batch.length[batch.channel == index].mean())
            )
            ids[index], cluster[index] = known.channel_id, known.cluster
        own = replace(batch, channel=ids[batch.channel])
        clusters = sorted({int(cluster[index]) for index in present})
        if len(clusters) == 1:
            self._fill(clusters[0], own, seq)
        else:
            cluster_of = cluster[batch.channel]
            for key in clusters:
                rows = np.flatnonzero(cluster_of == key)
                self._fill(key, own.take(rows), seq[rows])
        self.totals.messages += len(batch)
        self.totals.payload_bytes += batch.payload_bytes
        self._keep_pace(limit=4)

    def place_one(
        self, channel: Channel, payload: Buffer, log_time: int, publish_time: int, sequence: int
    ) -> Callable[[], None]:
        """Take one message; for large payloads this costs less than a batch.

        Returns:
            What copies the payload, unless that was done at once (one below
            `COPIED_AT_ONCE`). It must be called once, on any thread, also while others
            append; the message's chunk is not written before.

        Raises:
            DiskFullError: no space; what was flushed before stays.
        """
        known = self._known.get(channel) or self._meet(channel, len(payload))
        key = known.cluster
        builder = self._builder(key)
        if len(builder):
            size = len(builder) + MESSAGE_HEAD.itemsize + len(payload)
            away = abs(log_time - builder.first_log_time)
            is_far = away >= self._span_of(len(builder))
            if (key != _SHARED and is_far) or size > builder.capacity:
                self._close_chunk(key)
                builder = self._builder(key)
        copy = builder.place_one(
            payload,
            channel=known.channel_id,
            log_time=log_time,
            publish_time=publish_time,
            sequence=sequence,
            seq=self._next_seq,
        )
        self._next_seq += 1
        self.totals.messages += 1
        self.totals.payload_bytes += len(payload)
        if len(builder) >= builder.capacity:
            try:
                self._close_chunk(key)
            except BaseException:
                copy()  # or who packs the chunk would wait for ever
                raise
        return copy

    def count_chunks(self, channels: Iterable[Channel]) -> int:
        """In how many open chunks messages of some channels lie; of new ones each in its own."""
        known = self._known
        return len({known[c].cluster if c in known else c for c in channels})

    def add_extra(self, record: Metadata | Attachment) -> None:
        """Keep an attachment or a metadata record of the source."""
        self._storing.append(self._disk.submit(self._add, record))
        self._keep_pace(limit=0)

    def flush(self) -> None:
        """Close every open chunk and see it written."""
        for key in list(self._clusters):
            self._close_chunk(key)
        self._drain(limit=0)

    def flush_older(self, seconds: float) -> None:
        """Close the chunks that were opened so long ago, and write what is packed."""
        limit = time.monotonic() - seconds
        for key, builder in self._clusters.items():
            if builder.opened <= limit:
                self._close_chunk(key)
        self._keep_pace(limit=4)

    def close(self, end: Metadata | None = None) -> list[Path]:
        """Flush, seal the last segment; returns the paths of all segments.

        Args:
            end: A last metadata record, which says how the recording ended.
        """
        try:
            self.flush()
            if end is not None:
                self.add_extra(end)
                self._drain(limit=0)
            self._disk.submit(self._seal).result()
        finally:
            self._shut_down()
        return self._closed

    def give_up(self, extras: Sequence[Metadata]) -> None:
        """When nothing more can be written: seal what is in the file, drop what is not.

        Args:
            extras: Last records, for which there may be room.

        Raises:
            DiskFullError: There is not; the next opening of the store seals the segment.
        """
        self._syncing = None
        self._shut_down()
        if self._segment is not None and self._segment.is_complete:
            self._seal()
        segment = self._open_segment()
        for extra in extras:
            segment.add_metadata(extra)
        self._seal()

    def written_of(self, channel: Channel) -> int:
        """Messages of a channel that are in the files."""
        known = self._known.get(channel)
        return 0 if known is None else self.written[known.channel_id]

    def abort(self) -> None:
        """Stop at once; sealed segments and flushed chunks stay where they are."""
        self._broken = self._broken or StoreError("The recording was stopped.")
        self._shut_down()
        if self._segment is not None:
            self._segment.abandon()
            self._segment = None

    def _shut_down(self) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)
        self._disk.shutdown(wait=True, cancel_futures=True)

    def _meet(self, channel: Channel, mean: float) -> _Known:
        """Make a new channel known: its ids, and from its mean payload bytes its cluster."""
        if len(self._known) >= _MAX_CHANNELS:
            raise StoreError(f"more than {_MAX_CHANNELS} channels in one recording")
        schema_id = 0
        if channel.schema is not None:
            schema_id = self._schema_ids.setdefault(channel.schema, len(self._schema_ids) + 1)
        channel_id = len(self._known) + 1
        cluster = channel_id if mean >= self.settings.large_payload else _SHARED
        known = self._known[channel] = _Known(channel_id, schema_id, cluster)
        self.channels[channel_id] = channel
        return known

    def _builder(self, key: int) -> ChunkBuilder:
        """The open chunk of a cluster."""
        builder = self._clusters.get(key)
        if builder is None:
            builder = self._clusters[key] = ChunkBuilder(self._next_chunk_size())
        elif not len(builder):
            builder.capacity = self._next_capacity(key, builder.capacity)
        return builder

    def _next_capacity(self, key: int, before: int) -> int:
        """Bytes at which the next chunk of a cluster closes.

        Topics of one rate would close theirs at one time, which is much to do at once where
        chunks are large. So when they become twice as large or more, each cluster begins with
        another size between half of it and all.
        """
        size = self._next_chunk_size()
        return size if size < 2 * before else size - int(size / 2 * (key * _PHASE % 1))

    def _fill(self, key: int, batch: Batch | LooseBatch, seq: NDArray[np.int64]) -> None:
        """Lay messages into a cluster's chunk, closing chunks at their bounds."""
        sizes = np.cumsum(batch.length + MESSAGE_HEAD.itemsize)
        start, total = 0, len(batch)
        while start < total:
            builder = self._builder(key)
            before = int(sizes[start - 1]) if start else 0
            room = builder.capacity - len(builder)
            end = int(np.searchsorted(sizes, before + room, side="right"))
            if not len(builder):
                end = max(end, start + 1)  # a message larger than a chunk is a chunk
            if key != _SHARED:
                end = min(end, self._span_end(builder, batch, start))
            if end > start:
                rows = slice(start, end)
                builder.append(batch.take(rows), seq[rows])
                start = end
            if start < total or len(builder) >= builder.capacity:
                self._close_chunk(key)

    def _span_of(self, held: _Count) -> _Count:
        """Longest log time, ns, of a chunk of one channel that holds so many bytes."""
        is_small = held < self.settings.span_size
        return self.settings.chunk_span_ns * (1 + (_SMALL_SPANS - 1) * is_small)

    def _span_end(self, builder: ChunkBuilder, batch: Batch | LooseBatch, start: int) -> int:
        """First row from `start` on that lies too far in log time from the chunk's first."""
        log_time = batch.log_time[start:]
        first = builder.first_log_time if len(builder) else int(log_time[0])
        away = np.abs(log_time - first)
        if int(away.max()) < self.settings.chunk_span_ns:
            return len(batch)
        sizes = batch.length[start:] + MESSAGE_HEAD.itemsize
        held = np.cumsum(sizes) - sizes + len(builder)
        far = away >= self._span_of(held)
        return start + int(far.argmax()) if far.any() else len(batch)

    def _close_chunk(self, key: int) -> None:
        builder = self._clusters[key]
        if len(builder):
            copying = builder.copying
            batch, seq, size = builder.take()
            self._closed_bytes += size
            packed = self._pool.submit(self._pack, copying, batch, seq, size)
            self._packed.append(packed)
            self._storing.append(self._disk.submit(self._store, packed))
            self._keep_pace(limit=AT_WORK)

    def _keep_pace(self, limit: int) -> None:
        """Wait as `_drain` does, or only hear of what went wrong if somebody else waits."""
        self._drain(limit if self._on_written is None else len(self._storing))

    def _drain(self, limit: int) -> None:
        """Wait until at most `limit` chunks are still being packed and written; tell a failure."""
        while self._storing and (len(self._storing) > limit or self._storing[0].done()):
            self._storing.popleft().result()
        if self._broken is not None:
            raise self._broken

    def _pack(
        self, copying: Sequence[Lock], batch: Batch, seq: NDArray[np.int64], size: int
    ) -> PackedChunk:
        """Pack a chunk once all payloads are there: the same microseconds, seldom more."""
        for lock in copying:
            lock.acquire()
        # Only now: topics of one rate close their chunks at one time, and nobody is in a
        # hurry before most of these wait here, or for their turn.
        hurried = self._hurry()
        with nullcontext() if hurried else self._turn():
            hurried = hurried or self._hurry()
            return pack(self._compressor, batch, seq, size, hurried=hurried)

    @contextmanager
    def _turn(self) -> Iterator[None]:
        """A processor to spare, if one can be had soon; nothing waits long for who has it."""
        has_one = self._spare.acquire(timeout=_TURN_S)
        try:
            yield
        finally:
            if has_one:
                self._spare.release()

    # What follows runs on the thread that writes, and on no other.

    def _store(self, packed: Future[PackedChunk]) -> None:
        """See a closed chunk written, with those behind it that can be; none after a failure."""
        if self._broken is not None:
            return  # whoever appends hears of it
        if not self._packed or packed is not self._packed[0]:
            return  # it was written with one before it
        try:
            self._write()
        except BaseException as error:
            self._broken = error
            raise

    def _next_chunks(self, segment: SegmentFile) -> list[PackedChunk]:
        """The first chunk, once it is packed, and what is packed already and lies behind it.

        Each time this thread stops and goes on, it waits for its turn at the interpreter;
        so when much waits, much is written at once. The file is as if it had not waited.
        """
        first = self._packed[0].result()
        for channel_id in first.indexes:
            if channel_id not in segment.channels:
                channel = self.channels[channel_id]
                segment.define(channel_id, self._known[channel].schema_id, channel)
        chunks, size = [first], len(first.data)
        while size < _WRITTEN_AT_ONCE and len(chunks) < len(self._packed):
            following = self._packed[len(chunks)]
            if not following.done() or following.exception() is not None:
                break
            chunk = following.result()
            if not chunk.indexes.keys() <= segment.channels.keys():
                break
            chunks.append(chunk)
            size += len(chunk.data)
        return chunks

    def _add(self, record: Metadata | Attachment) -> None:
        segment = self._open_segment()
        if isinstance(record, Metadata):
            segment.add_metadata(record)
        else:
            segment.add_attachment(record)

    def _write(self) -> None:
        segment = self._open_segment()
        chunks = self._next_chunks(segment)
        stored = segment.append_chunks(chunks, self.settings.segment_size)
        for _ in stored:
            self._packed.popleft()
        if self.settings.sync == "chunk":
            segment.sync()
        elif self.settings.sync == "seal" and not segment.direct:
            self._sync_behind(segment)
        for chunk, place in zip(chunks, stored, strict=False):
            self._tell(chunk, place)
        span = self.settings.segment_span_s
        is_old = span is not None and time.monotonic() - self._opened >= span
        is_full = segment.position >= self.settings.segment_size
        has_many = segment.chunks >= _MOST_CHUNKS or segment.table.parts >= _MOST_PARTS
        if is_old or is_full or has_many:
            self._seal()

    def _tell(self, chunk: PackedChunk, stored: StoredChunk) -> None:
        """Whom it concerns that a chunk is in the file."""
        self.totals.chunks += 1
        for channel_id, data in chunk.indexes.items():
            self.written[channel_id] += entries_of(data)
        self.last_log_time = max(self.last_log_time, chunk.last)
        self._stored_seq = max(self._stored_seq, int(chunk.seq.max()) + 1)
        self._on_chunk(stored, self.channels)
        self._stored_bytes += chunk.uncompressed_size
        if self._on_written is not None:
            self._on_written()

    def _sync_behind(self, segment: SegmentFile) -> None:
        """Force long segments to the disk as they grow, so that sealing them takes no time."""
        if segment.position - self._synced >= _SYNC_STRIDE and self._syncing is None:
            self._synced = segment.position
            self._syncing = self._pool.submit(segment.sync)
        elif self._syncing is not None and self._syncing.done():
            self._finish_sync()

    def _finish_sync(self) -> None:
        syncing, self._syncing = self._syncing, None
        if syncing is not None:
            syncing.result()

    def _open_segment(self) -> SegmentFile:
        if self._segment is None:
            self._segment = SegmentFile.create(
                self._directory,
                self._number,
                self._recording,
                self._stored_seq,
                sync=self.settings.sync == "chunk",
            )
            self._number += 1
            self._opened = time.monotonic()
        return self._segment

    def _seal(self) -> None:
        segment = self._open_segment()
        self._finish_sync()
        self._synced = 0
        sync = self.settings.sync != "never"
        self._closed.append(segment.seal(sync=sync, on_sealing=self._on_sealing))
        self.totals.stored_bytes += segment.position
        self.totals.segments += 1
        self._segment = None
