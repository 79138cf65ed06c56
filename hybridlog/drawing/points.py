"""Scans and point clouds as points to draw: float32 arrays of bounded length."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np

from hybridlog.arrays.message_arrays import (
    POINT_MAKERS,
    attributes,
    plain_type,
    positions,
    to_numpy,
)
from hybridlog.tf.tree import placed
from hybridlog_storage.errors import PayloadError

if TYPE_CHECKING:
    from collections.abc import Collection

    from numpy.typing import NDArray

    from hybridlog.message import Message

MAX_POINTS: Final = 500_000
"""Points that are drawn at most, unless the caller says otherwise."""
COLOUR: Final = "rgb"
"""Name of the values that are colours: red * 65536 + green * 256 + blue."""
_MAX_VALUES = 64
_FAR_M = 8192.0  # m; from here on float32 has steps of a millimetre
_AXES = ("x", "y", "z")
_NONE: Final = np.empty(0)
_PARTS = (("red", "green", "blue"), ("r", "g", "b"))


Points: TypeAlias = "dict[str, Any]"
"""The points of a message.

* `xyz`: float32[n, 3], metres from `origin`, in the frame of the message.
* `values`: float64[n] for each name that was asked for, NaN where a point has none. Those called
  `rgb` are colours, red * 65536 + green * 256 + blue.
