"""Protobuf messages, if the protobuf package is installed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from graphlib import CycleError, TopologicalSorter
from importlib import import_module
from typing import TYPE_CHECKING

from hybridlog.schema.arrow_protobuf import (
    TIMES,
    TYPES,
    is_map,
    is_message,
    is_repeated,
)
from hybridlog.schema.codec import ObjectCodec
from hybridlog.schema.column import top_level_names
from hybridlog.schema.definition import MAX_DEFINITION, FieldPath
from hybridlog.schema.objects import Objects, document_cells
from hybridlog_storage.errors import DefinitionError, PayloadError

if TYPE_CHECKING:
    from collections.abc import Collection

    import pyarrow as pa
    from google.protobuf.descriptor import Descriptor
    from google.protobuf.descriptor_pb2 import FileDescriptorProto
    from google.protobuf.descriptor_pool import DescriptorPool
    from google.protobuf.message import Message

    from hybridlog_storage.messages import Buffer, Schema

_MAX_DEPTH = 32
_MAX_PATHS = 10_000
_PART = 256  # messages made plain together: each key of their maps is a column

_STANDARD = frozenset(
    f"google/protobuf/{name}.proto"
    for name in (
        "any",
        "api",
        "descriptor",
        "duration",
        "empty",
        "field_mask",
        "source_context",
        "struct",
        "timestamp",
        "type",
        "wrappers",
    )
)
"""Protobuf's own files, which some writers leave out."""


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

    def plain(self, *, whole: bool) -> list[dict[str, object]]:
        """The fields that are set, or that do not track whether they are."""
        from hybridlog.schema.arrow_types import plain_values

        cells = partial(document_cells, typed=True, whole=whole)
        parts = (slice(at, at + _PART) for at in range(0, len(self.values), _PART))
        return [one for part in parts for one in plain_values(self._arrow(part), cells)]

    def arrow(self) -> pa.StructArray:
        """Arrays of the types that the definition names."""
        return self._arrow(slice(None))

    def _arrow(self, rows: slice) -> pa.StructArray:
        from hybridlog.schema.arrow_protobuf import messages_array

        assert self.descriptor is not None
        return messages_array(self.descriptor, self.values[rows], self.wanted())


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
    if b"google.protobuf." in data:
        for name in sorted(_STANDARD - files.keys()):
            files[name] = _standard_file(name)
    for name in {name for file in files.values() for name in file.dependency} - files.keys():
        files[name] = FileDescriptorProto(name=name)
    graph = {name: set(file.dependency) for name, file in files.items()}
    try:
        waiting = list(TopologicalSorter(graph).static_order())
    except CycleError as error:
        raise ValueError(f"files import each other: {', '.join(error.args[1])[:200]}") from error
    problem: Exception | None = None
    # Twice, since an import can have another name than the file, and thus no place in the order.
    for _ in range(2):
        problem, failed = None, []
        for name in waiting:
            try:
                pool.AddSerializedFile(files[name].SerializeToString())
            except TypeError as error:
                problem = problem or error
                failed.append(name)
        waiting = failed
    return problem


def _standard_file(name: str) -> FileDescriptorProto:
    """One of protobuf's own files."""
    from google.protobuf.descriptor_pb2 import FileDescriptorProto

    module = import_module(f"{name.removesuffix('.proto').replace('/', '.')}_pb2")
    return FileDescriptorProto.FromString(module.DESCRIPTOR.serialized_pb)


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
