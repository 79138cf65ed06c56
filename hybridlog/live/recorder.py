"""The recorder of a running robot: writes the messages of live sources into a recording.

`Recorder` is the sink of its sources. It counts every message on arrival. So for each
topic the received messages are the stored ones plus those in the loss ledger.
"""

from __future__ import annotations

import math
import re
import shutil
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from operator import attrgetter
from typing import TYPE_CHECKING, Final, cast

from msgspec import Struct
from msgspec.structs import replace

from hybridlog.entries import put_entry
from hybridlog.entries import text as as_text
from hybridlog.follow.child import FollowerProcess, Task, Trigger
from hybridlog.live.clocks import CLOCK, MachineClock, SimulatedTime
from hybridlog.live.incidents import RULE, Incidents, SilenceWatch
from hybridlog.live.recording import SMALL_BYTES, LiveOptions, LiveRecording, follow_interval_s
from hybridlog.live.state import RecorderState, StateFile, Tally, TopicCounts
from hybridlog.maintenance.edit import remove_if
from hybridlog.maintenance.keep import RoomMaker
from hybridlog.maintenance.report import Followed
from hybridlog.maintenance.retention import Rules
from hybridlog.query.times import format_duration, format_time
from hybridlog.query.topics import TopicMatcher, matcher
from hybridlog.record.losses import Cause
from hybridlog.record.marks import CLOCK_SET
from hybridlog.schema.codecs import codec_for
from hybridlog.schema.ros_codec import completed
from hybridlog.wording import size
from hybridlog_storage.disk import files
from hybridlog_storage.errors import (
    DiskFullError,
    HybridlogError,
    StoreError,
    UsageError,
)
from hybridlog_storage.manifest import Loss, Mark, new_random
from hybridlog_storage.manifests import MANIFESTS
from hybridlog_storage.messages import REDUCED, Channel, left_channel

if TYPE_CHECKING:
    from hybridlog.contract import Contract
    from hybridlog.live.sources.base import LiveSource, Sink
    from hybridlog.record.recorder import RecordReport
    from hybridlog.store import Store
    from hybridlog_storage.catalog import RecordingEntry

_GROUPS = 10  # of files in the time of a ring, about
_MAX_REPORTS = 1000
_MAX_CACHED = 4096  # channel objects that are found without comparing their content
_FULL_BYTES = 4 << 20  # of a manifest; then another recording goes on
_SEQUENCES = 1 << 32
_HELD_SHARE = 8  # of the memory budget, for messages that come before `/clock`
_FITS_S = 5.0  # until options that fit no topic are told
_CLOCK_WAIT_S = 5.0
_SLOW_WRITE_S = 2.0  # to pack and write a chunk, on a disk that is busy


_RATE = re.compile(r"(\d+(?:\.\d+)?)\s*(?:hz)?", re.IGNORECASE)
_HIGHEST_HZ = 1e6
WHOLE_BELOW: Final = {"low": 0.5, "normal": 0.7, "high": 0.9}
"""Shares of the budget above which large messages of a priority keep their fields only."""


class Rule(Struct, frozen=True):
    """A setting for the topics that match a pattern: a rate in Hz, or a share of the budget."""

    pattern: str
    fits: TopicMatcher
    value: float


def throttle_rule(pattern: str, rate: str) -> Rule:
    """A rule that limits topics to a rate such as `5Hz` or `0.5`.

    Raises:
        UsageError: The rate is malformed.
        TopicError: The pattern is malformed.
    """
    found = _RATE.fullmatch(rate.strip())
    hz = float(found[1]) if found else 0.0
    if not 0 < hz <= _HIGHEST_HZ:
        raise UsageError(f"{rate!r} is no rate: give messages a second, such as 5Hz.")
    return Rule(pattern, matcher([pattern]), hz)


def priority_rule(pattern: str, word: str) -> Rule:
    """A rule that gives topics the priority `low`, `normal` or `high`.

    Raises:
        UsageError: The priority is unknown.
        TopicError: The pattern is malformed.
    """
    try:
        return Rule(pattern, matcher([pattern]), WHOLE_BELOW[word.strip().lower()])
    except KeyError:
        raise UsageError(f"Unknown priority {word!r}; choose low, normal or high.") from None


def first_fit(rules: Sequence[Rule], topic: str) -> float | None:
    """The value of the first rule that matches a topic, None if none does."""
    found = [rule.value for rule in rules if rule.fits(topic)]
    return found[0] if found else None


