"""Asks MongoDB for the messages that a filter finds, in the index as it is."""

from __future__ import annotations

import struct
from collections import defaultdict
from collections.abc import Iterable, Sequence
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from msgspec.structs import replace

from hybridlog.index.access import again_if_lost
from hybridlog.query.predicate.mongo_filter import misjudged
from hybridlog.query.predicate.tree import And, Condition, Field, MongoFilter, Predicate
from hybridlog.query.question import Counters, Part, field_types
from hybridlog.record.marks import MARKS
from hybridlog_storage.errors import StoreError, TopicError, WhereError
from hybridlog_storage.mongo.index_documents import KEY_BYTES, IndexState, between, collection_of
from hybridlog_storage.stopping import check_wanted
from hybridlog_storage.times import END

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.session import Session
    from hybridlog_storage.mongo.database import Database

_SEQ = Field(("_meta", "seq"))
_KEY = np.dtype([("head", "V14"), ("key", ">u8", 3), ("end", "u1")])
"""A document that has only its `_id`."""
_HEAD = np.void(struct.pack("<i5siB", _KEY.itemsize, b"\x05_id", KEY_BYTES, 0))
Filter = dict[str, object]
_READABLE: Filter = {"_meta.error": {"$exists": False}}
_WITHOUT_FIELDS: Filter = {"_meta.error": {"$exists": True}}
_TOO_LARGE: Filter = {"_meta.error": {"$regex": "take more than [0-9]+ MiB$"}}
"""Documents whose message has fields, but too large ones for a document."""
Query = tuple[str, Filter]
"""A collection and a filter."""


@again_if_lost
def decided(
    session: Session, parts: Sequence[Part], counters: Counters
) -> tuple[list[Part], dict[Part, int]]:
    """The parts with arrival numbers in place of filters, and documents as of `documents`.

    Messages that the filters cannot test, since their documents have no fields, are counted.
    """
    database, predicate = _database(session, parts), _predicate(parts[0])
    asks_fields = any(node.asks_fields for node in predicate.filters)
    own: list[Filter] = [node.to_filter() for node in predicate.filters]
    _check_arrays(database, parts, predicate.filters)
    everything: Filter = {"$and": [*own, _READABLE] if asks_fields else own}
    numbers = _numbers(database, parts, everything, counters)
    found = [
        replace(part, predicate=_decided(_predicate(part), numbers[part.recording.key]))
        for part in parts
    ]
    if asks_fields:
        lacking = [part for part in parts if _lacks_fields(part)]
        # What is read for the rest of the predicate is counted there.
        unknown = _TOO_LARGE if _predicate(found[0]).asks_fields else _WITHOUT_FIELDS
        counters.unreadable += sum(_counts(database, lacking, unknown).values())
    # Counted last: what another process has removed meanwhile is told as lacking.
    return found, _documents(database, parts)


@again_if_lost
def documents(session: Session, parts: Sequence[Part]) -> dict[Part, int]:
    """Number of documents of those parts of which the index may lack some."""
    return _documents(_database(session, parts), parts)


def _lacks_fields(part: Part) -> bool:
    """True if documents may lack the fields: those of unreadable messages."""
    is_open = part.recording.status == "open"
    return is_open or not part.has_fields or any(one.stats.unreadable for one in part.channels)


def _numbers(
    database: Database, parts: Sequence[Part], own: Filter, counters: Counters
) -> dict[str, NDArray[np.int64]]:
    """Arrival numbers of the documents that a filter finds, by key of the recording.

    A recording has each number once, whatever the topic.
    """
    found: dict[str, list[NDArray[np.int64]]] = defaultdict(list)
    for raw in database.each(_queries(parts, own), lambda _: {"$project": {"_id": 1}}):
        check_wanted()
        _, recordings, seqs = keys_of(raw).T
        counters.documents_read += len(seqs)
        for recording in np.unique(recordings).tolist():
            found[f"{recording:016x}"].append(seqs[recordings == recording].astype(np.int64))
    none = np.empty(0, np.int64)
    return {
        part.recording.key: np.unique(np.concatenate([none, *found[part.recording.key]]))
        for part in parts
    }


