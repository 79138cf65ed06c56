"""Reduced and expired messages, without payload: size, hash, and the indexed fields.

Under pressure a recorder stores only the small parts of a large message. A reduced message
is stored in the segment like any message, on a separate channel with the encoding
`REDUCED`. The index can therefore be rebuilt from it, too.

Its payload begins with 40 bytes: the size (u64, little-endian) and the SHA-256 of the
dropped payload. The BSON elements of the index document without `_meta` follow.

Of an expired message, whose payload was deleted to make room, a byte and the same elements
follow, or the reason why its payload could not be read. Files of rows hold this.
"""

from __future__ import annotations

import hashlib
import struct
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
from bson.errors import BSONError

from hybridlog.schema.codec import decode_each
from hybridlog.schema.column import Records
from hybridlog.schema.index_bodies import ARRAY_LIMIT, decoded_bodies, document_of, index_bodies
from hybridlog.schema.objects import Objects
from hybridlog.schema.states import CAUSES, State
from hybridlog_storage.errors import PayloadError
from hybridlog_storage.messages import ORIGINAL_ENCODING, REDUCED, Channel

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

    import pyarrow as pa
    from numpy.typing import NDArray

    from hybridlog.schema.codec import Codec, Decoded
    from hybridlog.schema.definition import FieldPath
    from hybridlog_storage.messages import Batch, Buffer


_HEAD = struct.Struct("<Q32s")
_SURPLUS, _UNREADABLE, _LOSSY = 1, 2, 4  # flags in the byte behind the head of an expired message


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
    """Reduce a message. An unreadable payload is reduced to size and hash."""
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
    state = State.REDUCED

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
        raise PayloadError(
            f"its payload was {CAUSES[self.state]}; only its fields are stored "
            f"({remains.size} bytes, SHA-256 {remains.sha256.hex()})"
        )


def _fields_in(payload: memoryview, head: int = _HEAD.size) -> dict[str, object]:
    try:
        remains_of(payload)
        return document_of(bytes(payload[head:]))
    except (BSONError, PayloadError) as error:
        raise PayloadError(f"the payload is not a reduced message: {error}") from error


def expired_payloads(batch: Batch, decoded: Decoded | None) -> list[bytes]:
    """The remains of messages whose payloads are deleted.

    Args:
        batch: The messages.
        decoded: Their fields; None if they cannot be decoded.
    """
    flags = np.zeros(len(batch), np.uint8)
    rest = [b""] * len(batch)
    if decoded is not None:
        flags[decoded.surplus] |= _SURPLUS
        if isinstance(decoded.records, Objects):
            lossy = [_is_lossy(one) for one in decoded.plain()]
            flags[decoded.rows[np.array(lossy, np.bool_)]] |= _LOSSY
        for group in decoded_bodies(decoded):
            for row, body in zip(group.rows.tolist(), group.body, strict=True):
                rest[row] = body.tobytes() if group.error is None else group.error.encode()
            if group.error is not None:
                flags[group.rows] |= _UNREADABLE
    payloads = (batch.payload(row) for row in range(len(batch)))
    heads = (_HEAD.pack(len(one), hashlib.sha256(one).digest()) for one in payloads)
    parts = zip(heads, flags.tolist(), rest, strict=True)
    return [head + bytes([flag]) + tail for head, flag, tail in parts]


def _is_lossy(value: object) -> bool:
    """True if a document does not hold all of a value: long arrays, bytes, large integers."""
    if isinstance(value, dict):
        return any(map(_is_lossy, value.values()))
    if isinstance(value, list):
        return len(value) > ARRAY_LIMIT or any(map(_is_lossy, value))
    is_large = isinstance(value, int) and not -(1 << 63) <= value < 1 << 63
    return is_large or isinstance(value, bytes)


def _is_doubtful(value: object) -> bool:
    """True if a value of a lossy document may stand for another one."""
    if isinstance(value, dict):
        return "n" in value or any(map(_is_doubtful, value.values()))
    if isinstance(value, list):
        return any(map(_is_doubtful, value))
    return isinstance(value, float) and abs(value) >= 1 << 63


def without_lossy(decoded: Decoded) -> tuple[Decoded, int]:
    """Decoded messages but for expired ones that lack a wanted value, and how many these are."""
    records = decoded.records
    if not isinstance(records, ExpiredFields):
        return decoded, 0
    is_complete = ~records.lacking()
    if is_complete.all():
        return decoded, 0
    values = [one for one, there in zip(records.values, is_complete.tolist(), strict=True) if there]
    left = replace(decoded, rows=decoded.rows[is_complete], records=replace(records, values=values))
    return left, int((~is_complete).sum())


