"""Images, scans and point clouds as numpy arrays, without a copy where possible.

Arrays lie over the bytes of a message, which are checked first.
"""

from __future__ import annotations

import base64
import io
import re
import struct
import warnings
from collections.abc import Callable, Mapping, Sequence
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from hybridlog.arrays import VIDEOS
from hybridlog_storage.errors import PayloadError, extra

if TYPE_CHECKING:
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


# Images.

_IMAGES: Final[Mapping[str, tuple[str, int]]] = {
    "mono8": ("u1", 1),
    "mono16": ("u2", 1),
    **{
        f"{order}{bits}": (f"u{bits // 8}", len(order))
        for order in ("rgb", "bgr", "rgba", "bgra")
        for bits in (8, 16)
    },
    **{
        f"bayer_{order}{bits}": (f"u{bits // 8}", 1)
        for order in ("rggb", "bggr", "gbrg", "grbg")
        for bits in (8, 16)
    },
    **dict.fromkeys(("yuv422", "yuv422_yuy2", "uyvy", "yuyv"), ("u1", 2)),
}
# Planes of one byte per sample: rows of the whole picture for each row of the image.
_PLANAR: Final[Mapping[str, tuple[int, int]]] = {"nv21": (3, 2), "nv12": (3, 2), "nv24": (3, 1)}
_CV_ENCODING = re.compile(r"(8|16|32|64)(U|S|F)C(\d{1,3})?")
_CV_TYPES = {"8U", "8S", "16U", "16S", "32S", "32F", "64F", "16F"}
_CV_CHANNELS = 512

_COMPRESSED = ("JPEG", "PNG", "WEBP", "TIFF", "BMP")
_PNG = b"\x89PNG\r\n\x1a\n"
_DEPTH_HEADER = struct.Struct("<iff")


def to_numpy(type_name: str, message: object) -> NDArray[Any]:
    """A message as an array.

    * `Image`, also Foxglove's `RawImage`: shape (height, width) or (height, width, channels) in the
      encoding's own channel order; big-endian samples have a big-endian dtype. YUV 4:2:2 has two
      channels, not separated; NV12, NV21 and NV24 are returned as raw planes, shape (rows of all
      planes, width).
    * `CompressedImage`, also Foxglove's: shape (height, width) or (height, width, 3 or 4), red
      first. `compressedDepth` gives the depth image: uint16 millimetres or float32 metres (NaN for
      missing measurements).
    * `LaserScan`: shape (n,), fields `range` (metres), `intensity` (if present) and `angle`
      (radians), float32. Ranges without an intensity have NaN.
    * `PointCloud2`: shape (width,) or, for an organised cloud, (height, width), with the cloud's
      own fields, which may overlap; `PointCloud`: shape (n,), `x`, `y`, `z` and the channels, NaN
      where a channel ends early.
    * `foxglove.LaserScan` and `foxglove.PointCloud`, also of `foxglove_msgs`: the same.

    An empty image, picture or cloud is an empty array. A step of 0 means rows without padding.
    Images and `PointCloud2` clouds are views of the message's data, without a copy. The message has
    its fields as attributes or, from JSON, is a dict.
    """
    maker = _MAKERS.get(plain_type(type_name))
    if maker is None:
        raise PayloadError(
            f"{type_name} has no array form; {', '.join(_MAKERS)} have. "
            "Its fields are in decode(), its columns in to_pandas()."
        )
    try:
        return maker(attributes(message))
    except (AttributeError, TypeError, ValueError, OverflowError) as error:
        raise PayloadError(f"this {type_name} has unusual fields: {error}") from error


def plain_type(name: str) -> str:
    """The name of a type without `msg`, and of a Foxglove type as Foxglove has it."""
    return name.replace("/msg/", "/").replace("foxglove_msgs/", "foxglove.")


def attributes(message: Any) -> Any:
    """The message with its fields as attributes, if it is a dict as JSON gives it."""
    if isinstance(message, dict):
        return SimpleNamespace(**{str(name): attributes(item) for name, item in message.items()})
    if isinstance(message, list) and any(isinstance(item, dict) for item in message[:1]):
        return [attributes(item) for item in message]
    return message


def _image(message: Any) -> NDArray[Any]:
    encoding = str(message.encoding).strip()
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = byte_array(message.data)
    if not encoding and not height * width and not len(data):
        return np.empty((min(height, MAX_EMPTY), min(width, MAX_EMPTY)), np.uint8)
    channels, sample = 1, np.dtype(np.uint8)
    planes = _PLANAR.get(encoding.lower())
    if planes is not None:
        whole, part = planes
        if height % part:
            raise PayloadError(f"a {encoding} image cannot have {height} rows")
        height = height * whole // part
    else:
        sample, channels = _sample(encoding)
    if getattr(message, "is_bigendian", False):  # Foxglove's are little-endian
        sample = sample.newbyteorder(">")
    row = width * channels * sample.itemsize
    step = step or row
    check_rows("an image", (height, width), row, step, len(data))
    pixel = channels * sample.itemsize
    if channels == 1:
        return view_of(data, (height, width), sample, (step, pixel))
    return view_of(data, (height, width, channels), sample, (step, pixel, sample.itemsize))


