"""Poses, fixes and clouds for other tools, against rosbags and readers of these tests."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

import hybridlog as hl
from hybridlog.cli.answers import write_answer
from hybridlog.formats import OUTPUTS
from hybridlog.formats.files import ply_of
from hybridlog.formats.writing import Answer
from hybridlog.query.query import tables_of
from hybridlog_storage.errors import UsageError
from tests.data import DATA, needs_data
from tests.independent import read_bag

_READ = {
    "char": "i1", "uchar": "u1", "short": "<i2", "ushort": "<u2",
    "int": "<i4", "uint": "<u4", "float": "<f4", "double": "<f8",
}  # fmt: skip


def read_ply(data: bytes) -> np.ndarray[Any, Any]:
    """A reader of binary PLY with vertices only."""
    head, body = data.split(b"end_header\n", 1)
    lines = head.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    count = int(lines[2].removeprefix("element vertex "))
    fields = [line.split()[1:] for line in lines[3:]]
    assert all(line.startswith("property ") for line in lines[3:])
    rows = np.frombuffer(body, [(name, _READ[kind]) for kind, name in fields])
    assert len(rows) == count
    return rows


def written(form: str, *tables: pa.Table, notes: Sequence[str] = ()) -> str:
    stream, answer = io.BytesIO(), Answer(tables=tables)
    OUTPUTS[form].write(answer, stream)
    assert answer.notes == [*notes]
    return stream.getvalue().decode()


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    path = tmp_path_factory.mktemp("places") / "store"
    with hl.open(path, create=True, mongo="none") as store:
        store.record(DATA / "real/sick_laser_radar.bag", name="radar")
        store.record(DATA / "real/tilt_laser.bag", name="tilt")
        store.record(DATA / "real/auv_ros2.mcap", name="auv")
        yield store


@needs_data
def test_clouds_have_all_fields(store: hl.Store, tmp_path: Path) -> None:
    query = store.topic("/cloud_radar_rawtarget")
    write_answer(query, "ply", tmp_path / "out")
    index = [json.loads(line) for line in (tmp_path / "out/index.jsonl").read_text().splitlines()]
    messages = [*query]
    assert len(index) == len(messages)
    for line, message in zip(index, messages, strict=True):
        cloud = message.decode()
        points = read_ply((tmp_path / "out" / line["file"]).read_bytes())
        assert line["points"] == len(points) == cloud.width * cloud.height
        data = np.frombuffer(bytes(cloud.data), np.uint8).reshape(len(points), cloud.point_step)
        kinds = dict(enumerate(["x", "i1", "u1", "<i2", "<u2", "<i4", "<u4", "<f4", "<f8"]))
        assert [*points.dtype.names] == [field.name for field in cloud.fields]
        for field in cloud.fields:
            kind = np.dtype(kinds[field.datatype])
            raw = data[:, field.offset : field.offset + kind.itemsize].copy()
            np.testing.assert_array_equal(points[field.name], raw.view(kind)[:, 0])


@needs_data
def test_scans_become_points(store: hl.Store, tmp_path: Path) -> None:
    scan = next(iter(store.recordings("tilt").topic("scan")))
    points = read_ply(ply_of(scan.to_numpy()))
    said = scan.decode()
    ranges = np.asarray(said.ranges)
    angles = said.angle_min + np.arange(len(ranges)) * said.angle_increment
    np.testing.assert_allclose(points["x"], ranges * np.cos(angles), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(points["y"], ranges * np.sin(angles), rtol=1e-4, atol=1e-4)
    assert not points["z"].any()


@needs_data
def test_poses(store: hl.Store) -> None:
    query = store.topic("/coug2/odom")
    lines = written("tum", *tables_of(query)).splitlines()
    for line, message in zip(lines, query, strict=True):
        said = message.decode()
        pose, stamp = said.pose.pose, said.header.stamp
        p, q = pose.position, pose.orientation
        time, *numbers = line.split(" ")
        assert time == f"{stamp.sec}.{stamp.nanosec:09d}"
        want = [p.x, p.y, p.z, q.x, q.y, q.z, q.w]
        np.testing.assert_array_equal([*map(float, numbers)], want)


def test_the_pose_of_a_table() -> None:
    pose = {f"pose.position.{axis}": [1.0, None] for axis in "xyz"}
    pose |= {f"pose.orientation.{axis}": [0.5, 0.5] for axis in "xyzw"}
    table = pa.table({"log_time": pa.array([-1, 5], pa.timestamp("ns", "UTC")), **pose})
    told = ["1 row without a time or a whole pose left out."]
    assert written("tum", table, notes=told) == "-1.999999999 1.0 1.0 1.0 0.5 0.5 0.5 0.5\n"
    with pytest.raises(UsageError, match="tum takes poses"):
        written("tum", table.drop_columns(["pose.orientation.w"]))
    two = pa.table({**{name: table[name] for name in table.column_names}, "topic": ["a", "b"]})
    with pytest.raises(UsageError, match="one topic"):
        written("tum", two)
    assert written("tum", table.slice(0, 0)) == ""


@needs_data
def test_fixes(store: hl.Store) -> None:
    found = json.loads(written("geojson", *tables_of(store.topic("/position_gps"))))
    assert found["type"] == "FeatureCollection"
    seen = [m for m in read_bag(DATA / "real/tilt_laser.bag") if m.topic == "/position_gps"]
    assert len(found["features"]) == len(seen)
    for feature, message in zip(found["features"], store.topic("/position_gps"), strict=True):
        said = message.decode()
        assert feature["geometry"] == {
            "type": "Point",
            "coordinates": [said.longitude, said.latitude, said.altitude],
        }
        assert re.match(r"20\d\d-", feature["properties"]["header.stamp"])
