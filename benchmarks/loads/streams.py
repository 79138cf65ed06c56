"""The synthetic streams of study 1: messages of one size at one rate on many topics."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.loads.base import PAYLOADS, Load
from hybridlog_storage.messages import Channel, Schema

if TYPE_CHECKING:
    from numpy.typing import NDArray

START_NS = 1_700_000_000 * 1_000_000_000
"""Log time of a stream's first message, ns since the epoch."""
TYPE = "hybridlog_benchmarks/Frame"

_FIELDS = "Header header\nfloat32[] ranges\nuint8[] data\n"
_HEADER = "uint32 seq\ntime stamp\nstring frame_id\n"
_DEFINITION = f"{_FIELDS}\n{'=' * 80}\nMSG: std_msgs/Header\n{_HEADER}"

_POOL_BYTES = 64 << 20
_POOL_MESSAGES = 100
_STAMP_STEP_NS = 10_000_000
"""Not that of the rate: streams of all rates share their payloads."""
_FRAME_ID = 12
_FIXED = 4 + 8 + 4 + _FRAME_ID + 4 + 4
"""Bytes of a message besides its arrays: header, and a length for each array."""


def pool_messages(size: int, topics: int, messages: int) -> int:
    """Number of different payloads in a stream: about 64 MB of them, and at least 100.

    More than a compressor looks back over, so that none finds a payload again.
    """
    return min(max(_POOL_BYTES // size, _POOL_MESSAGES), topics * messages)


def stream(
    directory: Path,
    *,
    size: int,
    rate: float,
    topics: int,
    messages: int,
    seed: int,
    pool: Path | None = None,
) -> Load:
    """Make a stream.

    Half of a message is a smooth range scan in whole millimetres, half is noise, as a
    compressed camera frame is. The topics take turns, evenly over a period.
    """
    payloads = directory / PAYLOADS
    count = pool_messages(size, topics, messages)
    if pool is None:
        _write_pool(payloads, size, count, seed)
    else:
        os.link(pool, payloads)
    rows = np.arange(topics * messages)
    due = np.rint(rows * (1e9 / (rate * topics))).astype(np.int64)
    load = Load(
        seed=seed,
        channels=tuple(_channel(number, topics) for number in range(topics)),
        channel=(rows % topics).astype(np.int32),
        due=due,
        log_time=START_NS + due,
        offset=(rows % count) * size,
        length=np.full(len(rows), size, np.int64),
        payloads=payloads,
    )
    load.save(directory)
    return load


def _channel(number: int, topics: int) -> Channel:
    digits = len(str(topics - 1))
    return Channel(
        topic=f"/frames/{number:0{digits}}",
        message_encoding="ros1",
        schema=Schema(TYPE, "ros1msg", _DEFINITION.encode()),
        metadata={"callerid": "/hybridlog_benchmarks"},
        has_publish_time=False,
    )


def _write_pool(path: Path, size: int, count: int, seed: int) -> None:
    """Write the different messages of a stream, one after the other."""
    rng = np.random.default_rng(seed)
    beams = size // 2 // 4
    noise = size - _FIXED - 4 * beams
    with path.open("wb") as file:
        for number in range(count):
            stamp = START_NS + number * _STAMP_STEP_NS
            head = np.array([number, *divmod(stamp, 10**9), _FRAME_ID], "<u4")
            file.write(head.tobytes() + f"frame_{number:0{_FRAME_ID - 6}}".encode())
            file.write(np.uint32(beams).tobytes())
            file.write(_scan(rng, beams).tobytes())
            file.write(np.uint32(noise).tobytes())
            file.write(rng.bytes(noise))


def _scan(rng: np.random.Generator, beams: int) -> NDArray[np.float32]:
    """Ranges in metres, float32[beams]: slow waves, in whole millimetres as scanners give."""
    at = np.linspace(0, 2 * np.pi, beams, endpoint=False, dtype=np.float32)
    phase = rng.uniform(0, 2 * np.pi, 3).astype(np.float32)
    metres = 6 + 3 * np.sin(at + phase[0]) + np.sin(3 * at + phase[1])
    metres += np.float32(0.2) * np.sin(17 * at + phase[2])
    found: NDArray[np.float32] = (np.rint(metres * 1000) / np.float32(1000)).astype("<f4")
    return found
