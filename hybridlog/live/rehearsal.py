"""Rehearses a trigger: what it would have kept of what is stored.

The rules are those of `Snapshots`: a message that fires starts a snapshot, or prolongs the
one that is being written. A snapshot has the messages from `before` the first of these, with
the latched ones in force there, up to `after` the last. It ends when a message comes that is
not earlier. The ring is taken to hold all of the time before.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hybridlog.live.snapshots import Trigger
from hybridlog.query.answers.lost import completeness_of
from hybridlog.query.counters import Counters
from hybridlog.query.intervals import Intervals
from hybridlog.query.latching import depth_of, publisher_of
from hybridlog.query.planner import Planner
from hybridlog.query.predicate.types import check
from hybridlog.query.question import Question
from hybridlog.query.ranges import RangeResolver
from hybridlog.query.times import TIME_LIMIT, DurationLike, parse_duration, parse_time
from hybridlog.wording import listed
from hybridlog_storage.errors import StoreError, TimeError, TopicError, WhereError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.question import Part, RecordedChannel
    from hybridlog.query.times import TimeLike
    from hybridlog.session import Session


@dataclass(frozen=True, slots=True)
class Rehearsal:
    """The snapshots that a trigger would have kept.

    Attributes:
        trigger: Its text.
        recordings: Number of recordings that it was rehearsed on.
        fired: Number of messages that satisfy it.
        snapshots: A recording that it would have written each; `messages` are those in it.
        payload_bytes: Payload bytes in all of these; what is in two counts twice.
        stored_bytes: Payload bytes of these recordings.
        remarks: Topics on which it can never fire, and why; what the recordings may lack.
        counters: What the answer has cost.
    """

    trigger: str
    recordings: int
    fired: int
    snapshots: Intervals
    payload_bytes: int
    stored_bytes: int
    remarks: tuple[str, ...]
    counters: Counters

    @property
    def messages(self) -> int:
        """Messages in all snapshots; what is in two counts twice."""
        return sum(snapshot.messages for snapshot in self.snapshots)


class _Sizes(NamedTuple):
    """Messages of one topic of one recording.

    Attributes:
        time: int64[n], log times, ns, ascending.
        length: int64[n], payload bytes.
        channel: int64[n], ids of channels.
    """

    time: NDArray[np.int64]
    length: NDArray[np.int64]
    channel: NDArray[np.int64]


def rehearse(
    session: Session,
    text: str,
    *,
    recordings: tuple[str, ...] | None = None,
    since: TimeLike | None = None,
    before: DurationLike = "10s",
    after: DurationLike = 0,
) -> Rehearsal:
    """The snapshots that a trigger would have kept; see `Store.rehearse`."""
    started = time.monotonic()
    trigger = Trigger.of(text)
    before_ns, after_ns = parse_duration(before), parse_duration(after)
    topics = tuple(topic for topic in session.topics() if trigger.fits(topic))
    if not topics:
        raise TopicError(f"No topic of the store matches the trigger {text!r}.")
    counters = Counters()
    remarks: list[str] = []
    able = [topic for topic in topics if _can_fire(session, trigger, topic, remarks)]
    everything = Question(*session.having(session.topics(), recordings))
    held = {*session.snapshot().topics_at(session.chosen(everything))}
    if held.isdisjoint(topics):
        remarks.append(f"No recording that was asked has {listed(topics)}.")
    if since is not None:
        everything = replace(everything, bounds=(_begin(since), TIME_LIMIT - 1))
    parts = []
    fired = payload = stored = count = 0
    try:
        resolved = list(RangeResolver(session, everything).resolve())
    except TimeError:
        resolved = []
    planner = Planner(session, replace(everything, predicate=trigger.predicate), counters)
    for one in resolved:
        entry = session.entry_of(one.summary)
        count += 1
        stored += sum(channel.stats.payload_bytes for channel in entry.channels)
        within = list(planner.parts_in(one.summary, one.bounds, None))
        found = [np.empty(0, np.int64)]
        for part in [part for part in within if part.topic in able]:
            found += [o.log_time[o.holds] for o in planner.outcomes(part)]
        times = np.sort(np.concatenate(found))
        fired += len(times)
        spans = snapshot_spans(times, before_ns, after_ns)
        if not len(spans):
            continue
        messages, size = _would_store(session, counters, within, spans)
        payload += int(size.sum())
        parts.append((entry.id, np.column_stack([spans, messages])))
    remarks += completeness_of(session, everything).sentences
    counters.elapsed_s = time.monotonic() - started
    return Rehearsal(
        text,
        count,
        fired,
        Intervals.of(parts),
        payload,
        stored,
        tuple(remarks),
        counters,
    )


def snapshot_spans(times: NDArray[np.int64], before: int, after: int) -> NDArray[np.int64]:
    """Log time of the snapshots that messages at some times start or prolong.

    Args:
        times: int64[n], log times of messages that fire, ns, ascending.
        before: Time before the first message of a snapshot, ns.
        after: Time after the last one, ns.

    Returns:
        int64[k, 2], `[begin, end)`; they may overlap.
    """
    if not len(times):
        return np.empty((0, 2), np.int64)
    # A message at the end of a snapshot, or later, ends it and starts the next one.
    starts = np.flatnonzero(np.concatenate([[True], np.diff(times) >= after]))
    first = times[starts]
    last = times[np.append(starts[1:], len(times)) - 1]
    begin = np.maximum(first - before, 0)
    # The message that fires is in its snapshot, even if nothing after it is.
    end = np.maximum(np.minimum(last, TIME_LIMIT - 1 - after) + after, first + 1)
    return np.stack([begin, end], axis=1)


def _can_fire(session: Session, trigger: Trigger, topic: str, remarks: list[str]) -> bool:
    if trigger.predicate is None:
        return True
    try:
        check(trigger.predicate, session.field_types((topic,), None))
    except WhereError as error:
        remarks.append(f"It can never fire on {topic}: {error}")
        return False
    return True


def _begin(since: TimeLike) -> int:
    """A time, or how long ago it is, ns."""
    if isinstance(since, str):
        try:
            return max(time.time_ns() - parse_duration(since), 0)
        except TimeError:
            pass  # it is a time
    return parse_time(since, start=None, end=None)


def _would_store(
    session: Session, counters: Counters, parts: list[Part], spans: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Messages and payload bytes of snapshots of one recording; int64[k] each."""
    messages = np.zeros(len(spans), np.int64)
    size = np.zeros(len(spans), np.int64)
    (recording,) = {part.recording.id for part in parts}
    rows = np.column_stack([spans, np.zeros(len(spans), np.int64)])
    windows = Intervals.of([(recording, rows)]).of_recording(recording)
    for part in parts:
        count, length = _of_part(session, counters, part, spans, windows)
        messages += count
        size += length
    return messages, size


