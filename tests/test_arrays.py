from __future__ import annotations

import io
import struct
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image as Pillow

from hybridlog.arrays.message_arrays import to_numpy
from hybridlog_storage.errors import PayloadError


def image(encoding: str, width: int, height: int, data: bytes, **other: Any) -> SimpleNamespace:
    fields = {"step": len(data) // max(height, 1), "is_bigendian": 0, **other}
    raw = np.frombuffer(data, np.uint8)
    return SimpleNamespace(encoding=encoding, width=width, height=height, data=raw, **fields)


@pytest.mark.parametrize(
    ("encoding", "sample", "channels"),
    [
        ("mono8", "u1", 1),
        ("mono16", "u2", 1),
        ("rgb8", "u1", 3),
        ("bgra16", "u2", 4),
        ("8UC1", "u1", 1),
        ("8UC3", "u1", 3),
        ("8SC2", "i1", 2),
        ("16UC1", "u2", 1),
        ("32SC1", "i4", 1),
        ("32FC1", "f4", 1),
        ("64FC10", "f8", 10),
        ("bayer_rggb8", "u1", 1),
        ("bayer_gbrg16", "u2", 1),
        ("yuv422", "u1", 2),
    ],
)
@pytest.mark.parametrize("big", [0, 1])
@pytest.mark.parametrize("padding", [0, 5])
def test_images(encoding: str, sample: str, channels: int, big: int, padding: int) -> None:
    height, width = 3, 4
    dtype = np.dtype(sample).newbyteorder(">" if big else "<")
    wanted = np.arange(height * width * channels).reshape(height, width, channels).astype(dtype)
    rows = [row.tobytes() + b"\xee" * padding for row in wanted]
    message = image(encoding, width, height, b"".join(rows), is_bigendian=big)
    got = to_numpy("sensor_msgs/msg/Image", message)
    assert got.dtype == dtype
    assert got.shape == ((height, width) if channels == 1 else (height, width, channels))
    assert np.array_equal(got.reshape(wanted.shape), wanted)
    assert np.shares_memory(got, message.data)
    # The padding of the last row may be left out.
    message.data = message.data[: len(message.data) - padding]
    assert np.array_equal(to_numpy("sensor_msgs/Image", message).reshape(wanted.shape), wanted)


@pytest.mark.parametrize(("encoding", "rows"), [("nv21", 6), ("nv12", 6), ("nv24", 12)])
def test_planes(encoding: str, rows: int) -> None:
    data = bytes(range(rows * 6))
    got = to_numpy("sensor_msgs/Image", image(encoding, 6, 4, data, step=6))
    assert got.shape == (rows, 6)
    assert got.tobytes() == data


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": 2**32 - 1, "height": 2**32 - 1}, "rows of"),
        ({"height": 2**32 - 1}, "needs"),
        ({"width": 5}, "need"),
        ({"step": 1}, "rows of 1 bytes"),
        ({"step": 2**32 - 1}, "needs"),
        ({"height": -1}, "cannot have"),
        ({"encoding": "64FC999"}, "unknown encoding"),
        ({"encoding": "12UC1"}, "unknown encoding"),
        ({"encoding": "jpeg"}, "unknown encoding"),
        ({"width": "wide"}, "unusual fields"),
    ],
)
def test_images_that_lie(change: dict[str, Any], message: str) -> None:
    lying = image("rgb8", 4, 3, bytes(36))
    lying.__dict__.update(change)
    with pytest.raises(PayloadError, match=message):
        to_numpy("sensor_msgs/Image", lying)
    nv21 = image("nv21", 4, 3, bytes(36))
    with pytest.raises(PayloadError, match="3 rows"):
        to_numpy("sensor_msgs/Image", nv21)


def test_a_step_of_0_means_rows_without_padding() -> None:
    data = bytes(range(36))
    got = to_numpy("sensor_msgs/Image", image("rgb8", 4, 3, data, step=0))
    assert got.shape == (3, 4, 3)
    assert got.tobytes() == data
    with pytest.raises(PayloadError, match="needs 36 bytes and has 35"):
        to_numpy("sensor_msgs/Image", image("rgb8", 4, 3, data[:35], step=0))


