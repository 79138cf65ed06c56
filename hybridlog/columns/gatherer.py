"""Making the columns beside the segments, while a recording is indexed."""

from __future__ import annotations

import errno
import logging
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
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
from hybridlog_storage.column_file import ColumnFileWriter, Values, part_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.column_filter import Single
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.messages import Channel
    from hybridlog_storage.segment_writer import StoredChunk

_ARENA = 2 << 20  # bytes of payloads that are put together to be decoded; caches hold no more
_ENOUGH = 1 << 20  # a chunk of so many is decoded where it is
_ROWS = 1 << 18  # messages that are put together
_PENDING = 16 << 20  # bytes of columns that are laid down together: many small blocks cost memory
_PART = 1000  # bytes that a part of a topic takes besides its columns
_RESERVE = 256 << 20  # bytes of the disk that are the segments' alone
_log = logging.getLogger(__name__)

_Place = tuple[int, int]
"""Of a chunk: its segment, and the byte in that."""


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


@dataclass(slots=True)
class _Stretch:
    """Chunks that lie one after the other: the place of the first, and where the last ends."""

    begin: _Place
    end: _Place


class _Part(NamedTuple):
    """Messages of a topic out of a stretch."""

    stretch: _Stretch
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
        self.pending: list[_Part] = []
        self._runs: list[_Run] = []

    def give_up(self) -> None:
        """Have no columns of it."""
        self.is_wanted = False
        self.types = {}
        self.pending.clear()

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
        runs = sorted(self._runs)
        return all(run.is_ordered for run in runs) and all(
            run.last < following.first for run, following in pairwise(runs)
        )

    def add(self, part: _Part) -> None:
        """More of its messages."""
        self.pending.append(part)
        self.rows += len(part.order.seq)

    def take(self, run_of: Mapping[_Place, _Place]) -> Iterator[tuple[_Place, dict[str, Values]]]:
        """The columns that were not laid down yet, each run's, and the place of the run.

        Args:
            run_of: Place of the run to which a stretch belongs, by where that begins.
        """
        parts, self.pending = self.pending, []
        parts.sort(key=lambda part: part.stretch.begin)
        for place, run in groupby(parts, lambda part: run_of[part.stretch.begin]):
            _, orders, fields = zip(*run, strict=True)
            order = Order(*(np.concatenate(column) for column in zip(*orders, strict=True)))
            first, last = ((int(order.log_time[n]), int(order.seq[n])) for n in (0, -1))
            self._runs.append(_Run(place, first, last, order.is_kept))
            columns: dict[str, Values] = {LOG_TIME: order.log_time, SEQ: order.seq}
            for path in self.types:
                columns[path] = values_of(concatenate([part[path] for part in fields]))
            yield place, columns


