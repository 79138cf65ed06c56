"""Connection headers of TCPROS, and the channels that they describe.

A header is its length, then fields `key=value`, each after its own length. All lengths are
4 bytes, little-endian. After both headers the publisher sends messages, each after its
length, until one side closes.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Final

from hybridlog.live.sources.text import one_line
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


class WireError(Exception):
    """A malformed connection header; the message names the fault."""


def encode_header(fields: Mapping[str, str]) -> bytes:
    """A connection header with its length."""
    lines = [f"{key}={value}".encode() for key, value in fields.items()]
    body = b"".join(len(line).to_bytes(4, "little") + line for line in lines)
    return len(body).to_bytes(4, "little") + body


def decode_header(body: bytes) -> dict[str, str]:
    """The fields of a connection header, which comes without its length.

    Raises:
        WireError: Lengths are inconsistent, or a field has no `=`.
    """
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
    """The channel that a publisher's header describes, as in a bag.

    Args:
        topic: Name as the master spells it.
        fields: The publisher's header.
    """
    metadata = dict(fields)
    definition = metadata.pop("message_definition", None)
    name = metadata.pop("type", "")
    metadata.pop("topic", None)
    schema = None
    if name and name != ANY:
        encoding = "" if definition is None else "ros1msg"
        schema = Schema(name, encoding, (definition or "").encode())
    return Channel(topic, "ros1", schema, metadata, has_publish_time=False)