def _of_part(
    session: Session,
    counters: Counters,
    part: Part,
    spans: NDArray[np.int64],
    windows: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Messages and payload bytes of one topic in snapshots; int64[k] each."""
    depths = {c.channel_id: depth_of(c.channel) for c in part.channels}
    near = None if any(depths.values()) else windows
    if session.table(part.recording, part.topic) is not None:
        try:
            return _within(part, depths, _from_table(session, counters, part, near), spans)
        except StoreError:
            session.reject_table(part.recording, part.topic)
    return _within(part, depths, _from_messages(session, counters, part, near), spans)


def _within(
    part: Part, depths: dict[int, int], blocks: Iterator[_Sizes], spans: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    messages = np.zeros(len(spans), np.int64)
    size = np.zeros(len(spans), np.int64)
    if any(depths.values()):
        whole = _joined(blocks)
        blocks = iter([whole])
        for publisher in {publisher_of(c.channel) for c in part.channels}:
            own = [c for c in part.channels if publisher_of(c.channel) == publisher]
            count, length = _in_force(whole, own, depths, spans[:, 0])
            messages += count
            size += length
    for block in blocks:
        if not len(block.time):
            continue
        begin = np.searchsorted(spans[:, 1], block.time[0], "right")
        end = np.searchsorted(spans[:, 0], block.time[-1], "right")
        places = np.searchsorted(block.time, spans[begin:end])
        total = np.concatenate([[0], np.cumsum(block.length)])
        messages[begin:end] += places[:, 1] - places[:, 0]
        size[begin:end] += total[places[:, 1]] - total[places[:, 0]]
    return messages, size


def _in_force(
    found: _Sizes, channels: list[RecordedChannel], depths: dict[int, int], at: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Number and bytes of the latched messages of a publisher that are in force at some times."""
    depth = max(depths[channel.channel_id] for channel in channels)
    own = np.isin(found.channel, [channel.channel_id for channel in channels])
    end = np.searchsorted(found.time[own], at)
    begin = np.maximum(end - depth, 0)
    total = np.concatenate([[0], np.cumsum(found.length[own])])
    return end - begin, total[end] - total[begin]


def _joined(blocks: Iterable[_Sizes]) -> _Sizes:
    none = np.empty(0, np.int64)
    columns = zip((none, none, none), *blocks, strict=True)
    return _Sizes(*(np.concatenate(column) for column in columns))


def _from_table(
    session: Session, counters: Counters, part: Part, windows: NDArray[np.int64] | None
) -> Iterator[_Sizes]:
    table = session.tables.of(part.recording, part.topic)
    if table is None:
        raise StoreError(f"The table of {part.topic} is missing.")
    own = ("ref", "channel")
    counters.bytes_read += table.size((), own)
    spans = None if windows is None else [(low, high) for low, high in windows.tolist()]
    for rows in table.scan((), own=own, spans=spans):
        # Of a message that was reduced there is no payload.
        length = rows.own["ref"].field("len").fill_null(0).to_numpy(zero_copy_only=False)
        channel = rows.own["channel"].to_numpy(zero_copy_only=False)
        yield _Sizes(rows.t, length.astype(np.int64), channel.astype(np.int64))


def _from_messages(
    session: Session, counters: Counters, part: Part, windows: NDArray[np.int64] | None
) -> Iterator[_Sizes]:
    name = part.recording.id
    question = Question((part.topic,), (name,))
    if windows is not None:
        rows = np.column_stack([windows, np.zeros(len(windows), np.int64)])
        question = replace(question, during=Intervals.of([(name, rows)]))
    counted = Counters()
    for run in Planner(session, question, counted).runs():
        ids = np.array([channel.channel_id for channel in run.channels], np.int64)
        batch = run.batch
        yield _Sizes(batch.log_time, batch.length.astype(np.int64), ids[batch.channel])
    counters.add(counted)
