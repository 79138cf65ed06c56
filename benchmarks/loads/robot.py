"""The log of a robot: 547 messages a second on eight topics, scans and camera included.

As messages of a load for the harness, and as an MCAP file to be recorded.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.loads.base import Spool
from benchmarks.simulator.topics import Types
from hybridlog_storage.messages import Channel, Schema
from tests.independent import write_mcap

if TYPE_CHECKING:
    from benchmarks.loads.base import Load

START_NS = 1_700_000_000 * 10**9
SECOND_NS = 10**9
BEAMS, WIDTH, HEIGHT = 1080, 640, 480
JOINTS = (b"left__", b"right_", b"mast__")
Rows = NDArray[np.void]
Seconds = NDArray[np.float64]


_HEAD = (("seq", "<u4"), ("secs", "<u4"), ("nsecs", "<u4"), ("id_size", "<u4"), ("id", "S4"))


def _packed(*fields: tuple[Any, ...], header: bool = True) -> np.dtype[Any]:
    """The bytes of a ROS 1 message whose strings and arrays have one length."""
    return np.dtype([*(_HEAD if header else ()), *fields])


IMU = _packed(
    ("orientation", "<f8", 4), ("a", "<f8", 9), ("turn", "<f8", 3), ("b", "<f8", 9),
    ("force", "<f8", 3), ("c", "<f8", 9),
)  # fmt: skip
ODOM = _packed(
    ("child_size", "<u4"), ("child", "S4"), ("position", "<f8", 3), ("orientation", "<f8", 4),
    ("a", "<f8", 36), ("twist", "<f8", 6), ("b", "<f8", 36),
)  # fmt: skip
TF = np.dtype([
    ("transforms", "<u4"), *_HEAD, ("child_size", "<u4"), ("child", "S4"),
    ("position", "<f8", 3), ("orientation", "<f8", 4),
])  # fmt: skip
JOINT_STATES = _packed(
    ("names", "<u4"), ("name", [("size", "<u4"), ("text", "S6")], len(JOINTS)),
    ("positions", "<u4"), ("position", "<f8", len(JOINTS)),
    ("velocities", "<u4"), ("velocity", "<f8", len(JOINTS)), ("efforts", "<u4"),
)  # fmt: skip
SCAN = _packed(
    ("settings", "<f4", 7), ("beams", "<u4"), ("ranges", "<f4", BEAMS), ("intensities", "<u4"),
)  # fmt: skip
IMAGE = _packed(
    ("height", "<u4"), ("width", "<u4"), ("encoding_size", "<u4"), ("encoding", "S5"),
    ("is_bigendian", "u1"), ("step", "<u4"), ("size", "<u4"), ("data", "u1", (HEIGHT, WIDTH)),
)  # fmt: skip
FIX = _packed(
    ("status", "i1"), ("service", "<u2"), ("place", "<f8", 3), ("a", "<f8", 9), ("kind", "u1"),
)  # fmt: skip
MODE = _packed(("data", "u1"), header=False)


class RobotTypes(Types):
    """The message types of ROS 1, and the channels of a bag."""

    def channel(self, topic: str, msgtype: str, node: str) -> Channel:
        """The channel of a topic, as a ROS 1 bag describes it."""
        text, checksum = self.store.generate_msgdef(msgtype, ros_version=1)
        schema = Schema(msgtype.replace("/msg/", "/"), "ros1msg", text.encode())
        metadata = {"callerid": node, "latching": "0", "md5sum": checksum}
        return Channel(topic, "ros1", schema, metadata, has_publish_time=False)


def _speed(seconds: Seconds) -> Seconds:
    """Forward speed of the robot, m/s: it stands still now and then."""
    return np.maximum(0.0, np.sin(seconds / 40) + 0.3 * np.sin(seconds / 7))


def _imu(rows: Rows, seconds: Seconds, noise: np.random.Generator) -> None:
    rows["orientation"][:, 2] = np.sin(seconds / 120)
    rows["orientation"][:, 3] = np.cos(seconds / 120)
    rows["turn"] = noise.normal(scale=0.01, size=(len(rows), 3))
    rows["force"] = noise.normal(scale=0.1, size=(len(rows), 3))
    rows["force"][:, 2] += 9.81


def _odom(rows: Rows, seconds: Seconds, noise: np.random.Generator) -> None:
    rows["child_size"], rows["child"] = 4, b"base"
    rows["position"][:, 0], rows["position"][:, 1] = 20 * np.sin(seconds / 90), seconds / 100
    rows["orientation"][:, 3] = 1
    rows["twist"][:, 0] = _speed(seconds) + noise.normal(scale=0.01, size=len(rows))


def _tf(rows: Rows, seconds: Seconds, noise: np.random.Generator) -> None:
    rows["transforms"], rows["child_size"], rows["child"] = 1, 4, b"base"
    rows["position"][:, 0] = 20 * np.sin(seconds / 90)
    rows["orientation"][:, 3] = 1


def _joint_states(rows: Rows, seconds: Seconds, noise: np.random.Generator) -> None:
    rows["names"] = rows["positions"] = rows["velocities"] = len(JOINTS)
    rows["name"]["size"], rows["name"]["text"] = 6, JOINTS
    rows["position"][:] = (seconds[:, None] * (1, 1.1, 0.01)) % 6.28
    rows["velocity"][:] = _speed(seconds)[:, None]


def _scan(rows: Rows, seconds: Seconds, noise: np.random.Generator) -> None:
    rows["settings"] = -3.14, 3.14, 6.28 / BEAMS, 0, 0.05, 0.1, 30
    rows["beams"] = BEAMS
    walls = 6 + 5.6 * np.sin(seconds[:, None] / 61 + np.arange(BEAMS) / 171)
    rows["ranges"] = np.round(walls + noise.normal(scale=0.01, size=walls.shape), 3)


def _image(rows: Rows, seconds: Seconds, noise: np.random.Generator) -> None:
    rows["height"], rows["width"], rows["encoding_size"] = HEIGHT, WIDTH, 5
    rows["encoding"], rows["step"], rows["size"] = b"mono8", WIDTH, HEIGHT * WIDTH
    across = np.arange(WIDTH) + 10 * seconds[:, None, None]
    rows["data"] = (
        2 * across + np.arange(HEIGHT)[:, None] + noise.integers(0, 4, rows["data"].shape)
    )


def _fix(rows: Rows, seconds: Seconds, noise: np.random.Generator) -> None:
    rows["place"] = 52.0, 8.0, 60.0
    rows["place"][:, 0] += seconds * 1e-6 + noise.normal(scale=1e-6, size=len(rows))


def _mode(rows: Rows, seconds: Seconds, noise: np.random.Generator) -> None:
    rows["data"] = seconds // 97 % 7


Fill = Callable[[Rows, Seconds, np.random.Generator], None]
TOPICS: dict[str, tuple[int, str, np.dtype[Any], Fill]] = {
    "/imu/data": (200, "sensor_msgs/Imu", IMU, _imu),
    "/tf": (100, "tf2_msgs/TFMessage", TF, _tf),
    "/odom": (100, "nav_msgs/Odometry", ODOM, _odom),
    "/joint_states": (100, "sensor_msgs/JointState", JOINT_STATES, _joint_states),
    "/scan": (40, "sensor_msgs/LaserScan", SCAN, _scan),
    "/camera/image_raw": (5, "sensor_msgs/Image", IMAGE, _image),
    "/fix": (1, "sensor_msgs/NavSatFix", FIX, _fix),
    "/mode": (1, "std_msgs/UInt8", MODE, _mode),
}
"""Messages a second, type, layout and content."""
RATE = sum(rate for rate, *_ in TOPICS.values())
"""Messages a second of all topics."""

Message = tuple[int, int, bytes]
"""Log time, number of the channel, payload."""


def channels() -> list[Channel]:
    """One for each topic, in the order of `TOPICS`."""
    types = RobotTypes()
    return [
        types.channel(topic, kind.replace("/", "/msg/"), "/robot")
        for topic, (_, kind, _, _) in TOPICS.items()
    ]


def messages(seconds: int, seed: int) -> Iterator[list[Message]]:
    """The messages of each second, in order; every half hour a second lacks scans."""
    noise = np.random.default_rng(seed)
    for second in range(seconds):
        found: list[Message] = []
        for number, (topic, (rate, _, layout, fill)) in enumerate(TOPICS.items()):
            if topic == "/scan" and second % 1800 == 900:
                continue
            since = second + np.arange(rate) / rate
            times = START_NS + second * SECOND_NS + np.arange(rate) * (SECOND_NS // rate) + number
            rows = np.zeros(rate, layout)
            if layout is not MODE:
                rows["id_size"], rows["id"] = 4, b"odom" if topic == "/odom" else b"base"
                rows["seq"] = second * rate + np.arange(rate)
                rows["secs"], rows["nsecs"] = np.divmod(times, SECOND_NS)
            fill(rows, since, noise)
            size, data = layout.itemsize, rows.tobytes()
            found += [
                (log_time, number, data[n * size : (n + 1) * size])
                for n, log_time in enumerate(times.tolist())
            ]
        found.sort()
        yield found


def robot_load(directory: Path, *, seconds: int, seed: int) -> Load:
    """The log as a load."""
    spool = Spool(directory)
    for found in messages(seconds, seed):
        times, numbers, payloads = zip(*found, strict=True)
        spool.messages(np.array(numbers, np.int32), payloads, np.array(times, np.int64))
    return spool.finish(seed, channels())


def write_log(path: Path, *, seconds: int, seed: int) -> None:
    """Write the log as an MCAP file."""
    known = channels()
    said = (
        (known[number], log_time, payload)
        for found in messages(seconds, seed)
        for log_time, number, payload in found
    )
    write_mcap(path, said)
