"""Recording messages as they come, from any number of threads.

To take a message is to append it to a queue. A writing thread moves queued messages into
chunks, and closes old chunks; other threads pack and write them. The budget limits the bytes
that were taken and not written yet: when it is used up, `write` waits.
"""

from __future__ import annotations

import os
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from operator import index as index_of
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, Final, Self

import numpy as np
from msgspec import Struct, field

from hybridlog.record.losses import Cause, Ledger
from hybridlog.record.recorder import Capture, RecordReport
from hybridlog_storage.errors import DatabaseError, DiskFullError, UsageError
from hybridlog_storage.manifest import Loss
from hybridlog_storage.mcap.mcap_content import MESSAGE_HEAD
from hybridlog_storage.messages import Buffer, Channel, LooseBatch, Schema
from hybridlog_storage.segments.segment_format import losses_record
from hybridlog_storage.segments.segment_writer import SegmentSettings

if TYPE_CHECKING:
    from hybridlog.follow.child import FollowerProcess
    from hybridlog.opened import OpenStore
    from hybridlog.query.topics import TopicMatcher
    from hybridlog_storage.catalog import RecordingEntry


_WAKE_BYTES = 4 << 20  # queued bytes that wake the writing thread: a batch has a fixed cost
_TICK_S = 0.1  # interval of the writing thread when little comes
_FLUSH_AT = 0.95  # share of the flush interval after which chunks are closed
_INDEX_INTERVALS = 4  # flush intervals between two looks of the follower
_LOOK_S = 5.0  # longest time between them
_MAX_NS = 1 << 63
_SOURCE = {"path": "", "kind": "live", "profile": "", "bytes": 0}
LIVE_SETTINGS = SegmentSettings(segment_size=1 << 30, segment_span_s=600.0)
"""Live segments are short, since what is not sealed is read anew by each command."""


SMALL_BYTES = 4096
"""Messages up to this payload size stay whole: reducing them saves next to nothing."""
MIN_USER_BUDGET: Final = 1 << 20
"""Smallest budget that a user may choose, bytes."""
_MIN_BUDGET, _MAX_BUDGET = 64 << 20, 2 << 30
_MACHINE_SHARE: Final = 16


