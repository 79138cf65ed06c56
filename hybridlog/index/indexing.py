"""Makes index documents from chunks, as a pure function.

`documents_of` makes the index disposable: it needs only chunks and their channels.
`record`, recovery, `index rebuild` and `verify` all call it.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hybridlog.schema.codec import Codec, stamps_of
from hybridlog.schema.codecs import codec_for
from hybridlog.schema.column import STAMP
from hybridlog.schema.index_bodies import bodies_of
from hybridlog_storage.catalog import ChannelStats, ChunkEntry
from hybridlog_storage.messages import Batch, Channel
from hybridlog_storage.mongo.index_documents import DocumentAssembler, Origin, Placed
from hybridlog_storage.ordering import run_lengths, run_starts
from hybridlog_storage.segments.chunk import StoredChunk

if TYPE_CHECKING:
    from numpy.typing import NDArray


class Documents(NamedTuple):
    """Index documents of one topic.

    Attributes:
        topic: Their topic.
        tables: uint8[k, width] each, with a whole BSON document in each row.
    """

    topic: str
    tables: list[NDArray[np.uint8]]

    @property
    def size(self) -> int:
        """Bytes of all documents."""
        return sum(table.size for table in self.tables)


class ChunkIndexer:
    """Makes the index documents of one recording's chunks. Thread safe.

    Args:
        recording: Id or key of the recording.
        has_documents: False to make only the chunks' catalog entries.
    """

    def __init__(self, recording: str, *, has_documents: bool = True) -> None:
        self.recording = recording
        self._key = recording[-16:]
        self._has_documents = has_documents
        self._parts: dict[int, tuple[Codec, DocumentAssembler, bool]] = {}
        self._lock = threading.Lock()

    def documents_of(
        self, chunks: Sequence[StoredChunk], channels: Mapping[int, Channel]
    ) -> tuple[list[Documents], list[ChunkEntry]]:
        """Make all index documents of some chunks, and the chunks' catalog entries.

        They equal those of each chunk alone. Several chunks of few messages take little longer
        than one.
        """
        placed = Placed.of(chunks)
        documents: list[Documents] = []
        stats: list[dict[int, ChannelStats]] = [{} for _ in chunks]
        for channel_id, rows in rows_by_channel(placed.batch.channel):
            channel = channels[channel_id]
            codec, assembler, stamped = self._part(channel_id, channel)
            is_indexed = channel.is_indexed and self._has_documents
            batch = placed.batch.take(rows)
            found = _StatsByChunk(
                batch, placed.number[rows], has_publish_time=channel.has_publish_time
            )
            tables: list[NDArray[np.uint8]] = []
            for group in bodies_of(codec, batch):
                if group.stamps is not None:
                    found.stamped(group.rows, group.stamps)
                if group.error is not None:
                    found.unreadable(group.rows)
                if len(group.surplus):
                    found.surplus(group.surplus)
                if is_indexed:
                    row = rows[group.rows]
                    tables.append(assembler.assemble(placed, row, group.body, group.error))
            if stamped:
                _read_stamps(codec, batch, found)
            if is_indexed:
                documents.append(Documents(channel.topic, tables))
            for number, of_chunk in found.by_chunk():
                stats[number][channel_id] = of_chunk
        entries = [
            ChunkEntry(chunk.segment, chunk.number, of_chunk)
            for chunk, of_chunk in zip(chunks, stats, strict=True)
        ]
        return documents, entries

    def prepare(self, channel: Channel) -> None:
        """Compile a channel's definition before its first message."""
        codec_for(channel).paths()

    def reason(self, channel_id: int, channel: Channel) -> str | None:
        """Reason why a channel's fields are not indexed, None if they are."""
        return self._part(channel_id, channel)[0].reason

    def _part(self, channel_id: int, channel: Channel) -> tuple[Codec, DocumentAssembler, bool]:
        with self._lock:
            part = self._parts.get(channel_id)
            if part is None:
                codec = codec_for(channel)
                stamped = any(path.path == STAMP and path.type == "time" for path in codec.paths())
                origin = Origin(self._key, channel.topic, channel.has_publish_time)
                part = self._parts[channel_id] = codec, DocumentAssembler(origin), stamped
            return part


def rows_by_channel(channel: NDArray[np.int32]) -> Iterator[tuple[int, NDArray[np.intp]]]:
    """Channel ids in a chunk, ascending, and the rows of each, in chunk order."""
    if len(channel) and bool((channel == channel[0]).all()):
        yield int(channel[0]), np.arange(len(channel))  # chunks of large messages are small
        return
    order = np.argsort(channel, kind="stable")
    ids = channel[order]
    starts = run_starts(ids).tolist()
    for start, end in zip(starts, [*starts[1:], len(ids)], strict=True):
        yield int(ids[start]), order[start:end]


