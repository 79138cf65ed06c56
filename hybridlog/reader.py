"""Asking a store: a `Query` is built step by step, and answered when it is looked at.

```python
scans = store.topic("scan").between("+10s", "+11s").where("ranges.min < 0.5")
for message in scans: ...
frame = scans.to_pandas()
```

Each step gives a new query; nothing is read before the answer is asked for. What an
answer has cost stands in `counters` afterwards.
"""

from __future__ import annotations

import difflib
import heapq
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from operator import itemgetter
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from hybridlog.counting import count_in_columns, in_all_times
from hybridlog.frames.names import is_own, is_summary
from hybridlog.indexing import STAMP
from hybridlog.message import Documents, Message, messages_in
from hybridlog.query.chunk_counts import count_in_chunks
from hybridlog.query.chunk_lists import earlier_and_earlier
from hybridlog.query.intervals import span_of
from hybridlog.query.latest import last_message
from hybridlog.query.plan import (
    Chosen,
    Clock,
    Counters,
    Lane,
    Piece,
    Plan,
    Sweep,
    Target,
    Task,
    count_given,
)
from hybridlog.query.predicate import Predicate
from hybridlog.query.times import (
    TIME_LIMIT,
    DurationLike,
    TimeLike,
    format_time,
    parse_range,
    parse_time,
)
from hybridlog_storage.collection_names import collection_of
from hybridlog_storage.errors import (
    IndexChangedError,
    SegmentError,
    TimeError,
    TopicError,
    UsageError,
)
from hybridlog_storage.index_documents import key_bound

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa
    from numpy.typing import NDArray

    from hybridlog.guarded import GuardedIndex
    from hybridlog.query.intervals import Intervals
    from hybridlog.store import Store
    from hybridlog_storage.catalog import ChunkEntry, RecordingEntry
    from hybridlog_storage.chunk import StoredChunk
    from hybridlog_storage.messages import Batch

_BATCH = 10_000  # index documents that come at a time
_FEW = 50
"""So many index documents are counted in the time in which a chunk's entry is fetched."""
_HANDFUL = 50  # messages for which nothing is read ahead
_REFERENCE = {"_id": 0, "_meta.t": 1, "_meta.seq": 1, "_meta.ref": 1}


