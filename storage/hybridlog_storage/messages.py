"""Schemas, channels and batches of messages, and the order of their rows.

Messages are handled in batches. A `Batch` is a buffer and a table of numpy columns with
the position of each payload. So copying, indexing and decoding thousands of messages take
a few array operations. Newly arrived messages are a `LooseBatch` until they are copied
into a chunk.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import accumulate
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from msgspec import Struct, field
from msgspec.structs import replace

if TYPE_CHECKING:
    from numpy.typing import NDArray

    T = TypeVar("T", bound=np.generic)


def order_of(*keys: NDArray[Any]) -> NDArray[np.intp] | None:
    """The order of rows by keys, the most significant first; None if they are in order."""
    is_tie = np.ones(max(len(keys[0]) - 1, 0), np.bool_)
    for key in keys:
        if (is_tie & (key[1:] < key[:-1])).any():
            return np.lexsort(keys[::-1])
        is_tie &= key[1:] == key[:-1]
        if not is_tie.any():
            break
    return None


def distinct(values: NDArray[T]) -> NDArray[T]:
    """The distinct values in ascending order: T[n] to T[k].

    Its first call to `numpy.unique` would load masked arrays, which stops a recording for
    15 milliseconds during its first messages.
    """
    ordered = np.sort(values)
    return ordered[run_starts(ordered)]


def run_starts(values: NDArray[Any]) -> NDArray[np.intp]:
    """Start of each run of equal values, intp[k], ascending; of an empty array none.

    For few values this takes a fifth of the time of `np.diff`.
    """
    changes = (values[1:] != values[:-1]).nonzero()[0]
    starts = np.zeros(len(changes) + min(len(values), 1), np.intp)
    np.add(changes, 1, out=starts[1:])
    return starts


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


Buffer = bytes | bytearray | memoryview
"""Contiguous bytes. A memoryview has itemsize 1."""

MAX_CHANNELS = 65535
"""Most channels of a recording; MCAP numbers them with 16 bits, from 1 on."""

MAX_PAYLOAD = (1 << 30) - (1 << 16)
"""Largest payload, bytes: a chunk, with the heads of its records, has to hold it."""

_SLICE_FROM = 2048  # mean payload bytes from which one slice copy per message is cheapest

ORIGINAL_ENCODING = "hybridlog.message_encoding"
"""Metadata key of a reduced channel: the encoding of the dropped payloads."""
REDUCED = "hybridlog.reduced"
"""Message encoding of a channel with reduced messages, whose payload was dropped."""
EXPIRED = "hybridlog.expired"
"""Message encoding of a channel with expired messages, whose payload was deleted."""
NOT_COPIED = "hybridlog.not_copied"
"""The same of messages whose payload is to be copied later."""
EXPIRED_IDS = 1 << 16
"""Added to the id of a channel: the channel of its expired messages; twice this: of those that
were not copied. No file has such ids."""
MARKS_CHANNEL = 3 * EXPIRED_IDS
"""Id of the channel of marks that somebody set: the manifest has them, and no file."""
_ENCODINGS = {1: EXPIRED, 2: NOT_COPIED}


SUPPLIED = "hybridlog.definition"
"""Metadata of a channel whose definition the source lacks: its ROS release, and the proof."""


REPLACED = "hybridlog.definition.replaced"
"""Metadata of such a channel: what the source has in place of a definition, if anything."""


class Schema(Struct, frozen=True):
    """A message definition, unchanged from its source.

    Attributes:
        name: Type name as the source spells it (`sensor_msgs/LaserScan` in ROS 1,
            `sensor_msgs/msg/LaserScan` in ROS 2, `foxglove.Log` in protobuf).
        encoding: MCAP schema encoding: `ros1msg`, `ros2msg`, `ros2idl`, `jsonschema`,
            `protobuf`, ... or empty without a definition.
        data: The definition; text encodings are UTF-8.
    """

    name: str
    encoding: str
    data: bytes


def schema_hash(schema: Schema) -> str:
    """SHA-256 of name, encoding and definition, as hex digits."""
    digest = hashlib.sha256()
    for part in (schema.name.encode(), schema.encoding.encode(), bytes(schema.data)):
        digest.update(len(part).to_bytes(8, "little") + part)
    return digest.hexdigest()


class Channel(Struct, frozen=True, eq=False):
    """One stream of messages of one type on one topic.

    A topic may have several channels (several ROS 1 connections, a type that changes).

    Attributes:
        topic: Its name, as the source spells it.
        message_encoding: MCAP message encoding: `ros1`, `cdr`, `json`, `protobuf`, ...
        schema: The definition, None for a channel without one.
        metadata: MCAP channel metadata of the source, with `SUPPLIED` added (ROS 1 connection
            header fields such as `callerid`, `latching`, `md5sum`; ROS 2
            `offered_qos_profiles`).
        has_publish_time: False if the source has no publish times; `publish_time`
            then repeats `log_time`.
        is_indexed: False if its messages get no documents in MongoDB.
    """

    topic: str
    message_encoding: str
    schema: Schema | None
    metadata: Mapping[str, str] = field(default_factory=dict)
    has_publish_time: bool = True
    is_indexed: bool = True


def left_channel(channel: Channel, encoding: str) -> Channel:
    """The channel of a channel's messages without payload; a reduced one has none to expire."""
    if channel.message_encoding == REDUCED:
        return channel
    metadata = {**channel.metadata, ORIGINAL_ENCODING: channel.message_encoding}
    return replace(channel, message_encoding=encoding, metadata=metadata)


