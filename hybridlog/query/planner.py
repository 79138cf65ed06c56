"""Splits a question into parts, each one topic of one recording, and joins their answers.

`rows.py` has the rows of a part.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from msgspec.structs import replace

from hybridlog.query.chunk_scan import ChunkScan, MessageRun
from hybridlog.query.question import Counters, Part
from hybridlog.query.ranges import RangeResolver
from hybridlog.query.rows import RowBatch, Rows
from hybridlog.schema.column import STAMP
from hybridlog.schema.states import GONE
from hybridlog.snapshot import UNFINISHED, differing
from hybridlog_storage.cache import lazy
from hybridlog_storage.errors import TopicError, UsageError
from hybridlog_storage.times import END

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.chunk_scan import ScanPlan
    from hybridlog.query.question import Question, RecordedChannel, Span
    from hybridlog.schema.states import State
    from hybridlog.session import Session
    from hybridlog_storage.summary import RecordingSummary

_GROUP_GROWTH = 64  # so many times more recordings are planned after each group
_MAX_GROUP = 4096  # recordings planned at once, if they do not overlap
_READ_AHEAD_FROM = 50  # messages; nothing is read ahead for fewer


class Planner(Rows):
    """Answers one question; `counters` count what that costs."""

    def __init__(
        self, session: Session, question: Question, counters: Counters | None = None
    ) -> None:
        super().__init__(session, Counters() if counters is None else counters)
        self.question = question
        self._ranges = RangeResolver(session, question)

    def parts(self) -> list[Part]:
        """The question, split by recording and topic, where it may have an answer.

        Recordings are oldest first. MongoDB is asked once for all.
        """
        return self.fitting(self.decided(self.split()))

    def split(self) -> list[Part]:
        """The same, of which nothing was asked yet."""
        return [part for one in self._ranges.resolve() for part in self.parts_in(*one)]

    def only_part(self) -> Part | None:
        """The only part of the question; None if it has several, or none."""
        found = self._ranges.resolve()
        parts = [*self.parts_in(*found[0])] if len(found) == 1 else []
        return parts[0] if len(parts) == 1 else None

    def parts_in(
        self, summary: RecordingSummary, bounds: Span | None, windows: NDArray[np.int64] | None
    ) -> Iterator[Part]:
        """The parts of the question in one recording."""
        recording = self.session.entry_of(summary)
        wanted = set(self.question.topics)
        by_topic: dict[str, list[RecordedChannel]] = defaultdict(list)
        for channel in self.session.channels_of(recording, wanted):
            self._check_clock(channel)
            by_topic[channel.channel.topic].append(channel)
        clock, predicate = self.question.clock, self.question.predicate
        for topic, channels in by_topic.items():
            if any(c.stats.messages for c in channels):  # else nothing was sent on the topic
                yield Part(recording, topic, tuple(channels), bounds, clock, windows, predicate)

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
        keys = sorted(resolved.summary.key for resolved in self._ranges.resolve())
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
        question = self.question
        if question.limit == 0:
            self._ranges.resolve()  # a range that is outside is refused all the same
            return
        runs = self._runs()
        for run in runs if question.returns_all else _decimated(runs, question):
            self.counters.add_messages(run.batch)
            yield run

    def _runs(self) -> Iterator[MessageRun]:
        """All messages that match, in order; recordings are read when their turn comes."""
        limit = self.question.limit
        ahead = limit is None or limit > _READ_AHEAD_FROM
        for group in self.groups():
            yield from ChunkScan(self.plan(group), self.session, ahead=ahead).runs()

    def kept(
        self, summary: RecordingSummary, bounds: Span | None, windows: NDArray[np.int64] | None
    ) -> Iterator[MessageRun]:
        """The messages of a part of a recording, in order; `ChunkScan` keeps their chunks."""
        plan = self.plan([*self.parts_in(summary, bounds, windows)])
        return ChunkScan(plan, self.session, keeps=True).runs()

    def plan(self, parts: Sequence[Part]) -> ScanPlan:
        """The plan for reading the matching messages of some parts, in the answer's order."""
        parts = self.fitting(self.decided(parts))
        return self.again(partial(self.chunk_plan, reverse=self.question.reverse), parts)

    def groups(self) -> Iterator[list[Part]]:
        """The parts in groups, those that overlap in time together, in the answer's order.

        The first group is small, so that the first message needs few recordings.
        """
        found = self._ranges.resolve()
        # In the order of the answer; going back, a recording begins with its last message.
        spans = [
            (one.extent[0], END if one.status in UNFINISHED else one.extent[1]) for one, *_ in found
        ]
        first, last = np.array(spans, np.int64).reshape(-1, 2).T
        if self.question.reverse:
            first, last = -last, -first
        order = np.argsort(first, kind="stable")
        reached = np.maximum.accumulate(last[order]) if len(order) else last
        edges = np.flatnonzero(first[order][1:] > reached[:-1]) + 1
        begin, most = 0, 1
        while begin < len(order):
            row = int(np.searchsorted(edges, begin + most))
            end = int(edges[row]) if row < len(edges) else len(order)
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
                    own = replace(part, channels=gone, predicate=None)
                    found[state] += self.count_of([own])
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
    given = 0
    for run in runs:
        keep = np.ones(len(run.batch), np.bool_)
        channels: dict[str, list[int]] = defaultdict(list)
        for number in np.unique(run.batch.channel).tolist() if question.every > 1 else ():
            channels[run.channels[number].channel.topic].append(number)
        for topic, own in channels.items():
            rows = np.flatnonzero(np.isin(run.batch.channel, own))
            keep[rows] = (seen[topic] + np.arange(len(rows))) % question.every == 0
            seen[topic] += len(rows)
        rows = np.flatnonzero(keep)
        if question.limit is not None:
            rows = rows[: question.limit - given]
        given += len(rows)
        if len(rows):
            yield run if len(rows) == len(run.batch) else run.take(rows)
        if question.limit is not None and given >= question.limit:
            return
