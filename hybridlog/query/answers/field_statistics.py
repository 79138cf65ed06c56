"""Statistics of the numeric fields of messages."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from hybridlog.query.planner import Planner
from hybridlog.query.question import field_types
from hybridlog.query.rows import summaries_in
from hybridlog.schema.kinds import NUMBERS
from hybridlog.schema.summary import Totals
from hybridlog_storage.errors import DefinitionError, UsageError

if TYPE_CHECKING:
    import pyarrow as pa

    from hybridlog.query.counters import Counters
    from hybridlog.query.question import Question, RecordedChannel
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

    def add(self, column: pa.Array[Any]) -> None:
        values = column.drop_null().to_numpy(zero_copy_only=False)
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
    planner = Planner(session, question, counters)
    found: dict[str, dict[str, _Running]] = {topic: {} for topic in question.topics}
    blind: DefinitionError | None = None
    for channel in planner.examples:
        try:
            _add(found[channel.channel.topic], question, _columns_of(channel, question))
        except DefinitionError as error:
            blind = error
    if blind is not None and (question.fields is not None or len(question.topics) == 1):
        raise blind  # otherwise, those of the topics that have fields
    for part in planner.decided(planner.parts()):
        if not all(channel.codec.indexed for channel in part.channels):
            continue
        fields = _numbers(part.field_types) if question.fields is None else question.fields
        for times, _, records in planner.columns(part, fields) if fields != [] else ():
            counters.messages += len(times)
            _add(found[part.topic], question, records)
    if question.fields is not None and not any(found.values()):
        raise UsageError(f"{', '.join(question.fields)}: no field with numbers.")
    return [
        values.result(topic, name)
        for topic, running in found.items()
        for name, values in running.items()
    ]


def _numbers(types: Mapping[str, str] | None) -> list[str] | None:
    """The fields of which each message has one number: none in lists of messages."""
    if types is None:
        return None
    return [path for path, kind in types.items() if kind in NUMBERS and "[" not in path]


def _columns_of(channel: RecordedChannel, question: Question) -> pa.StructArray:
    """The columns of a channel, without rows."""
    import pyarrow as pa

    from hybridlog.frames.columns import flat, with_summaries
    from hybridlog.schema.arrow_columns import structs

    types = field_types((channel,))
    fields = _numbers(types) if question.fields is None else question.fields
    arrays = {path.rpartition(".")[0] for path in summaries_in(fields, types)}
    empty = pa.array([], channel.arrow_type(None if fields is None else {*fields, *arrays}))
    return structs(with_summaries(flat(empty), fields), 0)


def _add(running: dict[str, _Running], question: Question, records: pa.StructArray) -> None:
    """Add numeric columns; elements of arrays that are named."""
    import pyarrow.compute as pc

    from hybridlog.schema.arrow_types import is_list, is_number

    for field, column in zip(records.type, records.flatten(), strict=True):
        if question.fields is not None and is_list(field.type):
            column = pc.list_flatten(column)  # noqa: PLW2901
        if is_number(column.type):
            running.setdefault(field.name, _Running()).add(column)