def with_expired(channels: Mapping[int, Channel], ids: Iterable[int]) -> dict[int, Channel]:
    """Channels by id, with those of expired messages among some ids."""
    found = dict(channels)
    for number in ids:
        kind, own = divmod(number, EXPIRED_IDS)
        if kind and own in found:
            found.setdefault(number, left_channel(found[own], _ENCODINGS[kind]))
    return found


class Left(Struct, frozen=True):
    """The rows of messages without payload. All columns have the same length n.

    Attributes:
        parts: Rows of files, struct arrays of all their columns.
        part: int32[n], index in these; -1 of a message that has its payload.
        row: int64[n], row of the part.
        offset: int64[n], byte where each payload starts in its chunk, whether it is there or not.
        length: int64[n], its bytes.
    """

    parts: Sequence[Any]
    part: NDArray[np.int32]
    row: NDArray[np.int64]
    offset: NDArray[np.int64]
    length: NDArray[np.int64]

    def take(self, rows: NDArray[np.intp] | NDArray[np.bool_] | slice) -> Left:
        """Select messages."""
        places = self.row[rows], self.offset[rows], self.length[rows]
        return Left(self.parts, self.part[rows], *places)

    def by_part(self) -> Iterator[tuple[Any, NDArray[np.intp], NDArray[np.int64]]]:
        """Each part, the messages that have their rows there, and these rows."""
        for number in np.unique(self.part[self.part >= 0]).tolist():
            own = np.flatnonzero(self.part == number)
            yield self.parts[number], own, self.row[own]

    @classmethod
    def joined(cls, batches: Sequence[Batch]) -> Left | None:
        """Those of several batches; None if all messages have their payloads."""
        if all(batch.left is None for batch in batches):
            return None
        parts: list[Any] = []
        columns = []
        for batch in batches:
            of = batch.left
            if of is None:
                none = np.full(len(batch), -1, np.int32)
                of = cls((), none, none.astype(np.int64), batch.offset, batch.length)
            part = np.where(of.part < 0, of.part, of.part + np.int32(len(parts)))
            columns.append((part, of.row, of.offset, of.length))
            parts += of.parts
        return cls(parts, *map(np.concatenate, zip(*columns, strict=True)))


