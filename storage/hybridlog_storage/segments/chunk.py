"""Closed chunks: packed for the file, then stored in a segment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hybridlog_storage.checksum import crc32
from hybridlog_storage.mcap.mcap_content import MESSAGE_HEAD
from hybridlog_storage.messages import joined
from hybridlog_storage.segments.chunk_table import parts_of
from hybridlog_storage.segments.segment_format import (
    chunk_head,
    index_order,
    message_indexes,
    pack_arrivals,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from hybridlog_storage.messages import Batch, Buffer
    from hybridlog_storage.segments.compression import Compressor


@dataclass(frozen=True, slots=True)
class PackedChunk:
    """A closed chunk, compressed and indexed, ready for the file.

    Attributes:
        size: Bytes of its content before compression.
        head: The chunk record up to the compressed content.
        data: The compressed content.
        indexes: Message index record of each channel, by channel id.
        arrivals: The arrival numbers, packed.
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
    starts = batch.offset - MESSAGE_HEAD.itemsize
    indexes = message_indexes(batch.channel, batch.log_time, starts, order)
    return PackedChunk(
        size=len(batch.buffer),
        head=head,
        data=data,
        indexes=indexes,
        arrivals=pack_arrivals(seq),
        parts=parts,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredChunk:
    """A chunk stored in a segment, with its content in memory.

    Attributes:
        segment: Number of the segment in its recording.
        number: Number of the chunk in its segment, from 0, in file order.
        offset: Byte of the chunk record in the file.
        length: Bytes of the chunk record.
        trailer: Bytes of the message indexes and arrival numbers that follow it.
        batch: Its messages over the uncompressed content; `channel` holds channel ids.
        seq: int64[n], arrival numbers.
    """

    segment: int
    number: int
    offset: int
    length: int
    trailer: int
    batch: Batch
    seq: NDArray[np.int64]


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
