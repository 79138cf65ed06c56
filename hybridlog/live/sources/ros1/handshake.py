"""Connects to a publisher of a topic: XML-RPC request, TCP connection, header exchange."""

from __future__ import annotations

import asyncio
import socket
from typing import Final

from hybridlog.live.sources.ros1.network import (
    PATIENCE_S,
    Endpoint,
    Network,
    PeerError,
    UnreachedError,
    reason_of,
)
from hybridlog.live.sources.ros1.rpc import call
from hybridlog.live.sources.ros1.wire import (
    ANY,
    MAX_HEADER,
    WireError,
    decode_header,
    encode_header,
    u32,
)
from hybridlog.live.sources.text import one_line

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

    Args:
        network: Makes connections.
        caller: Our node's name.
        topic: Name as the master spells it.
        uri: The publisher's address for calls.

    Returns:
        The socket, positioned at the first message, and the fields of the publisher's
        header.

    Raises:
        UnreachedError: The publisher cannot be reached.
        PeerError: It refuses, or violates the protocol.
        OSError: It closes the connection.
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
    if isinstance(protocol, list) and len(protocol) >= 3:
        name, host, port = protocol[:3]
        if (
            name == "TCPROS"
            and isinstance(host, str)
            and host
            and isinstance(port, int)
            and 0 < port < 65536
        ):
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
