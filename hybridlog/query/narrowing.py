"""Leaves out recordings of which an index on a field in MongoDB says that no message matches.

Columns have to open a file of each recording that may match; one command finds those that do.
MongoDB decides nothing: the recordings that are left are asked as without it. What it finds is
limited, so a condition that many messages satisfy costs little more than without an index.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from hybridlog.query.bounds import MIN_RECORDINGS
from hybridlog.query.predicate.numbers import is_nan, is_number
from hybridlog.query.predicate.tree import And, Compare, Member, Node, Value
from hybridlog_storage.errors import DatabaseError, WhereError
from hybridlog_storage.mongo.database import index_name
from hybridlog_storage.mongo.index_state import IndexState

if TYPE_CHECKING:
    from hybridlog.index.field_indexes import FieldIndex
    from hybridlog.query.question import Question, RecordedChannel
    from hybridlog.query.ranges import Ranges
    from hybridlog.session import Session

_PURPOSE = "An index on a field"
_MIN_MATCHES = 100
_MATCHES_SHARE = 4
"""MongoDB reads at most one match for so many recordings: a search in vain stays cheap."""
_EXACT = 2**53
"""Integers up to this are exact as doubles."""
_SINGLE = re.compile(r"(byte|char|string|time|duration|float(32|64)|u?int(8|16|32|64))")

Filter = dict[str, object]


def narrowed(
    session: Session, question: Question, found: Ranges, channels: Sequence[RecordedChannel]
) -> Ranges:
    """The recordings of a question that may have matching messages.

    Running recordings are among them, and those whose documents may not tell.

    Args:
        session: The open store.
        question: The question.
        found: The recordings.
        channels: Channels of them, of one recording for each set of topics and types.
    """
    if not session.connection.index or len(found) < MIN_RECORDINGS or len(question.topics) != 1:
        return found
    condition = _condition(session.field_indexes, question, channels)
    if condition is None:
        return found
    index, test = condition
    try:
        keys = _keys_with(session, index, test, len(found))
    except (DatabaseError, WhereError):
        return found  # columns answer; the index may have been dropped
    if keys is None:
        return found
    own = session.connection.index
    rows = [
        row
        for row, summary in enumerate(found.summaries)
        if summary.indexed_by != own or summary.key in keys
    ]
    return found.take(np.array(rows, np.intp))


def _keys_with(
    session: Session, index: FieldIndex, test: Filter, recordings: int
) -> set[str] | None:
    """Keys of the recordings with documents that satisfy a test, or that may lack documents.

    None if there are too many, or if another process changes the index.
    """
    database = session.database_for(_PURPOSE)
    turn, uncertain = session.uncertain(index.topic)
    most = max(_MIN_MATCHES, recordings // _MATCHES_SHARE)
    place = session.places(_PURPOSE).of([index.topic])[index.topic]
    name = index_name([(field, 1) for field in index.fields], place.of_topic)
    pipeline: list[Filter] = [
        {"$match": {index.fields[0]: test, **place.of_topic}},
        {"$limit": most + 1},
        {"$group": {"_id": "$_meta.rec", "n": {"$sum": 1}}},
    ]
    counts = {
        str(one["_id"]): int(one["n"])
        for one in database.aggregate(place.collection, pipeline, hint=name)
    }
    if sum(counts.values()) > most:
        return None
    if IndexState(database).turn() != turn:
        session.clear_uncertain()
        return None
    return uncertain | counts.keys()


def _condition(
    indexes: Sequence[FieldIndex], question: Question, channels: Sequence[RecordedChannel]
) -> tuple[FieldIndex, Filter] | None:
    """An index, and a test of its first field that every match satisfies; None without any."""
    assert question.predicate is not None
    tests: dict[str, Filter] = {}
    for node in _conjuncts(question.predicate.root):
        if isinstance(node, Compare | Member) and not node.field.is_sliced:
            test = _test_of(node)
            if test:
                tests.setdefault(node.field.path, {}).update(test)
    for index in indexes:
        path = index.fields[0]
        if index.topic == question.topics[0] and path in tests and _is_single(path, channels):
            return index, tests[path]
    return None


def _conjuncts(node: Node) -> Iterator[Node]:
    """Conditions that hold for every message for which a predicate holds."""
    if isinstance(node, And):
        for item in node.items:
            yield from _conjuncts(item)
    else:
        yield node


def _is_single(path: str, channels: Sequence[RecordedChannel]) -> bool:
    """True if a field has one value in each message, and documents hold it whole."""
    types = [
        {field.path: field.type for field in channel.codec.paths()}
        for channel in channels
        if channel.is_typed
    ]
    if any(channel.encoding == "json" for channel in channels):
        return False  # values may have other types than their schema says
    return bool(types) and all(_SINGLE.fullmatch(known.get(path, "")) for known in types)


def _test_of(node: Compare | Member) -> Filter:
    """Operators that find at least the documents of the matches; empty for all."""
    if isinstance(node, Member):
        ends = [] if node.negated else [_bounds(value) for value in node.values]
        exact = [one[0] for one in ends if one is not None and one[0] == one[1]]
        return {"$in": exact} if ends and len(exact) == len(ends) else {}
    bounds = _bounds(node.value)
    if bounds is None or node.order == "!=":
        return {}
    low, high = bounds
    if isinstance(low, str):
        return {"$eq": low} if node.order == "==" else {}
    if node.order == "==":
        return {"$gte": low, "$lte": high}
    return {"$lte": high} if node.order in {"<", "<="} else {"$gte": low}


def _bounds(value: Value) -> tuple[float | str, float | str] | None:
    """The value as documents hold it at least and at most; None if they may not have it."""
    if isinstance(value, str):
        return value, value
    if not is_number(value) or is_nan(value):
        return None
    if isinstance(value, float) or abs(value) <= _EXACT:
        return value, value
    try:
        near = float(value)
    except OverflowError:
        return None
    # Integers beyond int64 are doubles in documents, rounded either way.
    return math.nextafter(near, -math.inf), math.nextafter(near, math.inf)
