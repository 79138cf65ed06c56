"""Messages of the Foxglove WebSocket protocol: parsing and encoding."""

from __future__ import annotations

import base64
import binascii
import re
from collections.abc import Mapping
from typing import Final, NamedTuple, TypeGuard
from urllib.parse import unquote, urlsplit

from hybridlog.live.sources.base import PeerError, one_line
from hybridlog_storage.errors import UsageError
from hybridlog_storage.messages import Channel, Schema

SUBPROTOCOLS: Final = ("foxglove.sdk.v1", "foxglove.websocket.v1")
"""Protocol versions that the client speaks, the preferred one first."""

MESSAGE_DATA: Final = 1
"""First byte of a binary message with a payload."""

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
_REMEDY = "give an address like ws://robot:8765"
_PORTS = {"ws": 80, "wss": 443}


class Address(NamedTuple):
    """Address of a server; only `headers`, those of the handshake, hold the password."""

    url: str
    shown: str
    host: str
    port: int
    headers: dict[str, str]


class Offer(NamedTuple):
    """A channel that a server offers, and the problem with its definition, if any."""

    id: int
    channel: Channel
    problem: str = ""

    @property
    def type_name(self) -> str:
        """Name of its type, empty if unknown."""
        return self.channel.schema.name if self.channel.schema is not None else ""


def parse_address(url: str) -> Address:
    """Parse the address of a server."""
    shown = without_user(url)
    try:
        parts = urlsplit(url)
        host, port = parts.hostname or "", parts.port
        host = host if host.isascii() else host.encode("idna").decode()
        user = unquote(f"{parts.username}:{parts.password}", errors="strict").encode()
        if not url.isprintable() or " " in url:
            raise ValueError("it has spaces or control characters")
    except ValueError as error:
        reason = f"not the address of a Foxglove server ({one_line(str(error))})"
        raise UsageError(f"{shown}: {reason}; {_REMEDY}") from error
    for is_wrong, reason in (
        (parts.scheme not in _PORTS, "does not begin with ws:// or wss://"),
        (not host, "names no host"),
        (parts.fragment, "an address has no part after '#'"),
        (port == 0, "port 0 is invalid"),
    ):
        if is_wrong:
            raise UsageError(f"{shown}: {reason}; {_REMEDY}")
    if parts.username is not None and parts.password is None:
        raise UsageError(
            f"{shown}: a user without a password; give both "
            "(wss://user:password@robot:8765) or none"
        )
    headers = {"Sec-WebSocket-Protocol": ", ".join(SUBPROTOCOLS)}
    if parts.username is not None:
        headers["Authorization"] = f"Basic {base64.b64encode(user).decode()}"
    place = (f"[{host}]" if ":" in host else host) + (f":{port}" if port else "")
    url = parts._replace(netloc=place).geturl()
    return Address(url, shown, host, port or _PORTS[parts.scheme], headers)


def without_user(url: str) -> str:
    """An address to show: without password and control characters."""
    return one_line(re.sub(r"//[^/]*@", "//", url), _MAX_SHOWN)


def parse_channel(entry: object) -> Offer:
    """Parse an advertised channel.

    A channel with an unreadable definition has none: its messages are recorded, but their
    fields cannot be searched.
    """
    entry = entry if isinstance(entry, dict) else {}
    number, topic, encoding = (entry.get(key) for key in ("id", "topic", "encoding"))
    if (
        type(number) is not int
        or not 0 <= number < _MAX_ID
        or not topic
        or not (_is_text(topic) and _is_text(encoding))
    ):
        raise PeerError(
            "advertised a channel without number ('id'), topic or encoding; it is ignored"
        )
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
    return Offer(number, channel, problem)


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
    return isinstance(value, str) and value.encode(errors="ignore").decode() == value
