"""Types of the fields in a predicate, and the check of the predicate against them."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from functools import lru_cache
from typing import Any, Literal, cast

from msgspec import Struct, field

from hybridlog.query.predicate.parser import error_at
from hybridlog.query.predicate.tree import (
    Condition,
    Field,
    Parts,
    Predicate,
)
from hybridlog.schema.definition_text import FLOATS, NUMBERS, TIMES
from hybridlog.wording import listed, meant

Stat = Literal["n", "min", "max", "mean"]
Kind = Literal["number", "string", "bool", "time", "datetime", "other"]

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
    "date": "datetime",
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
    "_meta.inserted_at": "date",
    "_meta.t": "time",
    "_meta.pub": "time",
    "_meta.rec": "string",
    "_meta.topic": "string",
    "_meta.seq": "int64",
    "_meta.ref.seg": "int32",
    "_meta.ref.chunk": "int64",
    "_meta.ref.off": "int64",
    "_meta.ref.len": "int64",
    "_meta.error": "string",
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

    def are_floats(self, path: str) -> bool:
        """True if a field, or the elements of an array, are floating-point numbers."""
        return self.base(path) in FLOATS


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
