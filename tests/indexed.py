"""Index documents: those of a store, as MongoDB has them, and those of payloads."""

from __future__ import annotations

import struct
from collections import Counter, defaultdict
from typing import Any

import numpy as np
from bson import encode

import hybridlog as hl
from hybridlog.index.access import again_if_lost
from hybridlog.schema.codec import Codec
from hybridlog.schema.codecs import bodies_of, document_of
from hybridlog.schema.document import BodyGroup
from hybridlog_storage.messages import Batch
from hybridlog_storage.mongo.index_documents import IndexState, collection_of

EVERYTHING = {"_meta.seq": {"$gte": 0}}
"""A filter that every document satisfies."""


def documents_of(store: hl.Store, *topics: str) -> list[dict[str, Any]]:
    """The documents of some topics, by time, recording and arrival."""
    database = store.shared.index.database_for("A test")
    found: list[dict[str, Any]] = []
    for topic in topics:
        found += database.find(collection_of(topic))
    return sorted(found, key=lambda one: bytes(one["_id"]))


@again_if_lost
def misindexed(store: hl.Store) -> dict[str, int]:
    """How many documents lack, are of no message, or say something else, by topic and recording.

    MongoDB is asked as it is: an index that is behind is not brought up to date. The fields of some
    messages are compared.
    """
    wanted: defaultdict[str, dict[bytes, dict[str, object] | None]] = defaultdict(dict)
    for entry in store.recordings():
        topics = sorted({channel.topic for channel in entry.channels if channel.is_indexed})
        for count, message in enumerate(store.query(topics, [entry.id]) if topics else ()):
            key = struct.pack(">QQQ", message.log_time_ns, int(entry.key, 16), message.seq)
            fields = None if count % 97 else message.fields
            wanted[collection_of(message.topic)][key] = fields
    connected, wrong = store.shared.index.connect(brings=False), Counter[str]()
    there, database = IndexState(connected).document_collections(), connected._database
    for name in sorted(wanted.keys() | {*there}):
        found = {bytes(one.pop("_id")): one for one in database[name].find()}
        for key in found.keys() | wanted[name].keys():
            document, recording = found.get(key, {}), key[8:16].hex()
            is_its_own = document.pop("_meta", {}).get("rec") == recording
            fields = wanted[name].get(key)
            is_same = fields is None or encode(fields) == encode(document)
            if key not in wanted[name] or not is_its_own or not is_same:
                wrong[f"{name} of {recording}"] += 1
    return dict(wrong)


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
