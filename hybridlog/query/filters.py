"""MongoDB filters that a user wrote, checked before the database sees them.

Only operators that compare values are let through. Everything that runs code on the
server (`$where`, `$function`, `$accumulator`), reads something else, or is not known here
is refused, and so are values that carry code and patterns that could run for very long.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from datetime import datetime

from hybridlog.query.regex import UnsafeRegexError, check_regex
from hybridlog.query.where import MAX_REGEX, MAX_UNBOUNDED
from hybridlog_storage.errors import WhereError

MAX_DEPTH = 100
"""Deepest nesting; MongoDB itself takes up to 180 levels."""
MAX_NODES = 20_000
"""Most keys and values in all."""
MAX_CHARACTERS = 1_000_000
"""Most characters in all keys and strings."""

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
        # arrays; none that makes one longer than its input
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


def check_filter(query: Mapping[str, object]) -> dict[str, object]:
    """A copy of the filter in plain Python values, if everything in it is allowed.

    Numpy scalars become Python numbers, tuples become lists, compiled patterns become
    `$regex` conditions.

    Args:
        query: A filter as `pymongo` takes it.

    Raises:
        WhereError: What is not allowed and where it stands.
    """
    if not isinstance(query, Mapping):
        raise WhereError(f"a filter is a mapping, not {type(query).__name__}")
    return _Checker().query(query, (), 0)


_Path = tuple[str, ...]


class _Checker:
    def __init__(self) -> None:
        self._nodes = 0
        self._characters = 0

    def query(self, query: Mapping[str, object], path: _Path, depth: int) -> dict[str, object]:
        checked: dict[str, object] = {}
        for key, value in self._items(query, path, depth):
            inner = (*path, key)
            if key in _LOGICAL:
                checked[key] = self._clauses(value, inner, depth)
            elif key == "$expr":
                checked[key] = self._expression(value, inner, depth + 1)
            elif key == "$comment":
                checked[key] = self._literal(value, inner, depth + 1)
            elif key.startswith("$"):
                raise _refused(inner, "the operator is not allowed here")
            else:
                checked[key] = self._condition(value, inner, depth + 1)
        return checked

    def _clauses(self, value: object, path: _Path, depth: int) -> list[object]:
        if not isinstance(value, list | tuple) or not value:
            raise _refused(path, "needs a list of filters")
        return [self.query(_mapping(item, path), path, depth + 1) for item in value]

    def _condition(self, value: object, path: _Path, depth: int) -> object:
        if isinstance(value, Mapping):
            marked = [isinstance(key, str) and key.startswith("$") for key in value]
            if any(marked):
                if not all(marked):
                    raise _refused(path, "mixes operators and names")
                return self._operators(value, path, depth)
        if _is_pattern(value):
            return self._pattern(value, path)
        return self._literal(value, path, depth)

    def _operators(
        self, operators: Mapping[str, object], path: _Path, depth: int
    ) -> dict[str, object]:
        checked: dict[str, object] = {}
        for key, value in self._items(operators, path, depth):
            inner = (*path, key)
            if key in _LITERAL or key in _PLAIN:
                checked[key] = self._literal(value, inner, depth + 1)
            elif key in _LISTS:
                checked[key] = self._members(value, inner, depth)
            elif key == "$not":
                checked[key] = self._not(value, inner, depth)
            elif key == "$elemMatch":
                checked[key] = self._element(value, inner, depth)
            elif key == "$regex":
                checked.update(self._regex(value, operators.get("$options", ""), inner))
            elif key != "$options" or "$regex" not in operators:
                raise _refused(inner, "the operator is not allowed here")
        return checked

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

    def _not(self, value: object, path: _Path, depth: int) -> object:
        if _is_pattern(value):
            return self._pattern(value, path)
        inner = _mapping(value, path)
        if not inner or not all(isinstance(key, str) and key[:1] == "$" for key in inner):
            raise _refused(path, "needs operators")
        return self._operators(inner, path, depth + 1)

    def _element(self, value: object, path: _Path, depth: int) -> object:
        inner = _mapping(value, path)
        keys = [key for key in inner if isinstance(key, str) and key.startswith("$")]
        if keys and not set(keys) & _LOGICAL:
            return self._condition(inner, path, depth + 1)
        if "$expr" in inner:
            raise _refused((*path, "$expr"), "the operator is not allowed here")
        return self.query(inner, path, depth + 1)

    def _pattern(self, value: object, path: _Path) -> dict[str, object]:
        pattern, flags = getattr(value, "pattern", None), getattr(value, "flags", 0)
        if not isinstance(flags, int):
            raise _refused(path, "has flags that are not understood")
        table = {re.IGNORECASE: "i", re.MULTILINE: "m", re.DOTALL: "s"}
        options = "".join(letter for flag, letter in table.items() if flags & flag)
        if flags & ~(re.IGNORECASE | re.MULTILINE | re.DOTALL | re.UNICODE):
            raise _refused(path, "may have the flags i, m and s only")
        return self._regex(pattern, options, path)

    def _regex(self, value: object, options: object, path: _Path) -> dict[str, object]:
        if _is_pattern(value):
            if options:
                raise _refused(path, "has options twice")
            return self._pattern(value, path)
        if not isinstance(value, str):
            raise _refused(path, "needs a string")
        if not isinstance(options, str) or not set(options) <= _OPTIONS:
            raise _refused(path, "may have the options i, m and s only")
        try:
            check_regex(value, max_length=MAX_REGEX, max_unbounded=MAX_UNBOUNDED)
        except UnsafeRegexError as error:
            raise _refused(path, f"the pattern is refused: {error}") from None
        self._count(path, len(value))
        return {"$regex": str(value), **({"$options": options} if options else {})}

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
    if isinstance(number, int) and not isinstance(number, bool) and not -(2**63) <= number < 2**63:
        raise OverflowError(f"{number} does not fit into 64 bits; write it as a float")
    if not isinstance(number, bool | int | float | None):
        raise TypeError(f"a value of type {type(value).__name__} is not allowed")
    return float(number) if isinstance(number, float) else number


def _plain_text(value: object) -> str:
    text = str(value)
    text.encode()  # half a surrogate pair is a ValueError
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
    # bson.code.Code is a str, so the module is looked at first.
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


def _is_pattern(value: object) -> bool:
    return isinstance(value, re.Pattern) or (_is_bson(value) and type(value).__name__ == "Regex")


def _mapping(value: object, path: _Path) -> Mapping[str, object]:
    if not isinstance(value, Mapping):
        raise _refused(path, "needs a mapping")
    return value


def _refused(path: _Path, reason: str) -> WhereError:
    place = " → ".join(part[:60] for part in path[-6:]) or "the filter"
    return WhereError(f"filter not allowed at {place}: {reason}")
