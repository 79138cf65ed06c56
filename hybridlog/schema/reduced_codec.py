"""Messages whose payload was given up: size, hash, and the fields as the index has them.

When more comes than a disk takes, a recorder keeps of a large message what is small. It
lies in the segment like any message, on a channel of its own whose encoding is `REDUCED`,
so that a dropped index is made again from it, too.

The payload of a reduced message is a head of 40 bytes, the size of what was given up
(u64, little-endian) and its SHA-256, and then the BSON elements of the index document
without `_meta`.
"""

from __future__ import annotations

import hashlib
import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING

import bson
import numpy as np
from bson.errors import BSONError

from hybridlog.schema.codec import codec_for, nothing_decoded
from hybridlog.schema.object_rows import arrow_of, body_groups, objects_of, payloads_of
from hybridlog.schema.wire import Decoded, Unreadable
from hybridlog_storage.errors import PayloadError
from hybridlog_storage.messages import REDUCED, Channel

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

    from numpy.typing import NDArray

    from hybridlog.schema.codec import BodyGroup, DecodedArrow, DecodedObjects
    from hybridlog.schema.definition import FieldPath
    from hybridlog_storage.messages import Buffer

ORIGINAL_ENCODING = "hybridlog.message_encoding"
"""Channel metadata of a reduced channel: the encoding of what was given up."""

_HEAD = struct.Struct("<Q32s")
_GIVEN_UP = "its payload was given up under pressure; only its fields were kept"


@dataclass(frozen=True, slots=True)
class Remains:
    """What is known of a payload that was given up.

    Attributes:
        size: Bytes.
        sha256: Hash.
    """

    size: int
    sha256: bytes


def reduced_channel(channel: Channel) -> Channel:
    """The channel that carries what is left of a channel's messages."""
    return Channel(
        channel.topic,
        REDUCED,
        channel.schema,
        {**channel.metadata, ORIGINAL_ENCODING: channel.message_encoding},
        channel.has_publish_time,
    )


def reduce(channel: Channel, payload: bytes) -> bytes:
    """What is left of a message. A payload that cannot be read leaves size and hash.

    Args:
        channel: Its own channel.
        payload: The serialized message.
    """
    head = _HEAD.pack(len(payload), hashlib.sha256(payload).digest())
    one = np.zeros(1, np.int64)
    for group in codec_for(channel).bodies(payload, one, one + len(payload)):
        if group.error is None:
            return head + bytes(group.body[0])
    return head


def remains_of(payload: Buffer) -> Remains:
    """Size and hash of what was given up.

    Raises:
        PayloadError: It is no reduced message.
    """
    if len(payload) < _HEAD.size:
        raise PayloadError("the payload is no reduced message: it is too short")
    return Remains(*_HEAD.unpack_from(payload))


class ReducedCodec:
    """Reads what is left of messages."""

    indexed = True
    reason: str | None = None

    def paths(self) -> list[FieldPath]:
        """None of its own: those of the whole messages count."""
        return []

    def bodies(
        self, buffer: Buffer, offset: NDArray[np.int64], length: NDArray[np.int64]
    ) -> Iterator[BodyGroup]:
        """Index bodies; see `Codec.bodies`."""
        return body_groups(map(_body, payloads_of(buffer, offset, length)))

    def fields(self, payload: Buffer) -> dict[str, object]:
        """What the index document holds of this message."""
        body = _body(memoryview(payload))
        return {} if isinstance(body, PayloadError) else _document(body)

    def decode(self, payload: Buffer) -> object:
        """Refuses.

        Raises:
            PayloadError: Always.
        """
        remains = remains_of(payload)
        raise PayloadError(f"{_GIVEN_UP} ({remains.size} bytes, SHA-256 {remains.sha256.hex()})")

    def columns(
        self,
        buffer: Buffer,
        offset: NDArray[np.int64],
        length: NDArray[np.int64],
        fields: Collection[str] | None,
    ) -> Decoded:
        """No row can be read."""
        rows = np.arange(len(offset))
        return nothing_decoded([Unreadable(rows, _GIVEN_UP)] if len(rows) else [])

    def arrow(
        self,
        buffer: Buffer,
        offset: NDArray[np.int64],
        length: NDArray[np.int64],
        fields: Collection[str] | None,
    ) -> DecodedArrow:
        """What the index documents hold, as Arrow arrays; see `Codec.arrow`.

        Integers are int64, and arrays over the limit are summaries.
        """
        from hybridlog.schema.arrow_objects import objects_array

        return arrow_of(_fields, objects_array, payloads_of(buffer, offset, length), fields)

    def objects(
        self, buffer: Buffer, offset: NDArray[np.int64], length: NDArray[np.int64]
    ) -> DecodedObjects | None:
        """What the index documents hold."""
        return objects_of(_fields, payloads_of(buffer, offset, length))


def _fields(payload: memoryview) -> dict[str, object]:
    body = _body(payload)
    if isinstance(body, PayloadError):
        raise body
    return _document(body)


def _document(body: bytes) -> dict[str, object]:
    return bson.decode(struct.pack("<i", len(body) + 5) + body + b"\0")


def _body(payload: memoryview) -> bytes | PayloadError:
    try:
        remains_of(payload)
        body = bytes(payload[_HEAD.size :])
        # The elements go into the index as they are, so they must be what they claim.
        _document(body)
    except (BSONError, PayloadError) as error:
        return PayloadError(f"the payload is no reduced message: {error}")
    return body
