"""Checks MongoDB filters that a user wrote, before they are handed to MongoDB as they are.

Only operators that compare values are allowed. Operators that run code on the server
(`$where`, `$function`, `$accumulator`), read other data or are unknown are refused. Values
with code in them are refused, too. Patterns have RE2's syntax, so no search takes forever.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import replace
from datetime import datetime
from typing import cast

from hybridlog.query.predicate.numbers import HIGH, LOW
from hybridlog.query.predicate.regex import RegexError, compile_regex
from hybridlog.query.predicate.tokens import MAX_TEXT
from hybridlog.query.predicate.tree import (
    And,
    Compare,
    Field,
    Match,
    MongoFilter,
    Predicate,
    Reach,
    Value,
    frozen,
    is_meta,
)
from hybridlog.query.predicate.types import STATS, FieldTypes, check, check_name
from hybridlog.schema.kinds import width_of
from hybridlog_storage.errors import WhereError

MAX_DEPTH = 50
"""Deepest nesting; of MongoDB's 180 levels, its own rewriting takes some for each of ours."""
MAX_NODES = 20_000
"""Maximum number of keys and values in total."""
MAX_CHARACTERS = 1_000_000
"""Maximum number of characters in all keys and strings."""
WHOLE = 32
"""Longer arrays are summaries in index documents."""

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
        # arrays; none makes one longer than its input, as a nested `$map` or `$let` would
        *("$allElementsTrue", "$anyElementTrue", "$arrayElemAt", "$filter", "$first", "$last"),
        *("$in", "$indexOfArray", "$isArray", "$size", "$slice"),
        *("$avg", "$max", "$min", "$sum", "$stdDevPop", "$stdDevSamp"),
        # strings
        *("$indexOfBytes", "$indexOfCP", "$strcasecmp", "$strLenBytes", "$strLenCP"),
        *("$substrBytes", "$substrCP", "$toLower", "$toUpper", "$trim", "$ltrim", "$rtrim"),
        # types
        *("$convert", "$isNumber", "$toBool", "$toDate", "$toDouble", "$toInt", "$toLong"),
        *("$toString", "$type"),
        # values
        "$literal",
    }
)
_OPTIONS = set("ims")
_UNCHECKED = {"NoneType", "dict", "list", "Decimal128", "MinKey", "MaxKey"}
"""Types of values that are compared with fields of any type."""
_BSON_VALUES = {"Int64", "ObjectId", "Decimal128", "Timestamp", "MinKey", "MaxKey"}


Filter = dict[str, object]
_Path = tuple[str, ...]


def from_json(text: str) -> Filter:
    """A filter from JSON.

    Raises:
        WhereError: it is no JSON, or too large.
    """
    if len(text) > MAX_CHARACTERS:
        raise WhereError("filter not allowed: the filter is too large")
    try:
        found: Filter = json.loads(text)
    except RecursionError:
        raise WhereError(f"filter not allowed: it is nested deeper than {MAX_DEPTH}") from None
    except ValueError as error:
        raise WhereError(
            f'a MongoDB filter is JSON, such as {{"n": {{"$gt": 3}}}}: {error}'
        ) from None
    return found


def mongo_filter(
    query: Mapping[str, object], types: FieldTypes | Mapping[str, str] | None
) -> Predicate:
    """A filter as a predicate that MongoDB answers.

    Numpy scalars become Python numbers, tuples become lists, compiled patterns become `$regex`.

    Args:
        query: A filter as `pymongo` takes it.
        types: Types of the fields by path; None where no definition fixes them.

    Raises:
        WhereError: a part is not allowed, with its place; there is no such field; or a value
            does not fit its type.
    """
    if not isinstance(query, Mapping):
        raise WhereError(f"a filter is a mapping, not {type(query).__name__}")
    checker = _Checker()
    found, text = checker.query(query, (), 0), str(query)
    for path in checker.paths:
        if path.split(".")[0] != "_id":
            check_name(text, _field(path), types)
    compared = [
        replace(one, position=max(0, text.find(repr(one.field.path), 0, MAX_TEXT)))
        for one in checker.compared
        if one.field.parts[0] != "_id"
    ]
    check(Predicate(And(tuple(compared)), text), types)
    if not found:
        return Predicate(And(()), text)
    return Predicate(MongoFilter(frozen(found), tuple(checker.paths.items())), text)


