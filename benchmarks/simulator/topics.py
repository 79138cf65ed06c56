"""The robot's topics: their types, rates and delays, and the messages that fill them."""

from __future__ import annotations

import io
import zlib
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from benchmarks.simulator import sensors
from benchmarks.simulator.plan import DEPTH, WIDTH
from benchmarks.simulator.robot import MOTOR_ERROR, MOTOR_WARN

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from benchmarks.simulator.robot import Robot, State

    Floats = NDArray[np.float64]

Values = dict[str, Any]
_GRIPPER = """\
# Wanted opening of the gripper
float64 position    # metres between the fingers, 0.0 is closed
float64 max_effort  # newtons, negative for no limit
"""
_MAP_RESOLUTION, _TRACK, _WHEEL_RADIUS = 0.05, 0.42, 0.1


class RobotConfig(NamedTuple):
    """Sizes of the large messages: image width and height, beams, directions of the lidar.

    With a `jpeg` quality, images are compressed; an `intensity_step` rounds those of scans.
    """

    image_size: tuple[int, int] = (320, 240)
    scan_beams: int = 720
    cloud_columns: int = 1250
    jpeg: int | None = None
    intensity_step: float | None = None


DEMO = RobotConfig(cloud_columns=100, jpeg=75, intensity_step=50.0)
"""Small enough for the package."""


class Types:
    """Message types of ROS 1."""

    def __init__(self) -> None:
        self.store = get_typestore(Stores.ROS1_NOETIC)
        command = "pr2_controllers_msgs/msg/Pr2GripperCommand"
        self.store.register(get_types_from_msg(_GRIPPER, command))
        transforms = "geometry_msgs/TransformStamped[] transforms\n"
        self.store.register(get_types_from_msg(transforms, "tf2_msgs/msg/TFMessage"))

    def encode(self, message: object, msgtype: str) -> bytes:
        """A message as bytes."""
        return bytes(self.store.serialize_ros1(message, msgtype))

    def make(self, msgtype: str, values: Values) -> Any:
        """A message with values by path; the other fields are zero or empty."""
        fields = self.store.fielddefs[msgtype][1]
        empty = {name: self._empty(int(kind), detail) for name, (kind, detail) in fields}
        message = self.store.types[msgtype](**empty)
        for path, value in values.items():
            place, name = _find(message, path)
            setattr(place, name, value)
        return message

    def _empty(self, kind: int, detail: Any) -> Any:
        if kind == 1:  # A number or a string.
            return "" if detail[0] == "string" else 0
        if kind == 2:  # A message.
            return self.make(detail, {})
        (inner, (base, *_)), length = detail
        is_list = int(inner) == 2 or base == "string"
        return [] if is_list else np.zeros(length, {"bool": "u1", "octet": "u1"}.get(base, base))

    def filled(self, message: Any, columns: Values, count: int) -> Iterator[Any]:
        """One message object, yielded for each row of columns with the row's values by path."""
        places = []
        for path, column in columns.items():
            is_time = path.endswith("stamp") and isinstance(column, np.ndarray)
            places.append((*_find(message, path), self.times(column) if is_time else column))
        for row in range(count):
            for place, name, column in places:
                setattr(place, name, column[row])
            yield message

    def times(self, nanoseconds: NDArray[np.int64]) -> list[Any]:
        """Times since the epoch."""
        time = self.store.types["builtin_interfaces/msg/Time"]
        return [time(*divmod(ns, 1_000_000_000)) for ns in nanoseconds.tolist()]


def _find(message: Any, path: str) -> tuple[Any, str]:
    *parents, name = path.split(".")
    for parent in parents:
        message = message[int(parent)] if parent.isdigit() else getattr(message, parent)
    return message, name


def generator(seed: int, name: str, block: int, use: int = 0) -> np.random.Generator:
    """Random generator for a topic, a time span and one use."""
    return np.random.default_rng([seed, zlib.crc32(name.encode()), block, use])


class Ticks(NamedTuple):
    """Times of messages in a span: since the start, since the epoch, numbers, and noise."""

    seconds: Floats
    stamp: NDArray[np.int64]
    number: NDArray[np.int64]
    block: int
    rng: np.random.Generator


