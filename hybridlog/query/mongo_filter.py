"""Predicates as MongoDB filters.

The values of index documents follow a fixed table (arrays are lists up to a limit and
summaries past it), so one condition of the language may need two forms in the filter.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Literal, TypeGuard

from hybridlog.query.tokens import error_at
from hybridlog.query.where import (
    And,
    Compare,
    Condition,
    Exists,
    Expression,
    Field,
    Match,
    Member,
    Node,
    Not,
    Or,
    Value,
)
from hybridlog_storage.errors import WhereError

Filter = dict[str, object]
Stat = Literal["n", "min", "max", "mean"]
_Kind = Literal["number", "string", "bool", "time", "date", "other"]

_OPERATORS = {"==": "$eq", "!=": "$ne", "<": "$lt", "<=": "$lte", ">": "$gt", ">=": "$gte"}
_EXTREMES = {"<": "min", "<=": "min", ">": "max", ">=": "max"}
"""The element of an array that satisfies an order if any does."""
_STATS: dict[str, Stat] = {"n": "n", "min": "min", "max": "max", "mean": "mean"}
_SHOWN = 10
_INF = float("inf")
_NULL: dict[str, object] = {"$type": "null"}
_NUMBER_TYPES = ["int", "long", "double", "bool"]  # booleans count as 0 and 1
_BOOLEANS = [
    {"case": {"$eq": ["$$b", True]}, "then": 1},
    {"case": {"$eq": ["$$b", False]}, "then": 0},
]
_ANY_ELEMENT = re.compile(r"\[\*?\]")

_KINDS: dict[str, _Kind] = {
    "bool": "bool",
    "boolean": "bool",
    "string": "string",
    "time": "time",
    "duration": "time",
    "date": "date",
    **dict.fromkeys(
        ("byte", "char", "octet", "int", "uint", "float", "double", "number", "integer"), "number"
    ),
    **dict.fromkeys(
        (f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)), "number"
    ),
    **dict.fromkeys(("float32", "float64"), "number"),
}
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


def to_filter(expression: Expression, field_types: Mapping[str, str] | None) -> Filter:
    """The MongoDB filter of a predicate.

    Args:
        expression: The parsed predicate.
        field_types: See `hybridlog.query.where.compile_filter`.

    Raises:
        WhereError: A field that does not exist, or a value that does not fit its type.
    """
    types = None if field_types is None else tuple(field_types.items())
    return _Compiler(expression.text, FieldTypes.of(types)).node(expression.root)


@dataclass(frozen=True, slots=True)
class FieldTypes:
    """What is known of the fields.

    Attributes:
        known: False when only `_meta.*` is known.
        types: Type of each path, without marks of arrays in the path.
        arrays: Paths that are arrays.
        inner: Paths that have fields below them.
    """

    known: bool
    types: dict[str, str]
    arrays: set[str] = field(default_factory=set)
    inner: set[str] = field(default_factory=set)

    @staticmethod
    @lru_cache(maxsize=64)
    def of(field_types: tuple[tuple[str, str], ...] | None) -> FieldTypes:
        """Of paths and their types, None when they are not known."""
        found = FieldTypes(field_types is not None, dict(_META))
        for written, kind in {**dict(field_types or ()), **_META}.items():
            parts = written.split(".")
            for count in range(1, len(parts) + 1):
                path = _ANY_ELEMENT.sub("", ".".join(parts[:count]))
                if _ANY_ELEMENT.search(parts[count - 1]):
                    found.arrays.add(path)
                if count < len(parts):
                    found.inner.add(path)
            path = _ANY_ELEMENT.sub("", written)
            found.types[path] = kind
            if kind.endswith("]"):
                found.arrays.add(path)
        return found

    def is_open(self, name: str) -> bool:
        """Whether anything may stand below a name of the top level."""
        return not self.known and name != "_meta"

    def statistic(self, parts: tuple[str | int, ...]) -> Stat | None:
        """The statistic of an array that a path asks for; None when it asks for a field.

        Where the types are not known it may be either, and each message decides.
        """
        names = [part for part in parts if isinstance(part, str)]
        stat = _STATS.get(str(parts[-1]))
        if stat is None or len(parts) < 2 or self.is_open(names[0]):
            return stat if len(parts) > 1 else None
        path, parent = ".".join(names), ".".join(names[:-1])
        if path in self.types or path in self.inner or parent not in self.arrays:
            return None
        numeric = _KINDS.get(self.base(parent)) in {"number", "bool", "time"}
        return stat if numeric or stat == "n" else None

    def base(self, path: str) -> str:
        """Type of the elements of an array; empty when they are messages."""
        return self.types.get(path, "").split("[", 1)[0]


@dataclass(frozen=True, slots=True)
class _Target:
    """What a path leads to.

    Attributes:
        kind: Kind of the values there.
        stat: Set when the path asks for the summary of an array.
        base: Type of that array's elements.
        array: Whether the path is an array of numbers, none of its elements.
        open: Whether the types are not known.
    """

    kind: _Kind
    stat: Stat | None = None
    base: str = ""
    array: bool = False
    open: bool = False


class _Compiler:
    def __init__(self, text: str, types: FieldTypes) -> None:
        self._text = text
        self._types = types

    def node(self, node: Node) -> Filter:
        match node:
            case And(items):
                return {"$and": [self.node(item) for item in items]}
            case Or(items):
                return {"$or": [self.node(item) for item in items]}
            case Not(item):
                return {"$nor": [self.node(item)]}
            case Compare() | Member() | Exists() | Match():
                return self._condition(node)

    def _condition(self, node: Condition) -> Filter:
        target = self._target(node.field)
        self._check(node, target)
        if target.open and _depends_on_the_value(node, target.stat):
            return self._of_anything(node, target.stat)
        if target.stat is not None:
            return self._of_summary(node, target.stat, target.base)
        return self._of_field(node, target)

    def _of_field(self, node: Condition, target: _Target) -> Filter:
        path = node.field.path
        match node:
            case Compare(order=order, value=value):
                test = _comparison(_OPERATORS[order], value)
                # A long array is there as its summary.
                extreme = _EXTREMES.get(order) if target.array else None
                paths = [path, f"{path}.{extreme}"] if extreme else [path]
                return _any_of([{p: test} for p in paths])
            case Member(values=values, negated=negated):
                return _membership(path, values, negated=negated)
            case Exists(present=present):
                return {path: {"$exists": present}}
            case Match(pattern=pattern, negated=False):
                return {path: {"$regex": pattern}}
            case Match(pattern=pattern):
                return {path: {"$not": {"$regex": pattern}, "$exists": True}}

    def _target(self, asked: Field) -> _Target:
        types = self._types
        names = [part for part in asked.parts if isinstance(part, str)]
        path = ".".join(names)
        if names[0] == "_id":
            raise self._fail(asked, "_id cannot be asked for; use _meta.t, _meta.rec and _meta.seq")
        stat = types.statistic(asked.parts)
        if types.is_open(names[0]):
            return _Target("other", stat, open=True)
        if path in types.types:
            kind = _KINDS.get(types.types[path].split("[", 1)[0], "other")
            numbers = kind in {"number", "time"} and types.types[path].endswith("]")
            return _Target(kind, array=numbers and isinstance(asked.parts[-1], str))
        if stat is not None:
            return _Target("number", stat, types.base(".".join(names[:-1])))
        if path in types.inner or path in types.arrays:
            return _Target("other")
        raise self._unknown(asked, path)

    def _check(self, node: Condition, target: _Target) -> None:
        if not isinstance(node, Exists):
            self._check_leaf(node.field)
        match node:
            case Compare(value=value, position=position):
                self._check_value(target, value, position)
            case Member(values=values, position=position):
                for value in values:
                    self._check_value(target, value, position)
            case Match(position=position) if target.kind not in {"string", "other"}:
                raise error_at(self._text, position, f"the field is a {target.kind}, not a string")
            case _:
                pass

    def _check_leaf(self, asked: Field) -> None:
        """Refuse a comparison with a message, which has fields and no value of its own."""
        path = ".".join(part for part in asked.parts if isinstance(part, str))
        if path not in self._types.inner:
            return
        below = [name for name in self._types.types if name.startswith(f"{path}.")]
        leaves = [name for name in below if name not in self._types.inner]
        names = ", ".join(leaves[:_SHOWN]) + (" …" if len(leaves) > _SHOWN else "")
        raise self._fail(
            asked, f"{path} is a message, not a value; ask for one of its fields: {names}"
        )

    def _check_value(self, target: _Target, value: Value, position: int) -> None:
        kind = target.kind
        if kind == "date":
            raise error_at(
                self._text, position, "_meta.inserted_at has milliseconds only; ask for _meta.t"
            )
        if kind == "other" or value is None:
            return
        if isinstance(value, bool):
            given = "bool"
        elif isinstance(value, str):
            given = "string"
        else:
            given = "number"
        if given == kind or (given == "number" and kind == "time"):
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

    def _of_summary(self, node: Condition, stat: Stat, base: str) -> Filter:
        """A condition on an array's summary, or on what it would be for a short array."""
        array = Field(node.field.parts[:-1])
        there: Filter = {
            "$or": [{node.field.path: {"$exists": True}}, {array.path: {"$type": "array"}}]
        }
        match node:
            case Exists(present=present):
                return there if present else {"$nor": [there]}
            case Compare(order="!=", value=value):
                same = self._either(node.field, stat, base, "$eq", value)
                return {"$and": [there, {"$nor": [same]}]}
            case Compare(order=order, value=value):
                return self._either(node.field, stat, base, _OPERATORS[order], value)
            case Member(values=values, negated=negated):
                one: Filter = {
                    "$or": [self._either(node.field, stat, base, "$eq", value) for value in values]
                }
                return {"$and": [there, {"$nor": [one]}]} if negated else one
            case Match(position=position):  # `_check` has refused it; numbers have no pattern
                raise error_at(self._text, position, "the field is a number, not a string")

    def _of_anything(self, node: Condition, stat: Stat | None) -> Filter:
        """A condition on a path of which no type is known: each document decides."""
        asked = node.field
        there: Filter = {asked.path: {"$exists": True}}
        if stat is not None:
            there = {"$or": [there, {"$expr": _anywhere(asked.parts[:-1], _Counted(stat))}]}
        match node:
            case Exists(present=present):
                return there if present else {"$nor": [there]}
            case Compare(order="!=", value=value):
                return {"$and": [there, {"$nor": [_open_test(asked, stat, "==", value)]}]}
            case Compare(order=order, value=value):
                return _open_test(asked, stat, order, value)
            case Member(values=values, negated=negated):
                one = _any_of([_open_test(asked, stat, "==", value) for value in values])
                return {"$and": [there, {"$nor": [one]}]} if negated else one
            case Match(pattern=pattern, negated=negated):
                found = _at_element(asked, {"$regex": pattern})
                return {"$and": [there, {"$nor": [found]}]} if negated else found

    def _either(self, asked: Field, stat: Stat, base: str, operator: str, value: Value) -> Filter:
        summary: Filter = {asked.path: _comparison(operator, value)}
        if _is_nan(value):
            return summary  # summaries are over finite numbers, lists need not be read
        test = _Test(stat, base, operator, value)
        return {"$or": [summary, {"$expr": self._reach(asked.parts[:-1], test)}]}

    def _reach(self, parts: tuple[str | int, ...], test: _Test) -> object:
        """An aggregation expression: whether the test holds of any value at the path."""
        return self._step("", parts, (), test)

    def _step(
        self, here: str, parts: tuple[str | int, ...], seen: tuple[str, ...], test: _Test
    ) -> object:
        # `here` is "", "$a.b" or "$$v.b"; `seen` are the names passed so far.
        for index, part in enumerate(parts):
            rest = parts[index + 1 :]
            if isinstance(part, int):
                variable = f"e{len(seen)}x{index}"
                element = {"$cond": [{"$isArray": [here]}, {"$arrayElemAt": [here, part]}, None]}
                inner = self._step(f"$${variable}", rest, seen, test)
                return {"$let": {"vars": {variable: element}, "in": inner}}
            here = f"{here}.{part}" if here else f"${part}"
            seen = (*seen, part)
            is_array = ".".join(seen) in self._types.arrays
            if rest and is_array and not isinstance(rest[0], int):
                variable = f"m{len(seen)}"
                mapped = {
                    "$map": {
                        "input": {"$cond": [{"$isArray": [here]}, here, []]},
                        "as": variable,
                        "in": self._step(f"$${variable}", rest, seen, test),
                    }
                }
                return {"$anyElementTrue": [mapped]}
        return test.on(here)

    def _unknown(self, asked: Field, path: str) -> WhereError:
        known = sorted(set(self._types.types) - ({} if path.startswith("_meta") else _META).keys())
        lowered = {name.lower(): name for name in known}
        near = [name for name in known if name.rsplit(".", 1)[-1] == path.rsplit(".", 1)[-1]]
        near += [
            lowered[key]
            for key in difflib.get_close_matches(path.lower(), lowered, n=_SHOWN, cutoff=0.5)
        ]
        shown = list(dict.fromkeys(near or known))
        names = ", ".join(shown[:_SHOWN]) + (" …" if len(shown) > _SHOWN else "")
        hint = f"; did you mean {names}?" if near else f"; there are {names}" if names else ""
        return self._fail(asked, f"there is no field {path}{hint}")

    def _fail(self, asked: Field, message: str) -> WhereError:
        return error_at(self._text, asked.position, message)


