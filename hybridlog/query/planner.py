"""Splits a question into parts, each one topic of one recording, and joins their answers.

`rows.py` has the rows of a part.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from msgspec.structs import replace

from hybridlog.query.predicate.tree import And, Condition, Field, Predicate
from hybridlog.query.question import (
    Clock,
    Counters,
    Part,
    Question,
    RecordedChannel,
    Span,
    windows_in,
)
from hybridlog.query.rows import RowBatch, Rows
from hybridlog.query.times import format_time, is_early, is_relative, parse_range, parse_time
from hybridlog.schema.column import STAMP
from hybridlog.schema.states import GONE, State
from hybridlog.snapshot import UNFINISHED, differing
from hybridlog.wording import listed
from hybridlog_storage.cache import lazy
from hybridlog_storage.errors import TimeError, TopicError, UsageError
from hybridlog_storage.times import BEGIN, END, span_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.chunk_scan import MessageRun
    from hybridlog.session import Session
    from hybridlog_storage.catalog import RecordingSummary

_GROUP_GROWTH = 64  # so many times more recordings are planned after each group
_MAX_GROUP = 4096  # recordings planned at once, if they do not overlap
_READ_AHEAD_FROM = 50  # messages; nothing is read ahead for fewer
_MAX_NAMES = 5  # recordings in a message
_MAX_LOOKED_AT = 100
_FAR_NS = 10 * 365 * 86_400 * 10**9


class Planner(Rows):
    """Answers one question; `counters` count what that costs."""

    def __init__(
        self, session: Session, question: Question, counters: Counters | None = None
    ) -> None:
        super().__init__(session, Counters() if counters is None else counters)
        self.question = question
        self._resolved: list[Resolved] | None = None

    @property
    def resolved(self) -> list[Resolved]:
        """The recordings to ask, oldest first, each with its range."""
        if self._resolved is None:
            self._resolved = resolved(self.session, self.question)
        return self._resolved

    def parts(self) -> list[Part]:
        """The question, split by recording and topic, where it may have an answer.

        Recordings are oldest first. MongoDB is asked once for all.
        """
        return self.fitting(self.decided(self.split()))

    def split(self) -> list[Part]:
        """The same, of which nothing was asked yet."""
        return [part for one in self.resolved for part in self.parts_in(*one)]

    def parts_in(
        self,
        summary: RecordingSummary,
        windows: NDArray[np.int64] | None = None,
        bounds: Span | None = None,
    ) -> Iterator[Part]:
        """The parts of the question in one recording; ranges are as of `Resolved`."""
        recording, question = self.session.entry_of(summary), self.question
        predicate = question.predicate
        if bounds is not None:
            within = _within(question.clock, bounds)
            predicate = within if predicate is None else within & predicate
        by_topic: dict[str, list[RecordedChannel]] = defaultdict(list)
        for channel in self.session.channels_of(recording, {*question.topics}):
            self._check_clock(channel)
            by_topic[channel.channel.topic].append(channel)
        for topic, channels in by_topic.items():
            if any(c.stats.messages for c in channels):  # else nothing was sent on the topic
                yield Part(recording, topic, tuple(channels), predicate, windows)

    def channels(self) -> list[RecordedChannel]:
        """Every channel of the question."""
        return self._channels_of(self.session.summaries_of(self.question))

    @lazy
    def examples(self) -> list[RecordedChannel]:
        """Channels of the question, of one recording for each set of topics and types.

        The others have the same types, so these say what columns an answer has.
        """
        return self._channels_of(differing(self.session.summaries_of(self.question)))

    def _channels_of(self, summaries: Iterable[RecordingSummary]) -> list[RecordedChannel]:
        wanted = set(self.question.topics)
        return [
            channel
            for summary in summaries
            for channel in self.session.channels_of(self.session.entry_of(summary), wanted)
        ]

    @lazy
    def ranks(self) -> dict[str, int]:
        """The place of each recording among those asked, by its key; ties are in this order."""
        keys = sorted(one.summary.key for one in self.resolved)
        return {key: rank for rank, key in enumerate(keys)}

    # Answers.

    def count(self) -> int:
        """Number of messages in the answer; payloads are read only as the last resort."""
        every, limit = self.question.every, self.question.limit
        alike: dict[str, list[Part]] = defaultdict(list)
        for part in self.parts():
            alike[part.topic if every > 1 else ""].append(part)
        total = sum(-(-self.count_of(parts) // every) for parts in alike.values())
        return total if limit is None else min(total, limit)

    def runs(self) -> Iterator[MessageRun]:
        """The messages of the answer, in order."""
        question, runs = self.question, self._runs()
        if question.limit == 0:
            _ = self.resolved  # a range that is outside is refused all the same
            return
        for run in runs if question.returns_all else _decimated(runs, question):
            self.counters.add_messages(run.batch)
            yield run

    def _runs(self) -> Iterator[MessageRun]:
        """All messages that match, in order; recordings are read when their turn comes."""
        limit, reverse = self.question.limit, self.question.reverse
        ahead = limit is None or limit > _READ_AHEAD_FROM
        for group in self._groups():
            yield from self.scan(group, reverse=reverse, ahead=ahead).runs()

    def _groups(self) -> Iterator[list[Part]]:
        """The parts in groups, those that overlap in time together, in the answer's order.

        The first group is small, so that the first message needs few recordings.
        """
        found = self.resolved
        # In the order of the answer; going back, a recording begins with its last message.
        spans = [
            (one.extent[0], END if one.status in UNFINISHED else one.extent[1]) for one, *_ in found
        ]
        first, last = np.array(spans, np.int64).reshape(-1, 2).T
        if self.question.reverse:
            first, last = -last, -first
        order = np.argsort(first, kind="stable")
        is_apart = first[order][1:] > np.maximum.accumulate(last[order])[:-1]
        edges = np.append(np.flatnonzero(is_apart) + 1, len(order))
        begin, most = 0, 1
        while begin < len(order):
            end = int(edges[edges.searchsorted(min(begin + most, len(order)))])
            rows = order[begin:end].tolist()
            yield [part for row in rows for part in self.parts_in(*found[row])]
            begin, most = end, min(most * _GROUP_GROWTH, _MAX_GROUP)

    def count_expired(self) -> Counter[State]:
        """Number of messages, in the range, whose payloads are gone, by state."""
        found: Counter[State] = Counter()
        for part in self.split():
            for state in GONE:
                gone = tuple(one for one in part.channels if one.state is state)
                if gone:
                    own = [replace(part, channels=gone)]  # of which a table does not tell
                    count = self.count_of if part.predicate is None else self.count_in_chunks
                    found[state] += count(own)
        return found

    def not_indexed(self) -> tuple[tuple[str, int], ...]:
        """Number of messages, in the range, that the index lacks, by name of their recording."""
        from hybridlog.query import index_reader

        parts = self.split()
        return self.lacking(index_reader.documents(self.session, parts)) if parts else ()

    def _check_clock(self, channel: RecordedChannel) -> None:
        if self.question.bounds is None:
            return
        topic, clock = channel.channel.topic, self.question.clock
        if clock == "header" and not any(p.path == STAMP for p in channel.codec.paths()):
            raise TopicError(f"{topic} has no {STAMP}: use the log clock, or another topic.")
        if clock == "publish" and not channel.channel.has_publish_time:
            raise TopicError(
                f"{topic} came without publish times (ROS 1 bags have none): use --clock log."
            )


def _within(clock: Clock, bounds: Span) -> Predicate:
    """A range of another clock than the log's as a predicate; a stamp of zero was not set."""
    time = Field(tuple(STAMP.split(".")) if clock == "header" else ("_meta", "pub"))
    edges = [Condition(time, ">=", bounds[:1])]
    edges += [Condition(time, "<", bounds[1:])] if bounds[1] < END else []
    edges += [Condition(time, "!=", (0,))] if clock == "header" else []
    return Predicate(And(tuple(edges)))