class Throttle:
    """Limits a topic to a rate, with even intervals between messages.

    Time is the messages' receive time. A message may come a quarter of an interval early.
    Without that tolerance a jittering topic of 10 Hz gives 3.3 Hz instead of 5.
    """

    def __init__(self, hz: float) -> None:
        self._interval = math.ceil(1e9 / hz)
        self._slack = self._interval // 4
        self._due = self._reset = -2 * self._interval  # long ago: the next message passes
        self._last = 0

    def lets_through(self, received: int) -> bool:
        """Tells whether a message is stored."""
        if received < self._last - self._interval:
            self._due = self._reset  # the clock was set back
        self._last = received
        if received < self._due - self._slack:
            return False
        # The interval starts when the message was due: from its arrival the rate would sag.
        late = received - self._due
        self._due = (self._due if late < self._interval else received) + self._interval
        return True


class RecorderOptions(LiveOptions, frozen=True):
    """Options of a recorder, and of its recording; the first rule that fits a topic applies.

    It stops when less than `reserve_bytes` are free. After `ring_s` messages go that no pin
    touches. What lies `before_s` (None: as long as the ring) and `after_s` around a trigger or
    signal is marked and pinned. Unless it `derives`, tables and index are left to a later command.
    """

    name: str = "live"
    matcher: TopicMatcher | None = None
    throttles: Sequence[Rule] = ()
    priorities: Sequence[Rule] = ()
    duration_s: float | None = None
    max_messages: int | None = None
    reserve_bytes: int = 1 << 30
    ring_s: float | None = None
    triggers: Sequence[Trigger] = ()
    before_s: float | None = None
    after_s: float = 0.0
    use_sim_time: bool = False
    contract: Contract | None = None
    derives: bool = True

    def __post_init__(self) -> None:
        """Refuse a ring that holds too little."""
        LiveOptions.__post_init__(self)
        if self.ring_s is not None and (self.before_s or 0) > self.ring_s:
            raise UsageError("--before cannot be longer than --ring")


class _RecordedChannel(Struct):
    """A channel, with its policies and counters."""

    channel: Channel
    tally: Tally
    throttle: Throttle | None
    whole_below: float
    reduced: Channel | None = None


