"""Splits a question into parts and chooses an engine for each.

This is the only place that chooses. A part is one topic of one recording: an ended, a
running and a damaged recording may need different engines. Each engine estimates the cost
of its answer; the cheapest one answers, and if it fails, the next one.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from operator import itemgetter
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from hybridlog.query.chunk_scan import ChunkKey, ChunkScan, MessageRun, RowSelection
from hybridlog.query.engines.base import Checking, Need, UndecidedError
from hybridlog.query.engines.chunk_index import ChunkIndex
from hybridlog.query.engines.payload_scan import PayloadScan
from hybridlog.query.engines.statistics import Statistics
from hybridlog.query.question import Part
from hybridlog.query.ranges import RangeResolver
from hybridlog.schema.column import STAMP
from hybridlog.snapshot import UNFINISHED
from hybridlog_storage.errors import (
    ConnectionLostError,
    DatabaseError,
    HybridlogError,
    IndexChangedError,
    ResourceError,
    SegmentError,
    StoreError,
    TopicError,
)
from hybridlog_storage.lazy import lazy

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.chunk_scan import ChunkTask, ScanPlan
    from hybridlog.query.counters import Counters
    from hybridlog.query.engines.base import Engine, Objects, Outcomes, Values
    from hybridlog.query.engines.mongo import Mongo
    from hybridlog.query.engines.payload_columns import PayloadColumns
    from hybridlog.query.engines.running import RunningTables
    from hybridlog.query.engines.tables import TablesEngine
    from hybridlog.query.message_filter import MessageFilter
    from hybridlog.query.predicate.tree import Predicate
    from hybridlog.query.question import Question, RecordedChannel, Span
    from hybridlog.session import Session
    from hybridlog_storage.summary import RecordingSummary

_CONNECT_S = 0.3  # seconds to start and reach the embedded MongoDB
_MORE_TOGETHER = 64  # so many times more recordings are planned after each group
_MOST_TOGETHER = 4096  # recordings planned at once, if they do not overlap
_READ_AHEAD_FROM = 50  # messages; nothing is read ahead for fewer
_T = TypeVar("_T")
_Rows = TypeVar("_Rows", "Outcomes", "Values")
_Key = tuple[int, int]
_RETRIED = (
    DatabaseError,
    IndexChangedError,
    ResourceError,
    SegmentError,
    StoreError,
    UndecidedError,
)
"""Failures of one engine that another engine may not have."""


class Planner:
    """Answers one question.

    Args:
        session: The open store.
        question: The question.
        counters: Count what the answer costs.
    """

    def __init__(self, session: Session, question: Question, counters: Counters) -> None:
        self.session = session
        self.question = question
        self.counters = counters
        self._asked: Sequence[Part] = ()  # parts that are answered at the same time
        self._told: set[Part] = set()  # parts whose messages without fields are counted
        self._ranges = RangeResolver(session, question)
        self._scan = PayloadScan(session, counters)
        self._catalog: tuple[Engine, ...] = (Statistics(), ChunkIndex(session, counters))

    @lazy
    def _mongo(self) -> Mongo:
        from hybridlog.query.engines.mongo import Mongo

        return Mongo(self.session, self.counters, lambda: self._asked)

    @lazy
    def _tables(self) -> TablesEngine:
        from hybridlog.query.engines.tables import TablesEngine

        return TablesEngine(self.session, self.counters)

    @lazy
    def _columns(self) -> PayloadColumns:
        from hybridlog.query.engines.payload_columns import PayloadColumns

        return PayloadColumns(self.session, self.counters)

    @lazy
    def _running(self) -> RunningTables:
        from hybridlog.query.engines.running import RunningTables

        return RunningTables(self.session, self.counters)

    def _files(self, part: Part, need: Need) -> tuple[Engine, ...]:
        """The engines that need no server."""
        if part.recording.status in UNFINISHED:
            is_plain = part.predicate is None and need is not Need.VALUES
            return *self._catalog, *(() if is_plain else (self._running,)), self._scan
        if part.predicate is None and need is Need.OUTCOMES:
            return *self._catalog, self._tables, self._scan
        if part.predicate is None and need is not Need.VALUES:
            return *self._catalog, self._scan
        if part.recording.payloads:
            return *self._catalog, self._tables, self._columns, self._scan
        return *self._catalog, self._tables, self._scan

    def parts(self) -> list[Part]:
        """The question, split by recording and topic; recordings oldest first.

        Raises:
            TimeError: the time range is empty, or outside all recordings.
            TopicError: a topic does not have the requested clock.
        """
        return [part for resolved in self._ranges.resolve() for part in self.parts_in(*resolved)]

    def parts_in(
        self, summary: RecordingSummary, bounds: Span | None, windows: NDArray[np.int64] | None
    ) -> Iterator[Part]:
        """The parts of the question in one recording.

        Args:
            summary: The recording.
            bounds: See `Part`.
            windows: See `Part`.

        Raises:
            TopicError: a topic does not have the requested clock, or the recording is gone.
        """
        recording = self.session.entry_of(summary)
        wanted = set(self.question.topics)
        by_topic: dict[str, list[RecordedChannel]] = defaultdict(list)
        for channel in self.session.channels(recording):
            if channel.channel.topic in wanted:
                self._check_clock(channel)
                by_topic[channel.channel.topic].append(channel)
        predicate = self.question.predicate
        asks_fields = predicate is not None and predicate.asks_fields
        for topic, channels in by_topic.items():
            if not any(c.stats.messages for c in channels):
                continue  # nothing was sent on the topic
            blind = [c for c in channels if asks_fields and _has_no_fields(c)]
            yield Part(
                recording,
                topic,
                tuple(c for c in channels if not asks_fields or not _has_no_fields(c)),
                bounds,
                self.question.clock,
                windows,
                predicate,
                tuple(blind),
            )

    def channels(self) -> list[RecordedChannel]:
        """Every channel of the question."""
        places = self.session.chosen(self.question).tolist()
        summaries = self.session.snapshot().summaries
        return self._channels_of(summaries[place] for place in places)

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
            for channel in self.session.channels(self.session.entry_of(summary))
            if channel.channel.topic in wanted
        ]

    @lazy
    def ranks(self) -> dict[str, int]:
        """The place of each recording among those asked, by its key; ties are in this order."""
        keys = sorted(resolved.summary.key for resolved in self._ranges.resolve())
        return {key: rank for rank, key in enumerate(keys)}

    # Answers.

    def count(self) -> int:
        """Number of messages in the answer; payloads are read only as the last resort."""
        every = self.question.every
        by_topic: dict[str, list[Part]] = defaultdict(list)
        for part in self.parts():
            by_topic[part.topic].append(part)
        if every == 1:
            total = self._count([part for parts in by_topic.values() for part in parts])
        else:
            total = sum(-(-self._count(parts) // every) for parts in by_topic.values())
        limit = self.question.limit
        return total if limit is None else min(total, limit)

    def recordings_with_any(self) -> set[str]:
        """Ids of the recordings that have a message in the answer."""
        found: set[str] = set()
        groups: dict[Engine, list[Part]] = defaultdict(list)
        narrowed: list[Part] = []
        for part in self.together(self.parts()):
            if self._is_narrowed(part):
                narrowed.append(part)
            else:
                groups[next(self._choose(part, Need.COUNT))].append(part)
        for engine, group in groups.items():
            for part, count in self._count_each(engine, group):
                if count:
                    found.add(part.recording.id)
        if narrowed:
            for run in ChunkScan(self.plan(narrowed), self.session.segment).unordered():
                rows = np.unique(run.batch.channel).tolist()
                found.update(run.channels[row].recording.id for row in rows)
        return found

    def _count_each(self, engine: Engine, parts: Sequence[Part]) -> Iterator[tuple[Part, int]]:
        """The count of each part; a server is asked about all at once."""
        if engine is self._mongo:
            try:
                yield from self._mongo.counts(parts)
            except _RETRIED as error:
                yield from ((part, self._count_otherwise(part, engine, error)) for part in parts)
            return
        for part in parts:
            try:
                yield part, engine.count([part])
            except _RETRIED as error:
                yield part, self._count_otherwise(part, engine, error)

    def together(self, parts: Sequence[Part]) -> Sequence[Part]:
        """Announce parts that will be asked about one by one; a server is asked at once."""
        self._asked = parts
        return parts

    def outcomes(self, part: Part) -> Iterator[Outcomes]:
        """For each message of a part, whether it matches, in order."""
        self._tell_unasked([part])
        return self._first(part, Need.OUTCOMES, lambda engine: engine.outcomes(part))

    def reads_tables(self, part: Part, fields: Collection[str] | None) -> bool:
        """True if the fields of the messages of a part come from its table or columns."""
        costs = self._costs(self._files(part, Need.VALUES), part, Need.VALUES, fields)
        if costs and part.recording.payloads and costs[0][1] is self._columns:
            return True
        if not costs or costs[0][1] is not self._tables:
            return False
        try:
            self._tables.check(part)
        except _RETRIED:
            return False
        return True

    def values(self, part: Part, fields: Collection[str] | None) -> Iterator[Values]:
        """Fields of the matching messages of a part, in order."""
        if not self._costs(self._files(part, Need.VALUES), part, Need.VALUES, fields):
            # Only MongoDB finds the messages; the fields are those of the messages.
            return self._scan.values_of(self.plan([part]), fields)
        self._tell_unasked([part])
        return self._first(part, Need.VALUES, lambda engine: engine.values(part, fields), fields)

    def objects(self, part: Part) -> Iterator[Objects]:
        """The matching messages of a part as plain objects, in order."""
        return self._scan.objects_of(self.plan([part]))

    def runs(self) -> Iterator[MessageRun]:
        """The messages of the answer, in order."""
        question = self.question
        if question.limit == 0:
            return
        runs = self._runs()
        for run in runs if question.returns_all else _thinned(runs, question):
            self.counters.add_messages(run.batch)
            yield run

    def _runs(self) -> Iterator[MessageRun]:
        """All messages that match, in order; recordings are read when their turn comes."""
        limit = self.question.limit
        ahead = limit is None or limit > _READ_AHEAD_FROM
        for group in self._groups():
            plan = self.plan(group)
            yield from ChunkScan(plan, self.session.segment, ahead=ahead).runs()

    def unordered(self) -> Iterator[MessageRun]:
        """The messages of an answer without `limit` and `every`, unordered."""
        for group in self._groups():
            plan = self.plan(group)
            for run in ChunkScan(plan, self.session.segment).unordered():
                self.counters.add_messages(run.batch)
                yield run

    def _groups(self) -> Iterator[list[Part]]:
        """The parts in groups, those that overlap in time together, in the answer's order.

        The first group is small, so that the first message needs few recordings; there are few
        groups, since a server is asked once for each.
        """
        found = self._ranges.resolve()
        # In the order of the answer; going back, a recording begins with its last message.
        first, last = found.first, found.last
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
            begin, most = end, min(most * _MORE_TOGETHER, _MOST_TOGETHER)

    def plan(self, parts: Sequence[Part]) -> ScanPlan:
        """The plan for reading the matching messages of some parts."""
        plan = self._scan.plan(parts, filtered=False)
        plan.reverse = self.question.reverse
        if self.question.predicate is None or not parts:
            return plan
        from hybridlog.query.message_filter import MessageFilter

        self.together(parts)
        self._tell_unasked(parts)
        selecting: dict[Engine, list[Part]] = defaultdict(list)
        unindexed: set[int] = set()
        filters: dict[int, MessageFilter] = {}
        place = {(c.recording.id, c.channel_id): i for i, c in enumerate(plan.channels)}
        for part in parts:
            engine = self._selecting(part)
            indexes = [place[part.recording.id, c.channel_id] for c in part.channels]
            if engine is self._scan:
                unindexed.update(indexes)
                decide = part.predicate
            else:
                selecting[engine].append(part)
                decide = self._undecided(part) if engine is self._mongo else None
            if decide is not None:
                filters.update(dict.fromkeys(indexes, MessageFilter(decide, part.field_types)))
        plan.filters = filters

        def read_instead(part: Part, failure: HybridlogError) -> None:
            if not self._costs([self._scan], part, Need.SELECTION, ()):
                raise failure
            assert part.predicate is not None
            indexes = [place[part.recording.id, c.channel_id] for c in part.channels]
            decide = MessageFilter(part.predicate, part.field_types)
            filters.update(dict.fromkeys(indexes, decide))  # before chunks are read for it
            unindexed.update(indexes)

        def select(tasks: Sequence[ChunkTask]) -> RowSelection:
            offsets: dict[ChunkKey, list[NDArray[np.int64]]] = defaultdict(list)
            for engine, chosen in [*selecting.items()]:
                try:
                    found = self._again(partial(engine.select, chosen, tasks), chosen)
                except _RETRIED as error:
                    for part in chosen:
                        read_instead(part, error)
                    del selecting[engine]
                    continue
                for key, rows in found.offsets.items():
                    offsets[key].append(rows)
            merged = {key: np.sort(np.concatenate(rows)) for key, rows in offsets.items()}
            return RowSelection(merged, unindexed)

        plan.selector = select if selecting else None
        return plan

    def _tell_unasked(self, parts: Sequence[Part]) -> None:
        """Count, once, the messages of which the predicate cannot be asked for want of fields.

        Engines count the messages that they find to be unreadable.
        """
        for part in parts:
            if part in self._told or part.predicate is None:
                continue
            self._told.add(part)
            if part.blind:
                unseen = replace(part, channels=part.blind, blind=(), predicate=None)
                self.counters.unreadable += self._count_stored(unseen)
            if part.needs_index and self._mongo.reaches(part):
                self.counters.unindexed += self.count_unindexed([part])
            if part.predicate.is_opaque and self._mongo.reaches(part):
                self.counters.unreadable += self._mongo.count_unasked(part)

    def _count_stored(self, part: Part) -> int:
        """Number of messages of a part without a predicate."""
        by_times = self._catalog[1]
        engine = self._scan if by_times.cost(part, Need.COUNT) is None else by_times
        return engine.count([part])

    def count_unindexed(self, parts: Iterable[Part]) -> int:
        """Number of messages of running recordings, in the range, that the index lacks.

        Raises:
            DatabaseError: MongoDB is unavailable.
            IndexChangedError: another process changes the index.
        """
        total = 0
        for part in (part for part in parts if part.recording.status == "open"):
            channels = (*part.channels, *part.blind)
            whole = replace(part, channels=channels, blind=(), predicate=None)
            total += max(self._count_stored(whole) - self._mongo.count([whole]), 0)
        return total

    def _undecided(self, part: Part) -> Predicate | None:
        """The share of a part's predicate that is left when MongoDB has answered."""
        from hybridlog.query.message_filter import residual

        assert part.predicate is not None
        return residual(part.predicate) if self._mongo.undecided(part) else None

    # Choosing.

    def _selecting(self, part: Part) -> Engine:
        """The engine that finds the matching messages of a part."""
        for engine in self._choose(part, Need.SELECTION):
            if isinstance(engine, Checking):
                try:
                    engine.check(part)
                except _RETRIED:
                    continue
            return engine
        self.session.database_for("A MongoDB filter")
        raise DatabaseError("No engine answers this question.")

    def _choose(
        self, part: Part, need: Need, fields: Collection[str] | None = ()
    ) -> Iterator[Engine]:
        """The engines that can answer, the cheapest first.

        MongoDB is connected to only if that pays, or if nothing else can answer.

        Raises:
            DatabaseError: only MongoDB can, and it is unavailable.
        """
        files = self._files(part, need)
        costs = self._costs(files, part, need, fields)
        is_connected = self.session.connected is not None
        if costs and not is_connected and costs[0][0] < _CONNECT_S:
            yield from (engine for _, engine in costs)
            costs = []
        costs = sorted([*costs, *self._costs([self._mongo], part, need, fields)], key=itemgetter(0))
        yield from (engine for _, engine in costs)
        if not costs and not self._costs(files, part, need, fields):
            self.session.database_for("A MongoDB filter")
            raise DatabaseError("No engine answers this question.")

    def _costs(
        self, engines: Sequence[Engine], part: Part, need: Need, fields: Collection[str] | None
    ) -> list[tuple[float, Engine]]:
        """Costs of the engines that can answer, in order."""
        found = [(engine.cost(part, need, fields), engine) for engine in engines]
        able = [(cost, engine) for cost, engine in found if cost is not None]
        return sorted(able, key=itemgetter(0))

    def _count(self, parts: Sequence[Part]) -> int:
        self.together(parts)
        self._tell_unasked(parts)
        groups: dict[Engine, list[Part]] = defaultdict(list)
        narrowed: list[Part] = []
        for part in parts:
            if self._is_narrowed(part):
                narrowed.append(part)
                continue
            engine = next(self._choose(part, Need.COUNT))
            groups[engine].append(part)
        total = 0
        for engine, group in groups.items():
            try:
                total += engine.count(group)
            except _RETRIED as error:
                total += sum(self._count_otherwise(part, engine, error) for part in group)
        if narrowed:
            scan = ChunkScan(self.plan(narrowed), self.session.segment)
            total += sum(len(run.batch) for run in scan.unordered())
        return total

    def _is_narrowed(self, part: Part) -> bool:
        """True if MongoDB finds candidates and the messages decide."""
        if part.predicate is None:
            return False
        costs = self._costs(self._files(part, Need.COUNT), part, Need.COUNT, ())
        if costs and (costs[0][1] is not self._scan or costs[0][0] < _CONNECT_S):
            return False
        if not self._mongo.reaches(part) or self._costs([self._mongo], part, Need.COUNT, ()):
            return False
        return self._mongo.cost(part, Need.SELECTION) is not None

    def _count_otherwise(self, part: Part, failed: Engine, failure: Exception) -> int:
        """The count of an engine that failed, by the next ones."""
        for engine in self._others(part, Need.COUNT, failed, failure):
            try:
                return engine.count([part])
            except _RETRIED as error:
                failure = error if isinstance(failure, UndecidedError) else failure
        raise failure

    def _others(
        self,
        part: Part,
        need: Need,
        failed: Engine,
        failure: Exception,
        fields: Collection[str] | None = (),
    ) -> Iterator[Engine]:
        """The engines to ask after one has failed.

        If the connection was lost, MongoDB is connected to again only if no other can answer:
        the index may have to be built again first.
        """
        if not isinstance(failure, ConnectionLostError):
            yield from (e for e in self._choose(part, need, fields) if e is not failed)
            return
        self._mongo.forget()
        files = self._costs(self._files(part, need), part, need, fields)
        yield from (engine for _, engine in files)
        if self._costs([self._mongo], part, need, fields):
            yield self._mongo

    def _again(self, ask: Callable[[], _T], parts: Sequence[Part]) -> _T:
        """An answer; asked for once more if the connection was lost and MongoDB must answer."""
        try:
            return ask()
        except ConnectionLostError:
            if all(self._costs([self._scan], part, Need.SELECTION, ()) for part in parts):
                raise
            self._mongo.forget()
            return ask()

    def _first(
        self,
        part: Part,
        need: Need,
        ask: Callable[[Engine], Iterator[_Rows]],
        fields: Collection[str] | None = (),
    ) -> Iterator[_Rows]:
        """Items of the cheapest engine; the next one goes on where it fails."""
        failed = next(self._choose(part, need, fields))
        failure: Exception
        last: _Key | None = None
        try:
            for item in ask(failed):
                yield item
                last = _last_key(item) or last
            return
        except _RETRIED as error:
            failure = error
        for engine in self._others(part, need, failed, failure, fields):
            try:
                for item in ask(engine):
                    rest = item if last is None else _after(item, last)
                    if rest is not None:
                        yield rest
                        last = _last_key(rest) or last
                return
            except _RETRIED as error:
                failure = error if isinstance(failure, UndecidedError) else failure
        raise failure

    def _check_clock(self, channel: RecordedChannel) -> None:
        if self.question.bounds is None or channel.is_reduced:
            return
        topic, clock = channel.channel.topic, self.question.clock
        if clock == "header" and not any(p.path == STAMP for p in channel.codec.paths()):
            raise TopicError(f"{topic} has no {STAMP}: use the log clock, or another topic.")
        if clock == "publish" and not channel.channel.has_publish_time:
            raise TopicError(
                f"{topic} came without publish times (ROS 1 bags have none): use --clock log."
            )