class Speaker:
    """The robot with its sensors and its message types."""

    def __init__(self, robot: Robot, config: RobotConfig, types: Types) -> None:
        self.robot, self.types, self.config = robot, types, config
        self.front = sensors.Camera(config.image_size, 0.0, 0.15, colour=True)
        self.rear = sensors.Camera(config.image_size, np.pi, -0.15, colour=False)
        self._odometer, self._odometry = sensors.Odometer(robot), (-1, robot.at(np.zeros(1)))

    def odometry(self, ticks: Ticks) -> State:
        """Odometry of a span, measured once for all topics with the same clock."""
        if self._odometry[0] != ticks.block:
            rng = generator(self.robot.seed, "odometer", ticks.block)
            self._odometry = (ticks.block, self._odometer.measure(ticks.seconds, rng))
        return self._odometry[1]


Filled = tuple[Values, Values]
"""Values common to all messages, and columns of values that differ, by path."""
Fill = Callable[[Speaker, Ticks], Filled]


class Topic(NamedTuple):
    """One topic: a rate and phase, or `moments`; least and mean delay from stamp to log time.

    Topics with the same `clock` have the same times.
    """

    name: str
    msgtype: str
    node: str
    hz: float = 0.0
    phase: float = 0.0
    delay: tuple[float, float] = (0.001, 0.0003)
    jitter: float = 0.01
    clock: str = ""
    moments: Callable[[Robot], Sequence[float]] = lambda _robot: (0.0,)
    latched: bool = False
    fill: Fill = lambda _speaker, _ticks: ({}, {})

    @property
    def spelled(self) -> str:
        """Message type as rosbags spells it."""
        return self.msgtype.replace("/", "/msg/")

    def ticks(self, start: float, end: float, block: int, robot: Robot) -> Ticks:
        """The message times in `[start, end)` seconds."""
        if self.hz:
            bounds = np.ceil((np.array([start, end]) - self.phase) * self.hz - 1e-9)
            number = np.arange(*np.maximum(bounds, 0).astype(int).tolist())
            rng = generator(robot.seed, self.clock or self.name, block)
            seconds = self.phase + (number + self.jitter * rng.random(len(number))) / self.hz
        else:
            moments = np.array(self.moments(robot), np.float64)
            number = np.flatnonzero((moments >= start) & (moments < end))
            seconds = moments[number]
        stamp = robot.start_ns + np.rint(seconds * 1e9).astype(np.int64)
        return Ticks(seconds, stamp, number, block, generator(robot.seed, self.name, block, 1))

    def log_times(self, ticks: Ticks, seed: int) -> NDArray[np.int64]:
        """Log time of each message, int64[n] nanoseconds."""
        rng = generator(seed, self.name, ticks.block, 2)
        delay = self.delay[0] + self.delay[1] * rng.standard_exponential(len(ticks.seconds))
        return ticks.stamp + np.rint(delay * 1e9).astype(np.int64)

    def messages(self, speaker: Speaker, ticks: Ticks) -> Iterator[Any]:
        """Each message; the next one overwrites it."""
        values, columns = self.fill(speaker, ticks)
        message = speaker.types.make(self.spelled, values)
        if hasattr(message, "header"):
            columns |= {"header.stamp": ticks.stamp, "header.seq": ticks.number}
        yield from speaker.types.filled(message, columns, len(ticks.seconds))


TOPICS: list[Topic] = []
"""Every topic, in the order of a bag's connections."""


def topics_of(config: RobotConfig) -> list[Topic]:
    """Every topic, where those of compressed images are named as in ROS."""
    if config.jpeg is None:
        return TOPICS
    compressed = "sensor_msgs/CompressedImage"
    return [
        one._replace(name=f"{one.name}/compressed", msgtype=compressed)
        if one.msgtype == "sensor_msgs/Image"
        else one
        for one in TOPICS
    ]


def topic(*settings: Any, **others: Any) -> Callable[[Fill], Fill]:
    """Add a topic that the decorated function fills."""

    def add(fill: Fill) -> Fill:
        TOPICS.append(Topic(*settings, **others)._replace(fill=fill))
        return fill

    return add


def yaw(path: str, heading: Floats) -> Values:
    """A turn about the vertical axis."""
    return {f"{path}.z": np.sin(heading / 2), f"{path}.w": np.cos(heading / 2)}


def xyz(path: str, *columns: Any) -> Values:
    """Up to three columns of a vector."""
    return {f"{path}.{axis}": column for axis, column in zip("xyz", columns, strict=False)}


def _diagonal(*values: float) -> Floats:
    return np.diag(values).ravel()


