"""What kept columns answer of a question: which messages of a topic it is about."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hybridlog.kept_columns import TopicColumns, cost_s
from hybridlog.query.column_filter import ColumnFilter, column_filter
from hybridlog.schema.column import ranges, take

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.intervals import Span
    from hybridlog.reader import Query
    from hybridlog_storage.catalog import RecordingEntry


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """All messages of a topic in a recording, and a predicate.

    Attributes:
        recording: The recording.
        columns: The messages, in order.
        predicate: What is asked of them; None for nothing.
    """

    recording: RecordingEntry
    columns: TopicColumns
    predicate: ColumnFilter | None

    def holds(self, rows: NDArray[np.intp] | None = None) -> NDArray[np.bool_]:
        """Of which of some messages, or of all, the predicate holds: bool[n]."""
        count = len(self.columns) if rows is None else len(rows)
        if self.predicate is None:
            return np.ones(count, np.bool_)
        fields = {path: self.columns.fields[path] for path in self.predicate.fields}
        if rows is not None:
            fields = {path: take(column, rows) for path, column in fields.items()}
        return self.predicate.mask(fields, count)

    def rows(self, spans: Sequence[Span] | None = None) -> NDArray[np.intp]:
        """Messages of which it holds, in order.

        Args:
            spans: Only those in one of these ranges of log time, which are apart and in
                order; None for all.
        """
        if spans is None:
            return np.flatnonzero(self.holds())
        bounds = np.array(spans, np.int64).reshape(-1, 2)
        low, high = np.searchsorted(self.columns.log_time, bounds).T
        rows = ranges(low, high - low)
        return rows if self.predicate is None else rows[self.holds(rows)]

    def count(self, spans: Sequence[Span] | None = None) -> int:
        """Number of messages of which it holds."""
        return int(np.count_nonzero(self.holds())) if spans is None else len(self.rows(spans))


def whole(query: Query, topic: str, fields: Collection[str] = ()) -> dict[str, Judged] | None:
    """All messages of a topic, and what a question about some time says of them.

    Args:
        query: The question.
        topic: One of its topics.
        fields: Paths of fields that are needed besides those of the predicate.

    Returns:
        By id of the recording; None if columns do not have it all, or are not worth getting.
    """
    found = _asked(query, topic, fields, as_rows=True)
    return None if found is None else {part.recording.id: part for part, _ in found}


def chosen(
    query: Query,
    topic: str,
    fields: Collection[str] = (),
    *,
    as_rows: bool = False,
    instead_s: float | None = None,
) -> list[tuple[Judged, NDArray[np.intp]]] | None:
    """Messages of a topic that a question is about, of `limit` and `every` apart.

    Args:
        query: The question.
        topic: One of its topics.
        fields: Paths of fields that are needed besides those of the predicate.
        as_rows: Whether the messages themselves are wanted, not only their number.
        instead_s: What the answer costs without columns, if the caller knows it.

    Returns:
        Of each recording its columns and rows, ascending; None as in `whole`.
    """
    found = _asked(query, topic, fields, as_rows=as_rows, instead_s=instead_s)
    return None if found is None else [(part, part.rows(spans)) for part, spans in found]


def count(query: Query, topic: str) -> int | None:
    """Number of messages of a topic that a question is about; None as in `whole`."""
    found = _asked(query, topic)
    return None if found is None else sum(part.count(spans) for part, spans in found)


def _asked(
    query: Query,
    topic: str,
    fields: Collection[str] = (),
    *,
    as_rows: bool = False,
    instead_s: float | None = None,
) -> list[tuple[Judged, list[Span] | None]] | None:
    """Columns of each recording, and the ranges of time that a question is about."""
    store = query.store
    if store.database is None or not store.kept.most_bytes or not query.is_by_log_time:
        return None
    spans = None if query.is_unbounded else _spans(query)
    if instead_s is None:
        instead_s = _instead_s(query, topic, spans, as_rows=as_rows)
    found = _judged(query, topic, fields, instead_s)
    if found is None:
        return None
    return [(part, None if spans is None else spans.get(part.recording.id, [])) for part in found]


def _judged(
    query: Query, topic: str, fields: Collection[str], instead_s: float
) -> list[Judged] | None:
    """What columns say of a topic, whatever the time range; None as in `whole`."""
    store = query.store
    predicate = query.filter
    filters, wanted, recordings = [], set(fields), []
    for recording in store.recordings():
        if recording.id not in query.recording_ids:
            continue
        if not any(c.topic == topic for c in recording.channels):
            continue
        types = store.kept.types(recording, topic)
        if types is None or not types.keys() >= set(fields):
            return None
        found = column_filter(predicate, types)
        if found is None:
            return None
        filters.append(found)
        wanted |= found.fields
        recordings.append(recording)
    columns = store.kept.find(
        topic, recordings, wanted, instead_s=instead_s, counters=query.counters
    )
    if columns is None:
        return None
    return [
        Judged(recording, own, part if predicate else None)
        for recording, own, part in zip(recordings, columns, filters, strict=True)
    ]


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
        messages += share * sum(c.stats.messages for c in recording.channels if c.topic == topic)
    return cost_s(messages, windows=windows, as_rows=as_rows)
