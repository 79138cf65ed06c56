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
from itertools import groupby
from operator import attrgetter, itemgetter
from typing import TYPE_CHECKING

import numpy as np
from msgspec import Struct, field

from hybridlog.query.question import Counters, Part, RecordedChannel
from hybridlog_storage.errors import StoreError
from hybridlog_storage.messages import Batch, distinct, interleave, order_of
from hybridlog_storage.stopping import check_wanted
from hybridlog_storage.times import inside, touches

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.chunk_columns import Chunk
    from hybridlog.session import Session
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.segments.chunk import StoredChunk

_LOOK_AHEAD = 4
_MIN_THREADED_BYTES = 4 << 20  # starting threads takes as long as reading a megabyte
_FETCHED_BYTES = 16 << 20  # asked for at once, where each request takes long
_MERGED_BYTES = 1 << 20  # messages of small chunks are together up to this size

ChunkKey = tuple[str, int, int]
"""Recording id, segment number, chunk number in the segment."""


class RecordingScan(Struct, frozen=True):
    """The chunks of a recording to read for some channels: their ids and places in the scan.

    `windows` are of log time, ns: int64[n, 2], apart and in order; None is all times.
    """

    recording: RecordingEntry
    channels: Mapping[int, int]
    chunks: Sequence[Chunk]
    windows: NDArray[np.int64] | None = None


