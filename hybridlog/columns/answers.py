"""What kept columns answer of a question: which messages of a topic it is about."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

from hybridlog.columns.judged import Judged
from hybridlog.columns.kept import Asked, cost_s
from hybridlog.query.column_filter import column_filter

if TYPE_CHECKING:
    from hybridlog.query.column_filter import ColumnFilter
    from hybridlog.query.intervals import Span
    from hybridlog.reader import Query


def judged(
    query: Query,
    topic: str,
    fields: Collection[str] = (),
    *,
    as_rows: bool = False,
    instead_s: Callable[[], float] | None = None,
) -> tuple[Judged, ...] | None:
    """What columns say of one of a question's topics, of `limit` and `every` apart.

    Args:
        query: The question.
        topic: One of its topics.
        fields: Paths of fields that are needed besides those of the predicate.
        as_rows: Whether the messages themselves are wanted, not only their number.
        instead_s: Says what the answer costs without columns, if the caller knows better.

    Returns:
        One of each recording that has the topic; None if columns do not have it all, or
        are not worth getting.
    """
    store = query.store
    has_index = store.database if query.predicates or fields else store.connected
    if not all(predicate.is_exact for predicate in query.predicates):
        return None
    if has_index is None or not store.kept.most_bytes or not query.is_by_log_time:
        return None
    spans = None if query.is_unbounded else _spans(query)
    asked = Asked(
        topic,
        query.recording_ids,
        query.predicates,
        frozenset(fields),
        ordered=as_rows or spans is not None,
    )
    parts = store.kept.recall(asked)
    if parts is None:
        instead_s = instead_s or partial(_instead_s, query, topic, spans, as_rows=as_rows)
        parts = _found(query, asked, instead_s)
        if parts is None:
            return None
        store.kept.remember(asked, parts)
    if spans is None:
        return parts
    return tuple(replace(part, spans=spans.get(part.recording.id, [])) for part in parts)


def _found(query: Query, asked: Asked, instead_s: Callable[[], float]) -> tuple[Judged, ...] | None:
    """The same of all times."""
    kept = query.store.kept
    of_types: Mapping[str, str] = {}
    judge: ColumnFilter | None = None
    judges, recordings = [], []
    for recording in query.store.recordings():
        if recording.id not in asked.recording_ids or not recording.stats_of(asked.topic):
            continue
        types = kept.types(recording, asked.topic)
        if types is None or not types.keys() >= asked.fields:
            return None
        if asked.predicates and (judge is None or types != of_types):
            of_types, judge = types, column_filter(query.filter, types)
            if judge is None:
                return None
        judges.append(judge)
        recordings.append(recording)
    columns = kept.find(
        asked.topic,
        recordings,
        asked.fields.union(*(judge.fields for judge in judges if judge is not None)),
        ordered=asked.ordered,
        instead_s=instead_s,
        counters=query.counters,
    )
    if columns is None:
        return None
    return tuple(
        Judged(recording, own, judge, None)
        for recording, own, judge in zip(recordings, columns, judges, strict=True)
    )


def _spans(query: Query) -> dict[str, list[Span]]:
    spans: dict[str, list[Span]] = {}
    for recording, span in query.spans():
        spans.setdefault(recording.id, []).append(span)
    return spans


def _instead_s(
    query: Query, topic: str, spans: dict[str, list[Span]] | None, *, as_rows: bool
) -> float:
    """What MongoDB takes for the same."""
    messages, windows = 0.0, 1
    for recording in query.store.recordings():
        if recording.id not in query.recording_ids or recording.span is None:
            continue
        share = 1.0
        if spans is not None:
            own = spans.get(recording.id, [])
            windows += len(own)
            share = sum(end - begin for begin, end in own) / (
                recording.span[1] - recording.span[0] + 1
            )
        messages += share * recording.messages_of(topic)
    return cost_s(messages, windows=windows, as_rows=as_rows)
