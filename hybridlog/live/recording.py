"""Recording messages as they come, from any number of threads.

`LiveRecording.write` lays a large message into its chunk at once, and only puts a small
one down; one thread of the recording's own takes those that have come since it looked
last, lays them into chunks together and sees old chunks closed. The index has the lowest
rank: while messages come faster than they can be written, it waits, and makes up for it
from the segments. So what bounds a recording is the disk, and what bounds its memory is
the budget: when that is spent, `write` waits.
"""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from operator import index as index_of
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np

from hybridlog.capture import Capture, Pace
from hybridlog.live.budget import LEAST_ASKED_FOR, usual_budget
from hybridlog.live.collector import spared_objects
from hybridlog.live.policy import SMALL
from hybridlog.live.provision import Provision
from hybridlog.live.turns import Turns
from hybridlog.losses import Cause, Ledger
from hybridlog.processors import processors
from hybridlog.recorder import RecordReport
from hybridlog_storage.copying import COPIED_AT_ONCE
from hybridlog_storage.errors import DatabaseError, DiskFullError, HybridlogError, UsageError
from hybridlog_storage.messages import Channel, LooseBatch, Schema
from hybridlog_storage.segment_format import LOSSES_METADATA, json_metadata
from hybridlog_storage.segment_writer import AT_WORK, PACKERS, SegmentSettings

if TYPE_CHECKING:
    from types import TracebackType

    from hybridlog_storage.catalog import Catalog
    from hybridlog_storage.database import Database
    from hybridlog_storage.directory import StoreDirectory
    from hybridlog_storage.messages import Buffer

_LARGE = 1 << 17  # bytes from which a payload is laid down at once
_MOST_LAID = 8 << 20  # bytes that are laid down together: then whoever waits for room hears of it
_ENOUGH = 4 << 20  # bytes that are worth waking the writing thread for: each batch has its price
_TICK_S = 0.1  # the writing thread looks so often when little comes, or it has no batches
_FEW = 10  # messages for a chunk: below it, laid down one by one they cost less than as a batch
_FLUSHED = 0.95  # of the flush interval, when chunks are closed: then they are written
_PATIENCE = 4  # flush intervals for which chunks of few messages wait to be indexed together,
_PATIENCE_S = 4.0  # and seconds at most
_LARGE_AT_WORK = 3  # large chunks on their way without anything being late: two packed, one written
_MAKING_S = 2.0  # that packing, writing, making documents and sending them may take
_HURRY = 8 << 20  # bytes that wait from which only what shrinks to little is compressed
_BEHIND = 32 << 20  # and from which the index waits: what it has let go it must read again
_COPYING = 2  # threads that copy large messages at the same time
_NO_TURN = nullcontext()
_CALM_S = 1.0  # both for so long afterwards, or they would be the cause of the next delay
_LATE_S = 0.01  # a large message that waits so long to be laid down is late: both happen, too,
_LATE_TIMES = 20  # for so many times as long as it has waited
_LOOK_S = 0.25  # how often one looks how much comes
_MOST_NS = 1 << 63


@dataclass(frozen=True, slots=True)
class LiveOptions:
    """How to record what comes.

    Attributes:
        tags: Kept with the recording.
        source: What its messages come from, as the catalog shows it.
        budget_bytes: Payload bytes that may be in memory, not written yet.
        flush_interval_s: Seconds after which a message is in the segment at the latest:
            what a `kill -9` can cost.
        settings: How segments are cut and packed.
    """

    tags: Mapping[str, str] = field(default_factory=dict)
    source: Mapping[str, Any] = field(default_factory=dict)
    budget_bytes: int = field(default_factory=usual_budget)
    flush_interval_s: float = 1.0
    settings: SegmentSettings = field(default_factory=SegmentSettings)

    def __post_init__(self) -> None:
        if self.budget_bytes < LEAST_ASKED_FOR:
            raise UsageError("the memory budget must be at least 1 MiB")
        if not 0 < self.flush_interval_s <= 3600:
            raise UsageError("the flush interval must lie between 0 and 3600 seconds")


class _Message(NamedTuple):
    channel: int
    log_time: int
    publish_time: int
    sequence: int
    payload: Buffer


class _Strain:
    """Whether more waits to be written than a bound, or did a moment ago."""

    def __init__(self, bound: int) -> None:
        self._bound = bound
        self._calm = 0.0

    def go_on(self, seconds: float) -> None:
        """Be felt for some time, whatever waits to be written."""
        self._calm = max(self._calm, time.monotonic() + seconds)

    def is_felt(self, unwritten: int) -> bool:
        if unwritten > self._bound:
            self.go_on(_CALM_S)
        return time.monotonic() < self._calm


