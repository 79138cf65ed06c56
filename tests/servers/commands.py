"""The commands that MongoDB gets: their number is the same on every machine and network."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from pymongo import monitoring

_QUIET = frozenset({"hello", "isMaster", "ping", "endSessions"})


class _Listener(monitoring.CommandListener):
    def __init__(self) -> None:
        self.heard: list[list[str]] = []

    def started(self, event: monitoring.CommandStartedEvent) -> None:
        if event.command_name not in _QUIET:
            for names in self.heard:
                names.append(event.command_name)

    def succeeded(self, event: Any) -> None: ...

    def failed(self, event: Any) -> None: ...


_LISTENER = _Listener()
monitoring.register(_LISTENER)


@contextmanager
def commands() -> Iterator[list[str]]:
    """Names of the commands that are sent meanwhile, by connections made from now on."""
    names: list[str] = []
    _LISTENER.heard.append(names)
    try:
        yield names
    finally:
        # By identity: lists of equal names are equal.
        _LISTENER.heard[:] = [other for other in _LISTENER.heard if other is not names]