@dataclass(frozen=True, slots=True)
class _Test:
    """A comparison of a statistic of a short array.

    Attributes:
        stat: The statistic.
        base: Type of the elements; `any` when it is not known.
        operator: Aggregation operator.
        value: What to compare with.
    """

    stat: Stat
    base: str
    operator: str
    value: Value

    def on(self, here: str) -> object:
        """The aggregation expression for the value at `here`; false when it is no list."""
        compared: object = {self.operator: ["$$s", {"$literal": self.value}]}
        if self.operator != "$eq":
            # In aggregation null is less than every number.
            compared = {"$and": [{"$ne": ["$$s", None]}, compared]}
        statistic = {"$let": {"vars": {"s": self._statistic(here)}, "in": compared}}
        return {"$cond": [{"$isArray": [here]}, statistic, False]}

    def _statistic(self, here: str) -> object:
        if self.stat == "n":
            return {"$size": here}
        numbers: object = here
        if self.base == "any" or _KINDS.get(self.base) == "bool":
            number = {"$switch": {"branches": _BOOLEANS, "default": "$$b"}}
            numbers = {"$map": {"input": here, "as": "b", "in": number}}
        finite = {
            "$filter": {
                "input": numbers,
                "as": "v",
                # NaN sorts before -inf, everything that is no number after inf.
                "cond": {"$and": [{"$gt": ["$$v", -_INF]}, {"$lt": ["$$v", _INF]}]},
            }
        }
        operator = {"min": "$min", "max": "$max", "mean": "$avg"}[self.stat]
        return {operator: finite}


