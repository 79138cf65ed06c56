"""Aggregates of a topic's messages in bins of equal length: count, first, last, min, max, mean.

The bins begin at regular times, which are rows of an alignment too.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final, Literal, get_args

import numpy as np
import pyarrow as pa

from hybridlog.across.topic_reader import TIME, Stream, TopicReader, concatenated
from hybridlog.frames.names import is_summary
from hybridlog.query.answers.match_times import match_times
from hybridlog.query.counters import Counters
from hybridlog.query.predicate.types import FieldTypes
from hybridlog.query.ranges import RangeResolver
from hybridlog.schema.arrow_columns import numbers
from hybridlog.schema.arrow_types import is_number, is_time
from hybridlog.schema.summary import Totals
from hybridlog_storage.errors import TimeError, UsageError
from hybridlog_storage.ordering import run_starts
from hybridlog_storage.times import placed

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.question import Question
    from hybridlog.session import Session


Aggregate = Literal["count", "first", "last", "min", "max", "mean"]
AGGREGATES: Final[tuple[Aggregate, ...]] = get_args(Aggregate)
_OF_NUMBERS: Final = frozenset({"min", "max", "mean"})
_COUNT = "count"
_Block = tuple["NDArray[np.int64]", pa.Table]

MAX_TIMES = 100_000_000
"""Maximum number of rows of `resample`."""
_GRID_ROWS = 65_536


class Bins:
    """A topic beside regular times: gives what its messages say until the next time.

    Args:
        session: The open store.
        stream: The topic.
        grid: The times.
        how: What is asked of the messages of a bin.

    Raises:
        UsageError: a field has no single number, or the question has limit, every or reverse.
    """

    def __init__(
        self,
        session: Session,
        stream: Stream,
        grid: RegularTimes,
        *,
        how: Aggregate,
    ) -> None:
        if how in _OF_NUMBERS:
            fields = _numbers_of(session, stream, how)
            stream = replace(stream, question=replace(stream.question, fields=fields))
        self._reader = TopicReader(session, stream, "log")
        self._session = session
        self._grid = grid
        self._how: Aggregate = how
        self._counters = stream.counters
        self._none = self._reader.empty()[1] if how != _COUNT else pa.table({})
        self._recording = ""
        self._blocks: Iterator[_Block] = iter(())
        self._rest: _Block | None = None

    def enter(self, recording: str, _end: int | None) -> None:
        """Go on with the messages of another recording."""
        self._recording = recording
        self._rest = None
        self._blocks = self._times() if self._how == _COUNT else self._reader.tables(recording)

    def rows(self, times: NDArray[np.int64]) -> pa.Table:
        """The number of messages, and their fields, from each time to the next.

        Args:
            times: int64[n], ns, of the grid; not before those of the last call.
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
        return self._reader.named(
            made.table(), self._reader.prefix + _COUNT, pa.array(made.messages)
        )

    def _until(self, end: int) -> Iterator[_Block]:
        """The messages before a time that were not given yet."""
        while True:
            block = self._rest or next(self._blocks, None)
            self._rest = None
            if block is None:
                return
            times, table = block
            times = placed(times)
            cut = int(np.searchsorted(times, end))
            yield times[:cut], table.slice(0, cut)
            if cut < len(times):
                self._rest = times[cut:], table.slice(cut)
                return

    def _times(self) -> Iterator[_Block]:
        """Times of the messages, without their fields."""
        question = replace(self._reader.question, recordings=(self._recording,), fields=None)
        counters = Counters()
        try:
            for found in match_times(self._session, question, counters):
                yield found.log_time, pa.table({})
                counters.messages += len(found.log_time)
        except TimeError:
            return  # the range does not touch this recording
        finally:
            self._counters.add(counters)


def _numbers_of(session: Session, stream: Stream, how: Aggregate) -> tuple[str, ...] | None:
    """The fields of a topic, or the requested ones, that are single numbers, also times.

    Times have no mean. None if no definition fixes the fields.

    Raises:
        UsageError: a requested field has none.
    """
    question = stream.question
    known = session.field_types(question.topics, question.recordings)
    if known is None:
        return question.fields
    types = FieldTypes.of(known)
    kinds = {"number", "bool"} if how == "mean" else {"number", "bool", "time"}
    single = [
        path
        for path, kind in known.items()
        if not (path.endswith("]") or "[" in path or "[" in kind) and types.kind(path) in kinds
    ]
    if question.fields is None:
        return tuple(single)
    chosen: list[str] = []
    for field in question.fields:
        below = [path for path in single if path == field or path.startswith(f"{field}.")]
        if not below and not is_summary(field, known):
            raise _no_number(field, question.topics[0])
        chosen += below or [field]
    return tuple(dict.fromkeys(chosen))


def _no_number(field: str, topic: str) -> UsageError:
    return UsageError(
        f"{field} of {topic} is no single number; ask for a summary, such as {field}.min, or for "
        "its first or last value."
    )


