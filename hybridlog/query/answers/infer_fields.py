"""Infers the fields of a topic without a definition from its first messages."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from itertools import islice
from typing import TYPE_CHECKING, Any

from hybridlog.schema.definition import FieldPath
from hybridlog_storage.errors import PayloadError

if TYPE_CHECKING:
    from hybridlog.message import Message

SAMPLE = 100
"""Messages that are read."""
_MAX_FIELDS = 1000
_WORDS = {"int64": "integer", "uint64": "integer", "double": "number"}
_PLAIN = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


def infer_fields(messages: Iterable[Message]) -> list[FieldPath]:
    """Fields that the first messages have, which are in JSON, with the types of their columns.

    What cannot be read is skipped. Names that no path can have are in backticks.
    """
    from hybridlog.schema.arrow_columns import objects_array  # loads pyarrow

    values: list[Any] = []
    for message in islice(messages, SAMPLE):
        with suppress(PayloadError):
            values.append(message.decode())
    records = objects_array([one for one in values if isinstance(one, dict)], None)
    return [*islice(_fields(records.type, "", within_array=False), _MAX_FIELDS)]


def _fields(kind: Any, prefix: str, *, within_array: bool) -> Iterator[FieldPath]:
    import pyarrow as pa

    from hybridlog.schema.arrow_types import is_list

    for field in kind:
        path = prefix + (field.name if _PLAIN.fullmatch(field.name) else f"`{field.name}`")
        inner, brackets = field.type, ""
        while is_list(inner):
            inner, brackets = inner.value_type, f"{brackets}[]"
        is_object = pa.types.is_struct(inner)
        word = "any" if inner == pa.json_() else _WORDS.get(str(inner), str(inner))
        is_array = within_array or bool(brackets)
        yield FieldPath(path, ("object" if is_object else word) + brackets, is_array)
        if is_object:
            yield from _fields(inner, f"{path}{brackets}.", within_array=is_array)