def default_budget() -> int:
    """A sixteenth of the machine's memory in bytes, from 64 MiB to 2 GiB.

    It bridges some seconds of a slow disk, and leaves memory to other programs of the robot.
    """
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return min(max(memory // _MACHINE_SHARE, _MIN_BUDGET), _MAX_BUDGET)


class LiveOptions(Struct, frozen=True):
    """Options of a live recording.

    Attributes:
        tags: Tags of the recording.
        source: Origin of the messages, as the catalog shows it.
        budget_bytes: Bytes of messages that may be in memory, not written yet.
        flush_interval_s: Seconds after which a message is in the segment at the latest. A
            `kill -9` can cost the messages of this time.
        settings: Settings of segments and chunks; segments of 1 GiB or ten minutes.
        no_index: Selects topics whose messages get no documents in MongoDB; None for none.
        is_ring: Whether files of it go while it is recorded: tables and index documents are then
            made at its end, of what is left.
    """

    tags: Mapping[str, str] = field(default_factory=dict)
    source: Mapping[str, Any] = field(default_factory=dict)
    budget_bytes: int = field(default_factory=default_budget)
    flush_interval_s: float = 1.0
    settings: SegmentSettings = LIVE_SETTINGS
    no_index: TopicMatcher | None = None
    is_ring: bool = False

    def __post_init__(self) -> None:
        if self.budget_bytes < MIN_USER_BUDGET:
            raise UsageError("the memory budget must be at least 1 MiB")
        if not 0 < self.flush_interval_s <= 3600:
            raise UsageError("the flush interval must be between 0 and 3600 seconds")


class _Taken(Struct):
    """What was taken of a channel: log times in ns."""

    index: int
    first: int
    last: int = 0
    messages: int = 0


class LiveRecording:
    """A recording that takes messages as they come.

    The caller notes lost messages in `ledger`; its rows are written into the segments with
    the messages.

    Get one from `Store.start`. As a context manager it is closed at the end of the block,
    even after an error: the received messages are worth storing.

    Args:
        shared: The open store, whose end ends the recording, too.
        follow: Starts the follower of the recording.
        name: Name of the recording.
        options: Options.
    """

    def __init__(
        self,
        shared: OpenStore,
        follow: Callable[[RecordingEntry], FollowerProcess],
        name: str,
        options: LiveOptions,
    ) -> None:
        self._process = os.getpid()
        self._shared = shared
        self._options = options
        self._small_bound = options.budget_bytes * 5 // 4
        self._started = time.monotonic()
        self._taken: dict[Channel, _Taken] = {}
        self._channels: list[Channel] = []
        self._least = _MAX_NS  # log time of all
        self._inbox: deque[tuple[int, int, int, int, Buffer]] = deque()  # number of a channel first
        self._received = 0  # bytes of all messages, with their heads
        self._moved = 0  # of those that are in chunks
        self._worth_waking = min(_WAKE_BYTES, options.budget_bytes // 4)
        self._is_tight = False  # a message found no room
        self._lock = threading.Lock()
        self._room = threading.Condition(self._lock)
        # No event: a thread that is interrupted in `set` may leave it locked forever.
        self._calls: SimpleQueue[None] = SimpleQueue()
        self._ended = False
        self._closing = threading.RLock()
        self._is_closing = False
        self.failure: BaseException | None = None
        """The error that stopped the recording, None while it works."""
        self._report: RecordReport | None = None
        self.ledger = Ledger()
        """Messages that are missing from this recording."""
        self.cut_off: Counter[str] = Counter()
        """Messages that a full disk cost, by topic; known after the end."""
        self.make_room: Callable[[], bool] = lambda: False
        """Called when the disk is full; returns whether to try again."""
        self.capture = capture = Capture(
            shared.directory,
            shared.catalog,
            follow,
            shared.newest,
            name=name,
            tags=options.tags,
            source={**_SOURCE, **options.source, "flush_interval_s": options.flush_interval_s},
            settings=options.settings,
            no_index=options.no_index,
            is_ring=options.is_ring,
            make_room=lambda: self.make_room(),  # noqa: PLW0108 - it may be set later
            on_written=self._notify,
        )
        """Its files and its follower."""
        self.id = capture.entry.id
        """Recording id."""
        self.name = capture.entry.name
        """Its name in the store."""
        self._thread = threading.Thread(target=self._run, name="hybridlog-record", daemon=True)
        self._thread.start()
        shared.live.add(self)

    def __enter__(self) -> Self:
        """The recording itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the recording, unless that was tried already, or a parent process makes it."""
        if os.getpid() != self._process:
            return
        with self._closing:
            if not self._is_closing:
                self.close()

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
        """Take a message; waits while the memory budget is used up. Thread safe.

        Args:
            channel: The same object for all messages of a channel.
            payload: The serialized message, of any size: bytes or another buffer, which
                must not change afterwards.
            log_time: Receive time, ns since the epoch; None for now.
            publish_time: Send time, ns since the epoch; None for the log time. Channels
                without publish times always have the log time.
            sequence: The sender's number, 0 to 2³²-1.
            wait: False to refuse the message instead of waiting for the budget. Messages of
                up to `SMALL_BYTES` may exceed it by a quarter, so that fields are stored when
                payloads cannot be.

        Returns:
            True if the message was taken.

        Raises:
            UsageError: The payload is not bytes, the channel cannot be stored, a number is
                out of range or not an integer, or the recording was closed.
            DiskFullError: The disk is full; flushed messages stay.
        """
        self._check_process()
        # An error that shows up later would end the whole recording.
        if type(payload) is not bytes:
            payload = _pinned(payload)
        try:
            now = time.time_ns() if log_time is None else index_of(log_time)
            sent = now if publish_time is None else index_of(publish_time)
            sequence = index_of(sequence)
        except TypeError as error:
            raise UsageError(
                f"times and the sequence number of a message must be integers: {error}"
            ) from error
        if not (0 <= now < _MAX_NS and 0 <= sent < _MAX_NS and 0 <= sequence < 1 << 32):
            raise UsageError("a time or the sequence number of a message is out of range")
        bound = self._small_bound if len(payload) <= SMALL_BYTES else self._options.budget_bytes
        size = len(payload) + MESSAGE_HEAD.itemsize
        with self._lock:
            while (unwritten := self._unwritten) > 0 and unwritten + size > bound:
                self._check()
                self._is_tight = True
                self._wake()
                if not wait:
                    return False
                self._room.wait()
            self._room.notify()  # there may be room for another writer
            self._check()
            taken = self._taken.get(channel) if isinstance(channel, Channel) else None
            if taken is None:
                _check_channel(channel)
                self._channels.append(channel)
                taken = self._taken[channel] = _Taken(len(self._channels) - 1, now)
            taken.last = now
            taken.messages += 1
            self._least = min(self._least, now)
            # Ctrl-C may interrupt the main thread anywhere: a message is in the queue or not.
            self._inbox.append((taken.index, now, sent, sequence, payload))
            self._received += size
            enough = self._received - self._moved >= self._worth_waking
        if enough:
            self._wake()
        return True

    @property
    def filled(self) -> float:
        """Used share of the memory budget, 0 to 1."""
        return min(max(self._unwritten, 0) / self._options.budget_bytes, 1.0)

    @property
    def stored(self) -> tuple[int, int]:
        """Messages in chunks, and the bytes of their payloads."""
        return self.capture.writer.messages, self.capture.writer.payload_bytes

    @property
    def lag(self) -> int:
        """Messages that are not indexed yet."""
        return self.capture.lag

    @property
    def index_failure(self) -> DatabaseError | None:
        """The error that stopped the index, None while it works."""
        return self.capture.follower.state.failure

    @property
    def first_time(self) -> int | None:
        """The least log time, ns; None without messages."""
        return self._least if self._channels else None

    @property
    def taken(self) -> Counter[str]:
        """Messages taken so far, by topic."""
        found: Counter[str] = Counter()
        with self._lock:
            for channel, taken in self._taken.items():
                found[channel.topic] += taken.messages
        return found

    def close(self) -> RecordReport:
        """Write, index and seal everything, and return a report.

        On a full disk the flushed messages are sealed, and the rest is in the ledger. Thread
        safe; a second call returns the same report.

        Raises:
            DiskFullError: The disk has no room even to seal; flushed messages stay, and the
                next command that changes the store seals them.
            UsageError: Closing has failed before, or the same thread is closing already, as
                in a signal handler.
        """
        self._check_process()
        with self._closing:
            if self._report is None:
                self._end()
                self._report = self._close_once()
                self._shared.recorded(self._report)
            return self._report

    def _end(self) -> None:
        """Begin to close or to abort, once; the caller holds `_closing`."""
        if self._is_closing:
            raise UsageError(
                f"The recording {self.name!r} is being closed, or closing it was interrupted; "
                "the next command that changes the store seals the flushed messages."
            )
        self._is_closing = True
        self._stop()

    def _close_once(self) -> RecordReport:
        try:
            try:
                if self.failure is not None:
                    raise self.failure
                failure = self.capture.close()
            except DiskFullError:  # as much as fits
                failure = self.capture.close_truncated(self._cut_off())
        except BaseException:
            self.capture.abort()
            raise
        return RecordReport(
            self.capture.entry,
            [],
            self.capture.indexed,
            self.capture.follower.state.missed,
            failure,
            0,
            time.monotonic() - self._started,
            remarks=self.capture.follower.said,
        )

    def _cut_off(self) -> list[Loss]:
        """Rows of the ledger, with the messages that were taken but not written."""
        writer = self.capture.writer
        for channel, taken in self._taken.items():
            count = taken.messages - writer.written_of(channel)
            if count:
                self.cut_off[channel.topic] += count
                written = writer.last_time_of(channel)
                # The clock may have been set back since.
                first, last = sorted((taken.first if written is None else written, taken.last))
                detail = "the disk was full"
                self.ledger.note(Loss(Cause.DISK, channel.topic, count, first, last, detail))
        return self.ledger.take(everything=True)

    def abort(self) -> None:
        """Remove the whole recording.

        Raises:
            UsageError: The recording was closed, or is being closed.
        """
        self._check_process()
        with self._closing:
            self._end()
            self.capture.rollback()

    @property
    def _unwritten(self) -> int:
        """Bytes that were taken and are not in a file."""
        return self._received - self.capture.writer.stored_bytes

    def _notify(self) -> None:
        """There is room for another message."""
        with self._lock:
            self._room.notify()

    def _wake(self) -> None:
        """Wake the writing thread."""
        if self._calls.empty():
            self._calls.put(None)

    def _check_process(self) -> None:
        if os.getpid() != self._process:
            raise UsageError(f"The recording {self.name!r} is made by the parent of this process.")

    def _check(self) -> None:
        if self.failure is not None:
            raise self.failure
        if self._ended:
            raise UsageError(f"The recording {self.name!r} was closed.")

    def _stop(self) -> None:
        with self._lock:
            self._ended = True
            self._room.notify_all()
        self._wake()
        self._thread.join()

    def _run(self) -> None:
        """The writing thread."""
        flushed = reported = time.monotonic()
        interval = self._options.flush_interval_s
        tick = min(_TICK_S, interval / 10)
        try:
            while True:
                with suppress(Empty):
                    self._calls.get(timeout=tick)
                ended = self._ended
                self._take()
                if ended:
                    self._write_losses(everything=True)
                    return
                now = time.monotonic()
                if now - flushed >= tick or self._is_tight:
                    # As late as possible: a chunk of a slow topic costs more than its
                    # content. A message has waited for one tick, and waits for another.
                    age = interval * _FLUSH_AT - 2 * tick
                    self.capture.writer.flush_older(age, most=self._most_open())
                    flushed = now
                if now - reported >= interval / 4:
                    self._write_losses()
                    reported = now
        except BaseException as error:
            # The threads that write and close would wait forever.
            with self._lock:
                self.failure = self.failure or error
                self._room.notify_all()

    def _most_open(self) -> int | None:
        """Bytes that open chunks may have: what they hold is missing in the budget."""
        is_tight, self._is_tight = self._is_tight, False
        if is_tight and self.capture.writer.is_idle:
            return 0  # or nothing would ever make room
        budget = self._options.budget_bytes
        return budget // 8 if self._unwritten > budget // 4 else None

    def _write_losses(self, *, everything: bool = False) -> None:
        rows = self.ledger.take(everything=everything)
        if rows:
            self.capture.writer.add_extra(losses_record(rows))

    def _take(self) -> None:
        """Move queued messages into chunks."""
        with self._lock:
            inbox, self._inbox = self._inbox, deque()
            self._moved = self._received
        if inbox:
            self.capture.writer.append(_batch(inbox), self._channels)


def _pinned(payload: object) -> memoryview:
    """A view of a buffer that keeps it from being resized or released."""
    if isinstance(payload, bytes | bytearray | memoryview):
        view = memoryview(payload)
        if view.c_contiguous and view.ndim == 1 and view.format == "B":
            return view
    kind = type(payload).__name__
    raise UsageError(f"the payload of a message must be bytes, not {kind}")


def _check_channel(channel: object) -> None:
    """Refuse a channel that no segment can hold."""
    if not isinstance(channel, Channel):
        raise UsageError(f"{channel!r} is not a Channel")
    schema, metadata = channel.schema, channel.metadata
    schema = Schema("", "", b"") if schema is None else schema
    if not (isinstance(schema, Schema) and isinstance(schema.data, bytes)):
        raise UsageError(f"the channel {channel.topic!r} must have a Schema of bytes, or None")
    if not isinstance(metadata, Mapping):
        raise UsageError(f"the metadata of the channel {channel.topic!r} must be a mapping")
    texts = [channel.topic, channel.message_encoding, schema.name, schema.encoding]
    for text in (*texts, *metadata, *metadata.values()):
        if not isinstance(text, str) or text.encode(errors="ignore").decode() != text:
            raise UsageError(
                f"the channel {channel.topic!r} has {text!r} instead of text that UTF-8 can encode"
            )


def follow_interval_s(options: LiveOptions) -> float | None:
    """Time between two looks of its follower, seconds; None to do everything at the end."""
    return None if options.is_ring else min(_INDEX_INTERVALS * options.flush_interval_s, _LOOK_S)


def _batch(messages: deque[tuple[int, int, int, int, Buffer]]) -> LooseBatch:
    channel, log_time, publish_time, sequence, payloads = zip(*messages, strict=True)
    return LooseBatch(
        np.fromiter(payloads, np.object_, len(payloads)),
        np.fromiter(map(len, payloads), np.int64, len(payloads)),
        np.array(channel, np.int32),
        np.array(log_time, np.int64),
        np.array(publish_time, np.int64),
        np.array(sequence, np.uint32),
    )
