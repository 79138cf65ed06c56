"""The tree of a predicate, and its check against the types of the fields.

Nodes are immutable, hashable and picklable. Two nodes are equal if they have the same
meaning: their places in the text are ignored, and NaN equals NaN.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from functools import lru_cache
from typing import Any, Final, Literal, NamedTuple, TypeAlias, cast

from msgspec import Struct, field

from hybridlog.schema.definition_text import NUMBERS, TIMES
from hybridlog.wording import listed, meant
from hybridlog_storage.cache import lazy
from hybridlog_storage.errors import WhereError

Value: TypeAlias = bool | int | float | str
"""The operand of a comparison; times and durations are integer nanoseconds."""
Order = Literal["==", "!=", "<", "<=", ">", ">="]
Op: TypeAlias = Literal[Order, "in", "not in", "~", "!~", "exists", "missing"]
NEGATED: Final[dict[Op, Op]] = {"!=": "==", "not in": "in", "!~": "~"}
"""Operators that hold for a field that is there and does not satisfy another one."""


class _Node(Struct, frozen=True, eq=False):
    """Equality and hash of nodes, by what is shown of them: `1` is not `True`, NaN equals NaN."""

    def __repr__(self) -> str:
        names = [name for name in self.__struct_fields__ if name not in {"position", "text"}]
        shown = ", ".join(f"{name}={getattr(self, name)!r}" for name in names)
        return f"{type(self).__name__}({shown})"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Node) and repr(self) == repr(other)

    def __ne__(self, other: object) -> bool:
        return not self == other

    def __hash__(self) -> int:
        return hash(repr(self))


class Slice(NamedTuple):
    """Elements of an array; those that it does not have are left out.

    Attributes:
        begin: Number of the first element.
        end: Number of the element after the last one; None for all others.
    """

    begin: int
    end: int | None

    def __str__(self) -> str:
        return f"[{self.begin}:{'' if self.end is None else self.end}]"


Parts: TypeAlias = tuple[str | int | Slice, ...]
"""Names, numbers of elements, and slices."""


class Field(_Node, frozen=True, eq=False):
    """A field path.

    Attributes:
        parts: Names, ints for elements of arrays, slices.
        is_absolute: Without the signs of numbers, as `abs(x)`.
        position: Its place in the text.
    """

    parts: Parts
    is_absolute: bool = False
    position: int = 0

    @property
    def path(self) -> str:
        """The path as MongoDB writes it: `position.0`; it has no slices: `ranges.[0:9]`."""
        return ".".join(map(str, self.parts))

    @property
    def names(self) -> str:
        """The path without array indexes, as in the types of fields."""
        return ".".join(part for part in self.parts if isinstance(part, str))


class Condition(_Node, frozen=True, eq=False):
    """A condition on a field: `x < 5`, `x in [1, 2]`, `x ~ "^a"`, `x exists`.

    Attributes:
        operands: The value that it is compared with; of `in` several, of `exists` none; of `~` a
            pattern in RE2's syntax.
        other: The field that it is compared with, which must exist besides; None for operands.
        position: Place of the operands in the text.
    """

    field: Field
    op: Op
    operands: tuple[Value, ...] = ()
    other: Field | None = None
    position: int = 0


class And(_Node, frozen=True, eq=False):
    """All of the items hold; without items, always."""

    items: tuple[Node, ...]


class Or(_Node, frozen=True, eq=False):
    """One of the items holds."""

    items: tuple[Node, ...]


class Not(_Node, frozen=True, eq=False):
    """The item does not hold."""

    item: Node


class Near(_Node, frozen=True, eq=False):
    """A message of another topic near in time, as `Query.where` answers it.

    Attributes:
        topic: As written.
        item: What that message satisfies.
    """

    topic: str
    item: Node


class MongoFilter(_Node, frozen=True, eq=False):
    """A MongoDB filter, at the root of a predicate or in an `And` there.

    Attributes:
        filter: The filter in BSON.
        paths: The paths that it asks for, and whether for their values.
    """

    filter: bytes
    paths: tuple[tuple[str, bool], ...]

    def to_filter(self) -> dict[str, object]:
        """The filter as a new dictionary."""
        import bson

        return bson.decode(self.filter)

    @property
    def asks_fields(self) -> bool:
        """True if it is about fields of the message."""
        return not all(is_meta(path) or path.split(".")[0] == "_id" for path, _ in self.paths)


ALWAYS: Final = And(())
"""The condition that every message satisfies."""
Node: TypeAlias = Condition | And | Or | Not | Near | MongoFilter


class Predicate(_Node, frozen=True, eq=False, dict=True):
    """A predicate that was parsed and checked.

    Attributes:
        root: The tree.
        text: The text as written, to be shown.
    """

    root: Node
    text: str = ""

    def __bool__(self) -> bool:
        """True if it has any condition."""
        return self.root != ALWAYS

    def __and__(self, other: Predicate) -> Predicate:
        """Both predicates hold."""
        target = [each for each in (self, other) if each]
        if len(target) < 2:
            return target[0] if target else self
        items = [
            item
            for each in target
            for item in (each.root.items if isinstance(each.root, And) else (each.root,))
        ]
        return Predicate(And(tuple(items)), " and ".join(f"({each.text})" for each in target))

    def conditions(self) -> Iterator[Condition]:
        """Every single condition, from left to right."""
        return (node for node in nodes(self.root) if isinstance(node, Condition))

    def fields(self) -> list[str]:
        """The paths in the predicate, as MongoDB writes them, without duplicates."""
        return list(dict.fromkeys(condition.field.path for condition in self.conditions()))

    @lazy
    def asks_fields(self) -> bool:
        """True if it is about fields of the message, not only about `_meta`."""
        return not all(map(is_meta, self.fields())) or any(
            each.asks_fields for each in self.filters
        )

    @lazy
    def is_across(self) -> bool:
        """True if it has conditions on other topics."""
        return any(isinstance(node, Near) for node in nodes(self.root))

    @lazy
    def filters(self) -> tuple[MongoFilter, ...]:
        """The MongoDB filters in it."""
        return tuple(node for node in nodes(self.root) if isinstance(node, MongoFilter))


def is_meta(path: str) -> bool:
    """True if a path leads into `_meta`, which hybridlog adds to a message."""
    return path == "_meta" or path.startswith("_meta.")


def nodes(node: Node) -> Iterator[Node]:
    """All nodes of a tree but those of other topics, parents first, from left to right."""
    yield node
    match node:
        case And(items) | Or(items):
            for item in items:
                yield from nodes(item)
        case Not(item):
            yield from nodes(item)
        case _:
            pass


Stat = Literal["n", "min", "max", "mean"]
Kind = Literal["number", "string", "bool", "time", "other"]

STATS: dict[str, Stat] = {"n": "n", "min": "min", "max": "max", "mean": "mean"}
"""Names of the statistics in the summary of an array."""
_MAX_NAMES = 10
_ANY_ELEMENT = re.compile(r"\[\*?\]")
_FIXED = re.compile(r"\[([0-9]+)\]$")
_BARE = re.compile(r"[0-9][0-9.]*(?![\w.])")
_SECONDS, _NANOSECONDS = 10**8, 10**14
"""Numbers between are taken for seconds since 1970, or for milliseconds."""
_KINDS: dict[str, Kind] = {
    "bool": "bool",
    "boolean": "bool",
    "string": "string",
    **dict.fromkeys(TIMES, "time"),
    **dict.fromkeys({*NUMBERS, "number", "integer"}, "number"),
}
_VALUES: dict[Kind, Any] = {"bool": bool, "string": str, "number": int | float}
_CURES: dict[Kind, str] = {
    "bool": "; write true or false",
    "time": '; write a time as t"2015-03-03T18:28:33Z", a duration as 5ms',
    "string": "; write it in quotes",
}
_COLUMNS = {
    "log_time": "_meta.t",
    "t": "_meta.t",
    "publish_time": "_meta.pub",
    "seq": "_meta.seq",
    "topic": "_meta.topic",
}
"""Columns of tables that are no fields, and what predicates call them."""
_META = {
    "_meta.t": "time",
    "_meta.pub": "time",
    "_meta.rec": "string",
    "_meta.topic": "string",
    "_meta.seq": "int64",
}


class FieldTypes(Struct, frozen=True):
    """The types of the fields of a topic.

    Attributes:
        known: False if only `_meta.*` is known, as for JSON messages.
        types: Type of each path, without brackets for arrays in the path.
        arrays: Paths that are arrays.
        inner: Paths that have fields below them.
    """

    known: bool
    types: dict[str, str]
    arrays: set[str] = field(default_factory=set)
    inner: set[str] = field(default_factory=set)

    @staticmethod
    def of(types: FieldTypes | Mapping[str, str] | None) -> FieldTypes:
        """From types by path, as definitions write both: `a[].b`, `float32[9]`; None: unknown."""
        if isinstance(types, FieldTypes):
            return types
        return _listed(None if types is None else tuple(types.items()))

    def statistic(self, parts: Parts) -> Stat | None:
        """The statistic of an array that a path names; None if it names a field.

        If the types are unknown, the path may name either, and each message decides.
        """
        stat = STATS.get(str(parts[-1])) if len(parts) > 1 and parts[0] != "_meta" else None
        if stat is None or not self.known:
            return stat
        path, parent = Field(parts).names, Field(parts[:-1]).names
        if path in self.types or path in self.inner or parent not in self.arrays:
            return None
        numeric = _KINDS.get(self.base(parent)) in {"number", "bool", "time"}
        return stat if numeric or stat == "n" else None

    def base(self, path: str) -> str:
        """Type of a field, or of the elements of an array; empty for messages."""
        return self.types.get(path, "").split("[", 1)[0]

    def kind(self, path: str) -> Kind:
        """Kind of a field, or of the elements of an array."""
        return _KINDS.get(self.base(path), "other")

    def are_singles(self, parts: Parts) -> bool:
        """True if a field, the elements of an array, or its ends are of float32."""
        is_end = self.statistic(parts) in {"min", "max"}
        return self.base(Field(parts[:-1] if is_end else parts).names) == "float32"


@lru_cache(maxsize=64)
def _listed(types: tuple[tuple[str, str], ...] | None) -> FieldTypes:
    found = FieldTypes(types is not None, {})
    for written, kind in {**dict(types or ()), **_META}.items():
        parts = written.split(".")
        for count in range(1, len(parts) + 1):
            path = _ANY_ELEMENT.sub("", ".".join(parts[:count]))
            if _ANY_ELEMENT.search(parts[count - 1]):
                found.arrays.add(path)
            if count < len(parts):
                found.inner.add(path)
        path = _ANY_ELEMENT.sub("", written)
        found.types[path] = kind
        if kind.endswith("]") or kind == "bytes":
            found.arrays.add(path)
    return found


def check(predicate: Predicate, types: FieldTypes | Mapping[str, str] | None) -> None:
    """Refuse a predicate with unknown fields, or with comparisons of different kinds."""
    known = FieldTypes.of(types)
    for condition in predicate.conditions():
        target = condition.field
        for problem in _problems_of(target, known):
            raise error_at(predicate.text, target.position, problem)
        if condition.op in {"exists", "missing"}:
            continue
        if target.names in known.inner:
            below = (name for name in known.types if name.startswith(f"{target.names}."))
            names = listed((name for name in below if name not in known.inner), _MAX_NAMES)
            problem = (
                f"{target.names} is a message, not a value; ask for one of its fields: {names}"
            )
            raise error_at(predicate.text, target.position, problem)
        for problem in _problems(condition, known, predicate.text):
            raise error_at(predicate.text, condition.position, problem)


def _problems_of(target: Field, types: FieldTypes) -> Iterator[str]:
    """Reasons to refuse a field."""
    parts, path = target.parts, target.names
    for place, part in enumerate(parts):
        before = Field(parts[:place]).names
        size = _FIXED.search(types.types.get(before, ""))
        if isinstance(part, int) and size and part >= int(size[1]):
            yield f"{before} has {size[1]} elements, numbered from 0"
    if parts[0] == "_id":
        yield "_id is no field; use _meta.t, _meta.rec and _meta.seq"
    is_there = any(path in known for known in (types.types, types.inner, types.arrays))
    if is_there or types.statistic(parts) or not (types.known or parts[0] == "_meta"):
        return
    known = types.types.keys() - ({} if path.startswith("_meta") else _META).keys()
    hint = f"did you mean {_COLUMNS[path]}?" if path in _COLUMNS else meant(path, known)
    yield f"there is no field {path}; {hint}"


def _problems(node: Condition, types: FieldTypes, text: str) -> Iterator[str]:
    """Reasons to refuse what a field is compared with."""
    path = node.field.names
    is_statistic = types.known and path not in types.types and types.statistic(node.field.parts)
    kind = "number" if is_statistic else types.kind(path)
    if node.op in {"~", "!~"}:
        if kind not in {"string", "other"}:
            yield f"the field is a {kind}, not a string"
        return
    if node.field.is_absolute and kind not in {"number", "other"}:
        yield f"the field is a {kind}, and abs() is of numbers"
    if node.other is not None:
        kinds = {kind, types.kind(node.other.names)} - {"other"}
        if len(kinds) > 1 or not kinds <= {"number", "time"}:
            yield "only two numbers, or two times, can be compared (strings need quotes)"
        both = (node.field.parts, node.other.parts)
        paths = (Field(parts[: end + 1]).names for parts in both for end in range(len(parts)))
        is_absolute = node.field.is_absolute or node.other.is_absolute
        if is_absolute or not types.arrays.isdisjoint(paths):
            yield "fields that are compared are single values: no arrays, and no abs()"
    is_moment = kind == "time" and types.base(path) != "duration"
    for value in node.operands:
        if kind == "other":
            continue
        given = next(name for name, known in _VALUES.items() if isinstance(value, known))
        if given != kind and (kind, given) != ("time", "number"):
            yield f"the field is a {kind}, the value is a {given}{_CURES.get(kind, '')}"
        bare = _BARE.match(text, node.position)
        if is_moment and bare and _SECONDS <= cast(float, value) < _NANOSECONDS:
            yield (
                f'a number is nanoseconds here; write t"{bare[0]}" for seconds since 1970, or '
                f't"{bare[0]}ns"'
            )


def error_at(text: str, position: int, message: str) -> WhereError:
    """The error: the message, the line of the text, a caret under the place."""
    begin = text.rfind("\n", 0, position) + 1
    line = text[begin:].partition("\n")[0]
    # One column per character, without control characters.
    line = "".join(char if char.isprintable() else "?" for char in line)
    return WhereError(f"{message}\n  {line}\n  {' ' * (position - begin)}^")
