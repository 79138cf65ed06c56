"""Statistics of numeric fields, and gaps and regularity of topics.

The times of a topic in a recording are in memory at once, 8 bytes a message.

Fields of a topic without a definition are inferred from its first messages.
"""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from itertools import groupby, islice
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec import Struct

from hybridlog.query.intervals import GAP_PERIODS, Intervals, mean_rate, usual_period
from hybridlog.query.planner import Planner, log_spans, resolved
from hybridlog.query.question import windows_in
from hybridlog.query.times import DurationLike, parse_duration
from hybridlog.schema.definition import FieldPath
from hybridlog.schema.definition_text import NUMBERS
from hybridlog.wording import listed
from hybridlog_storage.errors import PayloadError, UsageError

if TYPE_CHECKING:
    from hybridlog.message import Message

if TYPE_CHECKING:
    import pyarrow as pa
    from numpy.typing import NDArray

    from hybridlog.query.question import Counters, Question, Span
    from hybridlog.session import Session
    from hybridlog_storage.catalog import RecordingSummary

    Times = NDArray[np.int64]


class FieldStatistics(Struct, frozen=True):
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
        self._mean = self._squares = np.longdouble(0)  # which no square of a double overflows

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
        numbers, count = values.astype(np.longdouble), len(values)
        mean = numbers.mean()
        step, share = mean - self._mean, count / (self.count + count)
        self._squares += np.square(numbers - mean).sum() + step * step * self.count * share
        self._mean += step * share
        self.count += count

    def result(self, topic: str, field: str) -> FieldStatistics:
        few = self.count < 2
        with np.errstate(over="ignore"):  # it may be greater than the greatest double
            std = float(np.sqrt(self._squares / max(self.count - 1, 1)))
        return FieldStatistics(
            topic,
            field,
            self.count,
            self.nan,
            self.infinite,
            self.least,
            self.most,
            float(self._mean) if self.count else None,
            None if few else std,
        )


def statistics(session: Session, question: Question, counters: Counters) -> list[FieldStatistics]:
    """Statistics of numeric fields; see `Query.stats`."""
    from hybridlog.frames.answer import check_definitions, columns

    _check_all(question)
    planner = Planner(session, question, counters)
    found: dict[str, dict[str, _Running]] = {topic: {} for topic in question.topics}
    for part in planner.parts():
        if not (part.has_fields or (part.predicate and part.predicate.asks_fields)):
            continue
        fields = _numbers(part.field_types) if question.fields is None else question.fields
        if fields == []:
            continue
        for rows in columns(planner, part, fields, partial=True):
            counters.messages += len(rows.log_time)
            _add(found[part.topic], question, rows.records)
    if not any(found.values()):
        check_definitions(planner.examples)
    if question.fields is not None and counters.messages and not any(found.values()):
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


def _add(running: dict[str, _Running], question: Question, records: pa.StructArray) -> None:
    """Add numeric columns; elements of arrays that are named."""
    import pyarrow.compute as pc

    from hybridlog.schema.arrow_types import is_list, is_number

    for field, column in zip(records.type, records.flatten(), strict=True):
        if question.fields is not None and is_list(field.type):
            column = pc.list_flatten(column)  # noqa: PLW2901
        if is_number(column.type):
            running.setdefault(field.name, _Running()).add(column)


class TopicCheck(Struct, frozen=True):
    """Regularity of a topic in a recording, or in a range of it.

    Attributes:
        recording: Name of the recording.
        topic: Full name.
        type: Type of the messages; several have commas between them.
        begin_ns: Beginning of the recording or the range.
        messages: Number of messages.
        rate_hz: Mean rate from the first message to the last; None of fewer than two.
        period_ns: Usual time from one message to the next, which nine of ten do not exceed.
        jitter_ns: Standard deviation of the times from one message to the next.
        gap_ns: Longest time from one message to the next.
        gap_begin_ns: Beginning of this time.
        late_ns: Time from the beginning to the first message; None without messages.
        early_ns: Time from the last message to the end; None without messages.
        lost: Messages lost, as far as the ledger names the topic; None for an unknown number.
        is_latched: The last message holds until the next: nothing starts late or stops early.
    """

    recording: str
    topic: str
    type: str
    begin_ns: int
    messages: int = 0
    rate_hz: float | None = None
    period_ns: float | None = None
    jitter_ns: float | None = None
    gap_ns: int | None = None
    gap_begin_ns: int | None = None
    late_ns: int | None = None
    early_ns: int | None = None
    lost: int | None = 0
    is_latched: bool = False

    @property
    def silent_periods(self) -> float:
        """Longest time without a message in usual periods; 0 where a period is not known.

        A late start and an early stop are such times, and without messages it is infinite.
        """
        if not self.messages:
            return math.inf
        ends = (0, 0) if self.is_latched else (self.late_ns or 0, self.early_ns or 0)
        return max(self.gap_ns or 0, *ends) / self.period_ns if self.period_ns else 0.0


