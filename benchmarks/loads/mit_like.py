"""A load like the recordings of a PR2 that drives through a building: many bytes.

Topics, types and rates are those of the published recordings and of the robot's own
launch files; `docs/benchmarks-loads.md` has the sources. What the sensors see is the
building of hybridlog's own simulator, with the noise and the jitter of real drivers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.loads import pr2
from benchmarks.loads.eyes import (
    BASELINE,
    IMAGE_SIZE,
    BaseLaser,
    DepthCamera,
    StereoCamera,
    TiltLaser,
)
from benchmarks.loads.simulation.robot import MAX_DURATION_S, Robot
from benchmarks.loads.simulation.sensors import Inertial, Odometer
from benchmarks.loads.spool import Spool
from benchmarks.loads.timing import received, steady
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from benchmarks.loads.base import Load
    from benchmarks.loads.simulation.camera import Camera
    from benchmarks.loads.simulation.wire import Template

    Floats = NDArray[np.float64]
    Times = NDArray[np.int64]
    Columns = dict[str, NDArray[Any]]

BASE_SCAN = "/base_scan"
TILT_SCAN = "/tilt_scan"
IMU = "/torso_lift_imu/data"
ODOMETRY = "/base_odometry/odom"
POSE = "/robot_pose_ekf/odom_combined"
JOINT_STATES = "/joint_states"
TF = "/tf"
STEREO = "/wide_stereo/{}/{}"
KINECT_IMAGE = "/camera/rgb/image_raw"
KINECT_DEPTH = "/camera/depth/image_raw"

START_NS = 1_327_493_665_000_000_000  # 2012-01-25 12:14:25 UTC
BASE_SCAN_HZ, BASE_BEAMS = 40.0, 1040
TILT_SCAN_HZ, TILT_BEAMS = 20.0, 380
IMU_HZ = 100.0
ODOMETRY_HZ = 100.0
STEREO_HZ = 25.0
KINECT_HZ = 15.0

_SPAN_S = 0.5
"""Seconds of log time that are made at once."""


@dataclass(frozen=True, slots=True)
class _Stream:
    """One publisher.

    Attributes:
        topic: Name.
        msgtype: As rosbags spells it.
        node: Who publishes it.
        hz: Rate.
        template: A message of it.
        values: Makes the columns of some messages, from their seconds since the start,
            their header stamps (ns since the epoch) and a generator.
        phase: Seconds after the start of the first message.
        delay: Seconds from header stamp to log time: the least, and the mean on top.
        clock: Streams with the same clock have the same stamps.
    """

    topic: str
    msgtype: str
    node: str
    hz: float
    template: Template
    values: Callable[[Floats, Times, np.random.Generator], Columns]
    phase: float
    delay: tuple[float, float]
    clock: str = ""


def mit_like(
    directory: Path,
    *,
    seconds: float,
    seed: int,
    kinect: bool = False,
    name: str = "mit_like",
) -> Load:
    """Make a load of one drive.

    Args:
        directory: Where it goes; what lies there is replaced.
        seconds: Length of the drive, above 0, up to a week. A second has 16 MB, 30 MB
            with the Kinect.
        seed: Not negative. Gives the furniture, the speed and the noise.
        kinect: With colour and depth images, as the later recordings have.
        name: Of the load.

    Raises:
        UsageError: An argument is out of its range, or the directory cannot be written.
    """
    if not 0 < seconds <= MAX_DURATION_S or seed < 0:
        raise UsageError(
            f"no drive of {seconds:g} s from seed {seed}; choose more than 0 s, up to "
            f"{MAX_DURATION_S:.0f} s, and a seed that is not negative"
        )
    types = pr2.Pr2Types()
    streams = _Drive(types, Robot(seconds, seed), kinect=kinect).streams()
    topics: dict[str, _Stream] = {}
    for stream in streams:
        topics.setdefault(stream.topic, stream)
    number = {topic: place for place, topic in enumerate(topics)}
    schedules = _schedules(streams, seconds, seed)
    with Spool(directory) as spool:
        for span in range(int(np.ceil(seconds / _SPAN_S))):
            edges = round(span * _SPAN_S * 1e9), round((span + 1) * _SPAN_S * 1e9)
            for place, (stream, (stamps, times)) in enumerate(zip(streams, schedules, strict=True)):
                first, last = (int(row) for row in np.searchsorted(stamps, edges))
                if first == last:
                    continue
                rng = pr2.generator(seed, place, "values", span)
                here = stamps[first:last]
                columns = stream.values(here / 1e9, START_NS + here, rng)
                if stream.topic != TF:  # each transform has a header of its own
                    columns |= pr2.stamped(START_NS + here)
                for path in columns:
                    if path.endswith("header.seq"):
                        columns[path] = columns[path] + first
                log_time = START_NS + times[first:last]
                spool.template(number[stream.topic], stream.template, columns, log_time)
        channels = [types.channel(t.topic, t.msgtype, t.node) for t in topics.values()]
        return spool.finish(name, seed, channels, seconds)


def _schedules(streams: list[_Stream], seconds: float, seed: int) -> list[tuple[Times, Times]]:
    """Header stamps and log times of each stream, ns since the start."""
    found = []
    for place, stream in enumerate(streams):
        clock = pr2.generator(seed, "clock", stream.clock or str(place))
        stamps = steady(clock, stream.hz, seconds, phase=stream.phase)
        transport = pr2.generator(seed, "transport", place)
        found.append((stamps, received(transport, stamps, *stream.delay)))
    first, second = (place for place, stream in enumerate(streams) if stream.topic == TF)
    links, pose = pr2.of_two_sources(found[first][1], found[second][1])
    found[first], found[second] = (found[first][0], links), (found[second][0], pose)
    return found


class _Drive:
    """The publishers of a robot that drives.

    Args:
        types: Message types.
        robot: Where it is and what is round it.
        kinect: With a colour and depth camera.
    """

    def __init__(self, types: pr2.Pr2Types, robot: Robot, *, kinect: bool) -> None:
        self._types = types
        self._robot = robot
        self._kinect = kinect

    def streams(self) -> list[_Stream]:
        """All of them; two speak on /tf."""
        return [
            self._base_scan(),
            self._tilt_scan(),
            self._imu(),
            self._odometry(),
            self._pose(),
            self._joints(),
            self._links(),
            self._base(),
            *self._stereo("left", BASELINE / 2),
            *self._stereo("right", -BASELINE / 2),
            *(self._colour_and_depth() if self._kinect else ()),
        ]

    def _stream(
        self,
        topic: str,
        msgtype: str,
        message: dict[str, object],
        values: Callable[[Floats, Times, np.random.Generator], Columns],
        *,
        node: str,
        hz: float,
        phase: float,
        delay: tuple[float, float],
        clock: str = "",
    ) -> _Stream:
        template = self._types.template(msgtype, message)
        return _Stream(topic, msgtype, node, hz, template, values, phase, delay, clock)

    def _base_scan(self) -> _Stream:
        laser = BaseLaser(BASE_BEAMS, BASE_SCAN_HZ)

        def values(seconds: Floats, _: Times, rng: np.random.Generator) -> Columns:
            # The launch file asks this scanner for ranges only.
            return {"ranges": laser.scan(self._robot, seconds, rng)[0]}

        message = _scan("base_laser_link", laser, laser.beams, BASE_SCAN_HZ)
        return self._stream(
            BASE_SCAN,
            "sensor_msgs/msg/LaserScan",
            message,
            values,
            node="/base_hokuyo_node",
            hz=BASE_SCAN_HZ,
            phase=0.004,
            delay=(0.019, 0.0008),
        )

    def _tilt_scan(self) -> _Stream:
        laser = TiltLaser(TILT_BEAMS)

        def values(seconds: Floats, _: Times, rng: np.random.Generator) -> Columns:
            ranges, light = laser.scan(self._robot, seconds, pr2.tilt(seconds), rng)
            return {"ranges": ranges, "intensities": light}

        message = _scan("laser_tilt_link", laser, laser.beams, TILT_SCAN_HZ)
        message["intensities"] = np.zeros(laser.beams)
        return self._stream(
            TILT_SCAN,
            "sensor_msgs/msg/LaserScan",
            message,
            values,
            node="/tilt_hokuyo_node",
            hz=TILT_SCAN_HZ,
            phase=0.011,
            delay=(0.008, 0.0008),
        )

    def _imu(self) -> _Stream:
        def values(seconds: Floats, _: Times, rng: np.random.Generator) -> Columns:
            state = self._robot.at(seconds)
            felt = Inertial.measure(state, rng)
            noise = rng.standard_normal((4, len(seconds)))
            return {
                "orientation.x": 0.002 * noise[0],
                "orientation.y": 0.002 * noise[1],
                "orientation.z": np.sin(state.heading / 2),
                "orientation.w": np.cos(state.heading / 2),
                "angular_velocity.x": Inertial.gyro_noise * noise[2],
                "angular_velocity.y": Inertial.gyro_noise * noise[3],
                "angular_velocity.z": felt.yaw_rate,
                "linear_acceleration.x": felt.forward,
                "linear_acceleration.y": felt.left,
                "linear_acceleration.z": felt.up,
            }

        message: dict[str, object] = {
            "header": {"frame_id": "imu_link"},
            "orientation_covariance": _diagonal([2.89e-08] * 3),
            "angular_velocity_covariance": _diagonal([1.0966e-04] * 3),
            "linear_acceleration_covariance": _diagonal([9.2e-03] * 3),
        }
        return self._stream(
            IMU,
            "sensor_msgs/msg/Imu",
            message,
            values,
            node="/imu_node",
            hz=IMU_HZ,
            phase=0.002,
            delay=(0.0012, 0.0006),
        )

    def _odometry(self) -> _Stream:
        odometer = Odometer(self._robot)

        def values(seconds: Floats, stamps: Times, rng: np.random.Generator) -> Columns:
            seen = odometer.at(int(stamps[0]), seconds, rng)
            return {
                "pose.pose.position.x": seen.x,
                "pose.pose.position.y": seen.y,
                "pose.pose.orientation.z": np.sin(seen.heading / 2),
                "pose.pose.orientation.w": np.cos(seen.heading / 2),
                "twist.twist.linear.x": seen.speed,
                "twist.twist.angular.z": seen.yaw_rate,
            }

        spread = _diagonal([4e-6, 4e-6, 1e6, 1e6, 1e6, 2.89e-4])
        message: dict[str, object] = {
            "header": {"frame_id": "odom"},
            "child_frame_id": "base_footprint",
            "pose": {"covariance": spread},
            "twist": {"covariance": spread},
        }
        return self._stream(
            ODOMETRY,
            "nav_msgs/msg/Odometry",
            message,
            values,
            node="/realtime_loop",
            hz=ODOMETRY_HZ,
            phase=0.001,
            delay=(0.0006, 0.0003),
        )

    def _pose(self) -> _Stream:
        def values(seconds: Floats, _: Times, rng: np.random.Generator) -> Columns:
            state = self._robot.at(seconds)
            x, y = 0.005 * rng.standard_normal((2, len(seconds)))
            return {
                "pose.pose.position.x": state.x + x,
                "pose.pose.position.y": state.y + y,
                "pose.pose.orientation.z": np.sin(state.heading / 2),
                "pose.pose.orientation.w": np.cos(state.heading / 2),
            }

        message: dict[str, object] = {
            "header": {"frame_id": "odom_combined"},
            "pose": {"covariance": _diagonal([2.5e-5, 2.5e-5, 1e-6, 1e-6, 1e-6, 1e-4])},
        }
        return self._stream(
            POSE,
            "geometry_msgs/msg/PoseWithCovarianceStamped",
            message,
            values,
            node="/robot_pose_ekf",
            hz=pr2.POSE_TF_HZ,
            phase=0.017,
            delay=(0.0015, 0.0005),
            clock="ekf",
        )

    def _joints(self) -> _Stream:
        def values(seconds: Floats, _: Times, rng: np.random.Generator) -> Columns:
            driven = self._robot.at(seconds).distance
            return pr2.joint_columns(rng, seconds, driven, pr2.tilt(seconds))

        return _Stream(
            JOINT_STATES,
            "sensor_msgs/msg/JointState",
            "/realtime_loop",
            pr2.JOINTS_HZ,
            pr2.joint_template(self._types),
            values,
            phase=0.003,
            delay=(0.0006, 0.0003),
        )

    def _links(self) -> _Stream:
        def values(seconds: Floats, stamps: Times, rng: np.random.Generator) -> Columns:
            wheels = self._robot.at(seconds).distance / pr2.WHEEL_RADIUS
            return pr2.links_columns(rng, stamps, [wheels] * 12 + [np.zeros(len(seconds))])

        template = pr2.links_template(self._types)
        hz, delay = pr2.STATE_TF_HZ, (0.0009, 0.0003)
        node = "/robot_state_publisher"
        return _Stream(TF, pr2.TF_TYPE, node, hz, template, values, 0.005, delay)

    def _base(self) -> _Stream:
        def values(seconds: Floats, stamps: Times, _: np.random.Generator) -> Columns:
            state = self._robot.at(seconds)
            return pr2.pose_columns(stamps, state.x, state.y, state.heading)

        template = pr2.pose_template(self._types)
        hz, delay = pr2.POSE_TF_HZ, (0.0015, 0.0005)
        return _Stream(
            TF, pr2.TF_TYPE, "/robot_pose_ekf", hz, template, values, 0.017, delay, "ekf"
        )

    def _stereo(self, side: str, left: float) -> list[_Stream]:
        eye = StereoCamera()
        frame, node = "wide_stereo_optical_frame", f"/wide_stereo_{side}"

        def image(seconds: Floats, _: Times, rng: np.random.Generator) -> Columns:
            out = _pictures(len(seconds), 1)
            eye.render(self._robot, seconds, left, out, rng)
            return {"data": out}

        shift = 0.0 if side == "left" else -eye.camera.focal * BASELINE
        return [
            self._stream(
                STEREO.format(side, "image_rect"),
                "sensor_msgs/msg/Image",
                _image(frame, "mono8", 1),
                image,
                node=node,
                hz=STEREO_HZ,
                phase=0.013,
                delay=(0.027, 0.0015),
                clock="stereo",
            ),
            self._stream(
                STEREO.format(side, "camera_info"),
                "sensor_msgs/msg/CameraInfo",
                _camera_info(frame, eye.camera, shift),
                _nothing,
                node=node,
                hz=STEREO_HZ,
                phase=0.013,
                delay=(0.025, 0.0008),
                clock="stereo",
            ),
        ]

    def _colour_and_depth(self) -> list[_Stream]:
        eye, depth = StereoCamera(), DepthCamera()

        def image(seconds: Floats, _: Times, rng: np.random.Generator) -> Columns:
            out = _pictures(len(seconds), 1)
            eye.render(self._robot, seconds, 0.0, out, rng)
            return {"data": out}

        def distances(seconds: Floats, _: Times, rng: np.random.Generator) -> Columns:
            out = _pictures(len(seconds), 2)
            depth.render(self._robot, seconds, out, rng)
            return {"data": out}

        node = "/camera/driver"
        # The scene is grey, so it is the same behind the colour filter of the sensor.
        return [
            self._stream(
                KINECT_IMAGE,
                "sensor_msgs/msg/Image",
                _image("camera_rgb_optical_frame", "bayer_grbg8", 1),
                image,
                node=node,
                hz=KINECT_HZ,
                phase=0.031,
                delay=(0.035, 0.003),
            ),
            self._stream(
                KINECT_DEPTH,
                "sensor_msgs/msg/Image",
                _image("camera_depth_optical_frame", "16UC1", 2),
                distances,
                node=node,
                hz=KINECT_HZ,
                phase=0.047,
                delay=(0.04, 0.003),
            ),
        ]


def _nothing(_seconds: Floats, _stamps: Times, _rng: np.random.Generator) -> Columns:
    """The values of messages of which only the header changes."""
    return {}


def _pictures(count: int, depth: int) -> NDArray[np.uint8]:
    """Room for images of so many bytes a pixel."""
    width, height = IMAGE_SIZE
    return np.empty((count, width * height * depth), np.uint8)


def _diagonal(values: list[float]) -> list[float]:
    return [float(value) for value in np.diag(values).ravel()]


def _scan(frame: str, laser: BaseLaser | TiltLaser, beams: int, hz: float) -> dict[str, object]:
    return {
        "header": {"frame_id": frame},
        "angle_min": laser.angle_min,
        "angle_max": -laser.angle_min,
        "angle_increment": laser.angle_increment,
        "time_increment": laser.time_increment,
        "scan_time": 1 / hz,
        "range_min": laser.range_min,
        "range_max": laser.range_max,
        "ranges": np.zeros(beams),
    }


def _image(frame: str, encoding: str, depth: int) -> dict[str, object]:
    width, height = IMAGE_SIZE
    return {
        "header": {"frame_id": frame},
        "height": height,
        "width": width,
        "encoding": encoding,
        "step": width * depth,
        "data": np.zeros(width * height * depth),
    }


def _camera_info(frame: str, camera: Camera, shift: float) -> dict[str, object]:
    width, height = IMAGE_SIZE
    f, (cx, cy) = camera.focal, camera.center
    return {
        "header": {"frame_id": frame},
        "height": height,
        "width": width,
        "distortion_model": "plumb_bob",
        "d": [0.0] * 5,
        "k": [f, 0, cx, 0, f, cy, 0, 0, 1],
        "r": [1, 0, 0, 0, 1, 0, 0, 0, 1],
        "p": [f, 0, cx, shift, 0, f, cy, 0, 0, 0, 1, 0],
    }