def recordings_with_any(session: Session, question: Question) -> set[str]:
    """Ids of the recordings that have a message in an answer."""
    planner = Planner(session, question)
    return {part.recording.id for part in planner.parts() if planner.count_of([part])}


def match_times(
    session: Session, question: Question, counters: Counters | None = None
) -> Iterator[RowBatch]:
    """The times of an answer, some at a time; recordings and topics one after the other."""
    if not question.returns_all:
        raise UsageError("Times are those of all messages: leave out limit and every.")
    planner = Planner(session, question, counters)
    for part in planner.parts():
        for found in planner.outcomes(part):
            holds = found.holds
            yield RowBatch(found.log_time[holds], found.seq[holds], holds[holds])


def log_times(
    session: Session, question: Question, counters: Counters | None = None
) -> NDArray[np.int64]:
    """All times of `match_times`, ns: those of a recording and topic ascend."""
    found = (one.log_time for one in match_times(session, question, counters))
    return np.concatenate([np.empty(0, np.int64), *found])


def _decimated(runs: Iterator[MessageRun], question: Question) -> Iterator[MessageRun]:
    """Every n-th message of each topic, up to the limit."""
    seen: Counter[str] = Counter()
    every, left = question.every, question.limit
    for run in runs:
        keep = np.ones(len(run.batch), np.bool_)
        numbers = np.unique(run.batch.channel).tolist() if every > 1 else ()
        topics = {number: run.channels[number].channel.topic for number in numbers}
        for topic in {*topics.values()}:
            own = [number for number, name in topics.items() if name == topic]
            rows = np.flatnonzero(np.isin(run.batch.channel, own))
            keep[rows] = (seen[topic] + np.arange(len(rows))) % every == 0
            seen[topic] += len(rows)
        rows = np.flatnonzero(keep)[:left]
        if len(rows):
            yield run if len(rows) == len(run.batch) else run.take(rows)
        left = None if left is None else left - len(rows)
        if left == 0:
            return