@dataclass(frozen=True, slots=True)
class _Counted:
    """Whether a value is a list that has a statistic, and no field of that name.

    Attributes:
        stat: The statistic.
        test: What must hold of it; None when nothing must.
    """

    stat: Stat
    test: _Test | None = None

    def on(self, here: str) -> object:
        """The aggregation expression for the value at `here`."""
        each: object = {"$in": [{"$type": "$$e"}, _NUMBER_TYPES]}
        if self.stat == "n":
            named = {"$ne": [{"$type": f"$$e.{self.stat}"}, "missing"]}
            each = {"$not": [{"$and": [{"$eq": [{"$type": "$$e"}, "object"]}, named]}]}
        fits = {"$allElementsTrue": [{"$map": {"input": here, "as": "e", "in": each}}]}
        found: object = fits if self.test is None else {"$and": [fits, self.test.on(here)]}
        return {"$cond": [{"$isArray": [here]}, found, False]}


@dataclass(frozen=True, slots=True)
class _Extreme:
    """Whether a value is the summary of a long array of which an element is in order.

    Attributes:
        end: The element that is in order if any is.
        operator: Aggregation operator.
        value: What to compare with.
    """

    end: str
    operator: str
    value: float

    def on(self, here: str) -> object:
        """The aggregation expression for the value at `here`."""
        end = f"{here}.{self.end}"
        whole = [{"$ne": [{"$type": f"{here}.{name}"}, "missing"]} for name in _STATS]
        return {
            "$and": [
                {"$eq": [{"$type": here}, "object"]},
                *whole,
                {"$in": [{"$type": end}, _NUMBER_TYPES]},
                {"$gte": [end, -_INF]},  # NaN sorts before it
                {self.operator: [end, {"$literal": self.value}]},
            ]
        }


