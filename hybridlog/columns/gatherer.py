"""Making the columns beside the segments, while a recording is indexed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hybridlog.columns.stored import LOG_TIME, NAME, ORDERED, SEQ, values_of
from hybridlog.columns.topic import SINGLE_READ, Order, UnfitError, is_small, singles, types_of
from hybridlog.schema.codec import Codec, codec_for
from hybridlog_storage.buffers import buffers
from hybridlog_storage.column_file import ColumnFileWriter

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.messages import Channel
    from hybridlog_storage.segment_writer import StoredChunk

_ARENA = 2 << 20  # bytes of payloads that are put together to be decoded; caches hold no more
_ENOUGH = 1 << 20  # a chunk of so many is decoded where it is
_ROWS = 1 << 18  # messages that are put together


class _Held(NamedTuple):
    """Messages that were collected: places of payloads, channels, log times, arrival numbers."""

    offset: NDArray[np.int64]
    length: NDArray[np.int64]
    channel: NDArray[np.int32]
    log_time: NDArray[np.int64]
    seq: NDArray[np.int64]

    def take(self, rows: NDArray[np.intp]) -> _Held:
        return _Held(
            self.offset[rows],
            self.length[rows],
            self.channel[rows],
            self.log_time[rows],
            self.seq[rows],
        )


class _Topic:
    """What is known of a topic; without `types` there are no columns of it."""

    def __init__(self, channel: Channel) -> None:
        self.codec: Codec = codec_for(channel)
        self.types = types_of(self.codec) if channel.message_encoding in SINGLE_READ else {}
        self.rows = 0
        self.is_ordered = True
        self._last = -1, -1

    def meet(self, channel: Channel) -> None:
        """A channel of the topic has messages."""
        if codec_for(channel) is not self.codec:
            self.types = {}

    def add(self, order: Order) -> None:
        """So many more of its messages have columns."""
        self.rows += len(order.seq)
        first = int(order.log_time[0]), int(order.seq[0])
        self.is_ordered = self.is_ordered and self._last < first and order.is_kept
        self._last = int(order.log_time[-1]), int(order.seq[-1])


class FieldGatherer:
    """Collects the fields of a recording's small messages while it is indexed.

    Payloads are put together until there are enough of them to be decoded by columns. Where
    anything does not fit, or there is no room on the disk, there are no columns of it.

    Args:
        recording: The recording's directory.
    """

    def __init__(self, recording: Path) -> None:
        self._path = recording / NAME
        self._writer: ColumnFileWriter | None = None
        self._ended = False
        self._arena: NDArray[np.uint8] | None = None
        self._filled = 0
        self._rows = 0
        self._held: list[_Held] = []
        self._channels: dict[int, Channel] = {}
        self._topics: dict[str, _Topic] = {}

    def add(self, chunk: StoredChunk, channels: Mapping[int, Channel]) -> None:
        """Take what is in a chunk; its buffer is not needed any more afterwards."""
        batch = chunk.batch
        if self._ended or not is_small(batch.payload_bytes, len(batch)):
            return
        self._channels.update(channels)
        begin = int(batch.offset.min())
        size = int((batch.offset + batch.length).max()) - begin
        if size >= _ENOUGH or self._filled + size > _ARENA or self._rows + len(batch) > _ROWS:
            self._decode()
        if self._ended:
            return
        data = np.frombuffer(batch.buffer, np.uint8, size, begin)
        self._held.append(
            # Copies: what is held must not keep the buffers of chunks from being used again.
            _Held(
                batch.offset + (self._filled - begin),
                batch.length.copy(),
                batch.channel.copy(),
                batch.log_time.copy(),
                chunk.seq.copy(),
            )
        )
        if size >= _ENOUGH:
            self._decode(data)
            return
        if self._arena is None:
            self._arena = buffers.take(_ARENA)
        self._arena[self._filled : self._filled + size] = data
        self._filled += size
        self._rows += len(batch)

    def close(self, entry: RecordingEntry) -> None:
        """Keep the columns of all topics of which no message is missing.

        Args:
            entry: The whole recording.
        """
        self._decode()
        whole = {
            name: {ORDERED: topic.is_ordered}
            for name, topic in self._topics.items()
            if topic.types and topic.rows == entry.messages_of(name)
        }
        try:
            if self._writer is not None:
                self._writer.close(whole)
            else:
                self._path.unlink(missing_ok=True)
        except OSError:
            self.discard()
        self._end()

    def discard(self) -> None:
        """Make no columns."""
        if self._writer is not None:
            self._writer.discard()
        self._end()

    def _end(self) -> None:
        self._ended = True
        self._writer = None
        self._arena = None
        self._held.clear()

    def _decode(self, data: NDArray[np.uint8] | None = None) -> None:
        """Make columns of what was collected."""
        if self._ended or not self._held:
            return
        if data is None:
            assert self._arena is not None
            data = self._arena[: self._filled]
        held = _Held(*(np.concatenate(parts) for parts in zip(*self._held, strict=True)))
        self._held.clear()
        self._filled = self._rows = 0
        numbers, names = self._by_topic(held.channel)
        order = np.argsort(numbers, kind="stable")
        bounds = np.searchsorted(numbers[order], np.arange(len(names) + 1)).tolist()
        try:
            for name, begin, end in zip(names, bounds[:-1], bounds[1:], strict=True):
                self._write(name, held.take(order[begin:end]), data.data)
        except OSError:
            self.discard()  # no room: the index has everything

    def _by_topic(self, channel: NDArray[np.int32]) -> tuple[NDArray[np.int32], list[str]]:
        """A number for the topic of each message, and the names of the topics."""
        names: dict[str, int] = {}
        table = np.zeros(int(channel.max()) + 1, np.int32)
        for number in np.flatnonzero(np.bincount(channel)).tolist():
            found = self._channels[number]
            topic = self._topics.setdefault(found.topic, _Topic(found))
            topic.meet(found)
            table[number] = names.setdefault(found.topic, len(names))
        return table[channel], list(names)

    def _write(self, name: str, held: _Held, buffer: memoryview) -> None:
        topic = self._topics[name]
        if not topic.types:
            return
        decoded = topic.codec.columns(buffer, held.offset, held.length, topic.types.keys())
        try:
            if decoded.unreadable:
                raise UnfitError
            fields = singles(decoded.records, topic.types)
        except UnfitError:
            topic.types = {}
            return
        if self._writer is None:
            self._writer = ColumnFileWriter(self._path)
        values = {path: values_of(column) for path, column in fields.items()}
        self._writer.append(name, {LOG_TIME: held.log_time, SEQ: held.seq, **values})
        topic.add(Order(held.log_time, held.seq))
