"""Asks MongoDB for the messages that a filter finds, in the index as it is."""

from __future__ import annotations

import struct
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np

from hybridlog.query.predicate.mongo_filter import misjudged
from hybridlog.query.predicate.tree import And, Field, Member, MongoFilter, Predicate
from hybridlog.record.marks import MARKS
from hybridlog.schema.column import STAMP
from hybridlog_storage.errors import (
    ConnectionLostError,
    IndexChangedError,
    StoreError,
    TopicError,
    WhereError,
)
from hybridlog_storage.mongo.collection_names import collection_of
from hybridlog_storage.mongo.index_documents import KEY_BYTES, between
from hybridlog_storage.mongo.index_state import Indexed, IndexState
from hybridlog_storage.stopping import check_wanted
from hybridlog_storage.times import END

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.counters import Counters
    from hybridlog.query.question import Part, Span
    from hybridlog.session import Session
    from hybridlog_storage.mongo.database import Database

_MAX_RANGES = 100
"""Recordings whose log time is asked for apart: as many as one command takes."""
_TRIES = 3
_SEQ = Field(("_meta", "seq"))
_KEY = np.dtype([("head", "V14"), ("key", ">u8", 3), ("end", "u1")])
"""A document that has only its `_id`."""
_HEAD = np.void(struct.pack("<i5siB", _KEY.itemsize, b"\x05_id", KEY_BYTES, 0))
Filter = dict[str, object]
_READABLE: Filter = {"_meta.error": {"$exists": False}}
_WITHOUT_FIELDS: Filter = {"_meta.error": {"$exists": True}}
_TOO_LARGE: Filter = {"_meta.error": {"$regex": "take more than [0-9]+ MiB$"}}
"""Documents whose message has fields, but too large ones for a document."""
_T = TypeVar("_T")
Query = tuple[str, Filter]
"""A collection and a filter."""
_Indexed = Mapping[str, Indexed]


class Found(NamedTuple):
    """The answer of MongoDB about parts of a question.

    Attributes:
        parts: The parts, with the arrival numbers of what the filters find in their place.
        documents: Number of documents of those parts of which the index may lack some.
        untested: Messages that the filters cannot test, since their documents have no fields.
    """

    parts: list[Part]
    documents: dict[Part, int]
    untested: int


