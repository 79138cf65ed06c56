"""Plays a log to viewers over the Foxglove WebSocket protocol; each has a playback of its own.

What a viewer asks and what is due take turns in one loop. The playback waits for its viewer: the
log time then runs slower, and no message is dropped. Only subscribed topics are read.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import math
import secrets
import struct
import time
from collections.abc import Callable, Collection, Generator, Iterator, Sequence
from http import HTTPStatus
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, NamedTuple, TypeAlias

import msgspec
import numpy as np
from msgspec.structs import replace
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed

from hybridlog.live.sources.foxglove.protocol import MESSAGE_DATA, SUBPROTOCOLS
from hybridlog.query.intervals import Intervals
from hybridlog.query.latching import depth_of, is_video
from hybridlog.query.query import Query, at_time, channels_of, narrowed, spans_of
from hybridlog.view.guard import Admission, listen
from hybridlog_storage.errors import HybridlogError, TimeError, TopicError, UsageError

if TYPE_CHECKING:
    from websockets.http11 import Request as HttpRequest
    from websockets.http11 import Response
    from websockets.typing import Subprotocol

    from hybridlog.query.question import RecordedChannel
    from hybridlog_storage.messages import Batch, Channel

_WITH_PLAYBACK: Final = SUBPROTOCOLS[0]
_MAX_VIEWERS: Final = 16
_MAX_REFUSED: Final = 32  # origins that are told
_MAX_REQUEST: Final = 8 << 20  # bytes; subscriptions to 65,535 channels take 3 MB
_MAX_SENT: Final = 1 << 20  # bytes of payload between two looks at requests
_TICK_S: Final = 1 / 30  # between two messages with the time
_STEP_S: Final = 0.002  # of waiting, at least, so that many messages are sent at once
_LATE_S: Final = 0.1  # of playing; later than this, the clock waits for the viewer
_PING_S: Final = 10.0
_CLOSE_S: Final = 1.0


# What is played.


Blocks: TypeAlias = "Generator[Batch, None, None]"
"""Messages in order of log time; `channel` is the number of the played channel, 0 for none."""


class PlayedLog:
    """The messages of a query, as a log that is played.

    Args:
        query: Topics, recordings, range of log time and predicate.

    Attributes:
        channels: What viewers can subscribe to, numbered from 1 on: a channel stands for those of
            all recordings with the same topic, encoding and type. Messages whose payload was
            dropped under pressure are not among them.
        begin: First log time, ns.
        end: Last log time, ns.

    Raises:
        TimeError: The range is outside of all recordings, or these have no messages.
    """

    def __init__(self, query: Query) -> None:
        spans = spans_of(query)
        if not spans:
            raise TimeError("There are no messages to play.")
        times = np.array([(begin, end, 0) for begin, end in spans.values()], np.int64)
        self._begin, self._end = times[:, 0], times[:, 1]
        self.begin, self.end = int(self._begin.min()), int(self._end.max()) - 1
        whole = replace(query.question, bounds=None, during=None, clock="log")
        self._whole = Query(query.source.now(), whole, conditions=query.conditions)
        params = Intervals((id_, times[row : row + 1]) for row, id_ in enumerate(spans))
        during = query.question.during
        self._during = params if during is None else during.common(params)
        self.channels: list[Channel] = []
        self._ids: dict[tuple[str, int], int] = {}
        self._latching: set[str] = set()
        numbers: dict[object, int] = {}
        for each in channels_of(query):
            if each.is_reduced:
                continue
            own = each.channel
            key = own.topic, own.message_encoding, own.schema
            if key not in numbers:
                self.channels.append(own)
            self._ids[each.recording.id, each.channel_id] = numbers.setdefault(
                key, len(self.channels)
            )
            if depth_of(own) or is_video(own):
                self._latching.add(own.topic)

    def next_covered(self, position: int) -> int:
        """The next log time that a recording covers, ns; the same one if it is, or no more is."""
        is_covered = (self._begin <= position) & (position < self._end)
        later = self._begin[self._begin > position]
        return position if is_covered.any() or not len(later) else int(later.min())

    def after(self, topics: Collection[str], position: int) -> Blocks:
        """All messages of some topics behind a log time, ns, in order."""
        if not topics or position >= self.end:
            return
        query = narrowed(self._whole, *topics).during(self._during).between(position + 1, None)
        for batch, channels in query.batches():
            yield self._numbered(batch, channels)

    def current(self, topics: Collection[str], position: int) -> Blocks:
        """The messages of some topics that are current at a log time, ns.

        They are the latched ones that a subscriber receives which joins then, the frames of
        video from the last key frame on, and the last message of every other topic. Messages
        from before the played range are not current, unless they are of the former two.
        """
        if not topics:
            return
        if found := self._latching.intersection(topics):
            latched = narrowed(self._whole, *found).between(min(position + 1, self.end), None)
            for batch, channels in latched.latched(original_times=True):
                yield self._numbered(batch, channels)
            if position >= self.end:
                yield from self.after(found, self.end - 1)
        if position >= self.begin:
            for topic in topics:
                if topic not in self._latching:
                    yield from self._last(topic, position)

    def _last(self, topic: str, position: int) -> Iterator[Batch]:
        """The last message of a topic until a log time, ns, if the range has one."""
        try:
            query = at_time(narrowed(self._whole, topic), position)
        except TopicError:
            return  # the topic has none yet
        for batch, channels in query.during(self._during).batches():
            yield self._numbered(batch, channels)

    def _numbered(self, batch: Batch, channels: Sequence[RecordedChannel]) -> Batch:
        ids = [self._ids.get((c.recording.id, c.channel_id), 0) for c in channels]
        return replace(batch, channel=np.array(ids, np.int32)[batch.channel])


SLOWEST: Final = 0.01
FASTEST: Final = 100.0
"""Limits of the speed, in seconds of log time a second."""


class PlaybackClock:
    """Log time, ns, during a playback; it stands still until it runs.

    Attributes:
        speed: Seconds of log time a second.
        is_running: The time runs.
    """

    def __init__(self, position: int, speed: float) -> None:
        self.speed, self.is_running = 1.0, False
        self._position = self._since = 0
        self.set(position, speed=speed)

    @property
    def position(self) -> int:
        """Log time now, ns."""
        passed = time.monotonic_ns() - self._since if self.is_running else 0
        return self._position + int(passed * self.speed)

    def set(
        self, position: int | None = None, *, runs: bool | None = None, speed: float = math.nan
    ) -> None:
        """Go to a log time, ns, run or stand still, and change the speed, within its limits.

        What is not given stays; so does the speed if it is NaN.
        """
        self._position = self.position if position is None else position
        self._since = time.monotonic_ns()
        if runs is not None:
            self.is_running = runs
        if not math.isnan(speed):
            self.speed = min(max(speed, SLOWEST), FASTEST)


# The protocol. Times are log times in ns, speeds seconds of log time a second.

_BASE64 = frozenset({"protobuf", "flatbuffer"})
_DATA = struct.Struct("<BIQ")  # opcode, subscription, log time
_TIME = struct.Struct("<BQ")  # opcode 2, time
_STATE = struct.Struct("<BBQfBI")  # opcode, status, time, speed, did seek, length of the id
_CONTROL = struct.Struct("<BBfBQI")  # opcode, command, speed, seeks, time, length of the id
_PLAYBACK_STATE: Final = 5
_PLAYBACK_CONTROL: Final = 3
_PLAY, _PAUSE = 0, 1

PLAYING, PAUSED, ENDED = 0, 1, 3
"""States of a playback."""
_ERROR = 2  # severity of a status


_Number = Annotated[int, msgspec.Meta(ge=0, lt=1 << 32)]


class Subscription(msgspec.Struct):
    """A subscription, and the channel that it is for."""

    id: _Number
    channel: _Number = msgspec.field(name="channelId")


class Subscriptions(msgspec.Struct):
    """A request for channels, or to end subscriptions, by their numbers."""

    op: Literal["subscribe", "unsubscribe"]
    subscriptions: list[Subscription] = []
    ended: list[_Number] = msgspec.field(name="subscriptionIds", default_factory=list)


class Control(NamedTuple):
    """A request, by its id: play or pause, a speed, and a log time to go to; None to stay."""

    plays: bool
    speed: float
    seek: int | None
    id: bytes


Request = Subscriptions | Control


def _described(number: int, channel: Channel) -> dict[str, Any]:
    """A channel as it is offered; one without a definition has an empty one."""
    schema = channel.schema
    found = {"id": number, "topic": channel.topic, "encoding": channel.message_encoding}
    if schema is None or not schema.encoding:
        return {**found, "schemaName": schema.name if schema else "", "schema": ""}
    text = schema.data.decode("utf-8", "replace")
    if schema.encoding in _BASE64:
        text = base64.b64encode(schema.data).decode()
    more = {"schemaName": schema.name, "schemaEncoding": schema.encoding, "schema": text}
    return {**found, **more}


def problem(text: str) -> str:
    """A message for the user of the client: what went wrong."""
    return json.dumps({"op": "status", "level": _ERROR, "message": text})


def time_now(position: int) -> bytes:
    """The time of the playback."""
    return _TIME.pack(2, position)


def parse(message: str | bytes) -> Request:
    """A message of a client; one that is malformed or unknown raises UsageError."""
    if isinstance(message, str):
        try:
            return msgspec.json.decode(message, type=Subscriptions)
        except (msgspec.MsgspecError, RecursionError, UnicodeError) as wrong:
            raise UsageError(f"a message is no request to a playback: {wrong}") from wrong
    name = message[_CONTROL.size :]
    with contextlib.suppress(struct.error):
        kind, command, speed, seeks, position, length = _CONTROL.unpack_from(message)
        if kind == _PLAYBACK_CONTROL and command in {_PLAY, _PAUSE} and len(name) == length:
            return Control(command == _PLAY, speed, position if seeks else None, name)
    raise UsageError("a message is no request to a playback, which takes no messages")


# The server.


class PlaybackServer:
    """Plays a log to Foxglove viewers.

    Args:
        log: What is played.
        name: What viewers call it.
        say: Takes lines for the user.
        port: TCP port on the loopback interface; 0 for a free one.
        speed: Seconds of log time a second at first.
        origins: Web origins that may connect, beside those of Foxglove and of this computer.
    """

    def __init__(
        self,
        log: PlayedLog,
        name: str,
        say: Callable[[str], None],
        *,
        port: int = 8765,
        speed: float = 1.0,
        origins: tuple[str, ...] = (),
    ) -> None:
        self._log, self._say = log, say
        self._port, self._speed = port, speed
        self._rules = Admission(origins=origins)
        begin, end = ({"sec": time // 10**9, "nsec": time % 10**9} for time in (log.begin, log.end))
        self._about = json.dumps(
            {
                "op": "serverInfo",
                "name": name,
                "capabilities": ["playbackControl", "time"],
                "sessionId": secrets.token_hex(8),
                "dataStartTime": begin,
                "dataEndTime": end,
            }
        )
        self._viewers = 0
        self._refused: set[str] = set()

    async def run(self, stop: asyncio.Event, ready: Callable[[int], None]) -> None:
        """Serve until stopped, and say goodbye; `ready` gets the port when viewers can connect."""
        protocols: Sequence[Subprotocol] = SUBPROTOCOLS  # type: ignore[assignment]
        async with serve(
            self._serve,
            sock=listen(self._port),
            subprotocols=protocols,
            process_request=self._check,
            compression=None,
            max_size=_MAX_REQUEST,
            ping_interval=_PING_S,
            ping_timeout=_PING_S,
            close_timeout=_CLOSE_S,
        ) as server:
            ready(int(next(iter(server.sockets)).getsockname()[1]))
            await stop.wait()

    def _check(self, connection: ServerConnection, request: HttpRequest) -> Response | None:
        """Refuse web pages that are no viewers, and more viewers than are served."""
        origin = request.headers.get("Origin")
        if not self._rules.is_host(request.headers.get("Host", "")):
            return connection.respond(HTTPStatus.FORBIDDEN, "Only localhost is served.\n")
        if origin is not None and not self._rules.is_guest(origin):
            if origin not in self._refused and len(self._refused) < _MAX_REFUSED:
                self._refused.add(origin)
                self._say(f"Refused a page of {origin}: --allow-origin {origin} admits it.")
            return connection.respond(HTTPStatus.FORBIDDEN, "This origin is not allowed.\n")
        if self._viewers >= _MAX_VIEWERS:
            return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, "Too many viewers.\n")
        return None

    async def _serve(self, connection: ServerConnection) -> None:
        """Serve a viewer until it goes."""
        self._viewers += 1
        try:
            await connection.send(self._about)
            await _Playback(connection, self._log, self._speed, self._say).run()
        except ConnectionClosed:
            pass  # it has gone without a farewell
        finally:
            self._viewers -= 1


class _Reading:
    """Reads blocks of messages, each in a thread."""

    def __init__(self, blocks: Blocks) -> None:
        self._blocks = blocks
        self._block: Batch | None = None
        self._row = 0

    async def next_time(self) -> int | None:
        """Log time of the next message, ns; None at the end."""
        while self._block is None or self._row == len(self._block):
            self._block, self._row = await asyncio.to_thread(next, self._blocks, None), 0
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


class _Playback:
    """The playback of one viewer: its subscriptions, its clock, and what it was sent."""

    def __init__(
        self, connection: ServerConnection, log: PlayedLog, speed: float, say: Callable[[str], None]
    ) -> None:
        self._connection, self._log, self._say = connection, log, say
        self._topics = {number: one.topic for number, one in enumerate(log.channels, 1)}
        self._subscriptions: dict[int, int] = {}  # their numbers by channel
        self._clock = PlaybackClock(log.begin, speed)
        self._sent = log.begin - 1  # log time until which everything is sent
        self._clock_sent_s = 0.0  # when the viewer was told the time
        self._has_begun = self._has_ended = False
        self._reading: _Reading | None = None

    async def run(self) -> None:
        """Play until the viewer goes: it is heard after each part of what is due."""
        offered = [_described(number, one) for number, one in enumerate(self._log.channels, 1)]
        await self._connection.send(json.dumps({"op": "advertise", "channels": offered}))
        await self._send_state()
        seconds: float | None = None
        while True:
            message = None
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(seconds):
                    message = await self._connection.recv()
            try:
                if message is not None:
                    await self._obey(message)
                seconds = await self._send_due()
            except HybridlogError as error:  # messages cannot be read
                self._clock.set(runs=False)
                self._reading = seconds = None
                self._say(str(error))
                await self._connection.send(problem(str(error)))
                await self._send_state()

    async def _send_state(self, *, seek: int | None = None, request: bytes = b"") -> None:
        """Tell a viewer whose protocol has it what the playback does, perhaps after a seek."""
        if self._connection.subprotocol != _WITH_PLAYBACK:
            return
        state = ENDED if self._has_ended else PLAYING if self._clock.is_running else PAUSED
        position = min(self._clock.position, self._log.end) if seek is None else seek
        about = position, self._clock.speed, seek is not None, len(request)
        await self._connection.send(_STATE.pack(_PLAYBACK_STATE, state, *about) + request)

    # Requests.

    async def _obey(self, message: str | bytes) -> None:
        try:
            request = parse(message)
        except UsageError as error:
            await self._connection.send(problem(str(error)))
            return
        if isinstance(request, Subscriptions):
            await self._subscribe(request)
        else:
            await self._control(request)

    async def _subscribe(self, request: Subscriptions) -> None:
        """End subscriptions, and begin others with the messages that are current now."""
        new, ended = set(), set(request.ended)
        own = {c: s for c, s in self._subscriptions.items() if s not in ended}
        self._subscriptions = own
        for each in request.subscriptions:
            if each.channel in self._topics and each.channel not in own:
                own[each.channel] = each.id
                new.add(each.channel)
            else:
                wrong = f"channel {each.channel} does not exist, or is subscribed to"
                await self._connection.send(problem(wrong))
        self._read()
        await self._send_current(new)
        if new and not self._has_begun:
            self._has_begun = True
            self._clock.set(runs=True)
            await self._send_state()

    async def _control(self, request: Control) -> None:
        """Play, pause, seek or change the speed."""
        self._has_begun = True
        seek = request.seek
        if seek is not None:
            seek = min(max(seek, self._log.begin), self._log.end)
            self._has_ended = False
        self._clock.set(runs=request.plays and not self._has_ended, speed=request.speed)
        if seek is not None:
            self._sent = seek - 1
            self._clock.set(seek)
            await self._send_state(seek=seek, request=request.id)
            await self._connection.send(time_now(seek))
            self._read()
            await self._send_current(set(self._topics))
            return
        if self._clock.is_running and self._reading is None:
            self._read()  # after an error
        await self._send_state(request=request.id)

    # Messages.

    async def _send_due(self) -> float | None:
        """Send what is due, or a part of it; the seconds until more is, None if the time stands."""
        if self._reading is None and not self._clock.is_running:
            return None  # a subscriber gets all messages of this time
        before, following = self._sent, await self._next_time()
        while following is not None and following <= max(self._clock.position, self._sent):
            assert self._reading is not None
            batch, self._sent = self._reading.take(max(self._clock.position, self._sent))
            await self._send(batch, self._topics)
            if self._clock.position - self._sent > _LATE_S * self._clock.speed * 1e9:
                self._clock.set(self._sent)
            following = await self._next_time()
            if following != self._sent:
                break  # messages of the same time belong together, even if a request waits
        last = self._log.end if following is None else following - 1
        self._sent = max(self._sent, min(self._clock.position, last))
        if self._sent > before and time.monotonic() - self._clock_sent_s > _TICK_S:
            self._clock_sent_s = time.monotonic()
            await self._connection.send(time_now(self._sent))
        await self._go_on()
        ahead = math.inf if following is None else following - self._clock.position
        if ahead <= 0:
            return 0.0
        is_running = self._clock.is_running
        return min(max(ahead / self._clock.speed / 1e9, _STEP_S), _TICK_S) if is_running else None

    async def _next_time(self) -> int | None:
        return await self._reading.next_time() if self._reading is not None else None

    async def _go_on(self) -> None:
        """Pass over the time between two recordings; at the end, stop."""
        if not self._clock.is_running:
            return
        if self._sent >= self._log.end:
            self._clock.set(self._log.end, runs=False)
            self._has_ended = True
            await self._connection.send(time_now(self._log.end))
            await self._send_state()
            return
        then = self._log.next_covered(self._sent)
        if then > self._sent:
            self._sent = then - 1
            self._clock.set(then)
            await self._send_state()

    async def _send_current(self, channels: Collection[int]) -> None:
        """Send the messages that are current of channels that are subscribed to."""
        wanted = set(self._subscriptions).intersection(channels)
        topics = sorted({self._topics[channel] for channel in wanted})
        reading = _Reading(self._log.current(topics, self._sent))
        while await reading.next_time() is not None:
            batch, _ = reading.take(self._sent)
            await self._send(batch, wanted)

    async def _send(self, batch: Batch, channels: Collection[int]) -> None:
        """Send messages of some channels, as far as these are subscribed to."""
        own = {c: s for c, s in self._subscriptions.items() if c in channels}
        rows = zip(batch.channel.tolist(), batch.log_time.tolist(), strict=True)
        for row, (channel, log_time) in enumerate(rows):
            if channel in own:
                head = _DATA.pack(MESSAGE_DATA, own[channel], log_time)
                await self._connection.send(head + batch.payload(row))

    def _read(self) -> None:
        """Read the subscribed topics, behind what is sent already."""
        topics = sorted({self._topics[channel] for channel in self._subscriptions})
        self._reading = _Reading(self._log.after(topics, self._sent)) if topics else None
