"""Intervals of log time: the answers for states, changes and windows around events.

All intervals are half-open, `begin <= time < end`, and each belongs to one recording:
no interval spans two recordings. They are columns, not objects; an `Interval` is made
on access. Beside them are the times from one message of a topic to the next.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import islice
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from msgspec import Struct

from hybridlog.query.times import DurationLike, format_duration, format_time, parse_duration
from hybridlog.schema.column import ranges
from hybridlog.wording import MAX_ROWS, table_html
from hybridlog_storage.errors import TopicError, UsageError
from hybridlog_storage.messages import run_starts
from hybridlog_storage.times import END, placed

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray

    Rows = NDArray[np.int64]
    """int64[n, 3]: begin, end, messages."""


Span = tuple[int, int]
"""`[begin, end)` in nanoseconds."""

_ROWS_PER_BATCH = 10_000  # intervals whose columns become Python numbers together


class Interval(Struct, frozen=True):
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
        parts: Id of a recording, and int64[n, 3]: begin, end (never before it), messages. A
            recording may have several parts. Intervals that begin at the same time are in the
            order of the recordings.
    """

    __slots__ = ("_columns", "_rows")

    def __init__(self, parts: Iterable[tuple[str, Rows]]) -> None:
        found: dict[str, list[Rows]] = {}
        for name, rows in parts:
            found.setdefault(name, []).append(rows)
        joined_rows = ((name, np.concatenate(rows)) for name, rows in found.items())
        self._rows = {name: r[np.lexsort((r[:, 1], r[:, 0]))] for name, r in joined_rows}
        self._columns: tuple[NDArray[np.intp], Rows] | None = None

    @property
    def recordings(self) -> tuple[str, ...]:
        """Ids of the recordings that have intervals, or had some."""
        return tuple(self._rows)

    def __len__(self) -> int:
        """Number of intervals."""
        return sum(map(len, self._rows.values()))

    def __iter__(self) -> Iterator[Interval]:
        """The intervals, one by one."""
        codes, rows = self._all()
        names = self.recordings
        for start in range(0, len(rows), _ROWS_PER_BATCH):
            places = slice(start, start + _ROWS_PER_BATCH)
            for code, row in zip(codes[places].tolist(), rows[places].tolist(), strict=True):
                yield Interval(names[code], *row)

    def __getitem__(self, place: int) -> Interval:
        """The interval at an index; a negative index counts from the end."""
        codes, rows = self._all()
        return Interval(self.recordings[codes[place]], *rows[place].tolist())

    def __repr__(self) -> str:
        return f"<Intervals {len(self)}, {format_duration(self.duration_ns)} in all>"

    def _repr_html_(self) -> str:
        rows = (
            (one.recording, format_time(one.begin_ns), format_time(one.end_ns), one.messages)
            for one in islice(self, MAX_ROWS)
        )
        return table_html(repr(self), [("recording", "begin", "end", "messages"), *rows])

    def __eq__(self, other: object) -> bool:
        """True if both have the same intervals of the same recordings."""
        return isinstance(other, Intervals) and self._value() == other._value()

    def __hash__(self) -> int:
        return hash(self._value())

    def _value(self) -> frozenset[tuple[str, bytes]]:
        return frozenset((name, rows.tobytes()) for name, rows in self._rows.items() if len(rows))

    @property
    def duration_ns(self) -> int:
        """Sum of the lengths, nanoseconds; time in which intervals overlap counts twice."""
        return sum(int((rows[:, 1] - rows[:, 0]).sum()) for rows in self._rows.values())

    def at_least(self, length: DurationLike) -> Intervals:
        """The intervals of at least this length.

        Raises:
            TimeError: it is no duration.
        """
        least = parse_duration(length)
        return self._each(lambda _, rows: rows[rows[:, 1] - rows[:, 0] >= least])

    def widened(self, before: DurationLike = 0, after: DurationLike = 0) -> Intervals:
        """Intervals that begin earlier and end later by these times; they may overlap.

        Raises:
            TimeError: `before` or `after` is no duration.
        """
        earlier, later = parse_duration(before), parse_duration(after)

        def widened(_: str, rows: Rows) -> Rows:
            begin = np.maximum(rows[:, 0], earlier) - earlier
            end = np.minimum(rows[:, 1], END - later) + later
            return np.stack([begin, end, rows[:, 2]], axis=1)

        return self._each(widened)

    def merged(self) -> Intervals:
        """Overlapping or touching intervals of a recording joined; empty ones dropped."""
        return self._each(lambda _, rows: joined(rows))

    def common(self, other: Intervals) -> Intervals:
        """The intersection: times of a recording that intervals of both cover.

        `messages` is 0, since no messages belong to the new intervals.
        """
        return self._each(
            lambda name, _: _common(self.of_recording(name), other.of_recording(name))
        )

    def union(self, other: Intervals) -> Intervals:
        """Times of a recording that intervals of either cover, joined.

        `messages` is 0, since no messages belong to the new intervals.
        """
        covered = (
            (name, one.of_recording(name)) for one in (self, other) for name in one.recordings
        )
        return Intervals((name, np.insert(rows, 2, 0, axis=1)) for name, rows in covered).merged()

    def without(self, other: Intervals) -> Intervals:
        """Times of a recording that these intervals cover and the other ones do not.

        `messages` is 0, since no messages belong to the new intervals.
        """

        def left(name: str, _: Rows) -> Rows:
            # What is between the others, from the first time to the last.
            edges = np.concatenate([[0], other.of_recording(name).ravel(), [END]])
            return _common(self.of_recording(name), edges.reshape(-1, 2))

        return self._each(left)

    def containing(self, events: Any) -> Intervals:
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
        moments = events.during(self).windows(after="1ns")

        def holding(name: str, rows: Rows) -> Rows:
            begin, end = moments.of_recording(name).T
            first = np.searchsorted(end, rows[:, 0], side="right")
            return rows[first < np.searchsorted(begin, rows[:, 1])]

        return self._each(holding)

    def within(self, spans: Mapping[str, Span]) -> Intervals:
        """Each interval cut to its recording; the number of intervals is unchanged.

        Args:
            spans: `[begin, end)`, ns, by id of the recording.
        """

        def within(name: str, rows: Rows) -> Rows:
            return np.column_stack([np.clip(rows[:, :2], *spans[name]), rows[:, 2]])

        return self._each(within)

    def by_id(self, ids: Mapping[str, str]) -> Intervals:
        """The same intervals, with other names of recordings replaced by ids.

        Args:
            ids: Id of each recording, by its id and its other names.

        Raises:
            TopicError: a recording is not in `ids`.
        """
        unknown = [name for name in self._rows if name not in ids]
        if unknown:
            raise TopicError(f"Recording {unknown[0]!r} of an interval is not in the store.")
        return Intervals((ids[name], rows) for name, rows in self._rows.items())

    def of_recording(self, recording: str) -> NDArray[np.int64]:
        """Covered time of one recording: int64[n, 2], begin and end, disjoint, in order."""
        return joined(self._rows.get(recording, np.empty((0, 3), np.int64)))[:, :2]

    def to_pandas(self) -> pd.DataFrame:
        """A frame: `recording`, `begin`, `end` (UTC, ns), `duration`, `messages`."""
        import pyarrow as pa

        from hybridlog.frames.frame import frame_of_table
        from hybridlog.schema.arrow_types import numbers

        codes, rows = self._all()
        begin, end, messages = np.ascontiguousarray(rows.T)
        columns = {
            "recording": pa.array(self.recordings, pa.string()).take(pa.array(codes)),
            "begin": numbers(begin, "time"),
            "end": numbers(end, "time"),
            "duration": numbers(end - begin, "duration"),
            "messages": numbers(messages),
        }
        return frame_of_table(pa.table(columns))

    def _each(self, change: Callable[[str, Rows], Rows]) -> Intervals:
        """The intervals of each recording changed."""
        return Intervals((name, change(name, rows)) for name, rows in self._rows.items())

    def _all(self) -> tuple[NDArray[np.intp], Rows]:
        """All intervals in order, and the place of the recording of each in `recordings`."""
        if self._columns is None:
            rows = np.concatenate([np.empty((0, 3), np.int64), *self._rows.values()])
            codes = np.repeat(np.arange(len(self._rows)), [*map(len, self._rows.values())])
            order = np.lexsort((rows[:, 1], codes, rows[:, 0]))
            self._columns = codes[order], rows[order]
        return self._columns


