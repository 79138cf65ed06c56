"""The logs of the speed and micro benchmarks: ROS 1 bags and MCAP files, made from a seed.

Each is written a second of log time at a time, so that making a log of any length
takes no more memory than making a short one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Reader, Writer

from benchmarks.loads.simulation.wire import Template, Types

if TYPE_CHECKING:
    from numpy.typing import NDArray

START_NS = 1_700_000_000 * 1_000_000_000
IMAGE_SIDE = 800
"""Pixels; 800 by 800 `mono8` are 640 000 bytes."""
CAMERA = (640, 480)
"""Width and height in pixels of the cameras of the drive, `mono8`."""
CAMERA_HZ = 15.0
SCAN_HZ = 20.0
SCAN_BEAMS = 720
SCAN_TOPIC = "/scan"
IMU_TOPIC = "/imu/data"

_DELAY_NS = 1_000_000
Columns = dict[str, "NDArray[Any]"]
_Frames = Callable[[np.random.Generator, int, "NDArray[np.uint8]"], None]
"""Fills frames, uint8[n, height, width], from a generator and the number of the first."""


@dataclass(frozen=True, slots=True)
class _Stream:
    """One topic of a log.

    Attributes:
        topic: Name.
        msgtype: As rosbags spells it.
        hz: Rate, evenly spaced.
        template: A message of it.
        values: Makes the values that vary of some messages, from a generator, the
            number of the first message and their count.
        phase_ns: Log time of the first message after the start, ns.
    """

    topic: str
    msgtype: str
    hz: float
    template: Template
    values: Callable[[np.random.Generator, int, int], Columns]
    phase_ns: int = 0


def write_small(path: Path, messages: int, seed: int) -> None:
    """Poses, IMU, transforms and joint states, a quarter each, at 100 Hz each."""
    types = Types(1)
    streams = [_pose(types, 100.0), _imu(types, 100.0), _tf(types, 100.0), _joints(types, 100.0)]
    _write(path, types, streams, messages / 400, seed)


def write_imu(path: Path, messages: int, seed: int) -> None:
    """Nothing but IMU messages, at 200 Hz."""
    types = Types(1)
    _write(path, types, [_imu(types, 200.0)], messages / 200, seed)


def write_images(path: Path, messages: int, seed: int) -> None:
    """Images of 640 kB at 10 Hz: one half of each is noise, the other a smooth surface."""
    types = Types(1)
    camera = _camera(types, "/camera/image_raw", (IMAGE_SIDE, IMAGE_SIDE), 10.0, _half_noise)
    _write(path, types, [camera], messages / 10, seed)


def write_drive(path: Path, duration_s: float, seed: int) -> None:
    """Two cameras and a laser scanner."""
    types = Types(1)
    streams = [
        _camera(types, "/camera/left/image_raw", CAMERA, CAMERA_HZ, _scene),
        _camera(types, "/camera/right/image_raw", CAMERA, CAMERA_HZ, _scene, phase_ns=7_000_000),
        _scan(types),
    ]
    _write(path, types, streams, duration_s, seed)


def bag_to_mcap(bag: Path, path: Path) -> None:
    """Copy a bag with the `mcap` package's own writer and its own settings."""
    with Reader(bag) as reader, path.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start(profile="ros1")
        channels = {}
        for connection in reader.connections:
            schema = writer.register_schema(
                connection.msgtype.replace("/msg/", "/"),
                "ros1msg",
                connection.msgdef.data.encode(),
            )
            channels[connection.id] = writer.register_channel(connection.topic, "ros1", schema)
        for connection, log_time, payload in reader.messages():
            writer.add_message(channels[connection.id], log_time, payload, log_time)
        writer.finish()  # type: ignore[no-untyped-call]


