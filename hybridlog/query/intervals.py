"""Intervals of log time: the answers for states, changes and windows around events.

All intervals are half-open, `begin <= time < end`, and each belongs to one recording:
no interval spans two recordings. They are columns, not objects; an `Interval` is made
on access.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from hybridlog.query.times import (
    DurationLike,
    format_duration,
    format_time,
    parse_duration,
)
from hybridlog.schema.column import ranges
from hybridlog_storage.errors import TopicError, UsageError
from hybridlog_storage.ordering import run_starts
from hybridlog_storage.times import END, placed

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray


Span = tuple[int, int]
"""`[begin, end)` in nanoseconds."""

MAX_PIECES = 10_000_000
"""Maximum number of intervals that `Intervals.cut` makes."""
_ROWS_PER_BATCH = 10_000  # intervals whose columns become Python numbers together


class Events(Protocol):
    """Messages at some times: those of a query."""

    @property
    def recordings(self) -> tuple[str, ...]:
        """Ids of their recordings."""

    @property
    def question(self) -> Any:
        """The questions that they answer."""

    def during(self, intervals: Intervals) -> Events:
        """Only those in some intervals."""

    def windows(self, before: DurationLike = 0, after: DurationLike = 0) -> Intervals:
        """Time around each of them."""


@dataclass(frozen=True, slots=True)
class Interval:
    """A span of log time of one recording.

    Attributes:
        recording: Id of the recording.
        begin_ns: First nanosecond, since the epoch.
        end_ns: First nanosecond after it.
        messages: Number of messages it was made from.
    """

    recording: str
    begin_ns: int
    end_ns: int
    messages: int

    def __repr__(self) -> str:
        return (
            f"<Interval {self.recording} {format_time(self.begin_ns)} "
            f"{format_duration(self.duration_ns)}>"
        )

    @property
    def duration_ns(self) -> int:
        """Length of the interval, nanoseconds."""
        return self.end_ns - self.begin_ns


class Intervals:
    """Intervals, ordered by their beginning. Immutable: each method returns new ones.

    Args:
        recordings: Ids, in the order of intervals that begin at the same time.
        recording: int32[n], index into `recordings`.
        begin: int64[n], ns since the epoch.
        end: int64[n], ns; never before `begin`.
        messages: int64[n], number of messages of each interval.
    """

    __slots__ = ("_begin", "_end", "_messages", "_places", "_recording", "_recordings")

    def __init__(
        self,
        recordings: tuple[str, ...],
        recording: NDArray[np.int32],
        begin: NDArray[np.int64],
        end: NDArray[np.int64],
        messages: NDArray[np.int64],
    ) -> None:
        order = np.lexsort((end, recording, begin))
        self._recordings = recordings
        self._places: dict[str, NDArray[np.intp]] | None = None
        self._recording: NDArray[np.int32] = recording[order]
        self._begin: NDArray[np.int64] = begin[order]
        self._end: NDArray[np.int64] = end[order]
        self._messages: NDArray[np.int64] = messages[order]

    @classmethod
    def of(cls, parts: Iterable[tuple[str, NDArray[np.int64]]]) -> Intervals:
        """Intervals from parts of recordings.

        Args:
            parts: Id of a recording, and int64[n, 3]: begin, end, messages. A recording
                may have several parts.
        """
        ids: dict[str, int] = {}
        rows: list[NDArray[np.int64]] = [np.empty((0, 3), np.int64)]
        codes: list[NDArray[np.int32]] = [np.empty(0, np.int32)]
        for name, part in parts:
            rows.append(part)
            codes.append(np.full(len(part), ids.setdefault(name, len(ids)), np.int32))
        begin, end, messages = np.ascontiguousarray(np.concatenate(rows).T)
        return cls(tuple(ids), np.concatenate(codes), begin, end, messages)

    @property
    def recordings(self) -> tuple[str, ...]:
        """Ids of the recordings that have intervals, or had some."""
        return self._recordings

    def __len__(self) -> int:
        """Number of intervals."""
        return len(self._begin)

    def __iter__(self) -> Iterator[Interval]:
        """The intervals, one by one."""
        columns = (self._recording, self._begin, self._end, self._messages)
        for start in range(0, len(self), _ROWS_PER_BATCH):
            rows = (column[start : start + _ROWS_PER_BATCH].tolist() for column in columns)
            for code, begin, end, count in zip(*rows, strict=True):
                yield Interval(self._recordings[code], begin, end, count)

    def __getitem__(self, place: int) -> Interval:
        """The interval at an index; a negative index counts from the end."""
        return Interval(
            self._recordings[self._recording[place]],
            int(self._begin[place]),
            int(self._end[place]),
            int(self._messages[place]),
        )

    def __repr__(self) -> str:
        return f"<Intervals {len(self)}, {format_duration(self.duration_ns)} in all>"

    def __eq__(self, other: object) -> bool:
        """True if both have the same intervals of the same recordings."""
        return isinstance(other, Intervals) and self._value() == other._value()

    def __hash__(self) -> int:
        return hash(self._value())

    def _value(self) -> tuple[object, ...]:
        names = np.array(self._recordings, object)[self._recording] if len(self) else ()
        columns = (self._begin, self._end, self._messages)
        return tuple(names), *(column.tobytes() for column in columns)

    @property
    def duration_ns(self) -> int:
        """Sum of the lengths, nanoseconds; time in which intervals overlap counts twice."""
        return int((self._end - self._begin).sum())

    def at_least(self, length: DurationLike) -> Intervals:
        """The intervals of at least this length.

        Raises:
            TimeError: it is no duration.
        """
        return self._take(self._end - self._begin >= parse_duration(length))

    def cut(self, length: DurationLike) -> Intervals:
        """Each interval cut into as many pieces of exactly this length as fit.

        The first piece begins where the interval begins, each next one where the last ends.
        A shorter rest is dropped. `messages` remains that of the whole interval.

        Raises:
            TimeError: the length is no duration.
            UsageError: the length is zero, or there would be too many pieces.
        """
        size = parse_duration(length)
        if size == 0:
            raise UsageError("Intervals cannot be cut into pieces of length 0.")
        count = (self._end - self._begin) // size
        if int(count.sum()) > MAX_PIECES:
            raise UsageError(
                f"The cut makes {int(count.sum())} intervals; use a greater length or a time range."
            )
        source = np.repeat(np.arange(len(self)), count)
        number = np.arange(len(source)) - np.repeat(np.cumsum(count) - count, count)
        begin = self._begin[source] + number * size
        return Intervals(
            self._recordings, self._recording[source], begin, begin + size, self._messages[source]
        )

    def widened(self, before: DurationLike = 0, after: DurationLike = 0) -> Intervals:
        """Intervals that begin earlier and end later by these times; they may overlap.

        Raises:
            TimeError: `before` or `after` is no duration.
        """
        begin = np.maximum(self._begin, parse_duration(before)) - parse_duration(before)
        later = parse_duration(after)
        end = np.minimum(self._end, END - later) + later
        return Intervals(self._recordings, self._recording, begin, end, self._messages)

    def merged(self) -> Intervals:
        """Overlapping or touching intervals of a recording joined; empty ones dropped."""
        return Intervals.of((name, joined(self._rows_of(name))) for name in self._recordings)

    def common(self, other: Intervals) -> Intervals:
        """The intersection: times of a recording that intervals of both cover.

        `messages` is 0, since no messages belong to the new intervals.
        """
        if len(other.recordings) < len(self._recordings):
            return other.common(self)
        parts = []
        for name in self._recordings:
            mine, theirs = self.of_recording(name), other.of_recording(name)
            # Each pair that overlaps: the others that end after this one begins, and so on.
            low = np.searchsorted(theirs[:, 1], mine[:, 0], "right")
            high = np.searchsorted(theirs[:, 0], mine[:, 1], "left")
            count = np.maximum(high - low, 0)
            one, pair = np.repeat(np.arange(len(mine)), count), ranges(low, count)
            begin = np.maximum(mine[one, 0], theirs[pair, 0])
            end = np.minimum(mine[one, 1], theirs[pair, 1])
            parts.append((name, np.stack([begin, end, np.zeros_like(begin)], axis=1)))
        return Intervals.of(parts)

    def union(self, other: Intervals) -> Intervals:
        """Times of a recording that intervals of either cover, joined.

        `messages` is 0, since no messages belong to the new intervals.
        """
        parts = []
        for one in (self, other):
            for name in one.recordings:
                rows = one.of_recording(name)
                parts.append((name, np.insert(rows, 2, 0, axis=1)))
        return Intervals.of(parts).merged()

    def without(self, other: Intervals) -> Intervals:
        """Times of a recording that these intervals cover and the other ones do not.

        `messages` is 0, since no messages belong to the new intervals.
        """
        parts = []
        for name in self._recordings:
            taken = other.of_recording(name)
            # What is between the others, from the first time to the last.
            begin = np.concatenate([[0], taken[:, 1]])
            end = np.concatenate([taken[:, 0], [END]])
            rows = np.stack([begin, end, np.zeros_like(begin)], axis=1)
            parts.append((name, rows[end > begin]))
        return self.common(Intervals.of(parts))

    def until_next(self, times: Mapping[str, NDArray[np.int64]]) -> Intervals:
        """Each extended to the first of some times of its recording after it, or without end.

        Args:
            times: int64[n], log times, ns, ascending, by id of the recording.
        """
        parts = []
        for name in self._recordings:
            rows = self._rows_of(name)
            known = np.append(times.get(name, np.empty(0, np.int64)), END)
            rows[:, 1] = known[np.searchsorted(known[:-1], rows[:, 1])]
            parts.append((name, rows))
        return Intervals.of(parts).merged()

    def counted(self, times: Mapping[str, NDArray[np.int64]]) -> Intervals:
        """The same with the number of some times in each as `messages`.

        Args:
            times: int64[n], log times, ns, ascending, by id of the recording.
        """
        parts = []
        for name in self._recordings:
            rows = self._rows_of(name)
            places = np.searchsorted(times.get(name, np.empty(0, np.int64)), rows[:, :2])
            rows[:, 2] = places[:, 1] - places[:, 0]
            parts.append((name, rows))
        return Intervals.of(parts)

    def containing(self, events: Events) -> Intervals:
        """The intervals that contain the log time of at least one message of a question.

        The message must be of the interval's own recording. Overlapping intervals are
        tested separately.

        Args:
            events: A query on the same store.

        Raises:
            UsageError: it has `limit` or `every`.
        """
        if not events.question.returns_all:
            raise UsageError("limit and every cannot be combined with a test for any message.")
        known = set(events.recordings)
        own = Intervals.of((n, self._rows_of(n)) for n in self._recordings if n in known)
        found = np.zeros(len(self), np.bool_)
        if len(own):
            moments = events.during(own).windows(after="1ns")
            for name in own.recordings:
                rows, (begin, end) = self._rows(name), moments.of_recording(name).T
                first = np.searchsorted(end, self._begin[rows], side="right")
                found[rows] = first < np.searchsorted(begin, self._end[rows])
        return self._take(found)

    def within(self, spans: Mapping[str, Span]) -> Intervals:
        """Each interval cut to its recording; the number of intervals is unchanged.

        Args:
            spans: `[begin, end)`, ns, by id of the recording.
        """
        bounds = np.array([spans[name] for name in self._recordings], np.int64).reshape(-1, 2)
        low, high = bounds[self._recording].T
        begin: NDArray[np.int64] = np.clip(self._begin, low, high)
        end: NDArray[np.int64] = np.clip(self._end, low, high)
        return Intervals(self._recordings, self._recording, begin, end, self._messages)

    def by_id(self, ids: Mapping[str, str]) -> Intervals:
        """The same intervals, with other names of recordings replaced by ids.

        Args:
            ids: Id of each recording, by its id and its other names.

        Raises:
            TopicError: a recording is not in `ids`.
        """
        unknown = [name for name in self._recordings if name not in ids]
        if unknown:
            raise TopicError(f"Recording {unknown[0]!r} of an interval is not in the store.")
        names = tuple(ids[name] for name in self._recordings)
        return Intervals(names, self._recording, self._begin, self._end, self._messages)

    def of_recording(self, recording: str) -> NDArray[np.int64]:
        """Covered time of one recording: int64[n, 2], begin and end, disjoint, in order."""
        return joined(self._rows_of(recording))[:, :2]

    def to_pandas(self) -> pd.DataFrame:
        """A frame: `recording`, `begin`, `end` (UTC, ns), `duration`, `messages`."""
        import pyarrow as pa

        from hybridlog.frames.frame import frame_of_table
        from hybridlog.schema.arrow_columns import numbers

        names = pa.array(self._recordings, pa.string())
        columns = {
            "recording": names.take(pa.array(self._recording)),
            "begin": numbers(self._begin, "time"),
            "end": numbers(self._end, "time"),
            "duration": numbers(self._end - self._begin, "duration"),
            "messages": numbers(self._messages),
        }
        return frame_of_table(pa.table(columns))

    def _rows(self, recording: str) -> NDArray[np.intp]:
        """Places of the intervals of a recording, in order."""
        if self._places is None:
            order = np.argsort(self._recording, kind="stable")
            edges = np.searchsorted(self._recording[order], np.arange(len(self._recordings) + 1))
            self._places = {
                name: order[begin:end]
                for name, begin, end in zip(self._recordings, edges, edges[1:], strict=False)
            }
        return self._places.get(recording, np.empty(0, np.intp))

    def _rows_of(self, recording: str) -> NDArray[np.int64]:
        rows = self._rows(recording)
        return np.stack([self._begin[rows], self._end[rows], self._messages[rows]], axis=1)

    def _take(self, rows: NDArray[np.bool_]) -> Intervals:
        return Intervals(
            self._recordings,
            self._recording[rows],
            self._begin[rows],
            self._end[rows],
            self._messages[rows],
        )


def joined(rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Intervals of one recording, those that overlap or touch joined, empty ones dropped.

    Rows are int64[n, 3]: begin, end, messages, of which joined ones have the sum; ordered by begin.
    """
    rows = rows[rows[:, 1] > rows[:, 0]]
    if not len(rows):
        return rows
    reach = np.maximum.accumulate(rows[:, 1])
    first = np.flatnonzero(np.concatenate([[True], rows[1:, 0] > reach[:-1]]))
    last = np.append(first[1:], len(rows)) - 1
    messages = np.add.reduceat(rows[:, 2], first)
    return np.stack([rows[first, 0], reach[last], messages], axis=1)


