"""Writes a recording: messages into chunks, and chunks into groups of segments.

A channel with large payloads has chunks of its own, bounded in bytes and in log time. A
slice of a scan therefore reads little else. Channels with small payloads share chunks. Worker
threads compress, another thread writes. Chunks reach the segments of the group in the order in
which they were closed, each with its indexes in one write. Only then the indexer gets them:
**log first, index second**.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, TypeVar

import numpy as np
from mcap.records import Metadata
from msgspec import Struct
from msgspec.structs import replace

from hybridlog_storage.errors import DiskFullError, StoreError, UsageError
from hybridlog_storage.mcap.mcap_content import MESSAGE_HEAD, Compressor
from hybridlog_storage.messages import MAX_CHANNELS, Batch, Channel, LooseBatch, Schema
from hybridlog_storage.segments.chunk import OpenChunk, PackedChunk, pack
from hybridlog_storage.segments.segment_file import Sealed, SegmentFile
from hybridlog_storage.segments.segment_format import Attachment
from hybridlog_storage.stopping import safe_point
from hybridlog_storage.threads import Threads, processors

if TYPE_CHECKING:
    from numpy.typing import NDArray

    _Done = TypeVar("_Done")


FIRST: Final = 1
"""Key of the first segment of a group."""
SECOND: Final = 2
"""Key of the segment with larger topics that have none of their own."""
LATCHED: Final = 3
"""Key of the segment with latched messages, where they stay alone: a group of its own."""
Key = Literal[1, 2, 3] | str
"""A segment of a group: one of the above, or that of a topic."""
_NAMED: Final = 14  # topics with segments of their own by a rule
_OTHERS: Final = 16  # and by their size: a group has 32 segments at most
_LEAST: Final = 16  # times that mean payload that it has had: small logs have few files
_MAX_CHUNKS: Final = 1 << 14  # of a segment: its reader needs a kilobyte of memory for each
_MAX_PARTS: Final = 1 << 20  # sum over a segment's chunks of their channels in the summary


class Division:
    """Decides which segment of a group a chunk goes to.

    In later groups than the first, `large_payload` takes the place of `own_payload`, for those with
    the most bytes in the group before. `is_named` returns whether a rule names a topic.
    """

    def __init__(self, settings: SegmentSettings, is_named: Callable[[str], bool]) -> None:
        self._settings = settings
        self._is_named = is_named
        self._named: dict[str, bool] = {}
        self._own: set[str] = set()
        self._is_first = True
        self._messages: Counter[str] = Counter()  # of this group
        self._bytes: Counter[str] = Counter()

    def is_named(self, topic: str) -> bool:
        """True if a rule names a topic, and there was room for a segment of its own."""
        found = self._named.get(topic)
        if found is None:
            has_room = sum(self._named.values()) < _NAMED
            found = self._named[topic] = has_room and self._is_named(topic)
        return found

    def key(self, topic: str, chunk: PackedChunk) -> Key:
        """The segment for the next chunk of a topic that shares no chunks."""
        self._messages[topic] += int(chunk.parts["messages"].sum())
        self._bytes[topic] += int(chunk.parts["payload_bytes"].sum())
        if topic in self._own or self.is_named(topic):
            return topic
        messages, least = self._messages[topic], self._settings.own_payload
        is_large = messages > 1 and self._bytes[topic] >= least * max(messages, _LEAST)
        if self._is_first and len(self._own) < _OTHERS and is_large:
            self._own.add(topic)
            return topic
        return SECOND

    def begin(self) -> None:
        """Begin the next group."""
        least = self._settings.large_payload
        large = [
            topic
            for topic, size in self._bytes.most_common()
            if size >= least * self._messages[topic] and not self.is_named(topic)
        ]
        self._own = {*large[:_OTHERS]}
        self._is_first = False
        self._messages.clear()
        self._bytes.clear()


_PACKERS = 2
AT_WORK = 8
"""Closed chunks that may be in work before the writer counts as late."""
_SHARED = -1
_LATCHED = -2
_MAX_SPAN = 3600 * 10**9  # ns
_SMALL_SPANS = 256  # times the usual span, for a chunk that is still small


class SegmentSettings(Struct, frozen=True):
    """Settings for the division and compression of segments.

    Attributes:
        chunk_size: Bytes of uncompressed content at which a chunk closes.
        chunk_span_ns: Log time after which a chunk of a large-payload channel closes.
        span_size: Bytes of content below which such a chunk may span 256 times as much: small
            chunks compress badly, and reading one whole costs little.
        large_payload: Mean payload bytes from which a channel gets chunks of its own, outside
            of the first segment of a group.
        own_payload: Mean payload bytes from which a topic gets a segment of its own in the
            first group, once it has two messages and 16 times so many bytes.
        compression: Codec of chunks that can be compressed.
        level: zstd level.
        segment_size: Bytes of a group of segments at which the next one starts, if it has not
            after 16,384 chunks of a segment.
        segment_span_s: Seconds after which the next group starts; None for no such bound.
        sync: Forces data to the disk at every chunk, when a group is sealed, or never
            (the operating system decides).
    """

    chunk_size: int = 2 << 20
    chunk_span_ns: int = 250_000_000
    span_size: int = 1 << 20
    large_payload: int = 1024
    own_payload: int = 16 << 10
    compression: Literal["zstd", "lz4", "none"] = "zstd"
    level: int = 3
    segment_size: int = 4 << 30
    segment_span_s: float | None = None
    sync: Literal["chunk", "seal", "never"] = "seal"

    def __post_init__(self) -> None:
        span_s = self.segment_span_s
        for is_right, words in (
            (
                1 << 10 <= self.chunk_size <= 1 << 28,
                "a chunk has between 1 KiB and 256 MiB",
            ),
            (0 < self.chunk_span_ns <= _MAX_SPAN, "a chunk lasts longer than no time, to an hour"),
            (1 <= self.level <= 19, "the zstd level lies between 1 and 19"),
            (span_s is None or span_s > 0, "a segment lasts longer than no time"),
        ):
            if not is_right:
                raise UsageError(f"{words}; give another value.")


class RecordingWriter:
    """Writes the batches of one recording into segments.

    `directory` exists and is empty; `recording` is the catalog entry, stored in every segment.

    With `on_written`, which a writer thread calls when less content is waiting, `append` never
    waits for the disk, and the caller watches `stored_bytes`: when more than a few chunks wait,
    only those that shrink to a fifth or less are compressed. Without it, it waits for the disk.

    A topic that a rule names (`is_named`) has segments of its own. Latched messages stay in the
    first ones, or `latched_apart` in one of their own in each group. Messages of a topic with
    `no_index` get no documents; the segments keep that.

    `on_sealing` is called on a writer thread, or by `close_truncated`, when a group is complete
    and, unless `sync` is never, on the disk, before its segments get their final names; an
    exception stops the writer like a failed write. `make_room` is called there when the disk is
    full, and returns whether to try again.
    """

    def __init__(
        self,
        directory: Path,
        recording: Mapping[str, object],
        settings: SegmentSettings | None = None,
        *,
        on_written: Callable[[], None] | None = None,
        no_index: Callable[[str], bool] = lambda _: False,
        is_named: Callable[[str], bool] = lambda _: False,
        is_latched: Callable[[Channel], bool] = lambda _: False,
        latched_apart: bool = False,
        on_sealing: Callable[[Sequence[Sealed]], None] = lambda _: None,
        make_room: Callable[[], bool] = lambda: False,
    ) -> None:
        self.settings = settings or SegmentSettings()
        self.messages = self.payload_bytes = self.sealed = 0
        """Messages that were appended, bytes of their payloads, and segments that are sealed."""
        self.channels: dict[int, Channel] = {}
        self.written: Counter[int] = Counter()
        """Number of messages in the files, by channel id."""
        self.stored_bytes = 0
        """Bytes of content in the files, before compression."""
        self.has_extras = False
        """True once those of `close_truncated` are in a segment."""
        self._closed_bytes = 0  # of content in closed chunks, those in the files included
        self._last_times: dict[int, int] = {}  # in the files, by channel id
        self._directory = directory
        self._recording = recording
        self._known: dict[Channel, tuple[int, int]] = {}  # its id, and its cluster
        self._schema_ids: dict[Schema, int] = {}
        self._clusters: dict[int, OpenChunk] = {}
        self._keys: dict[int, Key | None] = {}  # by channel id; None where the division decides
        self._compressor = Compressor(self.settings.compression, self.settings.level)
        # One processor is left to who brings messages that cannot wait.
        packers = _PACKERS if on_written is None else min(_PACKERS, max(processors() - 1, 1))
        self._pool = Threads(packers, "hybridlog-pack")
        self._disk = Threads(1, "hybridlog-disk")
        self._on_written = on_written
        self._no_index = no_index
        self._latched_apart = latched_apart
        self._is_latched = is_latched
        self._on_sealing = on_sealing
        self._make_room = make_room
        self._division = Division(self.settings, is_named)
        self._storing: deque[Future[None]] = deque()
        self._extras: list[Metadata | Attachment] = []  # not in a segment yet
        self._broken: BaseException | None = None
        self._next_seq = 0
        self._segments: dict[Key, SegmentFile] = {}  # of the open group, by number
        self._opened = 0.0  # when it was
        self._number = 0
        self._closed: list[Path] = []

    @property
    def is_idle(self) -> bool:
        """True if all closed chunks are in the files."""
        return self._closed_bytes == self.stored_bytes

    def append(self, batch: Batch | LooseBatch, channels: Sequence[Channel]) -> None:
        """Append a batch; `batch.channel` indexes `channels`. If it fails, flushed chunks stay."""
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
            known = self._known.get(channel)
            mean = float(sizes[index] / counts[index])
            ids[index], cluster[index] = known or self._meet(channel, mean)
        loose = batch if isinstance(batch, LooseBatch) else LooseBatch.of(batch)
        own = replace(loose, channel=ids[batch.channel])
        clusters = sorted({int(cluster[index]) for index in present})
        if len(clusters) == 1:
            self._fill(clusters[0], own, seq)
        else:
            cluster_of = cluster[batch.channel]
            for key in clusters:
                rows = np.flatnonzero(cluster_of == key)
                self._fill(key, own.take(rows), seq[rows])
        self.messages += len(batch)
        self.payload_bytes += batch.payload_bytes
        self._limit_queue(limit=4)

    def declare(self, channel: Channel) -> None:
        """Store a channel even if it has no message."""
        if channel not in self._known:
            self._meet(channel, 0)

    def add_extra(self, record: Metadata | Attachment) -> None:
        """Store an attachment or a metadata record of the source."""
        self._extras.append(record)
        self._storing.append(self._disk.submit(self._add, record))
        self._limit_queue(limit=0)

    def flush(self) -> None:
        """Close and write every open chunk."""
        for key in list(self._clusters):
            self._close_chunk(key)
        self._drain(limit=0)

    def flush_older(self, seconds: float, *, most: int | None = None) -> None:
        """Close chunks of at least this age, then large ones; write packed chunks.

        `most` bytes may remain in open chunks; None for any number.
        """
        limit = time.monotonic() - seconds
        for key, chunk in [*self._clusters.items()]:
            if chunk.opened <= limit:
                self._close_chunk(key)
        if most is not None:
            left = sum(chunk.size for chunk in self._clusters.values())
            for key, chunk in sorted(self._clusters.items(), key=lambda one: -one[1].size):
                if left <= most:
                    break
                left -= chunk.size
                self._close_chunk(key)
        self._limit_queue(limit=4)

    def close(self) -> list[Path]:
        """Flush and seal the last group; return the paths of all segments."""
        try:
            self.flush()
            for record in [*self._extras]:  # for which there was no room
                self._disk.submit(self._add, record).result()
            rest = [number for number in self.channels if not self.written[number]]
            self._disk.submit(lambda: self._define(self._first(), rest)).result()
            self._disk.submit(self._seal).result()
        finally:
            self._shut_down()
        return self._closed

    def close_truncated(self, extras: Sequence[Metadata]) -> None:
        """Seal the chunks in the file and drop the others, after a failed write.

        `DiskFullError` if no message is in the files, or there is no room: the next opening of the
        store seals the segment.
        """
        self._shut_down()
        if not self.written.total():
            raise DiskFullError("No space left for any message. Free some, and record again.")
        if self._first().is_complete:
            self._seal()
        first = self._first()
        kept = [one for one in self._extras if isinstance(one, Metadata)]  # such as losses
        for extra in (*kept, *extras):
            first.add_metadata(extra)
        self.has_extras = True
        self._seal()

    def written_of(self, channel: Channel) -> int:
        """Number of messages of a channel in the files."""
        return self.written[self._known.get(channel, (0, 0))[0]]

    def last_time_of(self, channel: Channel) -> int | None:
        """Log time of the last message of a channel in the files, ns; None without any."""
        return self._last_times.get(self._known.get(channel, (0, 0))[0])

    def abort(self) -> None:
        """Stop at once; sealed segments and flushed chunks stay."""
        self._broken = self._broken or StoreError("The recording was stopped.")
        self._shut_down()
        for segment in self._segments.values():
            segment.abandon()
        self._segments.clear()

    def _shut_down(self) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)
        self._disk.shutdown(wait=True, cancel_futures=True)

    def _meet(self, channel: Channel, mean: float) -> tuple[int, int]:
        """Register a new channel: its id and, from its mean payload size, its cluster."""
        if len(self._known) >= MAX_CHANNELS:
            raise StoreError(f"more than {MAX_CHANNELS} channels in one recording")
        if channel.schema is not None:
            self._schema_ids.setdefault(channel.schema, len(self._schema_ids) + 1)
        channel_id = len(self._known) + 1
        is_latched = self._is_latched(channel)
        is_alone = mean >= self.settings.large_payload or self._division.is_named(channel.topic)
        cluster = channel_id if is_alone else _SHARED
        self._keys[channel_id] = None if is_alone and not is_latched else FIRST
        if is_latched and self._latched_apart:
            cluster, self._keys[channel_id] = _LATCHED, LATCHED
        known = self._known[channel] = channel_id, cluster
        if channel.is_indexed and self._no_index(channel.topic):
            channel = replace(channel, is_indexed=False)
        self.channels[channel_id] = channel
        return known

    def _fill(self, key: int, batch: LooseBatch, seq: NDArray[np.int64]) -> None:
        """Append messages to a cluster's chunk, closing chunks at their bounds."""
        sizes = np.cumsum(batch.length + MESSAGE_HEAD.itemsize)
        start, total, capacity = 0, len(batch), self.settings.chunk_size
        while start < total:
            chunk = self._clusters.get(key)
            held = 0 if chunk is None else chunk.size
            before = int(sizes[start - 1]) if start else 0
            end = int(np.searchsorted(sizes, before + capacity - held, side="right"))
            if chunk is None:
                chunk = self._clusters[key] = OpenChunk(int(batch.log_time[start]))
                end = max(end, start + 1)  # a message larger than a chunk is a chunk of its own
            if key != _SHARED:
                end = min(end, self._span_end(chunk, batch, start))
            if end > start:
                rows = slice(start, end)
                chunk.append(batch.take(rows), seq[rows])
                start = end
            if start < total or chunk.size >= capacity:
                self._close_chunk(key)

    def _span_end(self, chunk: OpenChunk, batch: LooseBatch, start: int) -> int:
        """First row from `start` on whose log time is too far from the chunk's first."""
        span = self.settings.chunk_span_ns
        away = np.abs(batch.log_time[start:] - chunk.first_log_time)
        if int(away.max()) < span:
            return len(batch)
        sizes = batch.length[start:] + MESSAGE_HEAD.itemsize
        is_small = np.cumsum(sizes) - sizes + chunk.size < self.settings.span_size
        far = away >= span * (1 + (_SMALL_SPANS - 1) * is_small)
        return start + int(far.argmax()) if far.any() else len(batch)

    def _close_chunk(self, key: int) -> None:
        chunk = self._clusters.pop(key)
        self._closed_bytes += chunk.size
        packed = self._pool.submit(self._pack, chunk)
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

    def _pack(self, chunk: OpenChunk) -> PackedChunk:
        batch, seq = chunk.laid_out()
        # Asked now: topics of equal rate close their chunks at the same time.
        return pack(self._compressor, batch, seq, hurried=self._is_behind())

    def _is_behind(self) -> bool:
        """True if too much waits for a live recording's disk."""
        waiting = self._closed_bytes - self.stored_bytes
        return self._on_written is not None and waiting > AT_WORK * self.settings.chunk_size

    # The methods below run on the writing thread only.

    def _store(self, packed: Future[PackedChunk]) -> None:
        """Write a chunk, once it is packed; nothing after a failure."""
        if self._broken is not None:
            return  # the next append raises it
        try:
            self._write(packed.result())
        except BaseException as error:
            self._broken = error
            raise

    def _add(self, record: Metadata | Attachment) -> None:
        if isinstance(record, Metadata):
            self._with_room(partial(self._first().add_metadata, record))
        else:
            self._first().add_attachment(record)
        self._extras.remove(record)
        if isinstance(record, Attachment) and self._is_full():
            self._seal()

    def _define(self, segment: SegmentFile, channel_ids: Sequence[int]) -> None:
        channels = [(number, self.channels[number]) for number in channel_ids]
        segment.define(
            (number, self._schema_ids[channel.schema] if channel.schema else 0, channel)
            for number, channel in channels
        )

    def _write(self, chunk: PackedChunk) -> None:
        number = next(iter(chunk.indexes))
        key = self._keys[number]
        if key is None:
            key = self._division.key(self.channels[number].topic, chunk)
        segment = self._with_room(partial(self._append, chunk, key))
        self._publish(chunk)
        if self.settings.sync == "chunk":
            segment.sync()
        if self._is_full():
            self._seal()

    def _append(self, chunk: PackedChunk, key: Key) -> SegmentFile:
        first = self._first()
        segment = self._segments.get(key) or self._create(key, first.number)
        self._define(segment, [c for c in chunk.indexes if c not in segment.content.channels])
        segment.append_chunk(chunk)
        return segment

    def _with_room(self, do: Callable[[], _Done]) -> _Done:
        """Do what changes nothing when it fails, again when there is room for it."""
        while True:
            try:
                return do()
            except DiskFullError:
                if not self._make_room():
                    raise

    def _publish(self, chunk: PackedChunk) -> None:
        """Report that a chunk is in its segment."""
        rows = chunk.parts[["channel", "messages", "last"]].tolist()
        for channel_id, messages, last in rows:
            self.written[channel_id] += messages
            self._last_times[channel_id] = last
        self.stored_bytes += chunk.size
        if self._on_written is not None:
            self._on_written()

    def _first(self) -> SegmentFile:
        """The first segment of the open group, which is begun if there is none."""
        if not self._segments:
            self._opened = time.monotonic()
        return self._segments.get(FIRST) or self._create(FIRST, None)

    def _create(self, key: Key, group: int | None) -> SegmentFile:
        """Begin a segment of the group with a number; the first one has none yet."""
        segment = self._segments[key] = SegmentFile.create(
            self._directory,
            self._number,
            self._recording,
            group=None if key == LATCHED else group,
            sync=self.settings.sync == "chunk",
        )
        self._number += 1
        return segment

    def _is_full(self) -> bool:
        """True if the group has its size, has lasted for its time, or has too many chunks."""
        size, span_s = self.settings.segment_size, self.settings.segment_span_s
        if span_s is not None and time.monotonic() - self._opened >= span_s:
            return True
        segments = self._segments.values()
        return sum(segment.position for segment in segments) >= size or any(
            one.content.table.chunks >= _MAX_CHUNKS or one.content.table.parts >= _MAX_PARTS
            for one in segments
        )

    def _seal(self) -> None:
        self._first()  # an empty recording has one
        segments, sync = [*self._segments.values()], self.settings.sync != "never"
        # The first one last: until then it takes records.
        prepared = self._with_room(lambda: [one.prepare(sync=sync) for one in reversed(segments)])
        self._on_sealing(prepared[::-1])
        self._closed += [segment.publish(sync=segment is segments[-1]) for segment in segments]
        self.sealed += len(segments)
        self._division.begin()
        self._segments.clear()
