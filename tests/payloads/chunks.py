"""Chunks of messages for tests of payload columns, and messages rebuilt from columns."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hybridlog.columns.payload_rows import Piece, Rebuilder, TopicColumns, rows_of
from hybridlog_storage.messages import Batch, Channel
from hybridlog_storage.segments.chunk import StoredChunk
from hybridlog_storage.segments.chunk_builder import ChunkBuilder

BASE = 1_700_000_000_000_000_000


def chunk_of(payloads: Sequence[bytes], *, channels: Sequence[int] | None = None) -> StoredChunk:
    """A chunk with these messages."""
    rows = len(payloads)
    length = np.array([len(payload) for payload in payloads], np.int64)
    times = BASE + np.arange(rows, dtype=np.int64) * 1_000_003
    batch = Batch(
        b"".join(payloads),
        np.cumsum(length) - length,
        length,
        np.array(channels if channels is not None else [1] * rows, np.int32),
        times,
        times + np.arange(rows) % 3 * 7,
        (np.arange(rows) + 2**32 - rows).astype(np.uint32),
    )
    builder = ChunkBuilder(1 << 20)
    builder.append(batch, np.arange(rows, dtype=np.int64))
    packed, seq, _ = builder.take()
    return StoredChunk(
        segment=2, number=5, offset=0, length=0, trailer=0, crc=0, trailer_crc=0,
        batch=packed, seq=seq, compressed_size=0,
    )  # fmt: skip


def piece_of(topic: TopicColumns, chunk: StoredChunk, *, publish: bool = True) -> Piece | None:
    """All messages of a chunk as rows."""
    rows = np.arange(len(chunk.batch))
    return topic.piece(chunk, rows, dict.fromkeys(chunk.batch.channel.tolist(), publish))


def rebuilder_of(topic: TopicColumns, piece: Piece, channel: Channel) -> Rebuilder:
    """What makes messages from such rows."""
    order = [array.path for array in topic.arrays]
    return Rebuilder(channel.message_encoding, order, piece.layout)


def assert_exact(channel: Channel, payloads: Sequence[bytes], *, publish: bool = True) -> Piece:
    """Messages come back from columns exactly, with the heads of their records."""
    chunk, topic = chunk_of(payloads), TopicColumns(channel)
    piece = piece_of(topic, chunk, publish=publish)
    assert piece is not None
    rebuilder = rebuilder_of(topic, piece, channel)
    found = rebuilder.records(*rows_of(piece.table))
    assert found.data.tobytes() == bytes(memoryview(chunk.batch.buffer))
    assert found.place.tolist() == found.offset[:-1].tolist()
    return piece
