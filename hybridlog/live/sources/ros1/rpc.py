"""XML-RPC client and server for ROS, in an event loop, bounded in time and memory.

The client and server of the standard library block, trust any length and read without
limit, but peers are untrusted. So this module implements HTTP 1.0 (one call a connection,
no chunks), and uses the library only for XML.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import xmlrpc.client
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import urlsplit
from xml.parsers.expat import ExpatError

from hybridlog.live.sources.base import PeerError, one_line
from hybridlog.live.sources.network import (
    PATIENCE_S,
    Endpoint,
    Network,
    UnreachedError,
    endpoint_of,
    reason_of,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from hybridlog.live.sources.network import Addresses

    Method = Callable[[tuple[object, ...]], list[object]]


class RefusedError(PeerError):
    """A peer refuses a valid call."""


_MAX_ANSWER: Final = 32 << 20
_MAX_REQUEST: Final = 4 << 20
_MAX_CLIENTS: Final = 64
_END: Final = b"\r\n\r\n"


async def call(network: Network, uri: str, method: str, *arguments: Any) -> object:
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
            reader, writer = await asyncio.open_connection(sock=await network.connect(endpoint))
            with contextlib.closing(writer):
                writer.write(head.encode("ascii") + body)
                words, length = await _head(reader)
                if len(words) < 2 or not words[0].startswith(b"HTTP/"):
                    raise PeerError("it does not speak HTTP")
                if words[1] != b"200":
                    raise PeerError(f"it answers {one_line(b' '.join(words[1:]))}")
                answer = await _body(reader, length, _MAX_ANSWER)
    except OSError as error:
        raise UnreachedError(reason_of(error)) from error
    values, _ = _parsed(answer)
    return _value_of(values[0] if values else None)


async def _head(reader: asyncio.StreamReader) -> tuple[list[bytes], int | None]:
    """The words of the first line of a call or answer, and the length of its body."""
    try:
        got = await reader.readuntil(_END)
    except (asyncio.IncompleteReadError, asyncio.LimitOverrunError) as error:
        raise PeerError("it does not speak HTTP") from error
    first, *fields = got.removesuffix(_END).split(b"\r\n")
    return first.split(None, 2), _content_length(fields)


async def _body(reader: asyncio.StreamReader, length: int | None, most: int) -> bytes:
    """The body of a call or answer; without a length, all that comes."""
    got = bytearray()
    while length is None or len(got) < length:
        if max(length or 0, len(got)) > most:
            raise PeerError(f"its answer is longer than {most >> 20} MiB")
        data = await reader.read(64 << 10)
        if not data:
            if length is None:
                break
            raise PeerError("it closed in the middle of its answer")
        got += data
    return bytes(got[:length])


def _content_length(fields: list[bytes]) -> int | None:
    """The content length in the lines of an HTTP header, None if it has none."""
    for line in fields:
        name, _, value = line.partition(b":")
        if name.strip().lower() == b"content-length":
            value = value.strip()
            if not value.isdigit() or len(value) > 12:
                raise PeerError("it sends an invalid content length")
            return int(value)
        if name.strip().lower() == b"transfer-encoding":
            raise PeerError("it answers in chunks, which HTTP 1.0 does not have")
    return None


def _parsed(body: bytes) -> tuple[tuple[object, ...], str | None]:
    """Values and method name of an XML-RPC text."""
    # ROS nodes send none, and entities let small texts expand.
    if b"<!DOCTYPE" in body or b"<!ENTITY" in body:
        raise PeerError("it sends XML with a document type")
    try:
        return xmlrpc.client.loads(body)
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


def _value_of(answer: object) -> object:
    """The value in a ROS answer, a list of status, text and value."""
    match answer:
        case [1, _, value]:
            return value
        case [int(), text, _]:
            raise RefusedError(f"it refuses: {one_line(str(text))}")
    raise PeerError("its answer is not that of a ROS node")


class RpcServer:
    """Answers calls; `start` gives it a socket, which it owns."""

    def __init__(self, methods: Mapping[str, Method]) -> None:
        self._methods = methods
        self._clients = 0

    async def start(self, listening: socket.socket) -> asyncio.Server:
        """Answers calls until the returned server is closed, and the loop has ended."""
        return await asyncio.start_server(self._answer, sock=listening)

    async def _answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answers one call; malformed calls, and too many at once, close the connection."""
        self._clients += 1
        with contextlib.suppress(OSError, PeerError), contextlib.closing(writer):
            try:
                if self._clients <= _MAX_CLIENTS:
                    async with asyncio.timeout(PATIENCE_S):
                        await self._answer_one(reader, writer)
            finally:
                self._clients -= 1

    async def _answer_one(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        words, length = await _head(reader)
        if words[:1] != [b"POST"] or length is None:
            return
        values, method = _parsed(await _body(reader, length, _MAX_REQUEST))
        body = self._result(method, values).encode()
        head = f"HTTP/1.0 200 OK\r\nContent-Type: text/xml\r\nContent-Length: {len(body)}\r\n\r\n"
        writer.write(head.encode() + body)
        await writer.drain()

    def _result(self, method: str | None, values: tuple[object, ...]) -> str:
        known = self._methods.get(method or "")
        if known is None:
            fault = xmlrpc.client.Fault(1, f"unknown method {one_line(method or '')}")
            return xmlrpc.client.dumps(fault, methodresponse=True)
        return xmlrpc.client.dumps((known(values),), methodresponse=True)


_BACKLOG: Final = 64


async def listen(
    network: Network, environment: Mapping[str, str], say: Callable[[str], None]
) -> tuple[socket.socket, str]:
    """Opens the node's socket on `ROS_HOSTNAME` or `ROS_IP`; returns also its host for peers.

    Without these variables it listens on loopback. A master on another computer then cannot
    announce publishers, and polling finds them.
    """
    is_ipv6 = environment.get("ROS_IPV6") == "on"
    loopback = "::1" if is_ipv6 else "127.0.0.1"
    variable = "ROS_HOSTNAME" if environment.get("ROS_HOSTNAME") else "ROS_IP"
    host = environment.get(variable) or loopback
    try:
        return _bound(await network.addresses_of(host), is_ipv6=is_ipv6), host
    except OSError as error:
        if host == loopback:
            raise
        say(
            f"{variable}={one_line(host)} is not an address of this computer ({reason_of(error)}); "
            "the ROS master cannot announce publishers, so polling must find them"
        )
    return _bound(await network.addresses_of(loopback), is_ipv6=is_ipv6), loopback


def _bound(addresses: Addresses, *, is_ipv6: bool) -> socket.socket:
    """A socket that listens on the first address, if possible of the preferred family."""
    preferred = socket.AF_INET6 if is_ipv6 else socket.AF_INET
    family, address = min(addresses, key=lambda entry: entry[0] != preferred)
    made = socket.socket(family, socket.SOCK_STREAM)
    try:
        made.setblocking(False)
        made.bind(address)
        made.listen(_BACKLOG)
    except BaseException:
        made.close()
        raise
    return made


def uri_of(host: str, listening: socket.socket) -> str:
    """The node's address for calls."""
    return f"http://{Endpoint(host, listening.getsockname()[1])}/"


def methods(
    master_uri: str,
    topics: Callable[[], list[str]],
    changed: Callable[[str], None],
    say: Callable[[str], None],
) -> dict[str, Method]:
    """The slave API of a node that only subscribes.

    `topics` returns those that the node is registered for; `changed` is called with one whose
    publishers may have changed.
    """

    def publisher_update(arguments: tuple[object, ...]) -> list[object]:
        if len(arguments) == 3 and isinstance(arguments[1], str):
            changed(arguments[1])
            return [1, "", 0]
        return [-1, "publisherUpdate takes a caller, a topic and its publishers", 0]

    def shutdown(arguments: tuple[object, ...]) -> list[object]:
        caller = one_line(str(arguments[0])) if arguments else "a node"
        say(f"{caller} asks this node to shut down; only its own user can stop a recording")
        return [-1, "only its own user can stop a recorder", 0]

    def answer(value: Callable[[], object]) -> Method:
        return lambda _: [1, "", value()]

    return {
        "getBusInfo": answer(list),
        "getBusStats": answer(lambda: [[], [], []]),
        "getMasterUri": answer(lambda: master_uri),
        "getPid": answer(os.getpid),
        "getPublications": answer(list),
        "getSubscriptions": answer(lambda: [[topic, "*"] for topic in topics()]),
        "paramUpdate": answer(int),
        "publisherUpdate": publisher_update,
        "requestTopic": lambda _: [0, "this node publishes nothing", 0],
        "shutdown": shutdown,
    }
