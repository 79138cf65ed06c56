"""Reduced messages, without payload: size, hash, and the indexed fields.

Under pressure a recorder stores only the small parts of a large message. A reduced message
is stored in the segment like any message, on a separate channel with the encoding
`REDUCED`. The index can therefore be rebuilt from it, too.

Its payload begins with 40 bytes: the size (u64, little-endian) and the SHA-256 of the
dropped payload. The BSON elements of the index document without `_meta` follow.
"""

from __future__ import annotations

import hashlib
import struct
from typing import TYPE_CHECKING, NoReturn

import numpy as np
from bson.errors import BSONError

from hybridlog.schema.codec import ObjectCodec
from hybridlog.schema.index_bodies import document_of, index_bodies
from hybridlog.schema.left import missing_payload
from hybridlog.schema.states import State
from hybridlog_storage.errors import PayloadError
from hybridlog_storage.messages import ORIGINAL_ENCODING, REDUCED, Channel

if TYPE_CHECKING:
    from hybridlog.schema.codec import Codec
    from hybridlog_storage.messages import Buffer


_HEAD = struct.Struct("<Q32s")


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
    """Reduce a message. An unreadable payload is reduced to size and hash."""
    head = _HEAD.pack(len(payload), hashlib.sha256(payload).digest())
    one = np.zeros(1, np.int64)
    group = next(index_bodies(codec, payload, one, one + len(payload)))
    return head + group.body.tobytes()


class ReducedCodec(ObjectCodec):
    """Codec of reduced messages: their values are those of the index documents.

    Integers are int64, and arrays over the limit are summaries.
    """

    def read(self, payload: memoryview) -> dict[str, object]:
        """The stored fields.

        Raises:
            PayloadError: The payload is not a reduced message.
        """
        try:
            if len(payload) < _HEAD.size:
                raise PayloadError("it is too short")
            return document_of(bytes(payload[_HEAD.size :]))
        except (BSONError, PayloadError) as error:
            raise PayloadError(f"the payload is not a reduced message: {error}") from error

    def decode(self, payload: Buffer) -> NoReturn:
        """Raise, since the payload cannot be decoded.

        Raises:
            PayloadError: always.
        """
        if len(payload) < _HEAD.size:
            raise PayloadError("the payload is not a reduced message: it is too short")
        raise missing_payload(State.REDUCED, *_HEAD.unpack_from(payload))
