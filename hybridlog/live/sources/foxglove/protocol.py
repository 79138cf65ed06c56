"""Messages of the Foxglove WebSocket protocol: parsing and encoding."""

from __future__ import annotations

import base64
import binascii
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Protocol, TypeGuard
from urllib.parse import urlsplit

from hybridlog.live.sources.base import one_line
from hybridlog_storage.errors import UsageError
from hybridlog_storage.messages import Channel, Schema

SUBPROTOCOLS: Final = ("foxglove.sdk.v1", "foxglove.websocket.v1")
"""Protocol versions that the client speaks, the preferred one first."""

MESSAGE_DATA: Final = 1
"""First byte of a binary message with a payload."""

TIME: Final = 2
"""First byte of a binary message with the server's time."""

MAX_TEXT: Final = 128 << 20
"""Largest JSON message, bytes; a thousand channels with their definitions take 20 MB."""

_SCHEMA_ENCODINGS = {
    "ros1": "ros1msg",
    "cdr": "ros2msg",
    "json": "jsonschema",
    "protobuf": "protobuf",
    "flatbuffer": "flatbuffer",
}
_BASE64 = frozenset({"protobuf", "flatbuffer"})
_MAX_ID = 1 << 64
_MAX_SHOWN = 200  # characters of an address that are shown
_PORTS = {"ws": 80, "wss": 443}


class Receiver(Protocol):
    """Receiver of a connection's messages, called by the thread that reads it."""

    def data(self, subscription: int, log_time: int, payload: bytes) -> None:
        """Take a message, with the server's log time in ns since the epoch."""
        ...

    def time(self, now: int) -> None:
        """Take the time of the server, ns."""
        ...

    def text(self, data: bytes) -> None:
        """Take a JSON message."""
        ...

    def broken(self, reason: str) -> None:
        """Note a malformed binary message."""
        ...

    def too_large(self, subscription: int, size: int) -> None:
        """Note a skipped message that is larger than the limit, bytes."""
        ...

    def cut(self, subscription: int) -> None:
        """Note that the connection broke in the middle of a message."""
        ...

    def look(self) -> None:
        """Do postponed work; called after reads and in pauses."""
        ...


class PeerError(Exception):
    """The server is unreachable or violates the protocol; the message is for the user."""


@dataclass(frozen=True, slots=True)
class Address:
    """Address of a server.

    Attributes:
        url: As the user gave it, with a password: not to be shown.
        shown: The URL without user and password.
        host: Host name or IP address.
        port: TCP port.
        is_secure: Use TLS.
    """

    url: str
    shown: str
    host: str
    port: int
    is_secure: bool


@dataclass(frozen=True, slots=True)
class Advertised:
    """A channel that a server offers.

    Attributes:
        id: The server's number of the channel.
        channel: The channel, as in a log.
        type_name: Name of its type, empty if unknown.
        problem: Problem with its definition, or an empty string.
    """

    id: int
    channel: Channel
    type_name: str
    problem: str = ""


def parse_address(url: str) -> Address:
    """Parse the address of a server.

    Raises:
        UsageError: The address is invalid.
    """
    remedy = "give an address like ws://robot:8765"
    shown = without_user(url)
    if not url.isprintable() or " " in url:
        raise UsageError(f"{shown}: not the address of a Foxglove server; {remedy}")
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
    except ValueError as error:
        raise UsageError(
            f"{shown}: not the address of a Foxglove server ({error}); {remedy}"
        ) from error
    if parts.scheme not in _PORTS:
        raise UsageError(f"{shown}: does not begin with ws:// or wss://; {remedy}")
    if not host:
        raise UsageError(f"{shown}: names no host; {remedy}")
    if parts.fragment:
        raise UsageError(f"{shown}: an address has no part after '#'; {remedy}")
    if port == 0:
        raise UsageError(f"{shown}: port 0 is invalid; {remedy}")
    if parts.username is not None and parts.password is None:
        raise UsageError(
            f"{shown}: a user without a password; give both "
            "(wss://user:password@robot:8765) or none"
        )
    return Address(
        url=url,
        shown=shown,
        host=host,
        port=port or _PORTS[parts.scheme],
        is_secure=parts.scheme == "wss",
    )