@topic("/tf_static", "tf2_msgs/TFMessage", "/robot_state_publisher", latched=True)
def _static(speaker: Speaker, ticks: Ticks) -> Filled:
    mounts = (
        ("base_laser_link", sensors.LASER_OFFSET, sensors.LASER_HEIGHT, (0.0, 0.0, 0.0, 1.0)),
        ("imu_link", 0.0, 0.25, (0.0, 0.0, 0.0, 1.0)),
        ("velodyne", 0.0, sensors.LIDAR_HEIGHT, (0.0, 0.0, 0.0, 1.0)),
        # Optical frames look along z, with x to the right and y down.
        ("front_camera_optical_frame", 0.15, sensors.CAMERA_HEIGHT, (-0.5, 0.5, -0.5, 0.5)),
        ("rear_camera_optical_frame", -0.15, sensors.CAMERA_HEIGHT, (-0.5, -0.5, 0.5, 0.5)),
    )
    transforms = []
    for frame, x, z, turn in mounts:
        values: Values = {"header.frame_id": "base_link", "child_frame_id": frame}
        values |= xyz("transform.translation", x, 0.0, z) | xyz("transform.rotation", *turn)
        values["transform.rotation.w"] = turn[3]
        transforms.append(speaker.types.make("geometry_msgs/msg/TransformStamped", values))
    stamps = {f"transforms.{k}.header.stamp": ticks.stamp for k in range(len(mounts))}
    return {"transforms": transforms}, stamps


@topic("/map", "nav_msgs/OccupancyGrid", "/map_server", latched=True)
def _map(speaker: Speaker, ticks: Ticks) -> Filled:
    values: Values = {"header.frame_id": "map", "info.resolution": _MAP_RESOLUTION}
    values["info.width"] = round(WIDTH / _MAP_RESOLUTION)
    values["info.height"] = round(DEPTH / _MAP_RESOLUTION)
    values["info.map_load_time"] = speaker.types.times(ticks.stamp)[0]
    values["info.origin.orientation.w"] = 1.0
    return values | {"data": speaker.robot.plan.occupancy(_MAP_RESOLUTION).ravel()}, {}


@topic("/base/scan", "sensor_msgs/LaserScan", "/hokuyo_node", 20, 0.007, (0.0415, 0.0008))
def _scan(speaker: Speaker, ticks: Ticks) -> Filled:
    values: Values = {"header.frame_id": "base_laser_link", "scan_time": 1 / sensors.SCAN_HZ}
    values |= {"angle_min": sensors.SCAN_ANGLE_MIN, "angle_max": -sensors.SCAN_ANGLE_MIN}
    values |= {"range_min": sensors.SCAN_RANGE_MIN, "range_max": sensors.SCAN_RANGE_MAX}
    steps = sensors.scan_steps(speaker.config.scan_beams)
    values |= dict(zip(("angle_increment", "time_increment"), steps, strict=True))
    beams, step = speaker.config.scan_beams, speaker.config.intensity_step
    ranges, intensities = sensors.scan(speaker.robot, ticks.seconds, beams, ticks.rng)
    if step is not None:
        intensities = np.round(intensities / np.float32(step)) * np.float32(step)
    return values, {"ranges": ranges, "intensities": intensities}


_FRONT, _REAR = "camera/front", "camera/rear"


def _image(name: str) -> Fill:
    def fill(speaker: Speaker, ticks: Ticks) -> Filled:
        camera: sensors.Camera = getattr(speaker, name)
        values: Values = {"header.frame_id": f"{name}_camera_optical_frame"}
        encoding = "bgr8" if camera.channels == 3 else "mono8"
        pictures = [camera.render(speaker.robot, t, ticks.rng) for t in ticks.seconds.tolist()]
        if speaker.config.jpeg is not None:
            values["format"] = f"{encoding}; jpeg compressed {encoding}"
            return values, {"data": [_jpeg(p, camera, speaker.config.jpeg) for p in pictures]}
        values |= {"height": camera.height, "width": camera.width, "encoding": encoding}
        values["step"] = camera.width * camera.channels
        return values, {"data": pictures}

    return fill


def _jpeg(pixels: NDArray[np.uint8], camera: sensors.Camera, quality: int) -> NDArray[np.uint8]:
    from PIL import Image

    # Pictures are blue, green, red; files are red, green, blue.
    shape = camera.height, camera.width, camera.channels
    picture = np.ascontiguousarray(pixels.reshape(shape)[:, :, ::-1].squeeze())
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "jpeg", quality=quality, optimize=True)
    return np.frombuffer(file.getvalue(), np.uint8)


