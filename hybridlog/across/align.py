"""Topics side by side: a row for each message of one topic, with what others said then.

Times of a recording are whole, values come in pieces.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import chain, count
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
from msgspec.structs import replace

from hybridlog.across.match import HOWS, UNKNOWN, interpolated, match, quaternion_paths
from hybridlog.frames.answer import stream, text_column
from hybridlog.frames.names import free_name
from hybridlog.query.answers.completeness import Completeness, completeness_of, lost_times
from hybridlog.query.intervals import Intervals, joined
from hybridlog.query.planner import Planner, bounds_in, log_spans, log_times, resolved
from hybridlog.query.question import Clock, Counters, Question, Span
from hybridlog.query.times import DurationLike, format_duration, parse_duration
from hybridlog.schema.arrow_types import DURATION, column_of, common_schema, numbers
from hybridlog.schema.column import STAMP
from hybridlog.snapshot import UNFINISHED
from hybridlog.tf.in_frame import Known, stream_in_frame
from hybridlog.tf.reader import Epochs, epochs_of
from hybridlog.wording import MAX_ROWS, arrow_html, counted, listed
from hybridlog_storage.cache import lazy
from hybridlog_storage.errors import TimeError, UsageError
from hybridlog_storage.times import BEGIN, END, placed

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray

    from hybridlog.session import Session

Block = tuple["NDArray[np.int64]", pa.Table]
"""Times of some messages, ns, and their columns."""
Empty = Counter[tuple[str, str]]
"""Number of rows without a message, by topic and reason, or without a value, by column."""
TIME: Final = "log_time"
"""Column of the time of a row."""
RECORDING: Final = "recording"
"""Column of the recording of a row."""
MAX_TIMES: Final = 100_000_000
"""Maximum number of rows of `resample`."""
_DISTANCE: Final = "distance"
_LOST: Final = "messages of that time are lost"
_NO_TIME: Final = "the row has no time on the clock"
_NO_VALUE: Final = "the message has no such value"
_WHY: Final = {
    "asof": ("no message came before", "no message within {} before"),
    "nearest": ("no message", "no message within {}"),
    "interpolate": (
        "no message before, or none after",
        "no message within {} before and after",
    ),
}
_MAX_NAMES = 20  # remarks about empty columns
_GRID_ROWS = 65_536
_PIECE_BYTES = 32 << 20  # messages of a topic that rows get together
_SKIPPED = 32  # a piece has so many times the messages between needed ones that are read along


class Moments(NamedTuple):
    """Log times of n messages, and times on the clock of the k that have one, ns, ascending.

    `place` is intp[k], which of the n each of these is.
    """

    log_time: NDArray[np.int64]
    time: NDArray[np.int64]
    place: NDArray[np.intp]


_NONE: Final = Moments(*[np.empty(0, np.int64)] * 3)


class TopicReader:
    """One topic of an alignment: its messages with their times on a clock, as rows or beside these.

    The names of its columns begin with the prefix. If it `is_apart`, its messages may be of other
    recordings than the rows. Values come for a piece of the rows: at most `most` of them together.
    """

    def __init__(
        self,
        session: Session,
        question: Question,
        clock: Clock = "log",
        *,
        how: str = "asof",
        tolerance: int | None = None,
        prefix: str = "",
        is_apart: bool = False,
    ) -> None:
        if not question.returns_all or question.reverse:
            raise UsageError(
                "An alignment uses all messages; it cannot be combined with limit, every or "
                "reverse."
            )
        self.how = how
        self.tolerance = tolerance
        self.prefix = prefix
        self.is_apart = is_apart
        self.most = 1
        self.counters = Counters()
        self._recording = ""
        self._moments = _NONE
        self._of_all: Moments | None = None  # of all recordings, if these are apart
        self._lost = np.empty((0, 2), np.int64)
        self._epochs: dict[str, Epochs] = {}
        self._trees: Known = {}
        self._session = session
        self._time = {"log": TIME, "publish": "publish_time", "header": STAMP}[clock]
        self._hidden = {TIME} if is_apart else {TIME, RECORDING}
        if clock != "log":
            # Refused where the topic does not have the clock.
            on_clock = replace(question, clock=clock, bounds=(None, None), during=None)
            Planner(session, on_clock).split()
        self.question = replace(question, names_recording=question.names_recording or is_apart)

    @lazy
    def known(self) -> dict[str, str] | None:
        """Types of the fields, by path; None where no definition fixes them."""
        return self._session.field_types(self.question.topics, self.question.recordings)

    @lazy
    def _recordings(self) -> set[str]:
        """Ids of the recordings that the question is about."""
        return {one.id for one in self._session.summaries_of(self.question)}

    @lazy
    def empty(self) -> pa.Table:
        """No rows, with the columns of all recordings."""
        question = replace(self.question, limit=0, bounds=None, during=None, predicate=None)
        return next(stream(Planner(self._session, question)))

    def rows(self, recording: str) -> Iterator[Block]:
        """The messages of a recording, by log time, with their times on the clock."""
        question = self._beside(recording)
        question = replace(question, fields=self._with_time(question.fields))
        for table in self._stream(question, self.counters):
            yield self._times(table, recording), table

    def _with_time(self, fields: tuple[str, ...] | None) -> tuple[str, ...] | None:
        """The requested fields and the time on the clock, which is hidden if only we ask."""
        name = self._time
        if name == TIME or (fields is None and name == STAMP):
            return fields
        if fields is None:
            if self.known is None:
                raise UsageError("The fields of this topic are not fixed: name them.")
            fields = tuple(dict.fromkeys(p.split(".")[0].split("[")[0] for p in self.known))
        if any(path == name or name.startswith(f"{path}.") for path in fields):
            return fields
        self._hidden.add(name)
        return (*fields, name)

    def _during(self, question: Question, windows: NDArray[np.int64]) -> Question:
        """The question in windows of log time, int64[n, 2], alone."""
        rows = np.insert(windows, 2, 1, axis=1)
        summaries = self._session.summaries_of(question)
        return question.within(Intervals((one.id, rows) for one in summaries))

    def _stream(self, question: Question, counters: Counters) -> Iterator[pa.Table]:
        with suppress(TimeError):  # the range does not touch the recording
            planner = Planner(self._session, question, counters)
            tables = (
                stream(planner) if question.frame is None else stream_in_frame(planner, self._trees)
            )
            yield from (table for table in tables if table.num_rows)

    def moments(self, recording: str, span: Span | None = None) -> Moments:
        """The times of all messages beside a recording; no payload is read for log times.

        If these are compared, at least of those in a span, ns.
        """
        if self.is_elsewhere(recording):
            return _NONE
        counters, question = Counters(), replace(self._beside(recording), frame=None)
        log_time, time = _NONE[:2]
        if self._time == TIME:
            if span is not None and question.is_unbounded:
                question = self._during(question, np.array([span], np.int64))
            with suppress(TimeError):  # the range does not touch the recording
                log_time = log_times(self._session, replace(question, fields=None), counters)
            time = log_time = np.sort(log_time) if self.is_apart else log_time
        else:
            tables = self._stream(replace(question, fields=(self._time,)), counters)
            found = [(nanoseconds(one[TIME]), self._times(one, recording)) for one in tables]
            if found:
                log_time, time = (np.concatenate(parts) for parts in zip(*found, strict=True))
        counters.messages = counters.payload_bytes = 0
        if question.predicate is None:
            counters.unreadable = 0
        self.counters.add(counters)
        if (time[1:] >= time[:-1]).all() and not (time == UNKNOWN).any():
            return Moments(log_time, time, np.arange(len(time)))
        order = np.argsort(time, kind="stable")
        order = order[time[order] != UNKNOWN]
        return Moments(log_time, time[order], order)

    def epochs(self, recording: str) -> Epochs:
        """The epochs of a recording on the clock, looked up once."""
        if self._time != STAMP:
            return Epochs("", np.empty(0, np.int64))
        if recording not in self._epochs:
            self._epochs[recording] = epochs_of(self._session, recording)
        return self._epochs[recording]

    @property
    def remarks(self) -> list[str]:
        """Sentences about recordings whose times start again, as far as they were read."""
        return [one.sentence() for one in self._epochs.values() if len(one.begins)]

    def _times(self, table: pa.Table, recording: str) -> NDArray[np.int64]:
        """Times of messages on the clock, ns, those of other epochs far apart.

        `UNKNOWN` where a stamp is missing or not set.
        """
        times = nanoseconds(table[self._time])
        if self._time != STAMP:
            return times
        offsets = 0 if self.is_apart else self.epochs(recording).offsets(nanoseconds(table[TIME]))
        return np.where((times == 0) | (times == UNKNOWN), UNKNOWN, times + offsets)

    def is_elsewhere(self, recording: str) -> bool:
        """True if no message can be beside a recording's rows: they are of other recordings."""
        return not self.is_apart and recording not in self._recordings

    def _beside(self, recording: str) -> Question:
        """The question about the messages that may be beside the rows of a recording."""
        return self.question if self.is_apart else replace(self.question, recordings=(recording,))

    def put(self, columns: dict[str, Any], table: pa.Table, empty: Empty, known: int = 0) -> None:
        """Add the columns of messages to those of the rows, under free names.

        Rows that are `known` to have no message are not counted as without a value.
        """
        for name, column in zip(table.column_names, table.columns, strict=True):
            if name not in self._hidden:
                free = free_name(self.prefix + name, columns)
                columns[free] = column
                empty[free, _NO_VALUE] += max(column.null_count - known, 0)

    def enter(self, recording: str, span: Span | None) -> None:
        """Go on with the rows of another recording, in a span of log time, ns; None: any."""
        near = self.tolerance
        if span is not None:
            span = None if near is None else (max(span[0] - near, BEGIN), min(span[1] + near, END))
        if self.is_apart and span is None:
            self._of_all = self._of_all or self.moments(recording)
        self._moments = self._of_all or self.moments(recording, span)
        self._recording = recording
        self._lost = self._lost_beside(recording)
        stats = [one.stats for one in Planner(self._session, self._beside(recording)).channels()]
        size, messages = sum(one.payload_bytes for one in stats), sum(s.messages for s in stats)
        self.most = max(_PIECE_BYTES * messages // max(size, 1), 1)

    def _lost_beside(self, recording: str) -> NDArray[np.int64]:
        """int64[n, 2], log time in which messages beside a recording are lost, ns, in order."""
        spans: list[tuple[int, int, int]] = []
        if self._time == TIME and not self.is_elsewhere(recording):
            with suppress(TimeError):  # the range does not touch this recording
                lost = lost_times(self._session, self._beside(recording))
                # Those that may be of any time explain no row.
                known = (one for one in lost if one.begin_ns > BEGIN)
                spans = sorted((one.begin_ns, one.end_ns, 0) for one in known)
        return joined(np.array(spans, np.int64).reshape(-1, 3))[:, :2]

    def add(self, columns: dict[str, Any], times: NDArray[np.int64], empty: Empty) -> None:
        """Add the columns of the messages that belong to rows at times, ns, with their distance."""
        known = self._moments.time
        apart = self.epochs(self._recording).apart if self._time == STAMP else None
        found = match(times, known, self.how, self.tolerance, apart)
        if self.how == "interpolate":
            known = known if len(known) else times
            low, high = (known[np.maximum(rows, 0)] for rows in found[:2])
            length = (high - low).astype(np.float64)
            weight = np.where(length > 0, (times - low) / np.where(length > 0, length, 1), 0)
            before, after = self._read(found.before, found.after)
            table = interpolated(before, after, weight, quaternion_paths(self.known))
        else:
            (table,) = self._read(found.before)
        missing = found.before < 0
        distance = pa.array(found.distance, DURATION, mask=missing if missing.any() else None)
        columns[free_name(self.prefix + _DISTANCE, columns)] = distance
        if missing.any():
            self._explain(times, missing, empty)
        self.put(columns, table, empty, distance.null_count)

    def _explain(self, times: NDArray[np.int64], missing: NDArray[np.bool_], empty: Empty) -> None:
        """Count why rows have no message."""
        (topic,) = self.question.topics
        is_unknown = times == UNKNOWN
        is_lost = missing & ~is_unknown & self._is_lost(times)
        plain, near = _WHY[self.how]
        why = plain if self.tolerance is None else near.format(format_duration(self.tolerance))
        empty[topic, _NO_TIME] += int(is_unknown.sum())
        empty[topic, _LOST] += int(is_lost.sum())
        empty[topic, why] += int((missing & ~is_unknown & ~is_lost).sum())

    def _is_lost(self, times: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Rows whose message may have been lost."""
        low, high = np.full_like(times, BEGIN), times
        if self.tolerance is not None:
            low = np.maximum(times, BEGIN + self.tolerance) - self.tolerance
        if self.how != "asof":
            near = END if self.tolerance is None else self.tolerance
            high = np.minimum(times, END - near) + near
        place = np.searchsorted(self._lost[:, 1], low, "right")
        begins = np.append(self._lost[:, 0], END)[place]
        return (begins <= high) & (place < len(self._lost))

    def _read(self, *parts: NDArray[np.int64]) -> list[pa.Table]:
        """The messages at rows of `Moments.time`: null for -1, and where one cannot be read.

        What a predicate cannot decide `moments` has counted.
        """
        own, rows = self._moments, np.concatenate(parts)
        wanted = np.unique(own.place[rows[rows >= 0]])
        if not len(wanted):
            return [self.empty.take(pa.nulls(len(part), pa.int64())) for part in parts]
        times = own.log_time[wanted]
        ends = np.flatnonzero(np.diff(wanted) > self.most // _SKIPPED + 1)
        begin = placed(times[np.append(0, ends + 1)])
        end = placed(times[np.append(ends, len(times) - 1)]) + 1
        counters = Counters()
        question = self._during(self._beside(self._recording), np.stack([begin, end], axis=1))
        tables = self._stream(question, counters)
        if len(wanted) <= wanted[-1] - wanted[0]:
            tables = (one.filter(np.isin(nanoseconds(one[TIME]), times)) for one in tables)
        held = concatenated([self.empty, *tables])
        if question.predicate is not None:
            counters.unreadable = counters.without_arrays = 0
            counters.not_indexed = ()
        self.counters.add(counters)
        row_of = np.append(_rows_of(times, own.log_time, nanoseconds(held[TIME]), wanted), -1)
        places = (np.where(part < 0, len(own.log_time), own.place[part]) for part in parts)
        chosen = [row_of[wanted.searchsorted(one)] for one in places]
        found = [held.take(pa.array(one, mask=one < 0)) for one in chosen]
        # Of these the size is known; of the next ones there may be more.
        size = max(found[0].nbytes // len(parts[0]), 1)
        self.most = max(min(_PIECE_BYTES // size, 2 * self.most), 1)
        return found


def _rows_of(
    times: NDArray[np.int64],
    known: NDArray[np.int64],
    read: NDArray[np.int64],
    places: NDArray[np.intp],
) -> NDArray[np.intp]:
    """The rows of messages at some places among those that were read; -1 for unknown ones.

    Some cannot be read: of an equal log time there are as many as known, or it is unknown which.
    """
    first, start = known.searchsorted(times), read.searchsorted(times)
    count = known.searchsorted(times, "right") - first
    is_known = read.searchsorted(times, "right") - start == count
    return np.where(is_known, start + places - first, -1)


def nanoseconds(column: pa.ChunkedArray[Any]) -> NDArray[np.int64]:
    """Times of a column as integers; `UNKNOWN` for null."""
    times: NDArray[np.int64] = column.cast(pa.int64()).fill_null(UNKNOWN).to_numpy()
    return times


def concatenated(tables: Sequence[pa.Table]) -> pa.Table:
    """Tables one after the other; a column has the common exact type of all of them."""
    if all(table.schema == tables[0].schema for table in tables):
        return pa.concat_tables(tables)
    schema = common_schema(tables)
    columns = [
        pa.chunked_array([c for table in tables for c in column_of(table, one).chunks], one.type)
        for one in schema
    ]
    return pa.Table.from_arrays(columns, schema=schema)


class Aligned:
    """The messages of topics side by side. Each access reads them again.

    Rows are ordered by recording, oldest first, then by log time. Messages of different
    recordings are in one row only where that is asked for.

    Attributes:
        rows: Number of rows of the last answer.
    """

    def __init__(
        self,
        session: Session,
        base: TopicReader | RegularTimes,
        beside: Sequence[TopicReader],
        how: str,
    ) -> None:
        self._session = session
        self._base = base
        self._beside = beside
        self._readers = [*([base] if isinstance(base, TopicReader) else []), *beside]
        self._how = how
        self.rows = 0
        self._empty: Empty = Counter()

    @property
    def empty(self) -> dict[str, dict[str, int]]:
        """Numbers of rows that are empty in the last answer, by reason.

        They are by topic where it has no message for the row, by column where that has no value.
        """
        found: dict[str, dict[str, int]] = {}
        for (name, reason), rows in (+self._empty).items():
            found.setdefault(name, {})[reason] = rows
        return found

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
            for (name, reason), number in (+self._empty).items()
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
        self.rows, self._empty = 0, Counter()
        base = self._base
        several = len(self._session.summaries_of(base.question)) > 1
        chosen = resolved(self._session, base.question)
        for summary, *_ in chosen if limit != 0 else ():
            span = None if summary.status in UNFINISHED else summary.extent
            if base.question.bounds is not None and base.question.clock == "log":
                span = bounds_in(self._session, base.question, summary)
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
        columns: dict[str, Any] = {TIME: own[TIME]}
        if recording is not None:
            columns[RECORDING] = text_column(recording, len(times))
        if isinstance(self._base, TopicReader):
            self._base.put(columns, own, self._empty)
        for one in self._beside:
            one.add(columns, times, self._empty)
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
        for summary, span in log_spans(session, question):
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
    settings = {**_checked(how, tolerance), "clock": clock}
    (prefix, one), *named = _named([base, *others])
    rows = TopicReader(session, one, prefix=prefix, **settings)
    beside = [
        TopicReader(session, one, prefix=prefix, is_apart=across_recordings, **settings)
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
    settings, named = _checked(how, tolerance), _named([question])
    beside = [
        TopicReader(session, one, prefix=prefix if len(named) > 1 else "", **settings)
        for prefix, one in named
    ]
    return Aligned(session, times, beside, how)


def _checked(how: str, tolerance: DurationLike | None) -> dict[str, Any]:
    """The way to match, which must be one of `HOWS`, and the tolerance in ns."""
    if how not in HOWS:
        raise UsageError(f"Unknown way {how!r}; choose {', '.join(HOWS)}.")
    return {"how": how, "tolerance": None if tolerance is None else parse_duration(tolerance)}


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
