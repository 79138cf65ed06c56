"""Checks MongoDB filters that a user wrote, before they are handed to MongoDB as they are.

Only operators that compare values are allowed, on fields that exist, and no code. Patterns have
RE2's syntax, so no search takes forever. What is written wrongly otherwise MongoDB says itself.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any, cast

import bson
from bson.codec_options import CodecOptions, TypeRegistry
from bson.errors import BSONError
from bson.regex import Regex

from hybridlog.query.predicate.parser import RegexError, compile_regex
from hybridlog.query.predicate.tree import (
    ALWAYS,
    And,
    Condition,
    Field,
    MongoFilter,
    Predicate,
    is_meta,
)
from hybridlog.query.predicate.types import STATS, FieldTypes, check
from hybridlog.schema.definition_text import width_of
from hybridlog_storage.errors import WhereError

MAX_DEPTH = 50
"""A nesting that each MongoDB takes."""
MAX_BYTES = 1_000_000
"""Maximum size, as text and as BSON."""
WHOLE = 32
"""Longer arrays are summaries in index documents."""

_LOGICAL = {"$and", "$or", "$nor"}
_OF_VALUES = {"$eq", "$ne", "$gt", "$gte", "$lt", "$lte", "$in", "$nin", "$all", "$not"}
_PLAIN = {
    *("$exists", "$type", "$size", "$mod"),
    *("$bitsAllSet", "$bitsAllClear", "$bitsAnySet", "$bitsAnyClear"),
}
_FLAGS = {"i": re.IGNORECASE, "m": re.MULTILINE, "s": re.DOTALL, "": re.UNICODE}
_PLACE = re.compile(r"0|[1-9][0-9]{0,8}")

Filter = dict[str, object]
_Path = tuple[str, ...]


def from_json(text: str) -> Filter:
    """A filter from JSON.

    Raises:
        WhereError: it is no JSON, or too large.
    """
    if len(text) > MAX_BYTES:
        raise _refused((), "it is too large")
    try:
        found: Filter = json.loads(text)
    except RecursionError:
        raise _refused((), "it is nested too deeply") from None
    except ValueError as error:
        raise WhereError(
            f'a MongoDB filter is JSON, such as {{"n": {{"$gt": 3}}}}: {error}'
        ) from None
    return found


def mongo_filter(
    query: Mapping[str, object], types: FieldTypes | Mapping[str, str] | None
) -> Predicate:
    """A filter, as pymongo takes it, as a predicate that MongoDB answers.

    It is copied as BSON, so numpy's scalars are numbers and tuples are lists.
    """
    if not isinstance(query, Mapping):
        raise WhereError(f"a filter is a mapping, not {type(query).__name__}")
    try:
        content = bson.encode(query, codec_options=_CODEC)
        if len(content) > MAX_BYTES:
            raise _refused((), "it is too large")
        found = bson.decode(content)
        checker = _Checker()
        checker.query(found, ())
    except RecursionError:
        raise _refused((), "it is nested too deeply") from None
    except UnicodeError:
        raise _refused((), "it has a text that is not valid Unicode") from None
    except (BSONError, OverflowError, TypeError, ValueError) as error:
        raise _refused((), str(error)) from None
    asked = (Condition(_field(path), "exists") for path in checker.paths if not _is_id(path))
    check(Predicate(And(tuple(asked)), str(query)), types)
    root = MongoFilter(content, tuple(checker.paths.items())) if found else ALWAYS
    return Predicate(root, str(query))


def misjudged(node: MongoFilter, types: FieldTypes | Mapping[str, str] | None) -> dict[str, Filter]:
    """Reasons to refuse a filter, each with a filter of the documents that it would misjudge.

    Index documents have a long array as a summary only, and no summary of a short one.
    """
    known = FieldTypes.of(types)
    found: dict[str, Filter] = {}
    for path, of_value in node.paths:
        if is_meta(path) or _is_id(path):
            continue
        names = [name for name in path.split(".") if not name.isdecimal()]
        name, parent = ".".join(names), ".".join(names[:-1])
        is_statistic = known.statistic(tuple(names)) is not None
        if is_statistic:
            found[
                f"{parent} of up to {WHOLE} elements is whole in the index, and has no {name} "
                f"there: write a predicate, such as '{name} > 0'."
            ] = {parent: {"$type": "array", "$ne": []}, name: {"$exists": False}}
        above = {".".join(names[: end + 1]) for end in range(len(names))}
        for array in sorted(known.arrays if known.known else above):
            is_above = name.startswith(f"{array}.") and not (is_statistic and array == parent)
            is_it = array == name and (of_value or path != name)
            width = width_of(known.types.get(array, ""))
            if (is_above or is_it) and (width is None or width > WHOLE):
                found[
                    f"{array} of more than {WHOLE} elements is a summary in the index: write a "
                    f"predicate, such as '{array} > 0', or, if all are so long, ask for "
                    f"{array}.min, {array}.max, {array}.mean or {array}.n."
                ] = _summaries_of(array)
    return found


def _summaries_of(array: str) -> Filter:
    """A filter of the documents that have an array as a summary, known by the names in it."""
    of = f"${array}"
    nested = {"$cond": [{"$isArray": of}, of, []]}
    in_elements = {"$map": {"input": nested, "in": _is_summary("$$this")}}
    return {"$expr": {"$or": [_is_summary(of), {"$anyElementTrue": in_elements}]}}


def _is_summary(value: str) -> Filter:
    shapes = (("n",), tuple(STATS))
    return {"$in": [value, [{name: f"{value}.{name}" for name in shape} for shape in shapes]]}


def _field(path: str) -> Field:
    first, *rest = path.split(".")
    return Field((first, *(int(part) if _PLACE.fullmatch(part) else part for part in rest)))


def _is_id(path: str) -> bool:
    return path.split(".", maxsplit=1)[0] == "_id"


def _plain(value: Any) -> object:
    """A scalar of numpy as Python's own; refuses all else that BSON does not have."""
    if type(value).__module__ == "numpy" and value.shape == ():
        return value.item()
    kind = type(value).__name__
    raise TypeError(f"a value of type {kind} is not allowed, nor a number beyond 64 bits")