topic(
    f"/{_FRONT}/image_raw",
    "sensor_msgs/Image",
    f"/{_FRONT}",
    5,
    0.013,
    (0.032, 0.003),
    clock=_FRONT,
)(_image("front"))


@topic(
    f"/{_FRONT}/camera_info",
    *("sensor_msgs/CameraInfo", f"/{_FRONT}", 5, 0.013, (0.03, 5e-4), 0.01, _FRONT),
)
def _info(speaker: Speaker, _ticks: Ticks) -> Filled:
    camera, (cx, cy) = speaker.front, speaker.front.center
    values: Values = {"header.frame_id": "front_camera_optical_frame", "height": camera.height}
    values |= {"width": camera.width, "distortion_model": "plumb_bob"}
    k = np.array([[camera.focal, 0, cx], [0, camera.focal, cy], [0, 0, 1]])
    p = np.append(k, np.zeros((3, 1)), axis=1)
    matrices = {"D": np.zeros(5), "K": k.ravel(), "R": np.eye(3).ravel(), "P": p.ravel()}
    return values | matrices, {}


topic(
    f"/{_REAR}/image_raw", "sensor_msgs/Image", f"/{_REAR}", 2.5, 0.021, (0.032, 0.003), clock=_REAR
)(_image("rear"))


@topic("/lidar/points", "sensor_msgs/PointCloud2", "/velodyne_node", 0.5, 0.1, (0.061, 0.004), 1e-3)
def _cloud(speaker: Speaker, ticks: Ticks) -> Filled:
    width, step = speaker.config.cloud_columns, sensors.POINT.itemsize
    fields: list[Any] = []
    values: Values = {"header.frame_id": "velodyne", "height": sensors.RINGS, "width": width}
    for name, place in (sensors.POINT.fields or {}).items():
        kind = 6 if name == "ring" else 7
        field: Values = {"name": name, "offset": place[1], "datatype": kind, "count": 1}
        fields.append(speaker.types.make("sensor_msgs/msg/PointField", field))
    values |= {"point_step": step, "row_step": step * width, "fields": fields}
    turns = [sensors.cloud(speaker.robot, t, width, ticks.rng) for t in ticks.seconds.tolist()]
    return values, {"data": [points.view(np.uint8) for points in turns]}


@topic("/odom", "nav_msgs/Odometry", "/base_controller", 50, 0.002, (0.0016, 4e-4), clock="base")
def _odom(speaker: Speaker, ticks: Ticks) -> Filled:
    values: Values = {"header.frame_id": "odom", "child_frame_id": "base_link"}
    values["pose.covariance"] = _diagonal(0.01, 0.01, 1e6, 1e6, 1e6, 0.03)
    values["twist.covariance"] = _diagonal(0.001, 1e-6, 1e6, 1e6, 1e6, 0.004)
    measured = speaker.odometry(ticks)
    noise = 0.003 * ticks.rng.standard_normal((2, len(ticks.seconds)))
    columns = xyz("pose.pose.position", measured.x, measured.y)
    columns |= yaw("pose.pose.orientation", measured.heading)
    columns["twist.twist.linear.x"] = measured.speed + noise[0]
    columns["twist.twist.angular.z"] = measured.yaw_rate + noise[1]
    return values, columns


@topic(
    "/tf", "tf2_msgs/TFMessage", "/robot_state_publisher", 50, 0.002, (26e-4, 6e-4), clock="base"
)
def _transforms(speaker: Speaker, ticks: Ticks) -> Filled:
    measured, truth = speaker.odometry(ticks), speaker.robot.at(ticks.seconds)
    # map -> odom corrects the drift: with odom -> base it gives the true pose.
    turn = truth.heading - measured.heading
    x = truth.x - (np.cos(turn) * measured.x - np.sin(turn) * measured.y)
    y = truth.y - (np.sin(turn) * measured.x + np.cos(turn) * measured.y)
    odom = ("map", "odom", x, y, turn)
    base = ("odom", "base_link", measured.x, measured.y, measured.heading)
    transforms: list[Any] = []
    columns: Values = {}
    for number, (parent, child, right, up, heading) in enumerate((odom, base)):
        frames = {"header.frame_id": parent, "child_frame_id": child}
        transforms.append(speaker.types.make("geometry_msgs/msg/TransformStamped", frames))
        link = f"transforms.{number}"
        columns |= {f"{link}.header.stamp": ticks.stamp, f"{link}.header.seq": ticks.number}
        columns |= xyz(f"{link}.transform.translation", right, up)
        columns |= yaw(f"{link}.transform.rotation", heading)
    return {"transforms": transforms}, columns


