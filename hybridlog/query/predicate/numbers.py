"""Exact comparisons of numbers and strings of any types."""

from __future__ import annotations

import math
from typing import TypeGuard

import numpy as np

from hybridlog.query.predicate.tree import Value
from hybridlog.schema.text import nearest

LOW, HIGH = -(2**63), 2**63 - 1
"""Smallest and greatest int64."""


def is_number(value: object) -> TypeGuard[float]:
    """True if a value is an integer or a float; booleans are neither."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def is_nan(value: object) -> bool:
    """True if a value is NaN."""
    return isinstance(value, float) and math.isnan(value)


def single(value: Value) -> Value:
    """The float32 nearest to a decimal literal; integers, and what float32 cannot hold, stay."""
    if not isinstance(value, float):
        return value
    with np.errstate(over="ignore"):
        near = float(np.float32(value))
    return near if math.isfinite(near) else value


def for_doubles(order: str, value: float) -> tuple[str, float]:
    """The equivalent comparison of doubles with a double, that nearest to a value.

    Args:
        order: `<`, `<=`, `>` or `>=`.
        value: The value they are compared with; an int may not be a double.
    """
    near = nearest(value)
    if near == value:
        return order, near
    # No double lies between both, so it is on the other side or it is not.
    return (order[0] if (order[0] == "<") == (near > value) else f"{order[0]}="), near


def for_integers(order: str, value: float) -> tuple[str, int] | bool:
    """The equivalent comparison of integers with an integer.

    Returns:
        Order and bound; or a bool if the comparison holds for all or for none.
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
    # Between two integers: x < 1.5 becomes x < 2, x <= 1.5 becomes x <= 1.
    return order, (math.ceil if order in {"<", ">="} else math.floor)(value)
