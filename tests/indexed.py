"""Index documents: those of a store, as MongoDB has them, and those of payloads."""

from __future__ import annotations

from typing import Any

import numpy as np

import hybridlog as hl
from hybridlog.schema.codec import Codec
from hybridlog.schema.codecs import bodies_of, document_of
from hybridlog.schema.document import BodyGroup
from hybridlog_storage.messages import Batch
from hybridlog_storage.mongo.index_documents import collection_of

EVERYTHING = {"_meta.seq": {"$gte": 0}}
"""A filter that every document satisfies."""


def documents_of(store: hl.Store, *topics: str) -> list[dict[str, Any]]:
    """The documents of some topics, by time, recording and arrival."""
    database = store.shared.index.database_for("A test")
    found: list[dict[str, Any]] = []
    for topic in topics:
        found += database.find(collection_of(topic))
    return sorted(found, key=lambda one: bytes(one["_id"]))


def batch_of(*payloads: bytes) -> Batch:
    """Messages with some payloads."""
    length = np.array([len(payload) for payload in payloads], np.int64)
    none = np.zeros(len(payloads), np.int64)
    places = b"".join(payloads), np.cumsum(length) - length, length
    return Batch(*places, none.astype(np.int32), none, none, none.astype(np.uint32))


def groups_of(codec: Codec, *payloads: bytes) -> list[BodyGroup]:
    """The bodies of documents of payloads."""
    return [*bodies_of(codec, batch_of(*payloads))]


def index_fields(codec: Codec, payload: bytes) -> dict[str, object]:
    """The fields of a message in its index document; empty without any."""
    return document_of(groups_of(codec, payload)[0].body.tobytes())