@topic("/joint_states", "sensor_msgs/JointState", "/base_controller", 50, 0.009, (0.0012, 3e-4))
def _joints(speaker: Speaker, ticks: Ticks) -> Filled:
    robot, state = speaker.robot, speaker.robot.at(ticks.seconds)
    turned = (state.heading - robot.at(np.zeros(1)).heading) * _TRACK / 2
    half = state.yaw_rate * _TRACK / 2
    fingers = robot.gripper_opening(ticks.seconds)
    closing = (robot.gripper_opening(ticks.seconds + 0.01) - fingers) / 0.01
    drive = 2.0 * state.acceleration + 0.8 * np.sign(state.speed)
    rolled = [(state.distance + sign * turned) / _WHEEL_RADIUS for sign in (-1, 1)]
    rolling = [(state.speed + sign * half) / _WHEEL_RADIUS for sign in (-1, 1)]
    effort = np.stack((drive, drive, -20 * np.sign(closing)), axis=1)
    effort += 0.05 * ticks.rng.standard_normal(effort.shape)
    columns = {"position": np.stack((*rolled, fingers), axis=1), "effort": effort}
    columns["velocity"] = np.stack((*rolling, closing), axis=1)
    return {"name": ["wheel_left_joint", "wheel_right_joint", "r_gripper_joint"]}, columns


@topic("/imu/data", "sensor_msgs/Imu", "/imu_node", 100, 0.001, (0.0008, 0.0002))
def _imu(speaker: Speaker, ticks: Ticks) -> Filled:
    values: Values = {"header.frame_id": "imu_link"}
    values["orientation_covariance"] = _diagonal(1e-4, 1e-4, 4e-4)
    values["angular_velocity_covariance"] = _diagonal(*[sensors.GYRO_NOISE**2] * 3)
    values["linear_acceleration_covariance"] = _diagonal(*[sensors.ACCELERATION_NOISE**2] * 3)
    state = speaker.robot.at(ticks.seconds)
    yaw_rate, *acceleration = sensors.inertial(state, ticks.rng)
    tilt = 0.001 * ticks.rng.standard_normal((2, len(ticks.seconds)))
    columns = yaw("orientation", state.heading) | xyz("angular_velocity", *tilt, yaw_rate)
    return values, columns | xyz("linear_acceleration", *acceleration)


@topic("/cmd_vel", "geometry_msgs/Twist", "/move_base", 20, 0.004, (0.0005, 0.0002))
def _velocity(speaker: Speaker, ticks: Ticks) -> Filled:
    # The base follows its commands after 50 ms.
    ahead = speaker.robot.at(ticks.seconds + 0.05)
    return {}, {"linear.x": ahead.speed, "angular.z": ahead.yaw_rate}


@topic(
    *("/r_gripper_controller/command", "pr2_controllers_msgs/Pr2GripperCommand", "/grasp_planner"),
    moments=lambda robot: [command.seconds for command in robot.gripper_commands],
)
def _gripper(speaker: Speaker, ticks: Ticks) -> Filled:
    commands = [speaker.robot.gripper_commands[k] for k in ticks.number]
    return {}, {name: [getattr(c, name) for c in commands] for name in ("position", "max_effort")}


def _arm_moments(robot: Robot) -> list[float]:
    stops = [stop for stop in robot.stops if stop.kind in {"pick", "place"}]
    spans = [np.arange(start + 0.4, end - 0.3, 0.05) for _, start, end in stops]
    return [float(t) for span in spans for t in span if t < robot.duration_s]


@topic(
    *("/r_cart/command_pose", "geometry_msgs/PoseStamped", "/grasp_planner", 0, 0, (0.002, 0.0005)),
    moments=_arm_moments,
)
def _arm(speaker: Speaker, ticks: Ticks) -> Filled:
    part = np.zeros(len(ticks.seconds))
    for kind, start, end in speaker.robot.stops:
        here = (ticks.seconds - start - 0.4) / (end - start - 0.7)
        moves = (here >= 0) & (here <= 1) & (kind in {"pick", "place"})
        part = np.where(moves, here, part)
    # To the shelf and back.
    reach = np.sin(np.pi * part)
    columns = xyz("pose.position", 0.42 + 0.08 * reach, -0.18 - 0.4 * reach, 0.62 + 0.35 * reach)
    return {"header.frame_id": "base_link", "pose.orientation.w": 1.0}, columns


_VIEW = "/rviz_camera_publisher"


