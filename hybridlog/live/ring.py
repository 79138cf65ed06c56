"""The last minute of what a robot said, in bounded memory."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from hybridlog.latching import depth_of
from hybridlog_storage.messages import Channel

_MOST_LATCHED = 32 << 20  # payload bytes of one channel; its last message stays in any case


class Held(NamedTuple):
    """A message that may be wanted."""

    channel: Channel
    payload: bytes
    log_time: int
    publish_time: int | None
    sequence: int


class Ring:
    """Keeps messages for so long, or as many as fit.

    Latched messages stay until they are replaced, however old they are: without them what
    follows cannot be understood.

    Args:
        span_ns: How long; the time is the messages' own log time.
        most_bytes: Payload bytes that are kept at most.
    """

    def __init__(self, span_ns: int, most_bytes: int) -> None:
        self._span = span_ns
        self._most = most_bytes
        self._messages: deque[Held] = deque()
        self._latched: dict[Channel, deque[Held]] = {}
        self._bytes = 0
        self._cut = False

    def add(self, message: Held) -> None:
        """Keep a message, and let go of those that are too old or too many."""
        depth = depth_of(message.channel)
        if depth:
            self._latch(message, depth)
        self._messages.append(message)
        self._bytes += len(message.payload)
        oldest = message.log_time - self._span
        while self._bytes > self._most or (self._messages and self._messages[0].log_time < oldest):
            self._cut |= self._bytes > self._most
            self._bytes -= len(self._messages.popleft().payload)

    def since(self, begin: int) -> list[Held]:
        """What is kept from a log time on, ns, in the order in which it came.

        Latched messages from before stand in front, with the log time `begin`: so a slice
        spans no more than was asked for. Their publish time keeps saying when they were
        sent.
        """
        found = [held for held in self._messages if held.log_time >= begin]
        there = {id(held) for held in found}
        front = [
            held._replace(log_time=begin, publish_time=held.publish_time or held.log_time)
            for latched in self._latched.values()
            for held in latched
            if id(held) not in there and held.log_time < begin
        ]
        return front + found

    def latest(self, topic: str, begin: int, most: int) -> list[Held]:
        """The latest messages of a topic since a log time, ns, at most so many."""
        found: list[Held] = []
        for held in reversed(self._messages):
            if held.log_time < begin or len(found) == most:
                break
            if held.channel.topic == topic:
                found.append(held)
        return found

    def _latch(self, message: Held, depth: int) -> None:
        latched = self._latched.setdefault(message.channel, deque(maxlen=depth))
        latched.append(message)
        while len(latched) > 1 and sum(len(h.payload) for h in latched) > _MOST_LATCHED:
            latched.popleft()

    @property
    def payload_bytes(self) -> int:
        """Bytes that are kept now."""
        return self._bytes

    @property
    def held_s(self) -> float:
        """Seconds between the oldest and the newest message."""
        if not self._messages:
            return 0.0
        return (self._messages[-1].log_time - self._messages[0].log_time) / 1e9

    @property
    def is_short(self) -> bool:
        """Whether memory has not sufficed for the whole span."""
        return self._cut
