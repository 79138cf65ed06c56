"""The ROS 1 source: subscribes to the topics of a running ROS 1 system.

It has two threads. One runs an event loop for master, calls and handshakes. The other only reads
messages from sockets (see `stream`).

It asks the master twice a second for topics and their publishers, and connects to these. It does
not register: so nobody needs to reach it, and a restarted master or a node that comes back under
another address is noticed in the same way as a new topic.

Subscribing is a call, a TCP connection and an exchange of headers. A call is XML-RPC in HTTP 1.0
(one call a connection, no chunks). The client of the standard library blocks, trusts any length
and reads without limit, but peers are untrusted; so it is used only for XML.

A connection header of TCPROS is its length, then fields `key=value`, each after its own length.
All lengths are 4 bytes, little-endian. After both headers the publisher sends messages, each after
its length, until one side closes.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import secrets
import socket
import xmlrpc.client
from typing import TYPE_CHECKING, Any, Final, TypeVar
from urllib.parse import urlsplit
from xml.parsers.expat import ExpatError

import msgspec

from hybridlog.live.sources.base import (
    PATIENCE_S,
    Endpoint,
    LoopSource,
    PeerError,
    Sink,
    UnreachedError,
    connect,
    endpoint_of,
    one_line,
    reason_of,
)
from hybridlog.live.sources.ros1.stream import Reader, Stream, u32
from hybridlog_storage.errors import UsageError
from hybridlog_storage.messages import Channel, Schema

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterable, Mapping


_DEFAULT_URI: Final = "http://localhost:11311"
_DEFAULT_PORT: Final = 11311
_PAUSE_S: Final = 1.0  # between two connections, or two questions to a master that is not there


class Ros1Source(LoopSource):
    """Subscribes to topics of a ROS 1 system, whatever their type.

    Each connection to a publisher is a channel with the fields of its header, as in a bag.
    ROS 1 does not transmit send times, so channels have no publish time. Gaps in
    `header.seq` show messages that a publisher dropped in its queue (see `sequence_gaps`).
    Losses of types without a header cannot be detected.

    Publishers know it as `/hybridlog_PID_RANDOM`.

    Args:
        master_uri: The master's address; if None, `ROS_MASTER_URI` or the default port of
            this computer.
        max_message_bytes: Longest message. A connection that announces a longer one is
            closed. Memory grows only as bytes come.
        poll_s: Interval at which the master is polled, seconds.
    """

    kind = "ROS 1"

    def __init__(
        self,
        master_uri: str | None = None,
        *,
        max_message_bytes: int = 1 << 30,
        poll_s: float = 0.5,
    ) -> None:
        super().__init__()
        self.address = master_uri or os.environ.get("ROS_MASTER_URI") or _DEFAULT_URI
        self.was_reached = False
        self.caller = f"/hybridlog_{os.getpid()}_{secrets.token_hex(4)}"
        self.max_message_bytes = max_message_bytes
        self.poll_s = poll_s

    def check(self) -> None:
        """Checks the address."""
        self._endpoint()

    def start(self, sink: Sink) -> None:
        """Begins to poll the master, which need not be up yet."""
        uri = f"http://{self._endpoint()}/"
        self._begin_loop(sink, lambda: self._follow(sink, uri))

    def _endpoint(self) -> Endpoint:
        try:
            return endpoint_of(self.address, _DEFAULT_PORT)
        except PeerError as error:
            raise UsageError(
                f"{error}; give a ROS master like {_DEFAULT_URI} with --ros1 or ROS_MASTER_URI"
            ) from error

    async def _follow(self, sink: Sink, uri: str) -> None:
        """Runs all tasks until the source is stopped or one of them fails."""
        loop = asyncio.get_running_loop()
        failed: asyncio.Future[None] = loop.create_future()

        def fail(error: BaseException) -> None:
            if not failed.done():
                failed.set_exception(error)

        reader = Reader(lambda error: loop.call_soon_threadsafe(fail, error))
        reader.start()
        try:
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(Graph(uri, self, sink, reader, tasks.create_task).watch())
                await failed
        except BaseExceptionGroup as group:
            raise group.exceptions[0] from None
        finally:
            reader.stop()


_Kind = TypeVar("_Kind")
_REST: Final = 4


class Graph:
    """The topics of a master, and the subscriptions to them.

    `spawn` runs a coroutine until the source stops.
    """

    def __init__(
        self,
        uri: str,
        source: Ros1Source,
        sink: Sink,
        reader: Reader,
        spawn: Callable[[Coroutine[None, None, None]], object],
    ) -> None:
        self.source, self.sink, self.reader, self.spawn = source, sink, reader, spawn
        self._uri = uri
        self._subscriptions: dict[str, Subscription] = {}
        self._nodes: dict[str, str] = {}  # addresses by name

    def forget(self, uri: str) -> None:
        """Look again where the node of an address is: it does not answer there."""
        self._nodes = {name: known for name, known in self._nodes.items() if known != uri}

    async def watch(self) -> None:
        """Polls the master until cancelled."""
        loop = asyncio.get_running_loop()
        while True:
            began = loop.time()
            try:
                await self._poll()
            except PeerError as error:
                self.sink.say(
                    f"no ROS master at {one_line(self._uri)} ({error}); waiting for it. Start "
                    "roscore, or give its address with --ros1 or ROS_MASTER_URI"
                )
                await asyncio.sleep(_PAUSE_S)
                continue
            # A large system that takes long to poll is polled less often.
            await asyncio.sleep(max(self.source.poll_s, _REST * (loop.time() - began)))

    async def _poll(self) -> None:
        """Polls the master once, and updates the subscriptions."""
        lists = list[tuple[str, list[str]]]
        state = await self._asked(tuple[lists, object, object], "getSystemState")
        self.source.was_reached = True
        types = dict(await self._asked(list[tuple[str, str]], "getTopicTypes"))
        publishers = {topic: nodes for topic, nodes in state[0] if nodes}
        for topic in publishers.keys() | self._subscriptions.keys():
            kind = types.get(topic, "")
            kind = "" if kind == ANY else kind
            if topic not in self._subscriptions:
                if not self.sink.wants(topic, kind):
                    continue
                self._subscriptions[topic] = Subscription(self, topic)
            uris = [await self._find(node) for node in publishers.get(topic, ())]
            self._subscriptions[topic].update(kind, filter(None, uris))

    async def _find(self, node: str) -> str:
        """The address of a node; empty if it has gone."""
        if node not in self._nodes:
            try:
                self._nodes[node] = await self._asked(str, "lookupNode", node)
            except RefusedError:
                return ""
        return self._nodes[node]

    async def _asked(self, kind: type[_Kind], method: str, *arguments: object) -> _Kind:
        """What the master answers."""
        answer = await call(self._uri, method, self.source.caller, *arguments)
        try:
            return msgspec.convert(answer, kind)
        except msgspec.ValidationError as error:
            raise PeerError("its answer is not that of a ROS master") from error


class Subscription:
    """A wanted topic."""

    def __init__(self, graph: Graph, topic: str) -> None:
        self.topic = topic
        self._graph = graph
        self._links: dict[str, _Link] = {}
        self._type = ""
        self._reported = (False, "")

    def update(self, type_name: str, uris: Iterable[str]) -> None:
        """Updates the publishers, by their addresses.

        A connection to a publisher that is no longer listed goes on until it ends: a restarted
        master lists none at first. `type_name` is empty if the master does not know it.
        """
        if type_name:
            self._type = type_name
        listed = set(uris)
        for uri, link in tuple(self._links.items()):
            link.is_listed = uri in listed
            if link.has_ended and not link.is_listed:
                del self._links[uri]
        for uri in sorted(listed - set(self._links)):
            link = self._links[uri] = _Link(self, uri)
            self._graph.spawn(self._connect(uri, link))
        self.report()

    def report(self) -> None:
        """Tells the sink whether a publisher is connected, if that has changed."""
        now = (any(link.is_up for link in self._links.values()), self._type)
        if now == self._reported:
            return
        before, self._reported = self._reported, now
        if now[0]:
            self._graph.sink.topic_came(self.topic, self._type)
        elif before[0]:
            self._graph.sink.topic_gone(self.topic)

    def channel(self, fields: Mapping[str, str]) -> Channel | None:
        """The channel of a connection; None if it is unwanted."""
        type_name = fields.get("type", "")
        if type_name and type_name != ANY:
            self._type = self._type or type_name
            if not self._graph.sink.wants(self.topic, type_name):
                return None
        return channel_of(self.topic, fields)

    async def _connect(self, uri: str, link: _Link) -> None:
        await link.run(self._graph)
        link.is_up, link.has_ended = False, True
        if not link.is_listed:
            del self._links[uri]
        self.report()


class _Link:
    """The connection to one publisher of a topic, which the master lists or no longer lists."""

    def __init__(self, subscription: Subscription, uri: str) -> None:
        self.is_listed = True
        self.is_up = self.has_ended = False
        self._subscription = subscription
        self._uri = uri

    async def run(self, graph: Graph) -> None:
        """Connects and reconnects until the publisher is neither listed nor reachable."""
        topic, failures = self._subscription.topic, 0
        while True:
            try:
                connected, fields = await subscribe(graph.source.caller, topic, self._uri)
            except (OSError, PeerError) as error:
                if not self.is_listed:
                    return
                failures += 1
                # A single failure is normal: a node that ends is listed a little longer.
                if failures == 2:
                    graph.sink.say(self._told(error))
            else:
                failures = 0
                try:
                    channel = self._subscription.channel(fields)
                except BaseException:
                    connected.close()
                    raise
                if channel is None:
                    connected.close()
                    return
                await self._serve(graph, connected, channel)
            self._set_up(is_up=False)
            graph.forget(self._uri)
            await asyncio.sleep(_PAUSE_S)

    def _told(self, error: OSError | PeerError) -> str:
        """A failure, for the user."""
        uri, reason = one_line(self._uri), reason_of(error)
        if isinstance(error, UnreachedError):
            return (
                f"the publisher {uri} cannot be reached: {reason}; trying again. Is it dead "
                "(`rosnode cleanup`), or on a computer with an unknown name (set ROS_IP there)?"
            )
        topic = one_line(self._subscription.topic)
        return f"{topic}: cannot subscribe at its publisher {uri}: {reason}; trying again"

    async def _serve(self, graph: Graph, connected: socket.socket, channel: Channel) -> None:
        """Lets the reader read a connection until it ends."""
        loop = asyncio.get_running_loop()
        ended: asyncio.Future[str] = loop.create_future()

        def settle(failure: str) -> None:
            if not ended.done():
                ended.set_result(failure)

        def closed(failure: str) -> None:
            loop.call_soon_threadsafe(settle, failure)

        stream = Stream(connected, channel, graph.sink, graph.source.max_message_bytes, closed)
        self._set_up(is_up=True)
        graph.reader.add(stream)
        if failure := await ended:
            name = one_line(channel.metadata.get("callerid", "an unnamed node"))
            what = f"{one_line(channel.topic)}: lost the connection to {name}"
            graph.sink.say(f"{what} at {one_line(self._uri)}: {failure}; connecting again")

    def _set_up(self, *, is_up: bool) -> None:
        self.is_up = is_up
        self._subscription.report()


MAX_HEADER: Final = 4 << 20
"""Longest connection header, bytes; a definition of 100 kB is a long one."""

ANY: Final = "*"
"""Wildcard of subscribers, and of relays that do not know their type yet."""

_MAX_FIELDS = 1000


def encode_header(fields: Mapping[str, str]) -> bytes:
    """A connection header with its length."""
    lines = [f"{key}={value}".encode() for key, value in fields.items()]
    body = b"".join(len(line).to_bytes(4, "little") + line for line in lines)
    return len(body).to_bytes(4, "little") + body


def decode_header(body: bytes) -> dict[str, str]:
    """The fields of a connection header, which comes without its length."""
    fields: dict[str, str] = {}
    pos = 0
    while pos < len(body):
        end = pos + 4 + int.from_bytes(body[pos : pos + 4], "little")
        key, equals, value = body[pos + 4 : end].partition(b"=")
        if end > len(body) or not equals or len(fields) == _MAX_FIELDS:
            raise PeerError(f"its header is malformed at byte {pos}")
        fields[key.decode(errors="replace").strip()] = value.decode(errors="replace")
        pos = end
    return fields


def channel_of(topic: str, fields: Mapping[str, str]) -> Channel:
    """The channel that a publisher's header describes, as in a bag."""
    metadata = dict(fields)
    definition = metadata.pop("message_definition", None)
    name = metadata.pop("type", "")
    metadata.pop("topic", None)
    schema = None
    if name and name != ANY:
        encoding = "" if definition is None else "ros1msg"
        schema = Schema(name, encoding, (definition or "").encode())
    return Channel(topic, "ros1", schema, metadata, has_publish_time=False)


