"""The logs of the speed and micro benchmarks: ROS 1 bags and MCAP files, made from a seed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Reader, Writer

from benchmarks.loads import made
from benchmarks.loads.made import Moments, Topic, Values, diagonal, fixed, transforms, vector

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from hybridlog.demo.topics import Types

START_NS = 1_700_000_000 * 1_000_000_000
IMAGE_SIDE = 800
"""Pixels; 800 by 800 `mono8` are 640 000 bytes."""
CAMERA = (480, 640)
"""Height and width in pixels of the cameras of the drive, `mono8`."""
CAMERA_HZ, SCAN_HZ, SCAN_BEAMS = 15.0, 20.0, 720
SCAN_TOPIC, IMU_TOPIC = "/scan", "/imu/data"
_DELAY_NS = 1_000_000
_NO_DELAY = (0.0, 0.0)


def write_small(path: Path, messages: int, seed: int) -> None:
    """Poses, IMU, transforms and joint states, a quarter each, at 100 Hz each."""
    _write(path, [_topic(kind, 100.0) for kind in _SMALL], messages / 400, seed)


def write_imu(path: Path, messages: int, seed: int) -> None:
    """Nothing but IMU messages, at 200 Hz."""
    _write(path, [_topic(IMU_TOPIC, 200.0)], messages / 200, seed)


def write_images(path: Path, messages: int, seed: int) -> None:
    """Images of 640 kB at 10 Hz: one half of each is noise, the other a smooth surface."""
    shape = (IMAGE_SIDE, IMAGE_SIDE)
    _write(path, [_camera("/camera/image_raw", shape, 10.0, _half_noise)], messages / 10, seed)


def write_drive(path: Path, duration_s: float, seed: int) -> None:
    """Two cameras and a laser scanner."""
    topics = [
        _camera("/camera/left/image_raw", CAMERA, CAMERA_HZ, _scene),
        _camera("/camera/right/image_raw", CAMERA, CAMERA_HZ, _scene, 0.007),
        Topic(
            *(SCAN_TOPIC, "sensor_msgs/msg/LaserScan", "", SCAN_HZ, 0.003, _NO_DELAY),
            fixed(
                header__frame_id="laser",
                angle_min=-np.pi,
                angle_max=np.pi,
                angle_increment=2 * np.pi / SCAN_BEAMS,
                scan_time=1 / SCAN_HZ,
                range_min=0.1,
                range_max=30.0,
            ),
            _scan,
        ),
    ]
    _write(path, topics, duration_s, seed)


def bag_to_mcap(bag: Path, path: Path) -> None:
    """Copy a bag with the `mcap` package's own writer and its own settings."""
    with Reader(bag) as reader, path.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start(profile="ros1")
        channels = {}
        for connection in reader.connections:
            name = connection.msgtype.replace("/msg/", "/")
            schema = writer.register_schema(name, "ros1msg", connection.msgdef.data.encode())
            channels[connection.id] = writer.register_channel(connection.topic, "ros1", schema)
        for connection, log_time, payload in reader.messages():
            writer.add_message(channels[connection.id], log_time, payload, log_time)
        writer.finish()  # type: ignore[no-untyped-call]


def _write(path: Path, topics: Sequence[Topic], duration_s: float, seed: int) -> None:
    """Write a bag, a second of log time at a time."""
    types = made.OldTypes()
    random = [np.random.default_rng([seed, number]) for number in range(len(topics))]
    values = [topic.values(types) for topic in topics]
    done = [0] * len(topics)
    with Writer(path) as writer:
        connections = [
            writer.add_connection(t.name, t.msgtype, typestore=types.store) for t in topics
        ]
        for second in range(1, int(np.ceil(duration_s)) + 1):
            messages: list[tuple[int, int, bytes]] = []
            for number, topic in enumerate(topics):
                end = round(min(second, duration_s) * topic.hz)
                ticks, done[number] = np.arange(done[number], end), end
                if not len(ticks):
                    continue
                seconds = topic.phase + ticks / topic.hz
                stamps = START_NS + np.rint(seconds * 1e9).astype(np.int64)
                columns = topic.columns(Moments(seconds, stamps, random[number]))
                prefix = "transforms.0." if "transforms" in values[number] else ""
                columns |= {f"{prefix}header.stamp": stamps, f"{prefix}header.seq": ticks}
                payloads = made.payloads(types, topic.msgtype, values[number], columns)
                log_times = (stamps + _DELAY_NS).tolist()
                messages += zip(log_times, [number] * len(ticks), payloads, strict=True)
            messages.sort(key=lambda message: message[:2])
            for log_time, number, payload in messages:
                writer.write(connections[number], log_time, payload)


