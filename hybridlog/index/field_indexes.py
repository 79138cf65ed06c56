"""Indexes on fields, with which MongoDB finds documents without a scan.

They change the duration of a query and never its answer, so the segments do not have
them: MongoDB stores them, and `index rebuild` leaves them in place.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, NamedTuple

from hybridlog_storage.errors import UsageError
from hybridlog_storage.mongo.collection_names import collection_of

if TYPE_CHECKING:
    from hybridlog_storage.mongo.database import Database

OWN_FIELDS = ("_meta.t", "_meta.pub", "_meta.inserted_at", "_meta.rec")
"""Fields that every index document has, in any topic."""

_MAX_FIELDS = 8


class FieldIndex(NamedTuple):
    """An index on some fields of a topic.

    Attributes:
        topic: Full name.
        fields: Fields in the order of the index.
    """

    topic: str
    fields: tuple[str, ...]


def add(database: Database, topics: Iterable[str], fields: Sequence[str]) -> None:
    """Create an index on each topic, unless it exists.

    Raises:
        UsageError: no field, or too many.
        DatabaseError: MongoDB cannot create it: two of the fields are arrays.
    """
    _check(fields)
    for topic in topics:
        database.ensure_collection(collection_of(topic))
        database.create_index(collection_of(topic), _keys(fields))


def remove(database: Database, topics: Iterable[str], fields: Sequence[str]) -> int:
    """Drop the index on these fields from each topic; returns the number of indexes dropped."""
    _check(fields)
    return sum(database.drop_index(collection_of(topic), _keys(fields)) for topic in topics)


def of_topics(database: Database, topics: Iterable[str]) -> list[FieldIndex]:
    """The indexes of some topics, in the order of the topics, by fields."""
    return [
        FieldIndex(topic, tuple(field for field, _ in keys))
        for topic in topics
        for keys in database.indexes(collection_of(topic))
    ]


def _check(fields: Sequence[str]) -> None:
    if not fields:
        raise UsageError("Name at least one field; `hybridlog info -t TOPIC` lists them.")
    if len(fields) > _MAX_FIELDS or len(set(fields)) != len(fields):
        raise UsageError(f"An index takes up to {_MAX_FIELDS} fields, without duplicates.")


def _keys(fields: Sequence[str]) -> list[tuple[str, int]]:
    # Documents have no brackets: an index on an element is one on the array.
    return [(field.replace("[]", ""), 1) for field in fields]
