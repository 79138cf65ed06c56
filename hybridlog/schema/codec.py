"""Codecs: payloads of any encoding to index bodies, columns and objects."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from hybridlog_storage.errors import DefinitionError

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping, Sequence

    import pyarrow as pa
    from numpy.typing import NDArray

    from hybridlog.schema.definition import FieldPath
    from hybridlog.schema.wire import Unreadable
    from hybridlog_storage.messages import Buffer


_NONE: NDArray[np.intp] = np.empty(0, np.intp)


class BodyGroup(NamedTuple):
    """Bodies of index documents of equal width.

    Attributes:
        rows: intp[k], rows of the input.
        body: uint8[k, width], BSON elements without the document's length and end.
        error: Reason why these payloads could not be read; the width is then 0.
        stamps: int64[k], header stamps, ns; None if there are none, or if only
            `Codec.columns` provides them.
        surplus: intp[j], rows of these with bytes left over behind the message.
    """

    rows: NDArray[np.intp]
    body: NDArray[np.uint8]
    error: str | None
    stamps: NDArray[np.int64] | None = None
    surplus: NDArray[np.intp] = _NONE


@dataclass(slots=True)
class DecodedArrow:
    """Messages as Arrow holds them: exact values, nested as the messages are.

    A field that is missing and one that is null are null. Integers have their wire type,
    those of JSON int64, or uint64 from 2^63 on. A field without a common exact type is
    JSON text, of the type `pa.json_()`. Times are timestamp[ns, UTC], durations
    duration[ns], protobuf `bytes` binary, arrays whole.

    Attributes:
        rows: Rows of the input that could be read, ascending.
        records: Their fields; as many rows as `rows`.
        unreadable: The other rows, each in one of these.
    """

    rows: NDArray[np.intp]
    records: pa.StructArray
    unreadable: list[Unreadable]


@dataclass(slots=True)
class DecodedObjects:
    """Messages as plain objects, for JSON lines.

    A field that a message lacks is not there, and one that is null is None. Times are
    nanoseconds; bytes are bytes.

    Attributes:
        rows: Rows of the input that could be read, ascending.
        objects: One for each of them.
        unreadable: The other rows, each in one of these.
    """

    rows: NDArray[np.intp]
    objects: Sequence[Mapping[str, object]]
    unreadable: list[Unreadable]


class Codec(Protocol):
    """Decodes the payloads of a channel. Thread safe."""

    @property
    def indexed(self) -> bool:
        """False if only `_meta` is indexed."""

    @property
    def reason(self) -> str | None:
        """Reason why the fields are not indexed, None if they are."""

    def paths(self) -> list[FieldPath]:
        """The fields for predicates; empty if no definition fixes them."""

    def bodies(
        self, buffer: Buffer, offset: NDArray[np.int64], length: NDArray[np.int64]
    ) -> Iterator[BodyGroup]:
        """Make index bodies; each row of the input is in exactly one group.

        Args:
            buffer: Holds the payloads.
            offset: int64[n], where each payload starts.
            length: int64[n], bytes of each payload.
        """

    def fields(self, payload: Buffer) -> dict[str, object]:
        """The fields of this message in its index document; empty without any."""

    def plain(self, payload: Buffer, names: Collection[str] | None = None) -> dict[str, object]:
        """The whole message as plain values: dict, list, str, bool, int, float, None.

        Times and durations are integer nanoseconds; protobuf `bytes` are `{"n": length}`.

        Args:
            payload: The serialized message.
            names: Fields of the top level that are needed, at least; None for all.

        Raises:
            PayloadError: The payload does not fit its definition.
            DefinitionError: There is no definition to read it by.
        """

    def decode(self, payload: Buffer) -> object:
        """Decode the whole message into an object.

        Raises:
            PayloadError: The payload does not fit its definition.
            DefinitionError: It has no definition.
        """

    def arrow(
        self,
        buffer: Buffer,
        offset: NDArray[np.int64],
        length: NDArray[np.int64],
        fields: Collection[str] | None,
    ) -> DecodedArrow:
        """Messages as an Arrow struct array, arrays whole.

        Numbers may be views into `buffer`, which they keep.

        Args:
            buffer: Holds the payloads.
            offset: int64[n], where each payload starts.
            length: int64[n], bytes of each payload.
            fields: Dotted paths of those wanted, each with all below it; None for all.

        Raises:
            DefinitionError: There is no definition to read them by.
        """

    def objects(
        self, buffer: Buffer, offset: NDArray[np.int64], length: NDArray[np.int64]
    ) -> DecodedObjects | None:
        """Messages as plain objects; None when every message has every field.

        Args:
            buffer: Holds the payloads.
            offset: int64[n], where each payload starts.
            length: int64[n], bytes of each payload.
        """


class OpaqueCodec:
    """Codec of payloads that are stored and fetched, but not decoded.

    Args:
        reason: The reason.
    """

    indexed = False

    def __init__(self, reason: str) -> None:
        self.reason: str | None = reason

    def paths(self) -> list[FieldPath]:
        """No fields are known."""
        return []

    def bodies(
        self,
        buffer: Buffer,
        offset: NDArray[np.int64],
        length: NDArray[np.int64],
    ) -> Iterator[BodyGroup]:
        """One group of empty bodies."""
        if len(offset):
            yield BodyGroup(np.arange(len(offset)), np.empty((len(offset), 0), np.uint8), None)

    def fields(self, payload: Buffer) -> dict[str, object]:
        """Nothing."""
        return {}

    def plain(self, payload: Buffer, names: Collection[str] | None = None) -> dict[str, object]:
        """Nothing."""
        return {}

    def decode(self, payload: Buffer) -> object:
        """Raise, since the payload cannot be decoded.

        Raises:
            DefinitionError: Always.
        """
        raise self._refusal()

    def arrow(
        self,
        buffer: Buffer,
        offset: NDArray[np.int64],
        length: NDArray[np.int64],
        fields: Collection[str] | None,
    ) -> DecodedArrow:
        """Refuses.

        Raises:
            DefinitionError: Always.
        """
        raise self._refusal()

    def objects(
        self, buffer: Buffer, offset: NDArray[np.int64], length: NDArray[np.int64]
    ) -> DecodedObjects | None:
        """None: there are no fields."""
        return None

    def _refusal(self) -> DefinitionError:
        return DefinitionError(f"cannot be decoded: {self.reason}. `.raw` has the bytes")


def error_group(rows: NDArray[np.intp], error: str) -> BodyGroup:
    """The group of unreadable payloads."""
    return BodyGroup(rows, np.empty((len(rows), 0), np.uint8), error)
