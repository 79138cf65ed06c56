"""The codec of a channel; those of JSON, and of what is left; index documents of messages."""

from __future__ import annotations

import json
import struct
from collections.abc import Collection, Iterator, Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, NoReturn, cast

import numpy as np
from msgspec.structs import replace

from hybridlog.schema.codec import Codec, Decoded, ObjectCodec, OpaqueCodec
from hybridlog.schema.column import Records
from hybridlog.schema.states import CAUSES, State, encoding_of, state_of
from hybridlog_storage.errors import DefinitionError, PayloadError
from hybridlog_storage.messages import MARKS_CHANNEL, Batch, Buffer, Channel, Schema

if TYPE_CHECKING:
    from hybridlog.schema.definition import FieldPath
    from hybridlog.schema.document import BodyGroup
    from hybridlog.schema.objects import Plain

_ROS = {("ros1", "ros1msg"), ("cdr", "ros2msg"), ("cdr", "ros2idl"), ("cdr", "omgidl")}


def codec_for(channel: Channel) -> Codec:
    """The codec of a channel. Never raises: an unreadable channel gets an `OpaqueCodec`."""
    state = state_of(channel.message_encoding)
    if state is not State.WHOLE:
        encoding = encoding_of(channel.message_encoding, channel.metadata)
        return LeftCodec(codec_for(replace(channel, message_encoding=encoding)), state)
    return _codec(channel.message_encoding, channel.schema)


@lru_cache(maxsize=1024)
def _codec(encoding: str, schema: Schema | None) -> Codec:
    try:
        return JsonCodec() if encoding == "json" else _defined(encoding, schema)
    except DefinitionError as error:
        return OpaqueCodec(str(error))


def unindexed(definitions: Mapping[int, Channel]) -> dict[int, str]:
    """Why MongoDB has no fields of the messages of some channels, by id."""
    found = dict[int, str]()
    for number, channel in definitions.items():
        if number == MARKS_CHANNEL:
            found[number] = "marks that somebody set"
        elif not channel.is_indexed:
            found[number] = "recorded with --no-index"
        elif (reason := codec_for(channel).reason) is not None:
            found[number] = reason
    return found


def _defined(encoding: str, schema: Schema | None) -> Codec:
    """The codec of messages that need a definition."""
    if encoding not in {"ros1", "cdr", "protobuf"}:
        named = f"encoding {encoding!r}" if encoding else "a message without an encoding"
        return OpaqueCodec(f"{named} is stored and fetched, not indexed")
    if schema is None or not (schema.encoding or schema.data):
        named = "" if schema is None or not schema.name else f"{schema.name}: "
        return OpaqueCodec(f"{named}no definition in the source")
    if (encoding, schema.encoding) in _ROS:
        from hybridlog.schema.ros_codec import RosCodec

        return RosCodec(schema, "ros1" if encoding == "ros1" else "cdr")
    if (encoding, schema.encoding) == ("protobuf", "protobuf"):
        from hybridlog.schema.protobuf_codec import ProtobufCodec

        return ProtobufCodec(schema)
    return OpaqueCodec(
        f"{schema.name}: encoding {encoding!r} with a definition in {schema.encoding!r} "
        "is stored and fetched, not indexed"
    )


class JsonCodec(ObjectCodec):
    """Messages in JSON. A JSON schema is ignored."""

    def decode(self, payload: Buffer) -> Plain:
        """Decode the JSON text into Python objects."""
        try:
            return cast("Plain", json.loads(str(memoryview(payload), "utf-8-sig")))
        except (ValueError, RecursionError) as error:
            raise PayloadError(f"the payload is not JSON: {error}") from error


class LeftCodec(Codec):
    """Codec of messages whose payloads are gone; `state` says why."""

    def __init__(self, original: Codec, state: State) -> None:
        self.state = state
        self.indexed = original.indexed
        self.reason = original.reason
        self._original = original

    def paths(self) -> list[FieldPath]:
        """The fields of the messages."""
        return self._original.paths()

    def columns_of(self, batch: Batch, fields: Collection[str] | None = None) -> Decoded:
        """The fields that are left; see `Codec.columns_of`."""
        from hybridlog.columns.rows import decoded_left

        return decoded_left(batch, self._original, fields, reduced=self.state is State.REDUCED)

    def decode(self, payload: Buffer) -> NoReturn:
        """Refuses with PayloadError."""
        raise missing_payload(self.state)


def missing_payload(state: State, about: str = "") -> PayloadError:
    """Tells that a payload is gone, and what is known of it."""
    return PayloadError(f"its payload was {CAUSES[state]}; only its fields are stored{about}")


def bodies_of(codec: Codec, batch: Batch) -> Iterator[BodyGroup]:
    """Make index bodies of messages of one channel, with or without payloads."""
    return bodies_in(codec.columns_of(batch) if codec.indexed else None, len(batch))


def bodies_in(decoded: Decoded | None, messages: int) -> Iterator[BodyGroup]:
    """Make index bodies of so many decoded messages; None where these have no fields.

    Each message is in exactly one group.
    """
    from hybridlog.schema.document import bodies, without_fields  # loads numpy

    if decoded is None:
        if messages:
            yield without_fields(np.arange(messages), None)
        return
    records = decoded.records
    for group in bodies(records) if isinstance(records, Records) else records.bodies():
        yield group._replace(rows=decoded.rows[group.rows])
    for bad in decoded.unreadable:
        yield without_fields(bad.rows, bad.reason)


def document_of(body: bytes) -> dict[str, object]:
    """The document of a body."""
    import bson

    return bson.decode(struct.pack("<i", len(body) + 5) + body + b"\0")
