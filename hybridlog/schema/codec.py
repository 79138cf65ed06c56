"""From payloads to index bodies, columns and objects, whatever they are encoded in."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from hybridlog.schema.column import Records
from hybridlog.schema.wire import Decoded, Unreadable
from hybridlog_storage.errors import DefinitionError
from hybridlog_storage.messages import REDUCED

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping, Sequence

    import pyarrow as pa
    from numpy.typing import NDArray

    from hybridlog.schema.definition import FieldPath
    from hybridlog_storage.messages import Buffer, Channel, Schema

_ROS = {("ros1", "ros1msg"), ("cdr", "ros2msg"), ("cdr", "ros2idl")}


class BodyGroup(NamedTuple):
    """Bodies of index documents, all of one width.

    Attributes:
        rows: intp[k], rows of the input.
        body: uint8[k, width], BSON elements without the document's length and end.
        error: Why these payloads could not be read; the width is 0 then.
        stamps: int64[k], header stamps, ns; None when there are none, or when they are
            to be had from `Codec.columns` only.
    """

    rows: NDArray[np.intp]
    body: NDArray[np.uint8]
    error: str | None
    stamps: NDArray[np.int64] | None = None


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
    """What can be done with the payloads of a channel. Thread safe."""

    @property
    def indexed(self) -> bool:
        """False when only `_meta` goes into the index."""

    @property
    def reason(self) -> str | None:
        """Why the fields are not indexed, None when they are."""

    def paths(self) -> list[FieldPath]:
        """The fields that can be asked for; empty when no definition fixes them."""

    def bodies(
        self, buffer: Buffer, offset: NDArray[np.int64], length: NDArray[np.int64]
    ) -> Iterator[BodyGroup]:
        """Index bodies; each row of the input is in exactly one group.

        Args:
            buffer: Holds the payloads.
            offset: int64[n], where each payload starts.
            length: int64[n], bytes of each payload.
        """

    def fields(self, payload: Buffer) -> dict[str, object]:
        """What the index document holds of this message; empty when it holds nothing."""

    def decode(self, payload: Buffer) -> object:
        """The whole message as an object.

        Raises:
            PayloadError: The payload does not fit its definition.
            DefinitionError: There is no definition to read it by.
        """

    def columns(
        self,
        buffer: Buffer,
        offset: NDArray[np.int64],
        length: NDArray[np.int64],
        fields: Collection[str] | None,
    ) -> Decoded:
        """Fields as columns, arrays whole.

        Args:
            buffer: Holds the payloads.
            offset: int64[n], where each payload starts.
            length: int64[n], bytes of each payload.
            fields: Dotted paths of those wanted, each with all below it; None for all.

        Raises:
            DefinitionError: There is no definition to read them by.
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
    """Payloads that are stored and fetched as they are.

    Args:
        reason: Why.
    """

    indexed = False

    def __init__(self, reason: str) -> None:
        self.reason: str | None = reason

    def paths(self) -> list[FieldPath]:
        """None are known."""
        return []

    def bodies(
        self,
        buffer: Buffer,
        offset: NDArray[np.int64],
        length: NDArray[np.int64],
    ) -> Iterator[BodyGroup]:
        """One group without any element."""
        if len(offset):
            yield BodyGroup(np.arange(len(offset)), np.empty((len(offset), 0), np.uint8), None)

    def fields(self, payload: Buffer) -> dict[str, object]:
        """Nothing."""
        return {}

    def decode(self, payload: Buffer) -> object:
        """Refuses.

        Raises:
            DefinitionError: Always.
        """
        raise self._refusal()

    def columns(
        self,
        buffer: Buffer,
        offset: NDArray[np.int64],
        length: NDArray[np.int64],
        fields: Collection[str] | None,
    ) -> Decoded:
        """Refuses.

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


def codec_for(channel: Channel, *, array_limit: int = 32) -> Codec:
    """The codec of a channel. Never raises: what cannot be read is opaque and says why.

    Args:
        channel: Its message encoding and schema count.
        array_limit: Arrays of more elements are summarised in the index.
    """
    return _codec(channel.message_encoding, channel.schema, array_limit)


@lru_cache(maxsize=1024)
def _codec(encoding: str, schema: Schema | None, array_limit: int) -> Codec:
    try:
        return _made(encoding, schema, array_limit)
    except DefinitionError as error:
        return OpaqueCodec(str(error))


def _made(encoding: str, schema: Schema | None, array_limit: int) -> Codec:
    if encoding == "json":
        from hybridlog.schema.json_codec import JsonCodec

        return JsonCodec(array_limit)
    if encoding == REDUCED:
        from hybridlog.schema.reduced_codec import ReducedCodec

        return ReducedCodec()
    return _defined(encoding, schema, array_limit)


def _defined(encoding: str, schema: Schema | None, array_limit: int) -> Codec:
    """The codec of messages that a definition is needed for."""
    if encoding not in {"ros1", "cdr", "protobuf"}:
        named = f"encoding {encoding!r}" if encoding else "a message without an encoding"
        return OpaqueCodec(f"{named} is stored and fetched, not indexed")
    if schema is None or not (schema.encoding or schema.data):
        named = "" if schema is None or not schema.name else f"{schema.name}: "
        return OpaqueCodec(f"{named}no definition in the source")
    if (encoding, schema.encoding) in _ROS:
        from hybridlog.schema.ros_codec import RosCodec

        return RosCodec(schema, "ros1" if encoding == "ros1" else "cdr", array_limit)
    if (encoding, schema.encoding) == ("protobuf", "protobuf"):
        from hybridlog.schema.protobuf_codec import ProtobufCodec

        return ProtobufCodec(schema, array_limit)
    return OpaqueCodec(
        f"{schema.name}: encoding {encoding!r} with a definition in {schema.encoding!r} "
        "is stored and fetched, not indexed"
    )


def error_group(rows: NDArray[np.intp], error: str) -> BodyGroup:
    """The group of payloads that could not be read."""
    return BodyGroup(rows, np.empty((len(rows), 0), np.uint8), error)


def nothing_decoded(unreadable: list[Unreadable]) -> Decoded:
    """No row could be read."""
    return Decoded(np.empty(0, np.intp), Records({}, 0), unreadable)
