"""A recording with drives, joints, flags, pauses, text and JSON; another one without pauses."""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

import hybridlog as hl
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests.independent import write_mcap
from tests.odd_messages import write_odd

MS = 10**6
BASE = 1_748_937_600 * 10**9
DRIVE = b"""\
geometry_msgs/Vector3 linear
float32 y
int64 ticks
bool on
duration age
string state
float64[] position
float32[40] wide
geometry_msgs/Vector3[] way
================================================================================
MSG: geometry_msgs/Vector3
float64 x
float64 z
"""


IMAGE = b"""\
uint32 height
uint32 width
string encoding
uint8 is_bigendian
uint32 step
uint8[] data
"""
COMPRESSED = b"string format\nuint8[] data\n"


@dataclass
class Drive:
    """What was written: one entry a message."""

    store: hl.Store
    directory: Path
    times: NDArray[np.int64]
    x: NDArray[np.float64]
    z: NDArray[np.float64]
    ticks: NDArray[np.int64]
    joints: list[list[float]]
    wide: NDArray[np.float32]


def payload(drive: Drive, n: int) -> bytes:
    joints = drive.joints[n]
    way = [(float(k), n / 2) for k in range(n % 3)]
    return (
        struct.pack("<ddfq?ii", drive.x[n], drive.z[n], n / 4, drive.ticks[n], n % 2, 0, n)
        + struct.pack("<I2s", 2, b"go")
        + struct.pack(f"<I{len(joints)}d", len(joints), *joints)
        + drive.wide[n].tobytes()
        + struct.pack("<I", len(way))
        + b"".join(struct.pack("<dd", *point) for point in way)
    )


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


def image(pixels: NDArray[np.uint8], encoding: str = "rgb8") -> bytes:
    height, width = pixels.shape[:2]
    head = struct.pack("<II", height, width) + text(encoding)
    return head + struct.pack("<BII", 0, pixels.strides[0], pixels.nbytes) + pixels.tobytes()


def compressed(data: bytes, form: str = "png") -> bytes:
    return text(form) + struct.pack("<I", len(data)) + data


def encoded(pixels: NDArray[np.uint8], form: str) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, form)
    return file.getvalue()


SEEN = np.random.default_rng(5).integers(0, 256, (4, 4, 6, 3), np.uint8)
FILES = [encoded(SEEN[0], "JPEG"), encoded(SEEN[1], "WEBP"), encoded(SEEN[2], "JPEG")]


def write_looks(path: Path) -> None:
    """Raw images, the second of which is too short; compressed ones, two at the same time."""
    front = Channel("/front", "ros1", Schema("sensor_msgs/Image", "ros1msg", IMAGE))
    packed = Schema("sensor_msgs/CompressedImage", "ros1msg", COMPRESSED)
    rear, broken = (Channel(name, "ros1", packed) for name in ("/rear/compressed", "/broken"))
    said: list[tuple[Channel, int, bytes, int]] = []
    for n, pixels in enumerate(SEEN):
        payload = image(pixels, "rgb8" if n != 1 else "rgb16")
        said.append((front, BASE + n * MS, payload, BASE + n))
    for n, data in enumerate(FILES):
        said.append((rear, BASE + n // 2, compressed(data), 0))
        said.append((broken, BASE + n, compressed(b"no picture", "h265"), 0))
    write_mcap(path, said)


@pytest.fixture(scope="session")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Drive]:
    """5,000 messages, 10 ms apart but for two pauses of 20 s and one of 30 ms."""
    path = tmp_path_factory.mktemp("drawing")
    count = 5000
    rng = np.random.default_rng(7)
    steps = np.full(count, 10 * MS)
    steps[[1500, 4000]] = 20_000 * MS
    steps[2500] = 30 * MS
    x = rng.normal(size=count)
    x[100] = np.nan
    x[3000] = np.inf
    x[1600:1800] = np.nan
    with hl.open(path / "store", create=True) as store:
        made = Drive(
            store,
            path / "store",
            BASE + np.cumsum(steps) - steps[0],
            x,
            np.sin(np.arange(count) / 100),
            rng.integers(-(2**50), 2**50, count),
            [rng.normal(size=n % 4).tolist() for n in range(count)],
            rng.normal(size=(count, 40)).astype(np.float32),
        )
        channel = Channel("/drive", "ros1", Schema("demo/Drive", "ros1msg", DRIVE))
        loose = Channel("/loose", "json", Schema("Any", "jsonschema", b"{}"))
        sent: list[tuple[Channel, int, bytes]] = []
        for n, time in enumerate(made.times.tolist()):
            sent.append((channel, time, payload(made, n)))
            if n % 50 == 0:
                said = {"v": n if n % 100 else "no", "w": n / 2, "on": n % 100 > 0 or -5}
                said = said if n % 150 else {"name": "a"}
                sent.append((loose, time, json.dumps(said).encode()))
        write_mcap(path / "drive.mcap", sent)
        store.record(path / "drive.mcap", settings=SegmentSettings(chunk_size=1 << 16))
        write_looks(path / "looks.mcap")
        store.record(path / "looks.mcap")
        yield made


@pytest.fixture(scope="session")
def odd(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    with hl.open(tmp_path_factory.mktemp("odd") / "store", create=True) as store:
        write_odd(store)
        yield store
