"""A sink that remembers, for the tests of live sources."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, NamedTuple

from hybridlog.live.sources.base import Loss
from hybridlog_storage.messages import Channel

DEADLINE_S = 20.0


def must_return(call: Callable[[], object]) -> None:
    """Calls something that must not block, and fails if it does."""
    errors: list[BaseException] = []

    def run() -> None:
        try:
            call()
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(DEADLINE_S)
    assert not thread.is_alive(), f"{call} blocks"
    if errors:
        raise errors[0]


class Taken(NamedTuple):
    channel: Channel
    payload: bytes
    received: int
    sent: int | None
    sequence: int | None


class Heard:
    """A sink that remembers all that it is told, in order."""

    def __init__(self, wanted: Callable[[str, str], bool] = lambda *_: True) -> None:
        self.wanted = wanted
        self.asked: list[tuple[str, str]] = []
        self.expected: list[Channel] = []
        self.unexpected: list[Channel] = []
        self.taken: list[Taken] = []
        self.losses: list[Loss] = []
        self.topics: list[tuple[Any, ...]] = []
        self.said: list[str] = []
        self.times: list[int] = []
        self.ends: list[str] = []
        self._changed = threading.Condition()

    def _note(self, where: list[Any], what: Any) -> None:
        with self._changed:
            where.append(what)
            self._changed.notify_all()

    def until(self, done: Callable[[Heard], object]) -> None:
        with self._changed:
            assert self._changed.wait_for(lambda: done(self), DEADLINE_S), vars(self)

    def wants(self, topic: str, type_name: str) -> bool:
        self._note(self.asked, (topic, type_name))
        return self.wanted(topic, type_name)

    def expect(self, channel: Channel) -> None:
        self._note(self.expected, channel)

    def take(
        self,
        channel: Channel,
        payload: bytes,
        *,
        received: int,
        sent: int | None = None,
        sequence: int | None = None,
    ) -> None:
        if not any(expected is channel for expected in self.expected):
            self._note(self.unexpected, channel)
        self._note(self.taken, Taken(channel, payload, received, sent, sequence))

    def lost(self, loss: Loss) -> None:
        self._note(self.losses, loss)

    def clock(self, now: int, *, received: int) -> None:
        self._note(self.times, now)

    def topic_came(self, topic: str, type_name: str, publishers: int) -> None:
        self._note(self.topics, (topic, type_name, publishers))

    def topic_gone(self, topic: str) -> None:
        self._note(self.topics, (topic,))

    def say(self, text: str) -> None:
        self._note(self.said, text)

    def ended(self, reason: str = "") -> None:
        self._note(self.ends, reason)

    def payloads(self, topic: str = "/a") -> list[bytes]:
        return [taken.payload for taken in self.taken if taken.channel.topic == topic]

    def said_of(self, words: str) -> bool:
        return any(words in line for line in self.said)
