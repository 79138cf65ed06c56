"""Topics side by side: a row for each message of one topic, with what others said then."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain, count
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from hybridlog.across.bins import AGGREGATES, Bins, RegularTimes, with_numbers
from hybridlog.across.match import HOWS, Matched
from hybridlog.across.topic_reader import RECORDING, TIME, Beside, TopicReader, concatenated
from hybridlog.frames.answer import text_column
from hybridlog.query.answers.lost import completeness_of
from hybridlog.query.answers.remarks import remarks
from hybridlog.query.question import Counters
from hybridlog.query.ranges import RangeResolver
from hybridlog.query.times import DurationLike, parse_duration
from hybridlog.schema.arrow_types import common_schema
from hybridlog.snapshot import UNFINISHED
from hybridlog.wording import counted, listed
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray

    from hybridlog.query.answers.completeness import Completeness
    from hybridlog.query.question import Clock, Question
    from hybridlog.session import Session

_MAX_NAMES = 20  # remarks about empty columns


class Aligned:
    """The messages of topics side by side. Each access reads them again.

    Rows are ordered by recording, oldest first, then by log time. Messages of different
    recordings are in one row only where that is asked for.

    Args:
        session: The open store.
        base: The rows.
        others: The topics beside them.
        how: Which message of each.
        tolerance: Greatest distance in time, a duration; None for any.

    Attributes:
        rows: Number of rows of the last answer.
        empty: Numbers of rows that are empty in the last answer, by reason: by topic where it
            has no message for the row, by column where that has no value.

    Raises:
        UsageError: an unknown way or clock, or a question with limit, every or reverse.
        TopicError: a topic does not have the clock.
        TimeError: the tolerance is no duration.
    """

    def __init__(
        self,
        session: Session,
        base: TopicReader | RegularTimes,
        others: Sequence[TopicReader],
        *,
        how: str,
        tolerance: DurationLike | None,
    ) -> None:
        hows = (*HOWS, *AGGREGATES) if isinstance(base, RegularTimes) else HOWS
        if how not in hows:
            raise UsageError(f"Unknown way {how!r}; choose {', '.join(hows)}.")
        if how in AGGREGATES and tolerance is not None:
            raise UsageError(f"{how} is of the messages between two rows: leave out tolerance.")
        self._session = session
        self._base = base
        self._others = others
        self._readers = [*([base] if isinstance(base, TopicReader) else []), *others]
        self._how = how
        self._tolerance = None if tolerance is None else parse_duration(tolerance)
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
        questions = [reader.question for reader in self._readers]
        rows = counted(self.rows, "row")
        lines = [
            f"{name}: {number} of {rows} {'is' if number == 1 else 'are'} empty: {reason}."
            for name, reasons in self.empty.items()
            for reason, number in reasons.items()
        ]
        found = lines[:_MAX_NAMES]
        if len(lines) > _MAX_NAMES:
            found.append(
                f"{counted(len(lines) - _MAX_NAMES, 'more column')} are empty in some rows."
            )
        found += dict.fromkeys(text for one in self._readers for text in one.remarks)
        for question in questions:
            found += remarks(self._session, question, is_empty=False)
        return [*dict.fromkeys([*found, *self.completeness().sentences])]

    def completeness(self) -> Completeness:
        """Return what the rows lack, as `Query.completeness` does, after they were read."""
        answered = [(reader.question, reader.counters) for reader in self._readers]
        return completeness_of(self._session, *answered[0], *answered[1:])

    def __repr__(self) -> str:
        names = [name for reader in self._others for name in reader.question.topics]
        return f"<Aligned {', '.join(names)}; {self._how}>"

    def to_tables(self, limit: int | None = None) -> Iterator[pa.Table]:
        """The rows, or the first ones, in Arrow tables of bounded size; at least one table.

        The type of a column may differ between tables if no definition fixes it.
        """
        for reader in self._readers:
            reader.counters.reset()
        self.rows, self.empty = 0, {}
        base, beside = self._base, [self._beside(reader) for reader in self._others]
        several = len(self._session.chosen(base.question)) > 1
        chosen = RangeResolver(self._session, base.question).resolve()
        for summary, bounds, _ in chosen if limit != 0 else ():
            span = None if summary.status in UNFINISHED else summary.extent
            if bounds is not None and base.question.clock == "log":
                span = bounds
            for one in beside:
                one.enter(summary.id, span)
            name = summary.name if several else None
            for times, table in base.rows(summary.id):
                matched = [one.match(times) for one in beside]
                begin = 0
                while begin < len(times):
                    left = len(times) - begin if limit is None else limit - self.rows
                    if left <= 0:
                        return
                    room = [one.fitting(m, begin) for one, m in zip(beside, matched, strict=True)]
                    end = begin + min([len(times) - begin, left, *room])
                    own = table.slice(begin, end - begin)
                    parts = [Matched._make(column[begin:end] for column in m) for m in matched]
                    yield self._rows(times[begin:end], own, name, beside, parts)
                    begin = end
        if not self.rows:
            none = np.empty(0, np.int64)
            parts = [Matched(none, none, none)] * len(beside)
            yield self._rows(none, base.empty, "" if several else None, beside, parts)

    def _beside(self, reader: TopicReader) -> Beside:
        if isinstance(self._base, RegularTimes) and self._how in AGGREGATES:
            return Bins(reader, self._how, self._base)
        return Beside(reader, self._how, self._tolerance)

    def _rows(
        self,
        times: NDArray[np.int64],
        own: pa.Table,
        recording: str | None,
        beside: Sequence[Beside],
        found: Sequence[Matched],
    ) -> pa.Table:
        """Some rows with what was found beside them."""
        self.rows += len(times)
        empty = Counter[tuple[str, str]]()
        columns: dict[str, Any] = {TIME: own[TIME]}
        if recording is not None:
            columns[RECORDING] = text_column(recording, len(times))
        if isinstance(self._base, TopicReader):
            self._base.add(columns, own, empty, 0)
        for one, matched in zip(beside, found, strict=True):
            one.add(columns, times, matched, empty)
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
        questions = [self._base.question, *(other.question for other in self._others)]
        known = (self._session.field_types(q.topics, q.recordings) for q in questions)
        if all(types is not None for types in known):
            return None
        return common_schema(self.to_tables())


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
    chosen: Clock = clock  # type: ignore[assignment]
    rows, *readers = (
        TopicReader(session, one, chosen, prefix=prefix, is_apart=across_recordings and number > 0)
        for number, (prefix, one) in enumerate(_named([base, *others]))
    )
    return Aligned(session, rows, readers, how=how, tolerance=tolerance)


def resampled(
    session: Session,
    question: Question,
    step: DurationLike,
    how: str,
    tolerance: DurationLike | None,
) -> Aligned:
    """An alignment of topics to regular times; see `Query.resample`."""
    times = RegularTimes(session, replace(question, predicate=None), parse_duration(step))
    found = _named([question])
    readers = [
        TopicReader(
            session, with_numbers(session, one, how), prefix=prefix if len(found) > 1 else ""
        )
        for prefix, one in found
    ]
    return Aligned(session, times, readers, how=how, tolerance=tolerance)


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
