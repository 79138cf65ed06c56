"""Codecs: payloads of any encoding as columns.

A codec has one method for many messages, `columns`. Arrow arrays, plain objects and index
documents are made from its result, in one way for all encodings.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NoReturn, Protocol

import numpy as np

from hybridlog.schema.column import STAMP, Records
from hybridlog_storage.errors import DefinitionError, PayloadError

if TYPE_CHECKING:
    from collections.abc import Collection

    import pyarrow as pa
    from numpy.typing import NDArray

    from hybridlog.schema.definition import FieldPath
    from hybridlog.schema.objects import Objects
    from hybridlog_storage.messages import Batch, Buffer


def no_rows() -> NDArray[np.intp]:
    """No row."""
    return np.empty(0, np.intp)


@dataclass(slots=True)
class Unreadable:
    """Payloads that cannot be read, all for the same reason.

    Attributes:
        rows: Rows of the input, ascending.
        reason: A sentence: `the payload does not fit pkg/Type: it ends early`.
    """

    rows: NDArray[np.intp]
    reason: str


@dataclass(slots=True)
class Decoded:
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
        from hybridlog.schema.arrow_columns import records_array

        return records_array(self.records)

    def plain(self, *, whole: bool = True) -> list[dict[str, object]]:
        """The messages as plain values: dict, list, str, bytes, bool, int, float, None.

        A field that a message lacks is not there. Times and durations are integer nanoseconds.
        Without `whole`, protobuf's `bytes` are `{"n": length}`.
        """
        if not isinstance(self.records, Records):
            return self.records.plain(whole=whole)
        from hybridlog.schema.arrow_types import plain_values

        return plain_values(self.arrow())


class Codec(Protocol):
    """Decodes the payloads of a channel. Thread safe."""

    @property
    def indexed(self) -> bool:
        """False if only `_meta` is indexed, and nothing can be decoded."""

    @property
    def reason(self) -> str | None:
        """Reason why the fields are not indexed, None if they are."""

    def paths(self) -> list[FieldPath]:
        """The fields for predicates; empty if no definition fixes them."""

    def columns(
        self,
        buffer: Buffer,
        offset: NDArray[np.int64],
        length: NDArray[np.int64],
        fields: Collection[str] | None = None,
    ) -> Decoded:
        """Decode messages at `offset` (int64[n]) of `length` bytes (int64[n]) in a buffer.

        `fields` are dotted paths of those wanted, each with all below it; None for all. Without a
        definition it raises DefinitionError.
        """

    def decode(self, payload: Buffer) -> object:
        """One message as its format's usual library has it; PayloadError if it does not fit."""


class OpaqueCodec:
    """Codec of payloads that are stored and fetched, but not decoded."""

    indexed = False

    def __init__(self, reason: str) -> None:
        self.reason: str | None = reason

    def paths(self) -> list[FieldPath]:
        """No fields are known."""
        return []

    def columns(
        self,
        buffer: Buffer,
        offset: NDArray[np.int64],
        length: NDArray[np.int64],
        fields: Collection[str] | None = None,
    ) -> NoReturn:
        """Refuses with DefinitionError."""
        raise DefinitionError(f"cannot be decoded: {self.reason}. `.raw` has the bytes")

    def decode(self, payload: Buffer) -> NoReturn:
        """Refuses with DefinitionError."""
        self.columns(payload, no_rows(), no_rows())


class ObjectCodec(ABC):
    """Codec of messages that are decoded to Python objects one by one."""

    indexed = True
    reason: str | None = None

    def paths(self) -> list[FieldPath]:
        """No fields: a message may have any content."""
        return []

    @abstractmethod
    def decode(self, payload: Buffer) -> object:
        """See `Codec.decode`."""

    def read(self, payload: memoryview) -> Any:
        """The object that columns are made from; PayloadError if the payload does not fit."""
        return self.decode(payload)

    def form(self, values: list[Any], fields: Collection[str] | None) -> Objects:
        """The objects as one value."""
        from hybridlog.schema.objects import Objects

        return Objects(values, fields)

    def columns(
        self,
        buffer: Buffer,
        offset: NDArray[np.int64],
        length: NDArray[np.int64],
        fields: Collection[str] | None = None,
    ) -> Decoded:
        """Decode messages; see `Codec.columns`."""
        rows: list[int] = []
        objects: list[Any] = []
        bad: dict[str, list[int]] = {}
        view = memoryview(buffer)
        places = zip(offset.tolist(), length.tolist(), strict=True)
        for row, (start, size) in enumerate(places):
            try:
                objects.append(self.read(view[start : start + size]))
            except PayloadError as error:
                bad.setdefault(str(error), []).append(row)
            else:
                rows.append(row)
        unreadable = [Unreadable(np.array(r, np.intp), text) for text, r in bad.items()]
        records = self.form(objects, fields)
        return Decoded(np.array(rows, np.intp), records, unreadable, no_rows())


def columns_of(codec: Codec, batch: Batch, fields: Collection[str] | None = None) -> Decoded:
    """Decode messages of one channel, with or without their payloads; see `Codec.columns`."""
    of_rows: Any = getattr(codec, "columns_of", None)  # of a `LeftCodec`
    if of_rows is not None:
        found: Decoded = of_rows(batch, fields)
        return found
    return codec.columns(batch.buffer, batch.offset, batch.length, fields)


def stamps_of(codec: Codec, batch: Batch) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
    """Rows of those messages of one channel whose header stamp is set, and the stamps, ns."""
    decoded = columns_of(codec, batch, {STAMP})
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

    found: pa.Array[Any] = records
    for name in STAMP.split("."):
        if not pa.types.is_struct(found.type) or found.type.get_field_index(name) < 0:
            return None
        found = found.flatten()[found.type.get_field_index(name)]
    if not pa.types.is_timestamp(found.type):
        return None
    is_unset = pc.equal(found.view(pa.int64()), 0)
    return pc.if_else(is_unset, None, found) if pc.any(is_unset).as_py() else found