def misjudged(node: MongoFilter, types: FieldTypes | Mapping[str, str] | None) -> dict[str, Filter]:
    """Reasons to refuse a filter, each with a filter of the documents that it would misjudge.

    Index documents have a long array as a summary only, and no summary of a short one.
    """
    known = FieldTypes.of(types)
    found: dict[str, Filter] = {}
    for path, reach in node.paths:
        if is_meta(path) or path.split(".")[0] == "_id":
            continue
        names = [name for name in path.split(".") if not name.isdecimal()]
        name, parent = ".".join(names), ".".join(names[:-1])
        is_statistic = known.statistic(tuple(names)) is not None
        if is_statistic:
            found[
                f"{parent} of up to {WHOLE} elements is whole in the index, and has no {name} "
                f"there: write a predicate, such as '{name} > 0'."
            ] = {parent: {"$type": "array", "$ne": []}, name: {"$exists": False}}
        if known.known:
            arrays = known.arrays
        else:
            arrays = {".".join(names[: end + 1]) for end in range(len(names))}
        for array in sorted(arrays):
            is_above = name.startswith(f"{array}.") and not (is_statistic and array == parent)
            is_it = array == name and (reach != "exists" or path != name)
            is_below = reach == "whole" and array.startswith(f"{name}.")
            width = width_of(known.types.get(array, ""))
            if (is_above or is_it or is_below) and (width is None or width > WHOLE):
                found[
                    f"{array} of more than {WHOLE} elements is a summary in the index: write a "
                    f"predicate, such as '{array} > 0', or, if all are so long, ask for "
                    f"{array}.min, {array}.max, {array}.mean or {array}.n."
                ] = _summaries_of(array, known)
    return found


def _summaries_of(array: str, types: FieldTypes) -> Filter:
    """A filter of the documents that have an array as a summary."""
    count = f"{array}.n"
    if types.known and count not in types.types and count not in types.inner:
        return {count: {"$exists": True}}
    # The elements may have a field of that name: the shape tells.
    of = f"${array}"
    nested = {"$cond": [{"$isArray": of}, of, []]}
    in_elements = {"$map": {"input": nested, "in": _is_summary("$$this")}}
    return {"$expr": {"$or": [_is_summary(of), {"$anyElementTrue": in_elements}]}}


def _is_summary(value: str) -> Filter:
    shapes = (("n",), tuple(STATS))
    return {"$in": [value, [{name: f"{value}.{name}" for name in shape} for shape in shapes]]}


def _field(path: str) -> Field:
    first, *rest = path.split(".")
    return Field((first, *(int(part) if _is_place(part) else part for part in rest)))


def _is_place(part: str) -> bool:
    return part.isascii() and part.isdecimal() and str(int(part[:9])) == part


