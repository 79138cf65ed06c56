"""The index documents of a store, as MongoDB has them."""

from __future__ import annotations

from typing import Any

import hybridlog as hl
from hybridlog_storage.mongo.collection_names import collection_of

EVERYTHING = {"_meta.seq": {"$gte": 0}}
"""A filter that every document satisfies."""


def documents_of(store: hl.Store, *topics: str) -> list[dict[str, Any]]:
    """The documents of some topics, by time, recording and arrival."""
    database = store.shared.index.database_for("A test")
    found: list[dict[str, Any]] = []
    for topic in topics:
        found += database.find(collection_of(topic))
    return sorted(found, key=lambda one: bytes(one["_id"]))
