"""Types of protobuf fields, and tests for lists and maps."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from google.protobuf.descriptor import FieldDescriptor
    from google.protobuf.message import Message

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


def nanoseconds_of(message: Message) -> int:
    """A `Timestamp` or `Duration` in nanoseconds."""
    seconds, nanos = (getattr(message, name) for name in ("seconds", "nanos"))
    return int(seconds * 10**9 + nanos)


def map_key(key: object) -> str:
    """A map key as a field name."""
    return str(key).lower() if isinstance(key, bool) else str(key)
