"""Reads index documents of MongoDB: what only they can answer, and the documents themselves."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from hybridlog.query.predicate.to_mongo import replaced, to_mongo
from hybridlog.query.predicate.tree import Field, Member, Node, Opaque, Predicate, nodes
from hybridlog.schema.column import STAMP
from hybridlog.snapshot import UNFINISHED
from hybridlog_storage.errors import (
    ConnectionLostError,
    DatabaseError,
    IndexChangedError,
    TopicError,
)
from hybridlog_storage.mongo.index_columns import KEY, key_columns
from hybridlog_storage.stopping import check_wanted
from hybridlog_storage.times import END

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.index.index_version import GuardedIndex
    from hybridlog.query.counters import Counters
    from hybridlog.query.question import Part, Span
    from hybridlog.session import Session
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.mongo.index_columns import KeyColumns
    from hybridlog_storage.mongo.topic_places import TopicPlace

_DOCUMENTS = 10_000
"""Documents in one answer of MongoDB."""
_FIRST_DOCUMENTS = 100
"""Documents asked for by key in the first command; each later one asks for ten times more."""
_MAX_RANGES = 100
"""Ranges of log time that are asked for apart: as many as one command takes."""
_PURPOSE = "A MongoDB filter"
_SEQ = Field(("_meta", "seq"))
Filter = dict[str, object]
_READABLE: Filter = {"_meta.error": {"$exists": False}}
WITHOUT_FIELDS: Filter = {"_meta.error": {"$exists": True}}
"""Documents without fields, of which no filter can be asked."""
TOO_LARGE: Filter = {"_meta.error": {"$regex": "take more than [0-9]+ MiB$"}}
"""Those whose message has fields, but too large ones for a document."""
_T = TypeVar("_T")
Query = tuple[str, Filter]
"""A collection and a filter."""


class IndexReader:
    """Asks MongoDB about parts of a question."""

    def __init__(self, session: Session, counters: Counters) -> None:
        self._session = session
        self._counters = counters

    def without_index(self, parts: Sequence[Part]) -> list[Part]:
        """Parts with predicates that columns and messages decide.

        What only documents can answer becomes the arrival numbers of the messages for which it
        holds.

        Raises:
            DatabaseError: MongoDB is unavailable, or its list of topics is damaged.
            IndexChangedError: another process changes the index.
            TopicError: a topic was recorded without index documents.
            WhereError: MongoDB does not understand the predicate.
        """
        missing = next((part.topic for part in parts if not part.is_indexed), None)
        if missing is not None:
            raise without_documents(missing)
        groups: dict[Node, list[Part]] = defaultdict(list)
        for part in parts:
            for node in _of_documents(part):
                groups[node].append(part)
        found = self._again(
            parts,
            lambda: {node: self._holding(group, to_filter(node)) for node, group in groups.items()},
        )

        def decided(part: Part) -> Part:
            def seqs(node: Node) -> Node:
                numbers = found[node].get(part.recording.key)
                return Member(_SEQ, () if numbers is None else tuple(numbers.tolist()), False)

            assert part.predicate is not None
            root = replaced(part.predicate.root, seqs)
            return replace(part, predicate=Predicate(root, part.predicate.text))

        return [decided(part) for part in parts]

    def count(self, parts: Sequence[Part], own: Filter | None = None) -> int:
        """Number of documents of some parts, whatever their predicates.

        Args:
            parts: The parts.
            own: A filter for them; None for all.

        Raises:
            DatabaseError: MongoDB is unavailable.
            IndexChangedError: another process changes the index.
        """
        if not parts:
            return 0
        return self._again(
            parts,
            lambda: sum(
                self._index(parts).count_each(
                    [query for query, _ in self._queries(parts, own or {})]
                )
            ),
        )

    def documents(self, parts: Sequence[Part], *, reverse: bool) -> list[Iterator[bytes]]:
        """All documents of some parts of one topic, whatever their predicates.

        Returns:
            Streams of many documents at a time, each in order.

        Raises:
            DatabaseError: MongoDB is unavailable.
        """
        order = -1 if reverse else 1
        queries = self._queries(parts, {}, most=1)
        streams: list[list[Query]] = []
        ends: list[int] = []
        for query, (begin, end) in sorted(queries, key=lambda item: item[1]):
            place = next((i for i, last in enumerate(ends) if last <= begin), len(ends))
            if place == len(ends):
                streams.append([])
                ends.append(end)
            streams[place].append(query)
            ends[place] = end

        def read(own: Sequence[Query]) -> Iterator[bytes]:
            for query in own[::order]:
                yield from self._found(parts, query, order)

        return [read(own) for own in streams]

    def documents_with(
        self, parts: Sequence[Part], keys: KeyColumns, *, reverse: bool
    ) -> Iterator[bytes]:
        """The documents with some keys, many at a time.

        Args:
            parts: The parts of one topic that the keys are of.
            keys: In the order of documents.
            reverse: True for the last document first.

        Raises:
            DatabaseError: MongoDB is unavailable.
        """
        place = self._places(parts)[parts[0].topic]
        done, size = 0, _FIRST_DOCUMENTS
        while done < len(keys):
            rows = slice(done, done + size)
            if reverse:
                rows = slice(max(len(keys) - done - size, 0), len(keys) - done)
            names = keys.take(rows).to_keys(place.prefix)
            # Without bounds MongoDB looks at the whole collection.
            bounds = {"$gte": names[0], "$lte": names[-1], "$in": names}
            by_key: Filter = {"_id": bounds, **place.of_topic}
            yield from self._found(parts, (place.collection, by_key), -1 if reverse else 1)
            done += len(names)
            size = min(size * 10, _DOCUMENTS)

    def _found(self, parts: Sequence[Part], query: Query, order: int) -> Iterator[bytes]:
        return self._index(parts).find_raw(*query, sort=[("_id", order)], batch_size=_DOCUMENTS)

    def _holding(self, parts: Sequence[Part], own: Filter) -> dict[str, NDArray[np.int64]]:
        """Arrival numbers of the documents that a filter finds, by key of the recording.

        A recording has each number once, whatever the topic.
        """
        index, places = self._index(parts), self._places(parts)
        kinds: dict[bool, list[Part]] = defaultdict(list)  # keys differ in their length
        for part in parts:
            kinds[places[part.topic].is_shared].append(part)
        found: dict[str, list[NDArray[np.int64]]] = defaultdict(list)
        for group in kinds.values():
            queries = [query for query, _ in self._queries(group, own)]
            for raw in index.find_each(queries, KEY):
                check_wanted()
                keys = key_columns(raw)
                self._counters.documents_read += len(keys)
                for recording in np.unique(keys.recording).tolist():
                    found[f"{recording:016x}"].append(keys.seq[keys.recording == recording])
        return {key: np.unique(np.concatenate(numbers)) for key, numbers in found.items()}

    def _again(self, parts: Sequence[Part], ask: Callable[[], _T]) -> _T:
        """An answer; asked for once more if the connection was lost or the index has changed."""
        self.connect(parts)
        try:
            return ask()
        except (ConnectionLostError, IndexChangedError):
            self.connect(parts)
            return ask()

    def connect(self, parts: Sequence[Part]) -> None:
        """Connect, and bring the index of the recordings of some parts up to date.

        Raises:
            DatabaseError: MongoDB is unavailable.
        """
        entries = _entries(parts)
        database = self._session.database_about(_PURPOSE, entries)
        self._session.index_version(database, {entry.key for entry in entries})

    def _index(self, parts: Sequence[Part]) -> GuardedIndex:
        return self._session.index_for(_PURPOSE, _entries(parts))

    def _places(self, parts: Sequence[Part]) -> dict[str, TopicPlace]:
        found = self._session.places(_PURPOSE).of({part.topic for part in parts})
        for part in parts:
            if not found[part.topic].is_listed and part.recording.status not in UNFINISHED:
                self._index(parts)  # tells if their documents are missing altogether
                raise DatabaseError(
                    f"The index does not list {part.topic}: run `hybridlog index rebuild`."
                )
        return found

    # Queries.

    def _queries(
        self, parts: Sequence[Part], own: Filter, most: int = _MAX_RANGES
    ) -> list[tuple[Query, Span]]:
        """Queries that ask about each part once, with the log time of each.

        Parts that differ only in their recordings are asked about together, where nothing
        else lies between them.
        """
        places = self._places(parts)
        alike: dict[tuple[str, str, Span | None], list[tuple[Part, Span]]] = defaultdict(list)
        found: list[tuple[Query, Span]] = []
        for part in parts:
            place = places[part.topic]
            if part.windows is not None:
                for condition, span in conditions(part, place):
                    found.append(((place.collection, joined(condition, own)), span))
                continue
            span, bounds = _time_of(part)
            if span[0] < span[1]:
                alike[part.topic, part.clock, bounds].append((part, span))
        for (topic, clock, bounds), group in alike.items():
            place = places[topic]
            for span, there in self._ranges([p for p, _ in group], [s for _, s in group], most):
                condition = _chosen(place, span, there)
                if clock != "log" and bounds is not None:
                    condition.update(_on_clock(clock, bounds))
                found.append(((place.collection, joined(condition, own)), span))
        return found

    def _ranges(
        self, parts: Sequence[Part], spans: Sequence[Span], most: int
    ) -> list[tuple[Span, list[Part]]]:
        """Ranges of log time that hold the spans of some parts, with the parts of each.

        Spans are joined if they overlap, and if they are more than `most`, also across gaps in
        which no other recording lies: finding many documents in one range costs less than
        asking for many ranges.
        """
        if not parts:
            return []
        order = sorted(range(len(parts)), key=spans.__getitem__)
        ends = np.array([min(spans[i][1], END) for i in order[:-1]], np.int64)
        low = np.maximum.accumulate(ends)
        high = np.array([spans[i][0] for i in order[1:]], np.int64)
        is_apart = low < high
        if int(is_apart.sum()) >= most:
            first, end = self._session.snapshot().others({part.recording.id for part in parts})
            before = np.searchsorted(np.sort(first), high, "left")
            is_apart &= before > np.searchsorted(np.sort(end), low, "right")
        steps = [0, *(np.flatnonzero(is_apart) + 1).tolist(), len(order)]
        groups = [order[begin:end] for begin, end in pairwise(steps)]
        return [
            (
                (spans[group[0]][0], max(spans[i][1] for i in group)),
                [parts[i] for i in group],
            )
            for group in groups
        ]


def _entries(parts: Iterable[Part]) -> list[RecordingEntry]:
    """The recordings of some parts, each once."""
    return [*{part.recording.id: part.recording for part in parts}.values()]


def _of_documents(part: Part) -> list[Node]:
    """The largest pieces of a part's predicate that only documents answer."""
    found: list[Node] = []

    def keep(node: Node) -> Node:
        found.append(node)
        return node

    if part.predicate is not None:
        replaced(part.predicate.root, keep)
    return found