def _turn(path: str, moments: Moments) -> Values:
    """Unit quaternions."""
    turn = moments.rng.standard_normal((4, len(moments.seconds)))
    turn /= np.linalg.norm(turn, axis=0)
    return {f"{path}.{axis}": column for axis, column in zip("xyzw", turn, strict=True)}


def _vector(path: str, moments: Moments) -> Values:
    return vector(path, moments.rng, len(moments.seconds))


def _imu(moments: Moments) -> Values:
    columns = _turn("orientation", moments) | _vector("angular_velocity", moments)
    return columns | _vector("linear_acceleration", moments)


def _link(moments: Moments) -> Values:
    path = "transforms.0.transform"
    return _vector(f"{path}.translation", moments) | _turn(f"{path}.rotation", moments)


def _joints(moments: Moments) -> Values:
    shape = (len(moments.seconds), 7)
    names = ("position", "velocity", "effort")
    return {name: moments.rng.standard_normal(shape) for name in names}


_COVARIANCES = ("orientation", "angular_velocity", "linear_acceleration")
_SMALL: dict[str, tuple[str, Callable[[Types], Values], Callable[[Moments], Values]]] = {
    "/pose": (
        "geometry_msgs/msg/PoseStamped",
        fixed(header__frame_id="map"),
        lambda m: _vector("pose.position", m) | _turn("pose.orientation", m),
    ),
    IMU_TOPIC: (
        "sensor_msgs/msg/Imu",
        fixed(
            header__frame_id="imu_link",
            **{f"{name}_covariance": diagonal(1e-4, 1e-4, 4e-4) for name in _COVARIANCES},
        ),
        _imu,
    ),
    "/tf": ("tf/msg/tfMessage", transforms(("odom", "base_link")), _link),
    "/joint_states": (
        "sensor_msgs/msg/JointState",
        fixed(name=[f"arm_joint_{number}" for number in range(1, 8)]),
        _joints,
    ),
}


def _topic(name: str, hz: float) -> Topic:
    msgtype, values, columns = _SMALL[name]
    return Topic(name, msgtype, "", hz, 0.0, _NO_DELAY, values, columns)


def _camera(
    name: str,
    shape: tuple[int, int],
    hz: float,
    frames: Callable[[np.random.Generator, int, tuple[int, int, int]], NDArray[np.uint8]],
    phase: float = 0.0,
) -> Topic:
    height, width = shape

    def columns(moments: Moments) -> Values:
        first = round(moments.seconds[0] * hz)
        drawn = frames(moments.rng, first, (len(moments.seconds), height, width))
        return {"data": drawn.reshape(len(drawn), -1)}

    about: dict[str, Any] = {"height": height, "width": width, "encoding": "mono8", "step": width}
    values = fixed(header__frame_id="camera", **about)
    return Topic(name, "sensor_msgs/msg/Image", "", hz, phase, _NO_DELAY, values, columns)


_scene = made.scene


def _half_noise(
    rng: np.random.Generator, first: int, shape: tuple[int, int, int]
) -> NDArray[np.uint8]:
    """The upper half cannot be compressed at all, the lower half is a smooth surface."""
    count, height, width = shape
    upper = height // 2
    frames = np.empty(shape, np.uint8)
    frames[:, :upper] = rng.integers(0, 256, (count, upper, width), np.uint8)
    moment = (np.arange(first, first + count) % 256).astype(np.uint8)[:, None, None]
    np.add(made.smooth(height - upper, width), moment, out=frames[:, upper:])
    return frames


def _scan(moments: Moments) -> Values:
    angles = np.linspace(-np.pi, np.pi, SCAN_BEAMS)
    noise = moments.rng.normal(0.0, 0.01, (len(moments.seconds), SCAN_BEAMS))
    ranges = 5 + 3 * np.sin(3 * angles + moments.seconds[:, None] / 5) + noise
    intensities = np.rint(4000 / ranges)
    return {"ranges": ranges.astype(np.float32), "intensities": intensities.astype(np.float32)}
