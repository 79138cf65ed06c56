"""Scans and point clouds as numpy arrays, over the bytes of a message, which are checked first."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from hybridlog_storage.errors import PayloadError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

POINT_TYPES: Final[Mapping[int, str]] = dict(
    enumerate(("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"), 1)
)
"""Types of the fields of a PointCloud2 by their number, as numpy spells them."""
_FOXGLOVE_TYPES: Final[Mapping[int, str]] = dict(
    enumerate(("u1", "i1", "u2", "i2", "u4", "i4", "f4", "f8"), 1)
)
MAX_FIELDS: Final = 256
"""Greatest number of fields of a point."""
MAX_EMPTY: Final = 1 << 31
"""Greatest size of an empty array beside a size of zero."""


def byte_array(data: Any) -> NDArray[np.uint8]:
    """The bytes of a uint8 sequence, as a view if it is an array or a buffer.

    Text is base64, as in JSON.
    """
    if isinstance(data, str):
        data = base64.b64decode(data, validate=True)
    if isinstance(data, (bytes, bytearray, memoryview)):
        return np.frombuffer(data, np.uint8)
    if isinstance(data, list):
        return np.asarray(data, np.uint8)
    return np.ascontiguousarray(data).view(np.uint8).reshape(-1)


def check_rows(what: str, shape: tuple[int, int], row: int, step: int, size: int) -> None:
    """Check that rows of `row` bytes, `step` bytes apart, lie within `size` bytes."""
    height, width = shape
    if height < 0 or width < 0:
        raise PayloadError(f"{what} cannot have {width} columns and {height} rows")
    if height and step < row:
        raise PayloadError(f"{what} has rows of {step} bytes, and {width} columns need {row}")
    if height and width and (height - 1) * step + row > size:
        raise PayloadError(
            f"{what} of {width} x {height} needs {(height - 1) * step + row} bytes and has {size}"
        )


def view_of(
    data: NDArray[np.uint8],
    shape: tuple[int, ...],
    dtype: np.dtype[Any],
    strides: tuple[int, ...],
) -> NDArray[Any]:
    """An array over `data`; `check_rows` has checked that it lies inside."""
    if 0 in shape:
        # If one size is zero, the others are unchecked; numpy refuses those it cannot multiply.
        return np.empty(tuple(min(size, MAX_EMPTY) for size in shape), dtype)
    array: NDArray[Any] = np.ndarray(shape, dtype, data.data, 0, strides)
    return array


def _laser_scan(message: Any) -> NDArray[Any]:
    return _scan(message, float(message.angle_min), float(message.angle_increment))


def _foxglove_scan(message: Any) -> NDArray[Any]:
    start, gaps = float(message.start_angle), max(len(message.ranges) - 1, 1)
    return _scan(message, start, (float(message.end_angle) - start) / gaps)


def _scan(message: Any, start: float, step: float) -> NDArray[Any]:
    """One row for each range (m, at an angle in rad); there may be fewer intensities, or none."""
    count, columns = len(message.ranges), {"range": message.ranges}
    if len(message.intensities):
        columns["intensity"] = _fill(message.intensities, count)
    with np.errstate(over="ignore", invalid="ignore"):
        columns["angle"] = start + np.arange(count, dtype=np.float64) * step
        scan = np.empty(count, [(name, np.float32) for name in columns])
        for name, values in columns.items():
            scan[name] = np.asarray(values, np.float32)
    return scan


def _fill(values: Any, size: int) -> NDArray[np.float32]:
    """As many values as there are points: NaN for those that lack, without surplus ones."""
    filled = np.full(size, np.nan, np.float32)
    filled[: len(values)] = values[:size]
    return filled


def _point_cloud2(message: Any) -> NDArray[Any]:
    height, width = int(message.height), int(message.width)
    step = int(message.point_step)
    data = byte_array(message.data)
    if height * width and not step:
        raise PayloadError("a point cloud has points of 0 bytes")
    order = ">" if message.is_bigendian else "<"
    described = [(f.name, f.datatype, f.offset, f.count) for f in message.fields[: MAX_FIELDS + 1]]
    dtype = _point_dtype(described, POINT_TYPES, step, order)
    row_step = int(message.row_step) if height > 1 else width * step
    row_step = row_step or width * step  # some drivers leave it out
    check_rows("a point cloud", (height, width), width * step, row_step, len(data))
    if height == 1:
        return view_of(data, (width,), dtype, (step,))
    return view_of(data, (height, width), dtype, (row_step, step))


def _foxglove_cloud(message: Any) -> NDArray[Any]:
    data, step = byte_array(message.data), int(message.point_stride)
    described = [(f.name, f.type, f.offset, 1) for f in message.fields[: MAX_FIELDS + 1]]
    dtype = _point_dtype(described, _FOXGLOVE_TYPES, step, "<")
    points, rest = divmod(len(data), step) if step else (0, len(data))
    if rest:
        raise PayloadError(
            f"a point cloud has {len(data)} bytes, which is no whole number of points of "
            f"{step} bytes"
        )
    return view_of(data, (points,), dtype, (step,))


def _point_dtype(
    fields: Sequence[tuple[Any, Any, Any, Any]], types: Mapping[int, str], step: int, order: str
) -> np.dtype[Any]:
    """The structure of one point of `step` bytes, in a byte order as numpy spells it.

    Of each field there are name, type, offset and count; `types` are by their number.
    """
    if len(fields) > MAX_FIELDS:
        raise PayloadError(f"a point cloud has more than {MAX_FIELDS} fields")
    names: list[str] = []
    formats: list[Any] = []
    offsets: list[int] = []
    for given in fields:
        name = _unique(str(given[0]), names)
        code, offset, count = int(given[1]), int(given[2]), int(given[3]) or 1
        if code not in types:
            raise PayloadError(f"field {name!r} of a point cloud has the unknown type {code}")
        item = np.dtype(order + types[code])
        end = offset + count * item.itemsize
        if offset < 0 or end <= offset:
            raise PayloadError(
                f"field {name!r} of a point cloud has {count} elements from byte {offset}"
            )
        if end > step:
            raise PayloadError(
                f"field {name!r} of a point cloud ends at byte {end} of points of {step} bytes"
            )
        names.append(name)
        formats.append(item if count == 1 else (item, (count,)))
        offsets.append(offset)
    try:
        return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": step})
    except (ValueError, OverflowError) as error:
        raise PayloadError(f"points of {step} bytes cannot be read: {error}") from error


def _unique(name: str, taken: list[str]) -> str:
    """A field name that numpy accepts: not empty and not used already."""
    name = name or f"field_{len(taken)}"
    while name in taken:
        name += "_"
    return name


def _point_cloud(message: Any) -> NDArray[Any]:
    points = message.points
    if len(message.channels) > MAX_FIELDS:
        raise PayloadError(f"a point cloud has more than {MAX_FIELDS} channels")
    names = ["x", "y", "z"]
    columns = []
    for channel in message.channels:
        names.append(_unique(str(channel.name), names))
        columns.append(_fill(channel.values, len(points)))
    cloud = np.empty(len(points), [(name, np.float32) for name in names])
    for axis in ("x", "y", "z"):
        cloud[axis] = np.fromiter((getattr(p, axis) for p in points), np.float32, len(points))
    for name, values in zip(names[3:], columns, strict=True):
        cloud[name] = values
    return cloud


POINT_MAKERS: Final[Mapping[str, Callable[[Any], NDArray[Any]]]] = {
    "sensor_msgs/LaserScan": _laser_scan,
    "sensor_msgs/PointCloud2": _point_cloud2,
    "sensor_msgs/PointCloud": _point_cloud,
    "foxglove.LaserScan": _foxglove_scan,
    "foxglove.PointCloud": _foxglove_cloud,
}
"""Makers of arrays by the type of a message, of ROS without `msg`."""


def positions(points: NDArray[Any]) -> NDArray[np.float64]:
    """Positions of points: float64[..., 3], m; those of a scan in its plane."""
    names = points.dtype.names or ()
    if {"x", "y", "z"} <= set(names):
        return np.stack([points[axis].astype(np.float64) for axis in "xyz"], axis=-1)
    if not {"range", "angle"} <= set(names):
        raise PayloadError("these are no points: they have neither x, y and z nor range and angle")
    distance, angle = (points[name].astype(np.float64) for name in ("range", "angle"))
    with np.errstate(invalid="ignore"):
        flat = [distance * np.cos(angle), distance * np.sin(angle), np.zeros_like(distance)]
    return np.stack(flat, axis=-1)


def point_columns(points: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """The fields of points, each of shape (n,); those of several numbers become as many.

    Numbers have the byte order of this machine.
    """
    columns: dict[str, NDArray[Any]] = {}
    for name in points.dtype.names or ():
        values = points[name].reshape(points.size, -1)
        values = values.astype(values.dtype.newbyteorder("="), copy=False)
        for place in range(values.shape[1]):
            own = name + (f"_{place}" if values.shape[1] > 1 else "")
            columns[_unique(own, list(columns))] = values[:, place]
    return columns