def _database(session: Session, parts: Sequence[Part]) -> Database:
    """The database; refuses parts without documents."""
    for part in parts:
        if not all(c.channel.is_indexed for c in part.channels if c.stats.messages):
            why = "it was recorded with --no-index"
            if part.topic == MARKS:
                why = "marks that somebody set are not in MongoDB"
            raise TopicError(
                f"{part.topic} has no index documents: {why}. Write a predicate, such as "
                "'x > 1', instead of a MongoDB filter."
            )
    database: Database = session.shared.index.database_for(
        "A MongoDB filter (a predicate needs none)", brings=False
    )
    return database


def _documents(database: Database, parts: Sequence[Part]) -> dict[Part, int]:
    """Number of documents of the parts whose recordings are not in the index as a whole."""
    indexed = IndexState(database).of({part.recording.key for part in parts})
    doubtful = []
    for part in parts:
        there = indexed.get(part.recording.key, {}).items()
        if part.recording.status == "open" or not part.recording.digests.items() <= there:
            doubtful.append(part)
    return _counts(database, doubtful, {})


def _counts(database: Database, parts: Sequence[Part], own: Filter) -> dict[Part, int]:
    """Number of documents of each part that satisfy a filter."""
    owners = [part for part in parts for _ in _queries([part], own)]
    found = dict.fromkeys(parts, 0)
    for part, count in zip(owners, database.count_each(_queries(parts, own)), strict=True):
        found[part] += count
    return found


def _check_arrays(
    database: Database, parts: Sequence[Part], filters: Iterable[MongoFilter]
) -> None:
    """Refuse filters of arrays that documents do not have as the filters want them."""
    by_topic: dict[str, list[Part]] = defaultdict(list)
    for part in parts:
        by_topic[part.topic].append(part)
    for (topic, own), node in product(by_topic.items(), filters):
        channels = (c for part in own for c in part.channels if c.codec.indexed)
        for reason, test in misjudged(node, field_types(tuple(channels))).items():
            if any(
                database.find(collection, query, {"_id": 1}, limit=1)
                for collection, query in _queries(own, test)
            ):
                raise WhereError(f"{topic}: {reason}")


def _queries(parts: Sequence[Part], own: Filter) -> list[Query]:
    """Collections and filters that ask about each part: one for each window of log time."""
    found: list[Query] = []
    for part in parts:
        condition: Filter = {"_meta.rec": part.recording.key}
        # Of an open recording, more may have come.
        span = (0, END) if part.recording.status == "open" else part.span
        for low, high in np.clip(part.log_windows, *span).tolist():
            if low < high:
                window = between(low, high if high < END else None)
                found.append((collection_of(part.topic), {"$and": [{**condition, **window}, own]}))
    return found


def keys_of(batch: bytes) -> NDArray[np.uint64]:
    """uint64[n, 3]: log time, recording and arrival number of documents that have only `_id`."""
    if len(batch) % _KEY.itemsize == 0:
        found = np.frombuffer(batch, _KEY)
        if (found["head"] == _HEAD).all():
            return found["key"].astype(np.uint64)
    raise StoreError("An index document has an unexpected _id: run `hybridlog index rebuild`.")


def _predicate(part: Part) -> Predicate:
    assert part.predicate is not None
    return part.predicate


def _decided(predicate: Predicate, numbers: NDArray[np.int64]) -> Predicate:
    """A predicate with arrival numbers in place of its filters."""
    root = predicate.root
    items = root.items if isinstance(root, And) else (root,)
    rest = tuple(item for item in items if not isinstance(item, MongoFilter))
    found = Condition(_SEQ, "in", tuple(numbers.tolist()))
    return Predicate(And((found, *rest)), predicate.text)