class LiveRecording:
    """A recording that messages are written to as they come.

    What whoever writes could not take, or had to give up, is noted in `ledger`; its rows
    are written into the segments with the messages.

    Get one from `Store.start`. As a context manager it is closed at the end of the
    block, after an error too: what was received is worth keeping.

    Args:
        directory: The store.
        catalog: Its catalog.
        database: The index.
        name: Name of the recording.
        options: How.
        renew: Gives another connection to the index when one has failed.
        on_close: Called with the report when the recording has come to its end.
    """

    def __init__(
        self,
        directory: StoreDirectory,
        catalog: Catalog,
        database: Database,
        name: str,
        options: LiveOptions,
        *,
        renew: Callable[[], Database],
        on_close: Callable[[RecordReport], None],
    ) -> None:
        self._options = options
        self._small_bound = options.budget_bytes * 5 // 4
        self._on_close = on_close
        self._started = time.monotonic()
        self._ids: dict[Channel, int] = {}
        self._channels: list[Channel] = []
        self._taken: list[int] = []  # messages, by index of the channel
        self._inbox: deque[_Message] = deque()
        self._inbox_bytes = 0
        self._worth_waking = min(_ENOUGH, options.budget_bytes // 4)
        self._taken_bytes = 0  # taken, and not laid into a chunk yet
        self._beyond = 0  # bytes closed beyond those, as last counted; `write` asks each time
        self._lock = threading.Lock()
        self._room = threading.Condition(self._lock)
        self._laying = threading.Lock()  # held by who lays into chunks, and taken before `_lock`
        self._turns = Turns(_COPYING)
        # No event: who is interrupted while setting one may leave it locked for ever.
        self._calls: SimpleQueue[None] = SimpleQueue()
        self._ended = False
        self._closing = threading.RLock()
        self._is_closing = False
        self._hurry = _Strain(_HURRY)
        self._behind = _Strain(_BEHIND)
        self._failure: BaseException | None = None
        self._report: RecordReport | None = None
        self.ledger = Ledger()
        """What is missing from this recording."""
        self.cut_off: Counter[str] = Counter()
        """Messages that were taken and found no room on the disk, by topic; known at the end."""
        self._provision = Provision(options.settings.chunk_size, options.budget_bytes)
        self._held = ExitStack()
        with self._held:
            self._held.enter_context(spared_objects)
            self._capture = Capture(
                directory,
                catalog,
                database,
                name=name,
                tags=options.tags,
                source={"path": "", "kind": "live", "profile": "", "bytes": 0, **options.source},
                settings=options.settings,
                pace=Pace(
                    hurry=lambda: self._is_under(self._hurry),
                    behind=lambda: self._is_under(self._behind),
                    has_room=self._provision.has_room,
                    next_chunk_size=self._provision.next_chunk_size,
                    spare=threading.BoundedSemaphore(_spare_processors()),
                    on_written=self._make_room,
                    renew=renew,
                ),
            )
            self._held = self._held.pop_all()
        self.id = self._capture.entry.id
        """Recording id."""
        self.label = self._capture.entry.label
        """Name of the recording's directory."""
        self._thread = threading.Thread(target=self._run, name="hybridlog-record", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        """The recording itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close it, unless that was tried already."""
        with self._closing:
            if not self._is_closing:
                self.close()

    def expect(self, *channels: Channel) -> None:
        """Prepare for channels before their first message.

        To understand a definition and to make a collection takes some ten milliseconds
        each, which are better spent while nothing comes yet.

        Raises:
            UsageError: A channel cannot be stored, or the recording was closed.
            DiskFullError: As `write` does.
        """
        with self._lock:
            self._check()
            for channel in channels:
                _check_channel(channel)
                self._capture.index.prepare(channel)

    def write(
        self,
        channel: Channel,
        payload: Buffer,
        *,
        log_time: int | None = None,
        publish_time: int | None = None,
        sequence: int = 0,
        wait: bool = True,
    ) -> bool:
        """Take a message; waits while the memory budget is spent. Thread safe.

        Args:
            channel: The same object for all messages of a channel.
            payload: The serialized message, of any size: bytes, or memory that holds some and
                must not change afterwards.
            log_time: When it was received, ns since the epoch; None for now.
            publish_time: When it was sent, ns since the epoch; None for the log time, which
                is what a channel without publish times has.
            sequence: The sender's number, 0 to 2³²-1.
            wait: False to refuse the message instead of waiting for the budget. Messages of
                up to `SMALL` bytes may go beyond it by a quarter: fields land when payloads
                cannot.

        Returns:
            Whether it was taken.

        Raises:
            UsageError: The payload is not bytes, the channel cannot be stored, a number is not
                whole or out of its range, or the recording was closed.
            DiskFullError: No space; what was flushed before stays.
        """
        # Found out later, it would end the recording of everything else.
        if type(payload) is not bytes:
            payload = _held_fast(payload)
        try:
            now = time.time_ns() if log_time is None else index_of(log_time)
            sent = now if publish_time is None else index_of(publish_time)
            sequence = index_of(sequence)
        except TypeError as error:
            raise UsageError(
                f"a time or the sequence number of a message is no whole number: {error}"
            ) from error
        if not (0 <= now < _MOST_NS and 0 <= sent < _MOST_NS and 0 <= sequence < 1 << 32):
            raise UsageError("a time or the sequence number of a message is out of its range")
        size = len(payload)
        # Ctrl-C may come at any place of the main thread, and a chunk has no half messages.
        at_once = size >= _LARGE and threading.current_thread() is not threading.main_thread()
        with self._lock:
            bound = self._small_bound if size <= SMALL else self._options.budget_bytes
            while (unwritten := self._taken_bytes + self._beyond) and unwritten + size > bound:
                self._check()
                if not wait:
                    return False
                self._wake()
                self._room.wait()
            self._room.notify()  # there may be room for another
            self._check()
            index = self._ids.get(channel) if isinstance(channel, Channel) else None
            if index is None:
                _check_channel(channel)
                index = self._ids[channel] = len(self._channels)
                self._channels.append(channel)
                self._taken.append(0)
            message = _Message(index, now, sent, sequence, payload)
            self._taken[index] += 1
            self._taken_bytes += size
            if not at_once:
                self._inbox.append(message)
                self._inbox_bytes += size
            enough = self._inbox_bytes >= self._worth_waking
        if at_once:
            self._lay_now(message)
        elif enough:
            self._wake()
        return True

    @property
    def filled(self) -> float:
        """How much of the memory budget is spent, 0 to 1."""
        # An open chunk counts when it is closed, and may then be more than there is room for.
        return min(self._unwritten() / self._options.budget_bytes, 1.0)

    @property
    def stored(self) -> tuple[int, int]:
        """Messages that were laid into chunks, and the bytes of their payloads."""
        totals = self._capture.writer.totals
        return totals.messages, totals.payload_bytes

    @property
    def lag(self) -> int:
        """Messages that are not in the index yet."""
        return max(self._capture.writer.totals.messages - self._capture.index.indexed, 0)

    @property
    def index_failure(self) -> HybridlogError | None:
        """Why the index does not go on, None while it does."""
        return self._capture.index.failure

    @property
    def failure(self) -> BaseException | None:
        """Why nothing more can be taken, None while it can."""
        return self._failure

    def close(self) -> RecordReport:
        """Write, index and seal everything; tells how the recording went.

        On a full disk what was flushed is sealed, and the rest is in the ledger. Thread safe;
        who closes it once more gets the same report.

        Raises:
            DiskFullError: There is no room even for that; what was flushed before stays, and
                the next opening of the store seals it.
            UsageError: To close it has failed before, or the same thread does it already, as
                where a signal is handled meanwhile.
        """
        with self._closing:
            if self._report is None:
                self._end()
                self._report = self._close_once()
                self._on_close(self._report)
            return self._report

    def _end(self) -> None:
        """Begin to close or to abort, by who holds `_closing`; that is done once."""
        if self._is_closing:
            raise UsageError(
                f"The recording {self.label!r} is being closed, or that was broken off; the next "
                "opening of the store seals what was flushed."
            )
        self._is_closing = True
        self._stop()

    def _close_once(self) -> RecordReport:
        with self._held:
            try:
                end = {"status": "complete", "losses": []}
                if isinstance(self._failure, DiskFullError):
                    failure = self._capture.give_up(end, self._cut_off())
                elif self._failure is not None:
                    raise self._failure
                else:
                    failure = self._close_whole(end)
            except BaseException:
                self._capture.leave()
                raise
        index = self._capture.index
        return RecordReport(
            self._capture.entry,
            [],
            index.indexed,
            index.missed,
            failure,
            0,
            time.monotonic() - self._started,
        )

    def _close_whole(self, end: Mapping[str, Any]) -> DatabaseError | None:
        """Write everything; on a disk that is full only now, what there is room for."""
        try:
            return self._capture.close(end)
        except DiskFullError:
            return self._capture.give_up(end, self._cut_off())

    def _cut_off(self) -> list[dict[str, Any]]:
        """Rows of the ledger, with what was taken and is in no file."""
        now = time.time_ns()
        for channel, taken in zip(self._channels, self._taken, strict=True):
            count = taken - self._capture.writer.written_of(channel)
            if count:
                self.cut_off[channel.topic] += count
                self.ledger.note(
                    channel.topic,
                    Cause.DISK,
                    count,
                    first=min(self._capture.writer.last_log_time, now),
                    last=now,
                    detail="the disk was full",
                )
        return self.ledger.take(everything=True)

    def abort(self) -> None:
        """Take the whole recording back.

        Raises:
            UsageError: It was closed, or is being closed.
        """
        with self._closing:
            self._end()
            with self._held:
                self._capture.forget()

    def _closed_beyond(self) -> int:
        """Bytes in closed chunks beyond those at work."""
        usual = AT_WORK * self._options.settings.chunk_size
        at_work = max(usual, _LARGE_AT_WORK * self._provision.chunk_size)
        return max(self._capture.writer.waiting - at_work, 0)

    def _unwritten(self) -> int:
        """Bytes that wait: taken and not laid down, or in chunks beyond those at work."""
        return self._taken_bytes + self._closed_beyond()

    def _make_room(self, laid: int = 0) -> None:
        """See how much waits now that a chunk was closed or written, or so much was laid down."""
        with self._lock:
            self._taken_bytes -= laid
            self._beyond = self._closed_beyond()
            self._room.notify()

    def _wake(self) -> None:
        """See that the writing thread looks."""
        if self._calls.empty():
            self._calls.put(None)

    def _check(self) -> None:
        if self._failure is not None:
            raise self._failure
        if self._ended:
            raise UsageError(f"The recording {self.label!r} was closed.")

    def _is_under(self, strain: _Strain) -> bool:
        return strain.is_felt(self._unwritten()) and not self._ended

    def _stop(self) -> None:
        # Who lays down a message at this moment has it in the recording.
        with self._laying, self._lock:
            self._ended = True
            self._room.notify_all()
        self._wake()
        self._thread.join()
        self._provision.close()

    def _run(self) -> None:
        """What the writing thread does."""
        flushed = told = looked = time.monotonic()
        seen = 0
        interval = self._options.flush_interval_s
        tick = min(_TICK_S, interval / 10)
        with suppress(BaseException), self._failing():
            while True:
                with suppress(Empty):
                    self._calls.get(timeout=tick)
                ended = self._ended
                with self._laying:
                    self._take()
                    if ended:
                        self._write_losses(everything=True)
                        return
                    now = time.monotonic()
                    if now - flushed >= tick:
                        # As late as can be: of slow topics a chunk costs more than what is in
                        # it. What is laid down has waited for a tick, and does so once more.
                        self._capture.writer.flush_older(interval * _FLUSHED - 2 * tick)
                        self._make_room()
                        flushed = now
                    if now - told >= interval / 4:
                        self._write_losses()
                        self._capture.index.nudge(_patience(interval))
                        told = now
                if now - looked >= _LOOK_S:
                    stored = self._capture.writer.totals.payload_bytes
                    self._provision.look((stored - seen) / (now - looked))
                    looked, seen = now, stored

    @contextmanager
    def _failing(self) -> Iterator[None]:
        """Whatever goes wrong: those who write and close must hear of it, or wait for ever."""
        try:
            yield
        except BaseException as error:
            with self._lock:
                self._failure = self._failure or error
                self._room.notify_all()
            raise

    def _write_losses(self, *, everything: bool = False) -> None:
        rows = self.ledger.take(everything=everything)
        if rows:
            self._capture.writer.add_extra(json_metadata(LOSSES_METADATA, {"rows": rows}))

    def _lay_now(self, message: _Message) -> None:
        """Lay a message into its chunk, and before it what has come before it.

        By the thread that brings it: handed on, it would wait in memory of its own, and new
        memory is what a machine may be slow to give. What takes long to copy goes by turns,
        a few at a time: many that run leave those that write the chunks no turn at the
        interpreter.
        """
        # What is copied at once keeps the interpreter, and others with it, until it is laid.
        turn = self._turns if len(message.payload) >= COPIED_AT_ONCE else _NO_TURN
        since = time.monotonic()
        try:
            with turn:
                with self._laying:
                    self._be_on_time(time.monotonic() - since)
                    self._check()
                    with self._failing():
                        self._take()
                        copy = self._place(message)
                copy()
        except BaseException:
            with self._lock:
                self._taken[message.channel] -= 1
            raise
        finally:
            self._make_room(len(message.payload))

    def _be_on_time(self, waited: float) -> None:
        """Spare the processors and the disk when a message has waited long to be laid down."""
        if waited > _LATE_S:
            for strain in (self._hurry, self._behind):
                strain.go_on(min(_LATE_TIMES * waited, _CALM_S))

    def _take(self) -> None:
        """Lay what was put down into chunks; by who holds `_laying`."""
        with self._lock:
            inbox, size = self._inbox, self._inbox_bytes
            self._inbox, self._inbox_bytes = deque(), 0
        if inbox:
            for group in [inbox] if size <= _MOST_LAID else _groups(inbox):
                self._make_room(self._lay_down(group))

    def _lay_down(self, group: Sequence[_Message]) -> int:
        """Give some messages to the writer; returns the bytes of their payloads."""
        if len(group) >= _FEW * self._count_chunks(group):
            batch = _batch(group)
            self._capture.writer.append(batch, self._channels)
            return batch.payload_bytes
        for message in group:
            self._place(message)()
        return sum(len(message.payload) for message in group)

    def _count_chunks(self, group: Sequence[_Message]) -> int:
        """In how many chunks some messages will lie, about."""
        channels = [self._channels[index] for index in {message.channel for message in group}]
        return self._capture.writer.count_chunks(channels)

    def _place(self, message: _Message) -> Callable[[], None]:
        """Give a message its place in a chunk; what comes back copies it there."""
        return self._capture.writer.place_one(
            self._channels[message.channel],
            message.payload,
            message.log_time,
            message.publish_time,
            message.sequence,
        )


def _spare_processors() -> int:
    """For what can wait: one is left to those that bring messages, if it can be."""
    return min(PACKERS + 1, max(processors() - 1, 1))


def _held_fast(payload: object) -> memoryview:
    """What is no plain `bytes`, so that it cannot be resized or released until it is laid down."""
    if isinstance(payload, bytes | bytearray | memoryview):
        held = memoryview(payload)
        if held.c_contiguous and held.ndim == 1 and held.format == "B":
            return held
    kind = type(payload).__name__
    raise UsageError(f"the payload of a message is a {kind}, and must be bytes")


def _check_channel(channel: object) -> None:
    """Refuse what no segment could hold."""
    if not isinstance(channel, Channel):
        raise UsageError(f"{channel!r} is no Channel")
    schema = channel.schema
    if not (schema is None or isinstance(schema, Schema)):
        raise UsageError(f"the schema of the channel {channel.topic!r} is no Schema")
    if schema is not None and not isinstance(schema.data, bytes):
        kind = type(schema.data).__name__
        raise UsageError(f"the schema of the channel {channel.topic!r} is a {kind}, not bytes")
    if not isinstance(channel.metadata, Mapping):
        raise UsageError(f"the metadata of the channel {channel.topic!r} is no mapping")
    texts = [channel.topic, channel.message_encoding, *channel.metadata, *channel.metadata.values()]
    if schema is not None:
        texts += [schema.name, schema.encoding]
    for text in texts:
        if not isinstance(text, str):
            raise UsageError(f"the channel {channel.topic!r} has {text!r} where text must be")
        try:
            text.encode()
        except UnicodeEncodeError as error:
            raise UsageError(
                f"the channel {channel.topic!r} has {text!r}, which UTF-8 cannot hold"
            ) from error


def _patience(flush_interval_s: float) -> float:
    """Seconds for which chunks of few messages may wait to be indexed together."""
    return min(_PATIENCE * flush_interval_s, _PATIENCE_S)


def indexed_within_s(flush_interval_s: float) -> float:
    """Seconds after which an index that keeps up has a message, at the latest."""
    return flush_interval_s + _patience(flush_interval_s) + _MAKING_S


def _groups(inbox: deque[_Message]) -> Iterator[Sequence[_Message]]:
    """Take messages that are laid down together; those before them are forgotten."""
    while inbox:
        group = [inbox.popleft()]
        size = len(group[0].payload)
        while inbox and size < _MOST_LAID:
            group.append(inbox.popleft())
            size += len(group[-1].payload)
        yield group


def _batch(messages: Sequence[_Message]) -> LooseBatch:
    channel, log_time, publish_time, sequence, payloads = zip(*messages, strict=True)
    return LooseBatch(
        np.fromiter(payloads, np.object_, len(payloads)),
        np.fromiter(map(len, payloads), np.int64, len(payloads)),
        np.array(channel, np.int32),
        np.array(log_time, np.int64),
        np.array(publish_time, np.int64),
        np.array(sequence, np.uint32),
    )
