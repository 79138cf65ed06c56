"""Predicates on one document in memory, with the meaning that MongoDB gives them.

A trigger is asked of every message as it comes, long before that is in a database.
`tests/query/test_where.py` holds the answers against a MongoDB's.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, TypeGuard

from hybridlog.query.where import And, Compare, Exists, Member, Not, Or

if TYPE_CHECKING:
    from hybridlog.query.where import Condition, Expression, Node, Value

_STATISTICS: dict[str, Callable[[Sequence[float]], float]] = {
    "min": min,
    "max": max,
    "mean": lambda values: math.fsum(values) / len(values),
}
_SUMMARY = frozenset({"n", *_STATISTICS})
_ORDERS: dict[str, Callable[[float | str, float | str], bool]] = {
    "<": lambda one, other: one < other,  # type: ignore[operator]
    "<=": lambda one, other: one <= other,  # type: ignore[operator]
    ">": lambda one, other: one > other,  # type: ignore[operator]
    ">=": lambda one, other: one >= other,  # type: ignore[operator]
}


def holds(expression: Expression, document: Mapping[str, object]) -> bool:
    """Whether a predicate holds for a document.

    Args:
        expression: As `where.parse` gives it.
        document: Fields of an index document: dict, list, str, bool, int, float, None.
    """
    return _node(expression.root, document)


def numbers_at(document: Mapping[str, object], path: str) -> list[float]:
    """The numbers that a path such as `pose.position.x` or `ranges.min` leads to.

    Args:
        document: As for `holds`.
        path: Names and places with dots between them.
    """
    parts = tuple(int(part) if part.isdecimal() else part for part in path.split("."))
    values = (value for leaf in _reach(document, parts) for value in _elements(leaf))
    return [value for value in values if isinstance(value, int | float) and _is_number(value)]


def _node(node: Node, document: Mapping[str, object]) -> bool:
    if isinstance(node, And):
        return all(_node(item, document) for item in node.items)
    if isinstance(node, Or):
        return any(_node(item, document) for item in node.items)
    if isinstance(node, Not):
        return not _node(node.item, document)
    return _condition(node, document)


def _condition(node: Condition, document: Mapping[str, object]) -> bool:
    found = list(_reach(document, node.field.parts))
    if isinstance(node, Exists):
        return bool(found) is node.present
    values = [value for leaf in found for value in _elements(leaf)]
    if isinstance(node, Compare):
        if node.order == "!=":
            return bool(found) and not any(_equal(value, node.value) for value in values)
        if node.order == "==":
            return any(_equal(value, node.value) for value in values)
        # A long array is a summary: its least or its greatest element answers for it.
        end = "min" if node.order in {"<", "<="} else "max"
        values.extend(leaf[end] for leaf in found if _is_summary(leaf))
        return any(_ordered(node.order, value, node.value) for value in values)
    if isinstance(node, Member):
        hit = any(_equal(value, wanted) for value in values for wanted in node.values)
    else:
        pattern = _pattern(node.pattern)
        hit = any(isinstance(value, str) and bool(pattern.search(value)) for value in values)
    return bool(found) and not hit if node.negated else hit


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
        if isinstance(part, int):
            if part < len(value):
                yield from _reach(value[part], rest)
            return
        if not rest and part in _SUMMARY and all(isinstance(v, int | float) for v in value):
            # A short array has no summary, but answers as if it had one.
            yield _statistic(part, value)
            return
        for element in value:
            if isinstance(element, Mapping):
                yield from _reach(element, parts)


def _statistic(name: str, values: Sequence[float]) -> float | None:
    if name == "n":
        return len(values)
    finite = [float(value) for value in values if math.isfinite(value)]
    return _STATISTICS[name](finite) if finite else None


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
    return re.compile(text)
