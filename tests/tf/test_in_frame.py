"""Points and poses in another frame, against rosbags and pytransform3d."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pytransform3d.transformations import transform_from_pq
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

import hybridlog as hl
from benchmarks.simulator.write import write_bag
from hybridlog_storage.errors import IncompleteError, TopicError, UsageError
from tests.cli.running import run
from tests.data import DATA, needs_data
from tests.formats.test_places import read_ply
from tests.tf.test_oracle import Oracle

TILT = DATA / "real/tilt_laser.bag"


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six seconds of the demo's robot as `robot`, in a folder with `robot.bag`."""
    folder = tmp_path_factory.mktemp("frames")
    write_bag(folder / "robot.bag", duration_s=6)
    with hl.open(folder / "store", create=True, mongo="none") as store:
        store.record(folder / "robot.bag", name="robot")
        if TILT.exists():
            store.record(TILT, name="tilt")
    return folder


@pytest.fixture(scope="module")
def store(demo: Path) -> Iterator[hl.Store]:
    with hl.open(demo / "store", mongo="none") as opened:
        yield opened


def messages(path: Path, topic: str) -> list[Any]:
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        found = [c for c in reader.connections if c.topic == topic]
        return [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages(found)]


def stamp(message: Any) -> int:
    return int(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)


def matrix(oracle: Oracle, message: Any, target: str) -> Any | None:
    try:
        source = message.header.frame_id.lstrip("/")
        return oracle.at(stamp(message)).get_transform(source, target)
    except KeyError:
        return None


@needs_data
def test_scans_of_a_real_log(demo: Path, store: hl.Store, tmp_path: Path) -> None:
    """The first scan comes before the first transform; it keeps its place, and is reported."""
    query = store.recordings("tilt").topic("scan").in_frame("tilt_base")
    arrays, oracle, missing = query.to_numpy(), Oracle(TILT), 0
    scans = messages(TILT, "/scan")
    run("fetch", "-r", "tilt", "-t", "scan", "--in-frame", "tilt_base", "-F", "ply", "-o",
        tmp_path / "out", store=demo / "store")  # fmt: skip
    index = [json.loads(line) for line in (tmp_path / "out/index.jsonl").read_text().splitlines()]
    table = query.in_frame("tilt_base").to_arrow()
    assert len(scans) == len(arrays) == len(index) == table.num_rows
    for scan, points, line, row in zip(scans, arrays, index, table.to_pylist(), strict=True):
        angle = scan.angle_min + np.arange(len(scan.ranges)) * float(scan.angle_increment)
        ranges = scan.ranges.astype(np.float64)
        own = np.stack([ranges * np.cos(angle), ranges * np.sin(angle), 0 * angle, 1 + 0 * angle])
        found = np.stack([points[axis] for axis in "xyz"])
        np.testing.assert_array_equal(points["range"], scan.ranges)
        turn = matrix(oracle, scan, "tilt_base")
        if turn is None:
            missing += 1
            assert np.isnan(found).all()
        else:
            np.testing.assert_allclose(found, (turn @ own)[:3], atol=1e-4)  # angles are float32
        for axis, values in zip("xyz", found, strict=True):
            np.testing.assert_array_equal(row[axis], values)
            cloud = read_ply((tmp_path / "out" / line["file"]).read_bytes())
            np.testing.assert_array_equal(cloud[axis], values)
    assert 0 < missing < len(scans)
    (said,) = [one for one in query.completeness().sentences if "transform" in one]
    assert said.startswith(f"{missing} message")
    assert "before the first transform of" in said
    with pytest.raises(IncompleteError, match="without a transform"):
        query.completeness().check()
    aligned = ("align", "--to", "scan", "-t", "temperature", "-r", "tilt", "-F", "jsonl")
    done = run(*aligned, "--in-frame", "tilt_base", store=demo / "store")
    assert said in done.err
    rows = [json.loads(line) for line in done.out.splitlines()]
    assert rows[-1]["scan.x"] == table["x"][-1].as_py()
    assert rows[-1]["temperature.reading"] is not None
    fetched = ("fetch", "-t", "scan", "-r", "tilt", "--strict", "--in-frame", "tilt_base")
    for asked in (
        ("--strict", "--in-frame", "tilt_base", *aligned[1:-2], "-F", "csv"),
        (*fetched[1:], "-F", "ply"),
        (*fetched[1:], "-F", "parquet"),
    ):
        command = aligned[0] if "--to" in asked else "fetch"
        out = tmp_path / "strict"
        done = run(command, *asked, "-o", out, store=demo / "store", code=11)
        assert "without a transform" in done.err
        assert not [*tmp_path.glob("*strict*")]