def clipped(rows: NDArray[np.int64], span: Span) -> NDArray[np.int64]:
    """Intervals (int64[n, 3]) cut to a span, without empty ones."""
    begin = np.maximum(rows[:, 0], span[0])
    end = np.minimum(rows[:, 1], span[1])
    nonempty = end > begin
    return np.stack([begin[nonempty], end[nonempty], rows[nonempty, 2]], axis=1)


def holding(
    time: NDArray[np.int64],
    holds: NDArray[np.bool_],
    end: int,
    max_gap: int | None,
    before: int = 0,
) -> NDArray[np.int64]:
    """The intervals in which a state holds, int64[k, 3]: begin, end, messages.

    Each message determines the state, `holds`, from its log time (`time`, ns, ascending) until the
    next message or the end of the recording, and for at most `max_gap` ns, None for any. Of
    messages with the same log time, the last one counts. The first ones, as many as `before`, do
    not count as messages.
    """
    if not len(time):
        return np.empty((0, 3), np.int64)
    count = holds.astype(np.int64)
    count[:before] = 0
    first = run_starts(time)
    last = np.append(first[1:], len(time)) - 1
    begin = time[first]
    until = np.append(begin[1:], end)
    if max_gap is not None:
        until = np.minimum(until, np.minimum(begin, END - max_gap) + max_gap)
    kept = holds[last]
    return joined(np.stack([begin[kept], until[kept], np.add.reduceat(count, first)[kept]], axis=1))


def changing(time: NDArray[np.int64], pause: int) -> NDArray[np.int64]:
    """Steps (messages that differ from the one before) grouped into int64[k, 3]: begin, end, steps.

    `time` has log times of the steps, ns, ascending. In a change, each step is at most `pause` ns
    after the one before.
    """
    if not len(time):
        return np.empty((0, 3), np.int64)
    time = placed(time)
    first = np.append(0, np.flatnonzero(np.diff(time) > pause) + 1)
    steps = np.diff(first, append=len(time))
    return np.stack([time[first], time[first + steps - 1] + 1, steps], axis=1)
