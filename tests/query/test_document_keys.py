"""Keys out of projected documents, as MongoDB sends them."""

from __future__ import annotations

import bson
import pytest
from bson.int64 import Int64

from hybridlog.query.index_reader import keys_of
from hybridlog_storage.errors import StoreError


@pytest.mark.parametrize(
    "document", [{"_meta": {"seq": Int64(1)}}, {"_id": b"x" * 23}, {"_id": "x" * 24}]
)
def test_a_strange_document_is_refused(document: dict[str, object]) -> None:
    with pytest.raises(StoreError, match="index rebuild"):
        keys_of(bson.encode(document))
