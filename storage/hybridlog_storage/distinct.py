"""Distinct values of an array, and its runs of equal values."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    T = TypeVar("T", bound=np.generic)


def distinct(values: NDArray[T]) -> NDArray[T]:
    """The distinct values in ascending order: T[n] to T[k].

    Its first call to `numpy.unique` would load masked arrays, which stops a recording for
    15 milliseconds during its first messages.
    """
    ordered = np.sort(values)
    return ordered[run_starts(ordered)]


def run_starts(values: NDArray[Any]) -> NDArray[np.intp]:
    """Places at which a run of equal values begins, ascending; of an empty array none."""
    is_first = np.ones(len(values), np.bool_)
    np.not_equal(values[1:], values[:-1], out=is_first[1:])
    return np.flatnonzero(is_first)
