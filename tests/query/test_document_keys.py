"""Keys out of projected documents, as MongoDB sends them."""

from __future__ import annotations

import bson
import pytest
from bson.int64 import Int64
from hypothesis import given
from hypothesis import strategies as st

from hybridlog.query.index_reader import keys_of
from hybridlog_storage.errors import StoreError

whole = st.integers(0, 2**63 - 1)


@given(st.lists(st.tuples(whole, st.integers(0, 2**64 - 1), whole), max_size=20))
def test_keys_are_those_of_the_documents(rows: list[tuple[int, int, int]]) -> None:
    keys = [t.to_bytes(8, "big") + r.to_bytes(8, "big") + s.to_bytes(8, "big") for t, r, s in rows]
    found = keys_of(b"".join(bson.encode({"_id": key}) for key in keys))
    assert [tuple(row) for row in found.tolist()] == rows


@pytest.mark.parametrize(
    "document", [{"_meta": {"seq": Int64(1)}}, {"_id": b"x" * 23}, {"_id": "x" * 24}]
)
def test_a_strange_document_is_refused(document: dict[str, object]) -> None:
    with pytest.raises(StoreError, match="index rebuild"):
        keys_of(bson.encode(document))
