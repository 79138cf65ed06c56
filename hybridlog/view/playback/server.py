"""A Foxglove WebSocket server that plays a log to its clients.

All clients share one playback, as the protocol has it: a pause or a seek of one is for all.
Requests of clients and what is due are sent in turns. The playback waits for the slowest client:
the log time then runs slower, and no message is dropped. Only subscribed topics are read.
"""

from __future__ import annotations

import asyncio
import contextlib
import secrets
import time
from collections.abc import AsyncIterator, Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from http import HTTPStatus
from typing import TYPE_CHECKING, Final

import numpy as np
from msgspec import Struct, field
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed

from hybridlog.live.sources.foxglove.protocol import SUBPROTOCOLS
from hybridlog.view.guard import Admission, listen
from hybridlog.view.playback import protocol
from hybridlog.view.playback.played import PlaybackClock
from hybridlog_storage.errors import HybridlogError

if TYPE_CHECKING:
    from websockets.http11 import Request as HttpRequest
    from websockets.http11 import Response
    from websockets.typing import Subprotocol

    from hybridlog.view.playback.played import Blocks, PlayedLog
    from hybridlog_storage.messages import Batch

_WITH_PLAYBACK: Final = SUBPROTOCOLS[0]
_MAX_CLIENTS: Final = 32
_MAX_REQUEST: Final = 8 << 20  # bytes; subscriptions to 65,535 channels take 3 MB
_MAX_SENT: Final = 1 << 20  # bytes of payload between two looks at requests
_TICK_S: Final = 1 / 30  # between two messages with the time
_STEP_S: Final = 0.002  # of waiting, at least, so that many messages are sent at once
_LATE_S: Final = 0.1  # of playing; later than this, the clock waits for the clients
_PING_S: Final = 10.0
_CLOSE_S: Final = 1.0


class PlaybackOptions(Struct, frozen=True):
    """Options of a playback.

    Attributes:
        port: TCP port on the loopback interface; 0 for a free one.
        speed: Seconds of log time a second at first.
        loops: Begin again at the end.
        is_paused: Wait for a client to play; otherwise the first subscription begins it.
        origins: Web origins that may connect, beside those of Foxglove and of this computer.
    """

    port: int = 8765
    speed: float = 1.0
    loops: bool = False
    is_paused: bool = False
    origins: tuple[str, ...] = ()


class _Client(Struct, eq=False):
    """A client, and the subscriptions that it has by number of the channel."""

    connection: ServerConnection
    subscriptions: dict[int, int] = field(default_factory=dict)

    async def send(self, message: str | bytes) -> None:
        """Send a message and wait until the client takes it, if it is slow."""
        with contextlib.suppress(ConnectionClosed):  # its own task ends with it
            await self.connection.send(message)


class _Reading:
    """Reads blocks of messages in a thread of their own."""

    def __init__(self, blocks: Blocks, executor: ThreadPoolExecutor) -> None:
        self._blocks = blocks
        self._executor = executor
        self._block: Batch | None = None
        self._row = 0

    async def next_time(self) -> int | None:
        """Log time of the next message, ns; None at the end."""
        while self._block is None or self._row == len(self._block):
            read = self._executor.submit(next, self._blocks, None)
            self._block, self._row = await asyncio.wrap_future(read), 0
            if self._block is None:
                return None
        return int(self._block.log_time[self._row])

    def take(self, until: int) -> tuple[Batch, int]:
        """Messages until a log time, ns, about `_MAX_SENT` bytes; the log time of the last one.

        At least one. Call `next_time` first.
        """
        assert self._block is not None
        batch, row = self._block, self._row
        times = batch.log_time[row:]
        count = max(int(np.searchsorted(times, until, "right")), 1)
        sizes = np.cumsum(batch.length[row : row + count])
        last = int(np.searchsorted(sizes[:-1], _MAX_SENT))
        self._row += last + 1
        return batch.take(slice(row, self._row)), int(times[last])

    def close(self) -> None:
        """Read no more."""
        self._executor.submit(self._blocks.close)


