"""Making the columns beside the segments, while a recording is indexed."""

from __future__ import annotations

import errno
import logging
import shutil
import threading
from bisect import bisect, bisect_left, insort
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from itertools import groupby, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hybridlog.columns.stored import LOG_TIME, NAME, ORDERED, RECORDING, SEQ, values_of
from hybridlog.columns.topic import (
    SINGLE_READ,
    Order,
    UnfitError,
    is_small,
    nbytes,
    singles,
    types_of,
)
from hybridlog.indexing import rows_by_channel
from hybridlog.schema.codec import Codec, codec_for
from hybridlog.schema.column import Scalars, Strings, concatenate
from hybridlog_storage.buffers import buffers
from hybridlog_storage.column_file import ColumnFileWriter, Values, part_of, remove

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.column_filter import Single
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.chunk import StoredChunk
    from hybridlog_storage.messages import Buffer, Channel

_ARENA = 2 << 20  # bytes of payloads that are put together to be decoded; caches hold no more
_ENOUGH = 1 << 20  # a chunk of so many is decoded where it is
_ROWS = 1 << 18  # messages that are put together
_PENDING = 16 << 20  # bytes of columns that wait to be laid down: many small blocks cost time
_LEFT = _PENDING // 4  # of the smallest topics, which go on waiting until there is more of them
_PART = 1000  # bytes that a part of a topic takes besides its columns
_RESERVE = 256 << 20  # bytes of the disk that are the segments' alone
_log = logging.getLogger(__name__)

_Place = tuple[int, int]
"""Of a chunk: its segment, and the byte in that."""


class _Held(NamedTuple):
    """Messages that were collected: offsets of payloads, channels, log times, arrival numbers.

    No chunk is missing between those that they are from; `place` is the first one's.
    """

    place: _Place
    offset: NDArray[np.int64]
    length: NDArray[np.int64]
    channel: NDArray[np.int32]
    log_time: NDArray[np.int64]
    seq: NDArray[np.int64]

    @classmethod
    def of(cls, chunk: StoredChunk) -> _Held:
        """All of a chunk's."""
        batch = chunk.batch
        place = chunk.segment, chunk.offset
        return cls(place, batch.offset, batch.length, batch.channel, batch.log_time, chunk.seq)

    def moved(self, by: int) -> _Held:
        """A copy, with payloads that lie so many bytes further on."""
        return _Held(
            self.place,
            self.offset + by,
            self.length.copy(),
            self.channel.copy(),
            self.log_time.copy(),
            self.seq.copy(),
        )

    def take(self, rows: NDArray[np.intp]) -> _Held:
        return _Held(
            self.place,
            self.offset[rows],
            self.length[rows],
            self.channel[rows],
            self.log_time[rows],
            self.seq[rows],
        )


class _Part(NamedTuple):
    """Messages of a topic out of chunks between which none is missing; the first one's place."""

    place: _Place
    order: Order
    fields: dict[str, Single]


class _Run(NamedTuple):
    """Rows of a topic that were laid down together: log times and arrival of first and last."""

    place: _Place
    first: tuple[int, int]
    last: tuple[int, int]
    is_ordered: bool


class _Topic:
    """What is known of a topic; without `types` there is nothing but the order of its messages."""

    def __init__(self, channel: Channel) -> None:
        self.codec: Codec = codec_for(channel)
        self.types = types_of(self.codec) if channel.message_encoding in SINGLE_READ else {}
        self.is_wanted = True
        self.rows = 0
        self.pending = 0
        """Bytes of its columns that were not laid down yet."""
        self._parts: list[_Part] = []
        self._runs: list[_Run] = []  # by their places

    def give_up(self) -> None:
        """Have no columns of it."""
        self.is_wanted = False
        self.types = {}
        self.pending = 0
        self._parts.clear()

    def give_up_fields(self) -> None:
        """Have only the order of its messages: of all of them, or of none."""
        if self.types and self.rows:
            self.give_up()
        self.types = {}

    def meet(self, channel: Channel) -> None:
        """A channel of the topic has messages."""
        if codec_for(channel) is not self.codec:
            self.give_up()

    @property
    def is_ordered(self) -> bool:
        """Whether its rows, by their places, are by log time and arrival."""
        return all(run.is_ordered for run in self._runs) and all(
            run.last < following.first for run, following in pairwise(self._runs)
        )

    def add(self, part: _Part) -> int:
        """More of its messages; returns the bytes of their columns."""
        self._parts.append(part)
        self.rows += len(part.order.seq)
        size = part.order.seq.nbytes * 2 + sum(map(nbytes, part.fields.values())) + _PART
        self.pending += size
        return size

    def take(self, missing: list[_Place]) -> Iterator[tuple[_Place, dict[str, Values]]]:
        """The columns that were not laid down yet: those of each run, and its place.

        Args:
            missing: Places of chunks that are still to come, in order.
        """
        parts, self._parts, self.pending = self._parts, [], 0
        parts.sort(key=lambda part: part.place)
        laid = [run.place for run in self._runs]

        def run_of(part: _Part) -> tuple[int, int]:
            return bisect(missing, part.place), bisect(laid, part.place)

        for _, run in groupby(parts, run_of):
            (place, *_), orders, fields = zip(*run, strict=True)
            order = Order(*(np.concatenate(column) for column in zip(*orders, strict=True)))
            first, last = ((int(order.log_time[n]), int(order.seq[n])) for n in (0, -1))
            insort(self._runs, _Run(place, first, last, order.is_kept))
            columns: dict[str, Values] = {LOG_TIME: order.log_time, SEQ: order.seq}
            for path in self.types:
                columns[path] = values_of(concatenate([part[path] for part in fields]))
            yield place, columns


