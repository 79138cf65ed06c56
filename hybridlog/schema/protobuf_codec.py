"""Protobuf messages, if the protobuf package is installed.

As Arrow arrays they have the types in their definition: `bytes` are binary, lists of messages lists
of structs, `Timestamp` and `Duration` times. A map is a struct with a field for each key. An unset
field that tracks its presence is null.
"""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from graphlib import CycleError, TopologicalSorter
from importlib import import_module
from typing import TYPE_CHECKING, Any, cast

import pyarrow as pa

from hybridlog.schema.arrow_types import (
    lists,
    missing_rows,
    offsets_of,
    plain_values,
    structs,
    times_array,
)
from hybridlog.schema.codec import ObjectCodec
from hybridlog.schema.column import Wanted, below, top_level_names
from hybridlog.schema.definition import MAX_DEFINITION, FieldPath
from hybridlog.schema.objects import Objects, plain_cells
from hybridlog_storage.errors import DefinitionError, PayloadError

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from google.protobuf.descriptor import Descriptor, FieldDescriptor
    from google.protobuf.descriptor_pb2 import FileDescriptorProto
    from google.protobuf.descriptor_pool import DescriptorPool
    from google.protobuf.message import Message

    from hybridlog_storage.messages import Buffer, Schema

_MAX_UNSET = 10_000
"""Maximum number of fields that no row has and that still get a type."""
_MAX_DEPTH = 32
_MAX_PATHS = 10_000
_PART = 256  # messages made plain together: each key of their maps is a column

_STANDARD = re.compile(r"google/protobuf/([a-z_]+)\.proto")
"""Protobuf's own files, which some writers leave out."""

TIMES = {"google.protobuf.Timestamp": "time", "google.protobuf.Duration": "duration"}
"""Message types that are times."""

