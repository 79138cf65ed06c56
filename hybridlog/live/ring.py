"""A ring buffer of a robot's latest messages, in bounded memory."""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable
from dataclasses import dataclass, field
from operator import attrgetter
from typing import NamedTuple

from hybridlog.query.latching import KEEP_ALL, depth_of, is_key_frame, is_video, publisher_of
from hybridlog_storage.messages import Channel

_MAX_LATCHED = 32 << 20  # payload bytes of one publisher; its last message always stays


class BufferedMessage(NamedTuple):
    """A message in the ring.

    Attributes:
        set_by: Nanoseconds by which the clock of log times was set before it came.
    """

    channel: Channel
    payload: bytes
    log_time: int
    publish_time: int | None
    sequence: int
    set_by: int = 0

    @property
    def steady(self) -> int:
        """Its log time, ns, if the clock had never been set."""
        return self.log_time - self.set_by


@dataclass(slots=True)
class _Latched:
    """The last messages of a publisher, and the sum of their payload bytes."""

    messages: deque[BufferedMessage] = field(default_factory=deque)
    size: int = 0

    def clear(self) -> None:
        self.messages.clear()
        self.size = 0

    def add(self, message: BufferedMessage, depth: int) -> None:
        self.messages.append(message)
        self.size += len(message.payload)
        while len(self.messages) > depth or (self.size > _MAX_LATCHED and len(self.messages) > 1):
            self.size -= len(self.messages.popleft().payload)


def _latch(latched: dict[Hashable, _Latched], message: BufferedMessage) -> None:
    """Hold a message if its channel latches; the depth bounds how many stay.

    Of video, the frames from the last key frame on are held, if they are not too many.
    """
    channel = message.channel
    depth = KEEP_ALL if is_video(channel) else depth_of(channel)
    if not depth:
        return
    held = latched.setdefault(publisher_of(channel), _Latched())
    if is_video(channel):
        if is_key_frame(channel, message.payload):
            held.clear()
        elif not held.messages or held.size + len(message.payload) > _MAX_LATCHED:
            held.clear()
            return
    held.add(message, depth)


class Ring:
    """Holds the messages of a time span, or as many as fit.

    Latched messages that leave it are held until newer ones that leave it replace them, and
    frames of video from a key frame on until the next one: later messages cannot be understood
    without them.

    Args:
        span_ns: The span, by the messages' steady times.
        max_bytes: Limit for the payload bytes in the ring.

    Attributes:
        payload_bytes: Payload bytes in the ring.
        is_short: Whether memory did not suffice for the whole span.
    """

    def __init__(self, span_ns: int, max_bytes: int) -> None:
        self._span = span_ns
        self._max_bytes = max_bytes
        self._messages: deque[BufferedMessage] = deque()
        self._latched: dict[Hashable, _Latched] = {}
        self.payload_bytes = 0
        self.is_short = False

    def add(self, message: BufferedMessage) -> None:
        """Add a message, and drop those that are too old or too many."""
        self._messages.append(message)
        self.payload_bytes += len(message.payload)
        oldest = message.steady - self._span
        while (is_full := self.payload_bytes > self._max_bytes) or (
            self._messages and self._messages[0].steady < oldest
        ):
            self.is_short |= is_full
            dropped = self._messages.popleft()
            self.payload_bytes -= len(dropped.payload)
            _latch(self._latched, dropped)

    def since(self, begin: int) -> list[BufferedMessage]:
        """The messages from a steady time on, ns, in arrival order.

        The latched messages in force at that time come first, with its log time, so that the
        slice spans no more than requested. Their publish time still tells when they were sent.
        """
        latched: dict[Hashable, _Latched] = {}
        for message in (m for each in self._latched.values() for m in each.messages):
            _latch(latched, message)
        recent = [m for m in self._messages if m.steady >= begin]
        for message in self._messages:
            if message.steady < begin:
                _latch(latched, message)
        front = sorted(
            (m for each in latched.values() for m in each.messages if m.steady < begin),
            key=attrgetter("steady"),
        )
        at = begin + next((m.set_by for m in (*recent[:1], *front[-1:])), 0)
        return [
            *(m._replace(log_time=at, publish_time=m.publish_time or m.log_time) for m in front),
            *recent,
        ]

    def latest(self, topic: str, begin: int, limit: int) -> list[BufferedMessage]:
        """The latest messages of a topic since a steady time, ns, at most `limit`."""
        found: list[BufferedMessage] = []
        for message in reversed(self._messages):
            if message.steady < begin or len(found) == limit:
                break
            if message.channel.topic == topic:
                found.append(message)
        return found

    @property
    def held_s(self) -> float:
        """Seconds between the oldest and the newest message."""
        if not self._messages:
            return 0.0
        return (self._messages[-1].steady - self._messages[0].steady) / 1e9