class _Task(Struct, frozen=True):
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
        holds: bool[n], where the predicate holds; None for messages of which all do.
    """

    batch: Batch
    seq: NDArray[np.int64]
    channels: Sequence[RecordedChannel]
    holds: NDArray[np.bool_] | None = None

    def take(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> MessageRun:
        """The chosen rows."""
        holds = None if self.holds is None else self.holds[rows]
        return MessageRun(self.batch.take(rows), self.seq[rows], self.channels, holds)


_Loaded = tuple[MessageRun, "StoredChunk", int, int]
"""Messages and their chunk, messages unreadable for the predicate, those of them that expired."""


def with_payloads(run: MessageRun, counters: Counters) -> MessageRun:
    """The messages without those that have no payload, which are counted."""
    gone = [number for number, channel in enumerate(run.channels) if channel.is_reduced]
    if not gone:
        return run
    for number in gone:
        left = int((run.batch.channel == number).sum())
        counters.leave_out(left, run.channels[number].state)
    return run.take(~np.isin(run.batch.channel, gone))


class ChunkScan(Struct):
    """Everything to read, in order.

    Attributes:
        filters: By index of a channel the part whose predicate is asked of each message.
        offsets: Payload offsets of the other messages that are wanted, by chunk; int64[k].
        is_chosen: Only messages with offsets, or which a filter accepts, are wanted.
        marks: Messages that a filter does not accept are there, too: `MessageRun.holds` tells.
        reverse: Latest message first.
        ahead: Read ahead, which is unnecessary for a caller that takes few messages.
        keeps: Keep chunks in the cache, for one who looks around. Their buffers are read-only.
        counters: Count what is read.
    """

    session: Session
    channels: Sequence[RecordedChannel]
    scans: Sequence[RecordingScan]
    counters: Counters
    filters: Mapping[int, Part] = field(default_factory=dict)
    offsets: Mapping[ChunkKey, NDArray[np.int64]] = field(default_factory=dict)
    is_chosen: bool = False
    marks: bool = False
    reverse: bool = False
    ahead: bool = True
    keeps: bool = False

    def runs(self) -> Iterator[MessageRun]:
        """All messages, in order."""
        started = time.monotonic()
        waiting: list[MessageRun] = []
        ready: list[MessageRun] = []
        size = 0
        try:
            for run, following in self.loaded():
                if len(run.batch):
                    waiting.append(run)
                now, waiting = self._split(waiting, following)
                ready += now
                size += sum(len(one.batch.buffer) for one in now)
                # Decoding each small chunk by itself costs more than copying it.
                if ready and (size >= _MERGED_BYTES or self.keeps or not self.ahead):
                    self.counters.elapsed_s = time.monotonic() - started
                    yield in_order(ready, reverse=self.reverse)
                    ready, size = [], 0
            if ready:
                yield in_order(ready, reverse=self.reverse)
        finally:
            self.counters.elapsed_s = time.monotonic() - started

    def loaded(self) -> Iterator[tuple[MessageRun, Chunk | None]]:
        """The wanted messages of each chunk, and the chunk after it."""
        tasks, counters = self._tasks(), self.counters
        is_large = sum(task.chunk.place.length for task in tasks) >= _MIN_THREADED_BYTES
        upcoming = self._announced(tasks) if self.session.directory.is_remote else iter(tasks)
        loading: deque[tuple[_Task, Callable[[], _Loaded]]] = deque()
        pool = ThreadPoolExecutor(2, thread_name_prefix="hybridlog-read")
        try:
            while True:
                while len(loading) < _LOOK_AHEAD and (task := next(upcoming, None)) is not None:
                    is_early = is_large and self.ahead and not self.keeps
                    load = partial(self._load, task)
                    loading.append((task, pool.submit(load).result if is_early else load))
                if not loading:
                    return
                check_wanted()
                run, chunk, unreadable, expired = loading.popleft()[1]()
                if not self.keeps:
                    counters.add_chunk(chunk)
                counters.unreadable += unreadable
                counters.without_arrays += expired
                yield run, loading[0][0].chunk if loading else None
        finally:
            pool.shutdown(cancel_futures=True)

    def _tasks(self) -> list[_Task]:
        """The chunks to read, in the order of the scan."""
        found = [
            _Task(scan, chunk)
            for scan in self.scans
            for chunk in scan.chunks
            if scan.windows is None or touches(scan.windows, chunk.first, chunk.last)
        ]
        if self.is_chosen:
            found = [task for task in found if task.key in self.offsets or self._filtering(task)]
        if self.reverse:
            return sorted(found, key=lambda t: (-t.chunk.last, t.key))
        return sorted(found, key=lambda t: (t.chunk.first, t.key))

    def _filtering(self, task: _Task) -> list[int]:
        """Indexes of the channels on whose messages in a chunk filters decide."""
        own = task.scan.channels
        held = (own[channel] for channel in task.chunk.place.channels if channel in own)
        return [index for index in held if index in self.filters]

    def _announced(self, tasks: Sequence[_Task]) -> Iterator[_Task]:
        """The chunks, after a bucket was asked for many of them at once."""
        room = _FETCHED_BYTES if self.ahead and not self.keeps else _MERGED_BYTES
        ends = np.cumsum([task.chunk.place.length for task in tasks]) // room
        for _, numbered in groupby(zip(ends.tolist(), tasks, strict=True), itemgetter(0)):
            group = [task for _, task in numbered]
            for segment, own in groupby(
                sorted(group, key=attrgetter("key")), lambda task: task.key[:2]
            ):
                places = [(task.scan.recording, task.chunk.place) for task in own]
                reader = self.session.segment(places[0][0], segment[1])
                reader.fetch([place for _, place in places])
            yield from group

    def _load(self, task: _Task) -> _Loaded:
        segment, place = task.chunk.segment, task.chunk.place
        if self.keeps:
            count = self.counters.add_chunk
            chunk = self.session.chunk(task.scan.recording, segment, place, count)
        else:
            chunk = self.session.read_chunk(task.scan.recording, segment, place)
        filtering = self._filtering(task) if self.filters else []
        run = self._wanted(task, chunk, filtering)
        run, unreadable, expired = self._filtered(run, filtering)
        return run, chunk, unreadable, expired

    def _wanted(self, task: _Task, chunk: StoredChunk, filtering: Sequence[int]) -> MessageRun:
        batch, scan = chunk.batch, task.scan
        table = np.full(int(batch.channel.max()) + 1, -1, np.int32)
        for channel_id, index in scan.channels.items():
            if channel_id < len(table):
                table[channel_id] = index
        if batch.left is not None and not {*task.chunk.place.channels} & {*scan.channels}:
            raise StoreError(
                f"Payloads of recording {scan.recording.name!r} were deleted while it was "
                "read. Ask again."
            )
        channel = table[batch.channel]
        mask = channel >= 0
        if self.is_chosen:
            offsets = self.offsets.get(task.key, np.empty(0, np.int64))
            mask &= np.isin(channel, filtering) | np.isin(batch.places[0], offsets)
        if scan.windows is not None:
            mask &= inside(batch.log_time, scan.windows)
        if mask.all() and not self.keeps:
            batch.channel = channel
            return MessageRun(batch, chunk.seq, self.channels)
        rows = np.flatnonzero(mask)
        own = batch.take(rows)
        own.channel = channel[rows]
        return MessageRun(own, chunk.seq[rows], self.channels)

    def _filtered(self, run: MessageRun, filtering: Sequence[int]) -> tuple[MessageRun, int, int]:
        """The messages that satisfy the predicate, and numbers as of `matches`."""
        holds = np.ones(len(run.batch), np.bool_)
        unreadable = expired = 0
        for index in {*filtering}.intersection(distinct(run.batch.channel).tolist()):
            from hybridlog.query.predicate.evaluate import matches

            rows = np.flatnonzero(run.batch.channel == index)
            own = run.take(rows)
            found = matches(self.filters[index], self.channels[index], own.batch, own.seq)
            holds[rows], lacking, gone = found
            unreadable, expired = unreadable + lacking, expired + gone
        if self.marks:
            run = MessageRun(run.batch, run.seq, run.channels, holds)
        elif not holds.all():
            run = run.take(holds)
        return run, unreadable, expired

    def _split(
        self, waiting: list[MessageRun], following: Chunk | None
    ) -> tuple[list[MessageRun], list[MessageRun]]:
        """The messages that no later chunk can precede, and the rest."""
        if following is None:
            return waiting, []
        ready, rest = [], []
        for run in waiting:
            times = run.batch.log_time
            now = times > following.last if self.reverse else times < following.first
            if now.all():
                ready.append(run)
            elif now.any():
                ready.append(run.take(now))
                rest.append(run.take(~now))
            else:
                rest.append(run)
        return ready, rest


def in_order(runs: Sequence[MessageRun], *, reverse: bool = False) -> MessageRun:
    """Merge runs of equal channels, sorted by log time, recording and arrival."""
    channels = runs[0].channels
    keys = np.array([int(channel.recording.key, 16) for channel in channels], np.uint64)
    times = np.concatenate([r.batch.log_time for r in runs])
    of = np.concatenate([r.batch.channel for r in runs])
    seq = np.concatenate([r.seq for r in runs])
    order = order_of(times, keys[of], seq)
    if order is None and len(runs) == 1 and not reverse:
        return runs[0]
    if order is None:
        order = np.arange(len(times))
    if reverse:
        order = order[::-1]
    if len(runs) == 1:
        return runs[0].take(order)
    marked = [r.holds for r in runs if r.holds is not None]
    holds = np.concatenate(marked)[order] if marked else None
    return MessageRun(interleave([r.batch for r in runs], order), seq[order], channels, holds)
