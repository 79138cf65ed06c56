"""Scans, clouds and images as robots send them, and logs of them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from msgspec.structs import replace
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

import hybridlog as hl
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests import places
from tests.independent import write_mcap

COUNT = 120
SETTINGS = SegmentSettings(chunk_size=32 << 10, segment_size=60 << 10)
BASE = 1_700_000_000_000_000_000
STEP = 50_000_000
SCAN = "sensor_msgs/msg/LaserScan"
CLOUD = "sensor_msgs/msg/PointCloud2"
IMAGE = "sensor_msgs/msg/Image"
NUMBER = "std_msgs/msg/Int32"
XYZ = [("x", 0, 7, 1), ("y", 4, 7, 1), ("z", 8, 7, 1), ("ring", 14, 4, 1)]


@cache
def typestore() -> Typestore:
    return get_typestore(Stores.ROS2_HUMBLE)


@cache
def definition(name: str) -> str:
    return typestore().generate_msgdef(name, ros_version=2)[0]


@cache
def standard_channel(name: str) -> Channel:
    return Channel("/topic", "cdr", Schema(name, "ros2msg", definition(name).encode()))


def _header(n: int, frame: str):
    kinds = typestore().types
    return kinds["std_msgs/msg/Header"](kinds["builtin_interfaces/msg/Time"](1, n), frame)


def scan(
    values: Sequence[float] | np.ndarray,
    *,
    frame: str = "laser",
    n: int = 2,
    big: bool = False,
    measured: int | None = None,
) -> bytes:
    """A scan; by default half as many intensities are measured as ranges."""
    numbers = np.asarray(values, np.float32)
    half = numbers[: len(numbers) // 2 if measured is None else measured]
    angles = -1.5, 1.5, 0.01, 0.0, 0.1, 0.0, 30.0
    message = typestore().types[SCAN](_header(n, frame), *angles, numbers, half)
    return bytes(typestore().serialize_cdr(message, SCAN, little_endian=not big))


def cloud(
    layout: Sequence[tuple[str, int, int, int]],
    step: int,
    data: bytes,
    *,
    rows: int = 1,
    big: bool = False,
    pad: int = 0,
) -> bytes:
    kinds = typestore().types
    fields = [kinds["sensor_msgs/msg/PointField"](*one) for one in layout]
    width = len(data) // step // rows
    message = kinds[CLOUD](
        _header(2, "lidar"), rows, width, fields, big, step, width * step + pad,
        np.frombuffer(data, np.uint8), True,
    )  # fmt: skip
    return bytes(typestore().serialize_cdr(message, CLOUD))


def image(pixels: np.ndarray) -> bytes:
    height, width = pixels.shape
    message = typestore().types[IMAGE](
        _header(3, "camera"), height, width, "mono8", 0, width, pixels.ravel()
    )
    return bytes(typestore().serialize_cdr(message, IMAGE))


def number(n: int) -> bytes:
    return bytes(typestore().serialize_cdr(typestore().types[NUMBER](n), NUMBER))


def write_log(
    path: Path, said: Iterable[tuple[str, str, int, bytes]], chunk_size: int = 1 << 20
) -> Path:
    """A log of messages: topic, type, log time and payload of each."""
    channels: dict[tuple[str, str], Channel] = {}
    rows = []
    for topic, kind, time, data in said:
        channel = channels.setdefault((topic, kind), replace(standard_channel(kind), topic=topic))
        rows.append((channel, time, data, time - 5))
    return write_mcap(path, rows, chunk_size=chunk_size)


def ranges_of(n: int) -> np.ndarray:
    """Ranges of the n-th scan; some are infinite, of some scans there are more."""
    angles = np.arange(400 + n % 2)
    found = np.round(2 + np.sin(angles / 40 + n / 30), 3).astype(np.float32)
    found[angles % 97 == n % 97] = np.inf
    return found


def points_of(n: int) -> np.ndarray:
    """Points of the n-th cloud: x, y, z, padding of two bytes, ring, padding of four bytes."""
    points = np.zeros(
        150 + n % 5, [("xyz", "<f4", 3), ("pad", "u1", 2), ("ring", "<u2"), ("end", "<u4")]
    )
    points["xyz"] = np.arange(len(points) * 3).reshape(-1, 3) / 7 + n
    points["ring"] = np.arange(len(points)) % 16
    points["end"] = n % 3
    return points


def robot(count: int = COUNT) -> list[tuple[str, str, int, bytes]]:
    """Scans, clouds, images and numbers of a robot."""
    said = []
    for n in range(count):
        time = BASE + n * STEP
        said.append(("/scan", SCAN, time, scan(ranges_of(n), n=n)))
        said.append(("/cloud", CLOUD, time + 1, cloud(XYZ, 20, points_of(n).tobytes())))
        said.append(("/number", NUMBER, time + 2, number(n)))
        if n % 10 == 0:
            pixels = (np.arange(64 * 80).reshape(64, 80) * (n + 1) % 251).astype(np.uint8)
            said.append(("/image", IMAGE, time + 3, image(pixels)))
    return said


def messages(store: hl.Store) -> list[tuple[Any, ...]]:
    """All messages of a store, byte for byte."""
    return [
        (m.topic, m.log_time_ns, m.publish_time_ns, m.sequence, m.seq, m.raw)
        for m in store.all_topics()
    ]


def recording_of(store: Path) -> Path:
    return places.folder(store, "log")