def _has_no_fields(channel: RecordedChannel) -> bool:
    """True if the messages of a channel are not decoded, for example without a definition."""
    return not channel.is_reduced and not channel.codec.indexed


def _last_key(item: Outcomes | Values) -> _Key | None:
    """Log time and arrival number of the last row; None without rows."""
    return (int(item.log_time[-1]), int(item.seq[-1])) if len(item.log_time) else None


def _after(item: _Rows, key: _Key) -> _Rows | None:
    """The rows behind a log time and arrival number; None without any."""
    time, seq = key
    is_before = (item.log_time < time) | ((item.log_time == time) & (item.seq <= seq))
    begin = int(np.count_nonzero(is_before))
    if begin == len(item.log_time):
        return None
    columns: dict[str, Any] = {n: column[begin:] for n, column in item._asdict().items()}
    return item._replace(**columns)


def _thinned(runs: Iterator[MessageRun], question: Question) -> Iterator[MessageRun]:
    """Every n-th message of each topic, up to the limit."""
    number: dict[str, int] = {}
    seen: dict[int, int] = defaultdict(int)
    given = 0
    for run in runs:
        keep = np.ones(len(run.batch), np.bool_)
        if question.every > 1:
            names = (channel.channel.topic for channel in run.channels)
            of = [number.setdefault(name, len(number)) for name in names]
            topics = np.array(of, np.intp)[run.batch.channel]
            for topic in np.unique(topics).tolist():
                rows = np.flatnonzero(topics == topic)
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
