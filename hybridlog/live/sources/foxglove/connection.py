"""Connects to a Foxglove server, and reads until stopped: channels, subscriptions, messages."""

from __future__ import annotations

import asyncio
import json
import logging
import re
import socket
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from operator import attrgetter
from struct import Struct
from typing import Final, NamedTuple

from picows import (
    WSCloseCode,
    WSFrame,
    WSHandshakeError,
    WSListener,
    WSMsgType,
    WSProtocolError,
    WSTransport,
    ws_connect,
)

from hybridlog.live.sources.base import (
    Cause,
    Endpoint,
    Loss,
    PeerError,
    Sink,
    connect,
    one_line,
    reason_of,
)
from hybridlog.live.sources.foxglove.protocol import (
    MAX_TEXT,
    MESSAGE_DATA,
    SUBPROTOCOLS,
    Address,
    Offer,
    parse_channel,
)
from hybridlog.live.sources.sequence_gaps import (
    SequenceGap,
    SequenceGapDetector,
    has_sequence_numbers,
)
from hybridlog_storage.messages import Channel

_OPEN_S: Final = 10.0
_CLOSE_S: Final = 1.0
_PING_S: Final = 10.0  # silence after which a ping is sent, and then until the end
_PAUSE_S: Final = 1.0
_SILENT: Final = logging.Logger("picows", logging.CRITICAL + 1)  # the user is told by us


class Client:
    """The client, which runs in the event loop of a Foxglove source."""

    def __init__(self, sink: Sink, address: Address, reached: Callable[[], None]) -> None:
        self._sink = sink
        self._address = address
        self._reached = reached
        self._missed: dict[str, int] = {}

    async def run(self) -> None:
        """Connect, read and reconnect until cancelled."""
        while True:
            try:
                reason = await self._connect()
            except PeerError as error:
                reason = str(error)
            self._sink.say(f"{self._address.shown}: {one_line(reason)}; trying again")
            await asyncio.sleep(_PAUSE_S)

    async def _connect(self) -> str:
        """Make one connection, and read it to its end; returns the reason, for the user."""
        session = Session(self._sink, self._address.shown, self._missed, self._reached)
        opening = asyncio.ensure_future(self._open(session))
        is_stopped = True
        try:
            opened, _ = await asyncio.wait({opening}, timeout=_OPEN_S)
            if not opened:
                raise PeerError(f"does not answer within {_OPEN_S:g} s; check host and port")
            transport = opening.result()
            ended = asyncio.ensure_future(transport.wait_disconnected())
            await asyncio.wait({ended})
            is_stopped = False
        finally:
            await self._leave(session, opening)
            session.end(is_stopped=is_stopped)
        return self._reason(transport, session.problem or ended.exception())

    async def _leave(self, session: Session, opening: asyncio.Future[WSTransport]) -> None:
        """Close a connection, if there is one: first messages that are under way still come."""
        if not session.is_connected:
            opening.cancel()
        await asyncio.wait({opening})
        if opening.cancelled() or opening.exception() is not None:
            return
        transport = opening.result()
        ended = asyncio.ensure_future(transport.wait_disconnected())
        if not (await asyncio.wait({ended}, timeout=0))[0]:
            transport.send_close(WSCloseCode.OK)
            await asyncio.wait({ended}, timeout=_CLOSE_S)
            transport.disconnect(graceful=False)
            await asyncio.wait({ended})
        ended.exception()

    def _reason(self, transport: WSTransport, problem: BaseException | None) -> str:
        if isinstance(problem, WSProtocolError):
            if problem.code != WSCloseCode.MESSAGE_TOO_BIG:
                return f"violates the websocket protocol ({problem})"
            now = time.time_ns()
            detail = "a message exceeds the limit of this source"
            self._sink.lost(Loss(Cause.UNREADABLE, "", 1, now, now, detail))
            size = Session.max_bytes
            return f"announces a message of more than {size} bytes; is it a Foxglove server?"
        if problem is not None:
            raise problem
        closing = transport.close_handshake
        if closing is not None and closing.sent is not None:
            return f"has been silent for {2 * _PING_S:g} s"
        return "the connection broke"

    async def _open(self, session: Session) -> WSTransport:
        """Connect, and agree on the protocol; PeerError names reason and remedy."""
        place = Endpoint(self._address.host, self._address.port)
        try:
            made = await connect(place)
            transport, listener = await self._shake_hands(made, session)
        except WSHandshakeError as error:
            status = (error.raw_header or b"").split(b"\r\n", 1)[0]
            raise PeerError(_UNREACHED.format(one_line(status or str(error)))) from error
        except OSError as error:
            raise PeerError(_UNREACHED.format(reason_of(error))) from error
        if listener is None:
            raise PeerError(_UNREACHED.format("it is no websocket server"))
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