# A peer that was switched off is noticed after some 25 s of silence.
_KEEPALIVE: Final = (
    (socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1),
    (socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 10),
    (socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 5),
    (socket.IPPROTO_TCP, socket.TCP_KEEPCNT, 3),
)


async def subscribe(caller: str, topic: str, uri: str) -> tuple[socket.socket, dict[str, str]]:
    """Connects to a publisher of a topic, whatever its type.

    Returns the socket, positioned at the first message, and the fields of the publisher's header.
    """
    protocol = await call(uri, "requestTopic", caller, topic, [["TCPROS"]])
    place = _place_of(protocol)
    try:
        connected = await connect(place)
    except OSError as error:
        raise UnreachedError(f"{one_line(str(place))}: {reason_of(error)}") from error
    try:
        for option in _KEEPALIVE:
            connected.setsockopt(*option)
        async with asyncio.timeout(2 * PATIENCE_S):
            fields = await _exchange_headers(connected, caller, topic)
    except BaseException:
        connected.close()
        raise
    return connected, fields


def _place_of(protocol: object) -> Endpoint:
    """The endpoint in a publisher's answer to `requestTopic`."""
    match protocol:
        case ["TCPROS", str(host), int(port)] if host and 0 < port < 65536:
            return Endpoint(host, port)
    raise PeerError("it does not offer the topic over TCPROS")


