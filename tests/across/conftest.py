"""Two recordings that overlap in time, with ties, gaps and stamps that go backwards."""

from __future__ import annotations

import json
import random
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import hybridlog as hl
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests.independent import write_mcap
from tests.limits import Limit

MS = 10**6
BASE = 1_748_937_600 * 10**9
POSE = """\
std_msgs/Header header
geometry_msgs/Quaternion orientation
float64 x
float32 y
int64 ticks
string state
float64[] list
bool on
float64 distance
================================================================================
MSG: std_msgs/Header
uint32 seq
time stamp
string frame_id
================================================================================
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
"""


@dataclass
class Said:
    """A message as it was written."""

    topic: str
    time: int
    stamp: int
    number: int
    fields: dict[str, object] = field(default_factory=dict)


def _pose(said: Said) -> bytes:
    rng = random.Random(said.number)
    q = np.array([rng.gauss(0, 1) for _ in range(4)])
    q /= np.linalg.norm(q)
    if said.number % 11 == 0:
        q[:] = 0  # not set
    state = rng.choice(["go", "stop", ""])
    values = [rng.gauss(0, 1) for _ in range(rng.choice([0, 2, 40]))]
    said.fields = {
        "q": q,
        "x": float("nan") if said.number % 13 == 0 else rng.gauss(0, 5),
        "y": struct.unpack("<f", struct.pack("<f", rng.gauss(0, 5)))[0],
        "ticks": rng.randrange(-(2**40), 2**40),
        "state": state,
        "list": values,
        "on": rng.random() < 0.5,
        "distance": float(said.number),
    }
    head = struct.pack("<3I", said.number, said.stamp // 10**9, said.stamp % 10**9)
    return (
        head
        + struct.pack("<I1s", 1, b"a")
        + struct.pack("<4d", *q)
        + struct.pack("<dfq", said.fields["x"], said.fields["y"], said.fields["ticks"])
        + struct.pack("<I", len(state))
        + state.encode()
        + struct.pack("<I", len(values))
        + struct.pack(f"<{len(values)}d", *values)
        + struct.pack("<?d", said.fields["on"], said.fields["distance"])
    )


def _write(path: Path, seed: int) -> list[Said]:
    rng = random.Random(seed)
    said: list[Said] = []
    for topic, period, count in (
        ("/base", 10, 130),
        ("/left/pose", 4, 300),
        ("/right/pose", 33, 40),
    ):
        if topic == "/right/pose" and seed == 3:
            continue
        time = BASE + seed * 300 * MS
        for _ in range(count):
            time += rng.choice([0, 0, 1, period, period, 3 * period]) * MS
            stamp = time - rng.randrange(30) * MS
            said.append(Said(topic, time, stamp, len(said) + 1))
    said.sort(key=lambda one: one.time)
    schema = Schema("demo/Pose", "ros1msg", POSE.encode())
    weather = Channel("/weather", "json", Schema("Any", "jsonschema", b"{}"))
    channel = cache(lambda topic: Channel(topic, "ros1", schema))
    rows: list[tuple[Channel, int, bytes, int]] = []
    for one in said:
        rows.append((channel(one.topic), one.time, _pose(one), one.stamp))
        if one.topic == "/right/pose":
            report = json.dumps({"n": one.number, "v": one.number / 2 if seed == 2 else "hot"})
            rows.append((weather, one.time, report.encode(), one.time))
    write_mcap(path, rows, [weather])
    return said


@dataclass
class Logs:
    """An open store, and what its recordings hold, by label."""

    store: hl.Store
    said: dict[str, list[Said]]

    def of(self, label: str, topic: str) -> list[Said]:
        return [one for one in self.said[label] if one.topic == topic]


@pytest.fixture(scope="package")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Logs]:
    path = tmp_path_factory.mktemp("across")
    said = {name: _write(path / f"{name}.mcap", seed) for name, seed in (("b", 2), ("c", 3))}
    with hl.open(path / "store", create=True) as store:
        for name in said:
            store.record(path / f"{name}.mcap", settings=SegmentSettings(chunk_size=4096))
        yield Logs(store, said)


@pytest.fixture(params=[65_536, 3], ids=["whole", "in blocks"])
def blocks(request: pytest.FixtureRequest, limit: Limit) -> None:
    """Rows are read in blocks of so many, and made a few at a time where messages are large."""
    limit(align_piece_bytes=request.param * 400, frame_block_rows=request.param)