class Recorder:
    """Records the messages of its sources until it is stopped or reaches a limit.

    Args:
        store: The store that gets the recording.
        sources: The sources; `start` starts them, `stop` stops them.
        options: Options.
        say: Shows a line to the user; called from any thread.
        clock: The clock of log times; None for that of this machine.
    """

    def __init__(
        self,
        store: Store,
        sources: Sequence[LiveSource],
        options: RecorderOptions,
        say: Callable[[str], None],
        clock: MachineClock | None = None,
    ) -> None:
        if not (options.derives or Rules.of(store.directory.settings.retention).is_empty):
            raise UsageError(
                "The rules of this store delete what the follower has read: leave out --no-derive."
            )
        self._clock = clock or MachineClock()
        self._sources = sources
        self._options = options
        self._say = say
        self._shared = store.shared
        self._directory = store.directory
        self._recorded: dict[Channel, _RecordedChannel] = {}
        self._recorded_by_content: dict[tuple[object, ...], _RecordedChannel] = {}
        self._topics: dict[str, TopicCounts] = {}
        self._lock = threading.Lock()
        self._said: set[str] = set()
        self._unended = len(sources)
        self._over = threading.Event()
        self.reason = ""  # for the end; empty while the recorder runs
        self.is_full = False  # another recording goes on
        self._goes_on = all(source.kind != "replay" for source in sources)
        self._left = options.max_messages
        self._closed = False
        self._refused: tuple[Cause, str] | None = None
        self._started = time.monotonic()
        self._looked = self._written_at = self._started
        self._written = 0
        self._newest = max(store.session.look().summaries, key=attrgetter("created"), default=None)
        self._silence = SilenceWatch(options.contract)
        self._ended_at: int | None = None
        self._simulated: SimulatedTime | None = None
        if options.use_sim_time:
            held = options.budget_bytes // _HELD_SHARE
            self._simulated = SimulatedTime(self, held)
        self._sink = cast("Sink", self._simulated or self)
        self._target = LiveRecording(
            store.shared, self._begin_to_follow, options.name, self._of_recording()
        )
        self.name = self._target.name
        self._says = StateFile(store.directory, self._target.id)
        self._incidents = Incidents(
            partial(self._directory.manifests.change, self._target.id),
            lambda: self._target.first_time,
            self.say,
        )
        try:
            self._room = RoomMaker(
                store.directory,
                partial(remove_if, store.shared, clears=False),
                self._target.id,
                sealed=lambda: self._target.capture.writer.sealed,
                reserve=options.reserve_bytes,
                say=self.say,
                ring_s=options.ring_s,
                pin=self._incidents.write,
                judged=lambda: self._follower.judged,
            )
            self._target.make_room = self._room.make_room
        except BaseException:
            self._target.abort()
            raise

    def _begin_to_follow(self, entry: RecordingEntry) -> FollowerProcess:
        index, options, triggers = self._shared.index, self._options, self._options.triggers
        task = Task(
            self._directory.address,
            index.wanted,
            entry.id,
            [one.text for one in triggers],
            follow_interval_s(self._of_recording()),
        )
        self._follower = FollowerProcess(
            self._shared,
            task,
            Followed(index.is_wanted and options.derives),
            triggers=triggers,
            hit=self.fire,
            say=self.say,
        )
        return self._follower

    def _of_recording(self) -> LiveOptions:
        options, settings = self._options, self._options.settings
        if options.ring_s is not None:
            group_s = options.ring_s / _GROUPS
            span_s = min(settings.segment_span_s or group_s, group_s)
            settings = replace(settings, segment_span_s=span_s)
        by = f", by {CLOCK}" if options.use_sim_time else ""
        source = {
            "kind": ", ".join(source.kind for source in self._sources) + by,
            "path": ", ".join(source.address for source in self._sources),
        }
        is_ring = options.ring_s is not None
        return replace(options, source=source, settings=settings, is_ring=is_ring)

    # Methods for the program that runs the recorder.

    def start(self) -> None:
        """Start the sources.

        Raises:
            SourceError: A source can never work; the recording is removed.
            MissingDependencyError: A source needs a package that is not installed; the
                recording is removed.
        """
        try:
            self.look()  # nothing is stored where there is no room
            if self._options.derives:
                self._follower.start()
            for source in self._sources:
                source.start(self._sink)
        except BaseException:
            for source in self._sources:
                source.stop()
            self._says.remove()
            self._target.abort()
            raise
        now = self._clock.now()
        if self._simulated is None and self._newest is not None and self._newest.created > now:
            says = f"the clock of this machine says {format_time(now)}"
            self._note_clock(f"{says}, and recording {self._newest.name} was begun later", {}, now)

    def wait(self, seconds: float) -> bool:
        """Wait for the end for at most so long; returns True once it has come."""
        return self._over.wait(seconds)

    def leave(self) -> bool:
        """Leave to the next command what the follower has not done; False before all is sealed."""
        return self._follower.leave()

    def stop(self, wait_s: float | None = None) -> list[RecordReport]:
        """Stop the sources; flush and seal everything; then wait for the follower.

        The recording is removed if no source was ever reached and no message came, or if the
        disk had no room for any.

        Args:
            wait_s: Seconds to wait for the follower; None for as long as it takes.

        Returns:
            A report for each recording.

        Raises:
            DiskFullError: The disk is full; flushed messages stay.
        """
        ended_at = self._now() if self._ended_at is None else self._ended_at
        for source in self._sources:
            source.stop()
        self._over.set()
        if self._simulated is not None:
            self._simulated.close()
        self._follower.wait_s = math.inf if wait_s is None else wait_s
        self._says.remove()
        self._room.stop()
        self._check_silences(ended_at)
        self._write_marks()
        if self._is_marked(self._target.id) or (
            not (self.stopped_for_disk and self._target.first_time is None)
            and (self._recorded_by_content or any(source.was_reached for source in self._sources))
        ):
            report = self._target.close()
        else:
            self._target.abort()
            return []
        if self._write_marks():  # what triggers have found last
            self._shared.catch_up(report.entry.id)
            report.entry = put_entry(self._directory, self._shared.catalog, self._target.id)
        if self._target.cut_off:
            self._refuse(Cause.DISK, "the disk was full")
            for topic, count in self._target.cut_off.items():
                self._count_lost(topic, Cause.DISK, count)
        return [report]

    def _write_marks(self) -> bool:
        """Mark and pin what is new; returns whether something was. What fails is tried again."""
        try:
            return self._incidents.write()
        except (HybridlogError, OSError) as error:
            self.say(f"marking or pinning failed: {error}")
            return False

    @property
    def rest(self) -> RecorderOptions:
        """Options of the recording that goes on after a full one: what is left of the limits."""
        options, left = self._options, self._options.duration_s
        if left is not None:
            left = max(left - (time.monotonic() - self._started), 1e-3)
        return replace(options, duration_s=left, max_messages=self._left)

    @property
    def stopped_for_disk(self) -> bool:
        """Tells whether a full disk or its reserve ended the recording."""
        return self._refused is not None and self._refused[0] is Cause.DISK

    def look(self) -> RecorderState:
        """Compute the state, and check the limits; call it about once a second."""
        now = time.monotonic()
        elapsed = max(now - self._looked, 1e-3)
        if self._looked < self._started + _FITS_S <= now:
            for text in self.unfitting():
                self.say(f"no topic fits {text} so far")
        self._looked = now
        self._check_clock(now)
        self._check_silences()
        self._write_marks()
        if not self._over.is_set():
            self._room.look()
        lost: Counter[str] = Counter()
        with self._lock:
            for one in self._topics.values():
                lost.update({str(cause): count for cause, count in one.lost.items()})
            shown = [one for one in self._topics.values() if one.tallies or one.is_present]
        shown.sort(key=attrgetter("topic"))
        topics = [one.look(elapsed, self._steady()) for one in shown]
        stored, stored_bytes = self._target.stored
        failure = self._target.index_failure
        state = RecorderState(
            self.name,
            now - self._started,
            topics,
            sum(topic.messages for topic in topics),
            stored,
            dict(lost),
            self._target.filled,
            self._target.lag,
            "" if failure is None else str(failure),
            shutil.disk_usage(self._directory.path).free,
            stored_bytes,
            self._stalled_s(now),
            incidents=self._incidents.count,
            let_go=None if self._options.ring_s is None else self._room.keeper.let_go,
            taken=dict(self._target.taken),
            silent=self._silence.silent,
            breaches=self._silence.breaches,
            clock_set_s=self._clock.set_by / 1e9,
            sim_time=None if self._simulated is None else self._simulated.latest,
            hz=sum(topic.hz for topic in topics),
            bytes_per_s=sum(topic.bytes_per_s for topic in topics),
        )
        self._check_limits(state)
        self._says.write(state)
        return state

    def _stalled_s(self, now: float) -> float:
        taken, written = self._target.taken.total(), self._target.capture.writer.written.total()
        if taken <= written or written != self._written:
            self._written, self._written_at = written, now
        waited = now - self._written_at - self._options.flush_interval_s
        return waited if waited > _SLOW_WRITE_S else 0.0

    def fire(self, text: str, at: int | None = None) -> None:
        """Mark and pin what is around a log time, ns, or now; waits for nothing."""
        options = self._options
        before = options.before_s if options.before_s is not None else options.ring_s or 0.0
        at = self._now() if at is None else at
        begin, end = at - round(before * 1e9), at + round(options.after_s * 1e9)
        self._incidents.hit(as_text(text), begin, end)

    def _is_marked(self, recording: str) -> bool:
        with suppress(StoreError):
            return bool(self._directory.manifests.read(recording).marks)
        return False

    def _now(self) -> int:
        """The present as a log time, ns."""
        now = self._clock.now()
        return now if self._simulated is None else self._simulated.at(now)

    def _steady(self, log_time: int | None = None) -> int:
        """The present, or a log time of it, as nobody sets it, ns; of a simulation its own."""
        if self._simulated is None:
            return self._clock.monotonic()
        return self._now() if log_time is None else log_time

    def _check_silences(self, ended_at: int | None = None) -> None:
        """Tell silences that begin, and mark them from their beginning on; later their ends."""
        for mark in self._silence.look(self._steady(), ended_at):
            if self._incidents.note(mark):
                self._say(f"{mark.text} ({RULE} of the contract)")

    def unfitting(self) -> list[str]:
        """Options that name topics of which none has come, in words."""
        options = self._options
        chosen = options.matcher, options.no_index
        with self._lock:
            topics = [name for name, one in self._topics.items() if one.has_come]
            found = [f"'{as_text(one)}'" for all_ in chosen if all_ for one in all_.unused()]
        rules = [
            *((one.fits, f"'{as_text(one.pattern)}' of --throttle") for one in options.throttles),
            *((one.fits, f"'{as_text(one.pattern)}' of --priority") for one in options.priorities),
            *((one.fits, f"the trigger '{as_text(one.text)}'") for one in options.triggers),
        ]
        return found + [text for fits, text in rules if not any(map(fits, topics))]

    def silent(self) -> list[str]:
        """Topics that had publishers and never sent a message."""
        with self._lock:
            return sorted(
                topic
                for topic, one in self._topics.items()
                if one.has_come and not any(tally.messages for tally in one.tallies)
            )

    def _topic(self, name: str, type_name: str = "") -> TopicCounts:
        """What is counted of a topic; the caller holds the lock."""
        found = self._topics.setdefault(name, TopicCounts(name))
        found.type = found.type or type_name
        return found

    # The sink.

    def wants(self, topic: str, type_name: str) -> bool:
        """See `Sink.wants`."""
        if self._options.matcher is None:
            return True
        with self._lock:
            return self._options.matcher(topic)

    def take(
        self,
        channel: Channel,
        payload: bytes,
        *,
        received: int,
        sent: int | None = None,
        sequence: int | None = None,
    ) -> None:
        """See `Sink.take`."""
        recorded = self._recorded.get(channel) or self._meet(channel, payload)
        size = len(payload)
        through = recorded.throttle is None or recorded.throttle.lets_through(received)
        if through and not self._claim():
            return  # messages after the end are not part of the recording
        steady = self._steady(received)
        recorded.tally.add(size, steady)
        if not through:
            self._lose(recorded, Cause.THROTTLE, "", received)
            return
        if self._refused is not None:
            self._lose(recorded, *self._refused, received)
            return
        whole = size <= SMALL_BYTES or self._target.filled < recorded.whole_below
        number = 0 if sequence is None else sequence % _SEQUENCES
        try:
            is_stored = whole and self._target.write(
                recorded.channel,
                payload,
                log_time=received,
                publish_time=sent,
                sequence=number,
                wait=False,
            )
            if not is_stored and size > SMALL_BYTES:
                # Its fields may fit where its payload does not.
                is_stored = self._store_fields(recorded, payload, received, sent, number)
            if is_stored:
                self._silence.take(recorded.channel.topic, steady, received)
            else:
                self.say(
                    f"{recorded.channel.topic}: the memory budget is used up and messages are lost "
                    "(see the loss ledger); raise it with --budget"
                )
                self._lose(recorded, Cause.QUEUE, "the memory budget was used up", received)
        except HybridlogError as error:
            cause = Cause.DISK if isinstance(error, DiskFullError) else Cause.QUEUE
            self._refuse(cause, str(error))
            self._lose(recorded, cause, str(error), received)

    def lost(self, loss: Loss) -> None:
        """See `Sink.lost`."""
        self._count_lost(loss.topic, loss.cause, loss.count or 0)
        self._target.ledger.note(loss)

    def topic_came(self, topic: str, type_name: str) -> None:
        """See `Sink.topic_came`."""
        with self._lock:
            self._topic(topic, type_name).is_present = True

    def topic_gone(self, topic: str) -> None:
        """See `Sink.topic_gone`."""
        with self._lock:
            if topic in self._topics:
                self._topics[topic].is_present = False

    def say(self, text: str) -> None:
        """See `Sink.say`."""
        with self._lock:
            # A peer with ever new messages must not fill the memory.
            if text in self._said or len(self._said) >= _MAX_REPORTS:
                return
            self._said.add(text)
        self._say(text)

    def ended(self, reason: str = "") -> None:
        """See `Sink.ended`."""
        if reason:
            self.say(reason)
        with self._lock:
            self._unended -= 1
            last = self._unended <= 0
        if last:
            self._end(reason or "all sources have ended")

    # Parts of `take`.

    def _meet(self, channel: Channel, payload: bytes) -> _RecordedChannel:
        """Look up a channel object by its content, or add it, with its first message.

        That may complete its definition. A publisher that reconnects makes a new channel object
        with the same content. It shares the old channel: a robot with a bad cable would otherwise
        use up all numbers.
        """
        content = (
            channel.topic,
            channel.message_encoding,
            channel.schema,
            tuple(sorted(channel.metadata.items())),
            channel.has_publish_time,
        )
        with self._lock:
            recorded = self._recorded_by_content.get(content)
            if recorded is None:
                topic = channel.topic
                type_name = channel.schema.name if channel.schema is not None else ""
                hz = first_fit(self._options.throttles, topic)
                priority = first_fit(self._options.priorities, topic)
                recorded = _RecordedChannel(
                    completed(channel, [payload]),
                    Tally(),
                    None if hz is None else Throttle(hz),
                    WHOLE_BELOW["normal"] if priority is None else priority,
                )
                self._topic(topic, type_name).tallies.append(recorded.tally)
                self._recorded_by_content[content] = recorded
            if len(self._recorded) >= _MAX_CACHED:
                self._recorded.clear()  # they are found again by content
            self._recorded[channel] = recorded
        return recorded

    def _claim(self) -> bool:
        """Tells whether a message is within the limits, and counts it."""
        if self._refused is not None or self._left is None:
            return not self._closed
        with self._lock:
            if self._closed:
                return False
            self._left -= 1
            self._closed = self._left == 0
            is_last = self._closed
        if is_last:
            self._end("the limit of messages is reached")
        return True

    def _store_fields(
        self,
        recorded: _RecordedChannel,
        payload: bytes,
        received: int,
        sent: int | None,
        number: int,
    ) -> bool:
        """Store the fields of a message without its payload; False if they do not fit either."""
        from hybridlog.columns.rows import reduced  # loads pyarrow

        if recorded.reduced is None:
            recorded.reduced = left_channel(recorded.channel, REDUCED)
        is_stored = self._target.write(
            recorded.reduced,
            reduced(codec_for(recorded.channel), payload),
            log_time=received,
            publish_time=sent,
            sequence=number,
            wait=False,
        )
        if is_stored:
            self.say(
                f"{recorded.channel.topic}: messages come faster than the disk writes; of some "
                "only the fields are stored (see the loss ledger)"
            )
            self._lose(recorded, Cause.DEGRADE, "payload dropped, fields stored", received)
        return is_stored

    def _lose(self, recorded: _RecordedChannel, cause: Cause, detail: str, received: int) -> None:
        self.lost(Loss(cause, recorded.channel.topic, 1, received, received, detail))

    def _count_lost(self, topic: str, cause: str, count: int) -> None:
        with self._lock:
            self._topic(topic).lost[cause] += count

    def _refuse(self, cause: Cause, reason: str) -> None:
        """Stop storing; further messages are counted as lost."""
        self._refused = cause, reason
        self._end(reason)

    def _end(self, reason: str) -> None:
        now = self._now()
        with self._lock:
            self._ended_at = now if self._ended_at is None else self._ended_at
            self.reason = self.reason or reason
            self._closed = self._closed or self._refused is None
        self._over.set()

    def _check_limits(self, state: RecorderState) -> None:
        options = self._options
        if options.duration_s is not None and state.elapsed_s >= options.duration_s:
            self._end("the duration is over")
            return
        if self._goes_on and self._recorded and not self._over.is_set():
            with suppress(OSError):
                manifest = self._directory.path / MANIFESTS / f"{self._target.id}.json"
                self.is_full = files.status(manifest).st_size >= _FULL_BYTES
            if self.is_full:
                self._end("its manifest is full")
                return
        # Messages in memory will be written, and those of a second until the next check.
        wanted = options.reserve_bytes + state.filled * options.budget_bytes + state.bytes_per_s
        is_low = state.free_bytes < wanted and not self._over.is_set()
        if is_low and not self._room.make_room(round(wanted)):
            lower = ", or lower --reserve" if options.reserve_bytes else ""
            left = size(state.free_bytes)
            self._refuse(Cause.DISK, f"The disk has only {left} left: free some{lower}.")
        failure = self._target.failure
        if isinstance(failure, DiskFullError):
            self._refuse(Cause.DISK, str(failure))
        elif failure is not None:
            self._end("the recording failed")

    def _check_clock(self, now: float) -> None:
        """Report that the machine's clock was set: log times jump with it."""
        if self._simulated is not None:
            if self._simulated.is_waiting and now - self._started >= _CLOCK_WAIT_S:
                self.say(
                    f"waiting for {CLOCK}: messages are held in memory until it comes. Start the "
                    "simulation, or leave out --use-sim-time"
                )
            return
        by, at = self._clock.look()
        if by:
            where = "forward" if by > 0 else "back"
            text = f"the clock of this machine was set {where} by "
            text += format_duration(round(abs(by), -8))
            self._note_clock(text, {"set_by_ns": str(by)}, at)

    def _note_clock(self, text: str, tags: Mapping[str, str], at: int) -> None:
        """Report that the clock of this machine was set, or is to be, at a log time, ns."""
        self._say(f"{text}; log times are those of the clock")
        self._incidents.note(Mark(new_random(), at, text, {"cause": CLOCK_SET, **tags}))
