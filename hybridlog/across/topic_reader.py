"""One topic of an alignment: when its messages were on a clock, and those that belong to rows."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
from msgspec.structs import replace

from hybridlog.across.match import UNKNOWN, interpolated, match, quaternion_paths
from hybridlog.frames.names import free_name
from hybridlog.query.answers.lost import lost_times
from hybridlog.query.intervals import Intervals, joined
from hybridlog.query.planner import Planner, log_times
from hybridlog.query.question import Counters
from hybridlog.query.times import format_duration
from hybridlog.schema.arrow_columns import DURATION
from hybridlog.schema.arrow_types import column_of, common_schema
from hybridlog.schema.column import STAMP
from hybridlog.tf.epochs import Epochs, epochs_of
from hybridlog.tf.in_frame import Known, stream
from hybridlog_storage.cache import lazy
from hybridlog_storage.errors import TimeError, UsageError
from hybridlog_storage.times import BEGIN, END, placed

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.question import Clock, Question, Span
    from hybridlog.session import Session

Block = tuple["NDArray[np.int64]", pa.Table]
"""Times of some messages, ns, and their columns."""
Empty = Counter[tuple[str, str]]
"""Number of rows without a message, by topic and reason, or without a value, by column."""
TIME: Final = "log_time"
"""Column of the time of a row."""
RECORDING: Final = "recording"
"""Column of the recording of a row."""
_DISTANCE: Final = "distance"
_LOST: Final = "messages of that time are lost"
_NO_TIME: Final = "the row has no time on the clock"
_NO_VALUE: Final = "the message has no such value"
_WHY: Final = {
    "asof": "no message came before",
    "nearest": "no message",
    "interpolate": "no message before, or none after",
}
_WHY_NEAR: Final = {
    "asof": "no message within {} before",
    "nearest": "no message within {}",
    "interpolate": "no message within {} before and after",
}
_PIECE_BYTES = 32 << 20  # messages of a topic that rows get together
_SKIPPED_BYTES = 1 << 20  # messages between needed ones that are read along


class Moments(NamedTuple):
    """Log times of n messages, and times on the clock of the k that have one, ns, ascending.

    `place` is intp[k], which of the n each of these is.
    """

    log_time: NDArray[np.int64]
    time: NDArray[np.int64]
    place: NDArray[np.intp]


_NONE: Final = Moments(*[np.empty(0, np.int64)] * 3)


class TopicReader:
    """One topic of an alignment: its messages with their times on a clock.

    The names of its columns begin with the prefix. If it `is_apart`, its messages may be of other
    recordings than the rows.
    """

    def __init__(
        self,
        session: Session,
        question: Question,
        clock: Clock = "log",
        *,
        prefix: str = "",
        is_apart: bool = False,
    ) -> None:
        if not question.returns_all or question.reverse:
            raise UsageError(
                "An alignment uses all messages; it cannot be combined with limit, every or "
                "reverse."
            )
        self.prefix = prefix
        self.is_apart = is_apart
        self.counters = Counters()
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
    def _known(self) -> dict[str, str] | None:
        """Types of the fields, by path; None where no definition fixes them."""
        return self._session.field_types(self.question.topics, self.question.recordings)

    @lazy
    def empty(self) -> pa.Table:
        """No rows, with the columns of all recordings."""
        question = replace(self.question, limit=0, bounds=None, during=None, predicate=None)
        return next(stream(Planner(self._session, question)))

    def rows(self, recording: str) -> Iterator[Block]:
        """The messages of a recording, by log time, with their times on the clock."""
        fields = self.question.fields
        if self._time != TIME:
            fields = self._with_time(fields)
        question = replace(self._beside(recording), fields=fields)
        for table in self._stream(question, self.counters):
            yield self._times(table, recording), table

    def _with_time(self, fields: tuple[str, ...] | None) -> tuple[str, ...] | None:
        """The requested fields and the time on the clock, which is hidden if only we ask."""
        name = self._time
        if fields is None:
            if name == STAMP:
                return None
            if self._known is None:
                raise UsageError("The fields of this topic are not fixed: name them.")
            fields = tuple(dict.fromkeys(p.split(".")[0].split("[")[0] for p in self._known))
        if any(path == name or name.startswith(f"{path}.") for path in fields):
            return fields
        self._hidden.add(name)
        return (*fields, name)

    def within(self, recording: str, windows: NDArray[np.int64]) -> Iterator[pa.Table]:
        """The messages beside a recording in windows of log time, int64[n, 2], in order.

        What a predicate cannot decide `moments` has counted.
        """
        counters = Counters()
        try:
            yield from self._stream(self._during(self._beside(recording), windows), counters)
        finally:
            if self.question.predicate is not None:
                counters.unreadable = counters.without_arrays = 0
                counters.not_indexed = ()
            self.counters.add(counters)

    def _during(self, question: Question, windows: NDArray[np.int64]) -> Question:
        rows = np.insert(windows, 2, 1, axis=1)
        summaries = self._session.summaries_of(question)
        return question.within(Intervals((one.id, rows) for one in summaries))

    def _stream(self, question: Question, counters: Counters) -> Iterator[pa.Table]:
        with suppress(TimeError):  # the range does not touch the recording
            for table in stream(Planner(self._session, question, counters), self._trees):
                if table.num_rows:
                    yield table

    def moments(self, recording: str, span: Span | None = None) -> Moments:
        """The times of all messages beside a recording; no payload is read for log times.

        If these are compared, at least of those in a span, ns.
        """
        if self.elsewhere(recording) is not None:
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

    def elsewhere(self, recording: str) -> str | None:
        """The reason why no message can be beside a recording's rows; None if one may be."""
        place = self._session.snapshot().by_id[recording]
        if self.is_apart or place in self._session.chosen(self.question):
            return None
        return "the messages are of other recordings, which --beside or across_recordings takes"

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
                if column.null_count > known:
                    empty[free, _NO_VALUE] += column.null_count - known


