"""Summaries (count, minimum, maximum, mean) of arrays too long for an index document."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec import Struct

from hybridlog.schema.column import Scalars
from hybridlog.schema.text import nearest

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray


_LONG = 4096  # elements of rows that are summed one by one, as of images and clouds


class Summary(Struct):
    """Summaries of the rows of an array column.

    Attributes:
        n: int64[rows], elements, whether finite or not.
        min: shape (rows,), least finite element: int64 for integers and booleans,
            uint64 for uint64, float64 for floats; 0 where `has` is False.
        max: The greatest, in the same form.
        mean: float64[rows], mean of the finite elements; 0 where `has` is False.
        has: bool[rows], whether the row has a finite element at all.
    """

    n: NDArray[np.int64]
    min: NDArray[Any]
    max: NDArray[Any]
    mean: NDArray[np.float64]
    has: NDArray[np.bool_]


def summary_of(values: Sequence[object]) -> Summary | None:
    """The summary of one list of Python numbers and booleans; None of other values."""
    if not all(isinstance(value, int | float) for value in values):
        return None
    numbers: NDArray[Any] = np.array([nearest(value) for value in values], np.float64)  # type: ignore[arg-type]
    if values and not any(isinstance(value, float) for value in values):
        for kind in (np.uint64, np.int64) if min(values) >= 0 else (np.int64,):  # type: ignore[type-var, operator]
            with suppress(OverflowError):
                numbers = np.array(values, kind)
    return summarise(Scalars(numbers), np.array([0, len(numbers)], np.int64))


def summarise(values: Scalars, offset: NDArray[np.int64]) -> Summary:
    """Summarise every row of a ragged array; row i is `values[offset[i]:offset[i + 1]]`.

    The summary of a row depends on its elements alone, to the last bit. Sums of floats use one
    `reduceat`, which adds each segment separately and in the same order. A regular-grid reduction
    is never used, because its order may differ.
    """
    elements = values.values[int(offset[0]) : int(offset[-1])]
    offset = offset - offset[0]
    counts = np.diff(offset)
    if elements.dtype == np.bool_:
        elements = elements.view(np.uint8)
    with np.errstate(all="ignore"):
        if elements.dtype.kind == "f":
            return _floats(elements, offset, counts)
        return _integers(elements, offset[:-1], counts)


def _integers(
    elements: NDArray[Any], start: NDArray[np.int64], counts: NDArray[np.int64]
) -> Summary:
    has = counts > 0
    exact: type[np.generic] = np.uint64 if elements.dtype == np.uint64 else np.int64
    low, high = (np.zeros(len(counts), exact) for _ in range(2))
    mean = np.zeros(len(counts), np.float64)
    if has.any():
        # reduceat would return a neighbour's value for rows without elements.
        begin = start[has]
        low[has] = np.minimum.reduceat(elements, begin)
        high[has] = np.maximum.reduceat(elements, begin)
        if elements.dtype.itemsize == 8:
            # Sums of 64-bit integers could overflow.
            sums = np.add.reduceat(elements.astype(np.float64), begin)
        else:
            sums = _exact_sums(elements, begin, counts[has])
        mean[has] = sums / counts[has]
    return Summary(counts, low, high, mean, has)


def _exact_sums(
    elements: NDArray[Any], begin: NDArray[np.int64], counts: NDArray[np.int64]
) -> NDArray[Any]:
    """Exact sums of segments of integers of at most 32 bits."""
    if elements.dtype.itemsize == 4 or int(counts.mean()) < _LONG:
        return np.add.reduceat(elements, begin, dtype=np.int64)
    rows = zip(begin.tolist(), (begin + counts).tolist(), strict=True)
    return np.array([elements[first:end].sum() for first, end in rows])


def _floats(
    elements: NDArray[Any], offset: NDArray[np.int64], counts: NDArray[np.int64]
) -> Summary:
    finite = np.isfinite(elements)
    present = counts
    if not finite.all():
        seen = np.concatenate(([0], np.cumsum(finite, dtype=np.int64)))
        offset = seen[offset]
        present = np.diff(offset)
        elements = elements[finite]
    has = present > 0
    low, high, mean = (np.zeros(len(counts), np.float64) for _ in range(3))
    if has.any():
        begin = offset[:-1][has]
        # Adding 0.0 turns -0.0 into 0.0. Otherwise the zero that a reduction returns would
        # depend on the order of comparisons in the processor.
        low[has] = np.minimum.reduceat(elements, begin) + elements.dtype.type(0)
        high[has] = np.maximum.reduceat(elements, begin) + elements.dtype.type(0)
        wide = elements.astype(np.float64, copy=False)
        mean[has] = np.add.reduceat(wide, begin) / present[has] + 0.0
        if not np.isfinite(mean).all():  # no sum of doubles overflows a longer one
            longer = np.add.reduceat(wide, begin, dtype=np.longdouble)
            mean[has] = np.where(np.isfinite(mean[has]), mean[has], longer / present[has])
    return Summary(counts, low, high, mean, has)
