"""A recording with an image of every encoding, compressed ones, and damaged ones."""

from __future__ import annotations

import io
import struct
from typing import Final

import numpy as np
from PIL import Image

import hybridlog as hl
from tests.odd_messages import MS, START, ros_channel
from tests.ros_values import ROS1

WIDTH, HEIGHT = 16, 12
_RNG = np.random.default_rng(5)

SAMPLES: Final = {
    **dict.fromkeys(("mono8", "8UC1", "8SC1"), 1),
    **dict.fromkeys(("rgb8", "bgr8", "8UC3"), 3),
    **dict.fromkeys(("rgba8", "bgra8", "8UC4"), 4),
    **dict.fromkeys(("mono16", "16UC1", "16SC1", "16FC1", "8UC2"), 2),
    **dict.fromkeys(("32SC1", "32FC1"), 4),
    **dict.fromkeys(("64FC1", "rgba16", "bgra16"), 8),
    **dict.fromkeys(("rgb16", "bgr16"), 6),
    "32FC3": 12,
    **{f"bayer_{order}8": 1 for order in ("rggb", "bggr", "gbrg", "grbg")},
    **{f"bayer_{order}16": 2 for order in ("rggb", "bggr", "gbrg", "grbg")},
    **dict.fromkeys(("yuv422", "yuv422_yuy2", "uyvy", "yuyv"), 2),
    **dict.fromkeys(("nv12", "nv21"), 1.5),
    "nv24": 3,
}
"""Bytes of a pixel, by encoding."""
FORMS: Final = ("PNG", "JPEG", "WEBP", "BMP", "TIFF", "deep PNG", "depth")
BROKEN: Final = ("short", "unknown", "empty", "no file")
RAW, COMPRESSED = "/raw", "/compressed"
PIXELS: Final = _RNG.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
"""Of `rgb8`, and of every compressed picture of colours."""


def file_of(form: str) -> bytes:
    """A picture in a file format."""
    file = io.BytesIO()
    deep = _RNG.integers(1, 1 << 16, (HEIGHT, WIDTH)).astype(np.uint16)
    array = deep if form in {"deep PNG", "depth"} else PIXELS
    Image.fromarray(array).save(file, "PNG" if array is deep else form)
    head = struct.pack("<iff", 0, 0, 0) if form == "depth" else b""
    return head + file.getvalue()


def write_images(store: hl.Store) -> None:
    """Record `images`: a message each 100 ms, in the order of the lists above."""
    types = ROS1.types
    stamp = types["builtin_interfaces/msg/Time"](sec=1, nanosec=2)
    header = types["std_msgs/msg/Header"](seq=1, stamp=stamp, frame_id="camera")
    raw = ros_channel(RAW, "sensor_msgs/msg/Image", 1)
    compressed = ros_channel(COMPRESSED, "sensor_msgs/msg/CompressedImage", 1)
    with store.start("images") as recording:
        for n, encoding in enumerate([*SAMPLES, *BROKEN[:3]]):
            samples = SAMPLES.get(encoding, 1)
            data = _RNG.integers(0, 256, int(samples * WIDTH) * HEIGHT, np.uint8)
            if encoding == "rgb8":
                data = PIXELS.reshape(-1)
            height, width = (0, 0) if encoding == "empty" else (HEIGHT, WIDTH)
            row = width if encoding.startswith("nv") else width * int(samples)
            kept = {"short": 20, "empty": 0}.get(encoding, len(data))
            message = types["sensor_msgs/msg/Image"](
                header,
                height=height,
                width=width,
                encoding="mono8" if encoding in {"short", "empty"} else encoding,
                is_bigendian=0,
                step=row,
                data=data[:kept],
            )
            payload = bytes(ROS1.serialize_ros1(message, "sensor_msgs/msg/Image"))
            recording.write(raw, payload, log_time=START + n * 100 * MS)
        for n, form in enumerate([*FORMS, BROKEN[3]]):
            file = b"GARBAGE" * 9 if form == "no file" else file_of(form)
            name = "16UC1; compressedDepth png" if form == "depth" else form.lower()
            message = types["sensor_msgs/msg/CompressedImage"](
                header, format=name, data=np.frombuffer(file, np.uint8)
            )
            payload = bytes(ROS1.serialize_ros1(message, "sensor_msgs/msg/CompressedImage"))
            recording.write(compressed, payload, log_time=START + n * 100 * MS)
