"""Protobuf messages as Arrow arrays, of the types in their definition.

`bytes` are binary, lists of messages lists of structs, `Timestamp` and `Duration` times.
A map is a struct with a field for each key. An unset field that tracks its presence is
null.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import pyarrow as pa

from hybridlog.schema.arrow_columns import lists, structs
from hybridlog.schema.arrow_objects import below, missing_rows, offsets_of, times_array
from hybridlog.schema.column import top_level_names

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from google.protobuf.descriptor import Descriptor, FieldDescriptor
    from google.protobuf.message import Message

    Wanted = Sequence[Sequence[str]] | None


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


def nanoseconds_of(message: Any) -> int:
    """A `Timestamp` or `Duration` in nanoseconds."""
    return int(message.seconds * 10**9 + message.nanos)


def map_key(key: object) -> str:
    """A map key as a field name."""
    return str(key).lower() if isinstance(key, bool) else str(key)


_MAX_UNSET = 10_000
"""Maximum number of fields that no row has and that still get a type."""


def messages_array(
    descriptor: Descriptor, messages: Sequence[Message], wanted: Wanted
) -> pa.StructArray:
    """Messages of one type as a struct array of the wanted paths; None for all."""
    return cast("pa.StructArray", _Builder().messages(descriptor, messages, wanted, ()))


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
            if wanted is None or any(path[0] == name for path in wanted):
                arrays[name] = self._field(field, messages, below(wanted, name), within)
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
            name = map_key(key)
            if wanted is None or any(path[0] == name for path in wanted):
                values = [row[key] if row is not None and key in row else None for row in rows]
                arrays[name] = self._values(inner, values, below(wanted, name), above)
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
        return times_array([None if v is None else nanoseconds_of(v) for v in values], kind)
