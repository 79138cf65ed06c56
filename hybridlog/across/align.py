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
from hybridlog.across.match import HOWS, UNKNOWN, How, interpolated, match
from hybridlog.across.topic_reader import (
    RECORDING,
    TIME,
    Block,
    TopicReader,
    concatenated,
)
from hybridlog.frames.answer import text_column
from hybridlog.frames.names import free_name
from hybridlog.query.answers.lost import completeness_of
from hybridlog.query.answers.remarks import remarks
from hybridlog.query.question import Counters
from hybridlog.query.ranges import RangeResolver
from hybridlog.query.times import DurationLike, format_duration, parse_duration
from hybridlog.schema.arrow_columns import DURATION, numbers
from hybridlog.schema.arrow_types import common_schema
from hybridlog.wording import counted, listed
from hybridlog_storage.errors import UsageError
from hybridlog_storage.times import BEGIN, END

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray

    from hybridlog.query.answers.completeness import Completeness
    from hybridlog.query.question import Clock, Question
    from hybridlog.query.ranges import Resolved
    from hybridlog.session import Session

_MAX_NAMES = 20  # remarks about empty columns
_DISTANCE = "distance"
_LOST = "messages of that time are lost"
_NO_TIME = "the row has no time on the clock"
_PIECE_BYTES = 32 << 20  # of the other topics, in rows that are made together
_WHY = {
    "asof": "no message came before",
    "nearest": "no message",
    "interpolate": "no message before, or none after",
}
_WHY_NEAR = {
    "asof": "no message within {} before",
    "nearest": "no message within {}",
    "interpolate": "no message within {} before and after",
}


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
        clock: The time that is compared.

    Attributes:
        rows: Number of rows of the last answer.

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
        clock: Clock,
    ) -> None:
        is_regular = isinstance(base, RegularTimes)
        hows = (*HOWS, *AGGREGATES) if is_regular else HOWS
        if how not in hows:
            raise UsageError(f"Unknown way {how!r}; choose {', '.join(hows)}.")
        if how in AGGREGATES and tolerance is not None:
            raise UsageError(f"{how} is of the messages between two rows: leave out tolerance.")
        self._session = session
        self._base = base
        self._others = others
        self._how = how
        self._clock: Clock = clock
        self._tolerance = None if tolerance is None else parse_duration(tolerance)
        self.rows = 0
        self._empty: Counter[tuple[str, str]] = Counter()

    @property
    def _readers(self) -> list[TopicReader]:
        """The topics that are read."""
        own = [self._base] if isinstance(self._base, TopicReader) else []
        return [*own, *self._others]

    def _partner(self, reader: TopicReader) -> _Partner | Bins:
        if isinstance(self._base, RegularTimes) and self._how in AGGREGATES:
            return Bins(reader, self._base, self._how)
        return _Partner(reader, self._how, self._tolerance)  # type: ignore[arg-type]

    @property
    def counters(self) -> Counters:
        """The cost of the last answer."""
        found = Counters()
        for reader in self._readers:
            found.add(reader.counters)
        return found

    @property
    def empty(self) -> dict[str, dict[str, int]]:
        """Numbers of rows that are empty in the last answer, by reason.

        By topic where it has no message for the row, by column where that has no value.
        """
        found: dict[str, dict[str, int]] = {}
        for (name, reason), rows in (+self._empty).items():
            found.setdefault(name, {})[reason] = rows
        return found

    def remarks(self) -> list[str]:
        """Sentences about the last answer, those of `Query.remarks` about each topic."""
        questions = [reader.asked for reader in self._readers]
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
        answered = [(reader.asked, reader.counters) for reader in self._readers]
        return completeness_of(self._session, *answered[0], *answered[1:])

    def __repr__(self) -> str:
        names = [name for reader in self._others for name in reader.question.topics]
        return f"<Aligned {', '.join(names)}; {self._how}>"

    def to_tables(self, told: int | None = None) -> Iterator[pa.Table]:
        """The rows in Arrow tables of bounded size; at least one, possibly empty.

        The type of a column may differ between tables if no definition fixes it.

        Args:
            told: `rows`, `empty` and `remarks` are about so many first rows; None for all.
        """
        for reader in self._readers:
            reader.counters.reset()
        self.rows = 0
        self._empty.clear()
        base, partners = self._base, [self._partner(other) for other in self._others]
        several = len(self._session.chosen(base.question)) > 1
        given = False
        for resolved in RangeResolver(self._session, base.question).resolve():
            for partner in partners:
                partner.enter(resolved.summary.id, _end_of(resolved, self._clock))
            name = resolved.summary.name if several else None
            for times, table in base.tables(resolved.summary.id):
                given, begin = True, 0
                while begin < len(times):
                    rest = times[begin:]
                    known = min([len(rest), *(partner.decided(rest) for partner in partners)])
                    # Small pieces where many rows have the same large message.
                    row = sum(partner.row_bytes() for partner in partners)
                    end = begin + min(max(_PIECE_BYTES // max(row, 1), 1), known)
                    left = end if told is None else begin + told - self.rows
                    end = left if begin < left < end else end
                    piece = times[begin:end], table.slice(begin, end - begin)
                    yield self._rows(piece, name, partners, is_told=left > begin)
                    begin = end
        if not given:
            none = np.empty(0, np.int64), base.empty()
            yield self._rows(none, "" if several else None, partners, is_told=True)

    def _rows(
        self,
        piece: Block,
        recording: str | None,
        partners: Sequence[_Partner | Bins],
        *,
        is_told: bool,
    ) -> pa.Table:
        """Some rows, which count if they are told about."""
        times, own = piece
        empty = self._empty if is_told else Counter[tuple[str, str]]()
        self.rows += len(times) if is_told else 0
        columns: dict[str, Any] = {TIME: own[TIME]}
        if recording is not None:
            columns[RECORDING] = text_column(recording, len(times))
        if isinstance(self._base, TopicReader):
            self._base.add(columns, own, empty, 0)
        for partner in partners:
            partner.add(columns, times, empty)
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


class _Partner:
    """A topic beside the rows: gives the messages that belong to times.

    By the log clock the topic is read in step with the rows, one block at a time. By other
    clocks the messages of a recording are sorted in memory.
    """

    def __init__(self, reader: TopicReader, how: How, tolerance: int | None) -> None:
        self._reader = reader
        self._how = how
        self._tolerance = tolerance
        why = _WHY if tolerance is None else _WHY_NEAR
        self._why = why[how].format(format_duration(tolerance or 0))
        self._none: Block = np.empty(0, np.int64), reader.empty()
        self._times, self._table = self._none
        self._blocks: Iterator[Block] | None = None
        self._is_last = True

    def enter(self, recording: str, end: int | None) -> None:
        """Go on with another recording; rows are before `end` (log clock, ns; None: unknown)."""
        self._recording, self._end = recording, end
        self._reason = self._reader.elsewhere(recording) or self._why
        self._lost = self._reader.lost(recording)
        self._apart = self._reader.epochs(recording).apart
        self._blocks = None
        self._times, self._table = self._none
        self._is_last = False

    def _is_lost(self, times: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Rows whose message may have been lost."""
        low, high = np.full_like(times, BEGIN), times
        if self._tolerance is not None:
            low = np.maximum(times, BEGIN + self._tolerance) - self._tolerance
        if self._how != "asof":
            near = END if self._tolerance is None else self._tolerance
            high = np.minimum(times, END - near) + near
        place = np.searchsorted(self._lost[:, 1], low, "right")
        found: NDArray[np.bool_] = place < len(self._lost)
        found[found] = self._lost[place[found], 0] <= high[found]
        return found

    def decided(self, times: NDArray[np.int64]) -> int:
        """Number of times, at least one, that the messages which are read now decide.

        By the log clock times ascend, and are not before those of the last call of `add`.
        """
        if self._blocks is None:
            if self._reader.is_by_log_time:
                self._blocks = self._reader.tables(self._recording, self._span(int(times[0])))
                self._advance()
            else:
                self._blocks, self._is_last = iter(()), True
                self._times, self._table = self._reader.by_clock(self._recording)
        while not self._is_last:
            # What belongs to times before the last one of the block is known.
            if end := int(np.searchsorted(times, self._times[-1])):
                return end
            self._advance()
        return len(times)

    def row_bytes(self) -> int:
        """Mean bytes of these messages."""
        return int(self._table.nbytes) // max(len(self._times), 1)

    def _span(self, first: int) -> tuple[int, int] | None:
        """Log time that can hold the messages of all rows; None for all of it."""
        reader, end, near = self._reader, self._end, self._tolerance
        if reader.question.bounds is not None:
            return None
        if near is not None:
            begin = max(first - near, BEGIN)
        else:
            begin = reader.latest(self._recording, first)
        if end is None:
            return begin, END
        if self._how != "asof":
            end = reader.following(self._recording, end) if near is None else min(end + near, END)
        return begin, end

    def add(
        self, columns: dict[str, Any], times: NDArray[np.int64], empty: Counter[tuple[str, str]]
    ) -> None:
        """Add the columns of the messages that belong to decided times, ns, with their distance.

        `empty` counts rows without a message or a value, by name and reason.
        """
        found = match(times, self._times, self._how, self._tolerance, self._apart)
        table = _taken(self._table, found.before)
        if self._how == "interpolate":
            known = self._times if len(self._times) else times
            low, high = known[np.maximum(found.before, 0)], known[np.maximum(found.after, 0)]
            length = (high - low).astype(np.float64)
            weight = (times - low) / np.where(length > 0, length, 1)
            weight[length <= 0] = 0
            after = _taken(self._table, found.after)
            table = interpolated(table, after, weight, self._reader.quaternions)
        missing = found.before < 0
        distance = (
            pa.array(found.distance, DURATION, mask=missing)
            if missing.any()
            else numbers(found.distance, "duration")
        )
        columns[free_name(self._reader.prefix + _DISTANCE, columns)] = distance
        none = distance.null_count
        if none:
            (topic,) = self._reader.question.topics
            is_unknown = times == UNKNOWN
            is_lost = missing & ~is_unknown & self._is_lost(times)
            lost, unknown = int(is_lost.sum()), int(is_unknown.sum())
            empty[topic, _NO_TIME] += unknown
            empty[topic, _LOST] += lost
            empty[topic, self._reason] += none - lost - unknown
        self._reader.add(columns, table, empty, none)

    def _advance(self) -> None:
        """Read the next block, behind the last row before it, which may still be the latest."""
        found = next(self._blocks or iter(()), None)
        if found is None:
            self._is_last = True
        elif len(self._times):
            last = self._table.slice(len(self._times) - 1)
            self._times = np.concatenate([self._times[-1:], found[0]])
            self._table = concatenated([last, found[1]])
        else:
            self._times, self._table = found


def _taken(table: pa.Table, rows: NDArray[np.int64]) -> pa.Table:
    """Rows of a table; null for -1."""
    return table.take(pa.array(rows, mask=rows < 0))


def _end_of(resolved: Resolved, clock: Clock) -> int | None:
    """Log time that all rows of a recording are before, ns; None if unknown."""
    if resolved.windows is not None:
        return int(resolved.windows[-1, 1]) if len(resolved.windows) else 0
    return resolved.bounds[1] if resolved.bounds is not None and clock == "log" else None


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
    (prefix, first), *beside = _named([base, *others])
    rows = TopicReader(session, first, chosen, prefix=prefix)
    readers = [
        TopicReader(session, one, chosen, prefix=prefix, is_apart=across_recordings)
        for prefix, one in beside
    ]
    return Aligned(session, rows, readers, how=how, tolerance=tolerance, clock=chosen)


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
    return Aligned(session, times, readers, how=how, tolerance=tolerance, clock="log")


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
