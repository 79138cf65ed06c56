"""Comparison of messages: numbers by value, strings by bytes, lists by length and elements."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from hybridlog.columns.fields import joined
from hybridlog.schema.arrow_types import is_list, lengths_of
from hybridlog.schema.column import ranges

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Places = NDArray[np.intp]


def steps(
    carried: pa.StructArray | None, rows: pa.StructArray, tolerance: float
) -> tuple[NDArray[np.bool_], pa.StructArray]:
    """The rows that differ from the row before them (bool[n]), and the last row.

    `carried` is the row before the first one, if there is one.
    """
    whole = rows if carried is None else joined([carried, rows])
    numbers = np.arange(len(whole))
    differs = rows_differ(whole, numbers, np.maximum(numbers - 1, 0), tolerance)
    return differs[len(whole) - len(rows) :], whole[-1:]


def rows_differ(
    column: pa.Array[Any], one: Places, other: Places, tolerance: float = 0.0
) -> NDArray[np.bool_]:
    """True where rows of a column, possibly nested, differ from other rows of it.

    NaN equals NaN, -0 equals 0, and null equals only null; numbers are equal if they differ by at
    most the tolerance. Lists of different lengths differ.
    """
    kind = column.type
    if isinstance(kind, pa.BaseExtensionType):  # JSON text
        return rows_differ(column.storage, one, other)
    if pa.types.is_null(kind):
        return np.zeros(len(one), np.bool_)
    valid: NDArray[np.bool_] = np.asarray(column.is_valid(), np.bool_)
    differs: NDArray[np.bool_] = valid[one] != valid[other]
    there = valid[one] & valid[other]
    if pa.types.is_struct(kind):
        for inner in column.flatten():
            differs |= there & rows_differ(inner, one, other, tolerance)
        return differs
    if is_list(kind):
        rows = np.flatnonzero(there)
        differs[rows] = _lists(column, one[rows], other[rows], tolerance)
        return differs
    differs |= there & _values(column, one, other, tolerance)
    return differs


def _values(
    column: pa.Array[Any], one: Places, other: Places, tolerance: float
) -> NDArray[np.bool_]:
    kind = column.type
    if not (pa.types.is_primitive(kind) and not pa.types.is_decimal(kind)):
        codes = pc.fill_null(column.dictionary_encode().indices, -1)
        values = codes.to_numpy(zero_copy_only=False)
    else:
        if pa.types.is_temporal(kind):
            column = column.view(pa.int64())
        values = pc.fill_null(column, False if pa.types.is_boolean(kind) else 0).to_numpy(
            zero_copy_only=False
        )
    left, right = values[one], values[other]
    same = left == right
    if left.dtype.kind == "f":
        same |= np.isnan(left) & np.isnan(right)
    if tolerance and left.dtype.kind in "iuf" and pa.types.is_primitive(kind):
        with np.errstate(invalid="ignore"):  # inf - inf is NaN, which is not near
            same |= np.abs(left.astype(np.float64) - right.astype(np.float64)) <= tolerance
    differs: NDArray[np.bool_] = ~same
    return differs


def _lists(
    column: pa.Array[Any], one: Places, other: Places, tolerance: float
) -> NDArray[np.bool_]:
    length = lengths_of(column)
    if pa.types.is_fixed_size_list(column.type):
        start = (column.offset + np.arange(len(column))) * column.type.list_size
    else:
        start = column.offsets.to_numpy()[:-1].astype(np.int64)
    elements = column.values
    count = length[one]
    found: NDArray[np.bool_] = count != length[other]
    alike = np.flatnonzero(~found & (count > 0))
    if len(alike):
        count = count[alike]
        differs = rows_differ(
            elements,
            ranges(start[one[alike]], count),
            ranges(start[other[alike]], count),
            tolerance,
        )
        found[alike] = np.logical_or.reduceat(differs, np.cumsum(count) - count)
    return found