# The range of a question in each recording.


class Resolved(NamedTuple):
    """A recording that a question asks, and where.

    `windows` are as of `Part`; `bounds` are `[begin, end)` of the question's clock, where that is
    not the log's, ns; None for all times.
    """

    summary: RecordingSummary
    windows: NDArray[np.int64] | None
    bounds: Span | None


def resolved(session: Session, question: Question) -> list[Resolved]:
    """The recordings to ask, oldest first; without reading their entries."""
    during, is_log = question.during, question.clock == "log"
    chosen = session.summaries_of(question)
    if during is not None:
        named = {*during.recordings}
        chosen = [one for one in chosen if one.id in named]
    # Without relative times, the range is the same in each.
    shared = None if any(map(is_relative, question.bounds or ())) else bounds_in(session, question)
    found: list[Resolved] = []
    for one in chosen:
        windows = None if during is None else during.of_recording(one.id)
        if question.bounds is None:
            found.append(Resolved(one, windows, None))
            continue
        span = begin, end = shared or bounds_in(session, question, one)
        first, behind = one.extent
        if begin < end and not (is_log and (begin >= behind or end <= first)):
            own = (windows_in(windows, span), None) if is_log else (windows, span)
            found.append(Resolved(one, *own))
    if question.bounds is not None and chosen and during is None:
        _check(session, question, chosen, found)
    return found


def _check(
    session: Session,
    question: Question,
    chosen: Sequence[RecordingSummary],
    found: Sequence[Resolved],
) -> None:
    """Refuse a range without a recording, or one that begins far before any first message, ns."""
    begin, stop = question.bounds or (None, None)
    if found and question.clock == "log" and is_early(begin):
        at = parse_time(begin, start=None, end=None)
        if min(one.summary.extent[0] for one in found) - at > _FAR_NS:
            raise TimeError(
                f"{begin} is {format_time(at)}, long before any message; +{begin} is that long "
                "after the beginning of a recording."
            )
    if not found:
        spans = [_clock_span(session, question, one) for one in chosen[:_MAX_LOOKED_AT]]
        start, end = min(low for low, _ in spans), max(high for _, high in spans)
        parse_range(begin, stop, start=start, end=end)
        names = listed((one.name for one in chosen), _MAX_NAMES)
        raise TimeError(
            f"Nothing was recorded between {begin} and {stop}: {names} spans {format_time(start)} "
            f"to {format_time(end)}."
        )


def bounds_in(
    session: Session, question: Question, recording: RecordingSummary | None = None
) -> Span:
    """The range on the question's clock in one recording, ns; without one, if it is in all.

    It may be empty: for example `2025-01-01` to `end`, in a recording of 2024.
    """
    begin, stop = question.bounds or (None, None)
    start = end = None
    if recording is not None and question.bounds is not None:
        start, end = _clock_span(session, question, recording)
    return (
        BEGIN if begin is None else parse_time(begin, start=start, end=end),
        END if stop is None else parse_time(stop, start=start, end=end),
    )


def log_spans(session: Session, question: Question) -> list[tuple[RecordingSummary, Span]]:
    """The log time `[begin, end)`, ns, of each recording of a question."""
    if not question.is_by_log_time:
        raise UsageError(f"Intervals use log time; a range cannot use the {question.clock} clock.")
    return [
        (one.summary, (low, high))
        for one in resolved(session, question)
        if one.summary.span is not None
        for low, high in windows_in(one.windows, one.summary.extent).tolist()
    ]


def _clock_span(session: Session, question: Question, recording: RecordingSummary) -> Span:
    """`[first, end)` of the question's topics, on its clock."""
    if question.clock == "log":
        return recording.extent
    channels = session.channels_of(session.entry_of(recording), {*question.topics})
    ends = [time for one in channels for time in _ends(session, one, question.clock)]
    return span_of(min(ends), max(ends)) if ends else recording.extent


def _ends(session: Session, channel: RecordedChannel, clock: Clock) -> Iterator[int]:
    """First and last time of a channel on another clock, perhaps of each chunk.

    Where its statistics do not have them, the messages are read.
    """
    from hybridlog.schema.codec import stamps_of

    recording, stats, number = channel.recording, channel.stats, channel.channel_id
    if clock == "publish" and channel.channel.has_publish_time:
        for segment, _, _ in recording.spans_with([number]):
            parts = session.chunk_table(recording, segment).parts
            own = parts[parts["channel"] == number]
            yield from (*own["first_publish"].tolist(), *own["last_publish"].tolist())
    elif clock == "header" and recording.is_decoded:
        yield from (time for time in (stats.first_stamp, stats.last_stamp) if time is not None)
    elif clock == "header":
        for chunk in session.chunks(recording, [number]):
            batch = session.read_chunk(recording, chunk.segment, chunk.place).batch
            own = batch.take(np.flatnonzero(batch.channel == number))
            yield from stamps_of(channel.codec, own)[1].tolist()
