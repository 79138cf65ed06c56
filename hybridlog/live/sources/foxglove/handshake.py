"""Opens a websocket to a Foxglove server: TCP, TLS and websocket handshake."""

from __future__ import annotations

import os
import select
import socket
import ssl
import time
from collections.abc import Callable
from typing import Final, NamedTuple

from websockets.client import ClientProtocol
from websockets.exceptions import InvalidURI
from websockets.protocol import State
from websockets.typing import Subprotocol
from websockets.uri import WebSocketURI, parse_uri

from hybridlog.live.sources.foxglove.protocol import SUBPROTOCOLS, Address, PeerError
from hybridlog_storage.errors import UsageError

TICK_S: Final = 0.25
"""Interval at which a silent connection checks whether to stop."""

_OPEN_S: Final = 10.0
_READ: Final = 1 << 16
_MAX_ANSWER: Final = 1 << 16


class StoppedError(Exception):
    """The source was stopped while it was connecting."""


class Opened(NamedTuple):
    """A connection after its handshake.

    Attributes:
        socket: With a timeout of `TICK_S`.
        protocol: State of the websocket protocol.
        early: Bytes that followed the server's handshake.
    """

    socket: socket.socket
    protocol: ClientProtocol
    early: bytes


def websocket_uri(address: Address) -> WebSocketURI:
    """The address as the `websockets` package has it.

    Raises:
        UsageError: The address is invalid.
    """
    try:
        return parse_uri(address.url)
    except (InvalidURI, ValueError) as error:
        raise UsageError(
            f"{address.shown}: not the address of a Foxglove server; give one like ws://robot:8765"
        ) from error


def open_websocket(address: Address, stopped: Callable[[], bool]) -> Opened:
    """Connect, and agree on the protocol.

    Args:
        address: The server.
        stopped: Tells whether the source is stopped; called four times a second.

    Raises:
        PeerError: The connection failed; the message names reason and remedy.
        StoppedError: The source was stopped.
    """
    return _Opening(address, stopped).open()


class _Opening:
    """One attempt to connect, with a deadline."""

    def __init__(self, address: Address, stopped: Callable[[], bool]) -> None:
        self._address = address
        self._stopped = stopped
        self._deadline = time.monotonic() + _OPEN_S
        self._protocol = ClientProtocol(
            websocket_uri(address),
            subprotocols=[Subprotocol(name) for name in SUBPROTOCOLS],
            max_size=None,
        )

    def open(self) -> Opened:
        """See `open_websocket`."""
        try:
            made = self._connect()
            try:
                made.settimeout(TICK_S)
                if self._address.is_secure:
                    made = self._secure(made)
                return Opened(made, self._protocol, self._shake_hands(made))
            except BaseException:
                made.close()
                raise
        except ssl.SSLCertVerificationError as error:
            raise PeerError(
                f"its certificate is not trusted ({error.verify_message}); name the "
                "certificate of its authority in SSL_CERT_FILE"
            ) from error
        except ssl.SSLError as error:
            raise PeerError(
                f"does not speak TLS ({error.reason or error}); try ws:// instead of wss://"
            ) from error
        except OSError as error:
            raise PeerError(reason_of(error)) from error

    def _connect(self) -> socket.socket:
        address = self._address
        try:
            found = socket.getaddrinfo(address.host, address.port, type=socket.SOCK_STREAM)
        except (socket.gaierror, UnicodeError) as error:
            reason = error.strerror if isinstance(error, OSError) else "not a host name"
            raise PeerError(
                f"host {address.host!r} is unknown ({reason}); check its spelling"
            ) from error
        last: OSError = ConnectionRefusedError()
        for family, kind, protocol, _, place in found:
            made = socket.socket(family, kind, protocol)
            try:
                self._reach(made, place)
                made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            except OSError as error:
                made.close()
                last = error
            except BaseException:
                made.close()
                raise
            else:
                return made
        raise last

    def _reach(self, made: socket.socket, place: tuple[object, ...]) -> None:
        made.setblocking(False)
        try:
            made.connect(place)
            return
        except BlockingIOError:
            pass
        poller = select.poll()
        poller.register(made, select.POLLOUT)
        while not poller.poll(TICK_S * 1000):
            self._check()
        failed = made.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if failed:
            # With these arguments OSError becomes its subclass for the number.
            raise OSError(failed, os.strerror(failed))

    def _secure(self, plain: socket.socket) -> socket.socket:
        host = self._address.host
        context = ssl.create_default_context()
        try:
            secured = context.wrap_socket(
                plain, server_hostname=host, do_handshake_on_connect=False
            )
        except ValueError as error:
            raise PeerError(f"{host!r} cannot have a certificate; check its spelling") from error
        try:
            while True:
                try:
                    secured.do_handshake()
                except TimeoutError:
                    self._check()
                else:
                    return secured
        except BaseException:
            secured.close()
            raise

    def _shake_hands(self, made: socket.socket) -> bytes:
        """Do the websocket handshake; return the bytes that followed it."""
        protocol = self._protocol
        protocol.send_request(protocol.connect())
        made.sendall(b"".join(protocol.data_to_send()))
        answer = b""
        while b"\r\n\r\n" not in answer:
            self._check()
            try:
                more = made.recv(_READ)
            except TimeoutError:
                continue
            answer += more
            if not more or len(answer) > _MAX_ANSWER:
                raise PeerError(_NO_WEBSOCKET)
        head, _, early = answer.partition(b"\r\n\r\n")
        status = head.split(b"\r\n", 1)[0].decode("ascii", "replace")
        if not status.startswith("HTTP/1.1 101"):
            raise PeerError(_refusal(status))
        protocol.receive_data(head + b"\r\n\r\n")
        protocol.events_received()
        if protocol.handshake_exc is not None or protocol.state is not State.OPEN:
            raise PeerError(
                f"the websocket handshake failed ({protocol.handshake_exc}); check whether it "
                "is a Foxglove server"
            )
        if protocol.subprotocol is None:
            raise PeerError(
                "a websocket server that does not speak Foxglove; start foxglove_bridge or "
                "a program with the Foxglove SDK, and give its port"
            )
        return early

    def _check(self) -> None:
        if self._stopped():
            raise StoppedError
        if time.monotonic() > self._deadline:
            raise PeerError(f"does not answer within {_OPEN_S:g} s; check host and port")


_NO_WEBSOCKET = "not a websocket server; check the port (foxglove_bridge uses 8765)"


def _refusal(status: str) -> str:
    """Reason and remedy for an HTTP answer that refuses the websocket."""
    if not status.startswith("HTTP/"):
        return _NO_WEBSOCKET
    code = status[9:12]
    if code in {"401", "403"}:
        return f"refuses access (HTTP {code}); give ws://USER:PASSWORD@HOST:PORT"
    return (
        f"answers HTTP {code} instead of a websocket; check the port and the path, and "
        "whether it is a Foxglove server"
    )


def reason_of(error: OSError) -> str:
    """The reason of a socket error, for the user."""
    if isinstance(error, ConnectionRefusedError):
        return "refuses connections; start foxglove_bridge or the program, or correct the port"
    if isinstance(error, ConnectionResetError | BrokenPipeError):
        return "the connection broke"
    return f"cannot be reached ({error.strerror or error})"
