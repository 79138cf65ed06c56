"""How many messages there are, and whether there is any: asked of MongoDB, not read.

An index on a field can answer alone, without a document, as long as nothing else is
asked of the documents; and a document in which nothing but the predicate's fields is
looked at is done with earlier. So the recording is left out of the question when there
is no other whose documents could be counted too. That is never assumed: catalog,
directory and the collection's own count must all say so, and the catalog once more
afterwards.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import numpy as np

from hybridlog.columns.answers import judged
from hybridlog.columns.kept import cost_s
from hybridlog.processors import processors
from hybridlog.query.intervals import Intervals, joined
from hybridlog.query.times import TIME_LIMIT
from hybridlog_storage.collection_names import collection_of
from hybridlog_storage.errors import UsageError
from hybridlog_storage.index_documents import key_bound
from hybridlog_storage.index_state import RECORDINGS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.guarded import GuardedIndex
    from hybridlog.reader import Query
    from hybridlog.store import Store
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.database import Database

_MANY = 10_000  # messages; below it no way of counting takes long
_PART = 25_000  # least messages that are worth a thread
_MOST_PARTS = 4
_SEVERAL = 32
"""Reading so many keys takes as long as finding out whether one interval has a message."""

_Filter = Mapping[str, object]


def in_all_times(
    store: Store, topic: str, recordings: Sequence[RecordingEntry], predicate: _Filter
) -> int:
    """Number of a topic's messages that satisfy a predicate.

    Args:
        store: With its database.
        topic: Full name.
        recordings: Where to count; those that have the topic.
        predicate: A MongoDB filter, not empty.
    """
    index = store.index_for("A predicate", recordings)
    collection = collection_of(topic)
    keys = sorted(entry.key for entry in recordings)
    own = {"$and": [{"_meta.rec": {"$in": keys} if len(keys) > 1 else keys[0]}, dict(predicate)]}
    if _messages(topic, recordings) < _MANY:
        return index.count(collection, own)
    if _is_whole(store, index.database, topic, recordings):
        found = _counted(index, topic, recordings, predicate)
        if not _has_strangers(store, index.database):
            return found
    return _counted(index, topic, recordings, own)


def count_in_columns(query: Query, topics: Iterable[str]) -> tuple[int, list[str]]:
    """Number of a query's messages of topics that columns answer, and the topics that are left."""
    parts = {topic: judged(query, topic) for topic in topics}
    found = [part for of_topic in parts.values() for part in of_topic or ()]
    left = [topic for topic, of_topic in parts.items() if of_topic is None]
    return sum(part.count() for part in found), left


def any_in_each(query: Query, recording: str, spans: NDArray[np.int64]) -> NDArray[np.bool_]:
    """In which spans of log time of one recording any message of a question lies.

    Args:
        query: The question.
        recording: Id of the recording.
        spans: int64[n, 2], begin and end, ns; they may overlap.

    Returns:
        bool[n].

    Raises:
        UsageError: the question has `limit` or `every`.
        DatabaseError: MongoDB is away and there is a predicate.
    """
    if not query.is_unthinned:
        raise UsageError("Any message counts: limit and every do not fit.")
    found = np.zeros(len(spans), np.bool_)
    if recording not in query.recording_ids or not len(spans):
        return found
    part = query.in_recording(recording)
    entry = part.store.select([recording])[0]
    rows = np.concatenate([spans, np.ones((len(spans), 1), np.int64)], axis=1)
    covered = joined(rows[np.argsort(rows[:, 0], kind="stable")])
    near = part.during(Intervals.of([(recording, covered)]))
    if _in_columns(near, spans, found):
        return found
    if part.store.database is not None and part.is_unbounded:
        keys = _expected(part.topics, entry, int((covered[:, 1] - covered[:, 0]).sum()))
        # Spans that overlap much are read together with less than they are asked about.
        if len(spans) <= 2 * len(covered) + keys / _SEVERAL:
            return _asked_each(part, entry, spans)
    times = np.sort(_times(near))
    first, after = np.searchsorted(times, spans[:, 0]), np.searchsorted(times, spans[:, 1])
    found[:] = first < after
    return found


def _in_columns(query: Query, spans: NDArray[np.int64], found: NDArray[np.bool_]) -> bool:
    """Mark the spans in which a message lies, if columns tell it; whether they do."""
    instead_s = cost_s(_SEVERAL * len(spans), windows=len(spans)) / len(query.topics)
    for topic in query.topics:
        parts = judged(query, topic, as_rows=True, instead_s=lambda: instead_s)
        if parts is None:
            return False
        for part in parts:
            times = part.columns.log_time[part.rows()]
            first, after = np.searchsorted(times, spans.T)
            found |= first < after
    return True


