"""Checks MongoDB filters that a user wrote, before they are handed to MongoDB as they are.

Only operators that compare values are allowed. Operators that run code on the server
(`$where`, `$function`, `$accumulator`), read other data or are unknown are refused. Values
with code in them are refused, too. Patterns have RE2's syntax, so no search takes forever.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, cast

import bson
from bson.codec_options import CodecOptions, TypeRegistry
from bson.errors import BSONError
from bson.regex import Regex

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
    is_meta,
)
from hybridlog.query.predicate.types import STATS, FieldTypes, check, check_name
from hybridlog.schema.kinds import width_of
from hybridlog_storage.errors import WhereError

MAX_DEPTH = 50
"""Deepest nesting; of MongoDB's 180 levels, its own rewriting takes some for each of ours."""
MAX_BYTES = 1_000_000
"""Maximum size, as text and as BSON."""
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
_FLAGS = {re.IGNORECASE: "i", re.MULTILINE: "m", re.DOTALL: "s", re.UNICODE: ""}
_UNCHECKED = {"NoneType", "dict", "list", "Decimal128", "MinKey", "MaxKey"}
"""Types of values that are compared with fields of any type."""
_TYPES = {
    *("NoneType", "bool", "int", "float", "str", "bytes", "datetime"),
    *("Int64", "ObjectId", "Decimal128", "Timestamp", "MinKey", "MaxKey", "Regex"),
}


Filter = dict[str, object]
_Path = tuple[str, ...]


def from_json(text: str) -> Filter:
    """A filter from JSON.

    Raises:
        WhereError: it is no JSON, or too large.
    """
    if len(text) > MAX_BYTES:
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

    It is copied as BSON, so numpy's scalars are numbers and tuples are lists.

    Args:
        query: A filter as `pymongo` takes it.
        types: Types of the fields by path; None where no definition fixes them.

    Raises:
        WhereError: a part is not allowed, with its place; there is no such field; or a value
            does not fit its type.
    """
    if not isinstance(query, Mapping):
        raise WhereError(f"a filter is a mapping, not {type(query).__name__}")
    content = _encoded(query)
    found: Filter = bson.decode(content)
    text = str(query)
    _check_values(found, (), 0)
    checker = _Checker()
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
    return Predicate(MongoFilter(content, tuple(checker.paths.items())), text)


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


def _encoded(query: Mapping[str, object]) -> bytes:
    """A filter in BSON."""
    numbers: CodecOptions[Filter] = CodecOptions(
        type_registry=TypeRegistry(fallback_encoder=_number)
    )
    try:
        content = bson.encode(query, codec_options=numbers)
    except RecursionError:
        raise _refused((), f"it is nested deeper than {MAX_DEPTH}") from None
    except UnicodeError:
        raise _refused((), "it has a text that is not valid Unicode") from None
    except (BSONError, OverflowError, TypeError, ValueError) as error:
        raise _refused((), str(error)) from None
    if len(content) > MAX_BYTES:
        raise _refused((), "the filter is too large")
    return content


def _number(value: Any) -> object:
    """A scalar of numpy as Python's own; refuses all else that BSON does not have."""
    if type(value).__module__ == "numpy" and value.shape == ():
        value = value.item()
    elif not isinstance(value, int):
        raise TypeError(f"a value of type {type(value).__name__} is not allowed")
    if isinstance(value, int) and not LOW <= value <= HIGH:
        raise OverflowError(f"{value} does not fit into 64 bits; write it as a float")
    return value


def _check_values(value: object, path: _Path, depth: int) -> None:
    """Check depth and types of values; `path` is their place, for messages."""
    if depth > MAX_DEPTH:
        raise _refused(path[:3], f"is nested deeper than {MAX_DEPTH}")
    if isinstance(value, dict):
        for key, inner in value.items():
            _check_values(inner, (*path, key), depth + isinstance(inner, dict))
    elif isinstance(value, list):
        for inner in value:
            _check_values(inner, path, depth + 1)
    elif type(value).__name__ not in _TYPES:
        raise _refused(path, f"a value of type {type(value).__name__} is not allowed")


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
            elif isinstance(value, Regex):
                self._pattern(above + key, value, "", place)
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
            if key == "$regex" or (key == "$not" and isinstance(value, Regex)):
                self._pattern(name, value, operators.get("$options", ""), place)
            elif key == "$not":
                inner = _mapping(value, place)
                if not inner or not all(name.startswith("$") for name in inner):
                    raise _refused(place, "needs operators")
                self._operators(name, inner, place)
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
        if isinstance(value, Regex):
            if options:
                raise _refused(path, "has options twice")
            options = "".join(_FLAGS.get(flag, "x") for flag in re.RegexFlag(value.flags))
            value = value.pattern
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
    """Refuse operators and patterns in a value to compare with."""
    if isinstance(value, Regex):
        raise _refused(path, "a pattern is not allowed here")
    if isinstance(value, list):
        for item in value:
            _without_operators(item, path)
    elif isinstance(value, dict):
        for key, item in value.items():
            if key.startswith("$"):
                raise _refused((*path, key), "the operator is not allowed here")
            _without_operators(item, (*path, key))


def _has_operators(value: Filter, path: _Path) -> bool:
    """True if a mapping has operators as keys, not names."""
    marked = [key.startswith("$") for key in value]
    if any(marked) and not all(marked):
        raise _refused(path, "mixes operators and names")
    return any(marked)


def _mapping(value: object, path: _Path) -> Filter:
    if not isinstance(value, dict):
        raise _refused(path, "needs a mapping")
    return value


def _refused(path: _Path, reason: str) -> WhereError:
    place = " → ".join(part[:60] for part in path[-6:]) or "the filter"
    return WhereError(f"filter not allowed at {place}: {reason}")
