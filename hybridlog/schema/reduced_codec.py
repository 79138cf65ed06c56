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
from functools import partial
from typing import TYPE_CHECKING, NoReturn

import numpy as np
from bson.errors import BSONError

from hybridlog.schema.codec import decode_each
from hybridlog.schema.index_bodies import document_of, index_bodies
from hybridlog.schema.objects import Objects
from hybridlog.schema.states import CAUSES, State
from hybridlog_storage.errors import PayloadError
from hybridlog_storage.messages import ORIGINAL_ENCODING, REDUCED, Channel

if TYPE_CHECKING:
    from collections.abc import Collection

    from numpy.typing import NDArray

    from hybridlog.schema.codec import Codec, Decoded
    from hybridlog.schema.definition import FieldPath
    from hybridlog_storage.messages import Buffer


_HEAD = struct.Struct("<Q32s")
_GIVEN_UP = f"its payload was {CAUSES[State.REDUCED]}; only its fields are stored"


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
    group = next(index_bodies(codec, payload, one, one + len(payload)))
    return head + group.body.tobytes()


def remains_of(payload: Buffer) -> Remains:
    """Size and hash of the dropped payload.

    Raises:
        PayloadError: the payload is not a reduced message.
    """
    if len(payload) < _HEAD.size:
        raise PayloadError("the payload is not a reduced message: it is too short")
    return Remains(*_HEAD.unpack_from(payload))


class ReducedCodec:
    """Codec of reduced messages: their values are those of the index documents.

    Integers are int64, and arrays over the limit are summaries.
    """

    indexed = True
    reason: str | None = None

    def paths(self) -> list[FieldPath]:
        """No fields of its own: the fields are those of complete messages."""
        return []

    def columns(
        self,
        buffer: Buffer,
        offset: NDArray[np.int64],
        length: NDArray[np.int64],
        fields: Collection[str] | None = None,
    ) -> Decoded:
        """Decode the stored fields; see `Codec.columns`."""
        return decode_each(_fields_in, partial(Objects, fields=fields), buffer, offset, length)

    def decode(self, payload: Buffer) -> NoReturn:
        """Raise, since the payload cannot be decoded.

        Raises:
            PayloadError: always.
        """
        remains = remains_of(payload)
        raise PayloadError(f"{_GIVEN_UP} ({remains.size} bytes, SHA-256 {remains.sha256.hex()})")


def _fields_in(payload: memoryview) -> dict[str, object]:
    try:
        remains_of(payload)
        return document_of(bytes(payload[_HEAD.size :]))
    except (BSONError, PayloadError) as error:
        raise PayloadError(f"the payload is not a reduced message: {error}") from error
