"""The robot's topics: when each speaks, and what it says.

A stream turns a span of simulated time into serialised messages. Streams that share
a clock (odometry and transforms, an image and its camera info) speak at the same
moments, with the same header stamps.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from hybridlog.demo.camera import HEIGHT, Camera
from hybridlog.demo.plan import DEPTH, WIDTH
from hybridlog.demo.robot import (
    DIAGNOSTICS_PHASE_S,
    MOTOR_ERROR,
    MOTOR_WARN,
    TRACK,
    WHEEL_RADIUS,
)
from hybridlog.demo.sensors import Inertial, LaserScanner, Lidar, Odometer
from hybridlog.demo.wire import GRIPPER_COMMAND

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from hybridlog.demo.config import RobotConfig
    from hybridlog.demo.robot import Robot
    from hybridlog.demo.sensors import Odometry
    from hybridlog.demo.wire import Template, Types

    Floats = NDArray[np.float64]

MAP_RESOLUTION = 0.05
"""Metres of a cell of the map."""
NEAR_M = 0.5
"""A scan counts as near when its smallest range in metres is below this."""


@dataclass(frozen=True, slots=True)
class Ticks:
    """The moments at which a stream speaks in one span of time.

    Attributes:
        seconds: float64[n] since the start, rising.
        stamp: int64[n], the same in nanoseconds since the epoch.
        number: int64[n], counts the messages of the stream from 0.
        block: Number of the span.
        rng: Noise of this stream in this span.
    """

    seconds: Floats
    stamp: NDArray[np.int64]
    number: NDArray[np.int64]
    block: int
    rng: np.random.Generator

    def __len__(self) -> int:
        """Number of messages."""
        return len(self.seconds)


@dataclass(frozen=True, slots=True)
class Spoken:
    """Messages of one stream.

    Attributes:
        payloads: uint8[n, size] when all have one length, else a list of n.
        flags: bool[n] each: facts about the messages that can be asked for later.
    """

    payloads: NDArray[np.uint8] | Sequence[bytes]
    flags: Mapping[str, NDArray[np.bool_]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Stream:
    """One topic.

    Attributes:
        topic: Name.
        msgtype: Type as rosbags spells it.
        node: Who publishes it.
        speak: Makes the messages.
        hz: Rate; 0 for a stream that speaks at `moments`.
        phase: Seconds after which the first message comes.
        jitter: Deviation of the period, as a part of it.
        delay: Seconds from header stamp to log time: the least, and the mean of what
            comes on top.
        clock: Streams with the same name tick together.
        latched: Whether a late subscriber gets the last message.
        moments: Seconds since the start, rising, of a stream without a rate.
        size: Bytes of a message, about; bounds the span that is made at once.
    """

    topic: str
    msgtype: str
    node: str
    speak: Callable[[Ticks], Spoken]
    hz: float = 0.0
    phase: float = 0.0
    jitter: float = 0.01
    delay: tuple[float, float] = (0.001, 0.0003)
    clock: str = ""
    latched: bool = False
    moments: tuple[float, ...] = ()
    size: int = 400

    def ticks(self, start: float, end: float, block: int, robot: Robot) -> Ticks:
        """The moments in `[start, end)` seconds."""
        rng = _generator(robot.seed, self.clock or self.topic, block)
        if self.hz:
            first = max(0, int(np.ceil((start - self.phase) * self.hz - 1e-9)))
            last = max(first, int(np.ceil((end - self.phase) * self.hz - 1e-9)))
            number = np.arange(first, last)
            late = self.jitter * rng.random(len(number))
            seconds = self.phase + (number + late) / self.hz
        else:
            all_moments = np.array(self.moments, np.float64)
            number = np.flatnonzero((all_moments >= start) & (all_moments < end))
            seconds = all_moments[number]
        stamp = robot.start_ns + np.rint(seconds * 1e9).astype(np.int64)
        return Ticks(seconds, stamp, number, block, _generator(robot.seed, self.topic, block, 1))

    def transport(self, ticks: Ticks, seed: int) -> NDArray[np.int64]:
        """Nanoseconds from header stamp to log time of each message, int64[n]."""
        rng = _generator(seed, self.topic, ticks.block, 2)
        delay = self.delay[0] + self.delay[1] * rng.standard_exponential(len(ticks))
        return np.rint(delay * 1e9).astype(np.int64)


def _generator(seed: int, name: str, block: int, use: int = 0) -> np.random.Generator:
    return np.random.default_rng([seed, zlib.crc32(name.encode()), block, use])


def _header(frame: str) -> dict[str, object]:
    return {"frame_id": frame}


def _stamps(ticks: Ticks, prefix: str = "header") -> dict[str, NDArray[Any]]:
    return {f"{prefix}.stamp": ticks.stamp, f"{prefix}.seq": ticks.number}


def _yaw(heading: Floats, prefix: str) -> dict[str, NDArray[Any]]:
    return {f"{prefix}.z": np.sin(heading / 2), f"{prefix}.w": np.cos(heading / 2)}


def _diagonal(values: Sequence[float]) -> list[float]:
    return [float(v) for v in np.diag(values).ravel()]


class Speech:
    """All streams of a robot.

    Args:
        robot: The simulation.
        config: Sensors and rates.
        types: Message types of the ROS version to speak.
    """

    def __init__(self, robot: Robot, config: RobotConfig, types: Types) -> None:
        self._robot, self._config, self._types = robot, config, types
        self._odometer = Odometer(robot)

    def streams(self) -> list[Stream]:
        """Every topic, in the order in which the connections are written."""
        streams = [self._static_transforms(), self._map()]
        config = self._config
        if config.scan_hz:
            streams.append(self._scan())
        names = ("front", "rear", "left", "right")[: config.cameras]
        for name, yaw in zip(names, (0.0, np.pi, np.pi / 2, -np.pi / 2), strict=False):
            streams += self._camera(name, yaw)
        if config.cloud_hz:
            streams.append(self._cloud())
        if config.odom_hz:
            streams += [self._odometry(), self._transforms(), self._joints()]
        if config.imu_hz:
            streams.append(self._imu())
        if config.cmd_hz:
            streams.append(self._velocity())
        return [
            *streams,
            self._gripper(),
            self._arm(),
            self._viewpoint(),
            self._battery(),
            self._diagnostics(),
            self._text_log(),
        ]

    def _template(self, msgtype: str, **values: object) -> Template:
        return self._types.template(msgtype, values)

    def _scan(self) -> Stream:
        config, robot = self._config, self._robot
        laser = LaserScanner(config.scan_beams, config.scan_hz)
        msgtype = "sensor_msgs/msg/LaserScan"
        template = self._template(
            msgtype,
            header=_header("base_laser_link"),
            angle_min=laser.angle_min,
            angle_max=-laser.angle_min,
            angle_increment=laser.angle_increment,
            time_increment=laser.time_increment,
            scan_time=1 / laser.scan_hz,
            range_min=laser.range_min,
            range_max=laser.range_max,
            ranges=np.zeros(laser.beams),
            intensities=np.zeros(laser.beams),
        )

        def speak(ticks: Ticks) -> Spoken:
            ranges, intensities = laser.scan(robot, ticks.seconds, ticks.rng)
            columns = {**_stamps(ticks), "ranges": ranges, "intensities": intensities}
            near = ranges.min(axis=1) < NEAR_M
            return Spoken(template.rows(columns, len(ticks)), {"near_scans": near})

        sweep = laser.beams * laser.time_increment
        return Stream(
            "/base/scan",
            msgtype,
            "/hokuyo_node",
            speak,
            hz=config.scan_hz,
            phase=0.007,
            delay=(sweep + 0.004, 0.0008),
            size=template.size,
        )

    def _camera(self, name: str, yaw: float) -> list[Stream]:
        config, robot = self._config, self._robot
        colour = name == "front"
        hz = config.image_hz if colour else config.mono_hz
        if not hz:
            return []
        camera = Camera(config.image_size, yaw, 0.15 if colour else -0.15, colour=colour)
        header = _header(f"{name}_camera_optical_frame")
        image = self._template(
            "sensor_msgs/msg/Image",
            header=header,
            height=camera.height,
            width=camera.width,
            encoding="bgr8" if colour else "mono8",
            step=camera.width * camera.channels,
            data=np.zeros(camera.width * camera.height * camera.channels),
        )
        f, (cx, cy) = camera.focal, camera.center
        info = self._template(
            "sensor_msgs/msg/CameraInfo",
            header=header,
            height=camera.height,
            width=camera.width,
            distortion_model="plumb_bob",
            d=[0.0] * 5,
            k=[f, 0, cx, 0, f, cy, 0, 0, 1],
            r=[1, 0, 0, 0, 1, 0, 0, 0, 1],
            p=[f, 0, cx, 0, 0, f, cy, 0, 0, 0, 1, 0],
        )

        def draw(ticks: Ticks) -> Spoken:
            rows = image.rows(_stamps(ticks), len(ticks))
            camera.render(robot, ticks.seconds, image.view(rows, "data"), ticks.rng)
            return Spoken(rows)

        def describe(ticks: Ticks) -> Spoken:
            return Spoken(info.rows(_stamps(ticks), len(ticks)))

        clock, node = f"camera/{name}", f"/camera/{name}"
        phase = 0.013 if colour else 0.021
        streams = [
            Stream(
                f"/camera/{name}/image_raw",
                "sensor_msgs/msg/Image",
                node,
                draw,
                hz=hz,
                phase=phase,
                delay=(0.032, 0.003),
                clock=clock,
                size=image.size,
            )
        ]
        if colour:
            streams.append(
                Stream(
                    f"/camera/{name}/camera_info",
                    "sensor_msgs/msg/CameraInfo",
                    node,
                    describe,
                    hz=hz,
                    phase=phase,
                    delay=(0.03, 0.0005),
                    clock=clock,
                )
            )
        return streams

    def _cloud(self) -> Stream:
        lidar, robot = Lidar(self._config.cloud_columns), self._robot
        msgtype = "sensor_msgs/msg/PointCloud2"
        count, step = lidar.rings * lidar.columns, lidar.POINT.itemsize
        fields = [
            {"name": n, "offset": o, "datatype": 4 if n == "ring" else 7, "count": 1}
            for n, o in (("x", 0), ("y", 4), ("z", 8), ("intensity", 12), ("ring", 16))
        ]
        template = self._template(
            msgtype,
            header=_header("velodyne"),
            height=lidar.rings,
            width=lidar.columns,
            fields=fields,
            point_step=step,
            row_step=step * lidar.columns,
            data=np.zeros(count * step),
        )

        def speak(ticks: Ticks) -> Spoken:
            rows = template.rows(_stamps(ticks), len(ticks))
            data = template.view(rows, "data")
            for row, seconds in enumerate(ticks.seconds):
                data[row] = lidar.points(robot, float(seconds), ticks.rng).view(np.uint8)
            return Spoken(rows)

        return Stream(
            "/lidar/points",
            msgtype,
            "/velodyne_node",
            speak,
            hz=self._config.cloud_hz,
            phase=0.1,
            jitter=0.001,
            delay=(0.061, 0.004),
            size=template.size,
        )

    def _odometry(self) -> Stream:
        msgtype = "nav_msgs/msg/Odometry"
        template = self._template(
            msgtype,
            header=_header("odom"),
            child_frame_id="base_link",
            pose={"covariance": _diagonal([0.01, 0.01, 1e6, 1e6, 1e6, 0.03])},
            twist={"covariance": _diagonal([0.001, 1e-6, 1e6, 1e6, 1e6, 0.004])},
        )

        def speak(ticks: Ticks) -> Spoken:
            odometry = self._odometry_at(ticks)
            noise = ticks.rng.standard_normal((2, len(ticks)))
            columns = {
                **_stamps(ticks),
                "pose.pose.position.x": odometry.x,
                "pose.pose.position.y": odometry.y,
                **_yaw(odometry.heading, "pose.pose.orientation"),
                "twist.twist.linear.x": odometry.speed + 0.003 * noise[0],
                "twist.twist.angular.z": odometry.yaw_rate + 0.003 * noise[1],
            }
            return Spoken(template.rows(columns, len(ticks)))

        return Stream(
            "/odom",
            msgtype,
            "/base_controller",
            speak,
            hz=self._config.odom_hz,
            phase=0.002,
            delay=(0.0016, 0.0004),
            clock="base",
            size=template.size,
        )

    def _odometry_at(self, ticks: Ticks) -> Odometry:
        """The odometry of a span, made once for all streams of that clock."""
        rng = _generator(self._robot.seed, "odometer", ticks.block)
        return self._odometer.at(ticks.block, ticks.seconds, rng)

    def _transforms(self) -> Stream:
        robot = self._robot
        msgtype = "tf2_msgs/msg/TFMessage"
        template = self._template(
            msgtype,
            transforms=[
                {"header": _header("map"), "child_frame_id": "odom"},
                {"header": _header("odom"), "child_frame_id": "base_link"},
            ],
        )

        def speak(ticks: Ticks) -> Spoken:
            odometry, truth = self._odometry_at(ticks), robot.at(ticks.seconds)
            # map -> odom makes up for the drift: with odom -> base it gives the truth.
            turn = truth.heading - odometry.heading
            cos, sin = np.cos(turn), np.sin(turn)
            columns = {
                **_stamps(ticks, "transforms.0.header"),
                **_stamps(ticks, "transforms.1.header"),
                "transforms.0.transform.translation.x": truth.x
                - (cos * odometry.x - sin * odometry.y),
                "transforms.0.transform.translation.y": truth.y
                - (sin * odometry.x + cos * odometry.y),
                **_yaw(turn, "transforms.0.transform.rotation"),
                "transforms.1.transform.translation.x": odometry.x,
                "transforms.1.transform.translation.y": odometry.y,
                **_yaw(odometry.heading, "transforms.1.transform.rotation"),
            }
            return Spoken(template.rows(columns, len(ticks)))

        return Stream(
            "/tf",
            msgtype,
            "/robot_state_publisher",
            speak,
            hz=self._config.odom_hz,
            phase=0.002,
            delay=(0.0026, 0.0006),
            clock="base",
            size=template.size,
        )

    def _static_transforms(self) -> Stream:
        msgtype = "tf2_msgs/msg/TFMessage"
        frames = (
            ("base_laser_link", LaserScanner.offset, LaserScanner.height, (0.0, 0.0, 0.0, 1.0)),
            ("imu_link", 0.0, 0.25, (0.0, 0.0, 0.0, 1.0)),
            ("velodyne", 0.0, Lidar.height, (0.0, 0.0, 0.0, 1.0)),
            # Optical frames look along z, with x to the right and y down.
            ("front_camera_optical_frame", 0.15, HEIGHT, (-0.5, 0.5, -0.5, 0.5)),
            ("rear_camera_optical_frame", -0.15, HEIGHT, (-0.5, -0.5, 0.5, 0.5)),
        )
        template = self._template(
            msgtype,
            transforms=[
                {
                    "header": _header("base_link"),
                    "child_frame_id": frame,
                    "transform": {
                        "translation": {"x": x, "z": z},
                        "rotation": dict(zip("xyzw", turn, strict=True)),
                    },
                }
                for frame, x, z, turn in frames
            ],
        )

        def speak(ticks: Ticks) -> Spoken:
            stamps = {f"transforms.{k}.header.stamp": ticks.stamp for k in range(len(frames))}
            return Spoken(template.rows(stamps, len(ticks)))

        node = "/robot_state_publisher"
        return Stream("/tf_static", msgtype, node, speak, latched=True, moments=(0.0,))

    def _map(self) -> Stream:
        msgtype = "nav_msgs/msg/OccupancyGrid"
        grid = self._robot.plan.occupancy(MAP_RESOLUTION)
        template = self._template(
            msgtype,
            header=_header("map"),
            info={
                "resolution": MAP_RESOLUTION,
                "width": round(WIDTH / MAP_RESOLUTION),
                "height": round(DEPTH / MAP_RESOLUTION),
                "origin": {"orientation": {"w": 1.0}},
            },
            data=grid.ravel(),
        )

        def speak(ticks: Ticks) -> Spoken:
            columns = {**_stamps(ticks), "info.map_load_time": ticks.stamp}
            return Spoken(template.rows(columns, len(ticks)))

        return Stream("/map", msgtype, "/map_server", speak, latched=True, moments=(0.0,))

    def _joints(self) -> Stream:
        robot = self._robot
        msgtype = "sensor_msgs/msg/JointState"
        names = ["wheel_left_joint", "wheel_right_joint", "r_gripper_joint"]
        zeros = [0.0] * len(names)
        template = self._template(
            msgtype, header={}, name=names, position=zeros, velocity=zeros, effort=zeros
        )

        def speak(ticks: Ticks) -> Spoken:
            state = robot.at(ticks.seconds)
            turned = (state.heading - robot.lap.at(np.zeros(1)).heading[0]) * TRACK / 2
            fingers = robot.gripper_opening(ticks.seconds)
            closing = (robot.gripper_opening(ticks.seconds + 0.01) - fingers) / 0.01
            half = state.yaw_rate * TRACK / 2
            drive = 2.0 * state.acceleration + 0.8 * np.sign(state.speed)
            columns = {
                **_stamps(ticks),
                "position": np.stack(
                    (
                        (state.distance - turned) / WHEEL_RADIUS,
                        (state.distance + turned) / WHEEL_RADIUS,
                        fingers,
                    ),
                    axis=1,
                ),
                "velocity": np.stack(
                    (
                        (state.speed - half) / WHEEL_RADIUS,
                        (state.speed + half) / WHEEL_RADIUS,
                        closing,
                    ),
                    axis=1,
                ),
                "effort": np.stack((drive, drive, -20 * np.sign(closing)), axis=1)
                + 0.05 * ticks.rng.standard_normal((len(ticks), 3)),
            }
            return Spoken(template.rows(columns, len(ticks)))

        return Stream(
            "/joint_states",
            msgtype,
            "/base_controller",
            speak,
            hz=self._config.odom_hz,
            phase=0.009,
            delay=(0.0012, 0.0003),
            size=template.size,
        )

    def _imu(self) -> Stream:
        robot = self._robot
        msgtype = "sensor_msgs/msg/Imu"
        template = self._template(
            msgtype,
            header=_header("imu_link"),
            orientation_covariance=_diagonal([1e-4, 1e-4, 4e-4]),
            angular_velocity_covariance=_diagonal([Inertial.gyro_noise**2] * 3),
            linear_acceleration_covariance=_diagonal([Inertial.acceleration_noise**2] * 3),
        )

        def speak(ticks: Ticks) -> Spoken:
            state = robot.at(ticks.seconds)
            measured = Inertial.measure(state, ticks.rng)
            tilt = 0.001 * ticks.rng.standard_normal((2, len(ticks)))
            columns = {
                **_stamps(ticks),
                **_yaw(state.heading, "orientation"),
                "angular_velocity.x": tilt[0],
                "angular_velocity.y": tilt[1],
                "angular_velocity.z": measured.yaw_rate,
                "linear_acceleration.x": measured.forward,
                "linear_acceleration.y": measured.left,
                "linear_acceleration.z": measured.up,
            }
            return Spoken(template.rows(columns, len(ticks)))

        return Stream(
            "/imu/data",
            msgtype,
            "/imu_node",
            speak,
            hz=self._config.imu_hz,
            phase=0.001,
            delay=(0.0008, 0.0002),
            size=template.size,
        )

    def _velocity(self) -> Stream:
        robot = self._robot
        template = self._template("geometry_msgs/msg/Twist")

        def speak(ticks: Ticks) -> Spoken:
            # The base follows its commands after 50 ms.
            ahead = robot.at(ticks.seconds + 0.05)
            columns = {"linear.x": ahead.speed, "angular.z": ahead.yaw_rate}
            return Spoken(template.rows(columns, len(ticks)))

        return Stream(
            "/cmd_vel",
            "geometry_msgs/msg/Twist",
            "/move_base",
            speak,
            hz=self._config.cmd_hz,
            phase=0.004,
            delay=(0.0005, 0.0002),
        )

    def _gripper(self) -> Stream:
        commands = self._robot.gripper_commands
        position = np.array([c.position for c in commands], np.float64)
        effort = np.array([c.max_effort for c in commands], np.float64)
        template = self._template(GRIPPER_COMMAND)

        def speak(ticks: Ticks) -> Spoken:
            wanted = position[ticks.number]
            columns = {"position": wanted, "max_effort": effort[ticks.number]}
            rows = template.rows(columns, len(ticks))
            return Spoken(rows, {"gripper_closings": wanted == 0.0})

        return Stream(
            "/r_gripper_controller/command",
            GRIPPER_COMMAND,
            "/grasp_planner",
            speak,
            moments=tuple(c.seconds for c in commands),
        )

    def _arm(self) -> Stream:
        robot = self._robot
        msgtype = "geometry_msgs/msg/PoseStamped"
        template = self._template(
            msgtype, header=_header("base_link"), pose={"orientation": {"w": 1.0}}
        )
        moving = tuple(
            float(seconds)
            for start, stop in robot.stops
            if stop.kind in {"pick", "place"}
            for seconds in np.arange(start + 0.4, start + stop.end - stop.start - 0.3, 0.05)
            if seconds < robot.duration_s
        )

        def speak(ticks: Ticks) -> Spoken:
            # Out to the shelf and back.
            reach = np.sin(np.pi * np.nan_to_num(robot.arm_moves(ticks.seconds)))
            columns = {
                **_stamps(ticks),
                "pose.position.x": 0.42 + 0.08 * reach,
                "pose.position.y": -0.18 - 0.4 * reach,
                "pose.position.z": 0.62 + 0.35 * reach,
            }
            return Spoken(template.rows(columns, len(ticks)))

        topic, node = "/r_cart/command_pose", "/grasp_planner"
        return Stream(topic, msgtype, node, speak, moments=moving, delay=(0.002, 0.0005))

    def _viewpoint(self) -> Stream:
        robot = self._robot
        template = self._template("geometry_msgs/msg/Pose")

        def speak(ticks: Ticks) -> Spoken:
            state = robot.at(ticks.seconds)
            # An operator drags the view round the robot now and then, else it rests.
            bursts, clock = np.divmod(ticks.seconds, 7.0)
            part = np.clip((clock - 1.0) / 2.5, 0, 1)
            orbit = 0.9 * (bursts + part * part * (3 - 2 * part))
            away, down = 3.0, np.arctan2(1.6, 3.0) / 2
            yaw = orbit / 2 + np.pi / 2
            columns = {
                "position.x": state.x + away * np.cos(orbit),
                "position.y": state.y + away * np.sin(orbit),
                "position.z": np.full(len(ticks), 2.0),
                "orientation.x": -np.sin(yaw) * np.sin(down),
                "orientation.y": np.cos(yaw) * np.sin(down),
                "orientation.z": np.sin(yaw) * np.cos(down),
                "orientation.w": np.cos(yaw) * np.cos(down),
            }
            return Spoken(template.rows(columns, len(ticks)))

        return Stream(
            "/rviz_camera_publisher/camera_pose",
            "geometry_msgs/msg/Pose",
            "/rviz_camera_publisher",
            speak,
            hz=10.0,
            phase=0.05,
            delay=(0.006, 0.002),
        )

    def _battery(self) -> Stream:
        robot = self._robot
        msgtype = "sensor_msgs/msg/BatteryState"
        template = self._template(
            msgtype,
            header=_header("base_link"),
            temperature=float("nan"),
            capacity=40.0,
            design_capacity=42.0,
            power_supply_status=2,
            power_supply_health=1,
            power_supply_technology=2,
            present=1,
            cell_voltage=[0.0] * 7,
            location="base",
            serial_number=f"sim-{robot.seed:04d}",
        )
        full = 0.84 + 0.1 * float(_generator(robot.seed, "battery", 0).random())

        def speak(ticks: Ticks) -> Spoken:
            state = robot.at(ticks.seconds)
            # Electronics take 4.5 A all the time, driving 6 A more at a metre a second.
            used = (4.5 * ticks.seconds + 6.0 * state.distance) / 3600
            charge = np.maximum(40.0 * full - used, 0.0)
            current = 4.5 + 6.0 * state.speed
            voltage = 24.0 + 4.8 * charge / 40.0 - 0.04 * current
            columns = {
                **_stamps(ticks),
                "voltage": voltage,
                "current": -current,
                "charge": charge,
                "percentage": charge / 40.0,
                "cell_voltage": np.repeat(voltage[:, None] / 7, 7, axis=1),
            }
            return Spoken(template.rows(columns, len(ticks)))

        return Stream(
            "/battery",
            msgtype,
            "/power_board",
            speak,
            hz=1.0,
            phase=0.25,
            jitter=0.002,
            delay=(0.003, 0.001),
        )

    def _diagnostics(self) -> Stream:
        robot, types = self._robot, self._types
        msgtype = "diagnostic_msgs/msg/DiagnosticArray"

        def status(level: int, name: str, message: str, **values: str) -> dict[str, object]:
            return {
                "level": level,
                "name": name,
                "message": message,
                "hardware_id": "sim",
                "values": [{"key": k, "value": v} for k, v in values.items()],
            }

        def speak(ticks: Ticks) -> Spoken:
            temperature = robot.motor_temperature(ticks.seconds)
            payloads = []
            for stamp, number, degrees in zip(ticks.stamp, ticks.number, temperature, strict=True):
                level, text = 0, "OK"
                if degrees >= MOTOR_WARN:
                    level, text = 1, "motor temperature high"
                if degrees >= MOTOR_ERROR:
                    level, text = 2, "motor over-temperature"
                message = {
                    "header": {"stamp": int(stamp), "seq": int(number)},
                    "status": [
                        status(level, "drive motors", text, temperature=f"{degrees:.1f}"),
                        status(0, "laser", "OK", frequency=f"{self._config.scan_hz:g}"),
                        status(0, "computer", "OK", load="0.41"),
                    ],
                }
                payloads.append(types.encode(msgtype, message))
            return Spoken(payloads, {"errors": temperature >= MOTOR_ERROR})

        return Stream(
            "/diagnostics",
            msgtype,
            "/diagnostic_aggregator",
            speak,
            hz=1.0,
            phase=DIAGNOSTICS_PHASE_S,
            jitter=0.0,
            delay=(0.002, 0.0005),
        )

    def _text_log(self) -> Stream:
        robot, types = self._robot, self._types
        levels = {"info": 2, "warn": 4, "error": 8}
        if types.ros == 2:
            levels = {"info": 20, "warn": 30, "error": 40}

        def speak(ticks: Ticks) -> Spoken:
            payloads = []
            for stamp, number in zip(ticks.stamp, ticks.number, strict=True):
                remark = robot.remarks[int(number)]
                message = {
                    "header": {"stamp": int(stamp), "seq": int(number)},
                    "stamp": int(stamp),
                    "level": levels[remark.severity],
                    "name": remark.node,
                    "msg": remark.text,
                    "file": "robot.cpp",
                    "function": "spin",
                    "line": 100 + len(remark.text),
                    "topics": ["/rosout", "/cmd_vel"],
                }
                payloads.append(types.encode(types.log_type, message))
            return Spoken(payloads)

        moments = tuple(remark.seconds for remark in robot.remarks)
        return Stream("/rosout", types.log_type, "/rosout", speak, moments=moments)