class FieldGatherer:
    """Collects the order of a recording's messages, and fields of small ones, while it is indexed.

    Payloads are put together until there are enough of them to be decoded by columns. Chunks
    may come in any order, as those do that were let go and read back: what is laid down ends
    where one is missing, so that its columns can have their place in between.

    Where anything does not fit there are no columns of a topic; where anything fails, or the
    disk is nearly full, there are none at all. Neither is a loss: the index has the same.

    Args:
        recording: The recording's directory.
    """

    def __init__(self, recording: Path) -> None:
        self._path = recording / NAME
        self._writer: ColumnFileWriter | None = None
        self._ended = False
        self._pending = 0  # bytes of columns that were not laid down yet
        self._arena: NDArray[np.uint8] | None = None
        self._filled = 0
        self._rows = 0
        self._held: list[_Held] = []
        self._last: _Place = 0, 0  # of all chunks that were taken
        self._begins: list[_Place] = []  # of those that did not follow the one before, in order
        self._missing: list[_Place] = []  # in order
        self._lock = threading.Lock()  # of what is missing
        self._channels: dict[int, Channel] = {}
        self._topics: dict[str, _Topic] = {}

    def expect(self, segment: int, offset: int) -> None:
        """A chunk comes later than those behind it. Thread safe."""
        with self._lock:
            insort(self._missing, (segment, offset))

    def add(self, chunk: StoredChunk, channels: Mapping[int, Channel]) -> None:
        """Take what is in a chunk; its buffer is not needed any more afterwards."""
        if not self._ended:
            with self._harmless():
                self._add(chunk, channels)

    def close(self, entry: RecordingEntry) -> None:
        """Keep the columns of all topics of which no message is missing.

        Args:
            entry: The whole recording.
        """
        with self._harmless():
            self._flush(left=0)
            whole = {
                name: {ORDERED: topic.is_ordered, RECORDING: entry.key}
                for name, topic in self._topics.items()
                if topic.is_wanted and topic.rows == entry.messages_of(name)
            }
            if self._writer is not None:
                self._writer.close(whole)
            else:
                remove(self._path)
        self.discard()

    def discard(self) -> None:
        """Make no columns, or no more."""
        if self._writer is not None:
            self._writer.discard()
        else:
            with suppress(OSError):
                remove(part_of(self._path))  # a crash may have left it
        self._ended = True
        self._writer = None
        self._arena = None
        self._held.clear()
        self._topics.clear()

    @contextmanager
    def _harmless(self) -> Iterator[None]:
        """Whatever goes wrong here, the recording goes on without columns."""
        try:
            yield
        except Exception as error:
            _log.warning("no columns in %s: %s", self._path.parent, error or repr(error))
            self.discard()
            with suppress(OSError):  # those that were there are of other segments
                remove(self._path)

    def _add(self, chunk: StoredChunk, channels: Mapping[int, Channel]) -> None:
        batch, held = chunk.batch, _Held.of(chunk)
        self._channels.update(channels)
        if not self._follows(held.place):
            self._decode()
        if not is_small(batch.payload_bytes, len(batch)):
            for topic, part in self._by_topic(held):
                topic.give_up_fields()
                self._add_order(topic, part)
        else:
            self._collect(held, batch.buffer)
        if self._pending >= _PENDING:
            self._flush(left=_LEFT)

    def _follows(self, place: _Place) -> bool:
        """Whether a chunk comes after the last one: none is missing, or was before, in between."""
        last, self._last = self._last, place
        with self._lock:
            before = bisect_left(self._missing, place)
            if place in self._missing[before : before + 1]:
                del self._missing[before]
            follows = last < place and bisect(self._missing, last) == before
        if follows and bisect(self._begins, last) == bisect(self._begins, place):
            return True
        insort(self._begins, place)
        return False

    def _collect(self, held: _Held, buffer: Buffer) -> None:
        """Put the payloads of a chunk to those that wait to be decoded."""
        rows, begin = len(held.seq), int(held.offset.min())
        size = int((held.offset + held.length).max()) - begin
        if size >= _ENOUGH or self._filled + size > _ARENA or self._rows + rows > _ROWS:
            self._decode()
        data = np.frombuffer(buffer, np.uint8, size, begin)
        # Copies: what is held must not keep the buffers of chunks from being used again.
        self._held.append(held.moved(self._filled - begin))
        if size >= _ENOUGH:
            self._decode(data)
            return
        if self._arena is None:
            self._arena = buffers.take(_ARENA)
        self._arena[self._filled : self._filled + size] = data
        self._filled += size
        self._rows += rows

    def _decode(self, data: NDArray[np.uint8] | None = None) -> None:
        """Make columns of what was collected."""
        if not self._held:
            return
        if data is None:
            assert self._arena is not None
            data = self._arena[: self._filled]
        (place, *_), *columns = zip(*self._held, strict=True)
        held = _Held(place, *map(np.concatenate, columns))
        self._held.clear()
        self._filled = self._rows = 0
        for topic, part in self._by_topic(held):
            if topic.types:
                self._read(topic, part, data)
            else:
                self._add_order(topic, part)

    def _by_topic(self, held: _Held) -> Iterator[tuple[_Topic, _Held]]:
        """Messages, those of each topic by themselves."""
        first = int(held.channel[0])
        if bool((held.channel == first).all()):
            # A copy, as below: columns of a chunk may lie in a buffer that is used again.
            yield self._topic_of(first), held.moved(0)
            return
        by_channel = self._topics_of(held.channel)
        topics = list(dict.fromkeys(by_channel.values()))
        table = np.zeros(int(held.channel.max()) + 1, np.int32)
        table[list(by_channel)] = [topics.index(topic) for topic in by_channel.values()]
        for number, rows in rows_by_channel(table[held.channel]):
            yield topics[number], held.take(rows)

    def _topics_of(self, channel: NDArray[np.int32]) -> dict[int, _Topic]:
        """The topics of messages, by the ids of their channels."""
        numbers = np.flatnonzero(np.bincount(channel)).tolist()
        return {number: self._topic_of(number) for number in numbers}

    def _topic_of(self, number: int) -> _Topic:
        """The topic of a channel, which has messages."""
        channel = self._channels[number]
        topic = self._topics.get(channel.topic)
        if topic is None:
            topic = self._topics[channel.topic] = _Topic(channel)
        topic.meet(channel)
        return topic

    def _read(self, topic: _Topic, held: _Held, data: NDArray[np.uint8]) -> None:
        decoded = topic.codec.columns(data.data, held.offset, held.length, topic.types.keys())
        try:
            if decoded.unreadable:
                raise UnfitError
            fields = singles(decoded.records, topic.types)
        except UnfitError:
            topic.give_up()
            return
        self._lay(topic, held, {path: _apart(column, data) for path, column in fields.items()})

    def _add_order(self, topic: _Topic, held: _Held) -> None:
        if topic.is_wanted:
            self._lay(topic, held, {})

    def _lay(self, topic: _Topic, held: _Held, fields: dict[str, Single]) -> None:
        self._pending += topic.add(_Part(held.place, Order(held.log_time, held.seq), fields))

    def _flush(self, *, left: int) -> None:
        """Lay down what was collected, the largest topics first, but for so many bytes."""
        self._decode()
        with self._lock:
            missing = self._missing.copy()
        self._pending = sum(topic.pending for topic in self._topics.values())
        for name, topic in sorted(self._topics.items(), key=lambda item: -item[1].pending):
            if self._pending <= left:
                return
            if shutil.disk_usage(self._path.parent).free < _RESERVE:
                raise OSError(errno.ENOSPC, "the disk is nearly full")
            if self._writer is None:
                self._writer = ColumnFileWriter(self._path)
            self._pending -= topic.pending
            for place, columns in topic.take(missing):
                self._writer.append(name, columns, place)


def _apart(column: Single, data: NDArray[np.uint8]) -> Single:
    """A column that does not lie in the payloads it was read from: they will be others."""
    if isinstance(column, Strings) and np.may_share_memory(column.data, data):
        return Strings(column.data.copy(), column.offset)
    if isinstance(column, Scalars) and np.may_share_memory(column.values, data):
        return Scalars(column.values.copy(), column.kind)
    return column