@dataclass(frozen=True)
class Query:
    """A question about some topics of a store. Immutable: each step gives a new one."""

    store: Store
    topics: tuple[str, ...]
    recording_ids: tuple[str, ...]
    _bounds: tuple[TimeLike | None, TimeLike | None] | None = None
    _clock: Clock = "log"
    _predicates: tuple[Predicate, ...] = ()
    _limit: int | None = None
    _every: int = 1
    _reverse: bool = False
    _fields: tuple[str, ...] | None = None
    _windows: Intervals | None = None
    counters: Counters = field(default_factory=Counters, compare=False)
    """What the last answer has cost."""

    # Steps.

    def again(self) -> Query:
        """The same question, not asked yet: what it costs is counted anew."""
        return self._with()

    def between(self, begin: TimeLike | None, end: TimeLike | None = None) -> Query:
        """Only messages with `begin <= time < end`.

        Args:
            begin: ISO 8601, seconds or nanoseconds since the epoch, or relative to each
                recording (`+5s`, `-10s`); None for its start.
            end: The same; None for its end.
        """
        return self._with(_bounds=(begin, end))

    def clock(self, clock: str) -> Query:
        """Which time `between` is about: `log` (default), `publish` or `header`.

        Raises:
            UsageError: another word.
        """
        if clock not in {"log", "publish", "header"}:
            raise UsageError(f"There is no clock {clock!r}: log, publish and header there are.")
        return self._with(_clock=cast(Clock, clock))

    def where(self, predicate: str | Mapping[str, object]) -> Query:
        """Only messages that satisfy a predicate; several are joined by *and*.

        Args:
            predicate: `"ranges.min < 0.5 and header.frame_id == 'laser'"`, or a MongoDB
                filter.

        Raises:
            WhereError: it cannot be understood, or is not allowed.
        """
        if isinstance(predicate, str):
            checked = self.store.predicate(predicate, self.topics, self.recording_ids)
        else:
            from hybridlog.query.filters import check_filter

            checked = Predicate(check_filter(predicate))
        return self._with(_predicates=(*self._predicates, checked))

    def limit(self, count: int) -> Query:
        """At most so many messages.

        Raises:
            UsageError: a negative number.
        """
        if count < 0:
            raise UsageError("A limit cannot be negative.")
        return self._with(_limit=count)

    def every(self, step: int) -> Query:
        """Only every n-th message, beginning with the first.

        Raises:
            UsageError: less than one.
        """
        if step < 1:
            raise UsageError("every(n) needs n of at least 1.")
        return self._with(_every=step)

    def reverse(self) -> Query:
        """Latest first."""
        return self._with(_reverse=not self._reverse)

    def fields(self, *paths: str) -> Query:
        """Only these fields in tables (`header.stamp`, `pose.position`, `ranges.min`).

        `publish_time`, `stamp` (of the header), `seq` (arrival number), `sequence` (the
        sender's), `topic` and `recording` are columns, too, where no field is called so.

        Raises:
            TopicError: no topic of the query has such a field.
        """
        known = self.field_types()
        for path in paths:
            if known and not (_is_field(path, known) or is_own(path)):
                raise TopicError(_no_field(path, known, self.topics))
        return self._with(_fields=tuple(paths))

    def in_recording(self, *names: str) -> Query:
        """Only these recordings, by id or name.

        Raises:
            TopicError: there is no such recording, or it lacks the topic.
        """
        chosen = tuple(r.id for r in self.store.select(names))
        return self._in(self.topics, chosen)

    def only(self, topic: str) -> Query:
        """The same question about one of its topics."""
        return self._in([topic], self.recording_ids)

    def during(self, intervals: Intervals) -> Query:
        """Only messages whose log time is in one of some intervals of their recording.

        A message in several of them is given once. Given twice, both must hold.

        Args:
            intervals: From `intervals`, `changes` or `windows` of any query of this store, or
                made by hand; recordings go by id or by label.

        Raises:
            TopicError: an interval is of a recording that is not in the store.
        """
        known = self.store.recordings()
        ids = {entry.label: entry.id for entry in known} | {entry.id: entry.id for entry in known}
        intervals = intervals.by_id(ids)
        if self._windows is not None:
            intervals = self._windows.common(intervals)
        return self._with(_windows=intervals.merged())

    def before(self, events: Query, length: DurationLike) -> Query:
        """Only messages that came at most so long before an event, in its recording.

        The event's own log time is not part of it: `t - length <= time < t`.

        Args:
            events: Its messages are the events.
            length: A duration: `"5min"`, seconds, a `timedelta`.

        Raises:
            TimeError: `length` is no duration.
        """
        return self.during(events.windows(before=length))

    def around(self, events: Query, before: DurationLike = 0, after: DurationLike = 0) -> Query:
        """Only messages near an event, in its recording: `t - before <= time < t + after`.

        Args:
            events: Its messages are the events.
            before: How long before an event it begins, a duration.
            after: How long after an event it ends, a duration.

        Raises:
            TimeError: One of both is no duration.
            UsageError: Both are zero.
        """
        return self.during(events.windows(before, after))

    def just_at(self, moment: TimeLike) -> Query:
        """Only the message that was current at a time: the last one not after it.

        Raises:
            TopicError: there is none.
            UsageError: the question has a time range, or another clock than the log's.
        """
        found = self.at(moment)
        return self._last_within(found.recording, found.log_time_ns, found.log_time_ns)

    def at(self, moment: TimeLike) -> Message:
        """The message that `just_at` asks for. Its arrays are read-only: copy what is to change.

        Raises:
            TopicError: there is none.
            UsageError: the question has a time range, or another clock than the log's.
        """
        if not self.is_unbounded or self._clock != "log":
            raise UsageError(
                "A message at a time is the last one by log time; `between`, `during` and "
                "`clock` do not fit."
            )
        with self.costing():
            found = self._current(moment)
        if found is None:
            raise TopicError(f"No message of {', '.join(self.topics)} is at or before {moment}.")
        return found

    def _current(self, moment: TimeLike) -> Message | None:
        """The message that was current at a time, in whichever recording it is."""
        moments: list[tuple[int, int, RecordingEntry]] = []
        for recording in self._recordings():
            start, end = span_of(recording)
            now = parse_time(moment, start=start, end=end)
            if start < end and start <= now:
                moments.append((min(now, end - 1), start, recording))
        best: tuple[tuple[int, str, int], Message] | None = None
        # The recording that could hold the latest message is asked first: mostly it does.
        for latest, start, recording in sorted(moments, key=itemgetter(0), reverse=True):
            if best is not None and latest < best[0][0]:
                break
            found = self._last_of(recording, (start, latest))
            if found is not None:
                place = found.log_time_ns, recording.key, found.seq
                if best is None or place > best[0]:
                    best = place, found
        return best[1] if best is not None else None

    def _last_of(self, recording: RecordingEntry, span: tuple[int, int]) -> Message | None:
        """The last message of a recording in `[start, latest]`, ns."""
        if self._predicates:
            return self._last_that_satisfies(recording, span)
        wanted = set(self.topics)
        lanes = {
            lane.channel_id: lane
            for lane in self.store.lanes(recording)
            if lane.channel.topic in wanted
        }

        def load(entry: ChunkEntry) -> StoredChunk:
            chunk = self.store.segment(recording.id, entry.segment).read_chunk(entry.place)
            self.counters.chunks_read += 1
            self.counters.bytes_read += chunk.length + chunk.trailer
            return chunk

        def read(entry: ChunkEntry) -> StoredChunk:
            key = recording.id, entry.segment, entry.number
            return self.store.recent_chunks.get(key, partial(load, entry))

        chunks = self.store.chunks_before(recording, list(lanes), span)
        found = last_message(chunks, lanes, span[1], read)
        if found is None:
            return None
        batch = found.batch.take(slice(found.row, found.row + 1))
        view = batch.payload(0)
        self.counters.messages += 1
        self.counters.payload_bytes += len(view)
        return Message(
            lanes[batch.channel.item()],
            log_time=found.log_time,
            publish_time=batch.publish_time.item(),
            sequence=batch.sequence.item(),
            seq=found.seq,
            view=view,
            documents=Documents(lanes, batch),
            row=0,
        )

    def _last_that_satisfies(
        self, recording: RecordingEntry, span: tuple[int, int]
    ) -> Message | None:
        start, latest = span
        for begin in earlier_and_earlier(latest, start):
            query = self._last_within(recording.id, begin, latest)
            found = next(iter(query), None)
            self.counters.add(query.counters)
            if found is not None:
                return found
        return None

    def _last_within(self, recording: str, begin: int, latest: int) -> Query:
        """The question about the last message of a recording in `[begin, latest]`, ns."""
        return self._with(
            recording_ids=(recording,),
            _bounds=(f"{begin}ns", f"{latest + 1}ns"),
            _reverse=True,
            _limit=1,
        )

    # Answers.

    def __iter__(self) -> Iterator[Message]:
        """The messages, ordered by log time, recording and arrival."""
        plan = self.plan()
        for piece in self.pieces(plan):
            yield from messages_in(plan.lanes, piece)

    def first(self) -> Message | None:
        """The first message, None when there is none."""
        return next(iter(self.limit(1)), None)

    def batches(self) -> Iterator[tuple[Batch, Sequence[Lane]]]:
        """The messages in order, many at once; `batch.channel` indexes the lanes.

        Messages whose payload was given up are not among them; `counters.reduced` counts
        them.
        """
        plan = self.plan()
        whole = np.array([not lane.is_reduced for lane in plan.lanes], np.bool_)
        for piece in self.pieces(plan):
            batch = piece.batch if whole.all() else piece.batch.take(whole[piece.batch.channel])
            self.counters.reduced += len(piece.batch) - len(batch)
            if len(batch):
                yield batch, plan.lanes

    def count(self) -> int:
        """Number of messages, without reading a payload."""
        started = time.monotonic()
        total = -(-self._count_again() // self._every)
        self.counters.messages = total if self._limit is None else min(total, self._limit)
        self.counters.elapsed_s = time.monotonic() - started
        return self.counters.messages

    def documents(self) -> Iterator[dict[str, Any]]:
        """The index documents, in the order of the messages.

        Raises:
            DatabaseError: MongoDB is away.
        """
        if len(self.topics) == 1:
            yield from self.documents_of(self.topics[0])
            return
        whole = self._with(_limit=None, _every=1)
        parts = [whole.documents_of(topic) for topic in self.topics]
        # Keys are in the order of log time, recording and arrival, over all topics.
        merged = heapq.merge(*parts, key=lambda document: document["_id"], reverse=self._reverse)
        stop = None if self._limit is None else self._limit * self._every
        yield from islice(merged, 0, stop, self._every)

    def documents_of(self, topic: str) -> Iterator[dict[str, Any]]:
        """The index documents of one of the topics, in the order of the messages."""
        import bson

        for raw, rows, _ in self.thinned_documents(topic, None):
            documents = bson.decode_all(raw)
            yield from (documents[row] for row in rows.tolist())

    def intervals(
        self,
        at_least: DurationLike | None = None,
        length: DurationLike | None = None,
        max_gap: DurationLike | None = None,
    ) -> Intervals:
        """When the predicate of `where` holds: the longest intervals in which it does.

        At any time the state is what the last message of the topic by then says (by log
        time, then arrival); before the first one it is unknown, and no interval. It goes
        on until the next message, or the end of the recording. The range of `between`
        cuts intervals off, and what held when it began is known from before. Without
        `where`, any message holds: with `max_gap`, that is when the topic was alive.

        Args:
            at_least: Only intervals of at least this length.
            length: Each interval cut into as many of exactly this length as fit into it,
                one after the other from its beginning.
            max_gap: A message is believed for this long; without, until the next one.

        Returns:
            Their `messages` are those that satisfy the predicate.

        Raises:
            UsageError: several topics, `limit`, `every`, `reverse`, or another clock than
                the log's.
            TimeError: no duration, or a range outside of all recordings.
            DatabaseError: MongoDB is away.
        """
        from hybridlog.moments import states

        with self.costing():
            found = states(self, max_gap)
        if at_least is not None:
            found = found.at_least(at_least)
        return found if length is None else found.cut(length)

    def changes(
        self, *fields: str, pause: DurationLike = "1s", tolerance: float = 0.0
    ) -> Intervals:
        """When fields changed: runs of messages that differ from the one before them.

        A step is a message of which any of the fields differs from that of the message
        before it, of those that satisfy `where`, in the same recording. Steps with no more
        than `pause` between them are one change, whatever lies between. A change begins
        at the log time of its first step, and ends 1 ns after that of its last one.

        Args:
            fields: Paths (`position`, `position.x`). Long arrays are compared by their
                summaries, the only thing of them that the index holds.
            pause: Longest time between steps of one change.
            tolerance: Numbers that differ by at most so much are the same.

        Returns:
            Their `messages` are the steps.

        Raises:
            TopicError: there is no such field.
            UsageError: no field, several topics, `limit`, `every`, `reverse`, or another
                clock than the log's.
            TimeError: no duration, or a range outside of all recordings.
            DatabaseError: MongoDB is away.
        """
        from hybridlog.moments import changes

        if not fields:
            raise UsageError("Which fields? `hybridlog schema TOPIC` lists them.")
        self.fields(*fields)  # refuses what there is not
        with self.costing():
            return changes(self, fields, pause, tolerance)

    def windows(self, before: DurationLike = 0, after: DurationLike = 0) -> Intervals:
        """Time around each message: `t - before <= time < t + after`, within its recording.

        There is one a message, so they may overlap; `during` and `merged` join them.

        Args:
            before: How long before it the window begins, a duration.
            after: How long after it the window ends, a duration.

        Raises:
            TimeError: one of both is no duration.
            UsageError: both are zero, or `limit` or `every` of several topics.
            DatabaseError: MongoDB is away.
        """
        from hybridlog.moments import windows

        with self.costing():
            return windows(self, before, after)

    def to_arrow(self) -> pa.Table:
        """A table: scalars and strings as columns, arrays as lists, first column log time."""
        from hybridlog.frames.answer import collect

        table = collect(self).to_arrow()
        if self._reverse:
            table = table.take(np.arange(table.num_rows - 1, -1, -1))
        return table

    def to_pandas(self) -> pd.DataFrame:
        """A frame: scalars as columns, arrays as numpy cells, indexed by log time (UTC, ns)."""
        from hybridlog.frames.answer import collect

        frame = collect(self).to_pandas()
        if self._reverse:
            frame = frame.iloc[::-1]
        frame.attrs["hybridlog"] = _as_dict(self.counters)
        return frame

    def to_numpy(self) -> NDArray[Any] | list[NDArray[Any]]:
        """Every message as an array (`Message.to_numpy`): stacked when all are alike."""
        arrays: list[NDArray[Any]] = [message.to_numpy() for message in self]
        alike = {(a.shape, a.dtype) for a in arrays}
        return np.stack(arrays) if len(alike) == 1 else arrays

    # What was asked, for those who answer.

    @property
    def selected_fields(self) -> tuple[str, ...] | None:
        """Paths given to `fields`, None for all."""
        return self._fields

    @property
    def step(self) -> int:
        """What was given to `every`."""
        return self._every

    @property
    def most(self) -> int | None:
        """What was given to `limit`, None for all; 1 after `just_at`."""
        return self._limit

    @property
    def is_unthinned(self) -> bool:
        """Whether every message that fits is wanted: neither `limit` nor `every`."""
        return self._limit is None and self._every == 1

    @property
    def is_unbounded(self) -> bool:
        """Whether all times are wanted: neither `between` nor `during`."""
        return self._bounds is None and self._windows is None

    @property
    def is_by_log_time(self) -> bool:
        """Whether its time range, if it has one, is of log time."""
        return self._bounds is None or self._clock == "log"

    @property
    def is_reversed(self) -> bool:
        """Whether the latest message comes first."""
        return self._reverse

    @property
    def filter(self) -> dict[str, object]:
        """What was given to `where`, as one MongoDB filter; empty for everything."""
        return _all_of([predicate.to_filter() for predicate in self._predicates if predicate])

    @property
    def predicates(self) -> tuple[Predicate, ...]:
        """What was given to `where`; all must hold."""
        return self._predicates

    def spans(self) -> list[tuple[RecordingEntry, tuple[int, int]]]:
        """Which log time `[begin, end)`, ns, of each recording is asked about.

        Raises:
            TimeError: The range is empty, or outside of all recordings.
            UsageError: The range is by another clock.
        """
        if not self.is_by_log_time:
            raise UsageError(f"Intervals are of log time; a range by {self._clock} does not fit.")
        found: list[tuple[RecordingEntry, tuple[int, int]]] = []
        outside: list[tuple[RecordingEntry, tuple[int, int]]] = []
        for recording in self._recordings():
            bounds = self._bounds_in(recording)
            if recording.span is None:
                continue
            if bounds is not None and self._is_outside(bounds, recording):
                outside.append((recording, bounds))
                continue
            start, end = span_of(recording)
            if bounds is not None:
                start, end = max(start, bounds[0]), min(end, bounds[1])
            found.extend((recording, span) for span in self._windows_in(recording, (start, end)))
        if outside and not found and self._windows is None:
            self._refuse(outside)
        return found

    def beginnings(self) -> Iterator[tuple[RecordingEntry, int]]:
        """Recordings in which the time range begins after the recording does, and when, ns."""
        for recording in self._recordings():
            bounds = self._bounds_in(recording) if self._clock == "log" else None
            start, end = span_of(recording)
            begin, stop = bounds or (start, end)
            windows = self._windows_in(recording, (max(begin, start), min(end, stop)))
            if windows and start < windows[0][0]:
                yield recording, windows[0][0]

    def size_hint(self) -> int:
        """Bytes of payload, about: what a progress bar counts up to."""
        total = 0.0
        for recording in self._recordings():
            start, end = span_of(recording)
            begin, stop = self._bounds_in(recording) or (start, end)
            windows = self._windows_in(recording, (max(start, begin), min(end, stop)))
            share = sum(high - low for low, high in windows) / max(end - start, 1)
            total += share * sum(
                c.stats.payload_bytes for c in recording.channels if c.topic in self.topics
            )
        return int(total)

    def lanes(self) -> list[Lane]:
        """Every channel that the question is about."""
        wanted = set(self.topics)
        return [
            lane
            for r in self._recordings()
            for lane in self.store.lanes(r)
            if lane.channel.topic in wanted
        ]

    # How.

    def _with(self, **changes: Any) -> Query:
        # What `replace` does, which asks about each field: a loop makes many questions.
        other = object.__new__(Query)
        vars(other).update(vars(self), counters=Counters(), **changes)
        return other

    def _in(self, topics: Sequence[str], recordings: Sequence[str]) -> Query:
        """The same conditions on other topics and recordings."""
        other = self.store.query(topics, recordings)
        return self._with(topics=other.topics, recording_ids=other.recording_ids)

    def _recordings(self) -> list[RecordingEntry]:
        return [r for r in self.store.recordings() if r.id in self.recording_ids]

    def field_types(self) -> dict[str, str] | None:
        """Paths that can be queried and their types; None when a topic has no fixed fields."""
        types: dict[str, str] = {}
        for lane in self.lanes():
            if lane.is_reduced:
                continue  # its fields are those of whole messages
            paths = lane.codec.paths()
            if not paths:
                return None
            types.update({path.path: path.type for path in paths})
        return types or None

    def _bounds_in(self, recording: RecordingEntry) -> tuple[int, int] | None:
        """The time range in one recording, ns; None for all of it.

        It may be empty: `2025-01-01` to `end` is, in a recording of the year before.
        """
        if self._bounds is None:
            return None
        start, end = span_of(recording)
        begin, stop = self._bounds
        return (
            0 if begin is None else parse_time(begin, start=start, end=end),
            TIME_LIMIT - 1 if stop is None else parse_time(stop, start=start, end=end),
        )

    def _windows_in(
        self, recording: RecordingEntry, span: tuple[int, int]
    ) -> list[tuple[int, int]]:
        """What of a span of log time is asked about: all of it, or parts, apart and in order."""
        begin, end = span
        if begin >= end:
            return []
        if self._windows is None:
            return [span]
        rows = self._windows.of_recording(recording.id).tolist()
        return [
            (max(begin, low), min(end, high)) for low, high in rows if low < end and high > begin
        ]

    def _targets(self, lanes: list[Lane], *, with_chunks: bool = True) -> list[Target]:
        """What is wanted of each recording; without chunks when the index alone answers."""
        targets = []
        wanted = set(self.topics)
        outside: list[tuple[RecordingEntry, tuple[int, int]]] = []
        for recording in self._recordings():
            mine: dict[int, int] = {}
            for lane in self.store.lanes(recording):
                if lane.channel.topic in wanted:
                    self._check_clock(lane)
                    mine[lane.channel_id] = len(lanes)
                    lanes.append(lane)
            if not mine:
                continue
            bounds = self._bounds_in(recording)
            if bounds is not None and self._is_outside(bounds, recording):
                outside.append((recording, bounds))
                continue
            windows = None
            if self._windows is not None:
                windows = self._windows.of_recording(recording.id)
                if not len(windows):
                    continue
            chunks = self._chunks(recording, list(mine), bounds, windows) if with_chunks else []
            targets.append(Target(recording, mine, bounds, chunks, windows))
        if outside and not targets and self._windows is None:
            self._refuse(outside)
        return targets

    def _chunks(
        self,
        recording: RecordingEntry,
        channels: list[int],
        bounds: tuple[int, int] | None,
        windows: NDArray[np.int64] | None,
    ) -> list[ChunkEntry]:
        """Chunks that may hold what is wanted; those between windows are among them."""
        clock = self._clock
        if windows is not None and (bounds is None or clock == "log"):
            low, high = bounds or (0, TIME_LIMIT - 1)
            bounds = max(low, int(windows[0, 0])), min(high, int(windows[-1, 1]))
            clock = "log"
            if bounds[0] >= bounds[1]:
                return []
        return self.store.chunks(recording, channels, bounds, clock)

    def _is_outside(self, bounds: tuple[int, int], recording: RecordingEntry) -> bool:
        """Whether a range is empty, or by the log clock beside a recording."""
        start, end = span_of(recording)
        beside = self._clock == "log" and (bounds[0] >= end or bounds[1] <= start)
        return beside or bounds[0] >= bounds[1]

    def _refuse(self, outside: Sequence[tuple[RecordingEntry, tuple[int, int]]]) -> None:
        """Refuse a range that holds nothing of any recording.

        Raises:
            TimeError: it ends before it begins, or lies beside all of them.
        """
        assert self._bounds is not None
        begin, stop = self._bounds
        spans = []
        for recording, (low, high) in outside:
            start, end = span_of(recording)
            # `2025-01-01` to `end` is no mistake, there is only nothing so late.
            if low < high or low == start or high == end:
                spans.append(f"{recording.label} spans {format_time(start)} to {format_time(end)}")
        if not spans:
            start, end = span_of(outside[0][0])
            parse_range(begin, stop, start=start, end=end)
        raise TimeError(f"Nothing was recorded between {begin} and {stop}: {'; '.join(spans[:5])}.")

    def _check_clock(self, lane: Lane) -> None:
        if self._bounds is None or lane.is_reduced:
            return
        topic = lane.channel.topic
        if self._clock == "header" and not any(p.path == STAMP for p in lane.codec.paths()):
            raise TopicError(f"{topic} has no {STAMP}: use the log clock, or another topic.")
        if self._clock == "publish" and not lane.channel.has_publish_time:
            raise TopicError(
                f"{topic} came without publish times (ROS 1 bags have none): use --clock log."
            )

    def plan(self) -> Plan:
        """What to read for this question; resets the counters."""
        lanes: list[Lane] = []
        self.counters.reset()
        targets = self._targets(lanes)
        chooser = self._choose if self._predicates else None
        return Plan(lanes, targets, self._clock, chooser, self._reverse, self.counters)

    @contextmanager
    def costing(self) -> Iterator[None]:
        """Counts from zero, and takes the time, while an answer is made."""
        self.counters.reset()
        started = time.monotonic()
        try:
            yield
        finally:
            self.counters.elapsed_s = time.monotonic() - started

    def index_for(self, purpose: str) -> GuardedIndex:
        """The index, to ask about the recordings of the question.

        Args:
            purpose: What it is needed for, if it is not to be had.

        Raises:
            DatabaseError: MongoDB is away.
            IndexChangedError: Another process removes documents of these recordings.
        """
        return self.store.index_for(purpose, self._recordings())

    def pieces(self, plan: Plan) -> Iterator[Piece]:
        """The plan's messages, thinned out and limited."""
        if self._limit == 0:
            return
        is_long = self._limit is None or self._limit > _HANDFUL
        pieces = Sweep(plan, self.store.segment, ahead=is_long).pieces()
        if self.is_unthinned:
            for piece in pieces:
                count_given(plan.counters, piece.batch)
                yield piece
            return
        taken = given = 0
        for piece in pieces:
            count = len(piece.batch)
            rows = np.arange((-taken) % self._every, count, self._every)
            taken += count
            if self._limit is not None:
                rows = rows[: self._limit - given]
            given += len(rows)
            kept = piece if len(rows) == count else Piece(piece.batch.take(rows), piece.seq[rows])
            count_given(plan.counters, kept.batch)
            if len(rows):
                yield kept
            if self._limit is not None and given >= self._limit:
                break

    def _filter(self, extra: Mapping[str, object]) -> dict[str, object]:
        # Asked for once a range of time, so that a long list of values is not copied each time.
        filters = (extra, *(predicate.query for predicate in self._predicates))
        return _all_of([dict(part) for part in filters if part])

    def _choose(self, tasks: Sequence[Task]) -> Chosen:
        """Ask the index which messages of some chunks satisfy the predicate."""
        from hybridlog.frames.bson import reference_columns

        index = self.index_for("A predicate")
        low, high = min(t.first for t in tasks), max(t.last for t in tasks)
        wanted = {t.key for t in tasks}
        found: dict[tuple[str, int, int], list[NDArray[np.int64]]] = {}
        recordings = sorted({t.key[0] for t in tasks})
        bounds = {
            "_id": {"$gte": key_bound(low), "$lt": key_bound(high + 1)},
        }
        for topic in self.topics:
            for recording in recordings:
                query = self._filter({**bounds, "_meta.rec": recording[:16]})
                # With the order MongoDB weighs the range against an index of the user's.
                for raw in index.find_raw(
                    collection_of(topic), query, _REFERENCE, sort=[("_id", 1)]
                ):
                    reference = reference_columns(raw)
                    self.counters.documents_read += len(reference.off)
                    places = np.stack([reference.seg, reference.chunk], axis=1)
                    groups, inverse = np.unique(places, axis=0, return_inverse=True)
                    for number, (segment, chunk) in enumerate(groups.tolist()):
                        key = (recording, segment, chunk)
                        if key in wanted:
                            rows = inverse.reshape(-1) == number
                            found.setdefault(key, []).append(reference.off[rows])
        return {key: np.sort(np.concatenate(parts)) for key, parts in found.items()}

    def conditions(
        self, recording: RecordingEntry, window: tuple[int, int] | None = None
    ) -> dict[str, object]:
        """The query's time range in one recording, or in a part of it, as a MongoDB filter.

        Args:
            recording: Which.
            window: Log time `[begin, end)`, ns, within the range of `between`.
        """
        bounds = self._bounds_in(recording)
        conditions: dict[str, object] = {"_meta.rec": recording.key}
        if bounds is not None and self._clock != "log":
            name = STAMP if self._clock == "header" else "_meta.pub"
            conditions[name] = {"$gte": bounds[0], "$lt": bounds[1]}
            bounds = None
        span = window or bounds
        if span is not None:
            conditions["_id"] = {"$gte": key_bound(span[0]), "$lt": key_bound(span[1])}
        return conditions

    def _parts(self, targets: Sequence[Target]) -> list[dict[str, object]]:
        """MongoDB filters that together find what is wanted, each in order after the other.

        A collection is read in one sweep when all times are wanted, and else a window at a
        time: windows of several recordings that overlap in time go together.
        """
        if self._windows is None:
            conditions = [self.conditions(target.recording) for target in targets]
            return [_any_of(conditions)] if conditions else []
        found: list[tuple[int, int, RecordingEntry]] = []
        for target in targets:
            bounds = target.bounds if self._clock == "log" else None
            windows = self._windows_in(target.recording, bounds or (0, TIME_LIMIT - 1))
            found.extend((*window, target.recording) for window in windows)
        groups: list[list[dict[str, object]]] = []
        reach = -1
        for begin, end, recording in sorted(found, key=lambda item: item[:2]):
            if begin >= reach:
                groups.append([])
            groups[-1].append(self.conditions(recording, (begin, end)))
            reach = max(reach, end)
        parts = [_any_of(group) for group in groups]
        return parts[::-1] if self._reverse else parts

    def _count_again(self) -> int:
        """What `_count` says, asked once more when another process has changed the index."""
        try:
            return self._count()
        except IndexChangedError:
            there = {recording.id for recording in self.store.recordings()}
            if not there.issuperset(self.recording_ids):
                raise
        return self._count()

    def _count(self) -> int:
        self.counters.reset()
        if self._predicates:
            self.store.database_for("A predicate")
        is_plain = not self._predicates and self.is_by_log_time
        # A question about topics and log times alone asks no server.
        has_index = not is_plain and self.store.database is not None
        total, left = 0, list(self.topics)
        if has_index and not is_plain:
            total, left = count_in_columns(self, self.topics)
            if not left:
                return total
        lanes: list[Lane] = []
        targets = self._targets(lanes, with_chunks=not has_index and not is_plain)
        if is_plain and self.is_unbounded:
            return sum(
                channel.stats.messages
                for target in targets
                for channel in target.recording.channels
                if channel.id in target.lanes
            )
        if is_plain:
            return sum(map(self._count_between, targets))
        if not has_index:
            plan = Plan(lanes, targets, self._clock, None, self._reverse, self.counters)
            return sum(len(p.batch) for p in Sweep(plan, self.store.segment).unordered())
        wanted = [(topic, t) for topic in left for t in targets if topic in _topics_of(t)]
        if not self.is_unbounded:
            return total + self._count_documents(wanted)
        of_topic: dict[str, list[RecordingEntry]] = {}
        for topic, target in wanted:
            of_topic.setdefault(topic, []).append(target.recording)
        return total + sum(
            in_all_times(self.store, topic, recordings, self.filter)
            for topic, recordings in of_topic.items()
        )

    def _count_between(self, target: Target) -> int:
        """Messages of one recording in the range of log time, whatever is in them."""
        topics = set(_topics_of(target))
        counted = topics
        if self.store.connected is not None:
            counted = {topic for topic in topics if _has_full_chunks(target.recording, topic)}
        total = 0
        try:
            total = self._count_in_chunks(target, counted)
        except SegmentError:
            if self.store.database is None:
                raise
            counted = set()  # the index knows it without the segment
        others = sorted(topics - counted)
        if not others:
            return total
        found, left = count_in_columns(self._with(recording_ids=(target.recording.id,)), others)
        total += found
        if not left:
            return total
        try:
            return total + self._count_documents([(topic, target) for topic in left])
        except IndexChangedError:  # the segments know it without the index
            return total + self._count_in_chunks(target, set(left))

    def _count_in_chunks(self, target: Target, topics: set[str]) -> int:
        """The same of some topics, without the index."""
        channels = [c.id for c in target.recording.channels if c.topic in topics]
        if not channels:
            return 0
        windows = self._windows_in(target.recording, target.bounds or (0, TIME_LIMIT - 1))
        return count_in_chunks(
            self._chunks(target.recording, channels, target.bounds, target.windows),
            set(channels),
            np.array(windows, np.int64).reshape(-1, 2),
            partial(self.store.segment, target.recording.id),
            self.counters,
        )

    def _count_documents(self, wanted: Sequence[tuple[str, Target]]) -> int:
        """What the index has of topics of recordings in the range, where the predicate holds."""
        filters = [
            (collection_of(topic), self._filter(part))
            for topic, target in wanted
            for part in self._parts([target])
        ]
        return sum(self.index_for("An index").count_each(filters))

    def thinned_documents(
        self, topic: str, projection: Mapping[str, object] | None
    ) -> Iterator[tuple[bytes, NDArray[np.intp], int]]:
        """The index documents of one topic, in key order, as raw batches.

        Yields:
            BSON documents one after the other, which of them the answer has, and how many
            documents came before them.
        """
        from hybridlog_storage.bson_columns import split

        index = self.index_for("Reading index documents")
        lanes: list[Lane] = []
        self.counters.reset()
        found = self._targets(lanes, with_chunks=False)
        targets = [t for t in found if topic in _topics_of(t)]
        started = time.monotonic()
        taken = given = 0
        collection, order = collection_of(topic), -1 if self._reverse else 1
        parts = [self._filter(part) for part in self._parts(targets)]
        # A limit ends the reading between two parts, so they are asked for one by one.
        one_by_one = self._limit is not None or len(parts) == 1
        for asked in [[part] for part in parts] if one_by_one else [parts]:
            most = 0 if self._limit is None else self._limit - given
            for raw in (
                index.find_raw(
                    collection,
                    asked[0],
                    projection,
                    # With an index of the user's, documents come in its order unless told.
                    sort=[("_id", order)],
                    limit=most if self._every == 1 else 0,
                    batch_size=_BATCH,
                )
                if one_by_one
                else index.find_each(collection, asked, projection, order=order, batch_size=_BATCH)
            ):
                count = len(split(raw))
                rows = np.arange((-taken) % self._every, count, self._every)
                if self._limit is not None:
                    rows = rows[: self._limit - given]
                given += len(rows)
                self.counters.documents_read += count
                self.counters.elapsed_s = time.monotonic() - started
                yield raw, rows, taken
                taken += count
                if self._limit is not None and given >= self._limit:
                    return


def _topics_of(target: Target) -> list[str]:
    return sorted({c.topic for c in target.recording.channels if c.id in target.lanes})


def _has_full_chunks(recording: RecordingEntry, topic: str) -> bool:
    """Whether entries of chunks are much fewer than the messages of a topic, and all there."""
    if recording.status == "open":
        return False
    stats = recording.stats_of(topic)
    first = min((s.first for s in stats if s.first is not None), default=0)
    last = max((s.last for s in stats if s.last is not None), default=0)
    chunks = (last - first) / max(1, *(s.longest for s in stats)) + 1
    return sum(s.messages for s in stats) > _FEW * chunks


def _all_of(filters: list[dict[str, object]]) -> dict[str, object]:
    if not filters:
        return {}
    return filters[0] if len(filters) == 1 else {"$and": filters}


def _any_of(filters: list[dict[str, object]]) -> dict[str, object]:
    return filters[0] if len(filters) == 1 else {"$or": filters}


def _as_dict(counters: Counters) -> dict[str, float]:
    return {name: getattr(counters, name) for name in counters.__dataclass_fields__}


def _is_field(path: str, known: Mapping[str, str]) -> bool:
    if is_summary(path, known):
        return True
    return any(p == path or p.startswith((f"{path}.", f"{path}[")) for p in known)


def _no_field(path: str, known: Mapping[str, str], topics: Sequence[str]) -> str:
    near = difflib.get_close_matches(path, known, n=5, cutoff=0.4) or sorted(known)[:10]
    return (
        f"There is no field {path!r} on {', '.join(topics)}. Did you mean {', '.join(near)}? "
        "`hybridlog schema TOPIC` lists them all."
    )