def without_user(url: str) -> str:
    """An address to show: without password and control characters."""
    return one_line(re.sub(r"//[^/]*@", "//", url), _MAX_SHOWN)


def parse_text(data: bytes) -> Mapping[str, object]:
    """Parse a JSON message.

    Raises:
        PeerError: The message is malformed.
    """
    try:
        message = json.loads(data.decode())
    except (ValueError, RecursionError) as error:
        raise PeerError(f"sent a message that is not JSON ({error}); it is ignored") from error
    if not isinstance(message, dict) or not isinstance(message.get("op"), str):
        raise PeerError("sent a JSON message without an operation ('op'); it is ignored")
    return message


def subscribe(wanted: Mapping[int, int]) -> str:
    """The request to subscribe to channels.

    Args:
        wanted: Number of each new subscription, and the server's number of its channel.
    """
    subscriptions = [{"id": number, "channelId": channel} for number, channel in wanted.items()]
    return json.dumps({"op": "subscribe", "subscriptions": subscriptions})


def unsubscribe(number: int) -> str:
    """The request to end a subscription."""
    return json.dumps({"op": "unsubscribe", "subscriptionIds": [number]})


def parse_channel(entry: object) -> Advertised:
    """Parse an advertised channel.

    A channel with an unreadable definition has none: its messages are recorded, but their
    fields cannot be searched.

    Raises:
        PeerError: Id, topic or encoding are missing.
    """
    if not isinstance(entry, dict):
        raise PeerError("advertised a channel that is not a JSON object; it is ignored")
    number = entry.get("id")
    if type(number) is not int or not 0 <= number < _MAX_ID:
        raise PeerError("advertised a channel without a number ('id'); it is ignored")
    topic, encoding = entry.get("topic"), entry.get("encoding")
    if not _is_text(topic) or not topic:
        raise PeerError(f"advertised channel {number} without a topic; it is ignored")
    if not _is_text(encoding):
        raise PeerError(f"advertised {topic!r} without an encoding; it is ignored")
    name = entry.get("schemaName")
    schema, problem = _parse_schema(entry, name if _is_text(name) else "", encoding)
    metadata = entry.get("metadata")
    channel = Channel(
        topic=topic,
        message_encoding=encoding,
        schema=schema,
        metadata={
            key: value
            for key, value in (metadata.items() if isinstance(metadata, dict) else ())
            if _is_text(key) and _is_text(value)
        },
    )
    return Advertised(number, channel, schema.name if schema is not None else "", problem)


def _parse_schema(
    entry: Mapping[str, object], name: str, encoding: str
) -> tuple[Schema | None, str]:
    """The definition of a channel, and its problem if any."""
    text, kind = entry.get("schema"), entry.get("schemaEncoding")
    if not kind:
        kind = _SCHEMA_ENCODINGS.get(encoding, encoding)
    if not text:
        return (Schema(name, "", b"") if name else None), ""
    if not _is_text(text) or not _is_text(kind):
        return Schema(name, "", b""), "is not text"
    if kind not in _BASE64:
        return Schema(name, kind, text.encode()), ""
    try:
        return Schema(name, kind, base64.b64decode(text, validate=True)), ""
    except (binascii.Error, ValueError) as error:
        return Schema(name, "", b""), f"is not base64 ({error})"


def _is_text(value: object) -> TypeGuard[str]:
    """Tells whether a value is text that UTF-8 can encode; JSON may have lone surrogates."""
    if not isinstance(value, str):
        return False
    try:
        value.encode()
    except UnicodeEncodeError:
        return False
    return True
