"""Protobuf messages, if the protobuf package is installed."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, cast

import bson
from bson.int64 import Int64

from hybridlog.schema.definition import MAX_DEFINITION, FieldPath
from hybridlog.schema.document import top_level_names
from hybridlog.schema.object_rows import (
    Duration,
    Nanoseconds,
    body_groups,
    body_of,
    columns_of,
    payloads_of,
)
from hybridlog_storage.errors import DefinitionError, PayloadError

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

    import numpy as np
    from google.protobuf.descriptor import Descriptor, FieldDescriptor
    from google.protobuf.descriptor_pool import DescriptorPool
    from google.protobuf.message import Message
    from numpy.typing import NDArray

    from hybridlog.schema.codec import BodyGroup
    from hybridlog.schema.object_rows import Plain
    from hybridlog.schema.wire import Decoded
    from hybridlog_storage.messages import Buffer, Schema

_MAX_DEPTH = 32
_MAX_PATHS = 10_000

_TIMES = {"google.protobuf.Timestamp": "time", "google.protobuf.Duration": "duration"}

# By FieldDescriptor.type; its numbers are part of the protobuf format.
_TYPES = {
    1: "float64",
    2: "float32",
    3: "int64",
    4: "uint64",
    5: "int32",
    6: "uint64",
    7: "uint32",
    8: "bool",
    9: "string",
    12: "bytes",
    13: "uint32",
    14: "int32",
    15: "int32",
    16: "int64",
    17: "int32",
    18: "int64",
}
_GROUP, _MESSAGE = 10, 11


class ProtobufCodec:
    """Messages of one protobuf type.

    Unset fields with presence are not in the index document.

    Args:
        schema: Name of the type, and a `FileDescriptorSet` with its dependencies.
        array_limit: Arrays of more elements are summarised in the index.

    Raises:
        DefinitionError: The package is missing, or the definition cannot be used.
    """

    indexed = True
    reason: str | None = None

    def __init__(self, schema: Schema, array_limit: int) -> None:
        self._name = schema.name
        self._limit = array_limit
        self._class = _message_class(schema)

    def paths(self) -> list[FieldPath]:
        """All fields; recursive types are followed once."""
        found: list[FieldPath] = []
        _add_paths(found, self._class.DESCRIPTOR, "", [], within_array=False)
        return found

    def bodies(
        self, buffer: Buffer, offset: NDArray[np.int64], length: NDArray[np.int64]
    ) -> Iterator[BodyGroup]:
        """Index bodies; see `Codec.bodies`."""
        return body_groups(map(self._body, payloads_of(buffer, offset, length)))

    def fields(self, payload: Buffer) -> dict[str, object]:
        """The fields of this message in its index document."""
        body = self._body(memoryview(payload))
        if isinstance(body, PayloadError):
            return {}
        return bson.decode(struct.pack("<i", len(body) + 5) + body + b"\0")

    def decode(self, payload: Buffer) -> object:
        """Decode the protobuf message.

        Raises:
            PayloadError: The payload is not of this type.
        """
        return self._parsed(memoryview(payload))

    def columns(
        self,
        buffer: Buffer,
        offset: NDArray[np.int64],
        length: NDArray[np.int64],
        fields: Collection[str] | None,
    ) -> Decoded:
        """Fields as columns; see `object_rows.columns_of`."""
        return columns_of(
            lambda payload: _plain(self._parsed(payload)),
            payloads_of(buffer, offset, length),
            fields,
        )

    def _parsed(self, payload: memoryview) -> Message:
        from google.protobuf.message import DecodeError

        message = self._class()
        try:
            message.ParseFromString(bytes(payload))
        except (DecodeError, ValueError, RecursionError) as error:
            raise PayloadError(
                f"the payload does not fit {self._name}: {error}. `.raw` has the bytes"
            ) from error
        return message

    def _body(self, payload: memoryview) -> bytes | PayloadError:
        try:
            message = self._parsed(payload)
        except PayloadError as error:
            return error
        try:
            return body_of(_plain(message), self._limit)
        except PayloadError as error:
            return PayloadError(f"the payload is {self._name}, but {error}")


def _message_class(schema: Schema) -> type[Message]:
    try:
        from google.protobuf.descriptor_pool import DescriptorPool
        from google.protobuf.message import DecodeError
        from google.protobuf.message_factory import GetMessageClass
    except ImportError as error:
        raise DefinitionError(
            f"{schema.name}: protobuf is stored and fetched, and indexed once "
            "`pip install 'hybridlog[protobuf]'` was run"
        ) from error

    if len(schema.data) > MAX_DEFINITION:
        raise DefinitionError(
            f"{schema.name}: the definition has {len(schema.data)} bytes; "
            f"more than {MAX_DEFINITION} are not read"
        )
    pool = DescriptorPool()
    try:
        _fill(pool, schema.data)
        made: type[Message] = GetMessageClass(pool.FindMessageTypeByName(schema.name))
    except KeyError as error:
        raise DefinitionError(f"{schema.name}: the definition does not say what it is") from error
    except (DecodeError, TypeError, ValueError, RecursionError) as error:
        raise DefinitionError(f"{schema.name}: the definition is malformed ({error})") from error
    return made


def _fill(pool: DescriptorPool, data: bytes) -> None:
    """Add all files of a set to a pool, each after its imports."""
    from google.protobuf.descriptor_pb2 import FileDescriptorSet

    waiting = {file.name: file for file in FileDescriptorSet.FromString(data).file}
    added: set[str] = set()
    while waiting:
        ready = [f for f in waiting.values() if not (set(f.dependency) - added) & waiting.keys()]
        if not ready:
            raise ValueError(f"files import each other: {', '.join(sorted(waiting))[:200]}")
        for file in ready:
            for name in file.dependency:
                if name not in added:
                    added.add(name)
                    _fill_standard(pool, name)
            pool.AddSerializedFile(file.SerializeToString())
            added.add(file.name)
            del waiting[file.name]


def _fill_standard(pool: DescriptorPool, name: str) -> None:
    """Add one of protobuf's own files, which some writers omit."""
    from google.protobuf import duration_pb2, timestamp_pb2

    for module in (duration_pb2, timestamp_pb2):
        if module.DESCRIPTOR.name == name:
            pool.AddSerializedFile(module.DESCRIPTOR.serialized_pb)


