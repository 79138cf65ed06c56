"""Reads chunks in order of log time and yields their messages in order.

Chunks are sorted by the log time at which they begin. The scan reads each once, in that
order, and yields a message as soon as no later chunk can hold an earlier one. The order
(log time, recording, arrival) is total; memory is bounded by the chunks that overlap in
time.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from msgspec import Struct, field

from hybridlog.query.question import Counters
from hybridlog_storage.errors import StoreError
from hybridlog_storage.messages import distinct, interleave, order_of
from hybridlog_storage.stopping import check_wanted
from hybridlog_storage.times import inside, placed, touches

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.chunk_columns import Chunk
    from hybridlog.query.question import Clock, Part, RecordedChannel, Span
    from hybridlog.session import Session
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.messages import Batch
    from hybridlog_storage.segments.chunk import StoredChunk

_LOOK_AHEAD = 4
_MIN_THREADED_BYTES = 4 << 20  # starting threads takes as long as reading a megabyte
_FETCHED_BYTES = 16 << 20  # asked for at once, where each request takes long
_MERGED_BYTES = 1 << 20  # messages of small chunks are together up to this size

ChunkKey = tuple[str, int, int]
"""Recording id, segment number, chunk number in the segment."""


class RecordingScan(Struct, frozen=True):
    """The chunks of a recording to read for some channels: their ids and places in the plan.

    `windows` are of log time: int64[n, 2], apart and in order; `bounds` are of the plan's clock.
    None is all times, ns.
    """

    recording: RecordingEntry
    channels: Mapping[int, int]
    bounds: Span | None
    chunks: Sequence[Chunk]
    windows: NDArray[np.int64] | None = None


class ChunkTask(Struct, frozen=True):
    """A chunk to read, and the messages wanted from it."""

    scan: RecordingScan
    chunk: Chunk

    @property
    def key(self) -> ChunkKey:
        """Location of the chunk."""
        return self.scan.recording.id, self.chunk.segment, self.chunk.number


class MessageRun(Struct, frozen=True):
    """Messages in order.

    Attributes:
        batch: The messages; `channel` is the index of each message's channel in `channels`.
        seq: int64[n], arrival numbers in their recordings.
    """

    batch: Batch
    seq: NDArray[np.int64]
    channels: Sequence[RecordedChannel]

    def take(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> MessageRun:
        """The chosen rows."""
        return MessageRun(self.batch.take(rows), self.seq[rows], self.channels)


class ScanPlan(Struct):
    """Everything to read, in order.

    Attributes:
        filters: By index of a channel the part whose predicate is asked of each message.
        offsets: Payload offsets of the other messages that are wanted, by chunk; int64[k].
        is_chosen: Only messages with offsets, or which a filter accepts, are wanted.
        reverse: Latest message first.
        counters: Count what is read.
    """

    channels: list[RecordedChannel]
    scans: list[RecordingScan]
    clock: Clock = "log"
    filters: Mapping[int, Part] = field(default_factory=dict)
    offsets: Mapping[ChunkKey, NDArray[np.int64]] = field(default_factory=dict)
    is_chosen: bool = False
    reverse: bool = False
    counters: Counters = field(default_factory=Counters)

    def tasks(self) -> list[ChunkTask]:
        """The chunks to read, in the order of the scan."""
        found = [
            ChunkTask(scan, chunk)
            for scan in self.scans
            for chunk in scan.chunks
            if scan.windows is None or touches(scan.windows, chunk.first, chunk.last)
        ]
        if self.is_chosen:
            found = [task for task in found if task.key in self.offsets or self.filtered(task)]
        if self.reverse:
            return sorted(found, key=lambda t: (-t.chunk.last, t.key))
        return sorted(found, key=lambda t: (t.chunk.first, t.key))

    def filtered(self, task: ChunkTask) -> list[int]:
        """Indexes of the channels on whose messages in a chunk filters decide."""
        own = task.scan.channels
        held = (own[channel] for channel in task.chunk.place.channels if channel in own)
        return [index for index in held if index in self.filters]


def with_payloads(run: MessageRun, counters: Counters) -> MessageRun:
    """The messages without those that have no payload, which are counted."""
    gone = [number for number, channel in enumerate(run.channels) if channel.is_reduced]
    if not gone:
        return run
    for number in gone:
        left = int((run.batch.channel == number).sum())
        counters.leave_out(left, run.channels[number].state)
    return run.take(~np.isin(run.batch.channel, gone))


class ChunkScan:
    """Executes a plan; reading `ahead` is unnecessary for a caller that takes few messages.

    One who looks around in a log `keeps` chunks in the cache. Their buffers are read-only.
    """

    def __init__(
        self,
        plan: ScanPlan,
        session: Session,
        *,
        ahead: bool = True,
        keeps: bool = False,
    ) -> None:
        self._plan = plan
        self._session = session
        self._reads_ahead = ahead and not keeps
        self._keeps = keeps

    def runs(self) -> Iterator[MessageRun]:
        """All messages, in order."""
        started = time.monotonic()
        plan = self._plan
        waiting: list[MessageRun] = []
        ready: list[MessageRun] = []
        size = 0
        try:
            for _, run, following in self.loaded():
                if len(run.batch):
                    waiting.append(run)
                now, waiting = self._split(waiting, following)
                ready += now
                size += sum(len(one.batch.buffer) for one in now)
                # Decoding each small chunk by itself costs more than copying it.
                if ready and (size >= _MERGED_BYTES or not self._reads_ahead):
                    plan.counters.elapsed_s = time.monotonic() - started
                    yield in_order(ready, plan)
                    ready, size = [], 0
            if ready:
                yield in_order(ready, plan)
        finally:
            plan.counters.elapsed_s = time.monotonic() - started

    def loaded(self) -> Iterator[tuple[ChunkTask, MessageRun, ChunkTask | None]]:
        """Each chunk, its wanted messages, and the chunk after it."""
        tasks = self._plan.tasks()
        size = sum(task.chunk.place.length for task in tasks)
        if size < _MIN_THREADED_BYTES or not self._reads_ahead:
            yield from self._ahead(tasks, lambda task: partial(self._load, task))
            return
        with ThreadPoolExecutor(2, thread_name_prefix="hybridlog-read") as pool:
            try:
                yield from self._ahead(tasks, lambda task: pool.submit(self._load, task).result)
            finally:
                pool.shutdown(cancel_futures=True)

    def _ahead(
        self, tasks: list[ChunkTask], start: Callable[[ChunkTask], Callable[[], _Loaded]]
    ) -> Iterator[tuple[ChunkTask, MessageRun, ChunkTask | None]]:
        counters = self._plan.counters
        upcoming = iter(tasks)
        if self._session.directory.is_remote:
            upcoming = self._announced(upcoming)
        loading: deque[tuple[ChunkTask, Callable[[], _Loaded]]] = deque()
        while True:
            while len(loading) < _LOOK_AHEAD:
                wanted = next(upcoming, None)
                if wanted is None:
                    break
                loading.append((wanted, start(wanted)))
            if not loading:
                return
            check_wanted()
            task, loaded = loading.popleft()
            run, chunk, unreadable, expired = loaded()
            if not self._keeps:
                counters.add_chunk(chunk)
            counters.unreadable += unreadable
            counters.without_arrays += expired
            yield task, run, loading[0][0] if loading else None

    def _announced(self, tasks: Iterator[ChunkTask]) -> Iterator[ChunkTask]:
        """The same, after a bucket was asked for many of them at once."""
        room = _FETCHED_BYTES if self._reads_ahead else _MERGED_BYTES
        while group := list(_up_to(tasks, room)):
            by_segment: dict[tuple[str, int], list[ChunkTask]] = {}
            for task in group:
                by_segment.setdefault(task.key[:2], []).append(task)
            for own in by_segment.values():
                reader = self._session.segment(own[0].scan.recording, own[0].chunk.segment)
                reader.fetch([task.chunk.place for task in own])
            yield from group

    def _load(self, task: ChunkTask) -> _Loaded:
        segment, place = task.chunk.segment, task.chunk.place
        if self._keeps:
            count = self._plan.counters.add_chunk
            chunk = self._session.chunk(task.scan.recording, segment, place, count)
        else:
            chunk = self._session.read_chunk(task.scan.recording, segment, place)
        undecided = self._plan.filtered(task)
        run = self._wanted(task, chunk, undecided)
        run, unreadable, expired = self._filtered(run, undecided)
        return run, chunk, unreadable, expired

    def _wanted(
        self,
        task: ChunkTask,
        chunk: StoredChunk,
        undecided: Sequence[int],
    ) -> MessageRun:
        batch, seq = chunk.batch, chunk.seq
        table = np.full(int(batch.channel.max()) + 1, -1, np.int32)
        for channel_id, index in task.scan.channels.items():
            if channel_id < len(table):
                table[channel_id] = index
        if batch.left is not None and not {*task.chunk.place.channels} & {*task.scan.channels}:
            raise StoreError(
                f"Payloads of recording {task.scan.recording.name!r} were deleted while it was "
                "read. Ask again."
            )
        channel = table[batch.channel]
        mask = channel >= 0
        if self._plan.is_chosen:
            offsets = self._plan.offsets.get(task.key, np.empty(0, np.int64))
            mask &= np.isin(channel, undecided) | np.isin(batch.places[0], offsets)
        bounds = task.scan.bounds
        if bounds is not None:
            mask &= self._inside(batch, channel, mask, bounds)
        windows = task.scan.windows
        if windows is not None:
            mask &= inside(batch.log_time, windows)
        if mask.all() and not self._keeps:
            batch.channel = channel
            return MessageRun(batch, seq, self._plan.channels)
        rows = np.flatnonzero(mask)
        own = batch.take(rows)
        own.channel = channel[rows]
        return MessageRun(own, seq[rows], self._plan.channels)

    def _filtered(self, run: MessageRun, undecided: Sequence[int]) -> tuple[MessageRun, int, int]:
        """The messages that satisfy the predicate, and numbers as of `matches`."""
        if not undecided or not len(run.batch):
            return run, 0, 0
        holds = np.ones(len(run.batch), np.bool_)
        unreadable = expired = 0
        from hybridlog.query.predicate.evaluate import matches

        for index in distinct(run.batch.channel).tolist():
            if index in undecided:
                rows = np.flatnonzero(run.batch.channel == index)
                channel = self._plan.channels[index]
                part = self._plan.filters[index]
                holds[rows], lacking, gone = matches(
                    part, channel, run.batch.take(rows), run.seq[rows]
                )
                unreadable, expired = unreadable + lacking, expired + gone
        return (run if holds.all() else run.take(holds)), unreadable, expired

    def _inside(
        self,
        batch: Batch,
        channel: NDArray[np.int32],
        mask: NDArray[np.bool_],
        bounds: Span,
    ) -> NDArray[np.bool_]:
        begin, end = bounds
        if self._plan.clock == "log":
            times = batch.log_time
        elif self._plan.clock == "publish":
            times = batch.publish_time
        else:
            from hybridlog.schema.codec import stamps_of

            times = np.zeros(len(batch), np.int64)
            has_stamp = np.zeros(len(batch), np.bool_)
            for index in distinct(channel[mask]).tolist():
                rows = np.flatnonzero(mask & (channel == index))
                stamped, stamps = stamps_of(self._plan.channels[index].codec, batch.take(rows))
                times[rows[stamped]], has_stamp[rows[stamped]] = stamps, True
            mask = mask & has_stamp
        times = placed(times)
        return mask & (times >= begin) & (times < end)

    def _split(
        self, waiting: list[MessageRun], following: ChunkTask | None
    ) -> tuple[list[MessageRun], list[MessageRun]]:
        """The messages that no later chunk can precede, and the rest."""
        if following is None:
            return waiting, []
        ready, rest = [], []
        for run in waiting:
            times = run.batch.log_time
            now = (
                times > following.chunk.last
                if self._plan.reverse
                else times < following.chunk.first
            )
            if now.all():
                ready.append(run)
            elif now.any():
                ready.append(run.take(now))
                rest.append(run.take(~now))
            else:
                rest.append(run)
        return ready, rest


def _up_to(tasks: Iterator[ChunkTask], room: int) -> Iterator[ChunkTask]:
    """The next chunks, until they have so many bytes."""
    for task in tasks:
        yield task
        room -= task.chunk.place.length
        if room <= 0:
            return


_Loaded = tuple[MessageRun, "StoredChunk", int, int]
"""Messages and their chunk, messages unreadable for the predicate, those of them that expired."""


def in_order(runs: list[MessageRun], plan: ScanPlan) -> MessageRun:
    """Merge runs, sorted by log time, recording and arrival."""
    keys = np.array([int(channel.recording.key, 16) for channel in plan.channels], np.uint64)
    times = np.concatenate([r.batch.log_time for r in runs])
    channels = np.concatenate([r.batch.channel for r in runs])
    seq = np.concatenate([r.seq for r in runs])
    order = order_of(times, keys[channels], seq)
    if order is None and len(runs) == 1 and not plan.reverse:
        return runs[0]
    if order is None:
        order = np.arange(len(times))
    if plan.reverse:
        order = order[::-1]
    if len(runs) == 1:
        return runs[0].take(order)
    return MessageRun(interleave([r.batch for r in runs], order), seq[order], plan.channels)
