"""What kept columns answer of a question: which messages of a topic it is about."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from hybridlog.columns.kept import cost_s
from hybridlog.columns.topic import TopicColumns
from hybridlog.query.column_filter import ColumnFilter, combined
from hybridlog.schema.column import ranges, take

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.intervals import Span
    from hybridlog.reader import Query
    from hybridlog_storage.catalog import RecordingEntry


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """All messages of a topic in a recording, and what is asked of them.

    Attributes:
        recording: The recording.
        columns: The messages, in order.
        predicate: Of which messages; None for all.
        spans: In which ranges of log time, apart and in order; None for all times.
    """

    recording: RecordingEntry
    columns: TopicColumns
    predicate: ColumnFilter | None
    spans: Sequence[Span] | None

    def holds(self, rows: NDArray[np.intp] | None = None) -> NDArray[np.bool_]:
        """Of which of some messages, or of all, the predicate holds: bool[n]."""
        count = len(self.columns) if rows is None else len(rows)
        if self.predicate is None:
            return np.ones(count, np.bool_)
        fields = {path: self.columns.fields[path] for path in self.predicate.fields}
        if rows is not None:
            fields = {path: take(column, rows) for path, column in fields.items()}
        return self.predicate.mask(fields, count)

    def rows(self) -> NDArray[np.intp]:
        """Messages in the ranges of which the predicate holds, in order."""
        if self.spans is None:
            return np.flatnonzero(self.holds())
        low, high = self._within(self.spans)
        rows = ranges(low, high - low)
        return rows if self.predicate is None else rows[self.holds(rows)]

    def count(self) -> int:
        """Number of these messages."""
        if self.spans is None:
            return int(np.count_nonzero(self.holds()))
        if self.predicate is None:
            low, high = self._within(self.spans)
            return int((high - low).sum())
        return len(self.rows())

    def _within(self, spans: Sequence[Span]) -> NDArray[np.intp]:
        """First messages of ranges, and those behind their last ones: intp[2, n]."""
        bounds = np.array(spans, np.int64).reshape(-1, 2)
        return np.searchsorted(self.columns.log_time, bounds).T


def judged(
    query: Query,
    topic: str,
    fields: Collection[str] = (),
    *,
    as_rows: bool = False,
    instead_s: Callable[[], float] | None = None,
) -> list[Judged] | None:
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
    if store.database is None or not store.kept.most_bytes or not query.is_by_log_time:
        return None
    spans = None if query.is_unbounded else _spans(query)
    filters, wanted, recordings = [], set(fields), []
    for recording in store.recordings():
        if recording.id not in query.recording_ids or not recording.stats_of(topic):
            continue
        types = store.kept.types(recording, topic)
        if types is None or not types.keys() >= set(fields):
            return None
        found = None
        if query.predicates:
            found = combined([predicate.on_columns(types) for predicate in query.predicates])
            if found is None:
                return None
            wanted |= found.fields
        filters.append(found)
        recordings.append(recording)
    columns = store.kept.find(
        topic,
        recordings,
        wanted,
        ordered=as_rows or spans is not None,
        instead_s=instead_s or partial(_instead_s, query, topic, spans, as_rows=as_rows),
        counters=query.counters,
    )
    if columns is None:
        return None
    return [
        Judged(
            recording,
            own,
            part,
            None if spans is None else spans.get(recording.id, []),
        )
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
        messages += share * recording.messages_of(topic)
    return cost_s(messages, windows=windows, as_rows=as_rows)
