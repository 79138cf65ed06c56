"""Answers from the index in MongoDB."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from hybridlog.query.chunk_scan import ChunkKey, RowSelection
from hybridlog.query.engines.base import Need, Outcomes, Values
from hybridlog.query.predicate.to_mongo import MongoFilter, to_mongo
from hybridlog.query.predicate.tree import And
from hybridlog.query.times import TIME_LIMIT
from hybridlog.schema.column import STAMP
from hybridlog_storage.collection_names import collection_of
from hybridlog_storage.errors import DatabaseError, IndexChangedError
from hybridlog_storage.index_columns import KEY, REFERENCE, key_columns, reference_columns
from hybridlog_storage.index_documents import key_bound

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.guarded import GuardedIndex
    from hybridlog.query.chunk_scan import ChunkTask
    from hybridlog.query.counters import Counters
    from hybridlog.query.question import Part, Span
    from hybridlog.session import Session
    from hybridlog_storage.index_columns import KeyColumns

_QUESTION_S = 0.4e-3  # seconds for a query to MongoDB
_LOOK_S = 0.7e-6  # seconds to examine a document
_DOCUMENT_S = 4e-6  # seconds to send a document
_WINDOWS_A_QUESTION = 14
_BATCH = 50_000
_DOCUMENTS = 10_000
_Filter = dict[str, object]
_READABLE: _Filter = {"_meta.error": {"$exists": False}}


class Mongo:
    """Finds index documents. Fields come from the messages, which hold the exact values.

    Args:
        session: The open store.
        counters: Count the documents that are read.
    """

    def __init__(self, session: Session, counters: Counters) -> None:
        self._session = session
        self._counters = counters
        self._undecided: dict[Part, int] = {}

    def cost(self, part: Part, need: Need, fields: Collection[str] | None = ()) -> float | None:
        """By the number of documents looked at; None without MongoDB, or if it cannot tell."""
        if need is Need.VALUES or _is_older(part) or self._session.database is None:
            return None
        try:
            if need is not Need.SELECTION and self.undecided(part):
                return None
        except (DatabaseError, IndexChangedError):
            return None
        windows = 1 if part.windows is None else len(part.windows)
        each = _LOOK_S if need is Need.COUNT else _LOOK_S + _DOCUMENT_S
        return _QUESTION_S * (1 + windows / _WINDOWS_A_QUESTION) + (
            each * part.messages * part.share
        )

    def filter_of(self, part: Part) -> MongoFilter:
        """The predicate of a part as a MongoDB filter."""
        if part.predicate is None:
            return to_mongo(And(()))
        found = to_mongo(part.predicate.root, part.field_types)
        is_open = part.recording.status == "open"
        if not is_open and not any(stats.unreadable for stats in part.stats):
            return found
        if not part.predicate.asks_fields:
            return found
        # An unreadable message has no fields.
        possible, certain = (joined(_READABLE, f) for f in (found.filter, found.certain))
        return MongoFilter(possible, certain, found.is_exact)

    def undecided(self, part: Part) -> int:
        """Number of documents that cannot decide whether their message matches.

        Long arrays are summaries there, some integers are rounded, and MongoDB does not
        search with patterns. Its candidates may be more than the matches.

        Raises:
            DatabaseError: MongoDB is unavailable.
            IndexChangedError: another process changes the index.
        """
        found = self.filter_of(part)
        if found.is_exact:
            return 0
        if part not in self._undecided:
            unsure = {"$and": [found.filter, {"$nor": [found.certain]}]}
            asked = [(collection_of(part.topic), joined(c, unsure)) for c in conditions(part)]
            self._undecided[part] = sum(self._index([part]).count_each(asked))
        return self._undecided[part]

    def count(self, parts: Sequence[Part]) -> int:
        """Number of documents that match.

        Raises:
            DatabaseError: MongoDB is unavailable.
            IndexChangedError: another process changes the index.
        """
        index = self._index(parts)
        unbounded: dict[tuple[str, str], list[Part]] = defaultdict(list)
        asked: list[tuple[str, Mapping[str, object]]] = []
        for part in parts:
            collection, own = collection_of(part.topic), self.filter_of(part).filter
            if part.is_unbounded:
                unbounded[collection, repr(own)].append(part)
            else:
                asked.extend((collection, joined(c, own)) for c in conditions(part))
        for (collection, _), group in unbounded.items():
            keys = sorted(part.recording.key for part in group)
            chosen: _Filter = {"_meta.rec": {"$in": keys} if len(keys) > 1 else keys[0]}
            asked.append((collection, joined(chosen, self.filter_of(group[0]).filter)))
        return sum(index.count_each(asked))

    def outcomes(self, part: Part) -> Iterator[Outcomes]:
        """Keys of the matching documents merged with keys of the others."""
        own = self.filter_of(part).filter
        collection = collection_of(part.topic)
        for condition in conditions(part):
            yes = self._keys(part, collection, joined(condition, own))
            no: Iterator[KeyColumns] = iter(())
            if own:
                no = self._keys(part, collection, joined(condition, {"$nor": [own]}))
            yield from _merged(yes, no)

    def values(self, part: Part, fields: Collection[str] | None) -> Iterator[Values]:
        """Not supported: `cost` returns None."""
        raise NotImplementedError

    def select(self, parts: Sequence[Part], tasks: Sequence[ChunkTask]) -> RowSelection:
        """References of the documents that match, or may match."""
        index = self._index(parts)
        low, high = min(t.first for t in tasks), max(t.last for t in tasks)
        wanted = {t.key for t in tasks}
        there = {t.key[0] for t in tasks}
        found: dict[ChunkKey, list[NDArray[np.int64]]] = defaultdict(list)
        for part in parts:
            if part.recording.id not in there:
                continue
            condition: _Filter = {
                "_id": {"$gte": key_bound(low), "$lt": key_bound(high + 1)},
                "_meta.rec": part.recording.key,
            }
            # With the order, MongoDB compares the range with an index of the user's.
            for raw in index.find_raw(
                collection_of(part.topic),
                joined(condition, self.filter_of(part).filter),
                REFERENCE,
                sort=[("_id", 1)],
            ):
                reference = reference_columns(raw)
                self._counters.documents_read += len(reference)
                places = np.stack([reference.segment, reference.chunk], axis=1)
                groups, inverse = np.unique(places, axis=0, return_inverse=True)
                for number, (segment, chunk) in enumerate(groups.tolist()):
                    key = (part.recording.id, segment, chunk)
                    if key in wanted:
                        found[key].append(reference.offset[inverse.reshape(-1) == number])
        return RowSelection({key: np.sort(np.concatenate(p)) for key, p in found.items()})

    def documents(self, part: Part, *, reverse: bool) -> Iterator[bytes]:
        """Index documents of the candidates of a part, in order, many at a time.

        Raises:
            DatabaseError: MongoDB is unavailable.
        """
        own, order = self.filter_of(part).filter, -1 if reverse else 1
        for condition in [*conditions(part)][::order]:
            yield from self._index([part]).find_raw(
                collection_of(part.topic),
                joined(condition, own),
                sort=[("_id", order)],
                batch_size=_DOCUMENTS,
            )

    def _index(self, parts: Iterable[Part]) -> GuardedIndex:
        entries = list({part.recording.id: part.recording for part in parts}.values())
        return self._session.index_for("A predicate", entries)

    def _keys(self, part: Part, collection: str, asked: _Filter) -> Iterator[KeyColumns]:
        """Keys of the documents that a filter finds, in order; no batch is empty."""
        index = self._index([part])
        for raw in index.find_raw(collection, asked, KEY, sort=[("_id", 1)], batch_size=_BATCH):
            keys = key_columns(raw)
            self._counters.documents_read += len(keys)
            if len(keys):
                yield keys


def _is_older(part: Part) -> bool:
    """True if the index is older than the package that reads the fields of the messages."""
    if part.predicate is None:
        return False
    unread = {c.id for c in part.recording.channels if c.reason is not None}
    return any(c.channel_id in unread and c.codec.indexed for c in part.channels)


def joined(condition: _Filter, predicate: Mapping[str, object]) -> _Filter:
    """Both filters joined by *and*."""
    return {"$and": [condition, dict(predicate)]} if predicate else condition


def conditions(part: Part) -> Iterator[_Filter]:
    """The recording and time of a part as filters, one for each window, in order."""
    recording: _Filter = {"_meta.rec": part.recording.key}
    if part.bounds is not None and part.clock != "log":
        name = STAMP if part.clock == "header" else "_meta.pub"
        recording[name] = {"$gte": part.bounds[0], "$lt": part.bounds[1]}
    for begin, end in part.log_windows.tolist():
        yield {**recording, **_between((begin, end))}


def _between(span: Span) -> _Filter:
    begin, end = span
    if begin <= 0 and end >= TIME_LIMIT - 1:
        return {}
    return {"_id": {"$gte": key_bound(begin), "$lt": key_bound(end)}}


def _merged(yes: Iterator[KeyColumns], no: Iterator[KeyColumns]) -> Iterator[Outcomes]:
    """Two ordered streams of keys as one, with the stream of each key."""
    left, right = next(yes, None), next(no, None)
    while left is not None and right is not None:
        # No later key of either stream precedes the nearer end.
        end = min((int(k.time[-1]), int(k.seq[-1])) for k in (left, right))
        here, there = left.place_after(*end), right.place_after(*end)
        time = np.concatenate([left.time[:here], right.time[:there]])
        seq = np.concatenate([left.seq[:here], right.seq[:there]])
        order = np.lexsort((seq, time))
        yield Outcomes(time[order], seq[order], order < here)
        left = left.take(slice(here, None)) if here < len(left) else next(yes, None)
        right = right.take(slice(there, None)) if there < len(right) else next(no, None)
    while left is not None:
        yield Outcomes(left.time, left.seq, np.ones(len(left), np.bool_))
        left = next(yes, None)
    while right is not None:
        yield Outcomes(right.time, right.seq, np.zeros(len(right), np.bool_))
        right = next(no, None)
