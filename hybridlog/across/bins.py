"""Aggregates of a topic's messages in bins of equal length: count, first, last, min, max, mean.

The bins begin at regular times, which are rows of an alignment too.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from itertools import chain
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa

from hybridlog.across.topic_reader import TIME, Block, TopicReader, concatenated
from hybridlog.frames.names import free_name, is_summary
from hybridlog.query.predicate.types import FieldTypes
from hybridlog.query.ranges import RangeResolver
from hybridlog.schema.arrow_columns import numbers
from hybridlog.schema.arrow_types import is_number, is_time
from hybridlog_storage.errors import UsageError
from hybridlog_storage.ordering import run_starts
from hybridlog_storage.times import placed

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.question import Question
    from hybridlog.session import Session


AGGREGATES: Final = ("count", "first", "last", "min", "max", "mean")
_OF_NUMBERS: Final = frozenset({"min", "max", "mean"})
_COUNT = "count"

MAX_TIMES = 100_000_000
"""Maximum number of rows of `resample`."""
_GRID_ROWS = 65_536


class Bins:
    """A topic beside regular times: gives what its messages say until the next time."""

    def __init__(self, reader: TopicReader, grid: RegularTimes, how: str) -> None:
        self._reader = reader
        self._grid = grid
        self._how = how
        self._none = self._reader.empty() if how != _COUNT else pa.table({})
        self._blocks: Iterator[Block] = iter(())

    def enter(self, recording: str, _end: int | None) -> None:
        """Go on with the messages of another recording."""
        self._recording, self._blocks = recording, self._reader.tables(recording)
        if self._how == _COUNT:
            self._blocks = ((times, pa.table({})) for times, _ in self._reader.times(recording))

    def decided(self, times: NDArray[np.int64]) -> int:
        """Number of times that are decided: all of them."""
        return len(times)

    def row_bytes(self) -> int:
        """Rows have a size of their own."""
        return 0

    def add(
        self, columns: dict[str, Any], times: NDArray[np.int64], _empty: Counter[tuple[str, str]]
    ) -> None:
        """Add the number of messages, and their fields, from each time to the next.

        The times are ns, of the grid, and not before those of the last call.
        """
        made = _Rows(self._how, len(times))
        made.add(self._none, np.empty(0, np.int64))
        if len(times):
            end = self._grid.end(self._recording, int(times[-1]))
            for known, table in self._until(end):
                row = (known - times[0]) // self._grid.step
                begin = int(np.searchsorted(row, 0))
                made.add(table.slice(begin), row[begin:])
        for field in self._reader.question.fields or ():
            if made.has_no_number(field):
                raise _no_number(field, self._reader.question.topics[0])
        name = free_name(self._reader.prefix + _COUNT, columns)
        columns[name] = pa.array(made.messages)
        self._reader.add(columns, made.table(), Counter(), len(times))

    def _until(self, end: int) -> Iterator[Block]:
        """The messages before a time that were not given yet."""
        for whole, table in self._blocks:
            times = placed(whole)
            cut = int(np.searchsorted(times, end))
            yield times[:cut], table.slice(0, cut)
            if cut < len(times):
                self._blocks = chain([(times[cut:], table.slice(cut))], self._blocks)
                return


def with_numbers(session: Session, question: Question, how: str) -> Question:
    """The question for the fields, or the requested ones, that are single numbers, also times.

    Times have no mean. The same question where all values count, or no definition fixes the fields.
    """
    known = session.field_types(question.topics, question.recordings)
    if known is None or how not in _OF_NUMBERS:
        return question
    types = FieldTypes.of(known)
    kinds = {"number", "bool"} if how == "mean" else {"number", "bool", "time"}
    single = [
        path
        for path, kind in known.items()
        if not (path.endswith("]") or "[" in path or "[" in kind) and types.kind(path) in kinds
    ]
    if question.fields is None:
        return replace(question, fields=tuple(single))
    chosen: list[str] = []
    for field in question.fields:
        below = [path for path in single if path == field or path.startswith(f"{field}.")]
        if not below and not is_summary(field, known):
            raise _no_number(field, question.topics[0])
        chosen += below or [field]
    return replace(question, fields=tuple(dict.fromkeys(chosen)))


def _no_number(field: str, topic: str) -> UsageError:
    return UsageError(
        f"{field} of {topic} is no single number: ask for its first or last value, or for a "
        "summary of an array, such as ranges.min."
    )


class _Rows:
    """The columns of some bins; `messages` counts those in each."""

    def __init__(self, how: str, size: int) -> None:
        self._how = how
        self.messages = np.zeros(size, np.int64)
        self._others: set[str] = set()  # columns with values that are no numbers
        self._columns: dict[str, _Column] = {}
        self._whole: list[pa.Table] = []  # the first or last messages of bins
        self._place = np.full(size, -1, np.int64)  # row of that of each bin
        self._given = 0

    def add(self, table: pa.Table, row: NDArray[np.int64]) -> None:
        """Add messages, not before those that were added; `row` is the bin of each, ascending."""
        begins = run_starts(row)
        bins, counts = row[begins], np.diff(np.append(begins, len(row)))
        if self._how in _OF_NUMBERS:
            for name, column in zip(table.column_names, table.columns, strict=True):
                found = _values_of(column, self._how)
                if found is not None:
                    if name not in self._columns:
                        self._columns[name] = _Column(self._how, len(self.messages))
                    values, is_value = found
                    self._columns[name].add(column.type, values, row[is_value])
                elif not pa.types.is_null(column.type):
                    self._others.add(name)
        elif self._how != _COUNT:
            chosen = begins if self._how == "first" else begins + counts - 1
            is_new = (self.messages[bins] == 0) | (self._how == "last")
            chosen = chosen[is_new]
            self._place[bins[is_new]] = self._given + np.arange(len(chosen))
            self._whole.append(table.take(pa.array(chosen)))
            self._given += len(chosen)
        self.messages[bins] += counts

    def has_no_number(self, field: str) -> bool:
        """True if a field has values, and none of them is a single number."""
        others, numeric = (
            any(name == field or name.startswith(f"{field}.") for name in names)
            for names in (self._others, self._columns)
        )
        return others and not numeric

    def table(self) -> pa.Table:
        """The columns."""
        if self._whole:
            missing = self._place < 0
            return concatenated(self._whole).take(pa.array(self._place, mask=missing))
        return pa.table({name: column.array() for name, column in self._columns.items()})


class _Column:
    """The aggregate of one column by bin."""

    def __init__(self, how: str, size: int) -> None:
        self._how = how
        self._choose = np.minimum if how == "min" else np.maximum
        self._count = np.zeros(size, np.int64)
        self._sums = np.zeros(size if how == "mean" else 0, np.longdouble)  # overflows by no double
        self._parts: list[tuple[NDArray[np.int64], NDArray[Any]]] = []  # bins, their values
        self._kinds: set[pa.DataType] = set()

    def add(self, kind: pa.DataType, values: NDArray[Any], row: NDArray[np.int64]) -> None:
        """Add values of an Arrow type in the bin of each."""
        begins = run_starts(row)
        bins = row[begins]
        if self._how != "mean":
            # An empty part has the type, too.
            self._parts.append((bins, self._choose.reduceat(values, begins)))
            self._kinds.add(kind)
        elif len(row):
            self._sums[bins] += np.add.reduceat(values, begins, dtype=np.longdouble)
        self._count[bins] += np.diff(np.append(begins, len(row)))

    def array(self) -> pa.Array[Any]:
        """The aggregate of each bin; null without any value."""
        missing = self._count == 0
        if self._how == "mean":
            means = self._sums / np.maximum(self._count, 1)
            return pa.array(means.astype(np.float64), mask=missing)
        row, values = (np.concatenate(parts) for parts in zip(*self._parts, strict=True))
        begins = run_starts(row)
        found = np.zeros(len(missing), values.dtype)
        found[row[begins]] = self._choose.reduceat(values, begins)
        made = pa.array(found, mask=missing)
        return made.cast(*self._kinds) if len(self._kinds) == 1 else made


def _values_of(column: Any, how: str) -> tuple[NDArray[Any], NDArray[np.bool_]] | None:
    """The numbers of a column that count, finite ones, and which these are; None of other types.

    Times have no mean.
    """
    kind = column.type
    if is_time(kind) and how != "mean":
        column = column.cast(pa.int64())
    elif pa.types.is_boolean(kind):
        column = column.cast(pa.uint8())
    elif not is_number(kind):
        return None
    is_valid = column.is_valid().to_numpy() if column.null_count else True
    values = (column.fill_null(0) if column.null_count else column).to_numpy()
    is_value = np.isfinite(values) & is_valid
    return values[is_value], is_value


class RegularTimes:
    """Regular times as rows: from the beginning of each recording, or of the asked range.

    The recordings and the range of the question count; the step is in ns, not zero.
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
            for first in range(begin, end, _GRID_ROWS * self.step):
                last = min(end, first + _GRID_ROWS * self.step)
                times = np.arange(first, last, self.step, dtype=np.int64)
                yield times, pa.table({TIME: numbers(times, "time")})
