"""Writes a recording: groups messages into chunks, and chunks into segments.

A channel with large payloads has chunks of its own, bounded in bytes and in log time. A
slice of a scan therefore reads little else. Channels with small payloads share chunks. Worker
threads compress, another thread writes. Chunks reach the file in the order in which they
were closed, each with its indexes in one write. Only then the indexer gets them: **log
first, index second**.
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
from mcap.records import Metadata

from hybridlog_storage.errors import DiskFullError, StoreError, UsageError
from hybridlog_storage.mcap.mcap_content import MESSAGE_HEAD
from hybridlog_storage.messages import MAX_CHANNELS, Batch, Buffer, Channel, LooseBatch, Schema
from hybridlog_storage.segments.attachments import Attachment
from hybridlog_storage.segments.chunk import PackedChunk, StoredChunk, pack
from hybridlog_storage.segments.chunk_builder import ChunkBuilder
from hybridlog_storage.segments.compression import Compressor
from hybridlog_storage.segments.segment_file import OnSealing, SegmentFile
from hybridlog_storage.segments.segment_format import entries_of, last_time_of
from hybridlog_storage.stopping import safe_point

if TYPE_CHECKING:
    from numpy.typing import NDArray

    _Count = TypeVar("_Count", int, NDArray[np.int64])
from hybridlog_storage.threads import Threads

_MAX_CHUNKS = 1 << 14  # chunks of a segment: its reader needs a kilobyte of memory for each
_MAX_PARTS = 1 << 20  # sum over a segment's chunks of their channels, which the summary lists
PACKERS = 2
"""Threads that pack chunks."""
AT_WORK = 8
"""Closed chunks that may be in work before the writer counts as late."""
_TURN_S = 0.1  # seconds: longest wait of a chunk before it is packed
_SHARED = -1
_MAX_SPAN = 3600 * 10**9  # ns
_PHASE = 0.6180339887  # whose multiples, without their whole part, never lie close together
_SMALL_SPANS = 256  # times the usual span, for a chunk that is still small
_SYNC_STRIDE = 32 << 20  # bytes
_WRITTEN_AT_ONCE = 16 << 20  # bytes, at most, and one chunk


@dataclass(frozen=True, slots=True)
class SegmentSettings:
    """Settings for the division and compression of segments.

    Attributes:
        chunk_size: Bytes of uncompressed content at which a chunk closes; a live recording
            uses larger chunks at high rates.
        chunk_span_ns: Log time after which a chunk of a large-payload channel closes.
        span_size: Bytes of content below which such a chunk may span 256 times as much: small
            chunks compress badly, and reading one whole costs little.
        large_payload: Mean payload bytes from which a channel gets chunks of its own.
        compression: Codec of chunks that can be compressed.
        level: zstd level.
        segment_size: Bytes of file at which the next segment starts, if it has not after
            16,384 chunks.
        segment_span_s: Seconds after which the next segment starts; None for no such bound.
        sync: Forces data to the disk at every chunk, when a segment is sealed, or never
            (the operating system decides).
    """

    chunk_size: int = 2 << 20
    chunk_span_ns: int = 250_000_000
    span_size: int = 1 << 20
    large_payload: int = 1024
    compression: Literal["zstd", "lz4", "none"] = "zstd"
    level: int = 3
    segment_size: int = 4 << 30
    segment_span_s: float | None = None
    sync: Literal["chunk", "seal", "never"] = "seal"

    def __post_init__(self) -> None:
        if not 1 << 10 <= self.chunk_size <= 1 << 28:
            raise UsageError("the chunk size must lie between 1 KiB and 256 MiB")
        if not 0 < self.chunk_span_ns <= _MAX_SPAN:
            raise UsageError("a chunk must last longer than no time, and an hour at most")
        if not 1 <= self.level <= 19:
            raise UsageError("the zstd level must lie between 1 and 19")
        if self.segment_span_s is not None and not self.segment_span_s > 0:
            raise UsageError("a segment must last longer than no time")


@dataclass(slots=True)
class RecordingTotals:
    """Progress of a recording's writer."""

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
    """Writes the batches of one recording into segments.

    Args:
        directory: The recording's directory; it exists and is empty.
        recording: Catalog entry stored in every segment.
        on_chunk: Called on a writer thread, in file order, with every chunk in the file.
        settings: How to divide and compress.
        skip_compression: Returns whether to compress only chunks that shrink to a fifth or
            less; None for never.
        next_chunk_size: Returns the size in bytes of the next chunk; None for the size in
            the settings.
        cpu_slots: Semaphore of the processors for work that can wait. Packing a chunk takes one
            if there is no skip_compression, and waits for it a tenth of a second at most.
        on_written: Called on a writer thread when less content is waiting. With it `append`
            never waits for the disk, and the caller watches `waiting`. Without it `append`
            waits for a slow disk.
        no_index: Returns whether the messages of a topic get no documents in MongoDB; None
            for no topic. The segments keep that.
        on_sealing: Called when a segment is complete and, unless `sync` is never, on the
            disk, before it gets its final name. Called on a writer thread or by `give_up`.
            An exception stops the writer like a failed write.
        on_sealed: The same, once it has its final name.
    """

    def __init__(
        self,
        directory: Path,
        recording: Mapping[str, object],
        on_chunk: Callable[[StoredChunk, Mapping[int, Channel]], None],
        settings: SegmentSettings | None = None,
        *,
        skip_compression: Callable[[], bool] | None = None,
        next_chunk_size: Callable[[], int] | None = None,
        cpu_slots: BoundedSemaphore | None = None,
        on_written: Callable[[], None] | None = None,
        no_index: Callable[[str], bool] | None = None,
        on_sealing: OnSealing | None = None,
        on_sealed: OnSealing | None = None,
    ) -> None:
        self.settings = settings or SegmentSettings()
        self.totals = RecordingTotals()
        self.channels: dict[int, Channel] = {}
        self.written: Counter[int] = Counter()
        """Number of messages in the files, by channel id."""
        self._last_times: dict[int, int] = {}  # in the files, by channel id
        self._directory = directory
        self._recording = recording
        self._on_chunk = on_chunk
        self._known: dict[Channel, _Known] = {}
        self._schema_ids: dict[Schema, int] = {}
        self._clusters: dict[int, ChunkBuilder] = {}
        self._compressor = Compressor(self.settings.compression, self.settings.level)
        self._pool = Threads(PACKERS, "hybridlog-pack")
        self._disk = Threads(1, "hybridlog-disk")
        self._skip_compression = skip_compression or (lambda: False)
        self._cpu_slots = cpu_slots or BoundedSemaphore(PACKERS)
        chunk_size = self.settings.chunk_size
        self._next_chunk_size = next_chunk_size or (lambda: chunk_size)
        self._on_written = on_written
        self._no_index = no_index or (lambda _: False)
        self._on_sealing: OnSealing = on_sealing or (lambda _: None)
        self._on_sealed: OnSealing = on_sealed or (lambda _: None)
        self._closed_bytes = 0
        self._stored_bytes = 0
        self._packed: deque[Future[PackedChunk]] = deque()  # in file order
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
        """Bytes of content in closed chunks that are not in the file yet."""
        return self._closed_bytes - self._stored_bytes

    def append(self, batch: Batch | LooseBatch, channels: Sequence[Channel]) -> None:
        """Append a batch; `batch.channel` indexes `channels`.

        Raises:
            DiskFullError: No space; flushed chunks stay.
        """
        if not len(batch):
            return
        seq = np.arange(self._next_seq, self._next_seq + len(batch), dtype=np.int64)
        self._next_seq += len(batch)
        counts = np.bincount(batch.channel)
        sizes = np.bincount(batch.channel, batch.length)
        present = np.flatnonzero(counts).tolist()
        ids, cluster = np.zeros((2, present[-1] + 1), np.int32)
        for index in present:
            channel = channels[index]
            known = self._known.get(channel) or self._meet(
                channel, float(sizes[index] / counts[index])
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
        self._limit_queue(limit=4)

    def place_one(
        self, channel: Channel, payload: Buffer, log_time: int, publish_time: int, sequence: int
    ) -> Callable[[], None]:
        """Append one message; for large payloads this costs less than a batch.

        Returns:
            A function that copies the payload, unless it was copied at once (below
            `COPIED_AT_ONCE`). Call it once, on any thread, also while others append; the
            message's chunk is not written before.

        Raises:
                DiskFullError: No space; flushed chunks stay.
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
                copy()  # or packing the chunk would wait for ever
                raise
        return copy

    def count_chunks(self, channels: Iterable[Channel]) -> int:
        """Number of open chunks with messages of some channels; a new channel counts as one."""
        known = self._known
        return len({known[c].cluster if c in known else c for c in channels})

    def declare(self, channel: Channel) -> None:
        """Store a channel even if it has no message."""
        if channel not in self._known:
            self._meet(channel, 0)

    def add_extra(self, record: Metadata | Attachment) -> None:
        """Store an attachment or a metadata record of the source."""
        self._storing.append(self._disk.submit(self._add, record))
        self._limit_queue(limit=0)

    def flush(self) -> None:
        """Close and write every open chunk."""
        for key in list(self._clusters):
            self._close_chunk(key)
        self._drain(limit=0)

    def flush_older(self, seconds: float) -> None:
        """Close chunks of at least this age, and write packed chunks."""
        limit = time.monotonic() - seconds
        for key, builder in self._clusters.items():
            if builder.opened <= limit:
                self._close_chunk(key)
        self._limit_queue(limit=4)

    def close(self, end: Metadata | None = None) -> list[Path]:
        """Flush and seal the last segment; return the paths of all segments.

        Args:
            end: The last metadata record, with the end of the recording.
        """
        try:
            self.flush()
            self._disk.submit(self._define_rest).result()
            if end is not None:
                self.add_extra(end)
                self._drain(limit=0)
            self._disk.submit(self._seal).result()
        finally:
            self._shut_down()
        return self._closed

    def close_truncated(self, extras: Sequence[Metadata]) -> None:
        """Seal the chunks in the file and drop the others, after a failed write.

        Raises:
            DiskFullError: No room; the next opening of the store seals the segment. Or no
                message is in the files.
        """
        self._syncing = None
        self._shut_down()
        if not self.written.total():
            raise DiskFullError("No space left for any message. Free some, and record again.")
        if self._segment is not None and self._segment.is_complete:
            self._seal()
        segment = self._open_segment()
        for extra in extras:
            segment.add_metadata(extra)
        self._seal()

    def written_of(self, channel: Channel) -> int:
        """Number of messages of a channel in the files."""
        known = self._known.get(channel)
        return 0 if known is None else self.written[known.channel_id]

    def last_time_of(self, channel: Channel) -> int | None:
        """Log time of the last message of a channel in the files, ns; None without any."""
        known = self._known.get(channel)
        return None if known is None else self._last_times.get(known.channel_id)

    def abort(self) -> None:
        """Stop at once; sealed segments and flushed chunks stay."""
        self._broken = self._broken or StoreError("The recording was stopped.")
        self._shut_down()
        if self._segment is not None:
            self._segment.abandon()
            self._segment = None

    def _shut_down(self) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)
        self._disk.shutdown(wait=True, cancel_futures=True)

    def _meet(self, channel: Channel, mean: float) -> _Known:
        """Register a new channel: its ids and, from its mean payload size, its cluster."""
        if len(self._known) >= MAX_CHANNELS:
            raise StoreError(f"more than {MAX_CHANNELS} channels in one recording")
        schema_id = 0
        if channel.schema is not None:
            schema_id = self._schema_ids.setdefault(channel.schema, len(self._schema_ids) + 1)
        channel_id = len(self._known) + 1
        cluster = channel_id if mean >= self.settings.large_payload else _SHARED
        known = self._known[channel] = _Known(channel_id, schema_id, cluster)
        if channel.is_indexed and self._no_index(channel.topic):
            channel = replace(channel, is_indexed=False)
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

        Topics of equal rate would close large chunks at the same time. So when chunks at least
        double in size, each cluster starts with a different size between half and full.
        """
        size = self._next_chunk_size()
        return size if size < 2 * before else size - int(size / 2 * (key * _PHASE % 1))

    def _fill(self, key: int, batch: Batch | LooseBatch, seq: NDArray[np.int64]) -> None:
        """Append messages to a cluster's chunk, closing chunks at their bounds."""
        sizes = np.cumsum(batch.length + MESSAGE_HEAD.itemsize)
        start, total = 0, len(batch)
        while start < total:
            builder = self._builder(key)
            before = int(sizes[start - 1]) if start else 0
            room = builder.capacity - len(builder)
            end = int(np.searchsorted(sizes, before + room, side="right"))
            if not len(builder):
                end = max(end, start + 1)  # a message larger than a chunk is a chunk of its own
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
        """First row from `start` on whose log time is too far from the chunk's first."""
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
            self._limit_queue(limit=AT_WORK)

    def _limit_queue(self, limit: int) -> None:
        """Wait as `_drain` does, or with `on_written` only raise a failure."""
        self._drain(limit if self._on_written is None else len(self._storing))

    def _drain(self, limit: int) -> None:
        """Wait until at most `limit` chunks are being packed or written; raise a failure."""
        while self._storing and (len(self._storing) > limit or self._storing[0].done()):
            safe_point()
            self._storing.popleft().result()
        if self._broken is not None:
            raise self._broken

    def _pack(
        self, copying: Sequence[Lock], batch: Batch, seq: NDArray[np.int64], size: int
    ) -> PackedChunk:
        """Pack a chunk once all payloads are copied, which takes microseconds."""
        for lock in copying:
            lock.acquire()
        # Checked here: topics of equal rate close their chunks at the same time, and the
        # skip_compression shows only when most of these are waiting.
        hurried = self._skip_compression()
        with nullcontext() if hurried else self._turn():
            hurried = hurried or self._skip_compression()
            return pack(self._compressor, batch, seq, size, hurried=hurried)

    @contextmanager
    def _turn(self) -> Iterator[None]:
        """Hold a spare processor, if one is free soon."""
        has_one = self._cpu_slots.acquire(timeout=_TURN_S)
        try:
            yield
        finally:
            if has_one:
                self._cpu_slots.release()

    # The methods below run on the writing thread only.

    def _store(self, packed: Future[PackedChunk]) -> None:
        """Write a packed chunk and the packed ones that follow it; nothing after a failure."""
        if self._broken is not None:
            return  # the next append raises it
        if not self._packed or packed is not self._packed[0]:
            return  # it was written together with an earlier one
        try:
            self._write()
        except BaseException as error:
            self._broken = error
            raise

    def _next_chunks(self, segment: SegmentFile) -> list[PackedChunk]:
        """The first chunk, once it is packed, and the packed chunks behind it.

        After each blocking call this thread waits for the interpreter lock. So many waiting
        chunks are written at once; the file is the same either way.
        """
        first = self._packed[0].result()
        self._define(segment, [c for c in first.indexes if c not in segment.channels])
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
            return
        segment.add_attachment(record)
        if segment.position >= self.settings.segment_size:
            self._seal()

    def _define_rest(self) -> None:
        """Define the channels without messages in the last segment."""
        self._define(self._open_segment(), [c for c in self.channels if not self.written[c]])

    def _define(self, segment: SegmentFile, channel_ids: Sequence[int]) -> None:
        channels = [(number, self.channels[number]) for number in channel_ids]
        segment.define(
            (number, self._schema_ids[channel.schema] if channel.schema else 0, channel)
            for number, channel in channels
        )

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
            self._publish(chunk, place)
        span = self.settings.segment_span_s
        is_old = span is not None and time.monotonic() - self._opened >= span
        is_full = segment.position >= self.settings.segment_size
        has_many = segment.chunks >= _MAX_CHUNKS or segment.table.parts >= _MAX_PARTS
        if is_old or is_full or has_many:
            self._seal()

    def _publish(self, chunk: PackedChunk, stored: StoredChunk) -> None:
        """Report that a chunk is in the file."""
        self.totals.chunks += 1
        for channel_id, data in chunk.indexes.items():
            self.written[channel_id] += entries_of(data)
            self._last_times[channel_id] = last_time_of(data)
        self._stored_seq = max(self._stored_seq, int(chunk.seq.max()) + 1)
        self._on_chunk(stored, self.channels)
        self._stored_bytes += chunk.uncompressed_size
        if self._on_written is not None:
            self._on_written()

    def _sync_behind(self, segment: SegmentFile) -> None:
        """Force long segments to the disk as they grow, so that sealing them is fast."""
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
        self._on_sealed(segment.complete())
        self.totals.stored_bytes += segment.position
        self.totals.segments += 1
        self._segment = None
