"""Which rows of columns differ: numbers by value, strings by their bytes, arrays by both."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hybridlog.schema.column import Arrays, Column, Records, Scalars, Strings, ranges

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Rows = NDArray[np.intp]


def unequal(column: Column, one: Rows, other: Rows, tolerance: float = 0.0) -> NDArray[np.bool_]:
    """Compare rows of a column with other rows of it.

    NaN equals NaN, and -0 equals 0. Arrays of different lengths differ.

    Args:
        column: The column.
        one: intp[n], rows.
        other: intp[n], the rows that they are compared with.
        tolerance: Numbers that differ by at most so much are the same.

    Returns:
        bool[n], whether they differ.
    """
    if isinstance(column, Scalars):
        return _scalars(column, one, other, tolerance)
    found: NDArray[np.bool_]
    if isinstance(column, Records):
        found = np.zeros(len(one), np.bool_)
        for inner in column.fields.values():
            found |= unequal(inner, one, other, tolerance)
        return found
    offset = column.offset
    length = np.diff(offset)
    count = length[one]
    found = count != length[other]
    alike = np.flatnonzero(~found & (count > 0))
    if not len(alike):
        return found
    count = count[alike]
    inside = ranges(offset[one[alike]], count), ranges(offset[other[alike]], count)
    found[alike] = _any_in_each(_elements(column, *inside, tolerance), count)
    return found


def _scalars(column: Scalars, one: Rows, other: Rows, tolerance: float) -> NDArray[np.bool_]:
    left, right = column.values[one], column.values[other]
    same = left == right
    if left.dtype.kind == "f":
        same |= np.isnan(left) & np.isnan(right)
    if tolerance and left.dtype.kind in "iuf":
        with np.errstate(invalid="ignore"):  # inf less inf is no number, and not near
            same |= np.abs(left.astype(np.float64) - right.astype(np.float64)) <= tolerance
    differs: NDArray[np.bool_] = ~same
    return differs


def _elements(
    column: Strings | Arrays, one: Rows, other: Rows, tolerance: float
) -> NDArray[np.bool_]:
    if isinstance(column, Strings):
        differs: NDArray[np.bool_] = column.data[one] != column.data[other]
        return differs
    return unequal(column.values, one, other, tolerance)


def _any_in_each(marks: NDArray[np.bool_], count: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether any mark is set in each of the groups, which have `count` marks, one or more."""
    found: NDArray[np.bool_] = np.logical_or.reduceat(marks, np.cumsum(count) - count)
    return found