def _asked_each(query: Query, entry: RecordingEntry, spans: NDArray[np.int64]) -> NDArray[np.bool_]:
    """One small question a span and topic, which is answered by its first message."""
    index = query.store.index_for("A predicate", [entry])
    topics = [t for t in query.topics if any(c.topic == t for c in entry.channels)]
    rows = np.flatnonzero(spans[:, 1] > spans[:, 0])
    found = np.zeros(len(spans), np.bool_)
    predicate = query.filter
    for topic in topics:
        rows = rows[~found[rows]]
        conditions = [query.conditions(entry, (b, e)) for b, e in spans[rows].tolist()]
        asked: list[tuple[str, _Filter]] = [
            (collection_of(topic), {"$and": [own, predicate]} if predicate else own)
            for own in conditions
        ]
        found[rows] = np.array(index.count_each(asked, most=1), np.bool_)
    return found


def _times(query: Query) -> NDArray[np.int64]:
    """Log times of the messages of a question, ns, in no order."""
    from hybridlog.frames.bson import key_columns

    parts = [np.empty(0, np.int64)]
    if query.store.database is None:
        parts.extend(piece.batch.log_time for piece in query.pieces(query.plan()))
    else:
        for topic in query.topics:
            for raw, _, _ in query.thinned_documents(topic, {"_id": 1}):
                parts.append(key_columns(raw).time)
    return np.concatenate(parts)


def _expected(topics: Iterable[str], entry: RecordingEntry, length: int) -> float:
    """About how many messages of some topics a recording has in so many nanoseconds."""
    if entry.span is None:
        return 0.0
    messages = sum(map(entry.messages_of, topics))
    return messages * length / max(entry.span[1] - entry.span[0], 1)


def _messages(topic: str, recordings: Iterable[RecordingEntry]) -> int:
    """How many messages of a topic the catalog knows of."""
    return sum(recording.messages_of(topic) for recording in recordings)


def _is_whole(
    store: Store, database: Database, topic: str, recordings: Sequence[RecordingEntry]
) -> bool:
    """Whether a topic's collection has documents of these recordings only."""
    chosen = {entry.id for entry in recordings}
    for entry in store.recordings():
        # One that is being written may get the topic yet.
        is_possible = entry.status == "open" or any(c.topic == topic for c in entry.channels)
        if entry.id not in chosen and is_possible:
            return False
    if _has_strangers(store, database):
        return False
    return database.count(collection_of(topic)) == _messages(topic, recordings)


def _has_strangers(store: Store, database: Database) -> bool:
    """Whether there are recordings that the store did not know of when it was looked at."""
    labels = {entry.label for entry in store.recordings()} | store.repairs.copies.keys()
    if not labels.issuperset(store.directory.labels()):
        return True
    others = {"_id": {"$nin": sorted(entry.key for entry in store.recordings())}}
    return database.find_one(RECORDINGS, others, {"_id": 1}) is not None


def _counted(
    index: GuardedIndex, topic: str, recordings: Sequence[RecordingEntry], asked: _Filter
) -> int:
    """What a filter finds: with an index in one go, else in parts side by side."""
    collection = collection_of(topic)
    parts = min(_messages(topic, recordings) // _PART, _MOST_PARTS, processors())
    if parts < 2 or _is_served(index.database, collection, asked):
        return index.count(collection, asked)
    filters = [{"$and": [part, dict(asked)]} for part in _key_ranges(topic, recordings, parts)]
    with ThreadPoolExecutor(parts, thread_name_prefix="hybridlog-count") as pool:
        return sum(pool.map(lambda part: index.count(collection, part), filters))


def _key_ranges(
    topic: str, recordings: Sequence[RecordingEntry], parts: int
) -> Iterator[dict[str, object]]:
    """All keys there can be, cut where the times of a topic's messages are."""
    stats = [s for recording in recordings for s in recording.stats_of(topic)]
    first = min((s.first for s in stats if s.first is not None), default=0)
    last = max((s.last for s in stats if s.last is not None), default=TIME_LIMIT)
    edges = [key_bound(first + (last - first) * n // parts) for n in range(1, parts)]
    for low, high in zip([None, *edges], [*edges, None], strict=True):
        bounds = {} if low is None else {"$gte": low}
        yield {"_id": bounds if high is None else {**bounds, "$lt": high}}


def _is_served(database: Database, collection: str, asked: _Filter) -> bool:
    """Whether an index begins with a field that a filter names."""
    named = set(_names(asked))
    return any(keys[0][0] in named for keys in database.indexes(collection))


def _names(value: object) -> Iterator[str]:
    """Every path that a filter names, and more: what stands below operators too."""
    if isinstance(value, Mapping):
        for name, inner in value.items():
            if not str(name).startswith("$"):
                yield str(name)
            yield from _names(inner)
    elif isinstance(value, list | tuple):
        for inner in value:
            yield from _names(inner)
