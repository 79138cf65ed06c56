"""A sink that remembers, for the tests of live sources."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any, NamedTuple, Self

from hybridlog.live.sources.base import Loss
from hybridlog_storage.messages import Channel

DEADLINE_S = 30.0


def must_return(call: Callable[[], object]) -> None:
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


class Listening:
    """Serves each connection in a thread of its own, until the block ends."""

    def __init__(
        self, serve: Callable[[socket.socket], None], host: str = "127.0.0.1", port: int = 0
    ) -> None:
        self._serve = serve
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._socket = socket.create_server((host, port), family=family)
        self.port = int(self._socket.getsockname()[1])
        self._peers: list[socket.socket] = []
        self._threads = [threading.Thread(target=self._accept)]

    def __enter__(self) -> Self:
        self._threads[0].start()
        return self

    def __exit__(self, *_: object) -> None:
        for each in (self._socket, *self._peers):
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join(DEADLINE_S)
            assert not thread.is_alive()
        self._socket.close()

    def _accept(self) -> None:
        while True:
            try:
                made, _ = self._socket.accept()
            except OSError:
                return
            made.settimeout(DEADLINE_S)
            self._peers.append(made)
            self._threads.append(threading.Thread(target=self._play, args=(made,)))
            self._threads[-1].start()

    def _play(self, made: socket.socket) -> None:
        with made, suppress(OSError, EOFError):  # the other side has hung up
            self._serve(made)


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
        self.taken: list[Taken] = []
        self.losses: list[Loss] = []
        self.topics: list[tuple[Any, ...]] = []
        self.said: list[str] = []
        self.ends: list[str] = []
        self._changed = threading.Condition()

    def _note(self, where: list[Any], what: Any) -> None:
        with self._changed:
            where.append(what)
            self._changed.notify_all()

    def wait(self, condition: Callable[[], object], what: str = "") -> None:
        """Until something is so, which can change with any call."""
        with self._changed:
            assert self._changed.wait_for(condition, DEADLINE_S), (what, vars(self))

    def until(self, done: Callable[[Heard], object]) -> None:
        self.wait(lambda: done(self))

    @property
    def came(self) -> list[tuple[Any, ...]]:
        return [told for told in self.topics if len(told) > 1]

    @property
    def gone(self) -> list[str]:
        return [told[0] for told in self.topics if len(told) == 1]

    def wants(self, topic: str, type_name: str) -> bool:
        self._note(self.asked, (topic, type_name))
        return self.wanted(topic, type_name)

    def take(
        self,
        channel: Channel,
        payload: bytes,
        *,
        received: int,
        sent: int | None = None,
        sequence: int | None = None,
    ) -> None:
        self._note(self.taken, Taken(channel, payload, received, sent, sequence))

    def lost(self, loss: Loss) -> None:
        self._note(self.losses, loss)

    def topic_came(self, topic: str, type_name: str) -> None:
        self._note(self.topics, (topic, type_name))

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
