"""Snapshot mode: a ring of the latest messages, stored when a trigger fires.

`Snapshots` takes the place of a recording. A trigger starts a recording with the content
of the ring. Messages of the time after the trigger follow; then the recording is closed,
and the ring goes on.
"""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

from hybridlog.live.ring import BufferedMessage, Ring
from hybridlog.query.predicate.parser import parse
from hybridlog.query.predicate.to_bool import numbers_at, to_bool
from hybridlog.query.predicate.types import check
from hybridlog.query.topics import TopicMatcher, matcher, split_topic
from hybridlog.record.losses import Cause, Ledger, Loss
from hybridlog.schema.codec import plain_message
from hybridlog.schema.codecs import codec_for
from hybridlog.schema.index_bodies import index_fields
from hybridlog_storage.errors import (
    DefinitionError,
    HybridlogError,
    PayloadError,
    UsageError,
    WhereError,
)
from hybridlog_storage.times import BEGIN

if TYPE_CHECKING:
    from hybridlog.live.clocks import MachineClock
    from hybridlog.live.recording import LiveRecording
    from hybridlog.query.predicate.tree import Predicate, Test
    from hybridlog.record.recorder import RecordReport
    from hybridlog_storage.messages import Channel

_MAX_ROWS = 10_000  # of the ledger, while there is no snapshot to write them into
_MAX_WATCHED = 1000  # messages whose field `numbers` reads
_MAX_WARNINGS = 100  # lines about triggers
_RING_SHARE = 0.5  # of a recording's budget; the rest is for messages that come meanwhile


@dataclass(frozen=True, slots=True)
class Trigger:
    """A condition that starts a snapshot.

    Attributes:
        text: As the user wrote it.
        fits: Tells whether a topic matches.
        predicate: Condition for a message; None for any message.
    """

    text: str
    fits: TopicMatcher
    predicate: Predicate | None

    @classmethod
    def of(cls, text: str) -> Trigger:
        """Parse `/diagnostics: status[*].level >= 2`, or a topic alone.

        Raises:
            UsageError: The topic is missing.
            TopicError: The pattern is malformed.
            WhereError: The predicate is malformed.
        """
        topic, predicate = split_topic(text)
        if not topic:
            raise UsageError(f"--trigger wants TOPIC: PREDICATE, not {text!r}.")
        fits = matcher([topic])
        condition = parse(predicate) if predicate else None
        for path in [] if condition is None else condition.fields():
            if path.split(".", 1)[0] in {"_id", "_meta"}:
                raise WhereError(
                    f"a trigger sees messages before they are stored: {path} does not exist yet"
                )
        return cls(text, fits, condition)


@dataclass(frozen=True, slots=True)
class SnapshotOptions:
    """Content and triggers of snapshots.

    Attributes:
        ring_s: Time span of the ring, seconds.
        before_s: Seconds before the trigger; None for the whole ring.
        after_s: Seconds after the trigger.
        triggers: Conditions; signals and other processes can trigger as well.
    """

    ring_s: float
    before_s: float | None = None
    after_s: float = 0.0
    triggers: tuple[Trigger, ...] = ()

    def __post_init__(self) -> None:
        """Refuse spans that the ring cannot hold."""
        if not 0 < self.ring_s <= 86_400:
            raise UsageError("--ring must be between 0 and a day")
        if self.before_s is not None and not 0 <= self.before_s <= self.ring_s:
            raise UsageError("--before cannot be longer than --ring")
        if not 0 <= self.after_s <= 86_400:
            raise UsageError("--after must be between 0 and a day")


class _Watch(NamedTuple):
    """A trigger, compiled for the messages of one channel.

    Attributes:
        reason: The trigger's text.
        test: Condition for a message's fields; None if any message fires it.
        names: Top-level fields that the condition needs.
    """

    reason: str
    test: Test | None
    names: frozenset[str] = frozenset()