class Beside(TopicReader):
    """A topic beside rows: finds the messages that belong to their times.

    Times are whole, values come for a piece of the rows: at most `most` of them together.
    """

    def __init__(
        self,
        session: Session,
        question: Question,
        clock: Clock = "log",
        *,
        how: str,
        tolerance: int | None = None,
        prefix: str = "",
        is_apart: bool = False,
    ) -> None:
        super().__init__(session, question, clock, prefix=prefix, is_apart=is_apart)
        self._how = how
        self._tolerance = tolerance
        self._recording = ""
        self._moments = _NONE
        self._of_all: Moments | None = None  # of all recordings, if these are apart
        self._lost = np.empty((0, 2), np.int64)
        self.most = 1

    def enter(self, recording: str, span: Span | None) -> None:
        """Go on with the rows of another recording, in a span of log time, ns; None: any."""
        near = self._tolerance
        if span is not None:
            span = None if near is None else (max(span[0] - near, BEGIN), min(span[1] + near, END))
        if self.is_apart and span is None:
            self._of_all = self._of_all or self.moments(recording)
        self._moments = self._of_all or self.moments(recording, span)
        self._recording = recording
        self._lost = self._lost_beside(recording)
        stats = [one.stats for one in Planner(self._session, self._beside(recording)).channels()]
        size = sum(one.payload_bytes for one in stats)
        self._fit(max(size // max(sum(one.messages for one in stats), 1), 1))

    def _fit(self, size: int) -> None:
        """Take as many rows together as fit with messages of so many bytes."""
        self.most = max(_PIECE_BYTES // size, 1)
        self._skipped = _SKIPPED_BYTES // size

    def _lost_beside(self, recording: str) -> NDArray[np.int64]:
        """int64[n, 2], log time in which messages beside a recording are lost, ns, in order."""
        spans: list[tuple[int, int, int]] = []
        if self._time == TIME and self.elsewhere(recording) is None:
            with suppress(TimeError):  # the range does not touch this recording
                lost = lost_times(self._session, self._beside(recording))
                # Those that may be of any time explain no row.
                known = (one for one in lost if one.begin_ns > BEGIN)
                spans = sorted((one.begin_ns, one.end_ns, 0) for one in known)
        return joined(np.array(spans, np.int64).reshape(-1, 3))[:, :2]

    def add(self, columns: dict[str, Any], times: NDArray[np.int64], empty: Empty) -> None:
        """Add the columns of the messages that belong to rows at times, ns, with their distance."""
        known, apart = self._moments.time, self.epochs(self._recording).apart
        found = match(times, known, self._how, self._tolerance, apart)
        if self._how == "interpolate":
            known = known if len(known) else times
            low, high = (known[np.maximum(rows, 0)] for rows in found[:2])
            length = (high - low).astype(np.float64)
            weight = (times - low) / np.where(length > 0, length, 1)
            weight[length <= 0] = 0
            before, after = self._read(found.before, found.after)
            table = interpolated(before, after, weight, quaternion_paths(self._known))
        else:
            (table,) = self._read(found.before)
        missing = found.before < 0
        distance = pa.array(found.distance, DURATION, mask=missing if missing.any() else None)
        columns[free_name(self.prefix + _DISTANCE, columns)] = distance
        if none := distance.null_count:
            (topic,) = self.question.topics
            is_unknown = times == UNKNOWN
            is_lost = missing & ~is_unknown & self._is_lost(times)
            lost, unknown = int(is_lost.sum()), int(is_unknown.sum())
            empty[topic, _NO_TIME] += unknown
            empty[topic, _LOST] += lost
            empty[topic, self._why()] += none - lost - unknown
        self.put(columns, table, empty, none)

    def _why(self) -> str:
        """Why rows have no message, if none is known to be lost."""
        why = _WHY if self._tolerance is None else _WHY_NEAR
        return self.elsewhere(self._recording) or why[self._how].format(
            format_duration(self._tolerance or 0)
        )

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

    def _read(self, *parts: NDArray[np.int64]) -> list[pa.Table]:
        """The messages at rows of `Moments.time`: null for -1, and where one cannot be read."""
        own, rows = self._moments, np.concatenate(parts)
        wanted = own.place[rows[rows >= 0]]
        if not len(wanted):
            return [self.empty.take(pa.nulls(len(part), pa.int64())) for part in parts]
        first = int(wanted.min())
        is_wanted = np.zeros(int(wanted.max()) + 1 - first, np.bool_)
        is_wanted[wanted - first] = True
        places = np.flatnonzero(is_wanted) + first
        ends = np.flatnonzero(np.diff(places) > self._skipped + 1)
        times = own.log_time[places]
        begin = placed(times[np.append(0, ends + 1)])
        end = placed(times[np.append(ends, len(times) - 1)]) + 1
        tables = self.within(self._recording, np.stack([begin, end], axis=1))
        if not is_wanted.all():
            tables = (table.filter(np.isin(nanoseconds(table[TIME]), times)) for table in tables)
        held = concatenated([self.empty, *tables])
        row_of = np.full(len(is_wanted) + 1, -1)  # for -1, too
        row_of[:-1][is_wanted] = _rows_of(times, own.log_time, nanoseconds(held[TIME]), places)
        chosen = [row_of[np.where(part < 0, -1, own.place[part] - first)] for part in parts]
        found = [held.take(pa.array(one, mask=one < 0)) for one in chosen]
        # Of these the size is known; of the next ones there may be more.
        self._fit(max(found[0].nbytes // len(parts[0]), _PIECE_BYTES // (2 * self.most), 1))
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
    if column.null_count:
        column = column.cast(pa.int64()).fill_null(UNKNOWN)
    whole = column.chunk(0) if column.num_chunks == 1 else column
    times: NDArray[np.int64] = whole.to_numpy().view(np.int64)
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
