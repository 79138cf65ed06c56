"""Predicates from MongoDB filters that a user wrote.

Only operators that compare values are allowed. Operators that run code on the server
(`$where`, `$function`, `$accumulator`), read other data or are unknown are refused. Values
with code in them are refused, too. Conditions that the language has become the same tree as
its text; the rest remains a filter that only MongoDB answers. Patterns have RE2's syntax,
and are allowed where the language has them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from datetime import datetime
from typing import TypeGuard

from hybridlog.query.predicate.numbers import HIGH, LOW, is_nan
from hybridlog.query.predicate.regex import RegexError, compile_regex
from hybridlog.query.predicate.tree import (
    And,
    Compare,
    Exists,
    Field,
    Match,
    Member,
    Node,
    Not,
    Opaque,
    Or,
    Order,
    Predicate,
    Value,
    frozen,
)
from hybridlog_storage.errors import WhereError

MAX_DEPTH = 100
"""Deepest nesting; MongoDB itself takes up to 180 levels."""
MAX_NODES = 20_000
"""Maximum number of keys and values in total."""
MAX_CHARACTERS = 1_000_000
"""Maximum number of characters in all keys and strings."""

_ORDERS: dict[str, Order] = {"$lt": "<", "$lte": "<=", "$gt": ">", "$gte": ">="}
_LOGICAL = {"$and", "$or", "$nor"}
_LITERAL = {"$eq", "$ne", "$gt", "$gte", "$lt", "$lte"}
_LISTS = {"$in", "$nin", "$all"}
_PLAIN = {
    "$exists",
    "$type",
    "$size",
    "$mod",
    "$bitsAllSet",
    "$bitsAllClear",
    "$bitsAnySet",
    "$bitsAnyClear",
}
_EXPRESSIONS = frozenset(
    {
        # comparison and logic
        *("$eq", "$ne", "$gt", "$gte", "$lt", "$lte", "$cmp", "$and", "$or", "$not"),
        *("$cond", "$ifNull", "$switch"),
        # numbers
        *("$abs", "$add", "$ceil", "$divide", "$exp", "$floor", "$ln", "$log", "$log10", "$mod"),
        *("$multiply", "$pow", "$round", "$sqrt", "$subtract", "$trunc"),
        *("$sin", "$cos", "$tan", "$asin", "$acos", "$atan", "$atan2"),
        *("$degreesToRadians", "$radiansToDegrees"),
        # arrays; no operator makes one longer than its input
        *("$allElementsTrue", "$anyElementTrue", "$arrayElemAt", "$filter", "$first", "$last"),
        *("$in", "$indexOfArray", "$isArray", "$map", "$size", "$slice"),
        *("$avg", "$max", "$min", "$sum", "$stdDevPop", "$stdDevSamp"),
        # strings
        *("$indexOfBytes", "$indexOfCP", "$strcasecmp", "$strLenBytes", "$strLenCP"),
        *("$substrBytes", "$substrCP", "$toLower", "$toUpper", "$trim", "$ltrim", "$rtrim"),
        # types
        *("$convert", "$isNumber", "$toBool", "$toDate", "$toDouble", "$toInt", "$toLong"),
        *("$toString", "$type"),
        # values
        *("$getField", "$let", "$literal"),
    }
)
_OPTIONS = set("ims")
_BSON_VALUES = {"ObjectId", "Decimal128", "Timestamp", "MinKey", "MaxKey"}


def from_mongo(query: Mapping[str, object]) -> Predicate:
    """The predicate that is equivalent to a filter.

    Numpy scalars become Python numbers, tuples become lists, compiled patterns become `$regex`.

    Args:
        query: A filter as `pymongo` takes it.

    Raises:
        WhereError: a part is not allowed; the message has its place.
    """
    if not isinstance(query, Mapping):
        raise WhereError(f"a filter is a mapping, not {type(query).__name__}")
    root = _Reader().query(query, (), 0)
    return Predicate(root, str(query))


_Path = tuple[str, ...]


class _Reader:
    def __init__(self) -> None:
        self._nodes = 0
        self._characters = 0

    def query(self, query: Mapping[str, object], path: _Path, depth: int) -> Node:
        found: list[Node] = []
        for key, value in self._items(query, path, depth):
            inner = (*path, key)
            if key in _LOGICAL:
                found.append(self._joined(key, value, inner, depth))
            elif key == "$expr":
                found.append(_opaque({key: self._expression(value, inner, depth + 1)}, inner))
            elif key == "$comment":
                self._literal(value, inner, depth + 1)
            elif key.startswith("$"):
                raise _refused(inner, "the operator is not allowed here")
            else:
                found.append(self._condition(key, value, inner, depth + 1))
        return found[0] if len(found) == 1 else And(tuple(found))

    def _joined(self, operator: str, value: object, path: _Path, depth: int) -> Node:
        if not isinstance(value, list | tuple) or not value:
            raise _refused(path, "needs a list of filters")
        items = tuple(self.query(_mapping(item, path), path, depth + 1) for item in value)
        if operator == "$and":
            return items[0] if len(items) == 1 else And(items)
        either = items[0] if len(items) == 1 else Or(items)
        return Not(either) if operator == "$nor" else either

    def _condition(self, name: str, value: object, path: _Path, depth: int) -> Node:
        if isinstance(value, Mapping) and _has_operators(value, path):
            return self._operators(name, value, path, depth)
        if _is_pattern(value):
            return self._pattern(name, value, path)
        plain = self._literal(value, path, depth)
        return _comparison(name, "$eq", plain) or _opaque({name: plain}, path)

    def _operators(
        self, name: str, operators: Mapping[str, object], path: _Path, depth: int
    ) -> Node:
        found: list[Node] = []
        for key, value in self._items(operators, path, depth):
            inner = (*path, key)
            if key == "$not":
                found.append(Not(self._not(name, value, inner, depth)))
            elif key == "$regex":
                options = operators.get("$options", "")
                found.append(self._regex(name, value, options, inner))
            elif key != "$options" or "$regex" not in operators:
                operand = self._operand(key, value, inner, depth)
                node = _comparison(name, key, operand)
                found.append(_opaque({name: {key: operand}}, inner) if node is None else node)
        return found[0] if len(found) == 1 else And(tuple(found))

    def _operand(self, operator: str, value: object, path: _Path, depth: int) -> object:
        """The operand of an operator, in plain Python values."""
        if operator in _LITERAL or operator in _PLAIN:
            return self._literal(value, path, depth + 1)
        if operator in _LISTS:
            return self._members(value, path, depth)
        if operator == "$elemMatch":
            return self._element(value, path, depth)
        raise _refused(path, "the operator is not allowed here")

    def _members(self, value: object, path: _Path, depth: int) -> list[object]:
        if not isinstance(value, list | tuple):
            raise _refused(path, "needs a list")
        members: list[object] = []
        for item in value:
            if path[-1] == "$all" and isinstance(item, Mapping) and set(item) == {"$elemMatch"}:
                inner = (*path, "$elemMatch")
                members.append({"$elemMatch": self._element(item["$elemMatch"], inner, depth + 1)})
            else:
                members.append(self._literal(item, path, depth + 1))
        return members

    def _not(self, name: str, value: object, path: _Path, depth: int) -> Node:
        if _is_pattern(value):
            return self._pattern(name, value, path)
        inner = _mapping(value, path)
        if not inner or not all(isinstance(key, str) and key[:1] == "$" for key in inner):
            raise _refused(path, "needs operators")
        return self._operators(name, inner, path, depth + 1)

    def _element(self, value: object, path: _Path, depth: int) -> dict[str, object]:
        """The condition on an element, as a filter: only MongoDB can answer it."""
        inner = _mapping(value, path)
        keys = [key for key in inner if isinstance(key, str) and key.startswith("$")]
        if keys and not set(keys) & _LOGICAL:
            return self._plain_operators(inner, path, depth + 1)
        if "$expr" in inner:
            raise _refused((*path, "$expr"), "the operator is not allowed here")
        return self._plain_query(inner, path, depth + 1)

    def _plain_query(
        self, query: Mapping[str, object], path: _Path, depth: int
    ) -> dict[str, object]:
        found: dict[str, object] = {}
        for key, value in self._items(query, path, depth):
            inner = (*path, key)
            if key in _LOGICAL:
                if not isinstance(value, list | tuple) or not value:
                    raise _refused(inner, "needs a list of filters")
                found[key] = [
                    self._plain_query(_mapping(item, inner), inner, depth + 1) for item in value
                ]
            elif key.startswith("$"):
                raise _refused(inner, "the operator is not allowed here")
            elif isinstance(value, Mapping) and _has_operators(value, inner):
                found[key] = self._plain_operators(value, inner, depth + 1)
            else:
                found[key] = self._literal(value, inner, depth + 1)
        return found

    def _plain_operators(
        self, operators: Mapping[str, object], path: _Path, depth: int
    ) -> dict[str, object]:
        found: dict[str, object] = {}
        for key, value in self._items(operators, path, depth):
            inner = (*path, key)
            if key == "$not":
                nested = _mapping(value, inner)
                if not nested:
                    raise _refused(inner, "needs operators")
                found[key] = self._plain_operators(nested, inner, depth + 1)
            elif key in {"$regex", "$options"}:
                raise _refused(inner, "patterns are not allowed within $elemMatch")
            else:
                found[key] = self._operand(key, value, inner, depth)
        return found

    def _pattern(self, name: str, value: object, path: _Path) -> Node:
        pattern, flags = getattr(value, "pattern", None), getattr(value, "flags", 0)
        if not isinstance(flags, int):
            raise _refused(path, "has flags that are not understood")
        table = {re.IGNORECASE: "i", re.MULTILINE: "m", re.DOTALL: "s"}
        options = "".join(letter for flag, letter in table.items() if flags & flag)
        if flags & ~(re.IGNORECASE | re.MULTILINE | re.DOTALL | re.UNICODE):
            raise _refused(path, "may have the flags i, m and s only")
        return self._regex(name, pattern, options, path)

    def _regex(self, name: str, value: object, options: object, path: _Path) -> Node:
        if _is_pattern(value):
            if options:
                raise _refused(path, "has options twice")
            return self._pattern(name, value, path)
        if not isinstance(value, str):
            raise _refused(path, "needs a string")
        if not isinstance(options, str) or not set(options) <= _OPTIONS:
            raise _refused(path, "may have the options i, m and s only")
        self._count(path, len(value))
        flags = "".join(sorted(set(options)))
        pattern = f"(?{flags}){value}" if flags else str(value)
        try:
            compile_regex(pattern)
        except RegexError as error:
            raise _refused(path, f"the pattern is refused: {error}") from None
        target = _field(name)
        if target is None:
            raise _refused(path, "a pattern needs a field of a message")
        return Match(target, pattern, negated=False)

    def _expression(self, value: object, path: _Path, depth: int) -> object:
        """An aggregation expression."""
        if isinstance(value, list | tuple):
            self._enter(path, depth)
            return [self._expression(item, path, depth + 1) for item in value]
        if not isinstance(value, Mapping):
            return self._literal(value, path, depth)
        items = self._items(value, path, depth)
        operators = [key for key, _ in items if key.startswith("$")]
        if operators and len(items) != 1:
            raise _refused(path, "an expression has one operator")
        checked: dict[str, object] = {}
        for key, inner in items:
            place = (*path, key)
            if key.startswith("$") and key not in _EXPRESSIONS:
                raise _refused(place, "the operator is not allowed here")
            check = self._literal if key == "$literal" else self._expression
            checked[key] = check(inner, place, depth + 1)
        return checked

    def _literal(self, value: object, path: _Path, depth: int) -> object:
        """A value to compare with; no operator has a meaning in it."""
        if isinstance(value, Mapping):
            checked: dict[str, object] = {}
            for key, item in self._items(value, path, depth):
                if key.startswith("$"):
                    raise _refused((*path, key), "the operator is not allowed here")
                checked[key] = self._literal(item, (*path, key), depth + 1)
            return checked
        if isinstance(value, list | tuple):
            self._enter(path, depth)
            return [self._literal(item, path, depth + 1) for item in value]
        self._count(path, len(value) if isinstance(value, str | bytes) else 0)
        return _scalar(value, path)

    def _items(
        self, value: Mapping[str, object], path: _Path, depth: int
    ) -> list[tuple[str, object]]:
        self._enter(path, depth)
        items: list[tuple[str, object]] = []
        for key, item in value.items():
            if not isinstance(key, str):
                raise _refused(path, f"has a key that is no string: {key!r}")
            try:
                plain = _plain_text(key)
            except ValueError:
                raise _refused(path, "has a name that is not valid Unicode") from None
            if "\0" in plain:
                raise _refused(path, "has a name with a NUL character")
            self._count(path, len(plain))
            items.append((plain, item))
        return items

    def _enter(self, path: _Path, depth: int) -> None:
        if depth > MAX_DEPTH:
            raise _refused(path[:3], f"is nested deeper than {MAX_DEPTH}")

    def _count(self, path: _Path, characters: int) -> None:
        self._nodes += 1
        self._characters += characters
        if self._nodes > MAX_NODES or self._characters > MAX_CHARACTERS:
            raise _refused(path[:3], "the filter is too large")


def _scalar(value: object, path: _Path) -> object:
    for test, make in _SCALARS:
        if test(value):
            try:
                return make(value)
            except (OverflowError, ValueError, TypeError) as error:
                raise _refused(path, str(error)) from None
    raise _refused(path, f"a value of type {type(value).__name__} is not allowed")


def _is_bson(value: object) -> bool:
    return type(value).__module__.split(".")[0] == "bson"


def _plain_number(value: object) -> object:
    """A numpy scalar or an int as a Python number that BSON can hold."""
    if getattr(value, "shape", ()) != ():
        raise TypeError(f"a value of type {type(value).__name__} is not allowed")
    number = value.item() if hasattr(value, "item") else value
    if not isinstance(number, bool | int | float | None):
        raise TypeError(f"a value of type {type(value).__name__} is not allowed")
    return float(number) if isinstance(number, float) else number


def _plain_text(value: object) -> str:
    text = str(value)
    text.encode()  # half a surrogate pair raises a ValueError
    return text


def _plain_date(value: object) -> object:
    convert = getattr(value, "to_pydatetime", None)  # pandas.Timestamp
    moment = convert() if convert is not None else value
    if not isinstance(moment, datetime) or not isinstance(moment.year, int):
        raise TypeError("is not a date")
    if math.isnan(moment.timestamp()):
        raise ValueError("is not a date")
    return moment


_SCALARS: tuple[tuple[Callable[[object], bool], Callable[[object], object]], ...] = (
    (lambda value: value is None or isinstance(value, bool), lambda value: value),
    # bson.code.Code is a str, so its module is tested first.
    (
        lambda value: _is_bson(value) and type(value).__name__ in _BSON_VALUES | {"Int64"},
        lambda value: value,
    ),
    (
        lambda value: isinstance(value, bytes) and type(value).__name__ != "Code",
        lambda value: value,
    ),
    (lambda value: isinstance(value, str) and not _is_bson(value), _plain_text),
    (lambda value: isinstance(value, datetime), _plain_date),
    (
        lambda value: (
            not _is_bson(value)
            and (isinstance(value, int | float) or type(value).__module__ == "numpy")
        ),
        _plain_number,
    ),
)


def _comparison(name: str, operator: str, operand: object) -> Node | None:
    """A condition as a node of the language; None if the language has no equivalent.

    MongoDB's equality with null also finds missing fields, and MongoDB orders values that
    have no order in the language.
    """
    target = _field(name)
    if target is None:
        return None
    if isinstance(operand, int) and not isinstance(operand, bool):
        operand = int(operand)  # also converts an Int64 of BSON
    if operator in {"$in", "$nin"} and isinstance(operand, list):
        values = tuple(value for value in operand if _is_value(value))
        member = Member(target, values, negated=False) if len(values) == len(operand) else None
        return member if operator == "$in" or member is None else Not(member)
    if operator == "$exists" and isinstance(operand, bool):
        return Exists(target, present=operand)
    if not _is_value(operand):
        return None
    if operator in {"$eq", "$ne"}:
        same = Compare(target, "==", operand)
        return same if operator == "$eq" else Not(same)
    order = _ORDERS.get(operator)
    is_ordered = not isinstance(operand, bool) and not is_nan(operand)
    return Compare(target, order, operand) if order is not None and is_ordered else None


def _is_value(operand: object) -> TypeGuard[Value]:
    """True if an operand has the same meaning for MongoDB and in the language."""
    return type(operand) in {bool, int, float, str}


def _field(name: str) -> Field | None:
    """The field of a path; None if only MongoDB understands it."""
    parts = name.split(".")
    if not all(parts) or parts[0] == "_id" or name == "_meta.inserted_at":
        return None
    return Field((parts[0], *map(_place_or_name, parts[1:])))


def _place_or_name(part: str) -> str | int:
    is_place = part.isascii() and part.isdecimal() and str(int(part[:9])) == part
    return int(part) if is_place else part


def _opaque(query: dict[str, object], path: _Path) -> Opaque:
    _check_width(query, path)
    return Opaque(frozen(query))


def _check_width(value: object, path: _Path) -> None:
    """Refuse integers that MongoDB cannot hold."""
    if isinstance(value, Mapping):
        for inner in value.values():
            _check_width(inner, path)
    elif isinstance(value, list):
        for inner in value:
            _check_width(inner, path)
    elif isinstance(value, int) and not LOW <= value <= HIGH:
        raise _refused(path, f"{value} does not fit into 64 bits; write it as a float")


def _has_operators(value: Mapping[str, object], path: _Path) -> bool:
    """True if a mapping has operators as keys, not names."""
    marked = [isinstance(key, str) and key.startswith("$") for key in value]
    if any(marked) and not all(marked):
        raise _refused(path, "mixes operators and names")
    return any(marked)


def _is_pattern(value: object) -> bool:
    return isinstance(value, re.Pattern) or (_is_bson(value) and type(value).__name__ == "Regex")


def _mapping(value: object, path: _Path) -> Mapping[str, object]:
    if not isinstance(value, Mapping):
        raise _refused(path, "needs a mapping")
    return value


def _refused(path: _Path, reason: str) -> WhereError:
    place = " → ".join(part[:60] for part in path[-6:]) or "the filter"
    return WhereError(f"filter not allowed at {place}: {reason}")
