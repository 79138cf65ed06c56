"""What the messages of the Foxglove WebSocket protocol mean, without any socket."""

from __future__ import annotations

import base64
import binascii
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Protocol, TypeGuard
from urllib.parse import urlsplit

from hybridlog.live.sources.text import one_line
from hybridlog_storage.errors import UsageError
from hybridlog_storage.messages import Channel, Schema

SUBPROTOCOLS: Final = ("foxglove.sdk.v1", "foxglove.websocket.v1")
"""What we speak, the one we like best first."""

MESSAGE_DATA: Final = 1
"""First byte of a binary message that carries a payload."""

MAX_TEXT: Final = 128 << 20
"""Largest JSON message, in bytes; a thousand channels with their definitions take 20 MB."""

_SCHEMA_ENCODINGS = {
    "ros1": "ros1msg",
    "cdr": "ros2msg",
    "json": "jsonschema",
    "protobuf": "protobuf",
    "flatbuffer": "flatbuffer",
}
_BASE64 = frozenset({"protobuf", "flatbuffer"})
_MAX_ID = 1 << 64
_LONGEST = 200  # characters of an address that are shown
_PORTS = {"ws": 80, "wss": 443}


class Receiver(Protocol):
    """What a connection speaks to, on the thread that reads it."""

    def data(self, subscription: int, log_time: int, payload: bytes) -> None:
        """A message, with the server's log time in ns since the epoch."""
        ...

    def text(self, data: bytes) -> None:
        """A JSON message."""
        ...

    def broken(self, reason: str) -> None:
        """A binary message that cannot be what it says."""
        ...

    def too_large(self, subscription: int, size: int) -> None:
        """A message over the limit, in bytes; it is passed over."""
        ...

    def cut(self, subscription: int) -> None:
        """The connection broke in the middle of a message."""
        ...

    def look(self) -> None:
        """Something came, or nothing did for a moment: time for what was put off."""
        ...


class PeerError(Exception):
    """A server that cannot be reached, or does what none may do; the message is for people."""


@dataclass(frozen=True, slots=True)
class Address:
    """Where a server is.

    Attributes:
        url: As the user gave it, a password included: not to be shown.
        shown: Without user and password.
        host: Name or number.
        port: TCP port.
        is_secure: TLS is wanted.
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
        id: The server's number of it.
        channel: As a log would have it.
        type_name: Name of its type, empty when the server gives none.
        problem: What is wrong with its definition, empty when nothing is.
    """

    id: int
    channel: Channel
    type_name: str
    problem: str = ""


def parse_address(url: str) -> Address:
    """Parses the address of a server.

    Raises:
        UsageError: It is none.
    """
    cure = "give an address like ws://robot:8765"
    shown = without_user(url)
    if not url.isprintable() or " " in url:
        raise UsageError(f"{shown}: no address of a Foxglove server; {cure}")
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
    except ValueError as error:
        raise UsageError(f"{shown}: no address of a Foxglove server ({error}); {cure}") from error
    if parts.scheme not in _PORTS:
        raise UsageError(f"{shown}: does not begin with ws:// or wss://; {cure}")
    if not host:
        raise UsageError(f"{shown}: names no host; {cure}")
    if parts.fragment:
        raise UsageError(f"{shown}: an address of a server has no part behind '#'; {cure}")
    if port == 0:
        raise UsageError(f"{shown}: nobody can listen on port 0; {cure}")
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
    """An address as it may be shown: no password, nothing that a terminal acts on."""
    return one_line(re.sub(r"//[^/]*@", "//", url), _LONGEST)


def parse_text(data: bytes) -> Mapping[str, object]:
    """Parses a JSON message.

    Raises:
        PeerError: It is none.
    """
    try:
        message = json.loads(data.decode())
    except (ValueError, RecursionError) as error:
        raise PeerError(f"sent a message that is no JSON ({error}); it is left out") from error
    if not isinstance(message, dict) or not isinstance(message.get("op"), str):
        raise PeerError("sent a JSON message without an operation ('op'); it is left out")
    return message


def subscribe(wanted: Mapping[int, int]) -> str:
    """The request for messages.

    Args:
        wanted: Our number of each subscription, and the server's number of its channel.
    """
    subscriptions = [{"id": number, "channelId": channel} for number, channel in wanted.items()]
    return json.dumps({"op": "subscribe", "subscriptions": subscriptions})


def unsubscribe(number: int) -> str:
    """The request for no more messages of a subscription."""
    return json.dumps({"op": "unsubscribe", "subscriptionIds": [number]})


def parse_channel(entry: object) -> Advertised:
    """Makes a channel of what a server advertises.

    A definition that cannot be read leaves a channel without one: its messages are as
    good as ever, only their fields cannot be told apart.

    Raises:
        PeerError: There is no id, topic or encoding to work with.
    """
    if not isinstance(entry, dict):
        raise PeerError("advertised a channel that is no JSON object; it is left out")
    number = entry.get("id")
    if type(number) is not int or not 0 <= number < _MAX_ID:
        raise PeerError("advertised a channel without a number ('id'); it is left out")
    topic, encoding = entry.get("topic"), entry.get("encoding")
    if not _is_text(topic) or not topic:
        raise PeerError(f"advertised channel {number} without a topic; it is left out")
    if not _is_text(encoding):
        raise PeerError(f"advertised {topic!r} without an encoding; it is left out")
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
    """The definition of a channel, and what is wrong with it."""
    text, kind = entry.get("schema"), entry.get("schemaEncoding")
    if not kind:
        kind = _SCHEMA_ENCODINGS.get(encoding, encoding)
    if not text:
        return (Schema(name, "", b"") if name else None), ""
    if not _is_text(text) or not _is_text(kind):
        return Schema(name, "", b""), "is no text"
    if kind not in _BASE64:
        return Schema(name, kind, text.encode()), ""
    try:
        return Schema(name, kind, base64.b64decode(text, validate=True)), ""
    except (binascii.Error, ValueError) as error:
        return Schema(name, "", b""), f"is no base64 ({error})"


def _is_text(value: object) -> TypeGuard[str]:
    """Whether a value is text that UTF-8 can hold; JSON also has halves of characters."""
    if not isinstance(value, str):
        return False
    try:
        value.encode()
    except UnicodeEncodeError:
        return False
    return True
