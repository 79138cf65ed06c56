"""Comparisons of numbers and strings, exact whatever their types."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeGuard

from hybridlog.query.predicate.tree import Value

LOW, HIGH = -(2**63), 2**63 - 1
"""Ends of int64."""
ORDERS: dict[str, Callable[[float | str, float | str], bool]] = {
    "<": lambda one, other: one < other,  # type: ignore[operator]
    "<=": lambda one, other: one <= other,  # type: ignore[operator]
    ">": lambda one, other: one > other,  # type: ignore[operator]
    ">=": lambda one, other: one >= other,  # type: ignore[operator]
}


def is_number(value: object) -> TypeGuard[float]:
    """Whether a value is an integer or a float; booleans are neither."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def is_nan(value: object) -> bool:
    """Whether a value is NaN."""
    return isinstance(value, float) and math.isnan(value)


def equal(value: object, wanted: Value) -> bool:
    """Whether two values are equal: numbers by value, NaN with NaN, nothing across kinds."""
    if is_number(value) and is_number(wanted):
        return value == wanted or (is_nan(value) and is_nan(wanted))
    if isinstance(wanted, str) or wanted is None or isinstance(wanted, bool):
        return type(value) is type(wanted) and value == wanted
    return False


def ordered(order: str, value: object, wanted: Value) -> bool:
    """Whether an order holds; numbers and strings have one, nothing else has."""
    if isinstance(value, str) and isinstance(wanted, str):
        return ORDERS[order](value, wanted)
    return is_number(value) and is_number(wanted) and ORDERS[order](value, wanted)


def nearest(value: float) -> float:
    """The nearest double; beyond the largest, an infinity."""
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf


def for_doubles(order: str, value: float) -> tuple[str, float]:
    """The comparison with a double that holds for the same doubles; `== nan` never comes back.

    Args:
        order: `<`, `<=`, `>` or `>=`.
        value: What they are compared with: an int may be no double.
    """
    near = nearest(value)
    if near == value:
        return order, near
    # No double lies between the value and its neighbours.
    below = near if near < value else math.nextafter(near, -math.inf)
    if order in {"<", "<="}:
        return "<=", below
    return ">=", math.nextafter(below, math.inf)


def for_integers(order: str, value: float) -> tuple[str, int] | bool:
    """The comparison with an integer that holds for the same integers.

    Returns:
        Order and bound; or whether the comparison holds for all, or for none.
    """
    if isinstance(value, int):
        return order, value
    if math.isnan(value):
        return False
    if math.isinf(value):
        return order in ({"<", "<="} if value > 0 else {">", ">="})
    if value.is_integer():
        return order, int(value)
    if order == "==":
        return False
    # Between two integers: x < 1.5 is x < 2, x <= 1.5 is x <= 1.
    return order, (math.ceil if order in {"<", ">="} else math.floor)(value)
