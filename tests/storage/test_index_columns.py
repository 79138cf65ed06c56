"""Keys and references out of projected documents, as MongoDB sends them."""

from __future__ import annotations

import bson
import numpy as np
import pytest
from bson.int64 import Int64
from hypothesis import given
from hypothesis import strategies as st

from hybridlog_storage.errors import StoreError
from hybridlog_storage.index_columns import key_columns, reference_columns

whole = st.integers(0, 2**63 - 1)
few = st.integers(0, 1)
references = st.one_of(
    st.tuples(st.integers(0, 2**64 - 1), st.integers(0, 2**31 - 1), whole, whole, whole),
    st.tuples(few, few, few, whole, whole),
)


@given(st.lists(references))
def test_references_are_those_of_the_documents(rows: list[tuple[int, int, int, int, int]]) -> None:
    batch = b"".join(
        bson.encode(
            {
                "_id": b"\0" * 8 + r.to_bytes(8, "big") + b"\0" * 8,
                "_meta": {"ref": {"seg": s, "chunk": Int64(c), "off": Int64(o), "len": Int64(n)}},
            }
        )
        for r, s, c, o, n in rows
    )
    found = reference_columns(batch)
    assert len(found) == len(rows)
    columns = (found.recording, found.segment, found.chunk, found.offset)
    assert list(zip(*(c.tolist() for c in columns), strict=True)) == [r[:4] for r in rows]
    by_chunk: dict[tuple[int, ...], list[int]] = {}
    for row in rows:
        by_chunk.setdefault(row[:3], []).append(row[3])
    assert {place: offsets.tolist() for place, offsets in found.by_chunk()} == by_chunk


@given(st.lists(st.tuples(whole, st.integers(0, 2**64 - 1), whole), max_size=20))
def test_keys_are_those_of_the_documents(rows: list[tuple[int, int, int]]) -> None:
    keys = [t.to_bytes(8, "big") + r.to_bytes(8, "big") + s.to_bytes(8, "big") for t, r, s in rows]
    found = key_columns(b"".join(bson.encode({"_id": key}) for key in keys))
    columns = (found.time, found.recording, found.seq)
    assert list(zip(*(c.tolist() for c in columns), strict=True)) == rows
    assert found.recording.dtype == np.uint64


@pytest.mark.parametrize(
    "document",
    [
        {"_meta": {"ref": {"seg": 1, "chunk": Int64(1), "off": Int64(1)}}},
        {"_meta": {"ref": {"seg": 1, "chunk": Int64(1), "len": Int64(1), "off": Int64(1)}}},
        {"_meta": {"ref": {"seg": 1.0, "chunk": Int64(1), "off": Int64(1), "le": Int64(1)}}},
        {"_id": b"x" * 24},
        {"_id": b"x" * 23},
        {"_id": "x" * 24},
    ],
)
def test_a_strange_document_is_refused(document: dict[str, object]) -> None:
    batch = bson.encode(document)
    if "_id" not in document or document["_id"] != b"x" * 24:
        with pytest.raises(StoreError, match="reindex"):
            key_columns(batch)
    with pytest.raises(StoreError, match="reindex"):
        reference_columns(batch)
