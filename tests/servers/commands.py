"""The commands that MongoDB gets: their number is the same on every machine and network."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

from pymongo import monitoring

_QUIET = frozenset({"hello", "isMaster", "ping", "endSessions"})


class Sent(NamedTuple):
    """A command: its name, the collection that it asks, and the read concern it asks for."""

    name: str
    collection: str
    read: str


class _Listener(monitoring.CommandListener):
    def __init__(self) -> None:
        self.heard: list[list[Sent]] = []

    def started(self, event: monitoring.CommandStartedEvent) -> None:
        if event.command_name not in _QUIET:
            read = event.command.get("readConcern", {}).get("level", "local")
            for sent in self.heard:
                asked = str(event.command.get(event.command_name))
                sent.append(Sent(event.command_name, asked, read))

    def succeeded(self, event: Any) -> None: ...

    def failed(self, event: Any) -> None: ...


_LISTENER = _Listener()
monitoring.register(_LISTENER)


@contextmanager
def commands() -> Iterator[list[Sent]]:
    """The commands that are sent meanwhile, by connections made from now on."""
    sent: list[Sent] = []
    _LISTENER.heard.append(sent)
    try:
        yield sent
    finally:
        # By identity: lists of equal commands are equal.
        _LISTENER.heard[:] = [other for other in _LISTENER.heard if other is not sent]