class Batch(Struct):
    """Messages whose payloads lie in one buffer. All columns have the same length n.

    Rows are in arrival order. `buffer` must not change while the batch is in use.

    Attributes:
        buffer: The bytes with all payloads.
        offset: int64[n], byte where each payload starts in `buffer`.
        length: int64[n], bytes of each payload; 0 where it is gone.
        channel: int32[n], index of each message's channel in the owner's channel list.
        log_time: int64[n], nanoseconds since the epoch.
        publish_time: int64[n], nanoseconds since the epoch.
        sequence: uint32[n], the sender's sequence number, 0 without one.
        left: The rows of messages whose payloads are gone; None if none is.
    """

    buffer: Buffer
    offset: NDArray[np.int64]
    length: NDArray[np.int64]
    channel: NDArray[np.int32]
    log_time: NDArray[np.int64]
    publish_time: NDArray[np.int64]
    sequence: NDArray[np.uint32]
    left: Left | None = None

    def __len__(self) -> int:
        """Number of messages."""
        return len(self.offset)

    @property
    def places(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Offset and bytes of each payload in its chunk, whether it is still there or not."""
        of = self if self.left is None else self.left
        return of.offset, of.length

    def take(self, rows: NDArray[np.intp] | NDArray[np.bool_] | slice) -> Batch:
        """Select rows, over the same buffer."""
        return Batch(
            self.buffer,
            self.offset[rows],
            self.length[rows],
            self.channel[rows],
            self.log_time[rows],
            self.publish_time[rows],
            self.sequence[rows],
            None if self.left is None else self.left.take(rows),
        )

    def payload(self, row: int) -> memoryview:
        """The payload of one message, without a copy."""
        start = int(self.offset[row])
        return memoryview(self.buffer)[start : start + int(self.length[row])]

    @property
    def payload_bytes(self) -> int:
        """Sum of all payload lengths."""
        return int(self.places[1].sum())


class LooseBatch(Struct):
    """Messages with a separate buffer each, to be joined once. All columns have length n.

    Rows are in arrival order. `payloads` is object[n]; the other columns are as in `Batch`.
    """

    payloads: NDArray[np.object_]
    length: NDArray[np.int64]
    channel: NDArray[np.int32]
    log_time: NDArray[np.int64]
    publish_time: NDArray[np.int64]
    sequence: NDArray[np.uint32]

    def __len__(self) -> int:
        """Number of messages."""
        return len(self.length)

    @classmethod
    def of(cls, batch: Batch) -> LooseBatch:
        """The messages of a batch with copies of their payloads, which may outlast its buffer."""
        source = batch.buffer if isinstance(batch.buffer, bytes) else memoryview(batch.buffer)
        places = zip(batch.offset.tolist(), batch.length.tolist(), strict=True)
        payloads = [bytes(source[start : start + size]) for start, size in places]
        return cls(
            np.fromiter(payloads, np.object_, len(payloads)),
            batch.length,
            batch.channel,
            batch.log_time,
            batch.publish_time,
            batch.sequence,
        )

    def take(self, rows: NDArray[np.intp] | NDArray[np.bool_] | slice) -> LooseBatch:
        """Select rows."""
        return LooseBatch(
            self.payloads[rows],
            self.length[rows],
            self.channel[rows],
            self.log_time[rows],
            self.publish_time[rows],
            self.sequence[rows],
        )

    @property
    def payload_bytes(self) -> int:
        """Sum of all payload lengths."""
        return int(self.length.sum())


def _windows(buffer: Buffer, width: int) -> NDArray[np.void]:
    """A view of every run of `width` bytes of a buffer, by start offset."""
    return np.ndarray(
        (max(len(buffer) - width + 1, 0),), dtype=f"V{width}", buffer=buffer, strides=(1,)
    )


def _copy_payloads(batch: Batch, target: bytearray, starts: NDArray[np.int64]) -> None:
    """Copy each payload of a batch to its position in a large enough buffer."""
    if batch.payload_bytes >= _SLICE_FROM * len(batch):
        # numpy copies between arrays without the interpreter lock.
        source = np.frombuffer(batch.buffer, np.uint8)
        view = np.frombuffer(target, np.uint8)
        for to, at, size in zip(
            starts.tolist(), batch.offset.tolist(), batch.length.tolist(), strict=True
        ):
            view[to : to + size] = source[at : at + size]
        return
    lengths = distinct(batch.length)
    for length in lengths[lengths > 0].tolist():
        rows = slice(None) if len(lengths) == 1 else batch.length == length
        places = _windows(target, length)
        places[starts[rows]] = _windows(batch.buffer, length)[batch.offset[rows]]


def joined(batches: Sequence[Batch]) -> Batch:
    """Join batches, at least one, with whole buffers, over a new one; a single one is unchanged."""
    if len(batches) == 1:
        return batches[0]
    starts = accumulate((len(b.buffer) for b in batches), initial=0)
    return Batch(
        b"".join(b.buffer for b in batches),
        np.concatenate([b.offset + at for b, at in zip(batches, starts, strict=False)]),
        np.concatenate([b.length for b in batches]),
        np.concatenate([b.channel for b in batches]),
        np.concatenate([b.log_time for b in batches]),
        np.concatenate([b.publish_time for b in batches]),
        np.concatenate([b.sequence for b in batches]),
        Left.joined(batches),
    )


def interleave(batches: Sequence[Batch], order: NDArray[np.intp]) -> Batch:
    """Reorder messages over one new buffer: row i is row `order[i]` of the joined batches."""
    length = np.concatenate([b.length for b in batches])[order]
    ends = np.cumsum(length)
    offset = ends - length
    target = bytearray(int(ends[-1]) if len(ends) else 0)
    place = np.empty(len(order), np.int64)
    place[order] = offset
    at = 0
    for batch in batches:
        _copy_payloads(batch, target, place[at : at + len(batch)])
        at += len(batch)
    left = Left.joined(batches)
    return Batch(
        target,
        offset,
        length,
        np.concatenate([b.channel for b in batches])[order],
        np.concatenate([b.log_time for b in batches])[order],
        np.concatenate([b.publish_time for b in batches])[order],
        np.concatenate([b.sequence for b in batches])[order],
        None if left is None else left.take(order),
    )
