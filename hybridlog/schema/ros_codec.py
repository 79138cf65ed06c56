"""Codec of ROS 1 and ROS 2 messages."""

from __future__ import annotations

import re
import struct
import threading
from contextlib import suppress
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Literal, cast

from hybridlog.schema.codec import Codec
from hybridlog.schema.definition import (
    ArrayOf,
    FieldPath,
    FieldType,
    Instant,
    MessageType,
    Primitive,
    Text,
    parse_definition,
    paths,
)
from hybridlog.schema.wire import WireReader
from hybridlog.schema.wire_walk import MisfitError
from hybridlog_storage.errors import DefinitionError, PayloadError

if TYPE_CHECKING:
    from collections.abc import Collection

    from rosbags.interfaces.typing import FieldDesc, Typesdict

    from hybridlog.schema.codec import Decoded
    from hybridlog_storage.messages import Batch, Buffer, Schema

_MAX_UNROLLED = 10_000
"""Most elements of fixed arrays of strings and messages that rosbags unrolls into code."""

_TYPE_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*(?:/[A-Za-z][A-Za-z0-9_]*)*\Z")

# rosbags uses one module name for generated classes while it registers them.
_REGISTERING = threading.Lock()


class RosCodec(Codec):
    """Messages of one ROS type."""

    def __init__(self, schema: Schema, wire: Literal["ros1", "cdr"]) -> None:
        self._name = schema.name
        self._wire: Literal["ros1", "cdr"] = wire
        self._type = parse_definition(schema)
        self._paths = paths(self._type)
        self._readers = lru_cache(maxsize=64)(partial(WireReader, self._type, wire))
        self._readers(None)  # which refuses some definitions
        self._objects: RosObjects | None = None

    def paths(self) -> list[FieldPath]:
        """All fields, in the order of the definition."""
        return self._paths

    def decode(self, payload: Buffer) -> object:
        """Decode the message with rosbags: fields as attributes, arrays as numpy views."""
        if self._objects is None:
            with _REGISTERING:
                self._objects = self._objects or RosObjects(self._type, self._wire)
        try:
            return self._objects.decode(payload)
        except PayloadError:
            # rosbags refuses payloads with bytes left over.
            with suppress(MisfitError):
                return self._objects.decode(self._readers(None).message_in(payload))
            raise

    def columns_of(self, batch: Batch, fields: Collection[str] | None = None) -> Decoded:
        """Decode messages; see `Codec.columns_of`."""
        reader = self._readers(None if fields is None else frozenset(fields))
        decoded = reader.read(batch.buffer, batch.offset, batch.length)
        for bad in decoded.unreadable:
            bad.reason = f"the payload does not fit {self._name}: {bad.reason}"
        return decoded


class RosObjects:
    """Decodes single messages to objects with rosbags.

    rosbags runs code generated from type and field names. So it gets the checked type and
    never the text of the definition.
    """

    def __init__(self, message_type: MessageType, wire: Literal["ros1", "cdr"]) -> None:
        from rosbags.typesys import TypesysError
        from rosbags.typesys.store import Typestore

        self._wire = wire
        self._label = message_type.name
        build = _Typesdict(message_type.name)
        self._name = build.add(message_type)
        self._store = Typestore()
        try:
            self._store.register(build.types)
            self._store.get_msgdef(self._name)
        except (TypesysError, SyntaxError, RecursionError, MemoryError) as error:
            raise DefinitionError(
                f"{message_type.name}: rosbags cannot make a class from this definition ({error}). "
                "`.raw` has the bytes"
            ) from error

    def decode(self, payload: Buffer) -> object:
        """The message; PayloadError if the payload does not fit the definition."""
        view = memoryview(payload)
        read = self._store.deserialize_ros1 if self._wire == "ros1" else self._store.deserialize_cdr
        from rosbags.serde import SerdeError

        try:
            return read(view, self._name)
        except (
            SerdeError,
            struct.error,
            ValueError,
            IndexError,
            OverflowError,
            MemoryError,
        ) as error:
            raise PayloadError(
                f"the payload does not fit {self._label}: {error}. `.raw` has the bytes"
            ) from error


class _Typesdict:
    """A type and all its nested types, in the form that rosbags registers."""

    def __init__(self, owner: str) -> None:
        self.types: Typesdict = {}
        self._owner = owner
        self._names: dict[MessageType, str] = {}
        self._unrolled = 0

    def add(self, message: MessageType) -> str:
        """Add a message; return its rosbags name."""
        if message not in self._names:
            name = self._free(_rosbags_name(message.name))
            self.types[name] = ([], [])
            self._names[message] = name
            self.types[name][1].extend((n, self._describe(t)) for n, t in message.fields)
        return self._names[message]

    def _free(self, name: str) -> str:
        if not _TYPE_NAME.match(name):
            raise DefinitionError(f"{self._owner}: {name[:80]!r} is not a valid type name")
        while name in self.types:
            name += "_"
        return name

    def _describe(self, field: FieldType) -> FieldDesc:
        from rosbags.interfaces import Nodetype

        if isinstance(field, Primitive):
            return _base(field.dtype.name)
        if isinstance(field, Text):
            return _base("string")
        if isinstance(field, Instant):
            parts = {"sec": field.signed_seconds, "nanosec": field.signed_nanoseconds}
            fields = ((name, Primitive("", "i4" if own else "u4")) for name, own in parts.items())
            field = MessageType(f"builtin_interfaces/{field.kind.capitalize()}", tuple(fields))
        if isinstance(field, MessageType):
            return (Nodetype.NAME, self.add(field))
        return self._describe_array(field)

    def _describe_array(self, field: ArrayOf) -> FieldDesc:
        from rosbags.interfaces import Nodetype

        if field.width is not None and not isinstance(field.element, Primitive):
            self._unrolled += field.width
            if self._unrolled > _MAX_UNROLLED:
                raise DefinitionError(
                    f"{self._owner}: fixed arrays of {field.width} messages or strings are not "
                    "made objects. `.raw` has the bytes"
                )
        kind = Nodetype.SEQUENCE if field.width is None else Nodetype.ARRAY
        inner = self._describe(field.element)
        return cast("FieldDesc", (kind, (inner, field.width or 0)))


def _base(name: str) -> FieldDesc:
    from rosbags.interfaces import Nodetype

    return cast("FieldDesc", (Nodetype.BASE, (name, 0)))


def _rosbags_name(name: str) -> str:
    """The rosbags spelling of `pkg/Name`: `pkg/msg/Name`."""
    parts = name.strip("/").split("/")
    if len(parts) == 1:
        # Its class would hide names that the code of rosbags uses.
        parts.insert(0, "unnamed")
    if len(parts) == 2:
        parts.insert(1, "msg")
    return "/".join(parts)