# Compressed images


def compressed(form: str, data: bytes) -> SimpleNamespace:
    return SimpleNamespace(format=form, data=np.frombuffer(data, np.uint8))


def encoded(array: np.ndarray[Any, Any], form: str, **options: Any) -> bytes:
    file = io.BytesIO()
    Pillow.fromarray(array).save(file, form, **options)
    return file.getvalue()


@pytest.mark.parametrize("shape", [(4, 6), (4, 6, 3), (4, 6, 4)])
def test_png(shape: tuple[int, ...]) -> None:
    wanted = np.random.default_rng(1).integers(0, 256, shape, np.uint8)
    message = compressed("bgr8; png compressed bgr8", encoded(wanted, "png"))
    assert np.array_equal(to_numpy("sensor_msgs/CompressedImage", message), wanted)


def test_png_of_16_bits_and_colour_is_not_cut_to_eight() -> None:
    header = b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sIIBBBBB", 13, b"IHDR", 2, 2, 16, 2, 0, 0, 0)
    with pytest.raises(PayloadError, match="16 bits"):
        to_numpy("sensor_msgs/CompressedImage", compressed("png", header))


def test_compressed_depth() -> None:
    depth = np.array([[1000, 0], [2500, 65535]], np.uint16)
    data = struct.pack("<iff", 0, 0.0, 0.0) + encoded(depth, "png")
    got = to_numpy("sensor_msgs/CompressedImage", compressed("16UC1; compressedDepth png", data))
    assert np.array_equal(got, depth)
    metres = np.array([[0.5, 4.0], [2.0, 1.0]])
    scale, shift = 100.0, 10.0
    inverse = np.round(scale / metres + shift).astype(np.uint16)
    inverse[1, 1] = 0
    data = struct.pack("<iff", 0, scale, shift) + encoded(inverse, "png")
    got = to_numpy("sensor_msgs/CompressedImage", compressed("32FC1; compressedDepth", data))
    assert got.dtype == np.float32
    assert np.allclose(got[:, 0], metres[:, 0])
    assert np.isnan(got[1, 1])
    for form, raw in (("16UC1; compressedDepth rvl", data), ("16UC1; compressedDepth", b"short")):
        with pytest.raises(PayloadError, match="only PNG"):
            to_numpy("sensor_msgs/CompressedImage", compressed(form, raw))


@pytest.mark.parametrize("form", ["", "jpeg", "32FC1; compressedDepth"])
def test_a_picture_without_bytes_is_empty(form: str) -> None:
    assert to_numpy("sensor_msgs/CompressedImage", compressed(form, b"")).shape == (0, 0)


@given(st.data())
def test_damaged_pictures(data: st.DataObject) -> None:
    wanted = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)
    raw = bytearray(encoded(wanted, data.draw(st.sampled_from(["png", "jpeg", "tiff", "bmp"]))))
    for _ in range(3):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(raw)))
    try:
        got = to_numpy("sensor_msgs/CompressedImage", compressed("jpeg", bytes(raw[:cut])))
    except PayloadError:
        return
    assert got.ndim in {2, 3}


def test_picture_that_claims_to_be_huge() -> None:
    raw = bytearray(encoded(np.zeros((4, 4), np.uint8), "png"))
    raw[16:24] = struct.pack(">II", 30000, 30000)
    import zlib

    raw[29:33] = struct.pack(">I", zlib.crc32(raw[12:29]))
    with pytest.raises(PayloadError, match="cannot be read"):
        to_numpy("sensor_msgs/CompressedImage", compressed("png", bytes(raw)))


# Scans and clouds


