"""A message as a tree of short texts, a part of it at a time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import islice
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np
import pyarrow as pa

from hybridlog.query.times import format_time
from hybridlog.schema.arrow_types import is_numeric
from hybridlog_storage.errors import UsageError
from hybridlog_storage.times import BEGIN, END

if TYPE_CHECKING:
    from hybridlog.message import Message

MAX_SHOWN: Final = 1000
"""Most elements of an array, or fields of an object, in one answer."""
MAX_DEPTH: Final = 16
"""Most levels of one answer."""
MAX_NODES: Final = 2000
"""Most nodes of one answer."""
MAX_TEXT: Final = 1000
"""Most characters of a text or a name."""

_SHOWN: Final = {True: 64, False: 16}
"""Elements that are shown unasked, of an array of plain values and of any other."""
_MAX_CHARACTERS: Final = 1 << 18
_LONGEST_INTEGER: Final = 1 << 256

Node: TypeAlias = "dict[str, Any]"
"""A part of a message.

`type`: its type, empty for an object. A plain value has `text`, and `n`, the number of its
characters, if that is cut. An array or an object has `n`, its length, `begin` and `items`, the
nodes from there on; an array of plain values has `texts` instead, and the items of an object
have `name`. Without either it is closed: ask for its path.
"""


def tree(
    message: Message, path: Sequence[int] = (), *, begin: int = 0, count: int | None = None
) -> Node:
    """A part of a message, with what is below it as far as there is room.

    Args:
        message: The message.
        path: Place of a field or an element at each level; empty for the whole message.
        begin: First element, field or character.
        count: Number of elements or fields, at most `MAX_SHOWN`; None for a few.

    Raises:
        PayloadError: the payload does not fit its definition.
        DefinitionError: no usable definition exists.
        UsageError: the message has no such part.
    """
    value: Any = message.content()
    for place in path:
        items = _items(value, place, 1)
        if items is None or not items:
            raise UsageError("The message has no such part.")
        value = items[0][1]
    if count is not None:
        count = min(max(count, 1), MAX_SHOWN)
    return _Walk().node(value, MAX_DEPTH, max(begin, 0), count)


class _Walk:
    """Makes the nodes of one answer.

    Attributes:
        nodes: Number of nodes that may still be made.
        characters: Number of characters that they may still have.
    """

    def __init__(self) -> None:
        self.nodes = MAX_NODES
        self.characters = _MAX_CHARACTERS

    def node(self, value: Any, depth: int, begin: int = 0, count: int | None = None) -> Node:
        """The node of a value."""
        self.nodes -= 1
        size = _size(value)
        if size is None:
            return self._plain(value, begin)
        kind, numbers = _array_type(value), _numbers(value)
        found: Node = {"type": kind, "n": size, "begin": min(begin, size)}
        is_object = not kind
        if count is None:
            count = MAX_SHOWN if is_object else _SHOWN[numbers is not None]
        if numbers is not None:
            found["texts"] = [self._cut(t) for t in _texts(numbers, begin, begin + count)]
            return found
        if depth <= 0 or self.nodes < min(count, size):
            return found
        self.nodes -= min(count, size)
        found["items"] = []
        for name, item in _items(value, begin, count) or ():
            self.nodes += 1  # it was set aside, so that no level below can take it
            node = self.node(item, depth - 1)
            found["items"].append({"name": self._cut(name), **node} if is_object else node)
        return found

    def _plain(self, value: Any, begin: int) -> Node:
        kind, text = _described(value)
        shown = self._cut(text[begin : begin + MAX_TEXT])
        found: Node = {"type": kind, "text": shown}
        if len(shown) < len(text):
            found |= {"n": len(text), "begin": min(begin, len(text))}
        return found

    def _cut(self, text: str) -> str:
        cut = text[: min(MAX_TEXT, max(self.characters, 1))]
        self.characters -= len(cut)
        # A lone surrogate, which JSON may have, is no text of a web page.
        return cut.encode("utf-8", "replace").decode()


def _size(value: Any) -> int | None:
    """Number of fields or elements; None for a plain value."""
    if isinstance(value, Mapping | list | tuple | bytes):
        return len(value)
    if isinstance(value, pa.StructScalar):
        return value.type.num_fields if value.is_valid else None
    if isinstance(value, pa.ListScalar | pa.FixedSizeListScalar | pa.LargeListScalar):
        return len(value.values) if value.is_valid else None
    if isinstance(value, pa.BinaryScalar | pa.LargeBinaryScalar) and not _is_text(value):
        return len(value.as_buffer()) if value.is_valid else None
    return None


def _items(value: Any, begin: int, count: int) -> list[tuple[str, Any]] | None:
    """Names and values of some fields, or elements with empty names; None of a plain value."""
    if _size(value) is None or begin < 0:
        return None
    if isinstance(value, Mapping):
        return [(str(name), item) for name, item in islice(value.items(), begin, begin + count)]
    if isinstance(value, pa.StructScalar):
        places = range(begin, min(begin + count, value.type.num_fields))
        return [(value.type.field(place).name, value[place]) for place in places]
    numbers = _numbers(value)
    if numbers is not None:
        return [("", item) for item in numbers[begin : begin + count]]
    elements = value if isinstance(value, list | tuple) else value.values
    return [("", elements[place]) for place in range(begin, min(begin + count, len(elements)))]


def _numbers(value: Any) -> Any:
    """The numbers of an array of nothing else, without a copy; None for other values."""
    if isinstance(value, bytes):
        return np.frombuffer(value, np.uint8)
    if isinstance(value, pa.BinaryScalar | pa.LargeBinaryScalar) and not _is_text(value):
        return np.frombuffer(value.as_buffer(), np.uint8)
    if isinstance(value, list | tuple):
        plain = bool(value) and all(_is_number(item) for item in value)
        return value if plain else None
    elements = getattr(value, "values", None)
    if isinstance(elements, pa.Array) and not elements.null_count:
        kind = elements.type
        if is_numeric(kind):
            return elements.to_numpy(zero_copy_only=not pa.types.is_boolean(kind))
    return None


def _is_number(value: object) -> bool:
    return isinstance(value, bool | int | float) and not hasattr(value, "kind")


def _texts(numbers: Any, begin: int, end: int) -> list[str]:
    return [_described(number)[1] for number in numbers[begin:end]]


def _array_type(value: Any) -> str:
    """Type of an array with its length; empty for an object."""
    size = _size(value)
    if isinstance(value, Mapping | pa.StructScalar):
        return ""
    if isinstance(value, bytes | pa.BinaryScalar | pa.LargeBinaryScalar):
        return f"bytes[{size}]"
    if isinstance(value, list | tuple):
        kinds = {_described(item)[0] for item in value[:MAX_SHOWN] if _size(item) is None}
        return f"{kinds.pop() if len(kinds) == 1 else ''}[{size}]"
    return f"{_type_name(value.values.type)}[{size}]"


def _is_text(value: Any) -> bool:
    return isinstance(value, pa.StringScalar | pa.LargeStringScalar)


def _type_name(kind: pa.DataType) -> str:
    if pa.types.is_timestamp(kind):
        return "time"
    if pa.types.is_nested(kind):
        return ""
    return {"float": "float32", "double": "float64"}.get(str(kind), str(kind).partition("[")[0])


def _described(value: Any) -> tuple[str, str]:
    """Type and text of a plain value."""
    if isinstance(value, pa.Scalar):
        return _of_arrow(value)
    kind = getattr(value, "kind", "")
    if kind in _INSTANTS:
        return kind, _INSTANTS[kind](int(value))
    if isinstance(value, np.generic):
        return value.dtype.name, _text(value)
    named = ((bool, "bool"), (int, "integer"), (float, "number"), (str, "string"))
    name = next((name for kind, name in named if isinstance(value, kind)), "")
    return name, _text(value)


def _of_arrow(value: pa.Scalar[Any]) -> tuple[str, str]:
    name = _type_name(value.type)
    if value.is_valid and name in _INSTANTS:
        return name, _INSTANTS[name](value.value)
    if value.is_valid and isinstance(value, pa.FloatScalar):
        return name, _text(np.float32(value.as_py()))
    return name, _text(value.as_py())


def _text(value: Any) -> str:
    """A text as it is, and of a number the shortest digits that give it back in its type."""
    if isinstance(value, str):
        return value
    if value is None:
        return "null"
    if isinstance(value, int) and abs(value) >= _LONGEST_INTEGER:
        return f"{value:#x}"  # Python refuses to write very long ones in decimal
    text = str(value)
    if isinstance(value, bool | np.bool_):
        return text.lower()
    return text.removesuffix(".0")


def _time(ns: int) -> str:
    return format_time(ns) if BEGIN <= ns <= END else _duration(ns)


def _duration(ns: int) -> str:
    whole, rest = divmod(abs(ns), 10**9)
    return f"{'-' if ns < 0 else ''}{whole}.{rest:09d}".rstrip("0").rstrip(".") + " s"


_INSTANTS: Final[Mapping[str, Callable[[int], str]]] = {"time": _time, "duration": _duration}
"""Texts of times and durations, ns."""