def _depends_on_the_value(node: Condition, stat: Stat | None) -> bool:
    """Whether a condition on a path without types means more than one thing."""
    if stat is not None or isinstance(node.field.parts[-1], int):
        return True
    return isinstance(node, Compare) and node.order in _EXTREMES and _is_number(node.value)


def _open_test(asked: Field, stat: Stat | None, order: str, value: Value) -> Filter:
    """A comparison with whatever a path leads to: values, elements, summaries."""
    operator = _OPERATORS[order]
    found = [_at_element(asked, _comparison(operator, value))]
    if _is_number(value) and order in _EXTREMES:
        end = _EXTREMES[order]
        exact = {"$expr": _anywhere(asked.parts, _Extreme(end, operator, value))}
        # The first condition is cheap, and few documents satisfy it.
        found.append({"$and": [{f"{asked.path}.{end}": {operator: value}}, exact]})
    if stat is not None and not _is_nan(value) and (_is_number(value) or value is None):
        test = _Counted(stat, _Test(stat, "any", operator, value))
        found.append({"$expr": _anywhere(asked.parts[:-1], test)})
    return _any_of(found)


def _at_element(asked: Field, test: Filter) -> Filter:
    """A condition on a value, or on any element of it.

    MongoDB looks into an array that a name leads to, but not into one that is itself an
    element.
    """
    found: Filter = {asked.path: test}
    if isinstance(asked.parts[-1], str):
        return found
    return {"$or": [found, {asked.path: {"$elemMatch": test}}]}


