"""Connects to a Foxglove server, reads until the connection ends, and reconnects."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Final

from hybridlog.live.sources.base import Sink
from hybridlog.live.sources.foxglove.connection import Connection
from hybridlog.live.sources.foxglove.handshake import StoppedError, open_websocket, websocket_uri
from hybridlog.live.sources.foxglove.protocol import Address, PeerError
from hybridlog.live.sources.foxglove.session import Notifier, Session

_PAUSES_S: Final = (0.5, 1.0, 2.0, 4.0, 8.0, 15.0)
_STABLE_S: Final = 10.0  # after a connection of this length the pauses are short again


class Client:
    """The client, which runs in the thread of a Foxglove source.

    Args:
        sink: Takes the messages.
        address: The server.
        max_message_bytes: Largest payload.
        stop: Set to stop the client.
        reached: Called after each handshake.

    Raises:
        UsageError: The address is invalid.
    """

    def __init__(
        self,
        sink: Sink,
        address: Address,
        max_message_bytes: int,
        stop: threading.Event,
        reached: Callable[[], None],
    ) -> None:
        websocket_uri(address)
        self._sink = sink
        self._notifier = Notifier(sink, address.shown)
        self._address = address
        self._limit = max_message_bytes
        self._stop = stop
        self._reached = reached
        self._missed: dict[str, int] = {}

    def run(self) -> None:
        """Connect, read and reconnect until stopped."""
        try:
            self._run()
        except BaseException as error:
            if not self._stop.is_set():
                self._sink.ended(f"{self._address.shown}: reading failed ({error!r})")
            raise

    def _run(self) -> None:
        failures = 0
        while not self._stop.is_set():
            began = time.monotonic()
            reason = self._connect()
            if self._stop.is_set():
                return
            self._notifier.say(f"{reason}; trying again")
            if time.monotonic() - began > _STABLE_S:
                failures = 0
            self._stop.wait(_PAUSES_S[min(failures, len(_PAUSES_S) - 1)])
            failures += 1

    def _connect(self) -> str:
        """Make one connection, and read it to its end.

        Returns:
            The reason of the end, for the user.
        """
        try:
            opened = open_websocket(self._address, self._stop.is_set)
            with opened.socket:
                self._reached()
                connection = Connection(opened, self._limit, self._stop.is_set)
                session = Session(self._sink, self._notifier, connection.send, self._missed)
                try:
                    return connection.read(session)
                finally:
                    session.end(is_stopped=self._stop.is_set())
        except PeerError as error:
            return str(error)
        except StoppedError:
            return ""
