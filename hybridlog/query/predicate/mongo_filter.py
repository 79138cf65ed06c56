"""Checks MongoDB filters that a user wrote, before they are handed to MongoDB as they are.

Only operators that compare values are allowed, on fields that exist; values are data, and never
run. Patterns are MongoDB's, and what is written wrongly otherwise it says itself.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

import bson
from bson.codec_options import CodecOptions, TypeRegistry
from bson.errors import BSONError

from hybridlog.query.predicate.tree import (
    ALWAYS,
    STATS,
    And,
    Condition,
    Field,
    FieldTypes,
    MongoFilter,
    Predicate,
    check,
    is_meta,
)
from hybridlog.schema.definition_text import width_of
from hybridlog_storage.errors import WhereError

MAX_BYTES = 1_000_000
"""Maximum size, as text and as BSON."""
WHOLE = 32
"""Longer arrays are summaries in index documents."""

_LOGICAL = {"$and", "$or", "$nor"}
_OPERATORS = {
    *("$eq", "$ne", "$gt", "$gte", "$lt", "$lte", "$in", "$nin", "$all", "$not", "$elemMatch"),
    *("$exists", "$type", "$size", "$mod", "$regex", "$options"),
    *("$bitsAllSet", "$bitsAllClear", "$bitsAnySet", "$bitsAnyClear"),
}
_INDEXED = {"_id", "_meta.inserted_at", "_meta.error"} | {
    f"_meta.ref{part}" for part in ("", ".seg", ".chunk", ".off", ".len")
}
"""What documents have and messages do not."""
_PLACE = re.compile(r"0|[1-9][0-9]{0,8}")

Filter = dict[str, object]
_Paths = dict[str, bool]
"""The paths that a filter asks for, and whether for their values."""


def mongo_filter(
    query: str | Mapping[str, object], types: FieldTypes | Mapping[str, str] | None
) -> Predicate:
    """A filter, as pymongo takes it or in JSON, as a predicate that MongoDB answers.

    It is copied as BSON, so numpy's scalars are numbers and tuples are lists.
    """
    paths: _Paths = {}
    try:
        if isinstance(query, str):
            query = json.loads(query)
        if not isinstance(query, Mapping):
            raise WhereError(f"a filter is a mapping, not {type(query).__name__}")
        content = bson.encode(query, codec_options=_CODEC)
        found = bson.decode(content)
        _check(found, paths)
    except RecursionError:
        raise _refused((), "it is nested too deeply") from None
    except (BSONError, OverflowError, TypeError, ValueError) as error:
        raise _refused((), str(error)) from None
    if len(content) > MAX_BYTES:
        raise _refused((), "it is too large")
    asked = (Condition(_field(path), "exists") for path in paths if path not in _INDEXED)
    check(Predicate(And(tuple(asked)), str(query)), types)
    root = MongoFilter(content, tuple(paths.items())) if found else ALWAYS
    return Predicate(root, str(query))


def misjudged(node: MongoFilter, types: FieldTypes | Mapping[str, str] | None) -> dict[str, Filter]:
    """Reasons to refuse a filter, each with a filter of the documents that it would misjudge.

    Index documents have a long array as a summary only, and no summary of a short one.
    """
    known = FieldTypes.of(types)
    found: dict[str, Filter] = {}
    for path, of_value in node.paths:
        if is_meta(path) or path == "_id":
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


def _plain(value: Any) -> object:
    """A scalar of numpy as Python's own; refuses all else that BSON does not have."""
    if type(value).__module__ == "numpy" and value.shape == ():
        return value.item()
    kind = type(value).__name__
    raise TypeError(f"a value of type {kind} is not allowed, nor a number beyond 64 bits")


_CODEC: CodecOptions[Filter] = CodecOptions(type_registry=TypeRegistry(fallback_encoder=_plain))


def _check(
    query: object, paths: _Paths, place: tuple[str, ...] = (), name: str = "", above: str = ""
) -> None:
    """Check a filter, or several; with a `name`, what a field is compared with.

    `above` is the array that the filter is inside of, and a dot.
    """
    for one in query if isinstance(query, list) else [query]:
        if not isinstance(one, dict) or (name and not _has_operators(one)):
            continue  # a value
        for key, value in one.items():
            at = (*place, key)
            are_operators = _has_operators(value) and _LOGICAL.isdisjoint(value)
            if name and key == "$elemMatch" and not are_operators:
                _check(value, paths, at, above=f"{name}.")
            elif key in (_OPERATORS if name else _LOGICAL):
                _check(value, paths, at, name, above)
            elif name or key.startswith("$"):
                raise _refused(at, "the operator is not allowed here")
            else:
                path = above + key
                is_of_value = not isinstance(value, dict) or [*value] != ["$exists"]
                paths[path] = paths.get(path, False) or is_of_value
                _check(value, paths, at, path)


def _has_operators(value: object) -> bool:
    """True for a mapping with operators as keys, not names."""
    return isinstance(value, dict) and any(key.startswith("$") for key in value)


def _refused(place: tuple[str, ...], reason: str) -> WhereError:
    shown = " → ".join(part[:60] for part in place[-6:]) or "the filter"
    return WhereError(f"filter not allowed at {shown}: {reason}")
