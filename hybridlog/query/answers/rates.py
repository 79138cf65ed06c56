"""Rates of messages, and gaps between them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from itertools import chain
from operator import attrgetter
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from hybridlog.query.answers.lost import flush_interval_ns
from hybridlog.query.intervals import MAX_PIECES, Intervals
from hybridlog.query.periods import GAP_PERIODS, Steps, mean_rate
from hybridlog.query.planner import Planner
from hybridlog.query.ranges import RangeResolver
from hybridlog.query.times import DurationLike, parse_duration
from hybridlog.wording import listed
from hybridlog_storage.errors import UsageError
from hybridlog_storage.times import END, placed

if TYPE_CHECKING:
    import pyarrow as pa
    from numpy.typing import NDArray

    from hybridlog.query.counters import Counters
    from hybridlog.query.question import Part, Question, Span
    from hybridlog.session import Session
    from hybridlog_storage.summary import RecordingSummary

_MAX_SECOND_LOOK = 1_000_000  # times that are kept for a second look
_Columns = dict[str, list["NDArray[Any]"]]


class Stretch(NamedTuple):
    """The messages of one topic in one span of one recording.

    Attributes:
        summary: The recording.
        topic: Full name.
        span: Log time `[begin, end)`, ns.
        part: The part of the question, without a range where that is the whole recording.
    """

    summary: RecordingSummary
    topic: str
    span: Span
    part: Part


class Rates:
    """Answers about the times of messages.

    Raises:
        UsageError: the question has limit, every or reverse.
    """

    def __init__(self, session: Session, question: Question, counters: Counters) -> None:
        if not question.returns_all or question.reverse:
            raise UsageError(
                "A rate is of all messages; it cannot be combined with limit, every or reverse."
            )
        self._session = session
        self._question = question
        self._planner = Planner(session, question, counters)

    def rate(self, window: DurationLike | None) -> pa.Table:
        """Messages and their rate; see `Query.rate`."""
        size = None if window is None else parse_duration(window)
        if size == 0:
            raise UsageError("A window of 0 holds nothing: name a duration, such as 1s.")
        named: list[tuple[str, str, int]] = []
        columns: _Columns = defaultdict(list)
        rows = 0
        for stretch in self._stretches():
            begin, end, messages, rate = (
                self._overall(stretch) if size is None else self._by_window(stretch, size)
            )
            rows += len(begin)
            if rows > MAX_PIECES:
                raise UsageError(f"There are {rows} windows; use a longer one or a time range.")
            named.append((stretch.summary.name, stretch.topic, len(begin)))
            for name, values in (
                ("begin", begin),
                ("end", end),
                ("messages", messages),
                ("rate", rate),
            ):
                columns[name].append(values)
        return _table(named, columns)

    def gaps(self, longer_than: DurationLike | None, periods: float | None) -> Intervals:
        """Times without messages; see `Query.gaps`."""
        if len(self._question.topics) != 1:
            raise UsageError(
                f"A gap is one topic's; this question has {len(self._question.topics)}: name one "
                f"of {listed(self._question.topics)}."
            )
        least = 0 if longer_than is None else parse_duration(longer_than)
        if periods is None and longer_than is None:
            periods = GAP_PERIODS
        if periods is not None and not 0 < periods < float("inf"):
            raise UsageError(f"A number of periods is more than 0, not {periods}.")
        found: list[tuple[str, NDArray[np.int64]]] = []
        stretches = [(one, _Times(partial(self.times, one))) for one in self._stretches()]
        usual = _usual_periods(stretches) if periods is not None else {}
        for stretch, times in stretches:
            limit = float(least)
            if periods is not None:
                if not usual[stretch.summary.id]:
                    continue  # one message does not tell when the next one was due
                limit = max(limit, periods * usual[stretch.summary.id])
            begin, end = stretch.span
            if stretch.summary.status == "open":  # other topics may be flushed later than this one
                end = max(begin, end - flush_interval_ns(stretch.summary))
            found += [(stretch.summary.id, rows) for rows in _longer(times, (begin, end), limit)]
        return Intervals.of(found)

    def stretches_in(self, summary: RecordingSummary, span: Span) -> Iterator[Stretch]:
        """The topics of the question that have messages in a recording."""
        is_whole = self._question.is_unbounded
        for part in self._planner.parts_in(summary, None, None):
            inner = part if is_whole else replace(part, bounds=span, clock="log")
            yield Stretch(summary, part.topic, span, inner)

    def _stretches(self) -> Iterator[Stretch]:
        """Topics and spans of the question, by recording and topic."""
        for summary, span in RangeResolver(self._session, self._question).spans():
            yield from sorted(self.stretches_in(summary, span), key=attrgetter("topic"))

    def _overall(self, stretch: Stretch) -> tuple[NDArray[Any], ...]:
        """First and last time, messages and mean rate."""
        part = stretch.part
        if part.predicate is None and part.is_unbounded:
            stats = [s for s in part.stats if s.first is not None and s.last is not None]
            count = part.messages
            first = min((s.first for s in stats if s.first is not None), default=0)
            last = max((s.last for s in stats if s.last is not None), default=0)
        else:
            count = first = last = 0
            for times in self.times(stretch):
                first = first if count else int(times[0])
                last = int(times[-1])
                count += len(times)
        if not count:
            first, last = stretch.span[0], stretch.span[1] - 1
        rate = mean_rate(count, first, last)
        return (
            np.array([first], np.int64),
            np.array([min(last + 1, END)], np.int64),
            np.array([count], np.int64),
            np.array([(np.nan if rate is None else rate) if count else 0.0]),
        )

    def _by_window(self, stretch: Stretch, size: int) -> tuple[NDArray[Any], ...]:
        low, high = stretch.span
        if (high - low) // size > MAX_PIECES:
            raise UsageError(
                f"There are {(high - low) // size} windows; use a longer one or a time range."
            )
        begin = np.arange(low, high, size, dtype=np.int64)
        end = np.append(begin[1:], high)
        messages = np.zeros(len(begin), np.int64)
        for times in self.times(stretch):
            times = placed(times)  # noqa: PLW2901
            inside = times[(times >= low) & (times < high)]
            if len(inside):
                windows = (inside - low) // size
                messages[windows[0] : windows[-1] + 1] += np.bincount(windows - windows[0])
        return begin, end, messages, messages * 1e9 / (end - begin)

    def times(self, stretch: Stretch) -> Iterator[NDArray[np.int64]]:
        """Log times of the matching messages, ns, ascending, some at a time."""
        for one in self._planner.outcomes(stretch.part):
            times = one.log_time[one.holds]
            if len(times):
                yield times


class _Times:
    """Times that are iterated over more than once; few are kept, many are read again."""

    def __init__(self, read: Callable[[], Iterator[NDArray[np.int64]]]) -> None:
        self._read = read
        self._cached: list[NDArray[np.int64]] | None = None

    def __iter__(self) -> Iterator[NDArray[np.int64]]:
        """int64 arrays, ns, ascending, none of them empty."""
        if self._cached is not None:
            yield from self._cached
            return
        cached: list[NDArray[np.int64]] = []
        count = 0
        for times in self._read():
            count += len(times)
            if count <= _MAX_SECOND_LOOK:
                cached.append(times)
            else:
                cached.clear()
            yield times
        self._cached = cached if count <= _MAX_SECOND_LOOK else None


def _longer(
    times: Iterable[NDArray[np.int64]], span: Span, limit: float
) -> Iterator[NDArray[np.int64]]:
    """Times without messages in a span: int64[k, 3], begin, end and 0 messages.

    Args:
        times: Times of the messages, ns, ascending.
        span: `[begin, end)`, ns.
        limit: Only those that are longer, ns.
    """
    before = span[0]
    for block in chain(times, [np.array([span[1]], np.int64)]):
        edges = np.concatenate([[before], block])
        rows = np.flatnonzero(np.diff(edges) > limit)
        yield np.stack([edges[rows], edges[rows + 1], np.zeros(len(rows), np.int64)], axis=1)
        before = int(block[-1])


def _usual_periods(stretches: Iterable[tuple[Stretch, _Times]]) -> dict[str, float]:
    """The usual period in each recording, ns; 0 where it is unknown."""
    steps: dict[str, Steps] = defaultdict(Steps)
    for stretch, times in stretches:
        own = steps[stretch.summary.id]
        own.restart()
        for block in times:
            own.add(block)
    return {name: found.usual_period() for name, found in steps.items()}


def _table(named: list[tuple[str, str, int]], columns: _Columns) -> pa.Table:
    import pyarrow as pa

    from hybridlog.schema.arrow_columns import numbers

    def joined(name: str, kind: Any) -> NDArray[Any]:
        return np.concatenate([np.empty(0, kind), *columns[name]])

    def texts(place: int) -> pa.Array[Any]:
        codes = np.repeat(np.arange(len(named)), [row[2] for row in named])
        names = [str(row[place]).encode("utf-8", "replace").decode() for row in named]
        return pa.array(names, pa.string()).take(numbers(codes.astype(np.int64)))

    rate = joined("rate", np.float64)
    return pa.table(
        {
            "begin": numbers(joined("begin", np.int64), "time"),
            "end": numbers(joined("end", np.int64), "time"),
            "recording": texts(0),
            "topic": texts(1),
            "messages": numbers(joined("messages", np.int64)),
            "rate": pa.array(rate, mask=np.isnan(rate)),
        }
    )
