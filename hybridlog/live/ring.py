"""A ring buffer of a robot's latest messages, in bounded memory."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from hybridlog.latching import depth_of
from hybridlog_storage.messages import Channel

_MAX_LATCHED = 32 << 20  # payload bytes of one channel; its last message always stays


class BufferedMessage(NamedTuple):
    """A message in the ring."""

    channel: Channel
    payload: bytes
    log_time: int
    publish_time: int | None
    sequence: int


class Ring:
    """Holds the messages of a time span, or as many as fit.

    Latched messages stay until newer ones replace them, whatever their age: later messages
    cannot be understood without them.

    Args:
        span_ns: The span, by the messages' log time.
        max_bytes: Limit for the payload bytes in the ring.
    """

    def __init__(self, span_ns: int, max_bytes: int) -> None:
        self._span = span_ns
        self._max_bytes = max_bytes
        self._messages: deque[BufferedMessage] = deque()
        self._latched: dict[Channel, deque[BufferedMessage]] = {}
        self._bytes = 0
        self._cut = False

    def add(self, message: BufferedMessage) -> None:
        """Add a message, and drop those that are too old or too many."""
        depth = depth_of(message.channel)
        if depth:
            self._latch(message, depth)
        self._messages.append(message)
        self._bytes += len(message.payload)
        oldest = message.log_time - self._span
        while (is_full := self._bytes > self._max_bytes) or (
            self._messages and self._messages[0].log_time < oldest
        ):
            self._cut |= is_full
            self._bytes -= len(self._messages.popleft().payload)

    def since(self, begin: int) -> list[BufferedMessage]:
        """The messages from a log time on, ns, in arrival order.

        Older latched messages come first, with the log time `begin`, so that the slice
        spans no more than requested. Their publish time still tells when they were sent.
        """
        found = [message for message in self._messages if message.log_time >= begin]
        present = {id(message) for message in found}
        front = [
            message._replace(log_time=begin, publish_time=message.publish_time or message.log_time)
            for latched in self._latched.values()
            for message in latched
            if id(message) not in present and message.log_time < begin
        ]
        return front + found

    def latest(self, topic: str, begin: int, limit: int) -> list[BufferedMessage]:
        """The latest messages of a topic since a log time, ns, at most `limit`."""
        found: list[BufferedMessage] = []
        for message in reversed(self._messages):
            if message.log_time < begin or len(found) == limit:
                break
            if message.channel.topic == topic:
                found.append(message)
        return found

    def _latch(self, message: BufferedMessage, depth: int) -> None:
        latched = self._latched.setdefault(message.channel, deque(maxlen=depth))
        latched.append(message)
        while len(latched) > 1 and sum(len(h.payload) for h in latched) > _MAX_LATCHED:
            latched.popleft()

    @property
    def payload_bytes(self) -> int:
        """Payload bytes in the ring."""
        return self._bytes

    @property
    def held_s(self) -> float:
        """Seconds between the oldest and the newest message."""
        if not self._messages:
            return 0.0
        return (self._messages[-1].log_time - self._messages[0].log_time) / 1e9

    @property
    def is_short(self) -> bool:
        """Tells whether memory did not suffice for the whole span."""
        return self._cut