def _write(path: Path, types: Types, streams: list[_Stream], duration_s: float, seed: int) -> None:
    """Write a bag; it has its name only once it is whole, so it can be used again."""
    part = path.with_suffix(".part")
    part.unlink(missing_ok=True)
    writer = Writer(part)
    with writer:
        connections = [
            writer.add_connection(s.topic, s.msgtype, typestore=types.store) for s in streams
        ]
        for messages in _spans(streams, duration_s, seed):
            for log_time, number, payload in messages:
                writer.write(connections[number], log_time, payload)
    part.rename(path)


def _spans(
    streams: list[_Stream], duration_s: float, seed: int
) -> Iterator[list[tuple[int, int, bytes]]]:
    """Log time in ns, number of the stream, payload: in order, a second at a time."""
    random = [np.random.default_rng([seed, number]) for number in range(len(streams))]
    made = [0] * len(streams)
    for second in range(1, int(np.ceil(duration_s)) + 1):
        messages: list[tuple[int, int, bytes]] = []
        for number, stream in enumerate(streams):
            end = round(min(second, duration_s) * stream.hz)
            count = end - made[number]
            if count < 1:
                continue
            ticks = np.arange(made[number], end)
            stamp = START_NS + stream.phase_ns + np.rint(ticks * (1e9 / stream.hz)).astype(np.int64)
            rows = stream.template.rows(
                _with_stamps(stream, stamp, ticks, random[number], count), count
            )
            made[number] = end
            messages.extend(
                (log_time, number, row.tobytes())
                for log_time, row in zip((stamp + _DELAY_NS).tolist(), rows, strict=True)
            )
        messages.sort(key=lambda message: message[:2])
        yield messages


def _with_stamps(
    stream: _Stream,
    stamp: NDArray[np.int64],
    ticks: NDArray[np.int64],
    random: np.random.Generator,
    count: int,
) -> Columns:
    prefix = "transforms.0." if stream.msgtype.endswith("TFMessage") else ""
    return {
        f"{prefix}header.stamp": stamp,
        f"{prefix}header.seq": ticks,
        **stream.values(random, int(ticks[0]), count),
    }


def _turn(prefix: str, random: np.random.Generator, count: int) -> Columns:
    """Unit quaternions."""
    turn = random.standard_normal((count, 4))
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    return {f"{prefix}.{name}": turn[:, column] for column, name in enumerate("xyzw")}


def _vector(prefix: str, random: np.random.Generator, count: int) -> Columns:
    values = random.standard_normal((count, 3))
    return {f"{prefix}.{name}": values[:, column] for column, name in enumerate("xyz")}


def _pose(types: Types, hz: float) -> _Stream:
    msgtype = "geometry_msgs/msg/PoseStamped"
    template = types.template(msgtype, {"header": {"frame_id": "map"}})

    def values(random: np.random.Generator, _: int, count: int) -> Columns:
        return {
            **_vector("pose.position", random, count),
            **_turn("pose.orientation", random, count),
        }

    return _Stream("/pose", msgtype, hz, template, values)


def _imu(types: Types, hz: float) -> _Stream:
    msgtype = "sensor_msgs/msg/Imu"
    spread = [0.01, 0, 0, 0, 0.01, 0, 0, 0, 0.01]
    covariances = ("orientation", "angular_velocity", "linear_acceleration")
    template = types.template(
        msgtype,
        {
            "header": {"frame_id": "imu_link"},
            **{f"{name}_covariance": spread for name in covariances},
        },
    )

    def values(random: np.random.Generator, _: int, count: int) -> Columns:
        return {
            **_turn("orientation", random, count),
            **_vector("angular_velocity", random, count),
            **_vector("linear_acceleration", random, count),
        }

    return _Stream(IMU_TOPIC, msgtype, hz, template, values)


def _tf(types: Types, hz: float) -> _Stream:
    msgtype = "tf2_msgs/msg/TFMessage"
    one = {"header": {"frame_id": "odom"}, "child_frame_id": "base_link"}
    template = types.template(msgtype, {"transforms": [one]})

    def values(random: np.random.Generator, _: int, count: int) -> Columns:
        return {
            **_vector("transforms.0.transform.translation", random, count),
            **_turn("transforms.0.transform.rotation", random, count),
        }

    return _Stream("/tf", msgtype, hz, template, values)


