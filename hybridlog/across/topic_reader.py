"""One topic of an alignment: when its messages were, and their values, on a clock."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

import numpy as np
import pyarrow as pa

from hybridlog.across.match import UNKNOWN, Matched, interpolated, match, quaternion_paths
from hybridlog.frames.names import free_name
from hybridlog.query.answers.lost import lost_times
from hybridlog.query.intervals import Intervals, joined
from hybridlog.query.planner import Planner, log_times
from hybridlog.query.question import Counters
from hybridlog.query.times import format_duration
from hybridlog.schema.arrow_columns import DURATION, numbers
from hybridlog.schema.arrow_types import column_of, common_schema
from hybridlog.schema.column import STAMP
from hybridlog.tf.epochs import Epochs, epochs_of
from hybridlog.tf.in_frame import stream
from hybridlog.wording import listed
from hybridlog_storage.errors import TimeError, UsageError
from hybridlog_storage.lazy import lazy
from hybridlog_storage.times import BEGIN, END, span_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.question import Clock, Question, Span
    from hybridlog.session import Session

Block = tuple["NDArray[np.int64]", pa.Table]
"""Times of some messages, ns, and their columns."""
TIME: Final = "log_time"
"""Column of the time of a row."""
RECORDING: Final = "recording"
"""Column of the recording of a row."""
SIDES: Final[tuple[Literal["left", "right"], ...]] = ("left", "right")
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
_PIECE_BYTES = 32 << 20  # messages of a topic that are read together
_MAX_NAMES: Final = 3  # recordings in a message


class Moments(NamedTuple):
    """Times of the messages of a topic.

    Attributes:
        log_time: int64[n], ns, ascending.
        time: int64[k], times on the clock of the messages that have one, ns, ascending.
        place: intp[k], which of the n messages each of these is.
    """

    log_time: NDArray[np.int64]
    time: NDArray[np.int64]
    place: NDArray[np.intp]


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
        self._of_all: Moments | None = None  # of all recordings, if these are apart
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
    def quaternions(self) -> list[str]:
        """Paths of the quaternions among the fields."""
        return quaternion_paths(self._known)

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
        for table in self._stream(replace(self._beside(recording), fields=fields)):
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

    def values(self, recording: str, span: Span) -> Iterator[pa.Table]:
        """The messages beside a recording in a span of log time, ns, in order."""
        yield from self._stream(self._during(self._beside(recording), span), is_decided=True)

    def _during(self, question: Question, span: Span) -> Question:
        row = np.array([[*span, 1]], np.int64)
        ids = [one.id for one in self._session.summaries_of(question)]
        return replace(question, during=Intervals((one, row) for one in ids))

    def moments(self, recording: str, span: Span | None = None) -> Moments:
        """The times of all messages beside a recording; no payload is read for log times.

        If these are compared, at least of those in a span, ns.
        """
        if self._time != TIME or not self.question.is_unbounded:
            span = None
        if not self.is_apart or span is not None:
            return self._moments(recording, span)
        self._of_all = self._of_all or self._moments(recording, None)
        return self._of_all

    def _moments(self, recording: str, span: Span | None) -> Moments:
        none = np.empty(0, np.int64)
        if self.elsewhere(recording) is not None:
            return Moments(none, none, none)
        counters, question = Counters(), replace(self._beside(recording), frame=None)
        if span is not None:
            question = self._during(question, span)
        log_time, time = none, none
        with suppress(TimeError):  # the range does not touch the recording
            if self._time == TIME:
                log_time = log_times(self._session, replace(question, fields=None), counters)
            else:
                question = replace(question, fields=(self._time,))
                tables = stream(Planner(self._session, question, counters))
                found = [(nanoseconds(one[TIME]), self._times(one, recording)) for one in tables]
                log_time, time = (np.concatenate(parts) for parts in zip(*found, strict=True))
        counters.messages = counters.payload_bytes = 0
        if question.predicate is None:
            counters.unreadable = 0
        self.counters.add(counters)
        if self._time == TIME:
            log_time = np.sort(log_time) if self.is_apart else log_time
            return Moments(log_time, log_time, np.arange(len(log_time)))
        order = np.argsort(time, kind="stable")
        order = order[time[order] != UNKNOWN]
        return Moments(log_time, time[order], order)

    def _stream(self, question: Question, *, is_decided: bool = False) -> Iterator[pa.Table]:
        """The tables with rows of an answer, whose cost counts.

        If a predicate is decided, `moments` has counted what it cannot decide.
        """
        counters = Counters()
        try:
            with suppress(TimeError):  # the range does not touch the recording
                for table in stream(Planner(self._session, question, counters)):
                    if table.num_rows:
                        yield table
        finally:
            if is_decided and question.predicate is not None:
                counters.unreadable = counters.without_arrays = 0
                counters.not_indexed = ()
            self.counters.add(counters)

    def message_bytes(self, recording: str) -> int:
        """Mean bytes of the messages beside a recording, at least one."""
        kinds = self.empty.schema.types
        if self._known is not None and all(map(pa.types.is_primitive, kinds)):
            return int(sum(kind.bit_width for kind in kinds)) // 8
        stats = [one.stats for one in Planner(self._session, self._beside(recording)).channels()]
        size = sum(one.payload_bytes for one in stats)
        return max(size // max(sum(one.messages for one in stats), 1), 1)

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
        snapshot = self._session.snapshot()
        place, places = snapshot.by_id[recording], self._session.chosen(self.question)
        if self.is_apart or place in places:
            return None
        is_near = (snapshot.begin[places] < snapshot.end[place]) & (
            snapshot.begin[place] < snapshot.end[places]
        )
        names = [snapshot.summaries[n].name for n in places[is_near].tolist()]
        if not names:
            return "the messages are of other recordings"
        return (
            "the messages of that time are of other recordings "
            f"({listed(names, _MAX_NAMES)}), which --beside or across_recordings takes"
        )

    def lost(self, recording: str) -> NDArray[np.int64]:
        """int64[n, 2], log time in which messages beside a recording are lost, ns, in order."""
        spans: list[tuple[int, int, int]] = []
        if self._time == TIME and self.elsewhere(recording) is None:
            with suppress(TimeError):  # the range does not touch this recording
                lost = lost_times(self._session, self._beside(recording))
                # Those that may be of any time explain no row.
                known = (one for one in lost if one.begin_ns > BEGIN)
                spans = sorted((one.begin_ns, one.end_ns, 0) for one in known)
        return joined(np.array(spans, np.int64).reshape(-1, 3))[:, :2]

    def _beside(self, recording: str) -> Question:
        """The question about the messages that may be beside the rows of a recording."""
        return self.question if self.is_apart else replace(self.question, recordings=(recording,))

    def add(
        self, columns: dict[str, Any], table: pa.Table, blank: Counter[tuple[str, str]], known: int
    ) -> None:
        """Add the columns of messages to those of the rows, under free names.

        `blank` counts rows that have no value, by column and reason, but for those `known` to have
        no message.
        """
        for name, column in zip(table.column_names, table.columns, strict=True):
            if name not in self._hidden:
                free = free_name(self.prefix + name, columns)
                columns[free] = column
                if column.null_count > known:
                    blank[free, _NO_VALUE] += column.null_count - known


class Beside:
    """A topic beside rows: finds the messages that belong to times, and reads them in pieces.

    The tolerance is the greatest distance, ns; None for any.
    """

    def __init__(self, reader: TopicReader, how: str, tolerance: int | None = None) -> None:
        self._reader = reader
        self._how = how
        self._tolerance = tolerance
        why = _WHY if tolerance is None else _WHY_NEAR
        self._why = why.get(how, "").format(format_duration(tolerance or 0))

    def enter(self, recording: str, span: Span | None) -> None:
        """Go on with the rows of another recording, in a span of log time, ns; None: any."""
        near = self._tolerance
        if span is not None:
            span = None if near is None else (max(span[0] - near, BEGIN), min(span[1] + near, END))
        self._recording = recording
        self._reason = self._reader.elsewhere(recording) or self._why
        self._lost = self._reader.lost(recording)
        self._moments = self._reader.moments(recording, span)
        self._most = max(_PIECE_BYTES // self._reader.message_bytes(recording), 1)
        self._held, self._first, self._last = self._reader.empty, END, BEGIN

    def match(self, times: NDArray[np.int64]) -> Matched:
        """The messages that belong to rows at times, ns: their rows in `Moments.time`."""
        apart = self._reader.epochs(self._recording).apart
        return match(times, self._moments.time, self._how, self._tolerance, apart)

    def fitting(self, matched: Matched, begin: int) -> int:
        """The number of rows from one on that are made together: one, or of bounded size."""
        if len(self._moments.place) <= self._most >= len(matched.before):
            return len(matched.before) - begin
        rows = np.stack([part[begin : begin + self._most] for part in matched[:2]])
        is_there, places = rows >= 0, self._moments.place
        found = places[rows] if len(places) else rows
        low = np.minimum.accumulate(np.where(is_there, found, len(places)).min(0))
        high = np.maximum.accumulate(np.where(is_there, found, -1).max(0))
        return max(int(np.searchsorted(high - low, self._most)), 1)

    def add(
        self,
        columns: dict[str, Any],
        times: NDArray[np.int64],
        matched: Matched,
        empty: Counter[tuple[str, str]],
    ) -> None:
        """Add the columns of the messages that belong to rows at times, ns, with their distance.

        `empty` counts rows without a message or a value, by name and reason.
        """
        if self._how == "interpolate":
            known = self._moments.time if len(self._moments.time) else times
            low, high = (known[np.maximum(rows, 0)] for rows in matched[:2])
            length = (high - low).astype(np.float64)
            weight = (times - low) / np.where(length > 0, length, 1)
            weight[length <= 0] = 0
            before, after = self._read(matched.before, matched.after)
            table = interpolated(before, after, weight, self._reader.quaternions)
        else:
            (table,) = self._read(matched.before)
        missing = matched.before < 0
        distance = (
            pa.array(matched.distance, DURATION, mask=missing)
            if missing.any()
            else numbers(matched.distance, "duration")
        )
        columns[free_name(self._reader.prefix + _DISTANCE, columns)] = distance
        if none := distance.null_count:
            (topic,) = self._reader.question.topics
            is_unknown = times == UNKNOWN
            is_lost = missing & ~is_unknown & self._is_lost(times)
            lost, unknown = int(is_lost.sum()), int(is_unknown.sum())
            empty[topic, _NO_TIME] += unknown
            empty[topic, _LOST] += lost
            empty[topic, self._reason] += none - lost - unknown
        self._reader.add(columns, table, empty, none)

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
        own, known = self._moments, np.concatenate(parts)
        places = own.place[known[known >= 0]]
        if len(places):
            self._hold(*(int(own.log_time[end]) for end in (places.min(), places.max())))
        return [self._held.take(self._rows(rows)) for rows in parts]

    def _rows(self, rows: NDArray[np.int64]) -> pa.Array:
        """The rows of what is held for rows of `Moments.time`."""
        own, is_none = self._moments, rows < 0
        if is_none.all():
            return pa.nulls(len(rows), pa.int64())
        place = own.place[rows]
        begin = np.searchsorted(own.log_time, self._first)
        row = place - begin
        if self._held.num_rows != np.searchsorted(own.log_time, self._last, "right") - begin:
            # Some cannot be read: of an equal log time there are as many, or it is unknown which.
            times, read = own.log_time[place], nanoseconds(self._held[TIME])
            first, behind = (np.searchsorted(own.log_time, times, side) for side in SIDES)
            start, end = (np.searchsorted(read, times, side) for side in SIDES)
            row = start + place - first
            is_none = is_none | (end - start != behind - first)
        return pa.array(row, mask=is_none)

    def _hold(self, first: int, last: int) -> None:
        """Hold the messages from one log time to another, ns; those that are held stay."""
        if self._first <= first <= self._last:
            begin = int(np.searchsorted(nanoseconds(self._held[TIME]), first))
            kept, start = self._held.slice(begin), self._last + 1
        else:
            kept, start, self._last = self._reader.empty, first, BEGIN
        self._first = first
        if self._last < last:
            self._last = last
            tables = self._reader.values(self._recording, span_of(start, last))
            self._held = kept = concatenated([kept, *tables])
            # Of what was read the size is known; it may be more at a time, but not at once.
            fitting = _PIECE_BYTES * kept.num_rows // max(kept.nbytes, 1)
            self._most = max(min(fitting, 2 * self._most), 1)
        self._held = kept


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