async def _exchange_headers(connected: socket.socket, caller: str, topic: str) -> dict[str, str]:
    loop = asyncio.get_running_loop()
    ours = encode_header(
        {
            "callerid": caller,
            "topic": topic,
            "type": ANY,
            "md5sum": ANY,
            # A small message must not wait for the next one: its receive time would be wrong.
            "tcp_nodelay": "1",
        }
    )
    await loop.sock_sendall(connected, ours)
    length = u32(await _exactly(connected, 4), 0)[0]
    if length > MAX_HEADER:
        raise PeerError(f"it announces a connection header of {length} bytes")
    fields = decode_header(await _exactly(connected, length))
    if "error" in fields:
        raise PeerError(f"it refuses: {one_line(fields['error'])}")
    return fields


async def _exactly(connected: socket.socket, count: int) -> bytes:
    """Receives exactly `count` bytes."""
    loop = asyncio.get_running_loop()
    got = bytearray()
    while len(got) < count:
        data = await loop.sock_recv(connected, min(count - len(got), 64 << 10))
        if not data:
            raise PeerError("it closed the connection within its header")
        got += data
    return bytes(got)


class RefusedError(PeerError):
    """A peer refuses a valid call."""


_MAX_ANSWER: Final = 32 << 20
_END: Final = b"\r\n\r\n"