class PlaybackServer:
    """Plays a log to Foxglove clients, under a name; `say` takes lines for the user."""

    def __init__(
        self, log: PlayedLog, name: str, options: PlaybackOptions, say: Callable[[str], None]
    ) -> None:
        self._log = log
        self._name = name
        self._options = options
        self._say = say
        self._rules = Admission(origins=options.origins, viewers=True, local=True)
        self._session = secrets.token_hex(8)
        self._topics = {each.id: each.channel.topic for each in log.channels}
        self._clients: list[_Client] = []
        self._turn = asyncio.Lock()
        self._waiting = 0  # for their turn
        self._asked = asyncio.Event()
        self._executor = ThreadPoolExecutor(1, "hybridlog-playback")
        self._refused: set[str] = set()
        self._reading: _Reading | None = None
        self._rewind()

    def _rewind(self) -> None:
        """Be as at the beginning: nothing is sent, and the clock stands still."""
        self._clock = PlaybackClock(self._log.begin, self._options.speed)
        self._sent = self._log.begin - 1  # log time until which everything is sent
        self._next: int | None = None  # log time of the next message that is read
        self._clock_sent_s = 0.0  # when clients were told the time
        self._has_begun = self._options.is_paused
        self._has_ended = False
        self._read()

    async def run(self, stop: asyncio.Event, ready: Callable[[int], None]) -> None:
        """Serve until stopped, and say goodbye; `ready` gets the port when clients can connect."""
        protocols: Sequence[Subprotocol] = SUBPROTOCOLS  # type: ignore[assignment]
        server = await serve(
            self._serve,
            sock=listen(self._options.port),
            subprotocols=protocols,
            process_request=self._check,
            compression=None,
            max_size=_MAX_REQUEST,
            ping_interval=_PING_S,
            ping_timeout=_PING_S,
            close_timeout=_CLOSE_S,
        )
        playing = asyncio.create_task(self._play())
        stopping = asyncio.create_task(stop.wait())
        try:
            async with server:
                ready(int(next(iter(server.sockets)).getsockname()[1]))
                await asyncio.wait((playing, stopping), return_when=asyncio.FIRST_COMPLETED)
            if playing.done():
                playing.result()  # raises what has ended it
        finally:
            playing.cancel()
            stopping.cancel()
            await asyncio.gather(playing, stopping, return_exceptions=True)
            self._clients.clear()
            self._read()
            self._executor.shutdown()

    # Clients.

    def _check(self, connection: ServerConnection, request: HttpRequest) -> Response | None:
        """Refuse web pages that are no viewers, and more clients than are served."""
        origin = request.headers.get("Origin")
        if not self._rules.is_host(request.headers.get("Host", "")):
            return connection.respond(HTTPStatus.FORBIDDEN, "Only localhost is served.\n")
        if origin is not None and not self._rules.is_guest(origin):
            if origin not in self._refused and len(self._refused) < _MAX_CLIENTS:
                self._refused.add(origin)
                self._say(f"Refused a page of {origin}: --allow-origin {origin} admits it.")
            return connection.respond(HTTPStatus.FORBIDDEN, "This origin is not allowed.\n")
        if len(self._clients) >= _MAX_CLIENTS:
            return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, "Too many clients.\n")
        return None

    async def _serve(self, connection: ServerConnection) -> None:
        """Serve a client until it goes."""
        client, log = _Client(connection), self._log
        await client.send(protocol.server_info(self._name, self._session, log.begin, log.end))
        await client.send(protocol.advertise(log.channels))
        self._clients.append(client)
        try:
            await self._send_state([client])
            async for message in connection:
                async with self._in_turn():
                    await self._obey(client, message)
                self._asked.set()
        except ConnectionClosed:
            pass  # it has gone without a farewell
        finally:
            self._clients.remove(client)
            async with self._in_turn():
                if self._clients:
                    self._read()
                else:
                    self._rewind()

    @contextlib.asynccontextmanager
    async def _in_turn(self) -> AsyncIterator[None]:
        """One after the other; where messages cannot be read, the playback pauses and says so."""
        self._waiting += 1
        try:
            await self._turn.acquire()
        finally:
            self._waiting -= 1
        try:
            yield
        except HybridlogError as error:
            self._clock.set(runs=False)
            self._read(())
            self._say(str(error))
            await self._broadcast(protocol.status(protocol.ERROR, str(error)))
            await self._send_state(self._clients)
        finally:
            self._turn.release()

    async def _broadcast(self, message: str | bytes) -> None:
        await asyncio.gather(*(client.send(message) for client in self._clients))

    async def _send_state(
        self, clients: Sequence[_Client], *, seek: int | None = None, request: bytes = b""
    ) -> None:
        """Tell clients whose protocol has it what the playback does, perhaps after a seek."""
        state = protocol.PLAYING if self._clock.is_running else protocol.PAUSED
        if self._has_ended:
            state = protocol.ENDED
        position = min(self._clock.position, self._log.end) if seek is None else seek
        message = protocol.playback_state(
            state, position, self._clock.speed, did_seek=seek is not None, request=request
        )
        told = [one for one in clients if one.connection.subprotocol == _WITH_PLAYBACK]
        await asyncio.gather(*(client.send(message) for client in told))

    async def _obey(self, client: _Client, message: str | bytes) -> None:
        try:
            request = protocol.parse(message)
        except protocol.RequestError as error:
            await client.send(protocol.status(protocol.ERROR, str(error)))
            return
        if isinstance(request, protocol.Subscribe):
            await self._subscribe(client, request)
        elif isinstance(request, protocol.Unsubscribe):
            ended = set(request.subscriptions)
            own = client.subscriptions
            client.subscriptions = {c: s for c, s in own.items() if s not in ended}
            self._read()
        elif isinstance(request, protocol.SubscribeGraph):
            await client.send(protocol.connection_graph(self._log.channels))
        elif isinstance(request, protocol.Control):
            await self._control(request)

    async def _subscribe(self, client: _Client, request: protocol.Subscribe) -> None:
        """Begin subscriptions with the messages that are current now."""
        new = set()
        for each in request.subscriptions:
            number, channel = each.id, each.channel
            if channel not in self._topics:
                text = f"there is no channel {channel}"
                await client.send(protocol.status(protocol.ERROR, text))
            elif channel in client.subscriptions or number in client.subscriptions.values():
                text = f"there is a subscription {number}, or one to channel {channel}"
                await client.send(protocol.status(protocol.WARNING, text))
            else:
                client.subscriptions[channel] = number
                new.add(channel)
        self._read()
        await self._send_current([client], new)
        if new and not self._has_begun:
            self._has_begun = True
            self._clock.set(runs=True)
            await self._send_state(self._clients)

    async def _control(self, request: protocol.Control) -> None:
        """Play, pause, seek or change the speed, for all clients."""
        self._has_begun = True
        seek = request.seek
        if seek is not None:
            seek = min(max(seek, self._log.begin), self._log.end)
            self._has_ended = False
        self._clock.set(runs=request.plays and not self._has_ended, speed=request.speed)
        if seek is not None:
            await self._go_to(seek, request.id)
            return
        if self._clock.is_running and self._reading is None:
            self._read()  # after an error
        await self._send_state(self._clients, request=request.id)

    async def _go_to(self, position: int, request: bytes = b"") -> None:
        """Set the clock to a log time, and show what is current there."""
        self._sent = position - 1
        self._clock.set(position)
        await self._send_state(self._clients, seek=position, request=request)
        await self._broadcast(protocol.time_now(position))
        self._read()
        await self._send_current(self._clients, set(self._topics))

    # Messages.

    async def _play(self) -> None:
        """Send what is due, until cancelled."""
        while True:
            async with self._in_turn():
                await self._send_due()
            seconds = _TICK_S if self._clock.is_running else None
            if seconds is not None and self._next is not None:
                ahead = (self._next - self._clock.position) / self._clock.speed / 1e9
                seconds = min(max(ahead, _STEP_S), _TICK_S)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(seconds):
                    await self._asked.wait()
            self._asked.clear()

    async def _send_due(self) -> None:
        """Send all messages until the time of the clock."""
        if self._reading is None and not self._clock.is_running:
            return  # the first subscriber gets all messages of this time
        before = self._sent
        self._next = await self._next_time()
        while self._next is not None:
            # Messages of the same time belong together, even if others wait.
            now = max(self._clock.position, self._sent)
            if self._next > now or (self._next > self._sent and self._waiting):
                break
            assert self._reading is not None
            batch, self._sent = self._reading.take(now)
            await self._send(self._clients, batch, self._topics)
            if self._clock.position - self._sent > _LATE_S * self._clock.speed * 1e9:
                self._clock.set(self._sent)
            self._next = await self._next_time()
        last = self._log.end if self._next is None else self._next - 1
        self._sent = max(self._sent, min(self._clock.position, last))
        if self._sent > before and time.monotonic() - self._clock_sent_s > _TICK_S:
            self._clock_sent_s = time.monotonic()
            await self._broadcast(protocol.time_now(self._sent))
        await self._go_on()

    async def _next_time(self) -> int | None:
        return await self._reading.next_time() if self._reading is not None else None

    async def _go_on(self) -> None:
        """Pass over the time between two recordings; at the end, stop or begin again."""
        if not self._clock.is_running:
            return
        if self._sent >= self._log.end:
            if self._options.loops:
                await self._go_to(self._log.begin)
                return
            self._clock.set(self._log.end, runs=False)
            self._has_ended = True
            await self._broadcast(protocol.time_now(self._log.end))
            await self._send_state(self._clients)
            return
        then = self._log.next_covered(self._sent)
        if then > self._sent:
            self._sent = then - 1
            self._clock.set(then)
            await self._send_state(self._clients)

    async def _send_current(self, clients: Sequence[_Client], channels: Collection[int]) -> None:
        """Send the messages of channels that are current to their subscribers among clients."""
        wanted = {c for client in clients for c in client.subscriptions if c in channels}
        topics = sorted({self._topics[channel] for channel in wanted})
        reading = _Reading(self._log.current(topics, self._sent), self._executor)
        while await reading.next_time() is not None:
            batch, _ = reading.take(self._sent)
            await self._send(clients, batch, wanted)

    async def _send(
        self, clients: Sequence[_Client], batch: Batch, channels: Collection[int]
    ) -> None:
        """Send messages to the subscribers of their channels."""
        rows = [*zip(batch.channel.tolist(), batch.log_time.tolist(), strict=True)]

        async def send(client: _Client) -> None:
            own = {c: s for c, s in client.subscriptions.items() if c in channels}
            for row, (channel, log_time) in enumerate(rows):
                if channel in own:
                    message = protocol.message_data(own[channel], log_time, batch.payload(row))
                    await client.send(message)

        await asyncio.gather(*map(send, clients))

    def _read(self, topics: Collection[str] | None = None) -> None:
        """Read topics, by default the subscribed ones, behind what is sent already."""
        if topics is None:
            topics = {self._topics[c] for client in self._clients for c in client.subscriptions}
        if self._reading is not None:
            self._reading.close()
            self._reading = None
        if topics:
            blocks = self._log.after(sorted(topics), self._sent)
            self._reading = _Reading(blocks, self._executor)
