"""Transforms of real logs, against rosbags as reader and pytransform3d as geometry."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pytransform3d.rotations import quaternion_slerp
from pytransform3d.transform_manager import TransformManager
from pytransform3d.transformations import transform_from_pq
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

import hybridlog as hl
from tests.data import DATA, needs_data

LOGS = (
    "real/tilt_laser.bag",
    "real/sick_laser_radar.bag",
    "real/auv_ros2.mcap",
    "odd/example.bag",
)
LOOKUPS = 200
TYPES = "tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"


class Oracle:
    """tf2's rules on what rosbags reads."""

    def __init__(self, path: Path) -> None:
        self.static: dict[str, tuple[str, Any]] = {}
        self.moving: dict[str, dict[int, tuple[str, Any]]] = {}
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            for connection, _, raw in reader.messages():
                if connection.msgtype not in TYPES:
                    continue
                for one in reader.deserialize(raw, connection.msgtype).transforms:
                    self._add(one, is_static=connection.topic.endswith("tf_static"))
        self.stamps = {child: sorted(rows) for child, rows in self.moving.items()}

    def _add(self, one: Any, *, is_static: bool) -> None:
        t, r = one.transform.translation, one.transform.rotation
        child = one.child_frame_id.lstrip("/")
        said = one.header.frame_id.lstrip("/"), np.array([t.x, t.y, t.z, r.w, r.x, r.y, r.z])
        if is_static:
            self.static[child] = said
        else:
            stamp = one.header.stamp.sec * 10**9 + one.header.stamp.nanosec
            self.moving.setdefault(child, {}).setdefault(stamp, said)

    @property
    def frames(self) -> list[str]:
        parents = {said[0] for said in self.static.values()}
        parents |= {said[0] for rows in self.moving.values() for said in rows.values()}
        return sorted(parents | {*self.static, *self.moving})

    def at(self, time: int) -> TransformManager:
        """The frames that have a transform at a time."""
        manager = TransformManager()
        for child, (parent, pose) in self.static.items():
            manager.add_transform(child, parent, transform_from_pq(pose))
        for child, stamps in self.stamps.items():
            if stamps[0] <= time <= stamps[-1]:
                place = bisect_right(stamps, time) - 1
                parent, first = self.moving[child][stamps[place]]
                pose = first
                if place + 1 < len(stamps):
                    _, second = self.moving[child][stamps[place + 1]]
                    share = (time - stamps[place]) / (stamps[place + 1] - stamps[place])
                    turned = quaternion_slerp(first[3:], second[3:], share, shortest_path=True)
                    moved = first[:3] + share * (second[:3] - first[:3])
                    pose = np.concatenate([moved, turned])
                manager.add_transform(child, parent, transform_from_pq(pose))
        return manager


@pytest.fixture(scope="module", params=LOGS)
def log(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    path = DATA / request.param
    folder = tmp_path_factory.mktemp("tf")
    with hl.open(folder / "store", create=True, mongo="none") as store:
        store.record(path)
        yield store.tf(), Oracle(path)


@needs_data
@pytest.mark.parametrize("lookups", [LOOKUPS, pytest.param(10_000, marks=pytest.mark.exhaustive)])
def test_random_times_and_pairs(log: Any, lookups: int) -> None:
    """Also outside the range, where both have none."""
    tree, oracle = log
    assert sorted(tree.names) == oracle.frames
    stamps = [one for own in oracle.stamps.values() for one in (own[0], own[-1])]
    low, high = min(stamps), max(stamps)
    spare = (high - low) // 10
    random = np.random.default_rng(7)
    both = 0
    for time in random.integers(low - spare, high + spare, lookups):
        source, target = random.choice(oracle.frames, 2, replace=False)
        found = tree.lookup(str(target), str(source), np.array([time]))
        manager = oracle.at(int(time))
        try:
            want = manager.get_transform(str(source), str(target))
        except KeyError:
            want = None
        assert bool(found.is_known[0]) == (want is not None), (source, target, time)
        if want is not None:
            both += 1
            np.testing.assert_allclose(found.matrix()[0], want, atol=1e-9)
        else:
            assert sum(found.missing.values()) == 1
    assert both > lookups // 10