def gaps(
    session: Session,
    question: Question,
    counters: Counters,
    longer_than: DurationLike | None,
    periods: float | None,
) -> Intervals:
    """Times without messages; see `Query.gaps`."""
    _check_all(question)
    if len(question.topics) != 1:
        raise UsageError(
            f"A gap is one topic's; this question has {len(question.topics)}: name one "
            f"of {listed(question.topics)}."
        )
    least = 0 if longer_than is None else parse_duration(longer_than)
    if periods is None and longer_than is None:
        periods = GAP_PERIODS
    if periods is not None and not 0 < periods < float("inf"):
        raise UsageError(f"A number of periods is more than 0, not {periods}.")
    planner = Planner(session, question, counters)
    found: list[tuple[str, Times]] = []
    for summary, rows in groupby(log_spans(session, question), itemgetter(0)):
        own = [
            (span, planner.times(part))
            for _, span in rows
            for part in planner.parts_in(summary, windows_in(None, span))
        ]
        limit = float(least)
        if periods is not None:
            steps = (np.diff(times) for _, times in own)
            usual = usual_period(np.concatenate([np.empty(0, np.int64), *steps]))
            if not usual:
                continue  # one message does not tell when the next one was due
            limit = max(limit, periods * usual)
        for span, times in own:
            edges = np.concatenate([span[:1], times, [_end(summary, span)]])
            places = np.flatnonzero(np.diff(edges) > limit)
            none = np.zeros(len(places), np.int64)
            found.append((summary.id, np.stack([edges[places], edges[places + 1], none], axis=1)))
    return Intervals(found)


def check(
    session: Session, question: Question, counters: Counters | None = None
) -> list[TopicCheck]:
    """Regularity of topics, the worst first; see `Query.check`."""
    from hybridlog.query.answers.completeness import completeness_of
    from hybridlog.query.latching import depth_of

    _check_all(question)
    planner = Planner(session, question, counters)
    lost: dict[tuple[str, str], list[int | None]] = defaultdict(list)
    for row in completeness_of(session, question).rows:
        lost[row["recording"], row["topic"]].append(row["count"])
    silent = (
        (recording, (0, 0))
        for recording, windows, _ in resolved(session, question)
        if recording.span is None and windows is None
    )
    found = []
    for summary, span in [*log_spans(session, question), *silent]:
        within = planner.parts_in(summary, windows_in(None, span))
        parts = {part.topic: part for part in within}
        entry = session.entry_of(summary)
        for topic in sorted({*question.topics} & entry.topics):
            part, counts = parts.get(topic), lost[summary.name, topic]
            times = np.empty(0, np.int64) if part is None else planner.times(part)
            channels = [one.channel for one in session.channels_of(entry, [topic])]
            types = {one.schema.name for one in channels if one.schema is not None}
            found.append(
                TopicCheck(
                    summary.name,
                    topic,
                    ", ".join(sorted(types)),
                    span[0],
                    lost=None if None in counts else sum(count or 0 for count in counts),
                    is_latched=any(map(depth_of, channels)),
                    **_measured(times, summary, span),
                )
            )
    return sorted(
        found,
        key=lambda one: (one.silent_periods, one.lost is None, one.lost or 0),
        reverse=True,
    )


def _check_all(question: Question) -> None:
    """Refuse a question about some messages only."""
    if not question.returns_all or question.reverse:
        raise UsageError("Statistics are of all messages: leave out limit, every and reverse.")


def _end(summary: RecordingSummary, span: Span) -> int:
    """End of a span; in an open recording, other topics may be flushed later than this one."""
    from hybridlog.query.answers.completeness import flush_interval_ns

    late = flush_interval_ns(summary) if summary.status == "open" else 0
    return max(span[0], span[1] - late)


def _measured(times: Times, summary: RecordingSummary, span: Span) -> dict[str, Any]:
    """Attributes of a `TopicCheck` that follow from the times of its messages."""
    if not len(times):
        return {}
    first, last, steps = int(times[0]), int(times[-1]), np.diff(times)
    found = {
        "messages": len(times),
        "rate_hz": mean_rate(len(times), first, last),
        "late_ns": first - span[0],
        "early_ns": max(_end(summary, span) - 1 - last, 0),
    }
    if len(steps):
        longest = int(steps.argmax())
        found["period_ns"] = usual_period(steps)
        found["jitter_ns"] = float(np.std(steps)) if len(steps) > 1 else None
        found["gap_ns"], found["gap_begin_ns"] = int(steps[longest]), int(times[longest])
    return found


SAMPLE = 100
"""Messages that are read."""
_MAX_FIELDS = 1000
_WORDS = {"int64": "integer", "uint64": "integer", "double": "number"}
_PLAIN = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


def infer_fields(messages: Iterable[Message]) -> list[FieldPath]:
    """Fields that the first messages have, which are in JSON, with the types of their columns.

    What cannot be read is skipped. Names that no path can have are in backticks.
    """
    from hybridlog.schema.arrow_types import objects_array  # loads pyarrow

    values: list[Any] = []
    for message in islice(messages, SAMPLE):
        with suppress(PayloadError):
            values.append(message.decode())
    records = objects_array([one for one in values if isinstance(one, dict)], None)
    return [*islice(_fields(records.type, "", within_array=False), _MAX_FIELDS)]


def _fields(kind: Any, prefix: str, *, within_array: bool) -> Iterator[FieldPath]:
    import pyarrow as pa

    from hybridlog.schema.arrow_types import is_list

    for field in kind:
        path = prefix + (field.name if _PLAIN.fullmatch(field.name) else f"`{field.name}`")
        inner, brackets = field.type, ""
        while is_list(inner):
            inner, brackets = inner.value_type, f"{brackets}[]"
        is_object = pa.types.is_struct(inner)
        word = "any" if inner == pa.json_() else _WORDS.get(str(inner), str(inner))
        is_array = within_array or bool(brackets)
        yield FieldPath(path, ("object" if is_object else word) + brackets, is_array)
        if is_object:
            yield from _fields(inner, f"{path}{brackets}.", within_array=is_array)
