"""Replay of a log in real time, for tests, benchmarks and trials.

A message is due at its time since the first message, divided by the speed. Messages that are
due go out without a pause: many small messages do not cost a pause each, and pauses do not
accumulate errors. They go out in the order of the log, so one that lies behind a later one goes
out with it.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final

from hybridlog.formats.log_set import open_source
from hybridlog.live.sources.base import Cause, Loss, Sink, ThreadedSource
from hybridlog_storage.errors import SourceError

if TYPE_CHECKING:
    from pathlib import Path

    from hybridlog.formats.reading import Damage, Source
    from hybridlog_storage.messages import Batch, Channel

_MIN_PAUSE_S: Final = 0.001  # messages that are due within it go out together
_MAX_PAUSE_S: Final = 3600.0


class ReplaySource(ThreadedSource):
    """Plays any log that hybridlog reads.

    Messages have their original publish time, if the channel has one, and sequence number;
    the receive time is now. Unreadable places are reported as lost without a topic, since
    it is unknown. Attachments and metadata of an MCAP file are ignored.

    Args:
        speed: Seconds of the log per second, above zero.
    """

    kind = "replay"

    def __init__(self, path: Path, *, speed: float = 1.0) -> None:
        super().__init__()
        self.address = str(path)
        self._path = path
        self._speed = speed
        self._source: Source
        self._sink: Sink
        self._present: set[str] = set()
        self._channels: list[Channel | None] = []
        self._told = 0  # damaged places
        self._began: float | None = None  # monotonic time of log time 0

    def check(self) -> None:
        """Check that the log can be opened."""
        open_source(self._path).close()

    def start(self, sink: Sink) -> None:
        """Open the log, and begin to play it."""
        self._source, self._sink = open_source(self._path), sink
        self._begin(sink, self._run)

    def _run(self) -> None:
        """Play the log to its end, or until it is stopped."""
        failure = ""
        with self._source:
            try:
                for batch in self._source.batches():
                    self._source.extras.clear()
                    self._tell_news()
                    if not self._play(batch):
                        return
            except SourceError as error:
                failure = str(error)
            self._tell_news()
        for topic in self._present:
            self._sink.topic_gone(topic)
        self._sink.ended(failure)

    def _play(self, batch: Batch) -> bool:
        """Play some messages; False if the source is stopped."""
        buffer = memoryview(batch.buffer)
        columns = (
            *(batch.log_time, batch.channel, batch.publish_time, batch.sequence),
            *(batch.offset, batch.offset + batch.length),
        )
        rows = zip(*(column.tolist() for column in columns), strict=True)
        for log_time, number, sent, sequence, begin, end in rows:
            if not self._wait_for(log_time):
                return False
            channel = self._channels[number]
            if channel is not None:
                self._sink.take(
                    channel,
                    bytes(buffer[begin:end]),
                    received=time.time_ns(),
                    sent=sent if channel.has_publish_time else None,
                    sequence=sequence or None,
                )
        return True

    def _wait_for(self, log_time: int) -> bool:
        """Wait until a message is due; False if the source is stopped."""
        at = log_time / (1e9 * self._speed)
        if self._began is None:
            self._began = time.monotonic() - at
        while (pause := self._began + at - time.monotonic()) > 0:
            if self._stopping.wait(min(max(pause, _MIN_PAUSE_S), _MAX_PAUSE_S)):
                return False
        return not self._stopping.is_set()

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
        return channel

    def _report(self, damage: Damage) -> None:
        at = "" if damage.offset is None else f", byte {damage.offset}"
        detail = f"{damage.file}{at}: {damage.reason}"
        if damage.messages_lost == 0:
            self._sink.say(detail)
            return
        now = time.time_ns()
        self._sink.lost(Loss(Cause.UNREADABLE, "", damage.messages_lost, now, now, detail))
