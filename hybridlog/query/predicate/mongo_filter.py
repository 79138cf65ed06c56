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
    found, text = _Plain().mapping(query, (), 0), str(query)
    checker.query(found, ())
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


class _Plain:
    """Makes plain Python values of a filter, within bounds."""

    def __init__(self) -> None:
        self._nodes = 0
        self._characters = 0

    def mapping(self, given: Mapping[str, object], path: _Path, depth: int) -> Filter:
        """A mapping in plain values; `path` is its place, for messages."""
        if depth > MAX_DEPTH:
            raise _refused(path[:3], f"is nested deeper than {MAX_DEPTH}")
        found: Filter = {}
        for key, value in given.items():
            if not isinstance(key, str):
                raise _refused(path, f"has a key that is no string: {key!r}")
            try:
                name = str(key)
                name.encode()
            except ValueError:
                raise _refused(path, "has a name that is not valid Unicode") from None
            if "\0" in name:
                raise _refused(path, "has a name with a NUL character")
            self._count(path, len(name))
            place = (*path, name)
            if name == "$regex" and _is_pattern(value):
                if given.get("$options"):
                    raise _refused(place, "has options twice")
                found |= _regex(value, place)
            elif name != "$options" or not _is_pattern(given.get("$regex")):
                is_pattern = _is_pattern(value)
                found[name] = (
                    _regex(value, place) if is_pattern else self._value(value, place, depth)
                )
        return found

    def _value(self, value: object, path: _Path, depth: int) -> object:
        if isinstance(value, Mapping):
            return self.mapping(value, path, depth + 1)
        if isinstance(value, list | tuple):
            if depth > MAX_DEPTH:
                raise _refused(path[:3], f"is nested deeper than {MAX_DEPTH}")
            # What is in a list is as deep as the list, but for lists.
            return [self._value(one, path, depth + isinstance(one, list | tuple)) for one in value]
        self._count(path, len(value) if isinstance(value, str | bytes) else 0)
        found = _scalar(value, path)
        if isinstance(found, int) and not LOW <= found <= HIGH:
            raise _refused(path, f"{found} does not fit into 64 bits; write it as a float")
        return found

    def _count(self, path: _Path, characters: int) -> None:
        self._nodes += 1
        self._characters += characters
        if self._nodes > MAX_NODES or self._characters > MAX_CHARACTERS:
            raise _refused(path[:3], "the filter is too large")


def _regex(pattern: object, path: _Path) -> Filter:
    """A compiled pattern as MongoDB writes it."""
    flags = getattr(pattern, "flags", 0)
    table = {re.IGNORECASE: "i", re.MULTILINE: "m", re.DOTALL: "s"}
    if not isinstance(flags, int) or flags & ~(sum(table) | re.UNICODE):
        raise _refused(path, "may have the flags i, m and s only")
    options = "".join(letter for flag, letter in table.items() if flags & flag)
    found: Filter = {"$regex": getattr(pattern, "pattern", None)}
    return {**found, "$options": options} if options else found


