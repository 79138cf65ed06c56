"""A source that says what a test wants."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import hybridlog as hl
from hybridlog.live.clocks import MachineClock
from hybridlog.live.recorder import Recorder, RecorderOptions
from hybridlog.live.sources.base import LiveSource, Sink
from hybridlog.maintenance.edit import mark_now
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests.waiting import wait_for

TEXT = Schema("std_msgs/String", "ros1msg", b"string data\n")
SCAN = Schema("test_msgs/Scan", "ros1msg", b"uint32 id\nfloat32 near\nuint8[] data\n")


def text_channel(topic: str = "/chatter") -> Channel:
    return Channel(topic, "ros1", TEXT, {}, has_publish_time=False)


def scan_channel(topic: str = "/scan") -> Channel:
    return Channel(topic, "ros1", SCAN, {}, has_publish_time=False)


def text(content: str | bytes) -> bytes:
    data = content.encode() if isinstance(content, str) else content
    return len(data).to_bytes(4, "little") + data


def scan(number: int, size: int) -> bytes:
    import struct

    return struct.pack("<IfI", number, number / 2, size) + bytes([number % 256]) * size


class Speaker(LiveSource):
    """Hands its sink over to the test when it is started."""

    kind = "test"
    address = "a test"

    def __init__(self, speak: Callable[[Sink], None] | None = None) -> None:
        self.sink: Sink | None = None
        self.stopped = 0
        self._speak = speak

    def start(self, sink: Sink) -> None:
        self.sink = sink
        if self._speak is not None:
            self._speak(sink)

    def stop(self) -> None:
        self.stopped += 1

    def say(self, channel: Channel, payload: bytes, received: int | None = None) -> None:
        assert self.sink is not None
        self.sink.take(channel, payload, received=time.time_ns() if received is None else received)


class Recorded:
    """A recorder with one speaker, and what it has said."""

    def __init__(
        self,
        store: hl.Store,
        options: RecorderOptions,
        speaker: Speaker | None = None,
        *clock: MachineClock,
    ) -> None:
        self.speaker = speaker or Speaker()
        self.said: list[str] = []
        self.recorder = Recorder(store, [self.speaker], options, self.said.append, *clock)
        self.recorder.start()
        self.store = store

    def mark(self, note: str, tags: dict[str, str], *around: int) -> str:
        """Mark the present moment, as another process does."""
        pair = (around[0], around[1]) if around else None
        target, now = self.recorder._target, time.time_ns()
        return mark_now(self.store.directory, target.id, now, note, tags, around=pair)


class Robot(Recorded):
    """A recorder of texts."""

    def say(self, topic: str, *texts: str, time: int | None = None) -> None:
        for content in texts:
            self.speaker.say(text_channel(topic), text(content), time)
            self.recorder.look()

    def hold(self) -> None:
        """Write nothing any more."""
        self.recorder._target._take = lambda: None  # type: ignore[method-assign]

    def kill(self) -> None:
        """Leave what a killed process leaves."""
        target = self.recorder._target
        target._end()
        target.capture.abort()


@contextmanager
def talking(
    path: Path, segment_s: float = 600, flush_s: float = 0.2
) -> Iterator[tuple[Robot, hl.Store]]:
    """A robot that has said `first` on /a, and its store as somebody else opens it."""
    options = RecorderOptions(
        reserve_bytes=0,
        flush_interval_s=flush_s,
        settings=SegmentSettings(segment_span_s=segment_s),
        derives=False,
    )
    with hl.open(path, create=True) as own, hl.open(path) as opened:
        one = Robot(own, options)
        one.say("/a", "first", time=1_000_000_000)
        wait_until_flushed(opened, 1)
        yield one, opened


def wait_until_flushed(store: hl.Store, count: int) -> None:
    wait_for(lambda: sum(one.messages for one in store.session.look().summaries) >= count)
