"""Index documents, read back by pymongo's BSON and compared value by value."""

from __future__ import annotations

import struct
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any

import bson
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridlog_storage.messages import Batch, Channel
from hybridlog_storage.mongo.index_documents import (
    DocumentAssembler,
    Placed,
    key_bound,
)
from hybridlog_storage.segments.chunk import StoredChunk

TIMES = st.integers(0, 2**63 - 1)
KEY = "fedcba9876543210"
CHANNEL = Channel("/a topic/ä", "x", None)


def chunk_of(
    times: list[int],
    seq: list[int] | None = None,
    lengths: list[int] | None = None,
    *,
    at: tuple[int, int] = (7, 2**40),
    content: bytes = b"",
) -> StoredChunk:
    count = len(times)
    length = np.array(lengths if lengths is not None else [3] * count, np.int64)
    offset = 31 + np.concatenate([[0], np.cumsum(length + 31)[:-1]]).astype(np.int64)
    batch = Batch(
        content,
        offset,
        length,
        np.zeros(count, np.int32),
        np.array(times, np.int64),
        np.array(times, np.int64) // 2,
        np.zeros(count, np.uint32),
    )
    arrivals = np.array(seq if seq is not None else range(count), np.int64)
    return StoredChunk(
        segment=at[0],
        number=at[1],
        offset=2**41,
        length=100,
        trailer=50,
        batch=batch,
        seq=arrivals,
    )


def documents(data: NDArray[np.uint8]) -> list[dict[str, Any]]:
    assert data.dtype == np.uint8
    raw = [row.tobytes() for row in data]
    for row in raw:
        assert struct.unpack_from("<i", row)[0] == len(row)
    return [bson.decode(row) for row in raw]


def assembled(chunk: StoredChunk, error: str | None = None) -> NDArray[np.uint8]:
    """Documents without fields, of all messages."""
    rows = np.arange(len(chunk.batch))
    nothing = np.empty((len(rows), 0), np.uint8)
    return DocumentAssembler(KEY, CHANNEL).assemble(Placed.of([chunk]), rows, nothing, error)


def body_of(values: list[dict[str, Any]]) -> NDArray[np.uint8]:
    """Elements of documents that are all of one size."""
    rows = [bson.encode(v)[4:-1] for v in values]
    return np.frombuffer(b"".join(rows), np.uint8).reshape(len(rows), -1)


@settings(max_examples=50)
@given(
    st.lists(st.tuples(TIMES, st.integers(0, 2**40), st.integers(0, 2**40)), min_size=1),
    st.booleans(),
)
def test_documents_say_what_the_chunk_says(rows: list[tuple[int, int, int]], publish: bool) -> None:
    chunk = chunk_of([r[0] for r in rows], [r[1] for r in rows], [r[2] for r in rows])
    channel = replace(CHANNEL, has_publish_time=publish)
    chosen = np.arange(0, len(rows), 2)
    body = body_of([{"number": i, "text": "abc"} for i in range(len(chosen))])
    made = documents(DocumentAssembler(KEY, channel).assemble(Placed.of([chunk]), chosen, body))
    assert len(made) == len(chosen)
    for number, (row, document) in enumerate(zip(chosen.tolist(), made, strict=True)):
        time, seq, length = rows[row]
        assert list(document) == ["_id", "number", "text", "_meta"]
        assert document["number"] == number
        meta = document["_meta"]
        inserted = meta.pop("inserted_at")
        day = datetime(1970, 1, 1, tzinfo=UTC)
        if time < 2**62:  # beyond, datetime has no such year
            assert inserted.replace(tzinfo=UTC) == day + timedelta(milliseconds=time // 10**6)
        assert meta.pop("pub", None) == (time // 2 if publish else None)
        assert meta == {
            "t": time,
            "rec": "fedcba9876543210",
            "topic": "/a topic/ä",
            "seq": seq,
            "ref": {"seg": 7, "chunk": 2**40, "off": int(chunk.batch.offset[row]), "len": length},
        }
        assert document["_id"] == struct.pack(">QQQ", time, 0xFEDCBA9876543210, seq)


@given(TIMES, TIMES)
def test_a_bound_parts_the_keys_at_its_time(time: int, bound: int) -> None:
    (made,) = documents(assembled(chunk_of([time])))
    assert (made["_id"] >= key_bound(bound)) == (time >= bound)


@pytest.mark.parametrize("time", [-1, -(2**70), 2**63, 2**80])
def test_bounds_outside_of_all_times(time: int) -> None:
    made = documents(assembled(chunk_of([0, 2**63 - 1])))
    assert all((d["_id"] >= key_bound(time)) == (time < 0) for d in made)


def test_errors_replace_the_fields() -> None:
    assembler = DocumentAssembler(KEY, CHANNEL)
    chunk = chunk_of([1, 2, 3])
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
