"""From a query to intervals: states that hold, values that change, windows around events.

Everything is read from the index, a batch of documents at a time: keys for states and
windows, the fields in question for changes. No payload is read.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from hybridlog.columns.answers import judged
from hybridlog.columns.judged import Judged
from hybridlog.frames.bson import KeyColumns, key_columns, records_from_bson
from hybridlog.query.intervals import Changing, Holding, Intervals, Span, clipped, span_of
from hybridlog.query.times import TIME_LIMIT, DurationLike, parse_duration
from hybridlog.query.unequal import unequal
from hybridlog.schema.column import Scalars, flatten
from hybridlog_storage.bson_columns import split
from hybridlog_storage.collection_names import collection_of
from hybridlog_storage.distinct import distinct
from hybridlog_storage.errors import UsageError
from hybridlog_storage.index_documents import key_bound

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.frames.bson import BsonPart
    from hybridlog.reader import Query
    from hybridlog_storage.catalog import RecordingEntry

_KEY = {"_id": 1}
_BATCH = 50_000
_Filter = dict[str, object]


def states(query: Query, max_gap: DurationLike | None) -> Intervals:
    """Where the predicate of a query holds; see `Query.intervals`."""
    _check(query, "A state")
    gap = None if max_gap is None else parse_duration(max_gap)
    if gap == 0:
        raise UsageError("A message that is believed for no time makes no interval.")
    found = _by_recording(query)
    if found is not None:
        return Intervals.of(
            (entry.id, rows)
            for entry, span in query.spans()
            for rows in _states_kept(found[entry.id], span, gap)
        )
    return Intervals.of(
        (entry.id, rows)
        for entry, span in query.spans()
        for rows in _states_in(query, entry, span, gap)
    )


def changes(
    query: Query, fields: Sequence[str], pause: DurationLike, tolerance: float
) -> Intervals:
    """When fields change; see `Query.changes`."""
    _check(query, "A change")
    if not tolerance >= 0 or tolerance == np.inf:
        raise UsageError(f"A tolerance is a number from 0 on, not {tolerance}.")
    quiet = parse_duration(pause)
    leaves = _leaves(query, fields)
    found = None if leaves is None else _by_recording(query, leaves)
    if found is not None and leaves is not None:
        return Intervals.of(
            (entry.id, rows)
            for entry, span in query.spans()
            for rows in _changes_kept(found[entry.id], leaves, span, tolerance, Changing(quiet))
        )
    projection = {**_KEY, **dict.fromkeys(_outermost(fields), 1)}
    return Intervals.of(
        (entry.id, rows)
        for entry, span in query.spans()
        for rows in _changes_in(
            query, projection, entry, span, tolerance=tolerance, changing=Changing(quiet)
        )
    )


def windows(query: Query, before: DurationLike, after: DurationLike) -> Intervals:
    """Time around each message of a query; see `Query.windows`."""
    if len(query.topics) > 1 and not query.is_unthinned:
        raise UsageError(
            "Windows around only some messages of several topics: ask for one topic, or "
            "without `limit` and `every`."
        )
    if parse_duration(before) == parse_duration(after) == 0:
        raise UsageError("How long before or after? A window needs one of them.")
    names = {int(entry.key, 16): entry for entry in query.store.recordings()}
    parts: list[tuple[int, NDArray[np.int64]]] = []
    for topic in query.topics:
        found = judged(query, topic, as_rows=True) if query.is_unthinned else None
        if found is not None:
            parts.extend((int(p.recording.key, 16), p.columns.log_time[p.rows()]) for p in found)
            continue
        for raw, rows, _ in query.thinned_documents(topic, _KEY):
            keys = key_columns(raw).take(rows)
            numbers = distinct(keys.recording).tolist()
            parts.extend((number, keys.time[keys.recording == number]) for number in numbers)
    wide = Intervals.of(
        # Where windows begin together, those of the recording with the least key are first.
        (names[number].id, np.stack([time, time, np.ones_like(time)], axis=1))
        for number, time in sorted(parts, key=lambda part: part[0])
        if len(time)
    ).widened(before, after)
    return wide.within({entry.id: _extent(entry) for entry in names.values()})


def _extent(entry: RecordingEntry) -> Span:
    """Log time in which a recording has messages, or may have some by now."""
    if entry.span is None:
        return 0, TIME_LIMIT - 1
    begin, end = span_of(entry)
    return begin, TIME_LIMIT - 1 if entry.status == "open" else end


def _check(query: Query, what: str) -> None:
    if len(query.topics) != 1:
        raise UsageError(
            f"{what} is one topic's; this question has {len(query.topics)}: name one of "
            f"{', '.join(query.topics[:10])}."
        )
    if not query.is_unthinned or query.is_reversed:
        raise UsageError(f"{what} is found in all messages: limit, every and reverse do not fit.")


def _by_recording(query: Query, fields: Collection[str] = ()) -> dict[str, Judged] | None:
    """What columns say of the one topic of a question, by id of the recording."""
    found = judged(query, query.topics[0], fields, as_rows=True)
    return None if found is None else {part.recording.id: part for part in found}


def _states_kept(part: Judged, span: Span, max_gap: int | None) -> Iterator[NDArray[np.int64]]:
    time = part.columns.log_time
    low, high = np.searchsorted(time, span)
    holding = Holding(max_gap)
    if low:
        # What was said last before the range still holds when it begins.
        before = np.array([low - 1])
        yield clipped(holding.add(time[before], part.holds(before), counted=False), span)
    within = np.arange(low, high)
    yield clipped(holding.add(time[within], part.holds(within)), span)
    yield clipped(holding.finish(span_of(part.recording)[1]), span)


def _changes_kept(
    part: Judged, leaves: Collection[str], span: Span, tolerance: float, changing: Changing
) -> Iterator[NDArray[np.int64]]:
    rows = np.flatnonzero(part.holds())  # also those before the range
    low, high = np.searchsorted(part.columns.log_time[rows], span)
    rows = rows[max(low - 1, 0) : high]
    differs = np.zeros(max(len(rows) - 1, 0), np.bool_)
    for path in leaves:
        differs |= unequal(part.columns.fields[path], rows[1:], rows[:-1], tolerance)
    yield changing.add(part.columns.log_time[rows[1:][differs]])
    yield changing.finish()


def _leaves(query: Query, fields: Sequence[str]) -> set[str] | None:
    """Single values that fields are made of; None if there are others among them."""
    known = query.field_types() or {}
    messages = {path.rpartition(".")[0] for path in known}
    found: set[str] = set()
    for field in fields:
        inner = f"{field}.", f"{field}["
        below = {path for path in known if path == field or path.startswith(inner)} - messages
        if not below:
            return None
        found |= below
    return found


def _states_in(
    query: Query, entry: RecordingEntry, span: Span, max_gap: int | None
) -> Iterator[NDArray[np.int64]]:
    holding = Holding(max_gap)
    start = _key_before(query, entry, span, {})
    if start is not None:
        # What was said last before the range still holds when it begins.
        time = np.array([int.from_bytes(start[:8], "big")])
        yield clipped(holding.add(time, _holds(query, start), counted=False), span)
    yes = _keys(query, _asked(entry, span, query.filter))
    no: Iterator[KeyColumns] = iter(())
    if query.filter:
        no = _keys(query, _asked(entry, span, {"$nor": [query.filter]}))
    for times, holds in _merged(yes, no):
        yield clipped(holding.add(times, holds), span)
    yield clipped(holding.finish(span_of(entry)[1]), span)


def _holds(query: Query, key: bytes) -> NDArray[np.bool_]:
    """Whether the message with a key satisfies the predicate, as an array of one."""
    own: _Filter = {"_id": key}
    if query.filter:
        own = {"$and": [own, query.filter]}
    index = query.index_for("A state")
    # An index of the user's on the predicate's fields would be the long way to one document.
    return np.array([bool(index.count(collection_of(query.topics[0]), own, by_key=True))])


def _merged(
    yes: Iterator[KeyColumns], no: Iterator[KeyColumns]
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.bool_]]]:
    """Two streams of keys as one in order, with the stream that each is from."""
    left, right = next(yes, None), next(no, None)
    while left is not None and right is not None:
        # No key up to the nearer end can come any more, from either.
        end = min((int(k.time[-1]), int(k.seq[-1])) for k in (left, right))
        here, there = left.place_after(*end), right.place_after(*end)
        time = np.concatenate([left.time[:here], right.time[:there]])
        seq = np.concatenate([left.seq[:here], right.seq[:there]])
        order = np.lexsort((seq, time))
        yield time[order], order < here
        left = left.take(slice(here, None)) if here < len(left) else next(yes, None)
        right = right.take(slice(there, None)) if there < len(right) else next(no, None)
    while left is not None:
        yield left.time, np.ones(len(left), np.bool_)
        left = next(yes, None)
    while right is not None:
        yield right.time, np.zeros(len(right), np.bool_)
        right = next(no, None)


def _changes_in(
    query: Query,
    projection: Mapping[str, object],
    entry: RecordingEntry,
    span: Span,
    *,
    tolerance: float,
    changing: Changing,
) -> Iterator[NDArray[np.int64]]:
    index = query.index_for("A change")
    collection = collection_of(query.topics[0])
    carried = b""
    start = _key_before(query, entry, span, query.filter)
    if start is not None:
        carried = b"".join(index.find_raw(collection, {"_id": start}, projection))
    asked = _asked(entry, span, query.filter)
    for raw in index.find_raw(collection, asked, projection, sort=[("_id", 1)], batch_size=_BATCH):
        documents = carried + raw
        starts = split(documents)
        if len(starts):
            query.counters.documents_read += len(starts) - bool(carried)
            # The next batch begins with what it is compared to.
            carried = documents[int(starts[-1]) :]
            yield changing.add(_steps(documents, len(starts), tolerance))
    yield changing.finish()


def _outermost(fields: Sequence[str]) -> list[str]:
    """Paths as MongoDB writes them, without those inside of others."""
    plain = [field.replace("[*]", "").replace("[]", "") for field in fields]
    return [path for path in plain if not any(path.startswith(f"{other}.") for other in plain)]


def _steps(documents: bytes, count: int, tolerance: float) -> NDArray[np.int64]:
    """Log times of documents whose fields differ from those of the one before."""
    parts = records_from_bson(documents, {})
    if len(parts) > 1:
        # JSON has whole numbers among others; as one type they can be compared.
        parts = records_from_bson(documents, dict.fromkeys(_numbers(parts), np.dtype(np.float64)))
    time = np.empty(count, np.int64)
    differs = np.ones(count, np.bool_)
    for part in parts:
        time[part.rows] = part.reference.t
        follows = np.flatnonzero(np.diff(part.rows) == 1)
        differs[part.rows[follows + 1]] = unequal(part.records, follows + 1, follows, tolerance)
    differs[0] = False  # nothing is known before it, or it has been told already
    return time[differs]


def _numbers(parts: tuple[BsonPart, ...]) -> list[str]:
    """Paths of plain numbers."""
    return [
        path
        for part in parts
        for path, column in flatten(part.records).items()
        if isinstance(column, Scalars) and column.values.dtype.kind in "iuf"
    ]


def _asked(entry: RecordingEntry, span: Span, predicate: Mapping[str, object]) -> _Filter:
    """Documents of a recording in a span of log time that satisfy a predicate."""
    own: _Filter = {
        "_id": {"$gte": key_bound(span[0]), "$lt": key_bound(span[1])},
        "_meta.rec": entry.key,
    }
    return {"$and": [own, dict(predicate)]} if predicate else own


def _key_before(
    query: Query, entry: RecordingEntry, span: Span, predicate: Mapping[str, object]
) -> bytes | None:
    """Key of the last message before a span; None when there is none."""
    assert entry.span is not None
    if span[0] <= entry.span[0]:
        return None
    before = entry.span[0], span[0]
    found = query.index_for("What was before").find_one(
        collection_of(query.topics[0]),
        _asked(entry, before, predicate),
        _KEY,
        sort=[("_id", -1)],
    )
    return None if found is None else bytes(found["_id"])


def _keys(query: Query, asked: _Filter) -> Iterator[KeyColumns]:
    """Keys of the documents that a filter finds, in order, never an empty batch."""
    index = query.index_for("A state")
    for raw in index.find_raw(
        collection_of(query.topics[0]), asked, _KEY, sort=[("_id", 1)], batch_size=_BATCH
    ):
        keys = key_columns(raw)
        query.counters.documents_read += len(keys)
        if len(keys):
            yield keys
