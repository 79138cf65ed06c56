"""Regular times as rows, and aggregates of a topic's messages from each to the next.

The aggregates are count, first, last, min, max, mean.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa
from msgspec.structs import replace

from hybridlog.across.topic_reader import TIME, Beside, Block, Empty, nanoseconds
from hybridlog.frames.names import free_name, is_summary
from hybridlog.query.predicate.types import FieldTypes
from hybridlog.query.ranges import RangeResolver
from hybridlog.schema.arrow_columns import numbers
from hybridlog.schema.arrow_types import is_number, is_time
from hybridlog_storage.errors import UsageError
from hybridlog_storage.messages import run_starts
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


class Bins(Beside):
    """A topic beside regular times: gives what its messages say until the next time."""

    def __init__(
        self, session: Session, question: Question, *, how: str, grid: RegularTimes, prefix: str
    ) -> None:
        super().__init__(session, question, how=how, prefix=prefix)
        self._grid = grid

    def _fit(self, size: int) -> None:
        super()._fit(size)
        if self._how not in {"first", "last"}:
            self.most = _GRID_ROWS  # an aggregate has no size

    def add(self, columns: dict[str, Any], times: NDArray[np.int64], empty: Empty) -> None:
        """Add the number of messages, and their fields, from each time, ns, to the next."""
        edges = times[:0]
        if len(times):
            edges = np.append(times, self._grid.end(self._recording, int(times[-1])))
        places = np.searchsorted(placed(self._moments.time), edges)
        counts = np.diff(places)
        columns[free_name(self.prefix + _COUNT, columns)] = pa.array(counts)
        if self._how == _COUNT:
            self.counters.messages += int(counts.sum())
            return
        if self._how in _OF_NUMBERS:
            table = self._aggregates(edges)
        else:
            chosen = places[1:] - 1 if self._how == "last" else places[:-1]
            (table,) = self._read(np.where(counts > 0, chosen, -1))
        self.put(columns, table, Counter(), len(times))

    def _aggregates(self, edges: NDArray[np.int64]) -> pa.Table:
        """The aggregate of each column of numbers, from each of some times, ns, to the next."""
        found: dict[str, _Column] = {}
        others: set[str] = set()  # columns with values that are no numbers
        size = max(len(edges) - 1, 0)
        windows = np.array([edges[[0, -1]]]) if size else edges.reshape(0, 2)
        for table in (self.empty, *self.within(self._recording, windows)):
            row = (placed(nanoseconds(table[TIME])) - edges[:1]) // self._grid.step
            for name, column in zip(table.column_names, table.columns, strict=True):
                numeric = _values_of(column, self._how)
                if numeric is not None:
                    values, is_value = numeric
                    own = found.setdefault(name, _Column(self._how, size))
                    own.add(column.type, values, row[is_value])
                elif not pa.types.is_null(column.type):
                    others.add(name)
        for field in self.question.fields or ():
            some, numeric_ones = (
                any(name == field or name.startswith(f"{field}.") for name in names)
                for names in (others, found)
            )
            if some and not numeric_ones:
                raise _no_number(field, self.question.topics[0])
        return pa.table({name: column.array() for name, column in found.items()})


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
        """Add values of an Arrow type in the bin of each, ascending."""
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

    empty: Final = pa.table({TIME: numbers(np.empty(0, np.int64), "time")})

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

    def rows(self, recording: str) -> Iterator[Block]:
        """The times in a recording."""
        for begin, end in self._spans.get(recording, []):
            for first in range(begin, end, _GRID_ROWS * self.step):
                last = min(end, first + _GRID_ROWS * self.step)
                times = np.arange(first, last, self.step, dtype=np.int64)
                yield times, pa.table({TIME: numbers(times, "time")})
