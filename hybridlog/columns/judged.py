"""All messages of a topic in a recording as columns, and what is asked of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hybridlog.columns.topic import TopicColumns
from hybridlog.query.column_filter import ColumnFilter
from hybridlog.schema.column import ranges, take

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.intervals import Span
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
