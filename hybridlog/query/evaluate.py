"""Predicates on one document in memory, with the meaning that MongoDB gives them.

A trigger is asked of every message as it comes, long before that is in a database.
`tests/query/test_where.py` holds the answers against a MongoDB's.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, TypeAlias, TypeGuard

from hybridlog.query.mongo_filter import FieldTypes
from hybridlog.query.where import And, Compare, Exists, Member, Not, Or

if TYPE_CHECKING:
    from hybridlog.query.mongo_filter import Stat
    from hybridlog.query.where import Condition, Expression, Node, Value

Document: TypeAlias = Mapping[str, object]
"""Fields of an index document: dict, list, str, bool, int, float, None."""
Test: TypeAlias = Callable[[Document], bool]

_SUMMARY = frozenset({"n", "min", "max", "mean"})
_ESCAPE = re.compile(r"\\.", re.DOTALL)
_IGNORES_CASE = re.compile(r"\(\?[a-zA-Z]*i")
_ORDERS: dict[str, Callable[[float | str, float | str], bool]] = {
    "<": lambda one, other: one < other,  # type: ignore[operator]
    "<=": lambda one, other: one <= other,  # type: ignore[operator]
    ">": lambda one, other: one > other,  # type: ignore[operator]
    ">=": lambda one, other: one >= other,  # type: ignore[operator]
}


def holds(
    expression: Expression, document: Document, field_types: Mapping[str, str] | None = None
) -> bool:
    """Whether a predicate holds for a document; see `compiled`."""
    return compiled(expression, field_types)(document)


def compiled(expression: Expression, field_types: Mapping[str, str] | None = None) -> Test:
    """A predicate as a test of one document after the other.

    Args:
        expression: As `where.parse` gives it.
        field_types: As for `where.compile_filter`, which refuses what does not fit them.
    """
    types = None if field_types is None else tuple(field_types.items())
    return _node(expression.root, FieldTypes.of(types))


def numbers_at(document: Document, path: str) -> list[float]:
    """The numbers that a path such as `pose.position.x` or `ranges.min` leads to.

    Args:
        document: As for `holds`.
        path: Names and places with dots between them.
    """
    parts = tuple(int(part) if part.isdecimal() else part for part in path.split("."))
    found = _found(document, parts, FieldTypes.of(None).statistic(parts))
    values = (value for leaf in found for value in _elements(leaf))
    return [value for value in values if isinstance(value, int | float) and _is_number(value)]


def _node(node: Node, types: FieldTypes) -> Test:
    if isinstance(node, Not):
        negated = _node(node.item, types)
        return lambda document: not negated(document)
    if isinstance(node, And | Or):
        tests = [_node(item, types) for item in node.items]
        joined = all if isinstance(node, And) else any
        return lambda document: joined(test(document) for test in tests)
    stat = types.statistic(node.field.parts)
    return lambda document: _condition(node, document, stat)


def _condition(node: Condition, document: Document, stat: Stat | None) -> bool:
    found = _found(document, node.field.parts, stat)
    if isinstance(node, Exists):
        return bool(found) is node.present
    values = [value for leaf in found for value in _elements(leaf)]
    if isinstance(node, Compare):
        if node.order == "!=":
            return bool(found) and not any(_equal(value, node.value) for value in values)
        if node.order == "==":
            return any(_equal(value, node.value) for value in values)
        if _is_number(node.value):
            # A long array is a summary: its least or its greatest element answers for it.
            end = "min" if node.order in {"<", "<="} else "max"
            leaves = _values(document, node.field.parts)
            values.extend(leaf[end] for leaf in leaves if _is_summary(leaf))
        return any(_ordered(node.order, value, node.value) for value in values)
    if isinstance(node, Member):
        hit = any(_equal(value, wanted) for value in values for wanted in node.values)
    else:
        pattern = _pattern(node.pattern)
        hit = any(isinstance(value, str) and bool(pattern.search(value)) for value in values)
    return bool(found) and not hit if node.negated else hit


def _found(document: Document, parts: tuple[str | int, ...], stat: Stat | None) -> list[object]:
    """What a path leads to, statistics of arrays that are there element by element included."""
    found = list(_reach(document, parts))
    if stat is not None:
        found.extend(
            _statistic(stat, value)
            for value in _values(document, parts[:-1])
            if isinstance(value, list) and _has_statistic(value, stat)
        )
    return found


def _reach(value: object, parts: tuple[str | int, ...]) -> Iterator[object]:
    """What a path leads to; through an array, each element that it leads into."""
    if not parts:
        yield value
        return
    part, rest = parts[0], parts[1:]
    if isinstance(value, Mapping):
        if str(part) in value:
            yield from _reach(value[str(part)], rest)
    elif isinstance(value, list):
        if isinstance(part, int) and part < len(value):
            yield from _reach(value[part], rest)
        # MongoDB takes a number for a name, too.
        for element in value:
            if isinstance(element, Mapping):
                yield from _reach(element, parts)


def _values(value: object, parts: tuple[str | int, ...]) -> Iterator[object]:
    """What a path leads to; a number in it is a place in an array and no name."""
    if not parts:
        yield value
        return
    part, rest = parts[0], parts[1:]
    if isinstance(part, int):
        if isinstance(value, list) and part < len(value):
            yield from _values(value[part], rest)
        return
    for element in _elements(value):
        if isinstance(element, Mapping) and part in element:
            yield from _values(element[part], rest)


def _has_statistic(values: Sequence[object], stat: Stat) -> bool:
    """Whether an array has a statistic, and its elements have no field of that name."""
    if stat == "n":
        return not any(isinstance(value, Mapping) and stat in value for value in values)
    return all(isinstance(value, int | float) for value in values)


def _statistic(stat: Stat, values: Sequence[float]) -> float | None:
    if stat == "n":
        return len(values)
    finite = [value * 1 for value in values if math.isfinite(value)]  # True counts as 1
    if not finite:
        return None
    if stat == "mean":
        return _sum(finite) / len(finite)
    return min(finite) if stat == "min" else max(finite)


def _sum(values: Sequence[float]) -> float:
    # An integer beyond 2^53 is a double and a rest.
    rests = (value - int(float(value)) for value in values if isinstance(value, int))
    try:
        return math.fsum((*values, *rests))
    except OverflowError:
        return float(sum(values))


def _is_summary(leaf: object) -> TypeGuard[Mapping[str, object]]:
    return isinstance(leaf, Mapping) and leaf.keys() >= _SUMMARY


def _elements(leaf: object) -> Sequence[object]:
    return leaf if isinstance(leaf, list) else [leaf]


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _equal(value: object, wanted: Value) -> bool:
    if _is_number(value) and _is_number(wanted):
        return value == wanted or (value != value and wanted != wanted)  # noqa: PLR0124 - NaN
    return type(value) is type(wanted) and value == wanted


def _ordered(order: str, value: object, wanted: Value) -> bool:
    if isinstance(value, str) and isinstance(wanted, str):
        return _ORDERS[order](value, wanted)
    if _is_number(value) and _is_number(wanted):
        if value != value and wanted != wanted:  # noqa: PLR0124 - NaN
            return order in {"<=", ">="}
        return _ORDERS[order](value, wanted)  # type: ignore[arg-type]
    if isinstance(value, bool) and isinstance(wanted, bool):
        return _ORDERS[order](value, wanted)
    return value is None and wanted is None and order in {"<=", ">="}


@lru_cache(maxsize=256)
def _pattern(text: str) -> re.Pattern[str]:
    # As MongoDB reads it: \w, \d, \s and \b are about ASCII, and \Z may be before a last
    # end of line. Without regard to case it knows all letters; re.ASCII would not.
    ascii_only = re.ASCII if _IGNORES_CASE.search(text) is None else re.NOFLAG
    return re.compile(_ESCAPE.sub(_escape, text), ascii_only)


def _escape(found: re.Match[str]) -> str:
    return r"(?=\n?\Z)" if found[0] == r"\Z" else found[0]
