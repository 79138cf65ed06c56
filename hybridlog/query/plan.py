"""From a question to chunks, and from chunks to messages in order.

A plan is a list of chunks sorted by the log time at which they begin. The sweep loads
them in that order, each once, and gives out every message as soon as no chunk still to
come can hold an earlier one: the order (log time, recording, arrival) is total, and
memory is bounded by the chunks that overlap in time.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import TYPE_CHECKING, Literal, Protocol

import numpy as np

from hybridlog.query.times import TIME_LIMIT
from hybridlog.schema.column import STAMP, header_stamps
from hybridlog_storage.chunk import StoredChunk
from hybridlog_storage.copying import interleave, joined
from hybridlog_storage.distinct import distinct
from hybridlog_storage.messages import REDUCED
from hybridlog_storage.segment_reader import SegmentReader

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.schema.codec import Codec
    from hybridlog_storage.catalog import ChunkEntry, RecordingEntry
    from hybridlog_storage.messages import Batch, Channel

Clock = Literal["log", "publish", "header"]
_LOOK_AHEAD = 4
_WORTH_THREADS = 4 << 20  # bytes; starting threads takes as long as reading a megabyte
_SMALL = 128 << 10  # bytes of a chunk that is copied in less time than it is decoded by itself
_TOGETHER = 1 << 20  # bytes of small chunks that are decoded at once


@dataclass(slots=True)
class Counters:
    """What answering a question has cost.

    Attributes:
        messages: Messages given out.
        payload_bytes: Bytes of their payloads.
        bytes_read: Bytes read from segments.
        chunks_read: Chunks read and decompressed.
        documents_read: Index documents that came from MongoDB.
        reduced: Messages left out because only their fields were kept.
        elapsed_s: Wall time, seconds.
    """

    messages: int = 0
    payload_bytes: int = 0
    bytes_read: int = 0
    chunks_read: int = 0
    documents_read: int = 0
    reduced: int = 0
    elapsed_s: float = 0.0

    def reset(self) -> None:
        """Count from zero."""
        self.messages = self.payload_bytes = self.bytes_read = self.chunks_read = 0
        self.documents_read = self.reduced = 0
        self.elapsed_s = 0.0

    def add(self, other: Counters) -> None:
        """Take in what a part of the answer has cost; the time is that of the whole."""
        self.messages += other.messages
        self.payload_bytes += other.payload_bytes
        self.bytes_read += other.bytes_read
        self.chunks_read += other.chunks_read
        self.documents_read += other.documents_read
        self.reduced += other.reduced


def count_given(counters: Counters, batch: Batch) -> None:
    """Messages were given out."""
    counters.messages += len(batch)
    counters.payload_bytes += batch.payload_bytes


@dataclass(frozen=True)
class Lane:
    """One channel of one recording that a question is about.

    Attributes:
        recording: Its recording.
        channel_id: Its id there.
        channel: Topic, type and so on.
    """

    recording: RecordingEntry
    channel_id: int
    channel: Channel

    @cached_property
    def codec(self) -> Codec:
        """Reads its payloads; of a hundred definitions a question needs one or two."""
        from hybridlog.schema.codec import codec_for

        return codec_for(self.channel)

    @property
    def is_reduced(self) -> bool:
        """Whether it carries what is left of messages whose payload was given up."""
        return self.channel.message_encoding == REDUCED


@dataclass(frozen=True, slots=True)
class Target:
    """What is wanted of one recording.

    Attributes:
        recording: The recording.
        lanes: Index of each wanted channel in the plan's lanes, by channel id.
        bounds: `[begin, end)`, ns, of the plan's clock; None for all times.
        chunks: The chunks that may hold it.
        windows: int64[n, 2], `[begin, end)` of log time, apart and in order: only messages
            in one of them; None for all.
    """

    recording: RecordingEntry
    lanes: Mapping[int, int]
    bounds: tuple[int, int] | None
    chunks: Sequence[ChunkEntry]
    windows: NDArray[np.int64] | None = None

    def touches(self, first: int, last: int) -> bool:
        """Whether a chunk may have messages in a window.

        Args:
            first: Log time of its first message, ns.
            last: Log time of its last message, ns.
        """
        if self.windows is None:
            return True
        place = int(np.searchsorted(self.windows[:, 1], first, "right"))
        return place < len(self.windows) and bool(self.windows[place, 0] <= last)


ChunkKey = tuple[str, int, int]
"""Recording id, number of the segment, number of the chunk in it."""

Chosen = Mapping[ChunkKey, "NDArray[np.int64]"]
"""Payload offsets (`_meta.ref.off`) of the chosen messages of each chunk, sorted."""

Chooser = Callable[[Sequence["Task"]], Chosen]
"""Asks the index which messages of some chunks satisfy the predicate."""


@dataclass(frozen=True, slots=True)
class Task:
    """A chunk to be read, and what is wanted from it."""

    target: Target
    chunk: ChunkEntry
    first: int
    last: int
    messages: int

    @property
    def key(self) -> ChunkKey:
        """Where the chunk lies."""
        return self.target.recording.id, self.chunk.segment, self.chunk.number


@dataclass(frozen=True, slots=True)
class Piece:
    """Messages in order.

    Attributes:
        batch: The messages; `channel` is the index of each message's lane.
        seq: int64[n], arrival numbers in their recordings.
    """

    batch: Batch
    seq: NDArray[np.int64]


@dataclass(slots=True)
class Plan:
    """A question, resolved.

    Attributes:
        lanes: Every channel it is about.
        targets: What is wanted of each recording.
        clock: Which time the bounds are about.
        chooser: The predicate, None without.
        reverse: Latest first.
    """

    lanes: list[Lane]
    targets: list[Target]
    clock: Clock = "log"
    chooser: Chooser | None = None
    reverse: bool = False
    counters: Counters = field(default_factory=Counters)

    def tasks(self) -> list[Task]:
        """The chunks to read, in the order in which the sweep takes them."""
        found = []
        for target in self.targets:
            for chunk in target.chunks:
                span = chunk.span(target.lanes)
                if span is not None and target.touches(*span):
                    count = sum(s.messages for c, s in chunk.stats.items() if c in target.lanes)
                    found.append(Task(target, chunk, *span, count))
        if self.reverse:
            return sorted(found, key=lambda t: (-t.last, t.key))
        return sorted(found, key=lambda t: (t.first, t.key))


class Sweep:
    """Carries out a plan.

    Args:
        plan: What to read.
        reader_of: Gives the reader of a segment, by recording id and number.
        ahead: Whether to read ahead; not worth it for who takes a few messages and leaves.
    """

    def __init__(
        self,
        plan: Plan,
        reader_of: Callable[[str, int], SegmentReader],
        *,
        ahead: bool = True,
    ) -> None:
        self._plan = plan
        self._reader_of = reader_of
        self._reads_ahead = ahead

    def pieces(self) -> Iterator[Piece]:
        """All messages, in order; whoever gives them out counts them."""
        started = time.monotonic()
        plan = self._plan
        waiting: list[Piece] = []
        try:
            for piece, following in self._loaded():
                if len(piece.batch):
                    waiting.append(piece)
                ready, waiting = self._split(waiting, following)
                if ready:
                    whole = _in_order(ready, plan)
                    plan.counters.elapsed_s = time.monotonic() - started
                    yield whole
        finally:
            plan.counters.elapsed_s = time.monotonic() - started

    def unordered(self) -> Iterator[Piece]:
        """All messages, a large chunk or many small ones at a time: for tables."""
        plan = self._plan
        started = time.monotonic()
        small: list[Piece] = []
        size = 0
        for piece, _ in self._loaded():
            count_given(plan.counters, piece.batch)
            if not len(piece.batch):
                continue
            length = len(piece.batch.buffer)
            if small and (length > _SMALL or size + length > _TOGETHER):
                yield _together(small)
                small, size = [], 0
            if length > _SMALL:
                yield piece
                continue
            small.append(piece)
            size += length
        if small:
            yield _together(small)
        plan.counters.elapsed_s = time.monotonic() - started

    def _chosen(self, tasks: list[Task]) -> Iterator[tuple[Task, NDArray[np.int64] | None]]:
        """Leave out the chunks in which nothing satisfies the predicate."""
        chooser = self._plan.chooser
        if chooser is None:
            yield from ((task, None) for task in tasks)
            return
        for group in _groups(tasks):
            chosen = chooser(group)
            for task in group:
                offsets = chosen.get(task.key)
                if offsets is not None and len(offsets):
                    yield task, offsets

    def _loaded(self) -> Iterator[tuple[Piece, Task | None]]:
        """The wanted messages of each chunk, and the chunk after it."""
        tasks = self._plan.tasks()
        size = sum(task.chunk.length for task in tasks)
        if size < _WORTH_THREADS or not self._reads_ahead:
            yield from self._ahead(tasks, lambda *item: _Later(partial(self._load, *item)))
            return
        with ThreadPoolExecutor(2, thread_name_prefix="hybridlog-read") as pool:
            try:
                yield from self._ahead(tasks, lambda *item: pool.submit(self._load, *item))
            finally:
                pool.shutdown(cancel_futures=True)

    def _ahead(
        self,
        tasks: list[Task],
        start: Callable[[Task, NDArray[np.int64] | None], _Loading],
    ) -> Iterator[tuple[Piece, Task | None]]:
        counters = self._plan.counters
        loading: deque[tuple[Task, _Loading]] = deque()
        upcoming = self._chosen(tasks)
        while True:
            while len(loading) < _LOOK_AHEAD:
                item = next(upcoming, None)
                if item is None:
                    break
                loading.append((item[0], start(*item)))
            if not loading:
                return
            piece, size = loading.popleft()[1].result()
            counters.chunks_read += 1
            counters.bytes_read += size
            yield piece, loading[0][0] if loading else None

    def _load(self, task: Task, offsets: NDArray[np.int64] | None) -> tuple[Piece, int]:
        entry = task.chunk
        reader = self._reader_of(task.target.recording.id, entry.segment)
        chunk = reader.read_chunk(entry.place)
        return self._wanted(task, chunk, offsets), chunk.length + chunk.trailer

    def _wanted(self, task: Task, chunk: StoredChunk, offsets: NDArray[np.int64] | None) -> Piece:
        batch, seq = chunk.batch, chunk.seq
        lanes = task.target.lanes
        table = np.full(int(batch.channel.max()) + 1, -1, np.int32)
        for channel_id, lane in lanes.items():
            if channel_id < len(table):
                table[channel_id] = lane
        lane_of = table[batch.channel]
        mask = lane_of >= 0
        if offsets is not None:
            at = np.minimum(np.searchsorted(offsets, batch.offset), len(offsets) - 1)
            mask &= offsets[at] == batch.offset
        bounds = task.target.bounds
        if bounds is not None:
            mask &= self._inside(batch, lane_of, mask, bounds)
        windows = task.target.windows
        if windows is not None:
            place = np.searchsorted(windows[:, 1], batch.log_time, "right")
            begins = np.append(windows[:, 0], TIME_LIMIT - 1)
            mask &= begins[place] <= batch.log_time
        if mask.all():
            batch.channel = lane_of
            return Piece(batch, seq)
        rows = np.flatnonzero(mask)
        own = batch.take(rows)
        own.channel = lane_of[rows]
        return Piece(own, seq[rows])

    def _inside(
        self,
        batch: Batch,
        lane_of: NDArray[np.int32],
        mask: NDArray[np.bool_],
        bounds: tuple[int, int],
    ) -> NDArray[np.bool_]:
        begin, end = bounds
        if self._plan.clock == "log":
            times = batch.log_time
        elif self._plan.clock == "publish":
            times = batch.publish_time
        else:
            times = np.full(len(batch), -1, np.int64)
            for lane in distinct(lane_of[mask]).tolist():
                rows = np.flatnonzero(mask & (lane_of == lane))
                part = batch.take(rows)
                decoded = self._plan.lanes[lane].codec.columns(
                    part.buffer, part.offset, part.length, {STAMP}
                )
                stamps = header_stamps(decoded.records)
                if stamps is not None:
                    times[rows[decoded.rows]] = stamps
        return (times >= begin) & (times < end)

    def _split(
        self, waiting: list[Piece], following: Task | None
    ) -> tuple[list[Piece], list[Piece]]:
        """What no chunk still to come can precede, and the rest."""
        if following is None:
            return waiting, []
        ready, rest = [], []
        for piece in waiting:
            times = piece.batch.log_time
            now = times > following.last if self._plan.reverse else times < following.first
            if now.all():
                ready.append(piece)
            elif now.any():
                ready.append(_rows(piece, now))
                rest.append(_rows(piece, ~now))
            else:
                rest.append(piece)
        return ready, rest


class _Loading(Protocol):
    """A chunk on its way."""

    def result(self) -> tuple[Piece, int]: ...


@dataclass(slots=True)
class _Later:
    """A chunk that is read when it is asked for."""

    load: Callable[[], tuple[Piece, int]]

    def result(self) -> tuple[Piece, int]:
        return self.load()


def _rows(piece: Piece, rows: NDArray[np.bool_] | NDArray[np.intp]) -> Piece:
    return Piece(piece.batch.take(rows), piece.seq[rows])


def _together(pieces: list[Piece]) -> Piece:
    """Several pieces as one: to decode each by itself costs more than to copy it."""
    return Piece(joined([p.batch for p in pieces]), np.concatenate([p.seq for p in pieces]))


def _in_order(pieces: list[Piece], plan: Plan) -> Piece:
    """Put pieces into one, sorted by log time, recording and arrival."""
    if len(pieces) == 1 and not plan.reverse and _is_in_order(pieces[0]):
        return pieces[0]
    keys = np.array([int(lane.recording.key, 16) for lane in plan.lanes], np.uint64)
    times = np.concatenate([p.batch.log_time for p in pieces])
    lanes = np.concatenate([p.batch.channel for p in pieces])
    seq = np.concatenate([p.seq for p in pieces])
    order = np.lexsort((seq, keys[lanes], times))
    if plan.reverse:
        order = order[::-1]
    if len(pieces) == 1:
        return _rows(pieces[0], order)
    return Piece(interleave([p.batch for p in pieces], order), seq[order])


def _is_in_order(piece: Piece) -> bool:
    """Whether a piece of one chunk is sorted; its log times alone can tell mostly."""
    return bool((piece.batch.log_time[1:] > piece.batch.log_time[:-1]).all())


def _groups(tasks: list[Task], most: int = 50_000) -> Iterator[list[Task]]:
    """Runs of chunks that are asked about in one query."""
    group: list[Task] = []
    messages = 0
    for task in tasks:
        group.append(task)
        messages += task.messages
        if messages >= most:
            yield group
            group, messages = [], 0
    if group:
        yield group
