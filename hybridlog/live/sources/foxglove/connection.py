"""Connects to a Foxglove server, and reads until stopped."""

from __future__ import annotations

import asyncio
import logging
import socket
import ssl
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from math import inf
from typing import Any, Final

from picows import (
    WSCloseCode,
    WSHandshakeError,
    WSListener,
    WSProtocolError,
    WSTransport,
    ws_connect,
)

from hybridlog.live.sources.base import Cause, Loss, PeerError, Sink, one_line
from hybridlog.live.sources.foxglove.protocol import Address
from hybridlog.live.sources.foxglove.session import Session
from hybridlog.live.sources.network import Endpoint, Network, reason_of

_TICK_S: Final = 0.25  # interval at which a silent connection checks whether to stop
_OPEN_S: Final = 10.0
_CLOSE_S: Final = 1.0
_PING_S: Final = 10.0  # silence after which a ping is sent, and then until the end
_PAUSES_S: Final = (0.5, 1.0, 2.0, 4.0, 8.0, 15.0)
_STABLE_S: Final = 10.0  # after a connection of this length the pauses are short again
_SILENT: Final = logging.Logger("picows", logging.CRITICAL + 1)  # the user is told by us


class Client:
    """The client, which runs in the thread of a Foxglove source."""

    def __init__(
        self,
        sink: Sink,
        address: Address,
        stop: threading.Event,
        reached: Callable[[], None],
    ) -> None:
        self._sink = sink
        self._address = address
        self._stop = stop
        self._reached = reached
        self._missed: dict[str, int] = {}

    def run(self) -> None:
        """Connect, read and reconnect until stopped."""
        failures = 0
        while not self._stop.is_set():
            began = time.monotonic()
            try:
                reason = asyncio.run(self._connect())
            except PeerError as error:
                reason = str(error)
            if self._stop.is_set():
                return
            self._sink.say(f"{self._address.shown}: {one_line(reason)}; trying again")
            if time.monotonic() - began > _STABLE_S:
                failures = 0
            self._stop.wait(_PAUSES_S[min(failures, len(_PAUSES_S) - 1)])
            failures += 1

    async def _connect(self) -> str:
        """Make one connection, and read it to its end; returns the reason, for the user."""
        session = Session(self._sink, self._address.shown, self._missed)
        opening = asyncio.ensure_future(self._open(session))
        if not await self._has_ended(opening, _OPEN_S):
            opening.cancel()
            await asyncio.wait({opening})
            raise PeerError(f"does not answer within {_OPEN_S:g} s; check host and port")
        transport = opening.result()
        ended = asyncio.ensure_future(transport.wait_disconnected())
        try:
            if session.problem is None:
                self._reached()
            if not await self._has_ended(ended, inf):
                transport.send_close(WSCloseCode.OK)  # messages under way still come
                await asyncio.wait({ended}, timeout=_CLOSE_S)
        finally:
            transport.disconnect(graceful=False)
            await asyncio.wait({ended})
            session.end(is_stopped=self._stop.is_set())
        error = ended.exception()
        return self._reason(transport, session.problem or error)

    async def _has_ended(self, work: asyncio.Future[Any], seconds: float) -> bool:
        """Wait for work to end, at most some seconds and until the source is stopped."""
        deadline = time.monotonic() + seconds
        while not (work.done() or self._stop.is_set() or time.monotonic() > deadline):
            await asyncio.wait({work}, timeout=_TICK_S)
        return work.done()

    def _reason(self, transport: WSTransport, problem: BaseException | None) -> str:
        if isinstance(problem, WSProtocolError):
            if problem.code != WSCloseCode.MESSAGE_TOO_BIG:
                return f"violates the websocket protocol ({problem})"
            now = time.time_ns()
            detail = "a message exceeds the limit of this source"
            self._sink.lost(Loss("", Cause.UNREADABLE, 1, now, now, detail))
            size = Session.max_bytes
            return f"announces a message of more than {size} bytes; is it a Foxglove server?"
        if problem is not None:
            raise problem
        closing = transport.close_handshake
        if closing is not None and closing.sent is not None and not self._stop.is_set():
            return f"has been silent for {2 * _PING_S:g} s"
        return "the connection broke"

    async def _open(self, session: Session) -> WSTransport:
        """Connect, and agree on the protocol; PeerError names reason and remedy."""
        place = Endpoint(self._address.host, self._address.port)
        try:
            made = await Network().connect(place)
            transport, listener = await self._shake_hands(made, session)
        except WSHandshakeError as error:
            raise PeerError(_refusal(error)) from error
        except ssl.SSLCertVerificationError as error:
            raise PeerError(
                f"its certificate is not trusted ({error.verify_message}); name the "
                "certificate of its authority in SSL_CERT_FILE"
            ) from error
        except ssl.SSLError as error:
            raise PeerError(
                f"does not speak TLS ({error.reason or error}); try ws:// instead of wss://"
            ) from error
        except socket.gaierror as error:
            reason = f"host {place.host!r} is unknown ({error.strerror}); check its spelling"
            raise PeerError(reason) from error
        except OSError as error:
            raise PeerError(_reason_of(error)) from error
        if listener is None:
            raise PeerError(_NO_WEBSOCKET)
        return transport

    async def _shake_hands(
        self, made: socket.socket, session: Session
    ) -> tuple[WSTransport, WSListener | None]:
        opening = asyncio.ensure_future(
            ws_connect(
                lambda *_: session,
                self._address.url,
                websocket_handshake_timeout=None,
                logger_name=_SILENT,
                enable_auto_ping=True,
                auto_ping_idle_timeout=_PING_S,
                auto_ping_reply_timeout=_PING_S,
                max_frame_size=session.max_bytes,
                extra_headers=self._address.headers,
                max_redirects=0,
                socket_factory=lambda _: made,
                use_aiofastnet=False,  # its TLS has errors of its own
            )
        )
        try:
            return await asyncio.shield(opening)
        except BaseException:
            # A handshake that is cancelled would leave its transport open.
            with suppress(OSError):
                made.shutdown(socket.SHUT_RDWR)
            await asyncio.gather(opening, return_exceptions=True)
            made.close()
            raise


_NO_WEBSOCKET = "not a websocket server; check the port (foxglove_bridge uses 8765)"


def _refusal(error: WSHandshakeError) -> str:
    """Reason and remedy for an answer that refuses the websocket."""
    status = (error.raw_header or b"").split(b"\r\n", 1)[0].decode("ascii", "replace")
    code = status[9:12]
    if not status.startswith("HTTP/"):
        return _NO_WEBSOCKET
    if status.startswith("HTTP/1.1 101"):
        return f"the websocket handshake failed ({error}); check whether it is a Foxglove server"
    if code in {"401", "403"}:
        return f"refuses access (HTTP {code}); give ws://USER:PASSWORD@HOST:PORT"
    return (
        f"answers HTTP {code} instead of a websocket; check the port and the path, and "
        "whether it is a Foxglove server"
    )


def _reason_of(error: OSError) -> str:
    """The reason of a socket error, for the user."""
    if isinstance(error, ConnectionRefusedError):
        return "refuses connections; start foxglove_bridge or the program, or correct the port"
    if isinstance(error, ConnectionResetError | BrokenPipeError):
        return "the connection broke"
    return f"cannot be reached ({reason_of(error)})"
