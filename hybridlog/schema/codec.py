"""Codecs: payloads of any encoding as columns.

A codec has one method for many messages, `columns_of`. Arrow arrays, plain objects and index
documents are made from its result, in one way for all encodings.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
from msgspec import Struct

from hybridlog.schema.column import STAMP, Records
from hybridlog_storage.errors import DefinitionError, PayloadError
from hybridlog_storage.messages import Batch, Buffer

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    import pyarrow as pa
    from numpy.typing import NDArray

    from hybridlog.schema.definition import FieldPath
    from hybridlog.schema.objects import Objects


def no_rows() -> NDArray[np.intp]:
    """No row."""
    return np.empty(0, np.intp)


def payload_alone(payload: bytes) -> Batch:
    """A message of which only the payload matters."""
    none = np.zeros(1, np.int64)
    size = none + len(payload)
    return Batch(payload, none, size, none.astype(np.int32), none, none, none.astype(np.uint32))


def no_messages() -> Batch:
    """From them follow the types of fields."""
    return payload_alone(b"").take(no_rows())


class Unreadable(Struct):
    """Payloads that cannot be read, all for the same reason.

    Attributes:
        rows: Rows of the input, ascending.
        reason: A sentence: `the payload does not fit pkg/Type: it ends early`.
    """

    rows: NDArray[np.intp]
    reason: str


class Decoded(Struct):
    """Some messages as columns, or as objects where no definition fixes their layout.

    Attributes:
        rows: Readable rows of the input, ascending.
        records: Their fields; as many rows as `rows`.
        unreadable: The other rows, each in one of these.
        surplus: Readable rows with bytes left over behind the message, ascending.
    """

    rows: NDArray[np.intp]
    records: Records | Objects
    unreadable: list[Unreadable]
    surplus: NDArray[np.intp]

    @property
    def is_typed(self) -> bool:
        """True if a definition fixes the types of the fields."""
        return isinstance(self.records, Records) or self.records.is_typed

    def arrow(self) -> pa.StructArray:
        """The messages as Arrow holds them: exact values, nested as the messages are.

        A field that is missing and one that is null are null. Integers have their wire type,
        those of JSON int64, or uint64 from 2^63 on. A field without a common exact type is
        JSON text, of the type `pa.json_()`. Times are timestamp[ns, UTC], durations
        duration[ns], protobuf `bytes` binary, arrays whole. Numbers may be views into the
        buffer that was read, which they keep.
        """
        if not isinstance(self.records, Records):
            return self.records.arrow()
        from hybridlog.schema.arrow_types import records_array

        return records_array(self.records)


class Codec(ABC):
    """Decodes the payloads of a channel. Thread safe."""

    indexed = True
    """False if only `_meta` is indexed, and nothing can be decoded."""
    reason: str | None = None
    """Reason why the fields are not indexed, None if they are."""

    def paths(self) -> list[FieldPath]:
        """The fields for predicates; empty if no definition fixes them."""
        return []

    @abstractmethod
    def columns_of(self, batch: Batch, fields: Collection[str] | None = None) -> Decoded:
        """Decode messages of one channel, with or without their payloads.

        `fields` are dotted paths of those wanted, each with all below it; None for all. Without a
        definition it raises DefinitionError.
        """

    @abstractmethod
    def decode(self, payload: Buffer) -> object:
        """One message as its format's usual library has it; PayloadError if it does not fit."""


class OpaqueCodec(Codec):
    """Codec of payloads that are stored and fetched, but not decoded."""

    indexed = False

    def __init__(self, reason: str) -> None:
        self.reason = reason

    def columns_of(self, *_: Any, **__: Any) -> NoReturn:
        """Refuses with DefinitionError."""
        raise DefinitionError(f"cannot be decoded: {self.reason}. `.raw` has the bytes")

    decode = columns_of


class ObjectCodec(Codec):
    """Codec of messages that are decoded to Python objects one by one."""

    def form(self, values: list[Any], fields: Collection[str] | None) -> Objects:
        """The objects as one value."""
        from hybridlog.schema.objects import Objects

        return Objects(values, fields)

    def columns_of(self, batch: Batch, fields: Collection[str] | None = None) -> Decoded:
        """Decode messages; see `Codec.columns_of`."""
        rows: list[int] = []
        objects: list[Any] = []
        bad: dict[str, list[int]] = {}
        view = memoryview(batch.buffer)
        places = zip(batch.offset.tolist(), batch.length.tolist(), strict=True)
        for row, (start, size) in enumerate(places):
            try:
                objects.append(self.decode(view[start : start + size]))
            except PayloadError as error:
                bad.setdefault(str(error), []).append(row)
            else:
                rows.append(row)
        records = self.form(objects, fields)
        return Decoded(np.array(rows, np.intp), records, unreadable(bad), no_rows())


def unreadable(bad: Mapping[str, list[int]]) -> list[Unreadable]:
    """Rows that cannot be read, by reason."""
    return [Unreadable(np.sort(np.array(rows, np.intp)), why) for why, rows in bad.items()]


def stamps_of(codec: Codec, batch: Batch) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
    """Rows of those messages of one channel whose header stamp is set, and the stamps, ns."""
    decoded = codec.columns_of(batch, {STAMP})
    found = stamp_array(decoded.arrow())
    if found is None:
        return np.empty(0, np.intp), np.empty(0, np.int64)
    there = found.is_valid().to_numpy(zero_copy_only=False)
    stamps = found.drop_null().view("int64").to_numpy()
    return decoded.rows[there], stamps


def stamp_array(records: pa.StructArray) -> pa.Array[Any] | None:
    """The header stamps of decoded messages, timestamp[ns]; None when they have none.

    A stamp of zero was not set, and is no time: it is null.
    """
    import pyarrow as pa
    import pyarrow.compute as pc

    try:
        found: pa.Array[Any] = pc.struct_field(records, STAMP.split("."))
    except pa.ArrowException:
        return None
    if not pa.types.is_timestamp(found.type):
        return None
    is_unset = pc.equal(found.view(pa.int64()), 0)
    return pc.if_else(is_unset, None, found) if pc.any(is_unset).as_py() else found