class Snapshots:
    """Takes messages like a recording, and stores those around triggers.

    Args:
        options: Content and triggers.
        budget_bytes: Payload bytes that the ring may hold.
        start: Starts a recording; its argument is the trigger's reason.
        again: Called with the reason of a trigger that fires during a snapshot.
        say: Shows a line to the user.
        clock: The clock of log times.
        settle_s: Seconds after the first topic in which others may come, before a trigger is
            told that none matches.

    Attributes:
        cut_off: Messages of snapshots that a full disk cost, by topic.
    """

    def __init__(
        self,
        options: SnapshotOptions,
        budget_bytes: int,
        start: Callable[[str], LiveRecording],
        again: Callable[[str], None],
        say: Callable[[str], None],
        *,
        clock: MachineClock,
        settle_s: float = 3.0,
    ) -> None:
        self.cut_off: Counter[str] = Counter()
        self._options = options
        self._again = again
        self._reasons: set[str] = set()
        self._unmet = dict.fromkeys(trigger.text for trigger in options.triggers)
        self._settle_s = settle_s
        self._complete_at: float | None = None
        self._warned: set[str] = set()
        self._ring = Ring(round(options.ring_s * 1e9), budget_bytes)
        self._start = start
        self._say = say
        self._clock = clock
        self._ledger = Ledger()
        self._lost: deque[tuple[int, dict[str, Any]]] = deque(maxlen=_MAX_ROWS)
        self._lock = threading.Lock()
        self._active: LiveRecording | None = None
        self._until = 0
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="hybridlog-snapshot")
        self._dumping: Future[None] | None = None
        self._reports: list[RecordReport] = []
        self._stored = (0, 0)
        self._failure: HybridlogError | None = None
        self._watched: dict[Channel, tuple[_Watch, ...]] = {}
        self._has_reported_short = False

    id = ""
    """Empty: there is no single recording."""

    def write(
        self,
        channel: Channel,
        payload: bytes,
        *,
        log_time: int,
        publish_time: int | None = None,
        sequence: int = 0,
        wait: bool = True,
    ) -> bool:
        """Take a message; see `LiveRecording.write`."""
        steady = self._clock.steady(log_time)
        message = BufferedMessage(
            channel, payload, log_time, publish_time, sequence, log_time - steady
        )
        watches = self._watched.get(channel)
        if watches is None:
            watches = self.expect(channel)
        with self._lock:
            self._ring.add(message)
            active = self._active
            if active is not None and steady >= self._until:
                self._end(active)
                active = None
            if active is None:
                taken = True
            else:
                taken = active.write(
                    channel,
                    payload,
                    log_time=log_time,
                    publish_time=publish_time,
                    sequence=sequence,
                    wait=wait,
                )
        for reason in _happened(watches, message):
            self.fire(reason, log_time)
        return taken

    def expect(self, channel: Channel) -> tuple[_Watch, ...]:
        """Compile the triggers for a channel; tells those that can never fire on it."""
        watches = self._watched[channel] = tuple(self._watches(channel))
        return watches

    def fire(self, reason: str, at: int | None = None) -> None:
        """Start a snapshot, or extend the one that is being written.

        Args:
            reason: Part of the recording's name, and its tag `trigger`.
            at: Time of the event, ns since the epoch; None for now.
        """
        now = self._clock.steady(self._clock.now() if at is None else at)
        until = now + round(self._options.after_s * 1e9)
        with self._lock:
            self._until = max(self._until, until)
            goes_on = self._active is not None or (
                self._dumping is not None and not self._dumping.done()
            )
            is_new = reason not in self._reasons
            if goes_on:
                self._reasons.add(reason)
            else:
                self._reasons = {reason}
                self._dumping = self._worker.submit(self._write_out, reason, now)
        if goes_on and is_new:
            self._again(reason)

    def look(self, topics: Collection[str] = ()) -> None:
        """End a snapshot whose time is over, even without further messages.

        Args:
            topics: Full names of the topics so far; triggers that match none are told.
        """
        self._warn_unmet(topics)
        with self._lock:
            now = self._clock.steady(self._clock.now())
            if self._active is not None and now >= self._until:
                self._end(self._active)
            self._take_losses()
            short = self._ring.is_short and not self._has_reported_short
            self._has_reported_short |= short
        if short:
            self._say(
                f"the ring holds only {self.held_s:.0f} of {self._options.ring_s:.0f} s: more does "
                "not fit into the memory budget (--budget)"
            )

    def close(self) -> list[RecordReport]:
        """Close the snapshot that is being written, and return the reports of all.

        Raises:
            DiskFullError: A snapshot could not be written.
        """
        if self._dumping is not None:
            self._dumping.result()
        with self._lock:
            if self._active is not None:
                self._end(self._active)
        self._worker.shutdown(wait=True)
        for text in self._unmet:
            self._say(f"no topic matched the trigger {text!r}")
        if self._failure is not None:
            raise self._failure
        return self._reports

    def abort(self) -> None:
        """Drop the snapshot that is being written; complete snapshots stay."""
        self._worker.shutdown(wait=True, cancel_futures=True)
        with self._lock:
            active, self._active = self._active, None
        if active is not None:
            active.abort()

    @property
    def ledger(self) -> Ledger:
        """Ledger of the snapshot that is being written, else of the ring."""
        active = self._active
        return self._ledger if active is None else active.ledger

    @property
    def filled(self) -> float:
        """Used share of the snapshot's memory budget, 0 to 1."""
        active = self._active
        return 0.0 if active is None else active.filled

    @property
    def stored(self) -> tuple[int, int]:
        """Messages and payload bytes in all snapshots."""
        active = self._active
        messages, size = (0, 0) if active is None else active.stored
        return self._stored[0] + messages, self._stored[1] + size

    @property
    def progress(self) -> tuple[int, int]:
        """Messages of the snapshot that are taken, and those that are written."""
        active = self._active
        return (0, 0) if active is None else active.progress

    @property
    def lag(self) -> int:
        """Messages of the snapshot that are not indexed yet."""
        active = self._active
        return 0 if active is None else active.lag

    @property
    def index_failure(self) -> HybridlogError | None:
        """The error that stopped the index, None while it works."""
        active = self._active
        return None if active is None else active.index_failure

    @property
    def failure(self) -> BaseException | None:
        """The error that stopped the recording, None while it works."""
        active = self._active
        return self._failure or (None if active is None else active.failure)

    @property
    def count(self) -> int:
        """Number of snapshots, including the one that is being written."""
        return len(self._reports) + (self._active is not None)

    @property
    def held_s(self) -> float:
        """Seconds that the ring holds."""
        with self._lock:
            return self._ring.held_s

    def _take_losses(self) -> None:
        """Note the losses since the last call, and what the clock was set by."""
        set_by = self._clock.set_by
        self._lost.extend((set_by, row) for row in self._ledger.take(everything=True))

    def numbers(self, topic: str, path: str, begin: int) -> list[float]:
        """Values of a field in the ring's latest messages since a log time, ns."""
        with self._lock:
            latest = self._ring.latest(topic, self._clock.steady(begin), _MAX_WATCHED)
        fields = (index_fields(codec_for(one.channel), one.payload) for one in latest)
        return [number for message in fields for number in numbers_at(message, path)]

    def _watches(self, channel: Channel) -> Iterator[_Watch]:
        """The triggers for a channel that may fire on it."""
        for trigger in self._options.triggers:
            if not trigger.fits(channel.topic):
                continue
            self._unmet.pop(trigger.text, None)
            if trigger.predicate is None:
                yield _Watch(trigger.text, None)
                continue
            types = {path.path: path.type for path in codec_for(channel).paths()} or None
            try:
                check(trigger.predicate, types)
            except WhereError as error:
                self._warn_once(
                    f"trigger {trigger.text!r} can never fire on {channel.topic}: {error}"
                )
            else:
                names = frozenset(path.split(".", 1)[0] for path in trigger.predicate.fields())
                yield _Watch(trigger.text, to_bool(trigger.predicate, types), names)

    def _warn_unmet(self, topics: Collection[str]) -> None:
        for trigger in self._options.triggers:
            if any(map(trigger.fits, topics)):
                self._unmet.pop(trigger.text, None)
        if topics and self._complete_at is None:
            self._complete_at = time.monotonic() + self._settle_s
        if self._complete_at is not None and time.monotonic() >= self._complete_at:
            for text in [*self._unmet]:
                self._warn_once(f"no topic matches the trigger {text!r} so far")

    def _warn_once(self, text: str) -> None:
        if text not in self._warned and len(self._warned) < _MAX_WARNINGS:
            self._warned.add(text)
            self._say(text)

    def _write_out(self, reason: str, at: int) -> None:
        """Start a recording with the content of the ring; runs on the worker."""
        before = self._options.before_s
        begin = BEGIN if before is None else at - round(before * 1e9)
        try:
            recording = self._start(reason)
        except HybridlogError as error:
            self._failure = error
            self._say(f"the snapshot for {reason!r} could not be started: {error}")
            return
        with self._lock:
            # From here on new messages go into the ring and into the recording.
            messages = self._ring.since(begin)
            self._take_losses()
            lost = [row for set_by, row in self._lost if row["to"] - set_by >= begin]
            self._lost.clear()
            self._active = recording
        for row in lost:
            recording.ledger.note(
                Loss(
                    row["topic"] or "",
                    Cause(row["cause"]),
                    row["count"],
                    first=row["from"],
                    last=row["to"],
                    detail=row["reason"],
                )
            )
        self._say(f"snapshot {recording.name} because of {reason!r}")
        try:
            for message in messages:
                while recording.filled > _RING_SHARE and recording.failure is None:
                    time.sleep(0.001)
                recording.write(
                    message.channel,
                    message.payload,
                    log_time=message.log_time,
                    publish_time=message.publish_time,
                    sequence=message.sequence,
                )
        except HybridlogError as error:
            self._failure = error
            self._say(f"snapshot {recording.name} is not complete: {error}")

    def _end(self, recording: LiveRecording) -> None:
        """Let the worker close a snapshot; the caller holds the lock."""
        self._active = None
        self._dumping = None
        self._worker.submit(self._close, recording)

    def _close(self, recording: LiveRecording) -> None:
        stored = recording.stored
        try:
            report = recording.close()
            self.cut_off.update(recording.cut_off)
        except HybridlogError as error:
            self._failure = error
            self._say(f"snapshot {recording.name} is not complete: {error}")
            return
        self._reports.append(report)
        self._stored = (self._stored[0] + stored[0], self._stored[1] + stored[1])


def _happened(watches: tuple[_Watch, ...], message: BufferedMessage) -> Iterator[str]:
    """Reasons of the triggers that fire for a message."""
    names = frozenset[str]().union(*(watch.names for watch in watches))
    fields: Mapping[str, object] | None = None
    for reason, test, _ in watches:
        if test is not None and fields is None:
            try:
                fields = plain_message(codec_for(message.channel), message.payload, names)
            except (PayloadError, DefinitionError):
                fields = {}  # it has no fields, as in an answer
        if test is None or (fields is not None and test(fields)):
            yield reason