_CODEC: CodecOptions[Filter] = CodecOptions(type_registry=TypeRegistry(fallback_encoder=_plain))


class _Checker:
    """Checks a filter of plain values; `paths` are asked for their values, or whether they are."""

    def __init__(self) -> None:
        self.paths: dict[str, bool] = {}

    def query(self, query: object, path: _Path, above: str = "") -> None:
        """Check a filter, or several; `above` is the array that it is inside of, and a dot."""
        for one in query if isinstance(query, list) else [query]:
            for key, value in one.items() if isinstance(one, dict) else ():
                place = (*path, key)
                if key in _LOGICAL:
                    self.query(value, place, above)
                elif key.startswith("$"):
                    raise _refused(place, "the operator is not allowed here")
                else:
                    self._condition(above + key, value, place)

    def _ask(self, name: str, *, of_value: bool = True) -> None:
        self.paths[name] = of_value or self.paths.get(name, False)

    def _condition(self, name: str, value: object, path: _Path) -> None:
        """Check what a field is compared with: a value, a pattern, or operators."""
        if isinstance(value, Regex):
            self._pattern(name, value, "", path)
        elif _has_operators(value):
            self._operators(name, cast("Filter", value), path)
        else:
            self._ask(name)
            _literal(value, path)

    def _operators(self, name: str, operators: Filter, path: _Path) -> None:
        for key, value in operators.items():
            place = (*path, key)
            self._ask(name, of_value=key != "$exists")
            if key == "$regex":
                self._pattern(name, value, operators.get("$options", ""), place)
            elif key == "$elemMatch":
                if _has_operators(value) and _LOGICAL.isdisjoint(cast("Filter", value)):
                    self._condition(name, value, place)
                else:
                    self.query(value, place, f"{name}.")
            elif key in _OF_VALUES:
                is_list = key in {"$in", "$nin", "$all"} and isinstance(value, list)
                for item in cast("list[object]", value) if is_list else [value]:
                    self._condition(name, item, place)
            elif key in _PLAIN:
                _literal(value, place)
            elif key != "$options" or "$regex" not in operators:
                raise _refused(place, "the operator is not allowed here")

    def _pattern(self, name: str, value: object, options: object, path: _Path) -> None:
        self._ask(name)
        if isinstance(value, Regex):
            if options or value.flags & ~sum(_FLAGS.values()):
                raise _refused(path, "may have the options i, m and s only, and once")
            options = "".join(letter for letter, flag in _FLAGS.items() if value.flags & flag)
            value = value.pattern
        if not {*str(options)} <= {*"ims"}:
            raise _refused(path, "may have the options i, m and s only")
        try:
            compile_regex(f"(?{options}){value}" if options else str(value))
        except RegexError as error:
            raise _refused(path, f"the pattern is refused: {error}") from None


def _literal(value: object, path: _Path) -> None:
    """Refuse operators, patterns and code in a value to compare with."""
    if isinstance(value, Regex | bson.Code):
        raise _refused(path, f"a value of type {type(value).__name__} is not allowed here")
    if isinstance(value, list):
        for item in value:
            _literal(item, path)
    elif isinstance(value, dict):
        for key, item in value.items():
            if key.startswith("$"):
                raise _refused((*path, key), "the operator is not allowed here")
            _literal(item, (*path, key))


def _has_operators(value: object) -> bool:
    """True for a mapping with operators as keys, not names."""
    return isinstance(value, dict) and any(key.startswith("$") for key in value)


def _refused(path: _Path, reason: str) -> WhereError:
    place = " → ".join(part[:60] for part in path[-6:]) or "the filter"
    return WhereError(f"filter not allowed at {place}: {reason}")