def _joints(types: Types, hz: float) -> _Stream:
    msgtype = "sensor_msgs/msg/JointState"
    names = [f"arm_joint_{number}" for number in range(1, 8)]
    zeros = [0.0] * len(names)
    template = types.template(
        msgtype, {"name": names, "position": zeros, "velocity": zeros, "effort": zeros}
    )

    def values(random: np.random.Generator, _: int, count: int) -> Columns:
        fields = ("position", "velocity", "effort")
        return {name: random.standard_normal((count, len(names))) for name in fields}

    return _Stream("/joint_states", msgtype, hz, template, values)


def _camera(
    types: Types,
    topic: str,
    size: tuple[int, int],
    hz: float,
    frames: _Frames,
    *,
    phase_ns: int = 0,
) -> _Stream:
    msgtype = "sensor_msgs/msg/Image"
    width, height = size
    template = types.template(
        msgtype,
        {
            "header": {"frame_id": "camera"},
            "height": height,
            "width": width,
            "encoding": "mono8",
            "step": width,
            "data": np.zeros(width * height, np.uint8),
        },
    )

    def values(random: np.random.Generator, first: int, count: int) -> Columns:
        out = np.empty((count, height, width), np.uint8)
        frames(random, first, out)
        return {"data": out.reshape(count, -1)}

    return _Stream(topic, msgtype, hz, template, values, phase_ns)


def _half_noise(random: np.random.Generator, first: int, out: NDArray[np.uint8]) -> None:
    """The upper half cannot be compressed at all, the lower half is a smooth surface."""
    count, height, width = out.shape
    upper = height // 2
    out[:, :upper] = random.integers(0, 256, (count, upper, width), np.uint8)
    moment = (np.arange(first, first + count) % 256).astype(np.uint8)[:, None, None]
    np.add(_surface(height - upper, width), moment, out=out[:, upper:])


def _scene(random: np.random.Generator, first: int, out: NDArray[np.uint8]) -> None:
    """Smooth surfaces under the noise of a sensor, one grey level in the mean square.

    It is the noise that makes camera frames slow to compress and to unpack.
    """
    count, height, width = out.shape
    size = height * width
    noise = np.rint(random.standard_normal(size + (1 << 16))).astype(np.int8).view(np.uint8)
    surface = _surface(height, width) // 2 + 30
    shifts = cast("list[int]", random.integers(0, 1 << 16, count).tolist())
    for row, shift in enumerate(shifts):
        moved = np.roll(surface, first + row, axis=1)
        np.add(moved, noise[shift : shift + size].reshape(height, width), out=out[row])


def _surface(height: int, width: int) -> NDArray[np.uint8]:
    slope = np.arange(height)[:, None] // 4 + np.arange(width) // 4
    return (slope % 256).astype(np.uint8)


def _scan(types: Types) -> _Stream:
    msgtype = "sensor_msgs/msg/LaserScan"
    angles = np.linspace(-np.pi, np.pi, SCAN_BEAMS)
    template = types.template(
        msgtype,
        {
            "header": {"frame_id": "laser"},
            "angle_min": -np.pi,
            "angle_max": np.pi,
            "angle_increment": 2 * np.pi / SCAN_BEAMS,
            "scan_time": 1 / SCAN_HZ,
            "range_min": 0.1,
            "range_max": 30.0,
            "ranges": np.zeros(SCAN_BEAMS),
            "intensities": np.zeros(SCAN_BEAMS),
        },
    )

    def values(random: np.random.Generator, first: int, count: int) -> Columns:
        moment = (first + np.arange(count))[:, None] / SCAN_HZ
        noise = random.normal(0.0, 0.01, (count, SCAN_BEAMS))
        ranges = 5 + 3 * np.sin(3 * angles + moment / 5) + noise
        return {"ranges": ranges, "intensities": np.rint(4000 / ranges)}

    return _Stream(SCAN_TOPIC, msgtype, SCAN_HZ, template, values, phase_ns=3_000_000)
