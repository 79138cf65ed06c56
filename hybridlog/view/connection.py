"""Connections that must ask something: those that only wait are closed."""

from __future__ import annotations

import asyncio
from typing import Any, Final

from uvicorn.protocols.http.h11_impl import H11Protocol

MAX_STRANGERS: Final = 64
"""Connections without a request that has the token; the oldest one makes room for another."""


class BoundedConnection(H11Protocol):
    """A connection whose requests arrive whole within a time, and in bounded memory.

    Otherwise any local user could hold all connections with requests that never end.

    Attributes:
        patience_s: Time for a request to arrive, from the connection or the last answer on.
        is_stranger: True until a request has the token.
        since: Time of the event loop at which it was made.
    """

    patience_s = 30.0

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._waiting: asyncio.TimerHandle | None = None
        self.is_stranger = True
        self.since = self.loop.time()

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """A client has connected."""
        super().connection_made(transport)
        self._wait()
        known: set[Any] = self.connections
        strangers = [one for one in known if one.is_stranger]
        if len(strangers) > MAX_STRANGERS:
            oldest = min(strangers, key=lambda one: one.since)
            known.discard(oldest)  # it is lost a little later
            oldest.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """The connection is closed."""
        self._stop_waiting()
        super().connection_lost(exc)

    def handle_events(self) -> None:
        """Something has arrived."""
        before = self.cycle
        super().handle_events()
        if self.cycle is not before:
            self._stop_waiting()
            guard: Any = self.config.app
            self.is_stranger &= not guard.rules.knows(self.scope["path"])

    def on_response_complete(self) -> None:
        """A request is answered."""
        self._wait()
        super().on_response_complete()

    def _wait(self) -> None:
        self._stop_waiting()
        self._waiting = self.loop.call_later(self.patience_s, self._give_up)

    def _stop_waiting(self) -> None:
        if self._waiting is not None:
            self._waiting.cancel()
            self._waiting = None

    def _give_up(self) -> None:
        if self.transport.get_write_buffer_size():
            self._wait()  # a slow reader, who has asked already
        else:
            self.transport.abort()