def _common(mine: NDArray[np.int64], theirs: NDArray[np.int64]) -> Rows:
    """The common time of intervals (int64[n, 2], disjoint, in order)."""
    # Each pair that overlaps: the others that end after this one begins, and so on.
    low = np.searchsorted(theirs[:, 1], mine[:, 0], "right")
    count = np.maximum(np.searchsorted(theirs[:, 0], mine[:, 1], "left") - low, 0)
    one, pair = np.repeat(np.arange(len(mine)), count), ranges(low, count)
    begin = np.maximum(mine[one, 0], theirs[pair, 0])
    end = np.minimum(mine[one, 1], theirs[pair, 1])
    return np.stack([begin, end, np.zeros_like(begin)], axis=1)


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


GAP_PERIODS: Final = 5
"""A time without messages is a gap if it is longer than so many usual periods."""
_SAMPLED: Final = 1_000_000  # steps that are kept, and those added with the last of them


def usual_period(steps: NDArray[np.int64]) -> float:
    """The usual period of a topic, ns, also of one whose messages come in bursts; 0 if unknown.

    Nine of ten steps (ns, from one message to the next) are no longer, and one long step among few
    does not count.
    """
    return float(np.quantile(steps, 0.9, method="lower")) if len(steps) else 0.0


class Steps:
    """Times from one message to the next: the first million of them, in bounded memory."""

    def __init__(self) -> None:
        self._steps: list[NDArray[np.int64]] = []
        self._left = _SAMPLED
        self.restart()

    def restart(self) -> None:
        """The next message does not follow the last one."""
        self._last: NDArray[np.int64] = np.empty(0, np.int64)

    def add(self, times: NDArray[np.int64]) -> None:
        """Add times of the next messages, ns."""
        if self._left > 0:
            self._steps.append(np.diff(np.concatenate([self._last, times])))
            self._left -= len(self._steps[-1])
            self._last = times[-1:] if len(times) else self._last

    def usual_period(self) -> float:
        """As the function of this name."""
        return usual_period(np.concatenate([np.empty(0, np.int64), *self._steps]))


def mean_rate(messages: int, first: int, last: int) -> float | None:
    """Messages a second from the first to the last, ns; None if they do not tell."""
    return (messages - 1) * 1e9 / (last - first) if messages > 1 and last > first else None
