"""Keys out of projected documents, as MongoDB sends them."""

from __future__ import annotations

import bson
import numpy as np
import pytest
from bson.int64 import Int64
from hypothesis import given
from hypothesis import strategies as st

from hybridlog_storage.errors import StoreError
from hybridlog_storage.mongo.index_columns import key_columns

whole = st.integers(0, 2**63 - 1)


@given(st.lists(st.tuples(whole, st.integers(0, 2**64 - 1), whole), max_size=20))
def test_keys_are_those_of_the_documents(rows: list[tuple[int, int, int]]) -> None:
    keys = [t.to_bytes(8, "big") + r.to_bytes(8, "big") + s.to_bytes(8, "big") for t, r, s in rows]
    found = key_columns(b"".join(bson.encode({"_id": key}) for key in keys))
    columns = (found.time, found.recording, found.seq)
    assert list(zip(*(c.tolist() for c in columns), strict=True)) == rows
    assert found.recording.dtype == np.uint64


@pytest.mark.parametrize(
    "document", [{"_meta": {"seq": Int64(1)}}, {"_id": b"x" * 23}, {"_id": "x" * 24}]
)
def test_a_strange_document_is_refused(document: dict[str, object]) -> None:
    with pytest.raises(StoreError, match="index rebuild"):
        key_columns(bson.encode(document))