class _Rows:
    """The columns of some bins.

    Attributes:
        messages: int64[size], messages in each bin.
    """

    def __init__(self, how: Aggregate, size: int) -> None:
        self._how: Aggregate = how
        self._size = size
        self.messages = np.zeros(size, np.int64)
        self._others: set[str] = set()  # columns with values that are no numbers
        self._columns: dict[str, _Column] = {}
        self._whole: list[pa.Table] = []
        self._place = np.full(size, -1, np.int64)  # row of the first or last message of a bin
        self._given = 0

    def add(self, table: pa.Table, row: NDArray[np.int64]) -> None:
        """Add messages, which are not before those that were added.

        Args:
            table: Their fields.
            row: int64[n], ascending, the bin of each.
        """
        begins = run_starts(row)
        bins, counts = row[begins], np.diff(np.append(begins, len(row)))
        if self._how in _OF_NUMBERS:
            for name, column in zip(table.column_names, table.columns, strict=True):
                found = _values_of(column)
                has_none = self._how == "mean" and pa.types.is_temporal(column.type)
                if found is not None and not has_none:
                    made = self._columns.setdefault(name, _Column(self._how, self._size))
                    made.add(column.type, *found, row)
                elif not pa.types.is_null(column.type):
                    self._others.add(name)
        elif self._how != _COUNT:
            is_new = self.messages[bins] == 0
            chosen = begins[is_new] if self._how == "first" else begins + counts - 1
            bins_of = bins[is_new] if self._how == "first" else bins
            self._place[bins_of] = self._given + np.arange(len(chosen))
            self._whole.append(table.take(pa.array(chosen)))
            self._given += len(chosen)
        self.messages[bins] += counts

    def has_no_number(self, field: str) -> bool:
        """True if a field has values, and none of them is a single number."""
        mine = [
            {name for name in names if name == field or name.startswith(f"{field}.")}
            for names in (self._others, self._columns)
        ]
        return bool(mine[0]) and not mine[1]

    def table(self) -> pa.Table:
        """The columns."""
        if self._how in _OF_NUMBERS:
            return pa.table({name: column.array() for name, column in self._columns.items()})
        if self._how == _COUNT:
            return pa.table({})
        missing = self._place < 0
        return concatenated(self._whole).take(pa.array(self._place, mask=missing))


class _Column:
    """The aggregate of one column by bin."""

    def __init__(self, how: Aggregate, size: int) -> None:
        self._how = how
        self._count = np.zeros(size, np.int64)
        self._totals = Totals(size if how == "mean" else 0)
        self._value: NDArray[Any] = np.zeros(size, np.uint8)
        self._kind: Any = None

    def add(
        self, kind: Any, values: NDArray[Any], is_value: NDArray[np.bool_], row: NDArray[np.int64]
    ) -> None:
        """Add values.

        Args:
            kind: Arrow type of the column.
            values: (n,), numbers.
            is_value: bool[n], False for those that do not count.
            row: int64[n], ascending, the bin of each.
        """
        if self._kind is None and self._how != "mean":
            self._value = self._value.astype(values.dtype)
        elif self._how != "mean":
            self._value = self._value.astype(np.result_type(self._value, values), copy=False)
        self._kind = kind if self._kind in {None, kind} else pa.from_numpy_dtype(self._value.dtype)
        chosen, row = values[is_value], row[is_value]
        if not len(row):
            return
        begins = run_starts(row)
        bins = row[begins]
        if self._how == "mean":
            self._totals.add(chosen.astype(np.float64), begins, bins)
        else:
            choose = np.minimum if self._how == "min" else np.maximum
            found = choose.reduceat(chosen, begins).astype(self._value.dtype)
            is_first = self._count[bins] == 0
            self._value[bins] = np.where(is_first, found, choose(self._value[bins], found))
        self._count[bins] += np.diff(np.append(begins, len(row)))

    def array(self) -> pa.Array[Any]:
        """The aggregate of each bin; null without any value."""
        missing = self._count == 0
        if self._how == "mean":
            return pa.array(self._totals.means(self._count), mask=missing)
        return pa.array(self._value, mask=missing).cast(self._kind)


def _values_of(column: Any) -> tuple[NDArray[Any], NDArray[np.bool_]] | None:
    """The numbers of a column, and which of them count: finite ones. None for other types."""
    kind = column.type
    if is_time(kind):
        column = column.cast(pa.int64())
    elif pa.types.is_boolean(kind):
        column = column.cast(pa.uint8())
    elif not is_number(kind):
        return None
    is_value = np.ones(len(column), np.bool_)
    if column.null_count:
        is_value = column.is_valid().to_numpy()
        column = column.fill_null(0)
    values = column.to_numpy()
    return values, is_value & np.isfinite(values)


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
