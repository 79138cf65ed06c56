"""Exact comparisons of numbers and strings of any types."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from hybridlog.query.predicate.tree import Value
from hybridlog.schema.arrow_types import is_text, is_time
from hybridlog.schema.text import nearest

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Mask = NDArray[np.bool_]

LOW, HIGH = -(2**63), 2**63 - 1
"""Smallest and greatest int64."""
_ORDERS: dict[str, np.ufunc] = {
    "==": np.equal,
    "<": np.less,
    "<=": np.less_equal,
    ">": np.greater,
    ">=": np.greater_equal,
}


def is_number(value: object) -> TypeGuard[float]:
    """True if a value is an integer or a float; booleans are neither."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def to_numpy(values: Any) -> NDArray[Any]:
    """An Arrow array as one of numpy."""
    found: NDArray[Any] = values.to_numpy(zero_copy_only=False)
    return found


def kind_of(values: Any) -> str:
    """The kind of values, as numpy names it: b, i, f, U; O of large integers, empty of others."""
    if isinstance(values, np.ndarray):
        return "O"
    kind = values.type
    if is_text(kind):
        return "U"
    if pa.types.is_boolean(kind):
        return "b"
    if pa.types.is_floating(kind):
        return "f"
    return "i" if pa.types.is_integer(kind) or is_time(kind) else ""


def compared(values: Any, op: str, operands: Sequence[Value]) -> Mask:
    """Mask of the values, none of them null, that `==`, `in`, `~` or an order holds for."""
    if op == "~":
        if kind_of(values) != "U":
            return np.zeros(len(values), np.bool_)
        return to_numpy(pc.match_substring_regex(values, str(operands[0])))
    are_int64 = all(type(value) is int and LOW <= value <= HIGH for value in operands)
    if len(operands) > 1 and are_int64 and isinstance(values, pa.Int64Array):
        return to_numpy(pc.is_in(values, pa.array(operands, pa.int64())))
    found = np.zeros(len(values), np.bool_)
    for value in operands:
        found |= _compared(values, "==" if op == "in" else op, value)
    return found


def compared_rows(left: NDArray[Any], op: str, right: NDArray[Any]) -> Mask:
    """Compare numbers with others, exactly."""
    if left.dtype.kind != right.dtype.kind:
        left, right = left.astype(object), right.astype(object)
    with np.errstate(invalid="ignore"):  # NaN
        return _ORDERS[op](left, right).astype(np.bool_)  # type: ignore[no-any-return]


def single(value: Value) -> Value:
    """The float32 nearest to a decimal literal; integers, and what float32 cannot hold, stay."""
    if not isinstance(value, float):
        return value
    with np.errstate(over="ignore"):
        near = float(np.float32(value))
    return near if math.isfinite(near) else value


def _compared(values: Any, order: str, value: Value) -> Any:
    """Mask of the values that an order holds for; False for values of another kind."""
    kind = kind_of(values)
    wanted = {bool: "b", str: "U"}.get(type(value), "ifO" if is_number(value) else "")
    if not kind or kind not in wanted:
        return False
    if kind == "O":
        return _ORDERS[order](values, value).astype(np.bool_)
    if kind in "bU":
        return to_numpy(getattr(pc, _ORDERS[order].__name__)(values, pa.scalar(value, values.type)))
    numbers = to_numpy(values.cast(pa.int64()) if is_time(values.type) else values)
    compare = _integers_compared if kind == "i" else _floats_compared
    return compare(numbers, order, value)  # type: ignore[arg-type]


def _integers_compared(numbers: NDArray[Any], order: str, value: float) -> Any:
    """Compare integers with any number, exactly."""
    limit: int
    if isinstance(value, int):
        limit = value
    elif math.isnan(value):
        return False
    elif math.isinf(value):
        return order in ({"<", "<="} if value > 0 else {">", ">="})
    elif value.is_integer():
        limit = int(value)
    elif order == "==":
        return False
    else:  # between two integers: x < 1.5 becomes x < 2, x <= 1.5 becomes x <= 1
        limit = (math.ceil if order in {"<", ">="} else math.floor)(value)
    info = np.iinfo(numbers.dtype)
    if limit > info.max:
        return order in {"<", "<="}
    if limit < info.min:
        return order in {">", ">="}
    return _ORDERS[order](numbers, numbers.dtype.type(limit))


def _floats_compared(numbers: NDArray[Any], order: str, value: float) -> Any:
    """Compare floats with any number, exactly."""
    wide = numbers.astype(np.float64, copy=False)
    near = nearest(value)
    if math.isnan(near):
        return np.isnan(wide) if order == "==" else False
    if near == value:
        return _ORDERS[order](wide, near)
    if order == "==":
        return False
    # No double lies between both, so it is on the other side or it is not.
    order = order[0] if (order[0] == "<") == (near > value) else f"{order[0]}="
    return _ORDERS[order](wide, near)
