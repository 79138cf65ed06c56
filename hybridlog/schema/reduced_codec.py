"""Reduced messages, without payload: size, hash, and the indexed fields.

Under pressure a recorder stores only the small parts of a large message. A reduced message
is stored in the segment like any message, on a separate channel with the encoding
`REDUCED`. Readers make a row of it, as of messages whose payloads were deleted later.

Its payload begins with 40 bytes: the size (u64, little-endian) and the SHA-256 of the
dropped payload. The BSON elements of the index document without `_meta` follow.
"""

from __future__ import annotations

import hashlib
import struct
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from bson.errors import BSONError

from hybridlog.schema.codec import no_rows
from hybridlog.schema.index_bodies import document_of, index_bodies
from hybridlog.schema.left import LeftCodec
from hybridlog.schema.states import State
from hybridlog_storage.errors import PayloadError
from hybridlog_storage.messages import ORIGINAL_ENCODING, REDUCED, Channel, Left

if TYPE_CHECKING:
    from collections.abc import Collection

    from hybridlog.columns.left_rows import LeftRows
    from hybridlog.schema.codec import Codec, Decoded
    from hybridlog_storage.messages import Batch


_HEAD = struct.Struct("<Q32s")
_TOO_SHORT = "the payload is not a reduced message: it is too short"


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


class ReducedCodec(LeftCodec):
    """Codec of reduced messages: they have the fields of rows.

    Args:
        original: The codec of the payloads.
    """

    def __init__(self, original: Codec) -> None:
        super().__init__(original, State.REDUCED)

    def rows(self, batch: Batch) -> LeftRows:
        """Rows of reduced messages."""
        from hybridlog.columns.left_rows import rows_of_documents

        none = no_rows()
        empty = self.original.columns(b"", none, none) if self.indexed else None
        return rows_of_documents(empty, [parsed(batch.payload(n)) for n in range(len(batch))])

    def columns_of(self, batch: Batch, fields: Collection[str] | None = None) -> Decoded:
        """The fields that are left; see `Codec.columns`."""
        count = len(batch)
        if count and self.indexed and (batch.left is None or batch.left.part[0] < 0):
            places = np.zeros(count, np.int32), np.arange(count), *batch.places
            batch = replace(batch, left=Left([self.rows(batch)], *places))
        return super().columns_of(batch, fields)


def size_and_digest(payload: memoryview) -> tuple[int, bytes]:
    """Size and hash of the dropped payload, by the reduced message.

    Raises:
        PayloadError: It is none.
    """
    if len(payload) < _HEAD.size:
        raise PayloadError("the payload is not a reduced message: it is too short")
    size, digest = _HEAD.unpack_from(payload)
    return size, digest


def parsed(payload: memoryview) -> tuple[int, bytes, dict[str, object] | str]:
    """Size and hash of the dropped payload; its document, or what is wrong with it."""
    about = 0, b""
    try:
        about = size_and_digest(payload)
        return *about, document_of(bytes(payload[_HEAD.size :]))
    except PayloadError as error:
        return *about, str(error)
    except BSONError as error:
        return *about, f"the payload is not a reduced message: {error}"