# By FieldDescriptor.type, whose numbers are part of the protobuf format.
TYPES = {
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


class ProtobufCodec(ObjectCodec):
    """Messages of one protobuf type, whose schema is a `FileDescriptorSet` with dependencies.

    Unset fields with presence are not in the index document.
    """

    def __init__(self, schema: Schema) -> None:
        self._name = schema.name
        self._class = _message_class(schema)

    def paths(self) -> list[FieldPath]:
        """All fields; recursive types are followed once."""
        found: list[FieldPath] = []
        _add_paths(found, self._class.DESCRIPTOR, "", [], within_array=False)
        return found

    def form(self, values: list[Message], fields: Collection[str] | None) -> Objects:
        """The messages as one value."""
        return _Messages(values, fields, self._class.DESCRIPTOR)

    def decode(self, payload: Buffer) -> Message:
        """Decode the protobuf message."""
        from google.protobuf.message import DecodeError

        message = self._class()
        try:
            message.ParseFromString(bytes(payload))
        except (DecodeError, ValueError, RecursionError) as error:
            raise PayloadError(
                f"the payload does not fit {self._name}: {error}. `.raw` has the bytes"
            ) from error
        return message


@dataclass(slots=True)
class _Messages(Objects):
    """Some protobuf messages of one type."""

    descriptor: Descriptor | None = None

    def plain(self) -> list[dict[str, object]]:
        """The fields that are set, or that do not track whether they are."""
        cells = partial(plain_cells, typed=True)
        parts = (slice(at, at + _PART) for at in range(0, len(self.values), _PART))
        return [one for part in parts for one in plain_values(self._arrow(part), cells)]

    def arrow(self) -> pa.StructArray:
        """Arrays of the types that the definition names."""
        return self._arrow(slice(None))

    def _arrow(self, rows: slice) -> pa.StructArray:
        assert self.descriptor is not None
        found = _Builder().messages(self.descriptor, self.values[rows], self.wanted(), ())
        return cast("pa.StructArray", found)


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
    problem: Exception | None = None
    try:
        problem = _fill(pool, schema.data)
        descriptor = pool.FindMessageTypeByName(schema.name.removeprefix("."))
        made: type[Message] = GetMessageClass(descriptor)
    except KeyError as error:
        what = f"is malformed ({problem})" if problem else "does not say what it is"
        raise DefinitionError(f"{schema.name}: the definition {what}") from error
    except (DecodeError, TypeError, ValueError, RecursionError) as error:
        raise DefinitionError(f"{schema.name}: the definition is malformed ({error})") from error
    return made


def _fill(pool: DescriptorPool, data: bytes) -> Exception | None:
    """Adds all files of a set to a pool, each after its imports; returns the error of one.

    Imports that the set lacks are empty: they matter only if a type of theirs is used. Files that
    import each other in a circle raise ValueError.
    """
    from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet

    files = {file.name: file for file in FileDescriptorSet.FromString(data).file}
    pending = [*files.values()]
    while pending:
        for name in {*pending.pop().dependency} - files.keys():
            files[name] = _standard_file(name) or FileDescriptorProto(name=name)
            pending.append(files[name])
    graph = {name: set(file.dependency) for name, file in files.items()}
    problem: Exception | None = None
    try:
        for name in TopologicalSorter(graph).static_order():
            try:
                pool.AddSerializedFile(files[name].SerializeToString())
            except TypeError as error:
                problem = problem or error
    except CycleError as error:
        raise ValueError(f"files import each other: {', '.join(error.args[1])[:200]}") from error
    return problem


def _standard_file(name: str) -> FileDescriptorProto | None:
    """One of protobuf's own files."""
    from google.protobuf.descriptor_pb2 import FileDescriptorProto

    if (found := _STANDARD.fullmatch(name)) is not None:
        with suppress(ImportError):
            module = import_module(f"google.protobuf.{found[1]}_pb2")
            return FileDescriptorProto.FromString(module.DESCRIPTOR.serialized_pb)
    return None


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
        array = within_array or is_repeated(field)
        inner = field.message_type if is_message(field) else None
        if inner is not None and is_map(field):
            found.append(FieldPath(path, "map", within_array))
            continue
        kind = TYPES[field.type] if inner is None else TIMES.get(inner.full_name, inner.full_name)
        found.append(FieldPath(path, f"{kind}[]" if is_repeated(field) else kind, array))
        if inner is None or kind in TIMES.values():
            continue
        within = [*above, message.full_name]
        if inner.full_name not in within and len(within) < _MAX_DEPTH:
            dot = "[]." if is_repeated(field) else "."
            _add_paths(found, inner, path + dot, within, within_array=array)


def is_message(field: FieldDescriptor) -> bool:
    """True if the field is a message."""
    return field.type in {_MESSAGE, _GROUP}


def is_repeated(field: FieldDescriptor) -> bool:
    """True if the field is a list or a map."""
    # Protobuf up to 5 has only the label, protobuf from 7 on has only the property.
    repeated = getattr(field, "is_repeated", None)
    return field.label == field.LABEL_REPEATED if repeated is None else bool(repeated)


def is_map(field: FieldDescriptor) -> bool:
    """True if the field is a map."""
    return field.type == _MESSAGE and bool(field.message_type.GetOptions().map_entry)


class _Builder:
    """Builds the arrays of one call, and limits the expansion of a definition."""

    def __init__(self) -> None:
        self._unset = 0

    def messages(
        self,
        descriptor: Descriptor,
        messages: Sequence[Message | None],
        wanted: Wanted,
        above: tuple[str, ...],
    ) -> pa.Array[Any]:
        """Messages of one type; null for None, and in all rows of an unset recursion."""
        missing = missing_rows(messages)
        if above and (missing is None or missing.all()) and not any(messages):
            self._unset += len(descriptor.fields)
            if descriptor.full_name in above or self._unset > _MAX_UNSET:
                return pa.nulls(len(messages))
        within = (*above, descriptor.full_name)
        names = [field.name for field in descriptor.fields]
        arrays: dict[str, pa.Array[Any]] = {}
        spelled = names if above else top_level_names(names)
        for name, field in zip(spelled, descriptor.fields, strict=True):
            if (inner := below(wanted, name)) != []:
                arrays[name] = self._field(field, messages, inner, within)
        return structs(arrays, len(messages), missing)

    def _field(
        self,
        field: FieldDescriptor,
        messages: Sequence[Message | None],
        wanted: Wanted,
        above: tuple[str, ...],
    ) -> pa.Array[Any]:
        name = field.name
        if not is_repeated(field):
            has_presence = field.has_presence
            values = [
                None if m is None or (has_presence and not m.HasField(name)) else getattr(m, name)
                for m in messages
            ]
            return self._values(field, values, wanted, above)
        rows = [None if message is None else getattr(message, name) for message in messages]
        if is_map(field):
            return self._map(field, rows, wanted, above)
        elements = [element for row in rows if row is not None for element in row]
        items = self._values(field, elements, wanted, above)
        return lists(items, offsets_of(rows), missing_rows(rows))

    def _map(
        self,
        field: FieldDescriptor,
        rows: Sequence[Mapping[Any, Any] | None],
        wanted: Wanted,
        above: tuple[str, ...],
    ) -> pa.Array[Any]:
        inner = field.message_type.fields_by_name["value"]
        arrays: dict[str, pa.Array[Any]] = {}
        for key in sorted({key for row in rows if row is not None for key in row}):
            name = str(key).lower() if isinstance(key, bool) else str(key)
            if (rest := below(wanted, name)) != []:
                values = [row[key] if row is not None and key in row else None for row in rows]
                arrays[name] = self._values(inner, values, rest, above)
        return structs(arrays, len(rows), missing_rows(rows))

    def _values(
        self,
        field: FieldDescriptor,
        values: Sequence[Any],
        wanted: Wanted,
        above: tuple[str, ...],
    ) -> pa.Array[Any]:
        """One value for each row."""
        if not is_message(field):
            name = TYPES[field.type].replace("bytes", "binary")
            return pa.array(values, pa.type_for_alias(name))
        kind = TIMES.get(field.message_type.full_name)
        if kind is None:
            return self.messages(field.message_type, values, wanted, above)
        times = (None if one is None else one.seconds * 10**9 + one.nanos for one in values)
        return times_array([*times], kind)
