"""A chunk between its closing and its place in a segment: packed, then stored."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from hybridlog_storage.checksum import crc32
from hybridlog_storage.mcap_content import MESSAGE_HEAD
from hybridlog_storage.segment_format import message_indexes, pack_arrivals

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from hybridlog_storage.compression import Compressor
    from hybridlog_storage.messages import Batch, Buffer


@dataclass(frozen=True, slots=True)
class PackedChunk:
    """A closed chunk, compressed and indexed, ready for the file."""

    batch: Batch
    seq: NDArray[np.int64]
    first: int
    last: int
    uncompressed_size: int
    crc: int
    compression: str
    data: Buffer
    indexes: dict[int, bytes]
    arrivals: bytes


def pack(
    compressor: Compressor,
    batch: Batch,
    seq: NDArray[np.int64],
    size: int,
    *,
    hurried: bool = False,
) -> PackedChunk:
    """Compress a chunk and build its message indexes; runs on a worker thread."""
    compression, data = compressor.compress(batch.buffer, hurried=hurried)
    return PackedChunk(
        batch,
        seq,
        int(batch.log_time.min()),
        int(batch.log_time.max()),
        size,
        crc32(batch.buffer),
        compression,
        data,
        message_indexes(batch.channel, batch.log_time, batch.offset - MESSAGE_HEAD.itemsize),
        pack_arrivals(seq),
    )


@dataclass(frozen=True, slots=True)
class StoredChunk:
    """A chunk that lies in a segment, with its content at hand.

    Attributes:
        segment: Number of the segment in its recording.
        offset: Byte of the chunk record in the file.
        length: Bytes of the chunk record.
        trailer: Bytes of the message indexes and arrival numbers that follow it.
        batch: Its messages over the uncompressed content; `channel` holds channel ids.
        seq: int64[n], arrival numbers.
        compressed_size: Bytes of compressed content.
    """

    segment: int
    offset: int
    length: int
    trailer: int
    batch: Batch
    seq: NDArray[np.int64]
    compressed_size: int
