"""Values between two messages.

| values | between two messages |
|---|---|
| floats | linear, in their own type |
| integers | linear, as doubles |
| `geometry_msgs/Quaternion` of unit length | on the sphere, the shorter way |
| all others: times, truth values, strings, arrays, other quaternions | of the message before |

Where one of the two is null or NaN, so is the result. An angle is a number like any other:
nothing says in a definition that it wraps.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa

from hybridlog.schema.arrow_columns import numbers
from hybridlog.schema.arrow_types import COMPUTED_AS, is_number, numpy_type

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

QUATERNIONS: Final = frozenset({"geometry_msgs/Quaternion", "geometry_msgs/msg/Quaternion"})
_PARTS: Final = ("x", "y", "z", "w")
_UNIT: Final = 1e-3  # greatest difference of a length from 1
_STRAIGHT: Final = 0.9995  # cosine above which an arc is taken as a line
_types = pa.types


def quaternion_paths(known: Mapping[str, str] | None) -> list[str]:
    """Paths of the quaternions among fields.

    Args:
        known: Types of all fields, by path; None if no definition fixes them.
    """
    return [path for path, kind in (known or {}).items() if kind in QUATERNIONS]


def interpolated(
    before: pa.Table, after: pa.Table, weight: NDArray[np.float64], quaternions: Sequence[str]
) -> pa.Table:
    """Rows between the rows of two tables.

    Args:
        before: n rows; those that match nothing are null.
        after: n rows with the same columns.
        weight: float64[n], 0 for the row before, 1 for the row after.
        quaternions: Paths of quaternions; those with a column for each part count.
    """
    columns: dict[str, Any] = dict(zip(before.column_names, before.columns, strict=True))
    done: set[str] = set()
    for path in quaternions:
        names = [f"{path}.{part}" for part in _PARTS]
        if not set(names) <= columns.keys():
            continue
        found = _on_the_sphere(
            np.stack([_doubles(before[name]) for name in names], axis=1),
            np.stack([_doubles(after[name]) for name in names], axis=1),
            weight,
        )
        for name, values in zip(names, found.T, strict=True):
            columns[name] = _like(values, before[name], after[name])
        done.update(names)
    for name, column in columns.items():
        kind = column.type
        if name in done or not is_number(kind):
            continue
        low, high = _doubles(before[name]), _doubles(after[name])
        with np.errstate(invalid="ignore", over="ignore"):
            between = low + (high - low) * weight
        between = np.where(weight == 0, low, between)  # infinities have no difference
        columns[name] = _like(between, before[name], after[name])
    return pa.table(columns)


def _doubles(column: pa.ChunkedArray[Any]) -> NDArray[np.float64]:
    column = column.cast(COMPUTED_AS.get(column.type, column.type))
    values: NDArray[np.float64] = column.cast(pa.float64(), safe=False).fill_null(np.nan).to_numpy()
    return values


def _like(
    values: NDArray[np.float64], before: pa.ChunkedArray[Any], after: pa.ChunkedArray[Any]
) -> pa.Array[Any]:
    """Numbers as a column: null where one of the two is, floats in their own type."""
    missing = np.zeros(len(values), np.bool_)
    for column in (before, after):
        if column.null_count:
            missing |= column.is_null().to_numpy()
    kind = before.type if _types.is_floating(before.type) else pa.float64()
    found = values.astype(numpy_type(kind))
    return pa.array(found, kind, mask=missing) if missing.any() else numbers(found)


def _on_the_sphere(
    low: NDArray[np.float64], high: NDArray[np.float64], weight: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Quaternions between quaternions, float64[n, 4]; `low` where one is not of unit length."""
    with np.errstate(invalid="ignore", divide="ignore"):
        lengths = [np.linalg.norm(part, axis=1, keepdims=True) for part in (low, high)]
        unit = np.abs(np.hstack(lengths) - 1).max(axis=1) <= _UNIT
        begin, end = (part / length for part, length in zip((low, high), lengths, strict=True))
        cosine = np.sum(begin * end, axis=1, keepdims=True)
        end = np.where(cosine < 0, -end, end)
        angle = np.arccos(np.minimum(np.abs(cosine), 1))
        part = weight[:, np.newaxis]
        arc = (np.sin((1 - part) * angle) * begin + np.sin(part * angle) * end) / np.sin(angle)
        line = begin + (end - begin) * part
        line /= np.linalg.norm(line, axis=1, keepdims=True)
        between = np.where(np.abs(cosine) > _STRAIGHT, line, arc)
    moves = unit & (weight > 0)
    # Where a part is NaN or missing, the result is NaN and not the message before.
    unknown = np.isnan(low).any(axis=1) | np.isnan(high).any(axis=1)
    found: NDArray[np.float64] = np.where(moves[:, np.newaxis], between, low)
    found[unknown] = np.nan
    return found
