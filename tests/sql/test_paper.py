"""The paper's questions, asked in four ways of one store, have one answer each."""

from __future__ import annotations

import struct
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer
from pymongo import MongoClient

import hybridlog as hl
from tests.tables.logs import BASE, SECOND

COMMAND, VIEW, ARM = (
    "/r_gripper_controller/command",
    "/rviz_camera_publisher/camera_pose",
    "/r_cart/command_pose",
)
POSE = "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n"
POINT = "MSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n"
TURN = "MSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"
LINE = "=" * 80 + "\n"
STAMPED = LINE.join(
    [
        "Header header\ngeometry_msgs/Pose pose\n",
        "MSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n",
        f"MSG: geometry_msgs/Pose\n{POSE}",
        POINT,
        TURN,
    ]
)
KINDS = {
    COMMAND: ("pr2_controllers_msgs/Pr2GripperCommand", "float64 position\nfloat64 max_effort\n"),
    VIEW: ("geometry_msgs/Pose", LINE.join([POSE, POINT, TURN])),
    ARM: ("geometry_msgs/PoseStamped", STAMPED),
}


def write_log(path: Path) -> Path:
    """A log of 400 messages a topic, whose times differ by tens of milliseconds."""
    rng = np.random.default_rng(7)
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channels = {
            topic: writer.register_channel(
                topic, "ros1", writer.register_schema(name, "ros1msg", text.encode())
            )
            for topic, (name, text) in KINDS.items()
        }
        times = np.sort(rng.integers(0, 400 * SECOND, 1200))
        for n, time in enumerate((BASE + times).tolist()):
            topic = list(KINDS)[n % 3]
            pose = struct.pack("<7d", *rng.uniform(-1.2, 1.6, 7))
            data = {
                COMMAND: struct.pack("<dd", [0.0, 0.08][n % 2], 50.0),
                VIEW: pose,
                ARM: struct.pack("<IIII", n, 0, 0, 0) + pose,
            }[topic]
            writer.add_message(channels[topic], time, data, time)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def in_mongodb(db: Any) -> list[int]:
    """Appendix A of the paper, but for JavaScript's syntax; rows that were found are counted."""
    half = timedelta(milliseconds=500)
    rows = [
        db.rviz_camera_publisher__camera_pose.find_one(
            {
                "position.x": {"$gte": 0},
                "_meta.inserted_at": {
                    "$lt": closing["_meta"]["inserted_at"] + half,
                    "$gt": closing["_meta"]["inserted_at"] - half,
                },
            }
        )
        for closing in db.r_gripper_controller__command.find({"position": 0.0})
    ]
    return [
        db.r_gripper_controller__command.count_documents({"position": 0.0}),
        db.rviz_camera_publisher__camera_pose.count_documents({"position.x": {"$lte": 0}}),
        db.r_cart__command_pose.count_documents(
            {
                "pose.position.z": {"$gt": 1},
                "pose.position.y": {"$gt": -0.5, "$lt": 0.5},
                "pose.position.x": {"$gt": 0.5, "$lt": 1},
            }
        ),
        sum(row is not None for row in rows),
    ]


def in_predicates(store: hl.Store) -> list[int]:
    closed = store.topic(COMMAND).where("position == 0")
    inside = (
        "pose.position.z > 1 and pose.position.y > -0.5 and pose.position.y < 0.5 "
        "and pose.position.x > 0.5 and pose.position.x < 1"
    )
    return [
        closed.count(),
        store.topic(VIEW).where("position.x <= 0").count(),
        store.topic(ARM).where(inside).count(),
        closed.where(f"{VIEW}: position.x >= 0", within="500ms").count(),
    ]


def in_sql(store: hl.Store) -> list[int]:
    queries = [
        "select count(*) from r_gripper_controller__command where position = 0",
        "select count(*) from rviz_camera_publisher__camera_pose where position.x <= 0",
        """select count(*) from r_cart__command_pose
           where pose.position.z > 1 and pose.position.y > -0.5 and pose.position.y < 0.5
             and pose.position.x > 0.5 and pose.position.x < 1""",
        """select count(*) from r_gripper_controller__command a
           where position = 0 and exists (
               select 1 from rviz_camera_publisher__camera_pose b
               where b.recording = a.recording and b.position.x >= 0
                 and abs(b.t - a.t) < 500000000)""",
    ]
    return [store.sql(query).rows()[0][0] for query in queries]


def in_frames(store: hl.Store) -> list[int]:
    grips, poses, arms = (store.topic(topic).to_pandas() for topic in (COMMAND, VIEW, ARM))
    closings = grips.index[grips["position"] == 0].asi8
    ahead = poses.index[poses["position.x"] >= 0].asi8
    x, y, z = (arms[f"pose.position.{axis}"] for axis in "xyz")
    near = [bool((np.abs(ahead - time) < 500_000_000).any()) for time in closings]
    return [
        len(closings),
        int((poses["position.x"] <= 0).sum()),
        int(((z > 1) & (y > -0.5) & (y < 0.5) & (x > 0.5) & (x < 1)).sum()),
        sum(near),
    ]


def test_four_ways_agree(tmp_path: Path, mongo: str) -> None:
    with hl.open(tmp_path / "store", create=True, mongo=mongo) as store:
        store.record(write_log(tmp_path / "log.mcap"))
        database = store.database
        assert database is not None
        with MongoClient[dict[str, Any]](database.address) as client:
            wanted = in_mongodb(client[database.name])
        assert all(0 < count < 400 for count in wanted)
        assert wanted[3] < wanted[0]
        assert in_predicates(store) == in_sql(store) == in_frames(store) == wanted
