"""Sources with an event loop, addresses of their peers, connections that never block the loop."""

from __future__ import annotations

import asyncio
import os
import socket
import threading
from concurrent.futures import Future
from contextlib import suppress
from typing import TYPE_CHECKING, Final, NamedTuple
from urllib.parse import urlsplit

from hybridlog.live.sources.base import PeerError, ThreadedSource, one_line

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Sequence

    from hybridlog.live.sources.base import Sink

    Addresses = Sequence[tuple[int, tuple[object, ...]]]

PATIENCE_S: Final = 5.0
"""Time limit for a look-up, a connection or an answer."""

_MAX_ADDRESSES = 8


class LoopSource(ThreadedSource):
    """A source whose thread runs an event loop."""

    def __init__(self) -> None:
        super().__init__()
        self._cancel: Callable[[], object] = lambda: None

    def _begin_loop(self, sink: Sink, work: Callable[[], Coroutine[None, None, None]]) -> None:
        """Run a coroutine, which is cancelled when the source stops."""

        async def follow() -> None:
            loop, task = asyncio.get_running_loop(), asyncio.current_task()
            assert task is not None
            with self._lock:
                if self._stopping.is_set():
                    return
                self._cancel = lambda: loop.call_soon_threadsafe(task.cancel)
            try:
                await work()
            finally:
                with self._lock:
                    self._cancel = lambda: None

        def run() -> None:
            with suppress(asyncio.CancelledError):
                asyncio.run(follow())

        self._begin(sink, run)

    def stop(self) -> None:
        """Stop, after the messages that are under way, and wait some seconds at most."""
        with self._lock:
            self._stopping.set()
            self._cancel()
            self._cancel = lambda: None
        super().stop()


class UnreachedError(PeerError):
    """A peer does not answer."""


class Endpoint(NamedTuple):
    """Host (without brackets) and port of a program."""

    host: str
    port: int

    def __str__(self) -> str:
        """The endpoint as in a URI."""
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


def endpoint_of(uri: str, default_port: int | None = None) -> Endpoint:
    """Host and port of an `http` address.

    Nodes on IPv6 may omit the brackets (`http://::1:4711/`): the last colon counts.
    """
    wrong = PeerError(f"{one_line(uri)!r} is not an address like http://host:port")
    try:
        parts = urlsplit(uri)
    except ValueError as error:
        raise wrong from error
    place = parts.netloc
    if parts.scheme != "http" or "@" in place or not uri.isascii() or not uri.isprintable():
        raise wrong
    if place.startswith("["):
        host, _, port = place[1:].partition("]")
        port = port.removeprefix(":")
    else:
        host, _, port = place.rpartition(":") if ":" in place else (place, "", "")
    if not port and default_port is not None:
        port = str(default_port)
    if not host or not (port.isdecimal() and 0 < int(port[:6]) < 65536):
        raise wrong
    return Endpoint(host, int(port))


def reason_of(error: Exception) -> str:
    """The reason of an error, in a few words for the user."""
    if isinstance(error, TimeoutError):
        return "no answer in time"
    if type(error).__module__ == "builtins" and isinstance(error, OSError) and error.errno:
        return os.strerror(error.errno)  # those of names and TLS have numbers of their own
    return one_line(getattr(error, "strerror", None) or str(error))


_lookups: dict[str, Future[Addresses]] = {}
"""Look-ups of names in threads, one at a time per name, since they cannot be interrupted."""


async def connect(endpoint: Endpoint) -> socket.socket:
    """A connected socket that does not block."""
    loop = asyncio.get_running_loop()
    failure: OSError = OSError(f"{one_line(endpoint.host)} has no address")
    addresses = await _addresses_of(endpoint.host)
    for family, (host, _, *scope) in addresses[:_MAX_ADDRESSES]:
        made = socket.socket(family, socket.SOCK_STREAM)
        try:
            made.setblocking(False)
            address = (host, endpoint.port, *scope)
            async with asyncio.timeout(PATIENCE_S):
                await loop.sock_connect(made, address)
            if made.getsockname() == made.getpeername():
                # The socket got the wanted port itself, and is connected to itself.
                raise ConnectionRefusedError("connection refused")
        except OSError as error:
            made.close()
            failure = error
        except BaseException:
            made.close()
            raise
        else:
            return made
    raise failure


async def _addresses_of(host: str) -> Addresses:
    """Address families and addresses (with port 0) of a host."""
    with suppress(OSError):  # it is a name
        return _look_up(host, socket.AI_NUMERICHOST)
    lookup = _lookups.get(host)
    if lookup is None:
        lookup = _lookups[host] = Future()
        lookup.set_running_or_notify_cancel()  # who stops waiting does not cancel it
        threading.Thread(target=_settle, args=(lookup, host), daemon=True).start()
    async with asyncio.timeout(PATIENCE_S):
        return await asyncio.wrap_future(lookup)


def _look_up(host: str, flags: int = 0) -> Addresses:
    try:
        found = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM, flags=flags)
    except ValueError as error:
        raise OSError(f"{one_line(host)} is not a host name") from error
    return [(int(family), address) for family, _, _, _, address in found]


def _settle(lookup: Future[Addresses], host: str) -> None:
    try:
        lookup.set_result(_look_up(host))
    except OSError as error:
        lookup.set_exception(error)
    finally:
        _lookups.pop(host)
