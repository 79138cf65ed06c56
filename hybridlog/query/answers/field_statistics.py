"""Statistics of the numeric fields of messages."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np

from hybridlog.query.counters import Counters
from hybridlog.query.planner import Planner
from hybridlog.query.ranges import RangeResolver
from hybridlog.schema.kinds import NUMBERS
from hybridlog.schema.summary import Totals
from hybridlog_storage.errors import DefinitionError, UsageError

if TYPE_CHECKING:
    import pyarrow as pa

    from hybridlog.query.question import Part, Question
    from hybridlog.session import Session


@dataclass(frozen=True, slots=True)
class FieldStatistics:
    """Statistics of one numeric field of a topic, over all messages of a question.

    Attributes:
        topic: Full name of the topic.
        field: Path of the field.
        count: Number of finite numbers; the next four are of these.
        nan: Number of values that are NaN.
        infinite: Number of values that are infinite.
        min: Least number, exactly; None without any.
        max: Greatest number, exactly; None without any.
        mean: Mean; None without any.
        std: Standard deviation of the sample (n - 1); None of fewer than two.
    """

    topic: str
    field: str
    count: int
    nan: int
    infinite: int
    min: int | float | None
    max: int | float | None
    mean: float | None
    std: float | None


class _Running:
    """Statistics of the values so far, joined block by block."""

    def __init__(self) -> None:
        self.count = self.nan = self.infinite = 0
        self.least: int | float | None = None
        self.most: int | float | None = None
        self._total = Totals(1)
        self._mean = 0.0
        self._squares, self._exponent = 0.0, -1074  # squares of numbers divided by 2**exponent

    def add(self, column: pa.ChunkedArray[Any]) -> None:
        values = column.drop_null().to_numpy()
        if values.dtype.kind == "f":
            is_finite = np.isfinite(values)
            nan = int(np.isnan(values).sum())
            self.nan += nan
            self.infinite += len(values) - int(is_finite.sum()) - nan
            values = values[is_finite]
        if not len(values):
            return
        low, high = values.min().item(), values.max().item()
        self.least = low if self.least is None else min(self.least, low)
        self.most = high if self.most is None else max(self.most, high)
        numbers, count = values.astype(np.float64), len(values)
        before, own, first = self._mean, self._total, np.zeros(1, np.intp)
        if self.count:
            own = Totals(1)
            own.add(numbers, first, first)
        self._total.add(numbers, first, first)
        mean = float(own.means(np.array([count]))[0])
        size = max(abs(low), abs(high))
        exponent = max(math.frexp(size)[1] if size else self._exponent, self._exponent)
        self._squares = math.ldexp(self._squares, 2 * (self._exponent - exponent))
        self._exponent = exponent
        self._squares += float(
            np.square(np.ldexp(numbers, -exponent) - math.ldexp(mean, -exponent)).sum()
        )
        step = math.ldexp(mean, -exponent) - math.ldexp(before, -exponent)
        self._squares += step * step * self.count * count / (self.count + count)
        self.count += count
        self._mean = mean
        if own is not self._total:
            self._mean = float(self._total.means(np.array([self.count]))[0])

    @property
    def _std(self) -> float:
        with np.errstate(over="ignore"):  # it may be greater than the greatest double
            return float(np.ldexp(math.sqrt(self._squares / (self.count - 1)), self._exponent))

    def result(self, topic: str, field: str) -> FieldStatistics:
        few = self.count < 2
        return FieldStatistics(
            topic,
            field,
            self.count,
            self.nan,
            self.infinite,
            self.least,
            self.most,
            self._mean if self.count else None,
            None if few else self._std,
        )


def statistics(session: Session, question: Question, counters: Counters) -> list[FieldStatistics]:
    """Statistics of numeric fields; see `Query.stats`."""
    if not question.returns_all or question.reverse:
        raise UsageError("Statistics are of all messages: leave out limit, every and reverse.")
    counted = Counters()
    planner = Planner(session, question, counted)
    in_tables = _of_tables(planner)
    counters.add(counted)
    recordings = [row.summary.id for row in RangeResolver(session, question).resolve()]
    found = []
    for topic in question.topics:
        if topic in in_tables:
            found += [values.result(topic, name) for name, values in in_tables[topic].items()]
            continue
        one = replace(question, topics=(topic,))
        known = session.field_types((topic,), question.recordings)
        if question.fields is None and known is not None:
            numeric = tuple(_single_numbers(known))
            if not numeric:
                continue
            one = replace(one, fields=numeric)
        snapshot = session.look(one.recordings)
        having = {snapshot.summaries[place].id for place in session.chosen(one).tolist()}
        running: dict[str, _Running] = {}
        try:
            for recording in filter(having.__contains__, recordings):
                part = replace(one, recordings=(recording,))
                for name, column in _columns(session, part, counters):
                    running.setdefault(name, _Running()).add(column)
        except DefinitionError:
            if question.fields is not None or len(question.topics) == 1:
                raise  # otherwise, those of the topics that have fields
        found += [values.result(topic, name) for name, values in running.items()]
    if question.fields is not None and not found:
        raise UsageError(f"{', '.join(question.fields)}: no field with numbers.")
    return found


def _single_numbers(types: Mapping[str, str]) -> list[str]:
    """The fields of which each message has one number: none in lists of messages."""
    return [path for path, kind in types.items() if kind in NUMBERS and "[" not in path]


def _of_tables(planner: Planner) -> dict[str, dict[str, _Running]]:
    """Statistics of the topics whose fields stand in tables, planned together."""
    import pyarrow as pa
    import pyarrow.compute as pc

    by_topic: dict[str, list[Part]] = defaultdict(list)
    for part in planner.parts():
        by_topic[part.topic].append(part)
    found: dict[str, dict[str, _Running]] = {}
    for topic, parts in by_topic.items():
        types = parts[0].field_types or {}
        numbers = _single_numbers(types)
        fields = numbers if planner.question.fields is None else [*planner.question.fields]
        if (
            not fields
            or not {*fields} <= {*numbers}
            or not all(part.field_types == types for part in parts)
        ):
            continue
        read = planner.values_of_tables(parts, fields)
        if read is None:
            continue
        found[topic] = {path: _Running() for path in fields}
        for values in chain.from_iterable(read):
            planner.counters.messages += len(values.log_time)
            for path, running in found[topic].items():
                column = pc.struct_field(values.records, path.split("."))
                running.add(pa.chunked_array([column]))
    return found


def _columns(
    session: Session, question: Question, counters: Counters
) -> Iterator[tuple[str, pa.ChunkedArray[Any]]]:
    """The numeric columns of an answer, a block at a time; elements of arrays that are named."""
    import pyarrow.compute as pc

    from hybridlog.frames.answer import stream
    from hybridlog.schema.arrow_types import is_list, is_number

    counted = Counters()
    for table in stream(Planner(session, question, counted)):
        for field in table.schema:
            column = table[field.name]
            if question.fields is not None and is_list(field.type):
                column = pc.list_flatten(column)
            if is_number(column.type):
                yield field.name, column
    counters.add(counted)
