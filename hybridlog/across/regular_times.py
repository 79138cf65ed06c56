"""Regular times as the rows of an alignment."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa

from hybridlog.across.topic_reader import TIME
from hybridlog.query.ranges import RangeResolver
from hybridlog.schema.arrow_columns import numbers
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.question import Question
    from hybridlog.session import Session

MAX_TIMES = 100_000_000
"""Maximum number of rows of `resample`."""
_GRID_ROWS = 65_536


class RegularTimes:
    """Regular times as rows: from the beginning of each recording, or of the asked range.

    Args:
        session: The open store.
        question: The question whose recordings and range count.
        step: Time between two rows, ns.

    Attributes:
        step: The step.

    Raises:
        UsageError: the step is zero.
    """

    def __init__(self, session: Session, question: Question, step: int) -> None:
        if step == 0:
            raise UsageError("A step of 0 gives no times: name a duration, such as 100ms.")
        self.question = question
        self.step = step
        spans: dict[str, list[tuple[int, int]]] = {}
        for summary, span in RangeResolver(session, question).spans():
            spans.setdefault(summary.id, []).append(span)
        self._spans = spans
        rows = sum((end - begin) // step for found in spans.values() for begin, end in found)
        if rows > MAX_TIMES:
            raise UsageError(f"There would be {rows} rows; use a longer step or a time range.")

    def end(self, recording: str, time: int) -> int:
        """End of the bin that begins at a time: the next time, or the end of the range."""
        spans = self._spans[recording]
        return min(time + self.step, next(end for begin, end in spans if begin <= time < end))

    def empty(self) -> pa.Table:
        """No rows."""
        return pa.table({TIME: numbers(np.empty(0, np.int64), "time")})

    def tables(self, recording: str) -> Iterator[tuple[NDArray[np.int64], pa.Table]]:
        """The times in a recording."""
        for begin, end in self._spans.get(recording, []):
            first = begin
            while first < end:
                last = min(end, first + _GRID_ROWS * self.step)
                times = np.arange(first, last, self.step, dtype=np.int64)
                yield times, pa.table({TIME: numbers(times, "time")})
                first = last if last == end else first + len(times) * self.step