* `frame`: the frame's name.
* `names`: every name that can be asked for.
* `total`: points of the message.
* `dropped`: number of points that are left out, by reason.
* `every`: 1 if all others are here, n if only every n-th is.
* `origin`: metres, [0, 0, 0] unless float32 would lose millimetres without it.
* `flat`: true if all points have the same z, as those of a scan.
"""


def points(
    message: Message, *, values: Collection[str] | None = None, limit: int = MAX_POINTS
) -> Points:
    """The points of a scan or cloud, a message of sensor_msgs or Foxglove.

    Points that are not finite, and ranges outside of those that the scanner can measure, are left
    out. Of more points than the limit, every n-th is taken. `values` are names of what is wanted of
    each point; None for all, and unknown ones are left out.
    """
    kind = plain_type(message.type)
    if kind not in POINT_MAKERS:
        raise PayloadError(
            f"{message.type or 'a message without a type'} has no points; "
            f"{', '.join(POINT_MAKERS)} have."
        )
    decoded = attributes(message.decode())
    rows = to_numpy(message.type, decoded).reshape(-1)
    try:
        return _drawn(decoded, rows, values, limit)
    except (AttributeError, TypeError, ValueError, OverflowError) as error:
        raise PayloadError(f"this {message.type} has unusual fields: {error}") from error


def _drawn(decoded: Any, rows: NDArray[Any], values: Collection[str] | None, limit: int) -> Points:
    is_scan = hasattr(decoded, "ranges")
    least, greatest = _bounds_of_ranges(decoded)
    pose = getattr(decoded, "pose", None)

    def axes_of(part: NDArray[Any]) -> list[NDArray[Any]]:
        return _posed([*positions(part).T] if is_scan else _axes(part), pose)

    with np.errstate(over="ignore", invalid="ignore"):
        origin = tuple(_origin(axis) for axis in axes_of(_some(rows)))

        axes = zip(axes_of(rows), origin, strict=True)
        xyz = np.stack([(axis - base).astype(np.float32) for axis, base in axes], axis=1)
        chosen = np.isfinite(xyz).all(axis=1)
        finite = int(np.count_nonzero(chosen))
        if is_scan:
            chosen &= (rows["range"] >= least) & (rows["range"] <= greatest)
        places = np.flatnonzero(chosen)
        count = len(places)
        every = max(1, -(-count // max(limit, 1)))
        xyz, taken = xyz[places[::every]], rows[places[::every]]
        offered = _offered(taken)
        chosen_values = {
            name: column.astype(np.float64)
            for name, column in offered.items()
            if values is None or name in values
        }
    dropped = {"not finite": len(rows) - finite, "out of range": finite - count}
    return {
        "xyz": xyz,
        "values": chosen_values,
        "frame": _frame(decoded),
        "names": tuple(offered),
        "total": len(rows),
        "dropped": {why: number for why, number in dropped.items() if number},
        "every": every,
        "origin": origin,
        "flat": is_scan if not len(xyz) else bool((xyz[:, 2] == xyz[0, 2]).all()),
    }


def _axes(rows: NDArray[Any]) -> list[NDArray[Any]]:
    """x, y and z of the points of a cloud; one that lacks is 0, two are refused."""
    names = rows.dtype.names or ()
    if not len(rows):
        return [np.zeros(0)] * 3
    if sum(name in names for name in _AXES) < 2:
        raise PayloadError(f"a point cloud has no x, y and z; its fields are {', '.join(names)}")
    axes = [rows[name] if name in names else np.zeros(len(rows)) for name in _AXES]
    if any(axis.ndim > 1 for axis in axes):
        raise PayloadError("x, y and z of a point cloud are not single numbers")
    return axes


def _posed(axes: list[NDArray[Any]], pose: Any) -> list[NDArray[Any]]:
    """The points in the frame of the message; without a pose in it, they are in it already."""
    if pose is None:
        return axes
    own = placed(pose)
    if not (own.translation.any() or own.rotation[:3].any()):
        return axes
    return list(own.apply(np.stack(axes, axis=-1)).T)


def _origin(axis: NDArray[Any]) -> float:
    """Offset to subtract so that float32 keeps millimetres; 0 where it does anyway."""
    if axis.dtype.itemsize <= 4 and axis.dtype.kind == "f":
        return 0.0
    finite = axis[np.isfinite(axis)]
    if not len(finite):
        return 0.0
    low, middle, high = np.quantile(_some(finite), (0.01, 0.5, 0.99)).tolist()
    far = max(abs(low), abs(high))
    return float(round(middle)) if far > _FAR_M and far > 2 * (high - low) else 0.0


def _bounds_of_ranges(scan: Any) -> tuple[np.float32, np.float32]:
    """Least and greatest range that the scanner can measure, m; none if they contradict."""
    least, greatest = (np.float32(getattr(scan, f"range_{end}", 0)) for end in ("min", "max"))
    return (least, greatest) if least < greatest else (np.float32(-np.inf), np.float32(np.inf))


def _offered(rows: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """The values of points by name, in the types of the message. Colours are first."""
    found: dict[str, NDArray[Any]] = {}
    for name in rows.dtype.names or ():
        column = rows[name]
        if name in {"rgb", "rgba"} and column.dtype.itemsize == 4 and column.ndim == 1:
            whole = np.ascontiguousarray(column, column.dtype.newbyteorder("="))
            found.setdefault(COLOUR, whole.view(np.uint32) & 0xFFFFFF)
        elif column.ndim > 1:
            shown = range(min(column.shape[1], _MAX_VALUES))
            found |= {f"{name}[{place}]": column[:, place] for place in shown}
        elif name not in _AXES:
            found[name] = column
    for parts in _PARTS:
        if COLOUR not in found and all(found.get(name, _NONE).dtype == "u1" for name in parts):
            red, green, blue = (found[name].astype(np.uint32) for name in parts)
            found = {COLOUR: red << 16 | green << 8 | blue} | found
    return dict(list(found.items())[:_MAX_VALUES])


def bounds(values: NDArray[np.floating[Any]]) -> tuple[float, float, float, float] | None:
    """Least and greatest finite value, and those without the outermost hundredths.

    Garbage in a few points does not change the latter much. None if no value is finite.
    """
    finite = values[np.isfinite(values)]
    if not len(finite):
        return None
    low, high = np.quantile(_some(finite), (0.01, 0.99))
    return float(finite.min()), float(finite.max()), float(low), float(high)


def _some(values: NDArray[Any]) -> NDArray[Any]:
    """Values that stand for all in a quantile."""
    return values[:: max(1, len(values) // 20_000)]


def _frame(message: Any) -> str:
    header = getattr(message, "header", message)
    return str(getattr(header, "frame_id", ""))