@topic(f"{_VIEW}/camera_pose", "geometry_msgs/Pose", _VIEW, 10, 0.05, (0.006, 0.002))
def _view(speaker: Speaker, ticks: Ticks) -> Filled:
    state = speaker.robot.at(ticks.seconds)
    # An operator moves the view round the robot occasionally, else it rests.
    bursts, clock = np.divmod(ticks.seconds, 7.0)
    part = np.clip((clock - 1.0) / 2.5, 0, 1)
    orbit = 0.9 * (bursts + part * part * (3 - 2 * part))
    down, turn = np.arctan2(1.6, 3.0) / 2, orbit / 2 + np.pi / 2
    columns = xyz("position", state.x + 3.0 * np.cos(orbit), state.y + 3.0 * np.sin(orbit))
    columns |= xyz("orientation", -np.sin(turn) * np.sin(down), np.cos(turn) * np.sin(down))
    columns |= yaw("orientation", 2 * turn)
    columns |= {
        f"orientation.{axis}": columns[f"orientation.{axis}"] * np.cos(down) for axis in "zw"
    }
    return {"position.z": 2.0}, columns


@topic("/battery", "sensor_msgs/BatteryState", "/power_board", 1, 0.25, (0.003, 0.001), 0.002)
def _battery(speaker: Speaker, ticks: Ticks) -> Filled:
    seed, state = speaker.robot.seed, speaker.robot.at(ticks.seconds)
    values: Values = {"header.frame_id": "base_link", "temperature": float("nan"), "present": 1}
    values |= {"capacity": 40.0, "design_capacity": 42.0, "serial_number": f"sim-{seed:04d}"}
    values |= {"power_supply_status": 2, "power_supply_health": 1, "location": "base"}
    full = 0.84 + 0.1 * float(generator(seed, "battery", 0).random())
    # Electronics draw 4.5 A all the time, driving 6 A more at 1 m/s.
    used = (4.5 * ticks.seconds + 6.0 * state.distance) / 3600
    charge, current = np.maximum(40.0 * full - used, 0.0), 4.5 + 6.0 * state.speed
    voltage = 24.0 + 4.8 * charge / 40.0 - 0.04 * current
    cells = np.repeat(voltage[:, None] / 7, 7, axis=1).astype(np.float32)
    columns = {"voltage": voltage, "current": -current, "cell_voltage": cells}
    columns |= {"charge": charge, "percentage": charge / 40.0}
    return values | {"power_supply_technology": 2}, columns


@topic(
    *("/diagnostics", "diagnostic_msgs/DiagnosticArray", "/diagnostic_aggregator"),
    *(1, 0.4, (0.002, 0.0005), 0.0),
)
def _diagnostics(speaker: Speaker, ticks: Ticks) -> Filled:
    def status(name: str, key: str, value: str, level: int = 0, said: str = "OK") -> Any:
        pair = speaker.types.make("diagnostic_msgs/msg/KeyValue", {"key": key, "value": value})
        values: Values = {"level": level, "name": name, "message": said, "hardware_id": "sim"}
        values["values"] = [pair]
        return speaker.types.make("diagnostic_msgs/msg/DiagnosticStatus", values)

    others = [
        status("laser", "frequency", f"{sensors.SCAN_HZ:g}"),
        status("computer", "load", "0.41"),
    ]
    found = []
    for degrees in speaker.robot.motor_temperature(ticks.seconds).tolist():
        level = int(degrees >= MOTOR_WARN) + int(degrees >= MOTOR_ERROR)
        said = ("OK", "motor temperature high", "motor over-temperature")[level]
        motors = status("drive motors", "temperature", f"{degrees:.1f}", level, said)
        found.append([motors, *others])
    return {}, {"status": found}


@topic("/rosout", "rosgraph_msgs/Log", "/rosout", moments=lambda r: [m.seconds for m in r.remarks])
def _text_log(speaker: Speaker, ticks: Ticks) -> Filled:
    grades = {"info": 2, "warn": 4, "error": 8}
    remarks = [speaker.robot.remarks[k] for k in ticks.number]
    rows = [(grades[r.severity], r.node, r.text, 100 + len(r.text)) for r in remarks]
    columns: Values = dict(
        zip(("level", "name", "msg", "line"), zip(*rows, strict=True), strict=True)
    )
    columns["stamp"] = ticks.stamp
    topics = ["/rosout", "/cmd_vel"]
    return {"file": "robot.cpp", "function": "spin", "topics": topics}, columns
