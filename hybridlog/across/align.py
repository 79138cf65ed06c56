"""Topics side by side: a row for each message of one topic, with what others said then."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import pyarrow as pa

from hybridlog.across.bins import AGGREGATES, Aggregate, Bins, RegularTimes
from hybridlog.across.match import HOWS, UNKNOWN, How, interpolated, match
from hybridlog.across.topic_reader import RECORDING, TIME, Stream, TopicReader, concatenated
from hybridlog.frames.names import free_name
from hybridlog.query.answers.lost import completeness_of
from hybridlog.query.answers.remarks import remarks
from hybridlog.query.counters import Counters
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

_DISTANCE = "distance"
_MAX_NAMES = 20  # remarks about empty columns
_LOST = "messages of that time are lost"
_NO_TIME = "the row has no time on the clock"
_NO_VALUE = "the message has no such value"
_PIECE_BYTES = 32 << 20  # of the other topics, in rows that are made together


class Base(Protocol):
    """The rows: messages of a topic, or regular times."""

    @property
    def question(self) -> Question:
        """The question; its recordings and times are those of the rows."""

    def empty(self) -> pa.Table:
        """No rows, with the columns of all of them."""

    def tables(self, recording: str) -> Iterator[tuple[NDArray[np.int64], pa.Table]]:
        """Times of the rows of a recording, ns, and their columns, in order."""


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
        base: Base,
        others: Sequence[Stream],
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

    def _partner(self, stream: Stream) -> _Partner | Bins:
        if isinstance(self._base, RegularTimes) and self._how in AGGREGATES:
            how: Aggregate = self._how
            return Bins(self._session, stream, self._base, how=how)
        return _Partner(
            self._session,
            stream,
            how=self._how,  # type: ignore[arg-type]
            tolerance=self._tolerance,
            clock=self._clock,
            empty=self._empty,
        )

    @property
    def _streams(self) -> list[Stream]:
        """The topics that are read."""
        own = [self._base.stream] if isinstance(self._base, TopicBase) else []
        return [*own, *self._others]

    @property
    def counters(self) -> Counters:
        """The cost of the last answer."""
        found = Counters()
        for stream in self._streams:
            found.add(stream.counters)
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
        streams = self._streams
        topics = tuple(topic for stream in streams for topic in stream.question.topics)
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
        for stream in streams:
            question = stream.question
            others = tuple(topic for topic in question.namesakes if topic not in topics)
            found += remarks(self._session, replace(question, namesakes=others), is_empty=False)
        return [*dict.fromkeys([*found, *self.completeness().sentences])]

    def completeness(self) -> Completeness:
        """Return what the rows lack, as `Query.completeness` does, after they were read."""
        answered = [(stream.question, stream.counters) for stream in self._streams]
        return completeness_of(self._session, *answered[0], *answered[1:])

    def __repr__(self) -> str:
        names = [name for stream in self._others for name in stream.question.topics]
        return f"<Aligned {', '.join(names)}; {self._how}>"

    def to_tables(self, told: int | None = None) -> Iterator[pa.Table]:
        """The rows in Arrow tables of bounded size; at least one, possibly empty.

        The type of a column may differ between tables if no definition fixes it.

        Args:
            told: `rows`, `empty` and `remarks` are about so many first rows; None for all.
        """
        for stream in self._streams:
            stream.counters.reset()
        self.rows = 0
        self._empty.clear()
        partners = [self._partner(other) for other in self._others]
        several = len(self._session.chosen(self._base.question)) > 1
        given = False
        for resolved in RangeResolver(self._session, self._base.question).resolve():
            recording = resolved.summary.id
            for partner in partners:
                partner.enter(recording, _end_of(resolved, self._clock))
            for times, table in self._base.tables(recording):
                name = resolved.summary.name if several else None
                left = None if told is None else told - self.rows
                for rows in _pieces(times, partners, left):
                    own = table.slice(rows.start, rows.stop - rows.start)
                    before = Counter(self._empty)
                    _count_blanks(self._empty, own, 0)
                    beside = [partner.rows(times[rows]) for partner in partners]
                    if told is None or self.rows < told:
                        self.rows += own.num_rows
                    else:
                        self._empty.clear()
                        self._empty.update(before)
                    yield _side_by_side(own, name, beside)
                given = given or bool(table.num_rows)
        if not given:
            empty = self._base.empty()
            none = np.empty(0, np.int64)
            yield _side_by_side(empty, "" if several else None, [p.rows(none) for p in partners])

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

        table = self.to_arrow()
        names = table.column_names[1:]
        return frame_of(table[TIME], ((name, table[name]) for name in names))

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


class TopicBase:
    """The messages of a topic as rows."""

    def __init__(self, session: Session, stream: Stream, clock: Clock) -> None:
        self.stream = stream
        self._reader = TopicReader(session, stream, clock)

    @property
    def question(self) -> Question:
        """The question about the topic."""
        return self._reader.question

    def empty(self) -> pa.Table:
        """No rows, with all columns."""
        table = self._reader.empty()[1]
        return self._reader.named(table, TIME, table[TIME])

    def tables(self, recording: str) -> Iterator[tuple[NDArray[np.int64], pa.Table]]:
        """Times and columns of the messages of a recording, in order."""
        for times, table in self._reader.tables(recording):
            yield times, self._reader.named(table, TIME, table[TIME])


class _Partner:
    """A topic beside the rows: gives the messages that belong to times.

    By the log clock the topic is read in step with the rows, one block at a time. By other
    clocks the messages of a recording are sorted in memory.
    """

    def __init__(
        self,
        session: Session,
        stream: Stream,
        *,
        how: How,
        tolerance: int | None,
        clock: Clock,
        empty: Counter[tuple[str, str]],
    ) -> None:
        self._reader = TopicReader(session, stream, clock)
        (self._topic,) = stream.question.topics
        self._empty = empty
        self._reason = ""
        self._lost = np.empty((0, 2), np.int64)
        self._how = how
        self._tolerance = tolerance
        self._clock = clock
        self._none = self._reader.empty()
        self._recording = ""
        self._end: int | None = None
        self._blocks: Iterator[tuple[NDArray[np.int64], pa.Table]] | None = None
        self._times, self._table = self._none
        self._last: tuple[int, pa.Table] | None = None  # the message before those of the table
        self._is_last = True

    def enter(self, recording: str, end: int | None) -> None:
        """Go on with the messages of another recording.

        Args:
            recording: Its id.
            end: Time that all rows are before, by the log clock, ns; None if unknown.
        """
        self._recording = recording
        elsewhere = self._reader.elsewhere(recording)
        self._reason = self._why() if elsewhere is None else elsewhere
        self._lost = self._reader.lost(recording)
        self._end = end
        self._blocks = None
        self._times, self._table = self._none
        self._last = None
        self._is_last = False

    def _why(self) -> str:
        """The reason why no message belongs to a row."""
        if self._tolerance is not None:
            near = format_duration(self._tolerance)
            if self._how == "interpolate":
                return f"no message within {near} before and after"
            return f"no message within {near}{' before' if self._how == 'asof' else ''}"
        reasons = {
            "asof": "no message came before",
            "nearest": "no message",
            "interpolate": "no message before, or none after",
        }
        return reasons[self._how]

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

    def row_bytes(self, times: NDArray[np.int64]) -> int:
        """Mean bytes of the messages that are read next.

        Args:
            times: As for `rows`.
        """
        self._start(times)
        size, rows = int(self._table.nbytes), int(self._table.num_rows)
        return size // max(rows, 1)

    def _start(self, times: NDArray[np.int64]) -> None:
        """Read the first block."""
        if self._blocks is None and not self._is_last and len(times):
            self._open(times)
            if not self._is_last:
                self._advance()

    def rows(self, times: NDArray[np.int64]) -> pa.Table:
        """The columns of the messages that belong to some times, with their distance.

        Args:
            times: int64[n], ns; by the log clock ascending, not before those of the last call.
        """
        self._start(times)
        parts = []
        begin = 0
        while True:
            end = len(times)
            if not self._is_last:
                # What belongs to times before the last one of the block is known.
                last = int(self._times[-1]) if len(self._times) else 0
                end = int(np.searchsorted(times, last))
            if end > begin or not len(times):
                parts.append(self._matched(times[begin:end]))
                begin = end
            if begin == len(times):
                return concatenated(parts)
            self._advance()

    def _open(self, times: NDArray[np.int64]) -> None:
        if self._clock == "log":
            self._blocks = self._reader.tables(self._recording, self._span(int(times[0])))
            return
        self._blocks = self._reader.tables(self._recording)
        found = [self._none, *self._blocks]
        all_times = np.concatenate([part for part, _ in found])
        table = concatenated([part for _, part in found])
        order = np.argsort(all_times, kind="stable")
        order = order[all_times[order] != UNKNOWN]
        self._times, self._table = all_times[order], table.take(pa.array(order))
        self._is_last = True

    def _span(self, first: int) -> tuple[int, int] | None:
        """Log time that can hold the messages of all rows; None for all of it."""
        reader, recording, end = self._reader, self._recording, self._end
        if reader.question.bounds is not None:
            return None
        if self._tolerance is not None:
            begin = max(first - self._tolerance, BEGIN)
        else:
            latest = reader.latest(recording, first)
            begin = first if latest is None else latest
        if end is not None and self._how != "asof":
            if self._tolerance is not None:
                end = min(end + self._tolerance, END)
            else:
                end = reader.following(recording, end)
        return begin, END if end is None else end

    def _advance(self) -> None:
        """Read the next block; the last row before it may still be the latest one."""
        assert self._blocks is not None
        found = next(self._blocks, None)
        if found is None:
            self._is_last = True
            return
        times, table = found
        if len(self._times):
            self._last = int(self._times[-1]), self._table.slice(self._table.num_rows - 1)
        self._times, self._table = times, table

    def _matched(self, times: NDArray[np.int64]) -> pa.Table:
        """The columns of the messages that belong to times that the block decides."""
        if self._last is None:
            return self._found(times, self._times, self._table)
        # Before the first message of the block, only that and the last one of the block before
        # come into question.
        begin = int(np.searchsorted(times, self._times[0]))
        parts = []
        if begin:
            around = np.array([self._last[0], self._times[0]])
            two = concatenated([self._last[1], self._table.slice(0, 1)])
            parts.append(self._found(times[:begin], around, two))
        if begin < len(times) or not parts:
            parts.append(self._found(times[begin:], self._times, self._table))
        return concatenated(parts)

    def _found(
        self, times: NDArray[np.int64], known: NDArray[np.int64], table: pa.Table
    ) -> pa.Table:
        found = match(times, known, self._how, self._tolerance)
        rows = _taken(table, found.before)
        if self._how == "interpolate":
            known = known if len(known) else times
            low, high = known[np.maximum(found.before, 0)], known[np.maximum(found.after, 0)]
            length = (high - low).astype(np.float64)
            weight = (times - low) / np.where(length > 0, length, 1)
            weight[length <= 0] = 0
            after = _taken(table, found.after)
            rows = interpolated(rows, after, weight, self._reader.quaternions)
        missing = found.before < 0
        distance = (
            pa.array(found.distance, DURATION, mask=missing)
            if missing.any()
            else numbers(found.distance, "duration")
        )
        table = self._reader.named(rows, self._reader.prefix + _DISTANCE, distance)
        empty = int(missing.sum())
        if empty:
            is_unknown = times == UNKNOWN
            is_lost = missing & ~is_unknown & self._is_lost(times)
            numbers_of = int(is_unknown.sum()), int(is_lost.sum())
            for reason, number in zip((_NO_TIME, _LOST), numbers_of, strict=True):
                self._empty[self._topic, reason] += number
            self._empty[self._topic, self._reason] += empty - sum(numbers_of)
        _count_blanks(self._empty, table, empty)
        return table


def _count_blanks(empty: Counter[tuple[str, str]], table: pa.Table, known: int) -> None:
    """Count the rows that are empty in single columns, beside a number of rows without any."""
    for name, column in zip(table.column_names, table.columns, strict=True):
        if column.null_count > known:
            empty[name, _NO_VALUE] += column.null_count - known


def _pieces(
    times: NDArray[np.int64], partners: Sequence[_Partner | Bins], left: int | None
) -> Iterator[slice]:
    """Rows in pieces that stay small where many rows have the same large message.

    One ends behind `left` rows, if there are more.
    """
    begin = 0
    while begin < len(times):
        rest = times[begin:]
        row = sum(one.row_bytes(rest) for one in partners if isinstance(one, _Partner))
        end = min(begin + max(_PIECE_BYTES // max(row, 1), 1), len(times))
        if left is not None and begin < left < end:
            end = left
        yield slice(begin, end)
        begin = end


def _taken(table: pa.Table, rows: NDArray[np.int64]) -> pa.Table:
    """Rows of a table; null for -1."""
    missing = rows < 0
    places = pa.array(rows, mask=missing) if missing.any() else numbers(rows)
    return table.take(places)


def _end_of(resolved: Resolved, clock: Clock) -> int | None:
    """Log time that all rows of a recording are before, ns; None if unknown."""
    if resolved.windows is not None:
        return int(resolved.windows[-1, 1]) if len(resolved.windows) else 0
    return resolved.bounds[1] if resolved.bounds is not None and clock == "log" else None


def _side_by_side(table: pa.Table, recording: str | None, parts: Sequence[pa.Table]) -> pa.Table:
    columns = dict(zip(table.column_names, table.columns, strict=True))
    found: dict[str, Any] = {TIME: columns.pop(TIME)}
    if recording is not None:
        text = recording.encode("utf-8", "replace").decode()
        found[RECORDING] = pa.repeat(pa.scalar(text, pa.string()), table.num_rows)
    found |= columns
    for part in parts:
        for name, column in zip(part.column_names, part.columns, strict=True):
            found[free_name(name, found)] = column
    return pa.table(found)


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
    taken: set[str] = set()
    streams = [
        Stream(
            replace(question, topics=(topic,)),
            _prefix(topic, taken),
            is_apart=across_recordings and n > 0,
        )
        for n, question in enumerate((base, *others))
        for topic in question.topics
    ]
    rows = TopicBase(session, streams[0], chosen)
    return Aligned(
        session,
        rows,
        streams[1:],
        how=how,
        tolerance=tolerance,
        clock=chosen,
    )


def resampled(
    session: Session,
    question: Question,
    step: DurationLike,
    how: str,
    tolerance: DurationLike | None,
) -> Aligned:
    """An alignment of topics to regular times; see `Query.resample`."""
    times = RegularTimes(session, replace(question, predicate=None), parse_duration(step))
    taken: set[str] = set()
    several = len(question.topics) > 1
    streams = [
        Stream(replace(question, topics=(topic,)), _prefix(topic, taken) if several else "")
        for topic in question.topics
    ]
    return Aligned(
        session,
        times,
        streams,
        how=how,
        tolerance=tolerance,
        clock="log",
    )


def _prefix(topic: str, taken: set[str]) -> str:
    """The beginning of the names of a topic's columns: `imu/data.`, `imu/data_2.`."""
    name = short = topic.removeprefix("/")
    number = 2
    while name in taken:
        name = f"{short}_{number}"
        number += 1
    taken.add(name)
    return f"{name}."