_UNREACHED = (
    "cannot be reached ({}); start foxglove_bridge or the program, or check host, port (8765), TLS "
    "(wss://, SSL_CERT_FILE) and password (ws://USER:PASSWORD@HOST:PORT)"
)
_MAX_CHANNELS: Final = 1 << 16
_MAX_RETIRED: Final = 1 << 12
_MAX_NS: Final = 1 << 63
_NO_CHANNEL = re.compile(
    r"(?i)unknown channel\D{0,20}(\d{1,20})\b|channel\D{0,20}(\d{1,20}) is not available"
)
_LARGE: Final = 1 << 14  # bytes from which a second copy costs more than a view
_RETRY_S: Final = 0.2
_MAX_UNREAD: Final = 8 << 20  # bytes of ours
_NUMBER: Final = Struct("<I").unpack_from
_HEAD: Final = Struct("<xIQ")
_CONTENT: Final = attrgetter("topic", "message_encoding", "schema", "metadata")
_BINARY: Final = WSMsgType.BINARY


class _Subscription(NamedTuple):
    """A subscription to a channel."""

    number: int
    offer: Offer


class Session(WSListener):
    """One connection; picows calls it in the thread that reads.

    `missed` are topics of an earlier connection, with the time of its end, ns since the epoch.
    Topics that are available again are removed.
    """

    max_bytes: Final = 1 << 30  # of a message

    def __init__(
        self, sink: Sink, name: str, missed: dict[str, int], reached: Callable[[], None]
    ) -> None:
        self.problem: Exception | None = None  # why the session ended the connection
        self.is_connected = False
        self._sink = sink
        self._take = sink.take
        self._name = name
        self._missed = missed
        self._reached = reached
        self._next = 0
        self._routes: dict[int, tuple[Channel, SequenceGapDetector | None]] = {}
        self._subscriptions: dict[int, _Subscription] = {}
        self._topics: Counter[str] = Counter()
        self._refused: set[int] = set()
        self._retired: deque[int] = deque()
        self._loop = asyncio.get_running_loop()
        self._transport: WSTransport

    def _say(self, text: str) -> None:
        """Report a problem; the text may quote the server."""
        self._sink.say(f"{self._name}: {one_line(text)}")

    # The connection.

    def on_ws_connected(self, transport: WSTransport) -> None:
        """Check the protocol."""
        self._transport, self.is_connected = transport, True
        transport.underlying_transport.set_write_buffer_limits(_MAX_UNREAD)
        if transport.response.headers.get("Sec-WebSocket-Protocol") in SUBPROTOCOLS:
            self._reached()
        else:
            self._fail(
                PeerError(
                    "a websocket server that does not speak Foxglove; start foxglove_bridge or "
                    "a program with the Foxglove SDK, and give its port"
                )
            )

    def on_ws_frame(self, transport: WSTransport, frame: WSFrame) -> None:
        """Take a frame."""
        if self.problem is not None:
            return
        try:
            kind, size = frame.msg_type, frame.payload_size
            if frame.rsv1 or frame.rsv2 or frame.rsv3:
                raise PeerError("violates the websocket protocol (reserved bits are set)")
            if size > self.max_bytes:
                return  # picows, which ends the connection, may still read it
            if kind is WSMsgType.CONTINUATION or not frame.fin:
                raise PeerError("sends messages in pieces, which no Foxglove server does")
            if kind is _BINARY:
                if size < _LARGE:
                    self._binary(frame.get_payload_as_bytes())
                else:
                    self._binary(frame.get_payload_as_memoryview())
            elif kind is WSMsgType.CLOSE:
                if transport.is_close_frame_sent:
                    transport.disconnect(graceful=False)
                    return
                transport.send_close(WSCloseCode.OK)
                reason = frame.get_close_reason()
                raise PeerError("closed the connection" + (f" ({reason})" if reason else ""))
            elif kind is WSMsgType.TEXT:
                if size > MAX_TEXT:
                    raise PeerError(f"sends a JSON message of more than {MAX_TEXT} bytes")
                self._text(frame.get_payload_as_bytes())
        except Exception as error:
            self._fail(error)

    def pause_writing(self) -> None:
        """Leave a server that does not read."""
        self._fail(PeerError(f"leaves more than {_MAX_UNREAD} bytes unread"))

    def _fail(self, error: Exception) -> None:
        self.problem = self.problem or error
        self._transport.disconnect(graceful=False)

    def _send(self, operation: str, **values: object) -> None:
        self._transport.send(WSMsgType.TEXT, json.dumps({"op": operation, **values}))

    def _subscribe(self, wanted: Iterable[_Subscription]) -> None:
        asked = [{"id": each.number, "channelId": each.offer.id} for each in wanted]
        self._send("subscribe", subscriptions=asked)

    # Messages.

    def _binary(self, data: bytes | memoryview) -> None:
        """Take a binary message."""
        received = time.time_ns()
        route, log_time = None, 0
        if len(data) >= _HEAD.size and data[0] == MESSAGE_DATA:
            subscription, log_time = _HEAD.unpack_from(data)
            route = self._routes.get(subscription)
        elif data and data[0] != MESSAGE_DATA:
            return  # such as an answer to a request
        if route is None:
            detail = "a binary message that is of no subscription"
            self._sink.lost(Loss(Cause.UNREADABLE, "", 1, received, received, detail))
            self._say(f"sends {detail}; it is ignored")
            return
        channel, gaps = route
        if log_time >= _MAX_NS:
            self._say(
                f"gives {channel.topic!r} a time after the year 2262; it is replaced by the "
                "receive time"
            )
            log_time = received
        payload = bytes(data[_HEAD.size :])
        self._take(channel, payload, received=received, sent=log_time)
        if gaps is not None and len(payload) >= 4:
            gaps.see(_NUMBER(payload)[0], received)
            if gaps.waiting:
                self._report(channel.topic, gaps.confirmed())

    # JSON messages.

    def _text(self, data: bytes) -> None:
        """Handle a JSON message; operations that do not matter to a recorder are ignored."""
        message: object = None
        with suppress(ValueError, RecursionError):
            message = json.loads(data.decode())
        match message:
            case {"op": "advertise", "channels": list(channels)}:
                self._advertise(channels)
            case {"op": "unadvertise", "channelIds": list(numbers)}:
                for number in numbers:
                    if type(number) is int and number in self._subscriptions:
                        self._retire(number)
            case {"op": "status", **about}:
                self._status(str(about.get("message")))
            case {"op": str(operation)} if operation not in {"advertise", "unadvertise"}:
                pass
            case _:
                self._say("sent a text that is no message of Foxglove; it is ignored")

    def _advertise(self, channels: list[object]) -> None:
        wanted: list[_Subscription] = []
        for entry in channels:
            try:
                offer = parse_channel(entry)
            except PeerError as error:
                self._say(str(error))
                continue
            subscription = self._offered(offer)
            if subscription is not None:
                wanted.append(subscription)
        if wanted:
            self._subscribe(wanted)

    def _offered(self, offer: Offer) -> _Subscription | None:
        """A new subscription to a channel, None if it needs none."""
        topic = offer.channel.topic
        known = self._subscriptions.get(offer.id)
        if known is not None:
            if _CONTENT(known.offer.channel) == _CONTENT(offer.channel):
                return None
            self._send("unsubscribe", subscriptionIds=[known.number])
            self._retire(offer.id)
        if not self._sink.wants(topic, offer.type_name):
            return None
        if len(self._subscriptions) >= _MAX_CHANNELS:
            self._say(f"has more than {_MAX_CHANNELS} channels; the rest is ignored")
            return None
        if offer.problem:
            self._say(
                f"the definition of {topic!r} {offer.problem}; its messages are recorded, but "
                "their fields cannot be searched"
            )
        gaps = SequenceGapDetector() if has_sequence_numbers(offer.channel) else None
        subscription = _Subscription(self._next, offer)
        self._next += 1
        self._subscriptions[offer.id] = subscription
        self._routes[subscription.number] = (offer.channel, gaps)
        self._topics[topic] += 1
        if self._topics[topic] == 1:
            self._sink.topic_came(topic, offer.type_name)
        since = self._missed.pop(topic, None)
        if since is not None:
            detail = "the connection was down; messages of this time are unknown"
            self._sink.lost(Loss(Cause.CONNECTION, topic, None, since, time.time_ns(), detail))
        return subscription

    def _retire(self, channel_id: int) -> None:
        """Remove a channel. Late messages of it are still recorded."""
        gone = self._subscriptions.pop(channel_id)
        self._retired.append(gone.number)
        if len(self._retired) > _MAX_RETIRED:
            self._routes.pop(self._retired.popleft(), None)
        topic = gone.offer.channel.topic
        self._topics[topic] -= 1
        if not self._topics[topic]:
            del self._topics[topic]
            self._sink.topic_gone(topic)

    def _status(self, text: str) -> None:
        """Show a status message to the user, or ask for a refused channel again, once.

        A server may advertise a channel a moment before it accepts subscriptions.
        """
        found = _NO_CHANNEL.search(text)
        refused = self._subscriptions.get(int(found[found.lastindex or 1])) if found else None
        if refused is None:
            self._say(f"says: {text}")
        elif refused.number in self._refused:
            self._say(f"offers {refused.offer.channel.topic!r}, but does not send it ({text})")
        else:
            self._refused.add(refused.number)
            self._loop.call_later(_RETRY_S, self._retry, refused)

    def _retry(self, refused: _Subscription) -> None:
        if self._subscriptions.get(refused.offer.id) is refused:
            self._subscribe([refused])

    def _report(self, topic: str, gaps: Iterable[SequenceGap]) -> None:
        """Notes messages that a publisher counted and that never came."""
        for gap in gaps:
            detail = "numbers are missing in header.seq"
            self._sink.lost(Loss(Cause.TRANSPORT, topic, gap.missing, gap.first, gap.last, detail))

    def end(self, *, is_stopped: bool) -> None:
        """End the session, as the source was stopped or the connection has ended."""
        now = time.time_ns()
        for channel, gaps in self._routes.values():
            if gaps is not None:
                self._report(channel.topic, gaps.finish())
        for topic in self._topics:
            if not is_stopped and len(self._missed) < _MAX_CHANNELS:
                self._missed[topic] = now
            self._sink.topic_gone(topic)
        self._topics.clear()
        self._subscriptions.clear()
        self._routes.clear()