def test_laser_scan() -> None:
    scan = SimpleNamespace(
        ranges=np.array([1, 2, np.inf], np.float32),
        intensities=np.array([], np.float32),
        angle_min=-0.5,
        angle_increment=0.25,
    )
    got = to_numpy("sensor_msgs/LaserScan", scan)
    assert got.dtype.names == ("range", "angle")
    assert got["range"].tolist() == [1, 2, np.inf]
    assert got["angle"].tolist() == [-0.5, -0.25, 0]
    scan.intensities = np.array([4, 5, 6], np.float32)
    assert to_numpy("sensor_msgs/LaserScan", scan)["intensity"].tolist() == [4, 5, 6]
    scan.intensities = np.array([4], np.float32)
    got = to_numpy("sensor_msgs/LaserScan", scan)
    assert got["intensity"][0] == 4
    assert np.isnan(got["intensity"][1:]).all()
    assert got["range"].tolist() == [1, 2, np.inf]
    scan.intensities = np.array([4, 5, 6, 7], np.float32)
    assert to_numpy("sensor_msgs/LaserScan", scan)["intensity"].tolist() == [4, 5, 6]
    scan.ranges = scan.ranges[:0]
    assert to_numpy("sensor_msgs/LaserScan", scan).shape == (0,)


def point_field(name: str, offset: int, datatype: int, count: int = 1) -> SimpleNamespace:
    return SimpleNamespace(name=name, offset=offset, datatype=datatype, count=count)


def cloud(**change: Any) -> SimpleNamespace:
    dtype = np.dtype(
        {
            "names": ["x", "ring", "rgb"],
            "formats": ["<f4", "<u2", ("u1", 3)],
            "offsets": [0, 8, 12],
            "itemsize": 16,
        }
    )
    points = np.zeros((2, 3), dtype)
    points["x"] = np.arange(6).reshape(2, 3)
    points["ring"] = 7
    points["rgb"] = [1, 2, 3]
    fields = {
        "height": 2,
        "width": 3,
        "point_step": 16,
        "row_step": 50,
        "is_bigendian": False,
        "fields": [
            point_field("rgb", 12, 2, 3),
            point_field("x", 0, 7),
            point_field("ring", 8, 4, 0),
        ],
        "data": np.frombuffer(b"".join(row.tobytes() + b"\xee\xee" for row in points), np.uint8),
        **change,
    }
    return SimpleNamespace(**fields)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": 2**32 - 1}, "need"),
        ({"height": 2**32 - 1}, "needs"),
        ({"row_step": 2**32 - 1}, "needs"),
        ({"row_step": 40}, "need"),
        ({"point_step": 2**32 - 1}, "cannot be read|need"),
        ({"point_step": 2**32 - 1, "width": 0}, "cannot be read"),
        ({"point_step": 0}, "points of 0 bytes"),
        ({"point_step": 0, "fields": [], "data": np.zeros(0, np.uint8)}, "points of 0 bytes"),
        ({"point_step": 0, "width": 0}, "ends at byte"),
        ({"fields": [point_field("x", 2**32 - 1, 7)]}, "ends at byte"),
        ({"fields": [point_field("x", -4, 7)]}, "from byte -4"),
        ({"fields": [point_field("x", 0, 7, 2**32 - 1)]}, "ends at byte"),
        ({"fields": [point_field("x", 0, 9)]}, "unknown type 9"),
        ({"data": np.zeros(97, np.uint8)}, "has 97"),
    ],
)
def test_clouds_that_lie(change: dict[str, Any], message: str) -> None:
    with pytest.raises(PayloadError, match=message):
        to_numpy("sensor_msgs/PointCloud2", cloud(**change))


def test_old_point_cloud() -> None:
    points = [SimpleNamespace(x=n, y=2 * n, z=3 * n) for n in range(3)]
    channels = [SimpleNamespace(name="intensity", values=np.array([7, 8, 9], np.float32))]
    message = SimpleNamespace(points=points, channels=channels)
    got = to_numpy("sensor_msgs/PointCloud", message)
    assert got.tolist() == [(0, 0, 0, 7), (1, 2, 3, 8), (2, 4, 6, 9)]
    channels[0].values = np.array([7, 8], np.float32)
    got = to_numpy("sensor_msgs/PointCloud", message)["intensity"]
    assert got[:2].tolist() == [7, 8]
    assert np.isnan(got[2])


def test_other_types_are_refused() -> None:
    with pytest.raises(PayloadError, match=r"sensor_msgs/Image.*sensor_msgs/PointCloud2"):
        to_numpy("nav_msgs/msg/Odometry", SimpleNamespace())
    with pytest.raises(PayloadError, match="unusual fields"):
        to_numpy("sensor_msgs/Image", SimpleNamespace(encoding="rgb8"))
