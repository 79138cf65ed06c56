"""A message as a tree of short texts, a part of it at a time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias

import numpy as np
import pyarrow as pa

from hybridlog.query.times import format_time
from hybridlog.schema.arrow_types import is_bytes, is_list, is_numeric
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

    The path is the place of a field or an element at each level; empty for the whole message. From
    its first element, field or character, `begin`, there are `count`, at most `MAX_SHOWN`; None for
    a few.
    """
    value: Any = message.content()
    for place in path:
        part = _part(value)
        if part.items is None or not 0 <= place < len(part.items):
            raise UsageError("The message has no such part.")
        value = part.items[place]
    if count is not None:
        count = min(max(count, 1), MAX_SHOWN)
    return _Walk().node(value, MAX_DEPTH, max(begin, 0), count)


class _Walk:
    """Makes the nodes of one answer; `nodes` says how many may still be made."""

    def __init__(self) -> None:
        self.nodes = MAX_NODES

    def node(self, value: Any, depth: int, begin: int = 0, count: int | None = None) -> Node:
        """The node of a value."""
        self.nodes -= 1
        part = _part(value)
        if part.items is None:
            shown = _cut(part.text[begin : begin + MAX_TEXT])
            is_cut = len(shown) < len(part.text)
            more = {"n": len(part.text), "begin": min(begin, len(part.text))} if is_cut else {}
            return {"type": part.type, "text": shown, **more}
        size, is_object = len(part.items), part.names is not None
        found: Node = {"type": part.type, "n": size, "begin": min(begin, size)}
        if count is None:
            count = MAX_SHOWN if is_object else _SHOWN[part.is_plain]
        places = range(begin, min(begin + count, size))
        if part.is_plain:
            found["texts"] = [_cut(_part(part.items[place]).text) for place in places]
            return found
        if depth <= 0 or self.nodes < min(count, size):
            return found
        self.nodes -= min(count, size)
        found["items"] = []
        for place in places:
            self.nodes += 1  # it was set aside, so that no level below can take it
            node = self.node(part.items[place], depth - 1)
            named = {} if part.names is None else {"name": _cut(part.names[place])}
            found["items"].append({**named, **node})
        return found


def _cut(text: str) -> str:
    # A lone surrogate, which JSON may have, is no text of a web page.
    return text[:MAX_TEXT].encode("utf-8", "replace").decode()


class _Part(NamedTuple):
    """A plain value as text, an object or an array.

    Attributes:
        type: Of an array, with its length; empty for an object.
        text: Of a plain value.
        items: The elements, or for objects the values; None for a plain value.
        names: Of the fields of an object.
        is_plain: An array of nothing but numbers.
    """

    type: str
    text: str = ""
    items: Any = None
    names: Sequence[str] | None = None
    is_plain: bool = False


def _part(value: Any) -> _Part:
    """The form of a value."""
    if isinstance(value, pa.Scalar):
        return _of_arrow(value)
    if isinstance(value, Mapping):
        return _Part("", items=[*value.values()], names=[*map(str, value)])
    if isinstance(value, bytes):
        return _Part(f"bytes[{len(value)}]", items=np.frombuffer(value, np.uint8), is_plain=True)
    if not isinstance(value, list | tuple):
        kind = getattr(value, "kind", "")
        if kind in _INSTANTS:
            return _Part(kind, _INSTANTS[kind](int(value)))
        kinds = ((bool, "bool"), (int, "integer"), (float, "number"), (str, "string"))
        plain = next((name for kind, name in kinds if isinstance(value, kind)), "")
        is_numpy = isinstance(value, np.generic)
        return _Part(value.dtype.name if is_numpy else plain, _text(value))
    simple = [v for v in value[:MAX_SHOWN] if not isinstance(v, Mapping | list | tuple | bytes)]
    kinds_found = {_part(one).type for one in simple}
    kind = kinds_found.pop() if len(kinds_found) == 1 else ""
    numeric = all(isinstance(v, bool | int | float) and not hasattr(v, "kind") for v in value)
    return _Part(f"{kind}[{len(value)}]", items=value, is_plain=bool(value) and numeric)


def _of_arrow(value: pa.Scalar[Any]) -> _Part:
    kind = value.type
    if value.is_valid and pa.types.is_struct(kind):
        return _Part("", items=value, names=[field.name for field in kind])
    if value.is_valid and is_bytes(kind):
        data = np.frombuffer(value.as_buffer(), np.uint8)
        return _Part(f"bytes[{len(data)}]", items=data, is_plain=True)
    if value.is_valid and is_list(kind):
        items: Any = value.values
        name, numeric = _type_name(items.type), is_numeric(items.type) and not items.null_count
        if numeric:
            items = items.to_numpy(zero_copy_only=not pa.types.is_boolean(items.type))
        return _Part(f"{name}[{len(items)}]", items=items, is_plain=numeric)
    name = _type_name(kind)
    if value.is_valid and name in _INSTANTS:
        return _Part(name, _INSTANTS[name](value.value))
    is_single = value.is_valid and pa.types.is_float32(kind)
    return _Part(name, _text(np.float32(value.as_py()) if is_single else value.as_py()))


def _type_name(kind: pa.DataType) -> str:
    if pa.types.is_timestamp(kind):
        return "time"
    if pa.types.is_nested(kind):
        return ""
    return {"float": "float32", "double": "float64"}.get(str(kind), str(kind).partition("[")[0])


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
