"""The index documents of a store, as MongoDB has them."""

from __future__ import annotations

from typing import Any

import hybridlog as hl
from hybridlog_storage.mongo.index_documents import KEY_BYTES

EVERYTHING = {"_meta.seq": {"$gte": 0}}
"""A filter that every document satisfies."""


def documents_of(store: hl.Store, *topics: str) -> list[dict[str, Any]]:
    """The documents of some topics, by time, recording and arrival."""
    database = store.shared.index.database_for("A test")
    found: list[dict[str, Any]] = []
    for topic in topics:
        place = store.index.place(topic)
        found += database.find(place.collection, place.documents(), sort=[("_id", 1)])
    return sorted(found, key=lambda one: bytes(one["_id"][-KEY_BYTES:]))
