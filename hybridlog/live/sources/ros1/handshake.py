"""Connects to a publisher of a topic: XML-RPC request, TCP connection, header exchange.

A connection header of TCPROS is its length, then fields `key=value`, each after its own length.
All lengths are 4 bytes, little-endian. After both headers the publisher sends messages, each
after its length, until one side closes.
"""

from __future__ import annotations

import asyncio
import socket
import struct
from typing import TYPE_CHECKING, Annotated, Final, Literal

import msgspec

from hybridlog.live.sources.base import PeerError, one_line
from hybridlog.live.sources.network import PATIENCE_S, Endpoint, Network, UnreachedError, reason_of
from hybridlog.live.sources.ros1.rpc import call
from hybridlog_storage.messages import Channel, Schema

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping


MAX_HEADER: Final = 4 << 20
"""Longest connection header, bytes; a definition of 100 kB is a long one."""

ANY: Final = "*"
"""Wildcard of subscribers, and of relays that do not know their type yet."""

u32: Final[Callable[..., tuple[int]]] = struct.Struct("<I").unpack_from
"""Reads the number at an offset of a buffer, as a tuple."""

_MAX_FIELDS = 1000
_Protocol = tuple[
    Literal["TCPROS"],
    Annotated[str, msgspec.Meta(min_length=1)],
    Annotated[int, msgspec.Meta(ge=1, lt=65536)],
]


class WireError(Exception):
    """A malformed connection header; the message names the fault."""


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
        if pos + 4 > len(body):
            raise WireError(f"its header has {len(body) - pos} surplus bytes")
        end = pos + 4 + u32(body, pos)[0]
        if end > len(body):
            raise WireError(f"a field of its header exceeds it by {end - len(body)} bytes")
        key, equals, value = body[pos + 4 : end].partition(b"=")
        if not equals:
            raise WireError(f"a field of its header has no '=': {one_line(key)}")
        if len(fields) == _MAX_FIELDS:
            raise WireError(f"its header has more than {_MAX_FIELDS} fields")
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


async def subscribe(
    network: Network, caller: str, topic: str, uri: str
) -> tuple[socket.socket, dict[str, str]]:
    """Connects to a publisher of a topic, whatever its type.

    Returns the socket, positioned at the first message, and the fields of the publisher's header.
    """
    protocol = await call(network, uri, "requestTopic", caller, topic, [["TCPROS"]])
    place = _place_of(protocol)
    try:
        connected = await network.connect(place)
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
    try:
        _, host, port = msgspec.convert(protocol, _Protocol)
    except msgspec.ValidationError as error:
        raise PeerError("it does not offer the topic over TCPROS") from error
    return Endpoint(host, port)


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
    try:
        fields = decode_header(await _exactly(connected, length))
    except WireError as error:
        raise PeerError(str(error)) from error
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
