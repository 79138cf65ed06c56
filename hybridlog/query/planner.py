"""Splits a question into parts, each one topic of one recording, and joins their answers.

`rows.py` has the rows of a part.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np

from hybridlog.query.chunk_scan import ChunkScan, MessageRun
from hybridlog.query.question import Counters, Part
from hybridlog.query.ranges import RangeResolver
from hybridlog.query.rows import TABLE_ERRORS, Rows
from hybridlog.schema.column import STAMP
from hybridlog.schema.states import GONE
from hybridlog.snapshot import UNFINISHED
from hybridlog_storage.errors import ChangedError, TopicError, UsageError
from hybridlog_storage.lazy import lazy
from hybridlog_storage.times import END

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.chunk_scan import ScanPlan
    from hybridlog.query.index_reader import IndexReader
    from hybridlog.query.question import Question, RecordedChannel, Span
    from hybridlog.query.rows import MatchColumns, Values
    from hybridlog.schema.states import State
    from hybridlog.session import Session
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.summary import RecordingSummary

_GROUP_GROWTH = 64  # so many times more recordings are planned after each group
_MAX_GROUP = 4096  # recordings planned at once, if they do not overlap
_RENEWALS = 50  # of a question, while a ring lets files go
_READ_AHEAD_FROM = 50  # messages; nothing is read ahead for fewer
_T = TypeVar("_T")
_Rows = TypeVar("_Rows", "MatchColumns", "Values")


class Planner:
    """Answers one question; `counters` count what that costs."""

    def __init__(
        self, session: Session, question: Question, counters: Counters | None = None
    ) -> None:
        self.session = session
        self.question = question
        self.counters = Counters() if counters is None else counters
        self._ranges = RangeResolver(session, question)
        self._rows = Rows(session, self.counters)

    @lazy
    def _index(self) -> IndexReader:
        """The index documents in MongoDB."""
        from hybridlog.query.index_reader import IndexReader

        return IndexReader(self.session, self.counters)

    def parts(self) -> list[Part]:
        """The question, split by recording and topic, where it may have an answer.

        Recordings are oldest first. MongoDB is asked once for all.
        """
        return self._rows.fitting(self.decided(self.split()))

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
        places = self.session.chosen(self.question)
        return self._channels_of(self.session.snapshot().differing(places))

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
        total = sum(-(-self._again(self._count, parts) // every) for parts in alike.values())
        return total if limit is None else min(total, limit)

    def recordings_with_any(self) -> set[str]:
        """Ids of the recordings that have a message in the answer."""
        return {part.recording.id for part in self.parts() if self._rows.count([part])}

    def decided(self, parts: Sequence[Part]) -> list[Part]:
        """The parts with predicates for columns and messages: MongoDB is asked once for all."""
        wanted = [part for part in parts if part.needs_index]
        if not wanted:
            return [*parts]
        found = self._index.found(wanted)
        self.counters.unreadable += found.untested
        self.counters.not_indexed += self._lacking(found.documents)
        decidable = dict(zip(wanted, found.parts, strict=True))
        return [decidable.get(part, part) for part in parts]

    def outcomes(self, part: Part) -> Iterator[MatchColumns]:
        """For each message of a part, whether it matches, in order."""
        return self._lasting(part, self._rows.outcomes)

    def times(self, part: Part) -> NDArray[np.int64]:
        """Log times of the matching messages of a part, ns, ascending."""
        found = [one.log_time[one.holds] for one in self.outcomes(part)]
        return np.concatenate([np.empty(0, np.int64), *found])

    def values(self, part: Part, fields: Collection[str] | None) -> Iterator[Values]:
        """Fields of the matching messages of a part, in order."""
        return self._lasting(part, lambda own: self._rows.values(own, fields))

    def columns(
        self, part: Part, fields: Collection[str] | None, *, partial: bool = False
    ) -> Iterator[Values]:
        """The same by dotted path; also summaries of arrays. See `Rows.columns`."""
        return self._lasting(part, lambda own: self._rows.columns(own, fields, partial=partial))

    def values_of_tables(
        self, parts: Sequence[Part], fields: Collection[str] | None
    ) -> list[Iterator[Values]] | None:
        """The same of each part, if tables have the fields of all their messages."""
        for part in parts:
            found = self._rows.tabled(part, fields)
            if found is None or found.rest is not None:
                return None
        return [self.values(part, fields) for part in parts]

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

    def _again(self, ask: Callable[[Sequence[Part]], _T], parts: Sequence[Part]) -> _T:
        """Ask about parts; again about those of recordings whose files were replaced."""
        for _ in range(_RENEWALS):
            unreadable = self.counters.unreadable
            try:
                return ask(parts)
            except ChangedError:
                self.counters.unreadable = unreadable
                parts = self._renewed(parts)
        return ask(parts)

    def _renewed(self, parts: Sequence[Part]) -> list[Part]:
        """The same parts, of recordings whose files were replaced as they are now."""
        snapshot = self.session.snapshot()
        found: list[Part] = []
        for part in parts:
            summary = snapshot.summaries[snapshot.by_id[part.recording.id]]
            if self.session.entry_of(summary) is part.recording:
                found.append(part)
                continue
            again = self.parts_in(summary, part.bounds, part.windows)
            found += [one for one in again if one.topic == part.topic]
        return found

    def plan(self, parts: Sequence[Part]) -> ScanPlan:
        """The plan for reading the matching messages of some parts."""
        return self._again(self._plan, parts)

    def _plan(self, parts: Sequence[Part]) -> ScanPlan:
        parts = self._rows.fitting(self.decided(parts))
        return self._rows.plan(parts, reverse=self.question.reverse)

    def count_expired(self) -> Counter[State]:
        """Number of messages, in the range, whose payloads are gone, by state."""
        found: Counter[State] = Counter()
        for part in self.split():
            for state in GONE:
                gone = tuple(one for one in part.channels if one.state is state)
                if gone:
                    own = replace(part, channels=gone, predicate=None)
                    found[state] += self._rows.count([own])
        return found

    def not_indexed(self) -> tuple[tuple[str, int], ...]:
        """Number of messages, in the range, that the index lacks, by name of their recording."""
        parts = self.split()
        return self._lacking(self._index.documents(parts)) if parts else ()

    def _lacking(self, documents: Mapping[Part, int]) -> tuple[tuple[str, int], ...]:
        """Messages that the index lacks, from the documents that it has of some parts."""
        found: Counter[str] = Counter()
        for part, number in documents.items():
            whole = replace(part, predicate=None)
            found[part.recording.name] += max(self._rows.count([whole]) - number, 0)
        return tuple((name, number) for name, number in found.items() if number)

    def _count(self, parts: Sequence[Part]) -> int:
        return self._rows.count(self.decided(parts))

    def _lasting(self, part: Part, ask: Callable[[Part], Iterator[_Rows]]) -> Iterator[_Rows]:
        """Rows of a part, to the end if files are replaced or a table is damaged meanwhile."""
        (part,) = self.decided([part])
        last: tuple[int, int] | None = None
        renewals, unreadable = 0, self.counters.unreadable
        while True:
            self.counters.unreadable = unreadable
            try:
                for item in ask(part):
                    rest = item if last is None else _after(item, last)
                    if rest is not None and len(rest.log_time):
                        last = int(rest.log_time[-1]), int(rest.seq[-1])
                    if rest is not None:
                        yield rest
                return
            except ChangedError:
                renewals += 1
                if renewals > _RENEWALS:
                    raise
                (part,) = self.decided(self._renewed([part]))
            except TABLE_ERRORS:
                if not self._rows.leave_table(part):
                    raise

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


class MatchTimes(NamedTuple):
    """Some messages of one topic of one recording, in order of log time (ns) and arrival number."""

    recording: RecordingEntry
    topic: str
    log_time: NDArray[np.int64]
    seq: NDArray[np.int64]


def match_times(
    session: Session, question: Question, counters: Counters | None = None
) -> Iterator[MatchTimes]:
    """The times of an answer, some at a time; recordings and topics one after the other."""
    if not question.returns_all:
        raise UsageError("Times are those of all messages: leave out limit and every.")
    planner = Planner(session, question, counters)
    for part in planner.parts():
        for found in planner.outcomes(part):
            holds = found.holds
            yield MatchTimes(part.recording, part.topic, found.log_time[holds], found.seq[holds])


def _after(item: _Rows, key: tuple[int, int]) -> _Rows | None:
    """The rows behind a log time and arrival number; None without any."""
    time, seq = key
    is_before = (item.log_time < time) | ((item.log_time == time) & (item.seq <= seq))
    begin = int(np.count_nonzero(is_before))
    if begin == len(item.log_time):
        return None
    columns: dict[str, Any] = {n: column[begin:] for n, column in item._asdict().items()}
    return item._replace(**columns)


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