class ExpiredCodec(ReducedCodec):
    """Codec of what is left of expired messages."""

    def __init__(self, original: Codec, state: State) -> None:
        self._original = original
        self.state = state
        self.indexed = original.indexed
        self.reason = original.reason

    def paths(self) -> list[FieldPath]:
        """The fields of the messages."""
        return self._original.paths()

    def columns(
        self,
        buffer: Buffer,
        offset: NDArray[np.int64],
        length: NDArray[np.int64],
        fields: Collection[str] | None = None,
    ) -> Decoded:
        """Decode the stored fields; see `Codec.columns`."""
        none = np.empty(0, np.int64)
        empty = self._original.columns(b"", none, none, fields)
        form = partial(ExpiredFields, fields=fields, empty=empty)
        decoded = decode_each(_left_in, form, buffer, offset, length)
        assert isinstance(decoded.records, ExpiredFields)
        has_surplus = [bool(one.flags & _SURPLUS) for one in decoded.records.values]
        decoded.surplus = decoded.rows[np.array(has_surplus, np.bool_)]
        return decoded


@dataclass(frozen=True, slots=True)
class _Left:
    """The remains of an expired message that was readable."""

    body: bytes
    flags: int


def _left_in(payload: memoryview) -> _Left:
    remains_of(payload)
    flags, rest = payload[_HEAD.size], bytes(payload[_HEAD.size + 1 :])
    if flags & _UNREADABLE:
        raise PayloadError(rest.decode())
    return _Left(rest, flags)


@dataclass(slots=True)
class ExpiredFields(Objects):
    """Fields of expired messages, in the types of their payloads where a definition fixes them.

    Attributes:
        empty: No messages, as the codec of the payloads decodes them.
    """

    empty: Decoded | None = None

    def plain(self, *, whole: bool) -> list[dict[str, object]]:
        """The messages as plain values; see `Decoded.plain`."""
        return [document_of(one.body) for one in self.values]

    def bodies(
        self, array_limit: int, max_bytes: int
    ) -> Iterator[tuple[NDArray[np.uint8] | str, NDArray[np.intp]]]:
        """The bodies of the index documents, as they were when the payloads were there."""
        width = np.array([len(one.body) for one in self.values], np.intp)
        for size in np.unique(width).tolist():
            rows = np.flatnonzero(width == size)
            data = b"".join(self.values[row].body for row in rows.tolist())
            yield np.frombuffer(data, np.uint8).reshape(len(rows), size), rows

    def arrow(self) -> pa.StructArray:
        """The messages as an Arrow array; arrays of which only a summary is left are null."""
        from hybridlog.schema.arrow_objects import objects_array
        from hybridlog.schema.arrow_types import converted, without_summaries

        assert self.empty is not None
        if not self.is_typed:
            return objects_array(self.plain(whole=True), self.wanted())
        kind = self.empty.arrow().type
        found = [without_summaries(one, kind) for one in self.plain(whole=True)]
        return converted(objects_array(found, self.wanted()), kind)

    @property
    def is_typed(self) -> bool:
        """True if a definition fixes the types of the fields."""
        assert self.empty is not None
        return isinstance(self.empty.records, Records)

    def statistic(self, path: str, what: str) -> pa.Array[Any] | None:
        """One number of the summary of an array in each message; None if there is none.

        Args:
            path: Dotted path of the array.
            what: `n`, `min`, `max` or `mean`.
        """
        from hybridlog.schema.arrow_types import stored_statistic

        assert self.empty is not None
        kind = self.empty.arrow().type
        return stored_statistic(self.plain(whole=True), kind, path.split("."), what)

    def _wanted_of(self, fields: dict[str, object]) -> list[object]:
        """The wanted values of a message."""
        if self.fields is None:
            return [fields]
        found: list[object] = []
        for path in self.wanted() or ():
            value: Any = fields
            for name in path:
                value = value.get(name) if isinstance(value, dict) else value
            found.append(value)
        return found

    def lacking(self, but: Collection[str] = ()) -> NDArray[np.bool_]:
        """bool[n], True for messages of which a wanted value is not in the document.

        Args:
            but: Dotted paths of arrays of which only summaries are wanted.
        """
        from hybridlog.schema.arrow_types import lacks_arrays

        assert self.empty is not None
        if not self.is_typed:
            is_lossy = [bool(one.flags & _LOSSY) for one in self.values]
            found = [
                lossy and any(map(_is_doubtful, self._wanted_of(one)))
                for one, lossy in zip(self.plain(whole=True), is_lossy, strict=True)
            ]
            return np.array(found, np.bool_)
        kind = self.empty.arrow().type
        found = [lacks_arrays(one, kind, but) for one in self.plain(whole=True)]
        return np.array(found, np.bool_)
