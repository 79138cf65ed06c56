"""Reduced messages, whose payload was dropped: size, hash, and the indexed fields.

Under pressure a recorder stores only the small parts of a large message. A reduced message
is stored in the segment like any message, on a separate channel with the encoding
`REDUCED`. The index can therefore be rebuilt from it, too.

Its payload begins with 40 bytes: the size (u64, little-endian) and the SHA-256 of the
dropped payload. The BSON elements of the index document without `_meta` follow.
"""

from __future__ import annotations

import hashlib
import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING

import bson
import numpy as np
from bson.errors import BSONError

from hybridlog.schema.object_rows import arrow_of, body_groups, objects_of, payloads_of
from hybridlog_storage.errors import PayloadError
from hybridlog_storage.messages import ORIGINAL_ENCODING, REDUCED, Channel

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

    from numpy.typing import NDArray

    from hybridlog.schema.codec import BodyGroup, Codec, DecodedArrow, DecodedObjects
    from hybridlog.schema.definition import FieldPath
    from hybridlog_storage.messages import Buffer


_HEAD = struct.Struct("<Q32s")
_GIVEN_UP = "its payload was dropped under pressure; only its fields are stored"


@dataclass(frozen=True, slots=True)
class Remains:
    """Size and hash of a dropped payload.

    Attributes:
        size: Bytes.
        sha256: Hash.
    """

    size: int
    sha256: bytes


def reduced_channel(channel: Channel) -> Channel:
    """The channel of a channel's reduced messages."""
    return Channel(
        channel.topic,
        REDUCED,
        channel.schema,
        {**channel.metadata, ORIGINAL_ENCODING: channel.message_encoding},
        channel.has_publish_time,
    )


def reduce(codec: Codec, payload: bytes) -> bytes:
    """Reduce a message. An unreadable payload is reduced to size and hash.

    Args:
        codec: The codec of its channel.
        payload: The serialized message.
    """
    head = _HEAD.pack(len(payload), hashlib.sha256(payload).digest())
    one = np.zeros(1, np.int64)
    for group in codec.bodies(payload, one, one + len(payload)):
        if group.error is None:
            return head + bytes(group.body[0])
    return head


def remains_of(payload: Buffer) -> Remains:
    """Size and hash of the dropped payload.

    Raises:
        PayloadError: the payload is not a reduced message.
    """
    if len(payload) < _HEAD.size:
        raise PayloadError("the payload is not a reduced message: it is too short")
    return Remains(*_HEAD.unpack_from(payload))


class ReducedCodec:
    """Codec of reduced messages."""

    indexed = True
    reason: str | None = None

    def paths(self) -> list[FieldPath]:
        """No fields of its own: the fields are those of complete messages."""
        return []

    def bodies(
        self, buffer: Buffer, offset: NDArray[np.int64], length: NDArray[np.int64]
    ) -> Iterator[BodyGroup]:
        """Index bodies; see `Codec.bodies`."""
        return body_groups(map(_body, payloads_of(buffer, offset, length)))

    def fields(self, payload: Buffer) -> dict[str, object]:
        """The fields of this message in its index document."""
        body = _body(memoryview(payload))
        return {} if isinstance(body, PayloadError) else _document(body)

    def plain(self, payload: Buffer, names: Collection[str] | None = None) -> dict[str, object]:
        """The stored fields; long arrays are summaries."""
        return self.fields(payload)

    def decode(self, payload: Buffer) -> object:
        """Raise, since the payload cannot be decoded.

        Raises:
            PayloadError: always.
        """
        remains = remains_of(payload)
        raise PayloadError(f"{_GIVEN_UP} ({remains.size} bytes, SHA-256 {remains.sha256.hex()})")

    def arrow(
        self,
        buffer: Buffer,
        offset: NDArray[np.int64],
        length: NDArray[np.int64],
        fields: Collection[str] | None,
    ) -> DecodedArrow:
        """The values of the index documents, as Arrow arrays; see `Codec.arrow`.

        Integers are int64, and arrays over the limit are summaries.
        """
        from hybridlog.schema.arrow_objects import objects_array

        return arrow_of(_fields, objects_array, payloads_of(buffer, offset, length), fields)

    def objects(
        self, buffer: Buffer, offset: NDArray[np.int64], length: NDArray[np.int64]
    ) -> DecodedObjects | None:
        """The values of the index documents."""
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
        # The elements go into the index unchanged, so they must be valid.
        _document(body)
    except (BSONError, PayloadError) as error:
        return PayloadError(f"the payload is not a reduced message: {error}")
    return body