class FieldGatherer:
    """Collects the order of a recording's messages, and fields of small ones, while it is indexed.

    Payloads are put together until there are enough of them to be decoded by columns. Chunks
    may come in any order, as those do that were let go and read back: what is laid down ends
    where one is missing, so that its columns can have their place in between. Where anything
    does not fit there are no columns of a topic; where anything fails, or the disk
    is nearly full, there are none at all. Neither is a loss: the index has the same.

    Args:
        recording: The recording's directory.
    """

    def __init__(self, recording: Path) -> None:
        self._path = recording / NAME
        self._writer: ColumnFileWriter | None = None
        self._ended = False
        self._pending = 0
        self._arena: NDArray[np.uint8] | None = None
        self._filled = 0
        self._rows = 0
        self._held: list[_Held] = []
        self._stretch: _Stretch | None = None  # that of the last chunk
        self._stretches: list[_Stretch] = []  # of which something was not laid down yet
        self._channels: dict[int, Channel] = {}
        self._topics: dict[str, _Topic] = {}

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
            self._flush()
            whole = {
                name: {ORDERED: topic.is_ordered, RECORDING: entry.key}
                for name, topic in self._topics.items()
                if topic.is_wanted and topic.rows == entry.messages_of(name)
            }
            if self._writer is not None:
                self._writer.close(whole)
            else:
                self._path.unlink(missing_ok=True)
        self.discard()

    def discard(self) -> None:
        """Make no columns, or no more."""
        if self._writer is not None:
            self._writer.discard()
        else:
            with suppress(OSError):
                part_of(self._path).unlink()  # a crash may have left it
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

    def _add(self, chunk: StoredChunk, channels: Mapping[int, Channel]) -> None:
        batch = chunk.batch
        self._channels.update(channels)
        self._place(chunk)
        if not is_small(batch.payload_bytes, len(batch)):
            whole = _Held(batch.offset, batch.length, batch.channel, batch.log_time, chunk.seq)
            for topic, held in self._by_topic(whole):
                topic.give_up_fields()
                self._add_order(topic, held)
        else:
            self._collect(chunk)
        if self._pending >= _PENDING:
            self._flush()

    def _place(self, chunk: StoredChunk) -> None:
        """Find out whether a chunk follows the last one; else what is put together ends here."""
        begin, size = (chunk.segment, chunk.offset), chunk.length + chunk.trailer
        end = chunk.segment, chunk.offset + size
        if self._stretch is not None and self._stretch.end == begin:
            self._stretch.end = end
            return
        self._decode()
        self._stretch = _Stretch(begin, end)
        self._stretches.append(self._stretch)

    def _collect(self, chunk: StoredChunk) -> None:
        """Put the payloads of a chunk to those that wait to be decoded."""
        batch = chunk.batch
        begin = int(batch.offset.min())
        size = int((batch.offset + batch.length).max()) - begin
        if size >= _ENOUGH or self._filled + size > _ARENA or self._rows + len(batch) > _ROWS:
            self._decode()
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

    def _decode(self, data: NDArray[np.uint8] | None = None) -> None:
        """Make columns of what was collected."""
        if not self._held:
            return
        if data is None:
            assert self._arena is not None
            data = self._arena[: self._filled]
        held = _Held(*(np.concatenate(parts) for parts in zip(*self._held, strict=True)))
        self._held.clear()
        self._filled = self._rows = 0
        for topic, part in self._by_topic(held):
            if topic.types:
                self._read(topic, part, data)
            else:
                self._add_order(topic, part)

    def _by_topic(self, held: _Held) -> Iterator[tuple[_Topic, _Held]]:
        """Messages, those of each topic by themselves."""
        by_channel = self._topics_of(held.channel)
        topics = list(dict.fromkeys(by_channel.values()))
        table = np.zeros(int(held.channel.max()) + 1, np.int32)
        table[list(by_channel)] = [topics.index(topic) for topic in by_channel.values()]
        for number, rows in rows_by_channel(table[held.channel]):
            yield topics[number], held.take(rows)

    def _topics_of(self, channel: NDArray[np.int32]) -> dict[int, _Topic]:
        """The topics of messages, by the ids of their channels."""
        found: dict[int, _Topic] = {}
        for number in np.flatnonzero(np.bincount(channel)).tolist():
            of = self._channels[number]
            if of.topic not in self._topics:
                self._topics[of.topic] = _Topic(of)
            found[number] = self._topics[of.topic]
            found[number].meet(of)
        return found

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
        assert self._stretch is not None
        topic.add(_Part(self._stretch, Order(held.log_time, held.seq), fields))
        self._pending += held.seq.nbytes * 2 + sum(map(nbytes, fields.values())) + _PART

    def _flush(self) -> None:
        """Lay down all that was collected."""
        self._decode()
        self._pending = 0
        run_of = _runs(self._stretches)
        self._stretch = None
        self._stretches.clear()
        waiting = [(name, topic) for name, topic in self._topics.items() if topic.pending]
        if not waiting:
            return
        if shutil.disk_usage(self._path.parent).free < _RESERVE:
            raise OSError(errno.ENOSPC, "the disk is nearly full")
        if self._writer is None:
            self._writer = ColumnFileWriter(self._path)
        for name, topic in waiting:
            for place, columns in topic.take(run_of):
                self._writer.append(name, columns, place)


def _runs(stretches: Iterable[_Stretch]) -> dict[_Place, _Place]:
    """Where the run begins to which each stretch belongs: no chunk is missing between its own."""
    found: dict[_Place, _Place] = {}
    last: _Stretch | None = None
    for stretch in sorted(stretches, key=lambda one: one.begin):
        if last is not None and last.end == stretch.begin:
            found[stretch.begin] = found[last.begin]
        else:
            found[stretch.begin] = stretch.begin
        last = stretch
    return found


def _apart(column: Single, data: NDArray[np.uint8]) -> Single:
    """A column that does not lie in the payloads it was read from: they will be others."""
    if isinstance(column, Strings) and np.may_share_memory(column.data, data):
        return Strings(column.data.copy(), column.offset)
    if isinstance(column, Scalars) and np.may_share_memory(column.values, data):
        return Scalars(column.values.copy(), column.kind)
    return column
