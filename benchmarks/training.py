"""Training sets and windows of pictures: `python -m benchmarks.training`.

Records 600 pictures of 640 x 480, raw and as JPEG, in a temporary directory. Then: frames a
second that become a set in H.264; and windows of random places, raw ones beside `preadv` of as
many bytes of the same file, JPEG ones beside Pillow alone. Everything is read from memory: each
is done once before. On a busy machine, only the processor time says something.
"""

from __future__ import annotations

import io
import os
import struct
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import hybridlog as hl
from hybridlog_storage.messages import Channel, Schema

FRAMES, HEIGHT, WIDTH, FPS = 600, 480, 640, 30
STEP = 10**9 // FPS
HEADER = b"=" * 80 + b"\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
RAW = Channel(
    "/raw",
    "ros1",
    Schema(
        "sensor_msgs/Image",
        "ros1msg",
        b"std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\n"
        b"uint8 is_bigendian\nuint32 step\nuint8[] data\n" + HEADER,
    ),
    {},
)
JPEG = Channel(
    "/jpeg",
    "ros1",
    Schema(
        "sensor_msgs/CompressedImage",
        "ros1msg",
        b"std_msgs/Header header\nstring format\nuint8[] data\n" + HEADER,
    ),
    {},
)


def text(value: bytes) -> bytes:
    return struct.pack("<I", len(value)) + value


def write(store: hl.Store) -> list[bytes]:
    """Record the pictures; returns the JPEG files."""
    random = np.random.default_rng(0)
    blocks = np.kron(random.integers(0, 255, (30, 40, 3)), np.ones((16, 16, 1))).astype(np.uint8)
    files = []
    head = struct.pack("<III", 0, 0, 0) + text(b"")
    with store.start("camera") as recording:
        for number in range(FRAMES):
            picture = np.roll(blocks, number * 3, 1)
            picture = picture ^ random.integers(0, 8, picture.shape, dtype=np.uint8)
            size = struct.pack("<II", HEIGHT, WIDTH) + text(b"rgb8")
            shape = struct.pack("<BI", 0, 3 * WIDTH)
            file = io.BytesIO()
            Image.fromarray(picture).save(file, "JPEG", quality=90)
            files.append(file.getvalue())
            raw = head + size + shape + text(picture.tobytes())
            recording.write(RAW, raw, log_time=number * STEP)
            jpeg = head + text(b"jpeg") + text(files[-1])
            recording.write(JPEG, jpeg, log_time=number * STEP)
    return files


def cost(work: Callable[[Any], object], places: list[Any]) -> tuple[float, float]:
    """Milliseconds of the clock and of the processor for each place, the second time."""
    for _ in range(2):
        begun, used = time.perf_counter(), time.process_time()
        for place in places:
            work(place)
        begun, used = time.perf_counter() - begun, time.process_time() - used
    return begun / len(places) * 1e3, used / len(places) * 1e3


def main() -> None:
    with tempfile.TemporaryDirectory() as place, hl.open(f"{place}/store", create=True) as store:
        files = write(store)
        for topic in ("raw", "jpeg"):
            begun, used = time.perf_counter(), time.process_time()
            report = store.to_lerobot(
                store.topic(topic), {"images": {"c": topic}}, f"{place}/{topic}", fps=FPS, task="x"
            )
            begun, used = time.perf_counter() - begun, time.process_time() - used
            rate, share = report.frames / begun, used / report.frames * 1e3
            print(f"set of {topic}: {rate:.0f} frames/s, {share:.1f} ms of a processor each")
        segment = next(Path(place).rglob("*.mcap"))
        with segment.open("rb", buffering=0) as file:
            for length in (1, 4, 16):
                size = length * HEIGHT * WIDTH * 3
                last = segment.stat().st_size - size

                def read(at: int, size: int = size) -> None:
                    os.preadv(file.fileno(), [np.empty(size, np.uint8)], at)

                ours = {}
                for topic in ("raw", "jpeg"):
                    features = {"images": {"c": topic}}
                    windows = store.windows(topic, fps=FPS, length=length, features=features)
                    ours[topic] = cost(windows.__getitem__, windows.order(1)[:200].tolist())
                offsets = np.random.RandomState(1).randint(0, last, 200).tolist()
                print(
                    f"window of {length}, ms (of a processor): raw {ours['raw'][0]:.2f} "
                    f"({ours['raw'][1]:.2f}), preadv {cost(read, offsets)[0]:.2f}; "
                    f"jpeg {ours['jpeg'][0]:.2f} ({ours['jpeg'][1]:.2f})"
                )
        alone = cost(lambda data: np.asarray(Image.open(io.BytesIO(data))), files[:200])
        print(f"Pillow alone, one picture: {alone[0]:.2f} ({alone[1]:.2f})")


if __name__ == "__main__":
    main()
