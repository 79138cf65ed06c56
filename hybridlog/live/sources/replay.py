"""Replay of a log in real time, for tests, benchmarks and trials.

A message is due at its time since the first message, divided by the speed. Messages that are
due go out without a pause: many small messages do not cost a pause each, and pauses do not
accumulate errors.

Messages go out in the order of log time, within a lookahead of some tens of megabytes.
Messages that lie farther out of order, as in concatenated logs, are sent when they are read.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from itertools import count
from typing import TYPE_CHECKING, Final, NamedTuple

from hybridlog.formats.log_set import open_source
from hybridlog.live.sources.base import Cause, Loss, Sink, ThreadedSource
from hybridlog_storage.errors import SourceError

if TYPE_CHECKING:
    from pathlib import Path

    from hybridlog.formats.reading import Damage, Source
    from hybridlog_storage.messages import Channel

_MIN_PAUSE_S: Final = 0.001  # messages that are due within it go out together
_MAX_PAUSE_S: Final = 3600.0
_LATE_S: Final = 0.5
_LONG_S: Final = 60.0
_WINDOW: Final = 32 << 20  # payload bytes of the lookahead
_WINDOW_ROWS: Final = 1 << 17


class _Message(NamedTuple):
    log_time: int
    place: int  # in the log
    channel: int
    publish_time: int
    sequence: int
    payload: bytes


class ReplaySource(ThreadedSource):
    """Plays any log that hybridlog reads.

    Messages have their original publish time, if the channel has one, and sequence number;
    the receive time is now. Unreadable places are reported as lost without a topic, since
    it is unknown. Attachments and metadata of an MCAP file are ignored.

    Args:
        speed: Seconds of the log per second, above zero. A sink or disk that cannot keep up is
            reported once.
    """

    kind = "replay"

    def __init__(self, path: Path, *, speed: float = 1.0) -> None:
        super().__init__()
        self.address = str(path)
        self._path = path
        self._speed = speed
        self._source: Source
        self._sink: Sink
        self._is_late = False
        self._present: set[str] = set()
        self._channels: list[Channel | None] = []
        self._told = 0  # damaged places
        self._failure = ""
        self._waited_for = -1

    def check(self) -> None:
        """Check that the log can be opened."""
        open_source(self._path).close()

    def start(self, sink: Sink) -> None:
        """Open the log, and begin to play it."""
        self._source, self._sink = open_source(self._path), sink
        self._begin(sink, self._run)

    def _run(self) -> None:
        """Play the log to its end, or until it is stopped."""
        with self._source:
            self._play()
        if not self._stopping.is_set():
            for topic in self._present:
                self._sink.topic_gone(topic)
            self._sink.ended(self._failure)

    def _play(self) -> None:
        start, first, newest = time.monotonic(), None, 0
        for message in self._messages():
            if first is None:
                start, first = time.monotonic(), message.log_time
            due = start + (message.log_time - first) / (1e9 * self._speed)
            while (pause := due - time.monotonic()) > 0:
                if self._pause(pause, message.log_time):
                    return
            # A message in the wrong place of the log is not played late.
            if message.log_time >= newest:
                newest = message.log_time
                self._check_lateness(-pause)
            self._send(message)
            if self._stopping.is_set():
                return

    def _messages(self) -> Iterator[_Message]:
        """The messages in the order of log time, as far as one looks ahead."""
        waiting: list[_Message] = []
        places = count()
        size = 0
        try:
            for batch in self._source.batches():
                if self._stopping.is_set():
                    return
                self._source.extras.clear()
                self._tell_news()
                columns = (
                    *(batch.log_time, batch.channel, batch.publish_time, batch.sequence),
                    *(batch.offset, batch.offset + batch.length),
                )
                buffer = memoryview(batch.buffer)
                rows = zip(*(column.tolist() for column in columns), strict=True)
                waiting += [
                    _Message(at, next(places), channel, sent, sequence, bytes(buffer[begin:end]))
                    for at, channel, sent, sequence, begin, end in rows
                ]
                waiting.sort()
                size += batch.payload_bytes
                out = 0
                while size > _WINDOW or len(waiting) - out > _WINDOW_ROWS:
                    yield waiting[out]
                    size -= len(waiting[out].payload)
                    out += 1
                del waiting[:out]
        except SourceError as error:
            self._failure = str(error)
        self._tell_news()
        yield from waiting

    # Channels and damage.

    def _tell_news(self) -> None:
        """Tell the channels and the damage that the last read has found."""
        for channel in self._source.channels[len(self._channels) :]:
            self._channels.append(self._add(channel))
        for damage in self._source.damage[self._told :]:
            self._report(damage)
        self._told = len(self._source.damage)

    def _add(self, channel: Channel) -> Channel | None:
        """The channel that the sink knows, None if it does not want the topic."""
        type_name = "" if channel.schema is None else channel.schema.name
        if not self._sink.wants(channel.topic, type_name):
            return None
        if channel.topic not in self._present:
            self._present.add(channel.topic)
            self._sink.topic_came(channel.topic, type_name)
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
        self._sink.lost(Loss(Cause.UNREADABLE, "", damage.messages_lost, now, now, detail))

    # The messages.

    def _pause(self, pause: float, moment: int) -> bool:
        """Wait for the message of a log time; True if the source is stopped."""
        if pause > _LONG_S and moment != self._waited_for:
            self._waited_for = moment
            self._sink.say(
                f"{self.address}: the log has no message until {moment / 1e9:.3f} s since the "
                f"epoch; that takes {pause:.0f} s, less at a higher speed"
            )
        return self._stopping.wait(min(max(pause, _MIN_PAUSE_S), _MAX_PAUSE_S))

    def _check_lateness(self, behind: float) -> None:
        if behind > _LATE_S and not self._is_late:
            self._is_late = True
            self._sink.say(
                f"{self.address}: cannot be played at speed {self._speed:g}, messages are "
                f"{behind:.1f} s late; none is skipped, but a lower speed keeps their timing"
            )

    def _send(self, message: _Message) -> None:
        channel = self._channels[message.channel]
        if channel is not None:
            self._sink.take(
                channel,
                message.payload,
                received=time.time_ns(),
                sent=message.publish_time if channel.has_publish_time else None,
                sequence=message.sequence or None,
            )
