"""Chunks: messages wait in an open one, it is packed for the file, then stored in a segment."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from msgspec import Struct

from hybridlog_storage.checksum import crc32
from hybridlog_storage.mcap.mcap_content import MESSAGE_HEAD, Compressor
from hybridlog_storage.messages import Batch, Buffer, LooseBatch, joined
from hybridlog_storage.segments.chunk_table import ChunkPlace, parts_of
from hybridlog_storage.segments.segment_format import (
    chunk_head,
    index_order,
    message_indexes,
    pack_arrivals,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray


_HEAD = MESSAGE_HEAD.itemsize
_LARGE = 1 << 15  # mean bytes of heads and payloads


class OpenChunk:
    """Messages, each in a buffer of its own.

    `opened` is seconds of `time.monotonic`; `size` is the bytes of its content.
    """

    def __init__(self, first_log_time: int) -> None:
        self.first_log_time = first_log_time
        self.opened = time.monotonic()
        self.size = 0
        self._payloads: list[Buffer] = []
        self._batches: list[LooseBatch] = []
        self._seq: list[NDArray[np.int64]] = []

    def append(self, batch: LooseBatch, seq: NDArray[np.int64]) -> None:
        """Append messages with the channel ids of the segment, and their arrival numbers."""
        self.size += batch.payload_bytes + _HEAD * len(batch)
        self._payloads += batch.payloads.tolist()
        batch.payloads = batch.payloads[:0].copy()  # a view keeps the whole array
        self._batches.append(batch)
        self._seq.append(seq)

    def laid_out(self) -> tuple[Batch, NDArray[np.int64]]:
        """The messages over the content of the chunk, and their arrival numbers."""
        length = self._column("length")
        heads = np.empty(len(length), MESSAGE_HEAD)
        heads["opcode"] = int(Opcode.MESSAGE)
        heads["length"] = length + (_HEAD - 9)
        heads["channel"] = channel = self._column("channel")
        heads["log_time"] = log_time = self._column("log_time")
        heads["publish_time"] = publish_time = self._column("publish_time")
        heads["sequence"] = sequence = self._column("sequence")
        parts: list[Buffer] = [b""] * (2 * len(length))
        parts[::2] = heads.view(f"V{_HEAD}").tolist()
        parts[1::2] = self._payloads
        content = _in_one_buffer(parts, self.size)
        offset = np.cumsum(length + _HEAD) - length
        batch = Batch(content, offset, length, channel, log_time, publish_time, sequence)
        return batch, np.concatenate(self._seq)

    def _column(self, name: str) -> NDArray[Any]:
        return np.concatenate([getattr(batch, name) for batch in self._batches])


def _in_one_buffer(parts: list[Buffer], size: int) -> Buffer:
    """The parts in one buffer. Large ones are copied without the interpreter lock."""
    if size < _LARGE * len(parts):
        return b"".join(parts)
    content = np.empty(size, np.uint8)
    at = 0
    for part in parts:
        content[at : at + len(part)] = np.frombuffer(part, np.uint8)
        at += len(part)
    return content.data


class PackedChunk(Struct, frozen=True):
    """A closed chunk, compressed and indexed, ready for the file.

    Attributes:
        size: Bytes of its content before compression.
        head: The chunk record up to the compressed content.
        data: The compressed content.
        indexes: Message index record of each channel, by channel id.
        arrivals: The parts and the arrival numbers, packed.
        parts: `PART`[c], statistics of each channel in the chunk.
    """

    size: int
    head: bytes
    data: Buffer
    indexes: dict[int, bytes]
    arrivals: bytes
    parts: NDArray[np.void]


def pack(
    compressor: Compressor,
    batch: Batch,
    seq: NDArray[np.int64],
    *,
    hurried: bool = False,
) -> PackedChunk:
    """Compress a chunk and build its message indexes and checksums. Runs on a worker thread."""
    compression, data = compressor.compress(batch.buffer, hurried=hurried)
    order = index_order(batch.channel, batch.log_time)
    parts, first, last = parts_of(batch, order)
    head = chunk_head(
        first=first,
        last=last,
        uncompressed_size=len(batch.buffer),
        crc=crc32(batch.buffer),
        compression=compression,
        compressed_size=len(data),
    )
    starts = batch.offset - _HEAD
    indexes = message_indexes(batch.channel, batch.log_time, starts, order)
    return PackedChunk(
        size=len(batch.buffer),
        head=head,
        data=data,
        indexes=indexes,
        arrivals=pack_arrivals(parts, seq),
        parts=parts,
    )


class StoredChunk(Struct, frozen=True):
    """A chunk stored in a segment, with its content in memory.

    Attributes:
        segment: Number of the segment in its recording.
        place: Its position there.
        batch: Its messages over the uncompressed content; `channel` holds channel ids.
        seq: int64[n], arrival numbers.
    """

    segment: int
    place: ChunkPlace
    batch: Batch
    seq: NDArray[np.int64]

    @property
    def number(self) -> int:
        """Number of the chunk in its segment, from 0, in file order."""
        return self.place.number


class Placed(NamedTuple):
    """The messages of some chunks, and their positions.

    Attributes:
        batch: n messages, grouped by chunk; its offsets refer to its buffer.
        seq: int64[n], arrival numbers.
        segment: int32[n], segment of the chunk of each message.
        chunk: int64[n], number of the chunk in the segment.
        offset: int64[n], position of the payload in the chunk's content.
        length: int64[n], its bytes.
    """

    batch: Batch
    seq: NDArray[np.int64]
    segment: NDArray[np.int32]
    chunk: NDArray[np.int64]
    offset: NDArray[np.int64]
    length: NDArray[np.int64]

    @classmethod
    def of(cls, chunks: Sequence[StoredChunk]) -> Placed:
        """All messages of one or more chunks; the contents of several are copied together."""
        batches = [chunk.batch for chunk in chunks]
        number = np.arange(len(chunks)).repeat([len(batch) for batch in batches])
        return cls(
            joined(batches),
            np.concatenate([chunk.seq for chunk in chunks]),
            np.array([chunk.segment for chunk in chunks], np.int32)[number],
            np.array([chunk.number for chunk in chunks], np.int64)[number],
            *map(np.concatenate, zip(*(batch.places for batch in batches), strict=True)),
        )

    def take(self, rows: NDArray[np.intp]) -> Placed:
        """The selected messages."""
        return Placed._make((self.batch.take(rows), *(column[rows] for column in self[1:])))