class IndexReader:
    """Asks MongoDB about parts of one question. It never writes to the index."""

    def __init__(self, session: Session, counters: Counters) -> None:
        self._session = session
        self._counters = counters

    def found(self, parts: Sequence[Part]) -> Found:
        """The parts with predicates that columns and messages decide."""
        predicate = _predicate(parts[0])
        asks_fields = any(node.asks_fields for node in predicate.filters)
        own: list[Filter] = [node.to_filter() for node in predicate.filters]
        everything: Filter = {"$and": [*own, _READABLE] if asks_fields else own}

        def ask(asked: _Asked) -> Found:
            documents = asked.documents()
            asked.check_arrays(predicate.filters)
            numbers = self._numbers(asked, parts, everything)
            decided = [
                replace(part, predicate=_decided(predicate, numbers[part.recording.key]))
                for part in parts
            ]
            untested = 0
            if asks_fields:
                lacking = [part for part in parts if part.lacks_fields]
                # What is read for the rest of the predicate is counted there.
                is_read = _predicate(decided[0]).asks_fields
                untested = sum(asked.counts(lacking, _TOO_LARGE if is_read else _WITHOUT_FIELDS))
            return Found(decided, documents, untested)

        return self._ask(parts, ask)

    def documents(self, parts: Sequence[Part]) -> dict[Part, int]:
        """Number of documents of those parts of which the index may lack some."""
        return self._ask(parts, _Asked.documents)

    def _numbers(
        self, asked: _Asked, parts: Sequence[Part], own: Filter
    ) -> dict[str, NDArray[np.int64]]:
        """Arrival numbers of the documents that a filter finds, by key of the recording.

        A recording has each number once, whatever the topic.
        """
        found: dict[str, list[NDArray[np.int64]]] = defaultdict(list)
        for raw in asked.database.each(
            asked.queries(parts, own), lambda _: {"$project": {"_id": 1}}
        ):
            check_wanted()
            _, recordings, seqs = keys_of(raw).T
            self._counters.documents_read += len(seqs)
            for recording in np.unique(recordings).tolist():
                found[f"{recording:016x}"].append(seqs[recordings == recording].astype(np.int64))
        none = np.empty(0, np.int64)
        return {
            part.recording.key: np.unique(np.concatenate([none, *found[part.recording.key]]))
            for part in parts
        }

    def _ask(self, parts: Sequence[Part], ask: Callable[[_Asked], _T]) -> _T:
        """An answer during which no other process has removed documents."""
        for part in parts:
            if not part.is_indexed:
                why = "it was recorded with --no-index"
                if part.topic == MARKS:
                    why = "marks that somebody set are not in MongoDB"
                raise TopicError(
                    f"{part.topic} has no index documents: {why}. Write a predicate, such as "
                    "'x > 1', instead of a MongoDB filter."
                )
        failure: Exception | None = None
        for _ in range(_TRIES):
            database = self._session.shared.index.database_for(
                "A MongoDB filter (a predicate needs none)", brings=False
            )
            keys = {part.recording.key for part in parts}
            try:
                indexed = IndexState(database).of(keys)
                found = ask(_Asked(database, parts, indexed))
                if _made(IndexState(database).of(keys)) == _made(indexed):
                    return found
            except ConnectionLostError as error:
                failure = error
        raise failure or IndexChangedError(
            "The index was changed by another process while it was asked. Ask again."
        )


class _Asked:
    """Parts of a question, and what the index has of their recordings."""

    def __init__(
        self,
        database: Database,
        parts: Sequence[Part],
        indexed: _Indexed,
    ) -> None:
        self.database = database
        self._parts = parts
        self._indexed = indexed

    def documents(self) -> dict[Part, int]:
        """Number of documents of the parts whose recordings are not in the index as a whole."""
        doubtful = []
        for part in self._parts:
            indexed = self._indexed.get(part.recording.key)
            segments = {} if indexed is None else indexed.segments
            is_there = part.recording.digests.items() <= segments.items()
            if part.recording.status == "open" or not is_there:
                doubtful.append(part)
        return dict(zip(doubtful, self.counts(doubtful, {}), strict=True))

    def counts(self, parts: Sequence[Part], own: Filter) -> list[int]:
        """Number of documents of each part that satisfy a filter."""
        queries = [
            (row, query) for row, part in enumerate(parts) for query in self.queries([part], own)
        ]
        found = [0] * len(parts)
        counted = self.database.count_each([query for _, query in queries])
        for (row, _), counts in zip(queries, counted, strict=True):
            found[row] += sum(number for _, number in counts)
        return found

    def check_arrays(self, filters: Iterable[MongoFilter]) -> None:
        """Refuse filters of arrays that documents do not have as the filters want them."""
        by_topic: dict[str, list[Part]] = defaultdict(list)
        for part in self._parts:
            by_topic[part.topic].append(part)
        for topic, parts in by_topic.items():
            types = _types_of(parts)
            for node in filters:
                tests = misjudged(node, types)
                if not tests or not self._any(parts, {"$or": [*tests.values()]}):
                    continue
                for reason, test in tests.items():
                    if self._any(parts, test):
                        raise WhereError(f"{topic}: {reason}")

    def _any(self, parts: Sequence[Part], own: Filter) -> bool:
        return any(
            self.database.find_one(collection, query, {"_id": 1}) is not None
            for collection, query in self.queries(parts, own)
        )

    def queries(self, parts: Sequence[Part], own: Filter) -> list[Query]:
        """Queries that ask about each part once; many parts of a topic are asked together."""
        alike: dict[tuple[str, str, Span | None], list[tuple[Part, Span]]] = defaultdict(list)
        found: list[Query] = []
        for part in parts:
            if part.windows is not None:
                windows = _windows(part)
                found += [(collection_of(part.topic), _joined(each, own)) for each in windows]
                continue
            span, bounds = _time_of(part)
            if span[0] < span[1]:
                alike[part.topic, part.clock, bounds].append((part, span))
        for (topic, clock, bounds), group in alike.items():
            # Finding many documents in one range costs less than asking for many ranges.
            together = [group] if len(group) > _MAX_RANGES else [[one] for one in group]
            for some in together:
                keys = sorted(part.recording.key for part, _ in some)
                span = min(low for _, (low, _) in some), max(high for _, (_, high) in some)
                condition: Filter = {"_meta.rec": {"$in": keys}, **_between(span)}
                if clock != "log" and bounds is not None:
                    condition.update(_on_clock(clock, bounds))
                found.append((collection_of(topic), _joined(condition, own)))
        return found