def _sample(encoding: str) -> tuple[np.dtype[Any], int]:
    """Type of a sample, and number of samples per pixel."""
    known = _IMAGES.get(encoding.lower())
    if known is not None:
        return np.dtype(known[0]), known[1]
    match = _CV_ENCODING.fullmatch(encoding.upper())
    if match is not None and match[1] + match[2] in _CV_TYPES:
        channels = int(match[3] or 1)
        if 1 <= channels <= _CV_CHANNELS:
            kind = {"U": "u", "S": "i", "F": "f"}[match[2]]
            return np.dtype(f"{kind}{int(match[1]) // 8}"), channels
    raise PayloadError(f"an image has the unknown encoding {encoding[:40]!r}")


def _compressed_image(message: Any) -> NDArray[Any]:
    form = str(message.format)
    data = byte_array(message.data).tobytes()
    if not data:
        return np.empty((0, 0), np.uint8)
    if "compressedDepth" in form:
        return _depth(form, data)
    return _picture(data)


def depth_picture(form: str, data: bytes) -> bytes | None:
    """The PNG in a `compressedDepth` image if its values are the depth, uint16 millimetres."""
    if not data:
        return data
    if len(data) < _DEPTH_HEADER.size or "rvl" in form.lower():
        raise PayloadError(f"a depth image in the form {form[:60]!r} cannot be read: only PNG can")
    return None if form.upper().startswith("32FC1") else data[_DEPTH_HEADER.size :]


def _depth(form: str, data: bytes) -> NDArray[Any]:
    """A depth image after its header: quantised inverse depth, or plain depth."""
    plain = depth_picture(form, data)
    picture = _picture(data[_DEPTH_HEADER.size :])
    if picture.ndim != 2:
        raise PayloadError("a depth image has more than one channel")
    if plain is not None:
        return picture
    _, scale, shift = _DEPTH_HEADER.unpack_from(data)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.float32(scale) / (picture.astype(np.float32) - np.float32(shift))
    depth[picture == 0] = np.nan
    return depth


def _picture(data: bytes) -> NDArray[Any]:
    with extra("images", "compressed images need Pillow"):
        from PIL import Image, UnidentifiedImageError

    # Pillow would silently cut these to eight bits.
    if data.startswith(_PNG) and data[24:25] == b"\x10" and data[25:26] != b"\x00":
        raise PayloadError("a PNG with 16 bits and several channels cannot be read")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(data), formats=_COMPRESSED) as image:
                # 16-bit and 32-bit float grey images have modes of their own.
                plain = image.mode in {"L", "RGB", "RGBA", "F", "I"} or image.mode[:4] == "I;16"
                mode = "RGBA" if "A" in image.mode or "transparency" in image.info else "RGB"
                mode = "L" if image.mode == "1" else mode
                array: NDArray[Any] = np.asarray(image if plain else image.convert(mode))
    except UnidentifiedImageError as error:
        raise PayloadError(
            f"a compressed image is none of {', '.join(_COMPRESSED)}, or its head is damaged"
        ) from error
    except (
        OSError,
        ValueError,
        SyntaxError,
        EOFError,
        struct.error,
        Warning,
        Image.DecompressionBombError,
    ) as error:
        raise PayloadError(f"a compressed image cannot be read: {error}") from error
    if array.dtype == np.int32 and array.size and 0 <= array.min() <= array.max() <= 0xFFFF:
        array = array.astype(np.uint16)  # older versions read 16-bit grey as 32
    return array


COMPRESSED_IMAGES: Final = frozenset(
    ("sensor_msgs/CompressedImage", "foxglove.CompressedImage", "foxglove_msgs/CompressedImage")
)
"""Types of messages with a picture in a file format, without `/msg/`."""
_RAW_IMAGES = ("sensor_msgs/Image", "foxglove.RawImage", "foxglove_msgs/RawImage")
IMAGES: Final = COMPRESSED_IMAGES.union(_RAW_IMAGES, VIDEOS)
"""Types of messages with a picture, without `/msg/`."""
_MAKERS: Final[Mapping[str, Callable[[Any], NDArray[Any]]]] = {
    **dict.fromkeys(_RAW_IMAGES, _image),
    **dict.fromkeys(sorted(COMPRESSED_IMAGES), _compressed_image),
    **POINT_MAKERS,
}