class _Checker:
    """Checks a filter.

    Attributes:
        paths: How the filter asks for each path.
        compared: Fields and the values that they are compared with, as `==`, and patterns.
    """

    def __init__(self) -> None:
        self.paths: dict[str, Reach] = {}
        self.compared: list[Compare | Match] = []
        self._nodes = 0
        self._characters = 0

    def query(
        self, query: Mapping[str, object], path: _Path, depth: int, above: str = ""
    ) -> Filter:
        """A filter in plain Python values.

        Args:
            query: The filter.
            path: Its place, for messages.
            depth: Its depth.
            above: The path of the array whose elements it is about, and a dot.
        """
        found: Filter = {}
        for key, value in self._items(query, path, depth):
            inner = (*path, key)
            if key in _LOGICAL:
                if not isinstance(value, list | tuple) or not value:
                    raise _refused(inner, "needs a list of filters")
                found[key] = [
                    self.query(_mapping(item, inner), inner, depth + 1, above) for item in value
                ]
            elif key == "$expr" and not above:
                found[key] = self._expression(value, inner, depth + 1)
            elif key == "$comment" and not above:
                found[key] = self._literal(value, inner, depth + 1)
            elif key.startswith("$"):
                raise _refused(inner, "the operator is not allowed here")
            else:
                found[key] = self._condition(above + key, value, inner, depth + 1)
        return found

    def _ask(self, name: str, reach: Reach) -> None:
        """Note that the filter asks for a path, and how."""
        if self.paths.get(name, "exists") == "exists" or reach == "whole":
            self.paths[name] = reach

    def _compared(self, name: str, value: object, path: _Path, depth: int) -> object:
        """A value that a field is compared with, in plain Python values."""
        found = self._literal(value, path, depth)
        if type(found).__name__ not in _UNCHECKED:
            self.compared.append(Compare(_field(name), "==", cast("Value", found)))
        return found

    def _condition(self, name: str, value: object, path: _Path, depth: int) -> object:
        if isinstance(value, Mapping) and _has_operators(value, path):
            return self._operators(name, value, path, depth)
        if _is_pattern(value):
            return self._regex(name, value, "", path)
        self._ask(name, "whole" if isinstance(value, Mapping | list | tuple) else "value")
        return self._compared(name, value, path, depth)

    def _operators(
        self, name: str, operators: Mapping[str, object], path: _Path, depth: int
    ) -> Filter:
        found: Filter = {}
        for key, value in self._items(operators, path, depth):
            inner = (*path, key)
            if key == "$not":
                found[key] = self._not(name, value, inner, depth)
            elif key == "$regex":
                found |= self._regex(name, value, operators.get("$options", ""), inner)
            elif key != "$options" or "$regex" not in operators:
                found[key] = self._operand(name, key, value, inner, depth)
        return found

    def _operand(self, name: str, operator: str, value: object, path: _Path, depth: int) -> object:
        """The operand of an operator, in plain Python values."""
        if operator == "$elemMatch":
            return self._element(name, value, path, depth)
        if operator in _LISTS:
            return self._members(name, value, path, depth)
        if operator not in _LITERAL | _PLAIN:
            raise _refused(path, "the operator is not allowed here")
        is_nested = isinstance(value, Mapping | list | tuple) and operator in _LITERAL
        self._ask(name, "exists" if operator == "$exists" else "whole" if is_nested else "value")
        if operator in _PLAIN:
            return self._literal(value, path, depth + 1)
        return self._compared(name, value, path, depth + 1)

    def _members(self, name: str, value: object, path: _Path, depth: int) -> list[object]:
        if not isinstance(value, list | tuple):
            raise _refused(path, "needs a list")
        is_nested = any(isinstance(item, Mapping | list | tuple) for item in value)
        self._ask(name, "whole" if is_nested else "value")
        members: list[object] = []
        for item in value:
            if path[-1] == "$all" and isinstance(item, Mapping) and set(item) == {"$elemMatch"}:
                inner = (*path, "$elemMatch")
                element = self._element(name, item["$elemMatch"], inner, depth + 1)
                members.append({"$elemMatch": element})
            else:
                members.append(self._compared(name, item, path, depth + 1))
        return members

    def _not(self, name: str, value: object, path: _Path, depth: int) -> Filter:
        if _is_pattern(value):
            return self._regex(name, value, "", path)
        inner = _mapping(value, path)
        if not inner or not all(isinstance(key, str) and key[:1] == "$" for key in inner):
            raise _refused(path, "needs operators")
        return self._operators(name, inner, path, depth + 1)

    def _element(self, name: str, value: object, path: _Path, depth: int) -> Filter:
        """The condition on an element of an array."""
        self._ask(name, "value")
        inner = _mapping(value, path)
        keys = [key for key in inner if isinstance(key, str) and key.startswith("$")]
        if keys and not set(keys) & _LOGICAL and "$expr" not in keys:
            return self._operators(name, inner, path, depth + 1)
        return self.query(inner, path, depth + 1, f"{name}.")

    def _regex(self, name: str, value: object, options: object, path: _Path) -> Filter:
        self._ask(name, "value")
        if _is_pattern(value):
            if options:
                raise _refused(path, "has options twice")
            flags = getattr(value, "flags", 0)
            table = {re.IGNORECASE: "i", re.MULTILINE: "m", re.DOTALL: "s"}
            if not isinstance(flags, int) or flags & ~(sum(table) | re.UNICODE):
                raise _refused(path, "may have the flags i, m and s only")
            options = "".join(letter for flag, letter in table.items() if flags & flag)
            value = getattr(value, "pattern", None)
        if not isinstance(value, str):
            raise _refused(path, "needs a string")
        if not isinstance(options, str) or not set(options) <= _OPTIONS:
            raise _refused(path, "may have the options i, m and s only")
        self._count(path, len(value))
        flags = "".join(sorted(set(options)))
        try:
            compile_regex(f"(?{flags}){value}" if flags else str(value))
        except RegexError as error:
            raise _refused(path, f"the pattern is refused: {error}") from None
        self.compared.append(Match(_field(name), str(value), negated=False))
        found: Filter = {"$regex": str(value)}
        return {**found, "$options": flags} if flags else found

    def _expression(self, value: object, path: _Path, depth: int) -> object:
        """An aggregation expression."""
        if isinstance(value, list | tuple):
            self._enter(path, depth)
            return [self._expression(item, path, depth + 1) for item in value]
        if not isinstance(value, Mapping):
            if isinstance(value, str) and value.startswith("$"):
                self._ask_in_expression(value, path)
            return self._literal(value, path, depth)
        items = self._items(value, path, depth)
        operators = [key for key, _ in items if key.startswith("$")]
        if operators and len(items) != 1:
            raise _refused(path, "an expression has one operator")
        checked: dict[str, object] = {}
        for key, inner in items:
            place = (*path, key)
            if key.startswith("$") and (
                key not in _EXPRESSIONS or (key == "$filter" and key in path)
            ):
                raise _refused(place, "the operator is not allowed here")
            check = self._literal if key == "$literal" else self._expression
            checked[key] = check(inner, place, depth + 1)
        return checked

    def _ask_in_expression(self, text: str, path: _Path) -> None:
        name = text[1:]
        if name.startswith("$"):
            variable, _, name = name[1:].partition(".")
            if variable not in {"ROOT", "CURRENT"}:
                return  # of a path that is noted already
            if not name:
                raise _refused(path, f"{text} is the whole document; name a field")
        self._ask(name, "whole")

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
        if isinstance(value, int) and not LOW <= value <= HIGH:
            raise _refused(path, f"{value} does not fit into 64 bits; write it as a float")
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
                plain = str(key)
                plain.encode()
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
    """A value as Python's own, if BSON can hold it."""
    kind = type(value)
    try:
        if hasattr(value, "to_pydatetime"):  # pandas.Timestamp
            value = value.to_pydatetime()
        elif kind.__module__ == "numpy" and getattr(value, "shape", None) == ():
            value = value.item()  # type: ignore[attr-defined]
        if _is_bson(value) and kind.__name__ in _BSON_VALUES:
            return value
        if isinstance(value, str) and not _is_bson(value):  # bson.code.Code is a string
            value.encode()
            return str(value)
        if isinstance(value, float):
            return float(value)
        is_date = isinstance(value, datetime) and not math.isnan(value.timestamp())
        if is_date or value is None or isinstance(value, bool | int | bytes):
            return value
    except UnicodeError:
        raise _refused(path, "has a text that is not valid Unicode") from None
    except (OverflowError, ValueError, TypeError) as error:
        raise _refused(path, str(error)) from None
    raise _refused(path, f"a value of type {kind.__name__} is not allowed")


def _is_bson(value: object) -> bool:
    return type(value).__module__.split(".")[0] == "bson"


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