def keys_of(batch: bytes) -> NDArray[np.uint64]:
    """uint64[n, 3]: log time, recording and arrival number of documents that have only `_id`."""
    if len(batch) % _KEY.itemsize == 0:
        found = np.frombuffer(batch, _KEY)
        if (found["head"] == _HEAD).all():
            return found["key"].astype(np.uint64)
    raise StoreError("An index document has an unexpected _id: run `hybridlog index rebuild`.")


def _made(indexed: _Indexed) -> dict[str, str]:
    return {key: one.made for key, one in indexed.items()}


def _predicate(part: Part) -> Predicate:
    assert part.predicate is not None
    return part.predicate


def _decided(predicate: Predicate, numbers: NDArray[np.int64]) -> Predicate:
    """A predicate with arrival numbers in place of its filters."""
    root = predicate.root
    items = root.items if isinstance(root, And) else (root,)
    rest = tuple(item for item in items if not isinstance(item, MongoFilter))
    found = Member(_SEQ, tuple(numbers.tolist()), negated=False)
    return Predicate(And((found, *rest)), predicate.text)


def _types_of(parts: Sequence[Part]) -> Mapping[str, str] | None:
    """Types of the fields of a topic; None where a definition does not fix them."""
    types: dict[str, str] = {}
    for part in parts:
        if part.field_types is None:
            return None
        types |= part.field_types
    return types


def _joined(condition: Filter, other: Filter) -> Filter:
    """Both filters joined by *and*."""
    return {"$and": [condition, other]} if other else condition


def _windows(part: Part) -> Iterator[Filter]:
    """The recording, topic and time of a part as filters, one for each window, in order."""
    recording: Filter = {"_meta.rec": part.recording.key}
    if part.bounds is not None and part.clock != "log":
        recording.update(_on_clock(part.clock, part.bounds))
    for begin, end in part.log_windows.tolist():
        yield {**recording, **_between((begin, end))}


def _on_clock(clock: str, bounds: Span) -> Filter:
    name, unset = (STAMP, {"$ne": 0}) if clock == "header" else ("_meta.pub", {})
    begin, end = bounds
    return {name: {"$gte": begin, "$lte" if end == END else "$lt": end, **unset}}


def _time_of(part: Part) -> tuple[Span, Span | None]:
    """The log time of a part without windows, and its bounds if they exclude messages.

    The log time is cut to that of its messages, where it is known.
    """
    low, high = (0, END) if part.bounds is None else part.bounds
    first, end = 0, END
    if part.recording.status != "open":
        first, end = part.span or (0, 0)
    if part.bounds is None:
        return (first, end), None
    if part.clock != "log":
        return (first, end), part.bounds
    is_whole = low <= first and end <= high
    return (max(first, low), min(end, high)), None if is_whole else part.bounds


def _between(span: Span) -> Filter:
    begin, end = span
    if begin <= 0 and end >= END:
        return {}
    return between(begin, end if end < END else None)
