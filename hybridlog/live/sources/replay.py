"""Replay of a log in real time, for tests, benchmarks and trials.

One thread reads ahead, another keeps time. A message is due at its time since the first
message, divided by the speed. All due messages go out at once: many small messages do not
cost a pause each, and pauses do not accumulate errors.

Messages go out in the order of log time, within a lookahead of some tens of megabytes.
Messages that lie farther out of order, as in concatenated logs, are sent when they are read.
"""

from __future__ import annotations

import math
import queue
import threading
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, cast

import numpy as np

from hybridlog.formats.log_set import open_source
from hybridlog.live.sources.base import Cause, LiveSource, Loss, Sink
from hybridlog.live.sources.replay_order import Lookahead, Rows
from hybridlog_storage.errors import SourceError, UsageError

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from hybridlog.formats.reading import Damage, Source
    from hybridlog_storage.messages import Channel

_MIN_PAUSE_S: Final = 0.001  # messages that are due within it go out together
_MAX_PAUSE_S: Final = 3600.0
_LATE_S: Final = 0.5
_LONG_S: Final = 60.0
_MAX_MESSAGES: Final = 1024  # messages between two reads of the clock
_TICK_S: Final = 0.1
_JOIN_S: Final = 5.0


@dataclass(frozen=True, slots=True)
class _Step:
    """Messages that the reading thread passes to the playing one.

    Attributes:
        rows: Messages, or None.
        channels: Channels of the log, as far as it is read.
        damage: Unreadable places.
        end: This is the last step.
        error: The error that ended reading.
    """

    rows: Rows | None
    channels: list[Channel]
    damage: list[Damage]
    end: bool = False
    error: BaseException | None = None