class _Checker:
    """Checks a filter of plain values.

    Attributes:
        paths: How the filter asks for each path.
        compared: Fields and the values that they are compared with, as `==`, and patterns.
    """

    def __init__(self) -> None:
        self.paths: dict[str, Reach] = {}
        self.compared: list[Compare | Match] = []

    def query(self, query: Filter, path: _Path, above: str = "") -> None:
        """Check a filter.

        Args:
            query: The filter.
            path: Its place, for messages.
            above: The path of the array whose elements it is about, and a dot.
        """
        for key, value in query.items():
            place = (*path, key)
            if key in _LOGICAL:
                if not isinstance(value, list) or not value:
                    raise _refused(place, "needs a list of filters")
                for item in value:
                    self.query(_mapping(item, place), place, above)
            elif key == "$expr" and not above:
                self._expression(value, place)
            elif key == "$comment" and not above:
                _without_operators(value, place)
            elif key.startswith("$"):
                raise _refused(place, "the operator is not allowed here")
            elif isinstance(value, dict) and _has_operators(value, place):
                self._operators(above + key, value, place)
            else:
                self._compare(above + key, value, place)

    def _ask(self, name: str, reach: Reach) -> None:
        """Note that the filter asks for a path, and how."""
        if self.paths.get(name, "exists") == "exists" or reach == "whole":
            self.paths[name] = reach

    def _compare(self, name: str, value: object, path: _Path) -> None:
        """Check a value that a field is compared with."""
        self._ask(name, "whole" if isinstance(value, dict | list) else "value")
        _without_operators(value, path)
        if type(value).__name__ not in _UNCHECKED:
            self.compared.append(Compare(_field(name), "==", cast("Value", value)))

    def _operators(self, name: str, operators: Filter, path: _Path) -> None:
        for key, value in operators.items():
            place = (*path, key)
            if key == "$not":
                inner = _mapping(value, place)
                if not inner or not all(name.startswith("$") for name in inner):
                    raise _refused(place, "needs operators")
                self._operators(name, inner, place)
            elif key == "$regex":
                self._pattern(name, value, operators.get("$options", ""), place)
            elif key == "$elemMatch":
                self._element(name, value, place)
            elif key in _LISTS:
                self._members(name, value, place)
            elif key in _LITERAL:
                self._compare(name, value, place)
            elif key in _PLAIN:
                self._ask(name, "exists" if key == "$exists" else "value")
                _without_operators(value, place)
            elif key != "$options" or "$regex" not in operators:
                raise _refused(place, "the operator is not allowed here")

    def _members(self, name: str, value: object, path: _Path) -> None:
        if not isinstance(value, list):
            raise _refused(path, "needs a list")
        self._ask(name, "value")
        for item in value:
            if path[-1] == "$all" and isinstance(item, dict) and set(item) == {"$elemMatch"}:
                self._element(name, item["$elemMatch"], (*path, "$elemMatch"))
            else:
                self._compare(name, item, path)

    def _element(self, name: str, value: object, path: _Path) -> None:
        """Check the condition on an element of an array."""
        self._ask(name, "value")
        inner = _mapping(value, path)
        keys = {key for key in inner if key.startswith("$")}
        if keys and not keys & {*_LOGICAL, "$expr"}:
            self._operators(name, inner, path)
        else:
            self.query(inner, path, f"{name}.")

    def _pattern(self, name: str, value: object, options: object, path: _Path) -> None:
        self._ask(name, "value")
        if not isinstance(value, str):
            raise _refused(path, "needs a string")
        if not isinstance(options, str) or not set(options) <= _OPTIONS:
            raise _refused(path, "may have the options i, m and s only")
        try:
            compile_regex(f"(?{options}){value}" if options else value)
        except RegexError as error:
            raise _refused(path, f"the pattern is refused: {error}") from None
        self.compared.append(Match(_field(name), value, negated=False))

    def _expression(self, value: object, path: _Path) -> None:
        """Check an aggregation expression."""
        if isinstance(value, list):
            for item in value:
                self._expression(item, path)
        elif isinstance(value, dict):
            if len(value) != 1 and any(key.startswith("$") for key in value):
                raise _refused(path, "an expression has one operator")
            for key, inner in value.items():
                place = (*path, key)
                is_known = key in _EXPRESSIONS and (key != "$filter" or key not in path)
                if key.startswith("$") and not is_known:
                    raise _refused(place, "the operator is not allowed here")
                if key == "$literal":
                    _without_operators(inner, place)
                else:
                    self._expression(inner, place)
        elif isinstance(value, str) and value.startswith("$"):
            name = value[1:]
            if name.startswith("$"):
                variable, _, name = name[1:].partition(".")
                if variable not in {"ROOT", "CURRENT"}:
                    return  # of a path that is noted already
                if not name:
                    raise _refused(path, f"{value} is the whole document; name a field")
            self._ask(name, "whole")


def _without_operators(value: object, path: _Path) -> None:
    """Refuse operators in a value to compare with."""
    if isinstance(value, list):
        for item in value:
            _without_operators(item, path)
    elif isinstance(value, dict):
        for key, item in value.items():
            if key.startswith("$"):
                raise _refused((*path, key), "the operator is not allowed here")
            _without_operators(item, (*path, key))


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


def _has_operators(value: Filter, path: _Path) -> bool:
    """True if a mapping has operators as keys, not names."""
    marked = [key.startswith("$") for key in value]
    if any(marked) and not all(marked):
        raise _refused(path, "mixes operators and names")
    return any(marked)


def _is_pattern(value: object) -> bool:
    return isinstance(value, re.Pattern) or (_is_bson(value) and type(value).__name__ == "Regex")


def _mapping(value: object, path: _Path) -> Filter:
    if not isinstance(value, dict):
        raise _refused(path, "needs a mapping")
    return value


def _refused(path: _Path, reason: str) -> WhereError:
    place = " → ".join(part[:60] for part in path[-6:]) or "the filter"
    return WhereError(f"filter not allowed at {place}: {reason}")