def _anywhere(parts: tuple[str | int, ...], test: _Counted | _Extreme) -> object:
    """An aggregation expression: whether a test holds of any value that a path leads to.

    Any value on the way may be an array.
    """
    return _further(f"${parts[0]}", parts[1:], test, 0)


def _further(
    here: str, parts: tuple[str | int, ...], test: _Counted | _Extreme, depth: int
) -> object:
    if not parts:
        return test.on(here)
    part, rest, variable = parts[0], parts[1:], f"v{depth}"
    if isinstance(part, int):
        element = {"$cond": [{"$isArray": [here]}, {"$arrayElemAt": [here, part]}, None]}
        inner = _further(f"$${variable}", rest, test, depth + 1)
        return {"$let": {"vars": {variable: element}, "in": inner}}
    inner = _further(f"$${variable}.{part}", rest, test, depth + 1)
    is_object = {"$eq": [{"$type": f"$${variable}"}, "object"]}
    values = {"$cond": [{"$isArray": [here]}, here, [here]]}
    each = {"$cond": [is_object, inner, False]}
    return {"$anyElementTrue": [{"$map": {"input": values, "as": variable, "in": each}}]}


def _any_of(filters: list[Filter]) -> Filter:
    return filters[0] if len(filters) == 1 else {"$or": filters}


def _comparison(operator: str, value: Value) -> Filter:
    # MongoDB's own equality with null is true of missing fields too, `$ne` as well.
    if value is None:
        return _NULL if operator == "$eq" else {"$exists": True, "$not": _NULL}
    if operator == "$ne":
        return {"$ne": value, "$exists": True}
    return {operator: value}


def _membership(path: str, values: tuple[Value, ...], *, negated: bool) -> Filter:
    others = [value for value in values if value is not None]
    if len(others) == len(values):
        return {path: {"$nin": others, "$exists": True} if negated else {"$in": others}}
    if negated:
        return {path: {"$nin": others, "$exists": True, "$not": _NULL}}
    return {"$or": [{path: _NULL}, {path: {"$in": others}}]}


def _is_number(value: Value) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_nan(value: Value) -> bool:
    return isinstance(value, float) and value != value  # noqa: PLR0124
