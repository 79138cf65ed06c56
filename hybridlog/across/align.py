"""Topics side by side: a row for each message of one topic, with what others said then."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import chain, count
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa
from msgspec.structs import replace

from hybridlog.across.match import HOWS
from hybridlog.across.topic_reader import (
    RECORDING,
    TIME,
    Beside,
    Block,
    Empty,
    TopicReader,
    concatenated,
)
from hybridlog.frames.answer import text_column
from hybridlog.query.answers.completeness import completeness_of
from hybridlog.query.question import Counters
from hybridlog.query.ranges import RangeResolver
from hybridlog.query.times import DurationLike, parse_duration
from hybridlog.schema.arrow_columns import numbers
from hybridlog.schema.arrow_types import common_schema
from hybridlog.snapshot import UNFINISHED
from hybridlog.wording import MAX_ROWS, arrow_html, counted, listed
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray

    from hybridlog.query.answers.completeness import Completeness
    from hybridlog.query.question import Clock, Question
    from hybridlog.session import Session

_MAX_NAMES = 20  # remarks about empty columns
MAX_TIMES = 100_000_000
"""Maximum number of rows of `resample`."""
_GRID_ROWS = 65_536


class Aligned:
    """The messages of topics side by side. Each access reads them again.

    Rows are ordered by recording, oldest first, then by log time. Messages of different
    recordings are in one row only where that is asked for.

    Attributes:
        rows: Number of rows of the last answer.
        empty: Numbers of rows that are empty in the last answer, by reason: by topic where it
            has no message for the row, by column where that has no value.
    """

    def __init__(
        self, session: Session, base: TopicReader | RegularTimes, beside: Sequence[Beside], how: str
    ) -> None:
        self._session = session
        self._base = base
        self._beside = beside
        self._readers = [*([base] if isinstance(base, TopicReader) else []), *beside]
        self._how = how
        self.rows = 0
        self.empty: dict[str, dict[str, int]] = {}

    @property
    def counters(self) -> Counters:
        """The cost of the last answer."""
        found = Counters()
        for reader in self._readers:
            found.add(reader.counters)
        return found

    def remarks(self) -> list[str]:
        """Sentences about the last answer, those of `Query.remarks` about each topic."""
        rows = counted(self.rows, "row")
        lines = [
            f"{name}: {number} of {rows} {'is' if number == 1 else 'are'} empty: {reason}."
            for name, reasons in self.empty.items()
            for reason, number in reasons.items()
        ]
        if len(lines) > _MAX_NAMES:
            more = counted(len(lines) - _MAX_NAMES, "more column")
            lines[_MAX_NAMES:] = [f"{more} are empty in some rows."]
        lines += [text for one in self._readers for text in one.remarks]
        return [*dict.fromkeys([*lines, *self.completeness().sentences])]

    def completeness(self) -> Completeness:
        """Return what the rows lack, as `Query.completeness` does, after they were read."""
        answered = [(reader.question, reader.counters) for reader in self._readers]
        return completeness_of(self._session, *answered[0], *answered[1:])

    def __repr__(self) -> str:
        names = [name for reader in self._beside for name in reader.question.topics]
        return f"<Aligned {', '.join(names)}; {self._how}>"

    def _repr_html_(self) -> str:
        return arrow_html(repr(self), next(self.to_tables(MAX_ROWS)))

    def to_tables(self, limit: int | None = None) -> Iterator[pa.Table]:
        """The rows, or the first ones, in Arrow tables of bounded size; at least one table.

        The type of a column may differ between tables if no definition fixes it.
        """
        for reader in self._readers:
            reader.counters.reset()
        self.rows, self.empty = 0, {}
        base = self._base
        several = len(self._session.chosen(base.question)) > 1
        chosen = RangeResolver(self._session, base.question).resolve()
        for summary, bounds, _ in chosen if limit != 0 else ():
            span = None if summary.status in UNFINISHED else summary.extent
            if bounds is not None and base.question.clock == "log":
                span = bounds
            for one in self._beside:
                one.enter(summary.id, span)
            for times, table in base.rows(summary.id):
                begin = 0
                while begin < len(times):
                    left = len(times) if limit is None else limit - self.rows
                    if left <= 0:
                        return
                    end = begin + min([left, *(one.most for one in self._beside)])
                    own = table.slice(begin, end - begin)
                    yield self._rows(times[begin:end], own, summary.name if several else None)
                    begin = end
        if not self.rows:
            yield self._rows(np.empty(0, np.int64), base.empty, "" if several else None)

    def _rows(self, times: NDArray[np.int64], own: pa.Table, recording: str | None) -> pa.Table:
        """Some rows with what is beside them."""
        self.rows += len(times)
        empty: Empty = Counter()
        columns: dict[str, Any] = {TIME: own[TIME]}
        if recording is not None:
            columns[RECORDING] = text_column(recording, len(times))
        if isinstance(self._base, TopicReader):
            self._base.put(columns, own, empty)
        for one in self._beside:
            one.add(columns, times, empty)
        for (name, reason), rows in (+empty).items():
            reasons = self.empty.setdefault(name, {})
            reasons[reason] = reasons.get(reason, 0) + rows
        return pa.table(columns)

    def batches(self) -> Iterator[pa.RecordBatch]:
        """The rows in Arrow record batches of bounded size."""
        for table in self.to_tables():
            yield from table.combine_chunks().to_batches()

    def to_arrow(self) -> pa.Table:
        """The rows as one Arrow table, first column log time."""
        return concatenated(list(self.to_tables()))

    def to_pandas(self) -> pd.DataFrame:
        """The rows as a frame, indexed by log time (UTC, ns)."""
        from hybridlog.frames.frame import frame_of

        return frame_of(self.to_arrow())

    def to_polars(self) -> Any:
        """The rows as a polars frame.

        Raises:
            MissingDependencyError: polars is not installed.
        """
        from hybridlog.frames.frame import to_polars

        return to_polars(self.to_arrow())

    def schema(self) -> pa.Schema | None:
        """Columns where only messages determine them, which are read; None otherwise."""
        questions = [self._base.question, *(other.question for other in self._beside)]
        known = (self._session.field_types(q.topics, q.recordings) for q in questions)
        if all(types is not None for types in known):
            return None
        return common_schema(self.to_tables())


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

    def rows(self, recording: str) -> Iterator[Block]:
        """The times in a recording."""
        for begin, end in self._spans.get(recording, []):
            for first in range(begin, end, _GRID_ROWS * self.step):
                last = min(end, first + _GRID_ROWS * self.step)
                times = np.arange(first, last, self.step, dtype=np.int64)
                yield times, pa.table({TIME: numbers(times, "time")})


def side_by_side(
    session: Session,
    base: Question,
    others: Sequence[Question],
    *,
    how: str,
    tolerance: DurationLike | None,
    clock: str,
    across_recordings: bool = False,
) -> Aligned:
    """An alignment of topics to the messages of one topic; see `Store.align`."""
    if clock not in {"log", "publish", "header"}:
        raise UsageError(f"Unknown clock {clock!r}; choose log, publish or header.")
    if len(base.topics) != 1:
        raise UsageError(
            f"The rows are the messages of one topic, not of {len(base.topics)}: name one of "
            f"{listed(base.topics)}."
        )
    near = _checked(how, tolerance)
    chosen: Clock = clock  # type: ignore[assignment]
    (prefix, one), *named = _named([base, *others])
    rows = TopicReader(session, one, chosen, prefix=prefix)
    apart = across_recordings
    beside = [
        Beside(session, one, chosen, how=how, tolerance=near, prefix=prefix, is_apart=apart)
        for prefix, one in named
    ]
    return Aligned(session, rows, beside, how)


def resampled(
    session: Session,
    question: Question,
    step: DurationLike,
    how: str,
    tolerance: DurationLike | None,
) -> Aligned:
    """An alignment of topics to regular times; see `Query.resample`."""
    times = RegularTimes(session, replace(question, predicate=None), parse_duration(step))
    near, named = _checked(how, tolerance), _named([question])
    beside = [
        Beside(session, one, how=how, tolerance=near, prefix=prefix if len(named) > 1 else "")
        for prefix, one in named
    ]
    return Aligned(session, times, beside, how)


def _checked(how: str, tolerance: DurationLike | None) -> int | None:
    """The tolerance, ns, of one of the ways to match."""
    if how not in HOWS:
        raise UsageError(f"Unknown way {how!r}; choose {', '.join(HOWS)}.")
    return None if tolerance is None else parse_duration(tolerance)


def _named(questions: Sequence[Question]) -> list[tuple[str, Question]]:
    """Each topic of questions, and the beginning of its columns: `imu/data.`, `imu/data_2.`."""
    found: dict[str, Question] = {}
    for question in questions:
        for topic in question.topics:
            name = topic.removeprefix("/")
            more = (f"{name}_{number}." for number in count(2))
            prefix = next(one for one in chain([f"{name}."], more) if one not in found)
            found[prefix] = replace(question, topics=(topic,))
    return [*found.items()]
