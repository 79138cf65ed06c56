"""A viewer of our own: it speaks the Foxglove WebSocket protocol by its specification."""

from __future__ import annotations

import asyncio
import json
import socket
import struct
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from typing import Any, NamedTuple, Self

from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin, Subprotocol

from hybridlog.view.playback import PlaybackServer, PlayedLog

SDK = "foxglove.sdk.v1"
WEBSOCKET = "foxglove.websocket.v1"
LIMIT_S = 30.0


class State(NamedTuple):
    """What the server says that the playback does."""

    status: str
    time: int
    speed: float
    did_seek: bool
    request: bytes


class Data(NamedTuple):
    """A message."""

    topic: str
    time: int
    payload: bytes


class Time(NamedTuple):
    """The time of the playback."""

    time: int


class Viewer:
    """A connection to a server. A context manager."""

    def __init__(
        self,
        url: str,
        *,
        origin: str | None = None,
        protocols: Sequence[str] = (SDK,),
        host: str | None = None,
        small_buffers: bool = False,
    ) -> None:
        more: dict[str, Any] = {"max_queue": 1} if small_buffers else {}
        if host is not None:
            port = int(url.rpartition(":")[2])
            more["sock"] = socket.create_connection(("127.0.0.1", port))
            url = f"ws://{host}:{port}"
        self._stack = ExitStack()
        self.connection: ClientConnection = self._stack.enter_context(
            connect(
                url,
                origin=Origin(origin) if origin is not None else None,
                subprotocols=[Subprotocol(each) for each in protocols],
                max_size=None,
                compression=None,
                proxy=None,
                **more,
            )
        )
        self.info = self.text("serverInfo")
        self.channels: list[dict[str, Any]] = self.text("advertise")["channels"]
        self._topics: dict[int, str] = {}
        is_sdk = self.connection.subprotocol == SDK
        self.first_state: State | None = self.until(State) if is_sdk else None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(OSError):  # it goes without a farewell, as a closed tab does
            self.connection.socket.shutdown(socket.SHUT_RDWR)
        self._stack.close()

    def text(self, operation: str) -> dict[str, Any]:
        """The next JSON message, which has to be this one."""
        while not isinstance(message := self.connection.recv(LIMIT_S), str):
            pass
        found: dict[str, Any] = json.loads(message)
        assert found["op"] == operation, found
        return found

    def number(self, topic: str) -> int:
        (found,) = (each["id"] for each in self.channels if each["topic"] == topic)
        return int(found)

    def subscribe(self, *topics: str) -> None:
        """Subscribe to topics, or to all channels; numbers are 1,000 more than the channels'."""
        numbers = [self.number(topic) for topic in topics] or [c["id"] for c in self.channels]
        self._topics |= {c["id"] + 1000: c["topic"] for c in self.channels}
        wanted = [{"id": number + 1000, "channelId": number} for number in numbers]
        self.connection.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    def unsubscribe(self, topic: str) -> None:
        numbers = [self.number(topic) + 1000]
        self.connection.send(json.dumps({"op": "unsubscribe", "subscriptionIds": numbers}))

    def ask(
        self, *, plays: bool, speed: float = 1.0, seek: int | None = None, name: bytes = b"id"
    ) -> None:
        """Ask for playback."""
        head = (3, int(not plays), speed, int(seek is not None), seek or 0, len(name))
        self.connection.send(struct.pack("<BBfBQI", *head) + name)

    def control(
        self, *, plays: bool, speed: float = 1.0, seek: int | None = None, name: bytes = b"id"
    ) -> State:
        """Ask for playback, and wait for the answer."""
        self.ask(plays=plays, speed=speed, seek=seek, name=name)
        while (state := self.until(State)).request != name:
            pass
        return state

    def read(self, timeout: float = LIMIT_S) -> State | Data | Time | dict[str, Any]:
        """The next message."""
        message = self.connection.recv(timeout)
        if isinstance(message, str):
            found: dict[str, Any] = json.loads(message)
            return found
        if message[0] == 1:
            subscription, log_time = struct.unpack_from("<IQ", message, 1)
            return Data(self._topics[subscription], log_time, message[13:])
        if message[0] == 2:
            (now,) = struct.unpack("<xQ", message)
            return Time(now)
        status, now, speed, did_seek, length = struct.unpack_from("<xBQfBI", message)
        names = {0: "playing", 1: "paused", 3: "ended"}
        request = message[19:]
        assert len(request) == length
        return State(names[status], now, speed, bool(did_seek), request)

    def until(self, kind: type[State | Time], **wanted: object) -> Any:
        """The next message of a kind with these values; others are dropped."""
        while True:
            found = self.read()
            if isinstance(found, kind) and all(getattr(found, k) == v for k, v in wanted.items()):
                return found

    def until_end(self) -> list[Data]:
        """All messages until the playback has ended."""
        found = []
        while not (isinstance(one := self.read(), State) and one.status == "ended"):
            if isinstance(one, Data):
                found.append(one)
        return found

    def quiet(self, seconds: float = 0.15) -> list[State | Data | Time | dict[str, Any]]:
        """Everything until nothing has come for so long."""
        found = []
        while True:
            try:
                found.append(self.read(seconds))
            except TimeoutError:
                return found


@contextmanager
def served(log: PlayedLog, said: list[str] | None = None, **options: Any) -> Iterator[str]:
    """The address of a server in a thread of its own."""
    say = (said if said is not None else []).append
    server = PlaybackServer(log, "test", say, **{"port": 0, "speed": 100.0, **options})
    ports: list[int] = []
    ready = threading.Event()
    stopping: list[tuple[asyncio.AbstractEventLoop, asyncio.Event]] = []
    failures: list[BaseException] = []

    def told(port: int) -> None:
        ports.append(port)
        ready.set()

    async def work() -> None:
        stop = asyncio.Event()
        stopping.append((asyncio.get_running_loop(), stop))
        await server.run(stop, told)

    def run() -> None:
        try:
            asyncio.run(work())
        except BaseException as error:
            failures.append(error)
        finally:
            ready.set()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        assert ready.wait(LIMIT_S)
        if failures:
            raise failures[0]
        yield f"ws://127.0.0.1:{ports[0]}"
    finally:
        for loop, stop in stopping:
            if not loop.is_closed():
                loop.call_soon_threadsafe(stop.set)
        thread.join(LIMIT_S)
    assert not failures
    assert not thread.is_alive()
