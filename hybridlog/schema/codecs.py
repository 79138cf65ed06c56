"""Finds the codec of a channel; the codec of JSON, which has no definition."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, cast

from msgspec.structs import replace

from hybridlog.schema.codec import Codec, ObjectCodec, OpaqueCodec
from hybridlog.schema.states import State, encoding_of, state_of
from hybridlog_storage.errors import DefinitionError, PayloadError
from hybridlog_storage.messages import MARKS_CHANNEL

if TYPE_CHECKING:
    from hybridlog.schema.objects import Plain
    from hybridlog_storage.messages import Buffer, Channel, Schema

_ROS = {("ros1", "ros1msg"), ("cdr", "ros2msg"), ("cdr", "ros2idl"), ("cdr", "omgidl")}


def codec_for(channel: Channel) -> Codec:
    """The codec of a channel. Never raises: an unreadable channel gets an `OpaqueCodec`."""
    state = state_of(channel.message_encoding)
    if state is not State.WHOLE:
        from hybridlog.schema.left import LeftCodec

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
