"""Tracks of satellite receivers, against geodesy by other formulas and every message."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader

import hybridlog as hl
from benchmarks.simulator.write import write_bag
from hybridlog.drawing.series import Grid, position_of, track
from hybridlog.query.query import field_types
from hybridlog_storage.errors import UsageError
from hybridlog_storage.messages import Channel, Schema
from tests.ros_values import ROS1

MS = 10**6
BASE = 1_700_000_000 * 10**9
COUNT = 4000
NAME = "sensor_msgs/msg/NavSatFix"


def payload(latitude: float, longitude: float, status: int = 0, **more: Any) -> bytes:
    types = ROS1.types
    stamp = types["builtin_interfaces/msg/Time"](1, 2)
    message = types[NAME](
        types["std_msgs/msg/Header"](0, stamp, "gps"),
        types["sensor_msgs/msg/NavSatStatus"](status, 1),
        latitude,
        longitude,
        more.get("altitude", 12.5),
        np.array(more.get("covariance", [4, 0, 0, 0, 1, 0, 0, 0, 9]), np.float64),
        more.get("kind", 2),
    )
    return bytes(ROS1.serialize_ros1(message, NAME))


def channel(topic: str) -> Channel:
    text = ROS1.generate_msgdef(NAME, ros_version=1)[0].encode()
    return Channel(topic, "ros1", Schema("sensor_msgs/NavSatFix", "ros1msg", text))


def walk() -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.bool_]]:
    """Times, latitude and longitude, and whether there is a fix."""
    rng = np.random.default_rng(5)
    steps = np.full(COUNT, 100 * MS)
    steps[3000] = 60_000 * MS
    position = np.array((48.1, 11.6)) + np.cumsum(rng.normal(scale=1e-5, size=(COUNT, 2)), axis=0)
    position[777] += (0.01, 0)  # a single outlier, which no picture may lose
    has_fix = np.ones(COUNT, np.bool_)
    has_fix[1000:1100] = False
    has_fix[2000] = False
    return BASE + np.cumsum(steps), position, has_fix


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    times, position, has_fix = walk()
    with hl.open(tmp_path_factory.mktemp("track") / "store", create=True) as opened:
        with opened.start("walk") as recorder:
            fix, other = channel("/fix"), channel("/other")
            schema = Schema("foxglove.LocationFix", "jsonschema", b"{}")
            loose = Channel("/json", "json", schema)
            for time, (lat, lon), is_there in zip(
                times.tolist(), position.tolist(), has_fix.tolist(), strict=True
            ):
                recorder.write(fix, payload(lat, lon, 0 if is_there else -1), log_time=time)
            for at in range(5):
                value = {"latitude": 10.0 + at / 1000, "longitude": 20.0}
                recorder.write(loose, json.dumps(value).encode(), log_time=BASE + at * MS)
            # Across the line where the date changes; then no positions.
            for at, (lat, lon) in enumerate(
                [(0.0, 179.999), (0.0, -179.999), (0.0, 180.001), (91.0, 0.0), (math.nan, 1.0)]
            ):
                recorder.write(other, payload(lat, lon), log_time=BASE + at * MS)
        yield opened


def test_every_fix(store: hl.Store) -> None:
    times, position, has_fix = walk()
    got = track(store.topic("fix"), pixels=1000)
    assert got["exact"]
    assert (got["messages"], got["fixes"]) == (COUNT, COUNT - 101)
    assert got["grid"] is not None
    assert (got["grid"].latitude, got["grid"].longitude) == tuple(position[0])
    # One entry of NaN in the pause.
    assert len(got["times"]) == COUNT + 1
    assert got["times"][3000] == times[2999] + 30_000 * MS
    assert np.isnan(got["xy"][3000]).all()
    assert np.array_equal(np.delete(got["times"], 3000), times)
    xy = np.delete(got["xy"], 3000, axis=0)
    assert np.array_equal(np.isnan(xy).any(axis=1), ~has_fix)
    # On a sphere that fits the ellipsoid there: half a percent is its error.
    north = np.radians(position[:, 0] - position[0, 0]) * 6_371_000
    east = np.radians(position[:, 1] - position[0, 1]) * 6_371_000
    east *= math.cos(math.radians(48.1))
    assert np.allclose(xy[has_fix, 1], north[has_fix], rtol=5e-3, atol=1e-3)
    assert np.allclose(xy[has_fix, 0], east[has_fix], rtol=5e-3, atol=1e-3)
    assert got["xy"][777, 1] > 1000


@pytest.mark.parametrize("pixels", [1, 7, 50, 600])
def test_extremes_of_each_pixel_are_kept(store: hl.Store, pixels: int) -> None:
    whole = track(store.topic("fix"), pixels=1000)
    got = track(store.topic("fix"), pixels=pixels)
    assert not got["exact"]
    assert len(got["times"]) <= 7 * pixels + 1
    assert (got["messages"], got["fixes"], got["grid"]) == (
        whole["messages"],
        whole["fixes"],
        whole["grid"],
    )
    assert (np.diff(got["times"]) > 0).all()
    known = dict(zip(whole["times"].tolist(), map(tuple, whole["xy"].tolist()), strict=True))
    for time, (x, y) in zip(got["times"].tolist(), got["xy"].tolist(), strict=True):
        if time in known and not math.isnan(x):
            assert known[time] == (x, y)
    begin, end = BASE + 100 * MS, int(whole["times"][-1]) + 1
    width = -(-(end - begin) // pixels)
    is_message = whole["times"] != whole["times"][2999] + 30_000 * MS
    for pixel in range(pixels):
        there = whole["xy"][is_message & ((whole["times"] - begin) // width == pixel)]
        here = (got["times"] - begin) // width == pixel
        if not len(there):
            continue
        if np.isnan(there).all():
            assert np.isnan(got["xy"][here]).all()
            continue
        assert np.array_equal(np.nanmin(there, axis=0), np.nanmin(got["xy"][here], axis=0))
        assert np.array_equal(np.nanmax(there, axis=0), np.nanmax(got["xy"][here], axis=0))
        if np.isnan(there).any():
            assert np.isnan(got["xy"][here]).any()


def test_the_short_way_round(store: hl.Store) -> None:
    got = track(store.topic("other"), pixels=10)
    assert np.allclose(got["xy"][:3, 0], [0, 222.64, 222.64], atol=0.01)
    assert np.isnan(got["xy"][3:]).all()
    assert (got["messages"], got["fixes"]) == (5, 3)


def test_messages_that_arrive_in_pairs_have_no_gaps(tmp_path: Path) -> None:
    with hl.open(tmp_path / "store", create=True) as store:
        with store.start("pairs") as recorder:
            for at in range(40):
                time = BASE + (at // 2) * 100 * MS + at % 2 + (5000 * MS if at >= 20 else 0)
                recorder.write(channel("/fix"), payload(48.0, 11.0), log_time=time)
        got = track(store.topic("fix"), pixels=100)
    assert np.flatnonzero(np.isnan(got["xy"][:, 0])).tolist() == [20]


def test_the_grid_is_on_the_ellipsoid() -> None:
    # Lengths of a degree, from the tables of the ellipsoid.
    for latitude, east, north in (
        (0, 111_319.49, 110_574.28),
        (45, 78_846.81, 111_131.78),
        (60, 55_800.19, 111_412.24),
        (90, 0, 111_693.98),
    ):
        grid = Grid.at(latitude, 0)
        assert (grid.east, grid.north) == (
            pytest.approx(east, abs=0.6),
            pytest.approx(north, abs=0.6),
        )


def test_topics_without_positions(store: hl.Store) -> None:
    with pytest.raises(UsageError, match="2 topics in 1 recordings"):
        track(store.topic("fix", "other"), pixels=10)
    with pytest.raises(UsageError, match="left to right"):
        track(store.topic("fix").reverse(), pixels=10)
    with pytest.raises(UsageError, match="at least one pixel"):
        track(store.topic("fix"), pixels=0)


def test_poses_of_a_robot(tmp_path: Path) -> None:
    """Against the messages as rosbags reads them."""
    bag = tmp_path / "robot.bag"
    write_bag(bag, duration_s=8, topics=["/odom", "/r_cart/command_pose"])
    with AnyReader([bag]) as reader:
        (connection,) = (c for c in reader.connections if c.topic == "/odom")
        read = [
            (time, reader.deserialize(raw, connection.msgtype).pose.pose)
            for _, time, raw in reader.messages([connection])
        ]
    with hl.open(tmp_path / "store", create=True) as store:
        store.record(bag)
        query = store.topic("odom")
        paths = ("pose.pose.position.x", "pose.pose.position.y")
        assert position_of(field_types(query)) == (paths, False)
        got = track(query, pixels=len(read))
        assert (got["is_geographic"], got["grid"], got["exact"]) == (False, None, True)
        assert got["times"].tolist() == [time for time, _ in read]
        assert got["xy"].tolist() == [[pose.position.x, pose.position.y] for _, pose in read]
        thin = track(query, pixels=10)
        assert not thin["exact"]
        assert (thin["messages"], thin["fixes"]) == (len(read), len(read))
        assert {tuple(place) for place in thin["xy"].tolist()} <= {
            tuple(p) for p in got["xy"].tolist()
        }
        paths = ("pose.position.x", "pose.position.y")
        assert position_of(field_types(store.topic("r_cart/command_pose"))) == (paths, False)
