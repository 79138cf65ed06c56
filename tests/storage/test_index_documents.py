"""Index documents, read back by pymongo's BSON and compared value by value."""

from __future__ import annotations

import struct
from typing import Any

import bson
import numpy as np
from numpy.typing import NDArray

from hybridlog_storage.messages import Batch, Channel
from hybridlog_storage.mongo.index_documents import DocumentAssembler
from hybridlog_storage.segments.chunk import Placed, StoredChunk
from hybridlog_storage.segments.chunk_table import ChunkPlace

KEY = "fedcba9876543210"
CHANNEL = Channel("/a topic/ä", "x", None)


def chunk_of(count: int) -> StoredChunk:
    """A chunk of messages of three bytes."""
    numbers = np.arange(count)
    none = np.zeros(count, np.int32)
    batch = Batch(b"", numbers * 34, np.full(count, 3), none, numbers, numbers, none)
    place = ChunkPlace(
        number=5, offset=2**41, length=100, trailer=50, first=0, last=0, channels=(1,)
    )
    return StoredChunk(7, place, batch, numbers)


def documents(data: NDArray[np.uint8]) -> list[dict[str, Any]]:
    assert data.dtype == np.uint8
    raw = [row.tobytes() for row in data]
    for row in raw:
        assert struct.unpack_from("<i", row)[0] == len(row)
    return [bson.decode(row) for row in raw]


def test_errors_replace_the_fields() -> None:
    assembler = DocumentAssembler(KEY, CHANNEL)
    chunk = chunk_of(3)
    none = np.empty((3, 0), np.uint8)
    for error in ("short", "ü" * 3000, "\udc80 half", "short"):
        for document in documents(
            assembler.assemble(Placed.of([chunk]), np.arange(3), none, error)
        ):
            assert list(document) == ["_id", "_meta"]
            said = document["_meta"]["error"]
            assert said[:5] == error.encode("utf-8", "replace").decode()[:5]
            assert len(said) <= 1000
    # Many different errors do not mix, nor does one stay in documents without.
    for number in range(600):
        (made, *_) = documents(
            assembler.assemble(Placed.of([chunk]), np.arange(3), none, f"e{number}")
        )
        assert made["_meta"]["error"] == f"e{number}"
    assert (
        "error"
        not in documents(assembler.assemble(Placed.of([chunk]), np.arange(3), none))[0]["_meta"]
    )