def test_poses_of_many_rows(demo: Path, store: hl.Store) -> None:
    oracle = Oracle(demo / "robot.bag")
    odometry = messages(demo / "robot.bag", "/odom")
    query = store.recordings("robot").topic("odom").in_frame("map")
    table = query.to_arrow()
    rows = table.to_pylist()
    assert len(rows) == len(odometry)
    some = np.random.default_rng(3).integers(0, len(rows), 200)
    known = 0
    for place in {0, len(rows) - 1, *some.tolist()}:
        row, message = rows[place], odometry[place]
        turn = matrix(oracle, message, "map")
        assert row["header.frame_id"] == "map"
        if turn is None:
            assert row["pose.pose.position.x"] is row["pose.covariance"] is None
            continue
        known += 1
        p, q = message.pose.pose.position, message.pose.pose.orientation
        want = turn @ transform_from_pq([p.x, p.y, p.z, q.w, q.x, q.y, q.z])
        pose = [row[f"pose.pose.position.{axis}"] for axis in "xyz"]
        pose += [row[f"pose.pose.orientation.{axis}"] for axis in "wxyz"]
        np.testing.assert_allclose(transform_from_pq(pose), want, atol=1e-9)
        both = np.kron(np.eye(2), turn[:3, :3])
        want = both @ np.reshape(message.pose.covariance, (6, 6)) @ both.T
        np.testing.assert_allclose(np.reshape(row["pose.covariance"], (6, 6)), want, atol=1e-9)
        assert row["twist.twist.linear.x"] == message.twist.twist.linear.x
    assert known > 100
    # Whatever is asked of it, a pose is the same.
    x = query.fields("pose.pose.position.x")
    assert x.to_arrow()["pose.pose.position.x"].equals(table["pose.pose.position.x"])
    assert x.to_arrow().column_names == ["log_time", "pose.pose.position.x"]
    assert len(query.where("pose.pose.position.x > 1e9").to_pandas()) == 0
    asof = store.align(store.topic("battery"), x).to_arrow()["odom.pose.pose.position.x"]
    plain = store.align(store.topic("battery"), store.topic("odom")).to_arrow()
    by_stamp = {row["header.stamp"]: row["pose.pose.position.x"] for row in rows}
    assert asof.to_pylist() == [by_stamp.get(one) for one in plain["odom.header.stamp"].to_pylist()]


def test_formats_and_refusals(demo: Path, store: hl.Store) -> None:
    where = demo / "store"
    fetch = ("fetch", "-r", "robot", "-t", "odom", "--in-frame", "map")
    rows = [*csv.DictReader(io.StringIO(run(*fetch, "-F", "csv", store=where).out))]
    lines = [json.loads(line) for line in run(*fetch, "-F", "jsonl", store=where).out.splitlines()]
    tum = run(*fetch, "-F", "tum", store=where).out.splitlines()
    for row, line in zip(rows, lines, strict=True):
        value = line["pose.pose.position.x"]
        assert row["pose.pose.position.x"] == ("" if value is None else repr(value))
    known = [line for line in lines if line["pose.pose.position.x"] is not None]
    assert [float(line.split()[1]) for line in tum] == [
        line["pose.pose.position.x"] for line in known
    ]
    assert "pose" in run(*fetch, "-n", "1", "-F", "table", store=where).out
    assert "as they came" in run(*fetch, "-F", "mcap", "-o", "x.mcap", store=where, code=2).err
    with pytest.raises(TopicError, match="no frame 'nowhere'; there are map, odom"):
        store.recordings("robot").topic("odom").in_frame("nowhere").to_arrow()
    with pytest.raises(UsageError, match="no points or poses"):
        store.recordings("robot").topic("battery").in_frame("map").to_arrow()
    with pytest.raises(UsageError, match="of one topic"):
        store.recordings("robot").topic("odom", "scan").in_frame("map").to_arrow()
    odom = store.topic("odom").in_frame("map")
    for ask in (
        lambda: store.sync([odom, "/base/scan"]),
        lambda: next(iter(odom)),
        lambda: odom.at("+1s"),
        lambda: odom.changes("pose.pose.position.x"),
    ):
        with pytest.raises(UsageError, match="as they came: leave out in_frame"):
            ask()
    with pytest.raises(UsageError, match="are a list"):
        store.sync("scan")
