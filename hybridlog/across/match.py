"""Finds the messages around times by binary search, and values between two messages.

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

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import pyarrow as pa

from hybridlog.schema.arrow_types import COMPUTED_AS, is_number, numbers, numpy_type
from hybridlog.tf.tree import Transform
from hybridlog.tf.tree import interpolated as slerp
from hybridlog_storage.times import BEGIN

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray


HOWS: Final = ("asof", "nearest", "interpolate")
UNKNOWN = BEGIN
"""The time of a message that has none on a clock: it matches nothing."""

QUATERNIONS: Final = frozenset({"geometry_msgs/Quaternion", "geometry_msgs/msg/Quaternion"})
_PARTS: Final = ("x", "y", "z", "w")
_UNIT: Final = 1e-3  # greatest difference of a length from 1
_types = pa.types


class Matched(NamedTuple):
    """The messages that belong to n times, int64[n] each: their rows, -1 where none is near enough.

    `after` equals `before` if that decides alone; `distance` is the time of the message, of two the
    farther one, minus the time, ns.
    """

    before: NDArray[np.int64]
    after: NDArray[np.int64]
    distance: NDArray[np.int64]


def match(
    times: NDArray[np.int64],
    rows: NDArray[np.int64],
    how: str,
    tolerance: int | None,
    apart: int | None = None,
) -> Matched:
    """The messages that belong to some times.

    `asof` finds the last message not after a time, of equal times the last one. `nearest` finds
    that one or the first one after the time, and the earlier one if both are equally near.
    `interpolate` finds both, and a message of exactly that time alone. All times are ns, `rows`
    those of the messages, ascending; `UNKNOWN` matches nothing. Without a tolerance, any distance
    is near enough, up to `apart`: times that are farther apart are of different epochs.
    """
    if not len(rows):
        nothing = np.full(len(times), -1, np.int64)
        return Matched(nothing, nothing, np.zeros_like(nothing))
    before = np.searchsorted(rows, times, "right").astype(np.int64) - 1
    after = np.minimum(before + 1, len(rows) - 1)
    has_before, has_after = before >= 0, before + 1 < len(rows)
    earlier = rows[np.maximum(before, 0)] - times  # not positive where there is one
    later = rows[after] - times
    found = has_before
    distance = earlier
    if how == "nearest":
        takes_after = has_after & (~has_before | (later < -earlier))
        before = np.where(takes_after, after, before)
        distance = np.where(takes_after, later, earlier)
        found = has_before | has_after
    elif how == "interpolate":
        is_exact = has_before & (earlier == 0)
        found = is_exact | (has_before & has_after)
        distance = np.where(is_exact | (-earlier >= later), earlier, later)
        after = np.where(is_exact, before, after)
    if how != "interpolate":
        after = before
    found = found & (times != UNKNOWN)
    for limit in (tolerance, apart):
        if limit is not None:
            found = found & (np.abs(distance) <= limit)
    return Matched(
        np.where(found, before, -1), np.where(found, after, -1), np.where(found, distance, 0)
    )


def quaternion_paths(known: Mapping[str, str] | None) -> list[str]:
    """Paths of the quaternions among fields with these types (None where nothing fixes them)."""
    return [path for path, kind in (known or {}).items() if kind in QUATERNIONS]


def interpolated(
    before: pa.Table, after: pa.Table, weight: NDArray[np.float64], quaternions: Sequence[str]
) -> pa.Table:
    """Rows between the rows of two tables with the same columns; those that match nothing are null.

    The weight is 0 for the row before, 1 for the row after. Quaternions, given by path, are turned
    from one to the other if each part is a column.
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
    none = np.zeros((len(low), 3))
    with np.errstate(invalid="ignore", divide="ignore"):
        lengths = [np.linalg.norm(part, axis=1, keepdims=True) for part in (low, high)]
        unit = np.abs(np.hstack(lengths) - 1).max(axis=1) <= _UNIT
        begin, end = (Transform(none, low / lengths[0]), Transform(none, high / lengths[1]))
        between = slerp(begin, end, weight).rotation
    moves = unit & (weight > 0)
    # Where a part is NaN or missing, the result is NaN and not the message before.
    unknown = np.isnan(low).any(axis=1) | np.isnan(high).any(axis=1)
    found: NDArray[np.float64] = np.where(moves[:, np.newaxis], between, low)
    found[unknown] = np.nan
    return found