def _plain(message: Message) -> dict[str, Plain]:
    """A message as a plain object, with fields in the order of the definition."""
    found: dict[str, Plain] = {}
    for field in message.DESCRIPTOR.fields:
        if field.has_presence and not message.HasField(field.name):
            continue
        value = getattr(message, field.name)
        if not _is_repeated(field):
            found[field.name] = _value(field, value)
        elif _is_map(field):
            inner = field.message_type.fields_by_name["value"]
            # Maps have no order; index documents must be reproducible.
            found[field.name] = {_map_key(k): _value(inner, value[k]) for k in sorted(value)}
        else:
            found[field.name] = [_value(field, v) for v in value]
    return found


def _value(field: FieldDescriptor, value: object) -> Plain:
    if field.type in {_MESSAGE, _GROUP}:
        kind = _TIMES.get(field.message_type.full_name)
        if kind is not None:
            return _nanoseconds(cast("Message", value), kind)
        return _plain(cast("Message", value))
    if isinstance(value, bytes):
        return {"n": Int64(len(value))}
    if _TYPES[field.type] in {"uint32", "int64", "uint64"}:
        return Int64(cast("int", value))
    return cast("Plain", value)


def _nanoseconds(message: Message, kind: str) -> Nanoseconds:
    seconds, nanos = (getattr(message, name) for name in ("seconds", "nanos"))
    return (Duration if kind == "duration" else Nanoseconds)(seconds * 10**9 + nanos)


def _map_key(key: object) -> str:
    return str(key).lower() if isinstance(key, bool) else str(key)


def _is_repeated(field: FieldDescriptor) -> bool:
    # Up to protobuf 5 only the label exists, from 7 on only the property.
    repeated = getattr(field, "is_repeated", None)
    return field.label == field.LABEL_REPEATED if repeated is None else bool(repeated)


def _is_map(field: FieldDescriptor) -> bool:
    return field.type == _MESSAGE and bool(field.message_type.GetOptions().map_entry)


def _add_paths(
    found: list[FieldPath],
    message: Descriptor,
    prefix: str,
    above: list[str],
    *,
    within_array: bool,
) -> None:
    names = [field.name for field in message.fields]
    for name, field in zip(names if above else top_level_names(names), message.fields, strict=True):
        if len(found) >= _MAX_PATHS:
            return
        path = prefix + name
        array = within_array or _is_repeated(field)
        inner = field.message_type if field.type in {_MESSAGE, _GROUP} else None
        if inner is not None and _is_map(field):
            found.append(FieldPath(path, "map", within_array))
            continue
        kind = _TYPES[field.type] if inner is None else _TIMES.get(inner.full_name, inner.full_name)
        found.append(FieldPath(path, f"{kind}[]" if _is_repeated(field) else kind, array))
        if inner is None or kind in _TIMES.values():
            continue
        within = [*above, message.full_name]
        if inner.full_name not in within and len(within) < _MAX_DEPTH:
            dot = "[]." if _is_repeated(field) else "."
            _add_paths(found, inner, path + dot, within, within_array=array)