def to_filter(node: Node) -> Filter:
    """A piece of a predicate as a filter; a document without fields satisfies no condition."""
    found = to_mongo(node)
    is_opaque = any(isinstance(each, Opaque) for each in nodes(node))
    return joined(_READABLE, found) if is_opaque else found


def without_documents(topic: str) -> TopicError:
    """The error for a topic that MongoDB does not have."""
    return TopicError(
        f"{topic} has no index documents: it was recorded with --no-index. Ask for its messages "
        "or tables."
    )


def joined(condition: Filter, other: Mapping[str, object]) -> Filter:
    """Both filters joined by *and*."""
    return {"$and": [condition, dict(other)]} if other else condition


def conditions(part: Part, place: TopicPlace) -> Iterator[tuple[Filter, Span]]:
    """The recording, topic and time of a part as filters, one for each window, in order."""
    recording: Filter = {"_meta.rec": part.recording.key}
    if part.bounds is not None and part.clock != "log":
        recording.update(_on_clock(part.clock, part.bounds))
    for begin, end in part.log_windows.tolist():
        yield {**recording, **_between(place, (begin, end))}, (begin, end)


def _on_clock(clock: str, bounds: Span) -> Filter:
    name = STAMP if clock == "header" else "_meta.pub"
    begin, end = bounds
    return {name: {"$gte": begin, "$lte" if end == END else "$lt": end}}


def _chosen(place: TopicPlace, span: Span, parts: Sequence[Part]) -> Filter:
    """The recordings of some parts of a topic, in a range of log time."""
    keys = sorted(part.recording.key for part in parts)
    return {"_meta.rec": {"$in": keys} if len(keys) > 1 else keys[0], **_between(place, span)}


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


def _between(place: TopicPlace, span: Span) -> Filter:
    begin, end = span
    if begin <= 0 and end >= END:
        return place.documents()
    return place.documents(begin, end if end < END else None)
