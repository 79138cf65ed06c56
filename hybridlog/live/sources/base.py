"""Interface between a robot's middleware and the recorder: `LiveSource` and `Sink`.

A source runs its own threads. It reports topics that appear and disappear to its sink, and
passes on every message at once, as it was on the wire. A source that leaves a socket unread
makes a publisher drop messages silently. So a sink may be called from any thread, and never
waits for a disk or a database.
"""

from __future__ import annotations

import asyncio
import os
import socket
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Coroutine, Sequence
from concurrent.futures import Future
from contextlib import suppress
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol, Self
from urllib.parse import urlsplit

from hybridlog.record.losses import Cause
from hybridlog_storage.manifest import Loss

if TYPE_CHECKING:
    from hybridlog_storage.messages import Channel

    Addresses = Sequence[tuple[int, tuple[object, ...]]]


__all__ = ["Cause", "LiveSource", "Loss", "Sink"]


class Sink(Protocol):
    """Receiver of a source's messages and events.

    Thread safe; no method waits for disk or database.
    """

    def wants(self, topic: str, type_name: str) -> bool:
        """Tells whether a topic is to be recorded. Costs microseconds.

        A source asks for each new topic, and subscribes to nothing else. Names are as it spells
        them; the type is empty if not known yet.
        """

    def take(
        self,
        channel: Channel,
        payload: bytes,
        *,
        received: int,
        sent: int | None = None,
        sequence: int | None = None,
    ) -> None:
        """Take a message. Messages of one channel come from one thread at a time.

        Args:
            channel: Topic, encoding and definition: the same object for all messages of
                a connection. `has_publish_time` says whether `sent` is given.
            payload: The serialized message; it must not change afterwards.
            received: Receive time, ns since the epoch.
            sent: Send time by the sender's clock, ns since the epoch, if known.
            sequence: Sequence number of the sender, if known.
        """

    def lost(self, loss: Loss) -> None:
        """Note messages that are lost."""

    def topic_came(self, topic: str, type_name: str) -> None:
        """Note that a wanted topic has publishers."""

    def topic_gone(self, topic: str) -> None:
        """Note that a topic has no publishers left."""

    def say(self, text: str) -> None:
        """Show the user a problem and its remedy in a line, each once; recording goes on."""

    def ended(self, reason: str = "") -> None:
        """Note that the source has ended by itself; `reason` is empty after a regular end."""


class PeerError(Exception):
    """A peer is unreachable or violates the protocol; the message names the problem."""


class LiveSource(ABC):
    """A source of messages. Start it once; as a context manager it stops at the end.

    Attributes:
        kind: `ROS 1`, `ROS 2`, `Foxglove`, `replay`.
        address: Address of the peer, as the catalog shows it.
        was_reached: The peer has answered at least once; always True without a peer.
    """

    kind: str
    address: str
    was_reached: bool = True

    def check(self) -> None:  # noqa: B027 - most sources cannot check anything
        """Raise the errors of `start` before a recording is created."""

    @abstractmethod
    def start(self, sink: Sink) -> None:
        """Begin to listen.

        Temporary problems (a master that is not up yet, a publisher that dies) do not raise: the
        source reports them, and tries again. An invalid setting raises UsageError,
        a source that can never work SourceError.
        """

    @abstractmethod
    def stop(self) -> None:
        """Stop listening. May be called more than once.

        Passes on the messages received so far, and does not call the sink after it has
        returned. Takes at most a few seconds, whatever the peers do.
        """

    def __enter__(self) -> Self:
        """The source itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Stop."""
        self.stop()


_JOIN_S: Final = 5.0


class ThreadedSource(LiveSource):
    """A source with a thread of its own, which ends soon after `_stopping` is set."""

    def __init__(self) -> None:
        self._stopping = threading.Event()
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None

    def _begin(self, sink: Sink, run: Callable[[], None]) -> None:
        """Call a function in the thread; the recorder does not wait for it after an error."""

        def guarded() -> None:
            try:
                run()
            except BaseException as error:
                if not self._stopping.is_set():
                    sink.ended(f"the {self.kind} source failed: {one_line(repr(error))}")
                raise

        name = f"hybridlog-{self.kind}"
        self._thread = threading.Thread(target=guarded, name=name, daemon=True)
        self._thread.start()

    def _reached(self) -> None:
        self.was_reached = True

    def stop(self) -> None:
        """Stop, after the messages that are under way, and wait some seconds at most."""
        self._stopping.set()
        self._join(_JOIN_S)

    def _join(self, seconds: float | None = None) -> None:
        """Wait for the end of the thread."""
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(seconds)


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


_MAX_LENGTH = 400


def one_line(text: str | bytes, limit: int = _MAX_LENGTH) -> str:
    """Text from a peer as one line: bounded, and without control characters."""
    if isinstance(text, bytes):
        text = text[: limit * 4].decode(errors="replace")
    # The end of a far longer text is not read.
    words = " ".join(text[: limit * 4].split())
    line = words if len(words) <= limit else f"{words[:limit]}..."
    return "".join(char if char.isprintable() else "?" for char in line)


PATIENCE_S: Final = 5.0
"""Time limit for a look-up, a connection or an answer."""

_MAX_ADDRESSES = 8


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
