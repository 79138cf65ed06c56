"""Types of the fields in a predicate, and the check of the predicate against them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, Literal

from hybridlog.query.predicate.tokens import error_at
from hybridlog.query.predicate.tree import (
    Compare,
    Condition,
    Exists,
    Field,
    Match,
    Member,
    Parts,
    Predicate,
    Value,
)
from hybridlog.schema.kinds import FLOATS, NUMBERS, TIMES
from hybridlog.wording import listed, meant
from hybridlog_storage.errors import WhereError

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
_VALUES: dict[str, Any] = {"bool": bool, "string": str, "number": int | float}
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


@dataclass(frozen=True, slots=True)
class FieldTypes:
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
        """The types as listed by a codec: path to type; None if they are unknown.

        Args:
            types: Path (dotted, with or without `[]` after arrays) to type as definitions
                write it: `float64`, `time`, `float32[]`, `uint8[9]`, `pkg/Type[]`.
        """
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
        names = [part for part in parts if isinstance(part, str)]
        path, parent = ".".join(names), ".".join(names[:-1])
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
        names = [part for part in (parts[:-1] if is_end else parts) if isinstance(part, str)]
        return self.base(".".join(names)) == "float32"

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
    checker = _Checker(predicate.text, FieldTypes.of(types))
    for condition in predicate.conditions():
        checker.check(condition)


class _Checker:
    def __init__(self, text: str, types: FieldTypes) -> None:
        self._text = text
        self._types = types

    def check(self, node: Condition) -> None:
        kind = self.check_name(node.field)
        if not isinstance(node, Exists):
            self._check_leaf(node.field)
        match node:
            case Compare(value=value, position=position):
                self._check_value(kind, node.field.names, value, position)
            case Member(values=values, position=position):
                for value in values:
                    self._check_value(kind, node.field.names, value, position)
            case Match(position=position) if kind not in {"string", "other"}:
                raise error_at(self._text, position, f"the field is a {kind}, not a string")
            case _:
                pass

    def check_name(self, target: Field) -> Kind:
        """Refuse a field that does not exist; the kind of one that does."""
        self._check_elements(target)
        types = self._types
        path = target.names
        if target.parts[0] == "_id":
            raise self._fail(target, "_id is no field; use _meta.t, _meta.rec and _meta.seq")
        if target.parts[0] != "_meta" and not types.known:
            return "other"
        if path in types.types:
            return types.kind(path)
        if types.statistic(target.parts) is not None:
            return "number"
        if path in types.inner or path in types.arrays:
            return "other"
        raise self._unknown(target, path)

    def _check_elements(self, target: Field) -> None:
        """Refuse an element that an array of fixed length does not have."""
        for place, part in enumerate(target.parts):
            before = ".".join(name for name in target.parts[:place] if isinstance(name, str))
            size = _FIXED.search(self._types.types.get(before, ""))
            if isinstance(part, int) and size and part >= int(size[1]):
                raise self._fail(target, f"{before} has {size[1]} elements, numbered from 0")

    def _check_leaf(self, target: Field) -> None:
        """Refuse a comparison with a message, which has fields and no value of its own."""
        path = target.names
        if path not in self._types.inner:
            return
        below = [name for name in self._types.types if name.startswith(f"{path}.")]
        leaves = [name for name in below if name not in self._types.inner]
        names = listed(leaves, _MAX_NAMES)
        raise self._fail(
            target, f"{path} is a message, not a value; ask for one of its fields: {names}"
        )

    def _check_value(self, kind: Kind, path: str, value: Value, position: int) -> None:
        if kind == "other" or value is None:
            return
        given = next(name for name, known in _VALUES.items() if isinstance(value, known))
        if given == "number" and kind == "time":
            self._check_time(value, self._types.base(path), position)
            return
        if given == kind:
            return
        hints = {
            "bool": "; write true or false",
            "time": '; write a time as t"2015-03-03T18:28:33Z", a duration as 5ms',
            "string": "; write it in quotes",
        }
        raise error_at(
            self._text,
            position,
            f"the field is a {kind}, the value is a {given}{hints.get(kind, '')}",
        )

    def _check_time(self, value: Value, kind: str, position: int) -> None:
        """Refuse a number without a unit that is seconds since 1970 rather than nanoseconds."""
        is_odd = kind != "duration" and _SECONDS <= value < _NANOSECONDS  # type: ignore[operator]
        if is_odd and (bare := _BARE.match(self._text, position)):
            raise error_at(
                self._text,
                position,
                f'a number is nanoseconds here; write t"{bare[0]}" for seconds since 1970, or '
                f't"{bare[0]}ns"',
            )

    def _unknown(self, target: Field, path: str) -> WhereError:
        known = self._types.types.keys() - ({} if path.startswith("_meta") else _META).keys()
        hint = f"did you mean {_COLUMNS[path]}?" if path in _COLUMNS else meant(path, known)
        return self._fail(target, f"there is no field {path}; {hint}")

    def _fail(self, target: Field, message: str) -> WhereError:
        return error_at(self._text, target.position, message)