class ReplaySource(LiveSource):
    """Plays any log that hybridlog reads.

    Messages have their original publish time, if the channel has one, and sequence number;
    the receive time is now. Unreadable places are reported as lost without a topic, since
    it is unknown. Attachments and metadata of an MCAP file are ignored.

    Args:
        path: The log.
        speed: Seconds of the log per second: positive and finite. A sink or disk that
            cannot keep up is reported once.

    Raises:
        UsageError: The speed is not positive and finite.
    """

    kind = "replay"

    def __init__(self, path: Path, *, speed: float = 1.0) -> None:
        if not (math.isfinite(speed) and speed > 0):
            raise UsageError(
                f"a log cannot be played at speed {speed:g}; give a number above zero, 1 for "
                "real time"
            )
        self.address = str(path)
        self._path = path
        self._speed = speed
        self._stop = threading.Event()
        self._steps: queue.Queue[_Step] = queue.Queue(maxsize=2)
        self._threads: list[threading.Thread] = []

    def check(self) -> None:
        """Check that the log can be opened.

        Raises:
            SourceError: The file is not a readable log.
        """
        open_source(self._path).close()

    def start(self, sink: Sink) -> None:
        """Open the log, and begin to play it.

        Raises:
            SourceError: The file is not a readable log.
        """
        source = open_source(self._path)
        player = _Player(sink, self.address, self._speed, self._stop)

        def play() -> None:
            player.play(self._received())

        self._threads = [
            threading.Thread(
                target=self._read, args=(source,), name="hybridlog-replay-read", daemon=True
            ),
            threading.Thread(target=play, name="hybridlog-replay", daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """Stop, even in a pause. All messages that are due have been sent."""
        self._stop.set()
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(_JOIN_S)

    def _received(self) -> Iterator[_Step]:
        """Steps of the reading thread, until it ends or the source is stopped."""
        while not self._stop.is_set():
            try:
                yield self._steps.get(timeout=_TICK_S)
            except queue.Empty:
                continue

    def _put(self, step: _Step) -> bool:
        """Pass a step on; False if the source is stopped."""
        while not self._stop.is_set():
            try:
                self._steps.put(step, timeout=_TICK_S)
            except queue.Full:
                continue
            return True
        return False

    # The reading thread.

    def _read(self, source: Source) -> None:
        error: BaseException | None = None
        try:
            self._read_all(source)
        except BaseException as caught:  # the playing thread raises or reports it
            error = caught
        self._put(_Step(None, [], [], end=True, error=error))

    def _read_all(self, source: Source) -> None:
        """Read a log to its end, or until the source is stopped."""
        lookahead = Lookahead()
        known = 0
        with source:
            for batch in source.batches():
                if self._stop.is_set():
                    return
                source.extras.clear()
                rows = lookahead.add(batch)
                if rows is None:
                    continue
                step = _Step(rows, list(source.channels), source.damage[known:])
                known = len(source.damage)
                if not self._put(step):
                    return
            self._put(_Step(lookahead.rest(), list(source.channels), source.damage[known:]))


class _Player:
    """Sends messages when they are due, on its own thread.

    Args:
        sink: Takes the messages.
        name: Name of the log for messages to the user.
        speed: Seconds of the log per second.
        stop: Set to stop playing.
    """

    def __init__(self, sink: Sink, name: str, speed: float, stop: threading.Event) -> None:
        self._sink = sink
        self._name = name
        self._speed = speed
        self._stop = stop
        self._is_late = False
        self._publishers: Counter[str] = Counter()
        self._channels: list[Channel | None] = []
        self._first: int | None = None
        self._newest = 0
        self._waited_for = -1
        self._start = self._last_due = 0.0

    def play(self, steps: Iterator[_Step]) -> None:
        """Play all steps."""
        try:
            for step in steps:
                if step.end:
                    self._wait_for_the_end()
                    self._end(step.error)
                    return
                self._begin(step)
                if step.rows is not None:
                    self._play(step.rows)
        except BaseException as error:
            if not self._stop.is_set():
                self._sink.ended(f"{self._name}: playing failed ({error!r})")
            raise

    def _end(self, error: BaseException | None) -> None:
        if error is not None and not isinstance(error, SourceError):
            raise error
        if self._stop.is_set():
            return
        for topic in self._publishers:
            self._sink.topic_gone(topic)
        self._sink.ended("" if error is None else str(error))

    # Channels and damage.

    def _begin(self, step: _Step) -> None:
        for channel in step.channels[len(self._channels) :]:
            self._channels.append(self._add(channel))
        for damage in step.damage:
            self._report(damage)

    def _add(self, channel: Channel) -> Channel | None:
        """The channel that the sink knows, None if it does not want the topic."""
        type_name = "" if channel.schema is None else channel.schema.name
        if not self._sink.wants(channel.topic, type_name):
            return None
        self._publishers[channel.topic] += 1
        self._sink.topic_came(channel.topic, type_name, self._publishers[channel.topic])
        self._sink.expect(channel)
        return channel

    def _report(self, damage: Damage) -> None:
        place = str(damage.file)
        if damage.offset is not None:
            place += f", byte {damage.offset}"
            if damage.length is not None:
                place += f" to {damage.offset + damage.length}"
        detail = f"{place}: {damage.reason}"
        if damage.messages_lost == 0:
            self._sink.say(detail)
            return
        now = time.time_ns()
        self._sink.lost(Loss("", Cause.UNREADABLE, damage.messages_lost, now, now, detail))

    # The messages.

    def _play(self, rows: Rows) -> None:
        if self._first is None:
            self._first = self._newest = int(rows.table.log_time[0])
            self._start = time.monotonic()
        due = self._due(rows)
        self._last_due = max(self._last_due, float(due[-1]))
        wanted = np.array([channel is not None for channel in self._channels])
        rows = rows.take(np.flatnonzero(wanted[rows.table.channel]))
        times, due = rows.table.log_time, self._due(rows)
        at = 0
        while at < len(rows):
            now = time.monotonic()
            ready = int(np.searchsorted(due, now, side="right"))
            if ready <= at:
                if self._pause(float(due[at]) - now, int(times[at])):
                    return
                continue
            ready = min(ready, at + _MAX_MESSAGES)
            newest = int(times[ready - 1])
            # A message in the wrong place of the log is not played late.
            if newest >= self._newest:
                self._newest = newest
                self._check_lateness(now - float(due[ready - 1]))
            self._send(rows.take(slice(at, ready)))
            at = ready
            if self._stop.is_set():
                return

    def _due(self, rows: Rows) -> NDArray[np.float64]:
        """Times at which messages are due, by the monotonic clock."""
        elapsed = rows.table.log_time - (self._first or 0)
        return self._start + elapsed / (1e9 * self._speed)

    def _wait_for_the_end(self) -> None:
        """Wait until the last message is due, even if its topic is not recorded."""
        while not self._stop.is_set():
            pause = self._last_due - time.monotonic()
            if pause <= 0:
                return
            self._stop.wait(min(pause, _MAX_PAUSE_S))

    def _pause(self, pause: float, moment: int) -> bool:
        """Wait for the message of a log time; True if the source is stopped."""
        if pause > _LONG_S and moment != self._waited_for:
            self._waited_for = moment
            self._sink.say(
                f"{self._name}: the log has no message until {moment / 1e9:.3f} s since the "
                f"epoch; that takes {pause:.0f} s, less at a higher speed"
            )
        return self._stop.wait(min(max(pause, _MIN_PAUSE_S), _MAX_PAUSE_S))

    def _check_lateness(self, behind: float) -> None:
        if behind > _LATE_S and not self._is_late:
            self._is_late = True
            self._sink.say(
                f"{self._name}: cannot be played at speed {self._speed:g}, messages are "
                f"{behind:.1f} s late; none is skipped, but a lower speed keeps their timing"
            )

    def _send(self, rows: Rows) -> None:
        table, take, clock = rows.table, self._sink.take, time.time_ns
        channels = cast("list[Channel]", self._channels)  # unwanted ones are gone
        columns = (table.channel, table.publish_time, table.sequence)
        for payload, number, publish_time, sequence in zip(
            rows.payloads(), *(column.tolist() for column in columns), strict=True
        ):
            channel = channels[number]
            take(
                channel,
                payload,
                received=clock(),
                sent=publish_time if channel.has_publish_time else None,
                sequence=sequence or None,
            )
