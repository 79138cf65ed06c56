"""Comparison of messages: numbers by value, strings by bytes, lists by length and elements."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from hybridlog.query.predicate.numbers import equal, is_number, nearest
from hybridlog.schema.arrow_types import is_list, lengths_of
from hybridlog.schema.column import ranges

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    Rows = NDArray[np.intp]


def rows_differ(
    column: pa.Array[Any], one: Rows, other: Rows, tolerance: float = 0.0
) -> NDArray[np.bool_]:
    """Compare rows of a column with other rows of it.

    NaN equals NaN, -0 equals 0, and null equals only null. Lists of different lengths differ.

    Args:
        column: The column, possibly nested.
        one: intp[n], rows.
        other: intp[n], the rows to compare them with.
        tolerance: Numbers are equal if they differ by at most this.

    Returns:
        bool[n], True where they differ.
    """
    kind = column.type
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


def _values(column: pa.Array[Any], one: Rows, other: Rows, tolerance: float) -> NDArray[np.bool_]:
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


def _lists(column: pa.Array[Any], one: Rows, other: Rows, tolerance: float) -> NDArray[np.bool_]:
    length = lengths_of(column)
    start = np.cumsum(length) - length  # of the elements that `flatten` returns
    elements = column.flatten()
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


_MISSING: Final = object()


def objects_differ(
    one: object, other: object, paths: Iterable[Sequence[str]], tolerance: float = 0.0
) -> bool:
    """Compare some fields of two messages that are plain objects, as `rows_differ` does.

    A missing field differs from null, and values of different kinds differ.

    Args:
        one: A message.
        other: Another one.
        paths: The names that lead to each field; through a list, to that of each element.
        tolerance: As for `rows_differ`.
    """
    left: list[tuple[object, object, Sequence[str]]] = [(one, other, path) for path in paths]
    while left:
        a, b, path = left.pop()
        if isinstance(a, list) and isinstance(b, list):
            if len(a) != len(b):
                return True
            left += [(x, y, path) for x, y in zip(a, b, strict=True)]
        elif path and (isinstance(a, list) or isinstance(b, list)):
            return True
        elif path:
            x, y = (
                m.get(path[0], _MISSING) if isinstance(m, Mapping) else _MISSING for m in (a, b)
            )
            left.append((x, y, path[1:] if x is not y else ()))
        elif isinstance(a, Mapping) and isinstance(b, Mapping):
            if a.keys() != b.keys():
                return True
            left += [(value, b[name], ()) for name, value in a.items()]
        elif not _same(a, b, tolerance):
            return True
    return False


def _same(one: object, other: object, tolerance: float) -> bool:
    if is_number(one) and is_number(other):
        near = tolerance > 0 and abs(nearest(one) - nearest(other)) <= tolerance
        return near or equal(one, other)
    return type(one) is type(other) and one == other
