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
from functools import partial
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
_MAX_HTTP_HEADER: Final = 64 << 10
_MAX_CLIENTS: Final = 64


# Calling.


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
            with await network.connect(endpoint) as connected:
                answer = await _exchange(connected, head.encode("ascii") + body)
    except OSError as error:
        raise UnreachedError(reason_of(error)) from error
    values, _ = _parsed(answer)
    return _value_of(values[0] if values else None)


async def _exchange(connected: socket.socket, request: bytes) -> bytes:
    """Sends a request, and returns the body of the answer."""
    await asyncio.get_running_loop().sock_sendall(connected, request)
    words, length, begun = await _head(connected)
    if len(words) < 2 or not words[0].startswith(b"HTTP/"):
        raise PeerError("it does not speak HTTP")
    if words[1] != b"200":
        raise PeerError(f"it answers {one_line(b' '.join(words[1:]))}")
    return await _body(connected, begun, length, _MAX_ANSWER)


async def _head(connected: socket.socket) -> tuple[list[bytes], int | None, bytearray]:
    """The words of the first line of a call or answer, the length of its body, and its begin."""
    loop = asyncio.get_running_loop()
    got = bytearray()
    while (end := got.find(b"\r\n\r\n")) < 0:
        data = await loop.sock_recv(connected, 64 << 10)
        if not data or len(got) > _MAX_HTTP_HEADER:
            raise PeerError("it does not speak HTTP")
        got += data
    first, *fields = bytes(got[:end]).split(b"\r\n")
    return first.split(None, 2), _content_length(fields), got[end + 4 :]


async def _body(connected: socket.socket, got: bytearray, length: int | None, most: int) -> bytes:
    """The body of a call or answer; without a length, all that comes."""
    loop = asyncio.get_running_loop()
    while length is None or len(got) < length:
        if max(length or 0, len(got)) > most:
            raise PeerError(f"its answer is longer than {most >> 20} MiB")
        data = await loop.sock_recv(connected, 64 << 10)
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


# Being called.


class RpcServer:
    """Answers calls on one socket, which it owns."""

    def __init__(self, listening: socket.socket, methods: Mapping[str, Method]) -> None:
        self._socket = listening
        self._methods = methods
        self._clients: set[asyncio.Task[None]] = set()

    async def serve(self) -> None:
        """Answers calls until cancelled; then closes all sockets."""
        loop = asyncio.get_running_loop()
        try:
            while True:
                while len(self._clients) >= _MAX_CLIENTS:
                    await asyncio.wait(self._clients, return_when=asyncio.FIRST_COMPLETED)
                await self._wait_for_call()
                try:
                    # The loop's `sock_accept` loses an accepted client if it is cancelled
                    # at that moment. Here nothing waits after `accept`.
                    client, _ = self._socket.accept()
                except BlockingIOError:
                    continue
                except OSError:
                    # The client is gone already, or no descriptors are left.
                    await asyncio.sleep(0.1)
                    continue
                client.setblocking(False)
                task = loop.create_task(self._answer(client))
                self._clients.add(task)
                task.add_done_callback(self._clients.discard)
                # Closes it even if the task is cancelled before it begins.
                task.add_done_callback(partial(_close, client))
        finally:
            self._socket.close()
            for task in tuple(self._clients):
                task.cancel()
            await asyncio.gather(*self._clients, return_exceptions=True)

    async def _wait_for_call(self) -> None:
        """Waits for a client."""
        loop = asyncio.get_running_loop()
        called = asyncio.Event()
        loop.add_reader(self._socket, called.set)
        try:
            await called.wait()
        finally:
            loop.remove_reader(self._socket)

    async def _answer(self, client: socket.socket) -> None:
        """Answers one call; malformed calls close the connection."""
        loop = asyncio.get_running_loop()
        with contextlib.suppress(OSError, PeerError):
            async with asyncio.timeout(PATIENCE_S):
                words, length, begun = await _head(client)
                if words[:1] != [b"POST"] or length is None:
                    return
                values, method = _parsed(await _body(client, begun, length, _MAX_REQUEST))
                body = self._result(method, values).encode()
                head = (
                    "HTTP/1.0 200 OK\r\nContent-Type: text/xml\r\n"
                    f"Content-Length: {len(body)}\r\n\r\n"
                )
                await loop.sock_sendall(client, head.encode() + body)

    def _result(self, method: str | None, values: tuple[object, ...]) -> str:
        known = self._methods.get(method or "")
        if known is None:
            fault = xmlrpc.client.Fault(1, f"unknown method {one_line(method or '')}")
            return xmlrpc.client.dumps(fault, methodresponse=True)
        return xmlrpc.client.dumps((known(values),), methodresponse=True)


def _close(client: socket.socket, _: asyncio.Task[None]) -> None:
    client.close()


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