class _StatsByChunk:
    """Statistics of a channel's messages, for each chunk.

    Args:
        batch: n messages of one channel.
        number: intp[n], index of each message's chunk; ascending.
        has_publish_time: Whether to include publish times.
    """

    def __init__(self, batch: Batch, number: NDArray[np.intp], *, has_publish_time: bool) -> None:
        self._batch = batch
        self._number = number
        self._has_publish_time = has_publish_time
        self._unreadable: list[NDArray[np.intp]] = []
        self._surplus: list[NDArray[np.intp]] = []
        self._stamped: list[NDArray[np.intp]] = []
        self._stamps: list[NDArray[np.int64]] = []

    def stamped(self, rows: NDArray[np.intp], stamps: NDArray[np.int64]) -> None:
        """Add messages with header stamps."""
        if len(rows):
            self._stamped.append(rows)
            self._stamps.append(stamps)

    def without_stamps(self) -> NDArray[np.intp]:
        """The messages of chunks without known header stamps."""
        if not self._stamped:
            return np.arange(len(self._number))
        if self._number[0] == self._number[-1]:
            return np.empty(0, np.intp)
        known = np.zeros(int(self._number[-1]) + 1, np.bool_)
        for rows in self._stamped:
            known[self._number[rows]] = True
        return np.flatnonzero(~known[self._number])

    def unreadable(self, rows: NDArray[np.intp]) -> None:
        """Add unreadable messages."""
        self._unreadable.append(rows)

    def surplus(self, rows: NDArray[np.intp]) -> None:
        """Add messages with bytes left over."""
        self._surplus.append(rows)

    def by_chunk(self) -> Iterator[tuple[int, ChannelStats]]:
        """The chunks with messages, in order, and their statistics."""
        batch, begins = self._batch, run_starts(self._number)
        numbers = self._number[begins].tolist()
        messages = run_lengths(begins, len(batch)).tolist()
        payload_bytes = np.add.reduceat(batch.length, begins).tolist()
        spans = _spans(batch.log_time, begins)
        found = {
            number: ChannelStats(messages=count, payload_bytes=size, first=first, last=last)
            for number, count, size, (first, last) in zip(
                numbers, messages, payload_bytes, spans, strict=True
            )
        }
        if self._has_publish_time:
            spans = _spans(batch.publish_time, begins)
            for stats, (first, last) in zip(found.values(), spans, strict=True):
                stats.first_publish, stats.last_publish = first, last
        for number, count in self._counted(self._unreadable):
            found[number].unreadable = count
        for number, count in self._counted(self._surplus):
            found[number].surplus = count
        if self._stamps:
            self._set_stamps(found)
        return iter(found.items())

    def _counted(self, rows: list[NDArray[np.intp]]) -> Iterator[tuple[int, int]]:
        """Chunks with some of these messages, and how many."""
        if rows:
            counts = np.bincount(self._number[np.concatenate(rows)])
            yield from ((number, count) for number, count in enumerate(counts.tolist()) if count)

    def _set_stamps(self, found: dict[int, ChannelStats]) -> None:
        rows, stamps = np.concatenate(self._stamped), np.concatenate(self._stamps)
        order = np.argsort(rows)
        rows, stamps = rows[order], stamps[order]
        begins = run_starts(self._number[rows])
        numbers = self._number[rows[begins]].tolist()
        counts = run_lengths(begins, len(rows)).tolist()
        for number, count, (first, last) in zip(
            numbers, counts, _spans(stamps, begins), strict=True
        ):
            stats = found[number]
            stats.stamped = stats.unset = count
            stats.first_stamp, stats.last_stamp = first, last
        rows, stamps = rows[stamps != 0], stamps[stamps != 0]
        if not len(rows):
            return
        skew = self._batch.log_time[rows] - stamps
        begins = run_starts(self._number[rows])
        numbers = self._number[rows[begins]].tolist()
        counts = run_lengths(begins, len(rows)).tolist()
        # Integers could overflow.
        sums = np.add.reduceat(skew, begins, dtype=np.float64).tolist()
        for number, count, total, (least, most) in zip(
            numbers, counts, sums, _spans(skew, begins), strict=True
        ):
            stats = found[number]
            stats.unset -= count
            stats.skew_sum = total
            stats.skew_min, stats.skew_max = least, most


def _read_stamps(codec: Codec, batch: Batch, found: _StatsByChunk) -> None:
    """Read header stamps that the index bodies do not provide."""
    rows = found.without_stamps()
    if len(rows):
        left = batch.take(rows)
        stamped, stamps = stamps_of(codec, left)
        if len(stamped):
            found.stamped(rows[stamped], stamps)


def _spans(values: NDArray[np.int64], begins: NDArray[np.intp]) -> Iterator[tuple[int, int]]:
    """Minimum and maximum of each run."""
    least, greatest = np.minimum.reduceat(values, begins), np.maximum.reduceat(values, begins)
    return zip(least.tolist(), greatest.tolist(), strict=True)