async def call(uri: str, method: str, *arguments: Any) -> object:
    """Calls a method of the master or of a node, which has 10 s, and returns its value."""
    endpoint = endpoint_of(uri)
    path = urlsplit(uri).path or "/RPC2"
    body = xmlrpc.client.dumps(arguments, method).encode(errors="replace")
    head = (
        f"POST {path} HTTP/1.0\r\nHost: {endpoint}\r\nContent-Type: text/xml\r\n"
        f"Content-Length: {len(body)}\r\n\r\n"
    )
    try:
        async with asyncio.timeout(2 * PATIENCE_S):
            reader, writer = await asyncio.open_connection(sock=await connect(endpoint))
            with contextlib.closing(writer):
                writer.write(head.encode("ascii") + body)
                answer = await _answer(reader)
    except OSError as error:
        raise UnreachedError(reason_of(error)) from error
    match _parsed(answer):
        case ([1, _, value],):
            return value
        case ([int(), text, _],):
            raise RefusedError(f"it refuses: {one_line(str(text))}")
    raise PeerError("its answer is not that of a ROS node")


async def _answer(reader: asyncio.StreamReader) -> bytes:
    """The body of an answer; without a length, all that comes."""
    try:
        first, *fields = (await reader.readuntil(_END)).removesuffix(_END).split(b"\r\n")
    except (asyncio.IncompleteReadError, asyncio.LimitOverrunError) as error:
        raise PeerError("it does not speak HTTP") from error
    version, _, status = first.partition(b" ")
    if not version.startswith(b"HTTP/"):
        raise PeerError("it does not speak HTTP")
    if status.split()[:1] != [b"200"]:
        raise PeerError(f"it answers {one_line(status)}")
    told = dict(line.lower().partition(b":")[::2] for line in fields).get(b"content-length")
    if told is not None and not told.strip().isdigit():
        raise PeerError("it sends an invalid content length")
    length = None if told is None else int(told.strip()[:20])
    got = bytearray()
    while length is None or len(got) < length:
        if max(length or 0, len(got)) > _MAX_ANSWER:
            raise PeerError(f"its answer is longer than {_MAX_ANSWER >> 20} MiB")
        data = await reader.read(64 << 10)
        if not data:
            break
        got += data
    if length is not None and len(got) < length:
        raise PeerError("it closed in the middle of its answer")
    return bytes(got[:length])


def _parsed(body: bytes) -> tuple[object, ...]:
    """The values of an XML-RPC text."""
    # ROS nodes send none, and entities let small texts expand.
    if b"<!DOCTYPE" in body or b"<!ENTITY" in body:
        raise PeerError("it sends XML with a document type")
    try:
        return xmlrpc.client.loads(body)[0]
    except xmlrpc.client.Fault as fault:
        raise PeerError(f"it answers: {one_line(str(fault.faultString))}") from fault
    except (
        ExpatError,
        xmlrpc.client.ResponseError,
        ArithmeticError,
        AttributeError,
        LookupError,
        TypeError,
        ValueError,
    ) as error:
        # The library raises all of these for malformed XML-RPC.
        raise PeerError("it sends malformed XML-RPC") from error
