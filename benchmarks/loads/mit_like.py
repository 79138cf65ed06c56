"""The topics of a PR2 that drives through a building, and a load of them: many bytes.

Topics, types and rates are those of the published recordings and of the robot's own
launch files; `docs/benchmarks-method.md` has the sources.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.loads import made
from benchmarks.loads.made import (
    TF_TYPE,
    Moments,
    OldTypes,
    Topic,
    Values,
    diagonal,
    fixed,
    room,
    scene,
    transforms,
    xyz,
    yaw,
)
from benchmarks.loads.spool import Spool
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from pathlib import Path

    from benchmarks.loads.base import Load
    from hybridlog.demo.topics import Types

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
MAX_SECONDS = 7 * 86_400.0
IMAGE_SIZE = (640, 480)
"""Width and height of all images, pixels."""

_ARM = ("upper_arm_roll", "shoulder_pan", "shoulder_lift", "forearm_roll", "elbow_flex")
_HAND = ("", "_l_finger", "_r_finger", "_r_finger_tip", "_l_finger_tip")
JOINTS = (
    *(
        f"{caster}_caster_{part}_joint"
        for caster in ("fl", "fr", "bl", "br")
        for part in ("rotation", "l_wheel", "r_wheel")
    ),
    *("torso_lift_joint", "torso_lift_motor_screw_joint", "head_pan_joint", "head_tilt_joint"),
    "laser_tilt_mount_joint",
    *(
        f"{side}_{joint}_joint"
        for side in ("r", "l")
        for joint in (
            *(*_ARM, "wrist_flex", "wrist_roll"),
            *(f"gripper{part}" for part in (*_HAND, "_motor_screw", "_motor_slider")),
        )
    ),
)
"""Joints of the robot's description, in the order of `/joint_states`."""


def _where(moments: Moments) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """x and y in metres, and heading: an eight through the building."""
    at = moments.seconds / 10
    return 5 * np.sin(at), 3 * np.sin(2 * at), np.arctan2(6 * np.cos(2 * at), 5 * np.cos(at))


def _imu(moments: Moments) -> Values:
    rng, count = moments.rng, len(moments.seconds)
    heading = _where(moments)[2]
    columns = xyz("orientation", *(0.002 * rng.standard_normal((2, count))))
    columns |= yaw("orientation", heading) | made.vector("angular_velocity", rng, count, 0.01)
    pushed = 0.1 * rng.standard_normal((3, count))
    pushed[2] += 9.80665
    return columns | xyz("linear_acceleration", *pushed)


def _odometry(moments: Moments) -> Values:
    x, y, heading = _where(moments)
    columns = xyz("pose.pose.position", x, y) | yaw("pose.pose.orientation", heading)
    columns["twist.twist.linear.x"] = 0.5 + 0.01 * moments.rng.standard_normal(len(x))
    return columns | {"twist.twist.angular.z": 0.1 * moments.rng.standard_normal(len(x))}


def _pose(moments: Moments) -> Values:
    x, y, heading = _where(moments)
    noise = 0.005 * moments.rng.standard_normal((2, len(x)))
    columns = xyz("pose.pose.position", x + noise[0], y + noise[1])
    return columns | yaw("pose.pose.orientation", heading)


def _joints(moments: Moments) -> Values:
    shape = (len(moments.seconds), len(JOINTS))
    rest = np.random.default_rng(len(JOINTS)).uniform(-1.5, 1.5, len(JOINTS))
    position = rest + 0.2 * np.sin(moments.seconds[:, None] + rest)
    position += 2e-4 * moments.rng.standard_normal(shape)
    velocity = 0.2 * np.cos(moments.seconds[:, None] + rest)
    velocity += 0.02 * moments.rng.standard_normal(shape)
    effort = rest * 3 + 0.15 * moments.rng.standard_normal(shape)
    return {"position": position, "velocity": velocity, "effort": effort}


def _links(moments: Moments) -> Values:
    columns: Values = {}
    angles = np.sin(moments.seconds + np.arange(len(JOINTS))[:, None])
    angles += 2e-4 * moments.rng.standard_normal(angles.shape)
    for number, angle in enumerate(angles):
        columns |= yaw(f"transforms.{number}.transform.rotation", angle)
    return columns


def _base(moments: Moments) -> Values:
    x, y, heading = _where(moments)
    columns = xyz("transforms.0.transform.translation", x, y)
    return columns | yaw("transforms.0.transform.rotation", heading)


def _frames(moments: Moments) -> Values:
    first = int(moments.seconds[0] * 25)
    frames = scene(moments.rng, first, (len(moments.seconds), *IMAGE_SIZE[::-1]))
    return {"data": frames.reshape(len(frames), -1)}


def _depths(moments: Moments) -> Values:
    """Millimetres to a floor below, and a wall behind it."""
    width, height = IMAGE_SIZE
    rows = np.maximum(np.arange(height) - height / 2, 1)[:, None]
    metres = np.minimum(0.9 * 440 / rows, 3 + np.sin(np.arange(width) / 90))
    frames = []
    for _ in moments.seconds:
        noise = 0.0012 * metres**2 * moments.rng.standard_normal((height, width), np.float32)
        depth = metres + noise
        depth[(depth < 0.5) | (depth > 9)] = 0
        frames.append(np.rint(depth * 1000).astype("<u2").view(np.uint8).ravel())
    return {"data": frames}


def _scan(frame: str, angle: float, beams: int, hz: float) -> Callable[[Types], Values]:
    step = 2 * angle / (beams - 1)
    turn = {"angle_min": -angle, "angle_max": angle, "angle_increment": step, "scan_time": 1 / hz}
    ranges = {"time_increment": 0.025 / 1440, "range_min": 0.023, "range_max": 30.0}
    return lambda _types: {"header.frame_id": frame, **turn, **ranges}


def _image(frame: str, encoding: str, depth: int) -> Callable[[Types], Values]:
    width, height = IMAGE_SIZE
    about = {"header.frame_id": frame, "height": height, "width": width}
    return lambda _types: {**about, "encoding": encoding, "step": width * depth}


def _camera_info(_types: Types) -> Values:
    width, height = IMAGE_SIZE
    f, cx, cy = 440.0, (width - 1) / 2, (height - 1) / 2
    values: Values = {"header.frame_id": "wide_stereo_optical_frame", "height": height}
    values |= {"width": width, "distortion_model": "plumb_bob", "D": np.zeros(5)}
    values |= {"K": np.array([f, 0, cx, 0, f, cy, 0, 0, 1.0]), "R": np.eye(3).ravel()}
    return values | {"P": np.array([f, 0, cx, 0, 0, f, cy, 0, 0, 0, 1.0, 0])}


def _lit(moments: Moments) -> Values:
    ranges = room(moments, 380)
    return {"ranges": ranges, "intensities": np.rint(4000 / ranges).astype(np.float32)}


_POSITION = "geometry_msgs/msg/PoseWithCovarianceStamped"
JOINT_TOPIC = Topic(
    *(JOINT_STATES, "sensor_msgs/msg/JointState", "/realtime_loop", 100.0, 0.003),
    *((0.0006, 0.0003), fixed(name=list(JOINTS)), _joints),
)
LINKS_TOPIC = Topic(
    *(TF, TF_TYPE, "/robot_state_publisher", 50.0, 0.005, (0.0009, 0.0003)),
    transforms(*(("torso_lift_link", name.replace("_joint", "_link")) for name in JOINTS)),
    _links,
)
BASE_TOPIC = Topic(
    *(TF, TF_TYPE, "/robot_pose_ekf", 30.0, 0.017, (0.0015, 0.0005)),
    *(transforms(("odom_combined", "base_footprint")), _base, "ekf"),
)
_SPREAD = diagonal(4e-6, 4e-6, 1e6, 1e6, 1e6, 2.89e-4)
_MODERN = (
    Topic(
        *(BASE_SCAN, "sensor_msgs/msg/LaserScan", "/base_hokuyo_node", 40.0, 0.004),
        *((0.019, 0.0008), _scan("base_laser_link", 2.2689, 1040, 40.0)),
        # The launch file asks this scanner for ranges only.
        *(lambda moments: {"ranges": room(moments, 1040)}, "", 4227),
    ),
    Topic(
        *(TILT_SCAN, "sensor_msgs/msg/LaserScan", "/tilt_hokuyo_node", 20.0, 0.011),
        *((0.008, 0.0008), _scan("laser_tilt_link", 0.829, 380, 20.0), _lit, "", 3107),
    ),
    Topic(
        *(IMU, "sensor_msgs/msg/Imu", "/imu_node", 100.0, 0.002, (0.0012, 0.0006)),
        fixed(
            header__frame_id="imu_link",
            orientation_covariance=diagonal(*[2.89e-08] * 3),
            angular_velocity_covariance=diagonal(*[1.0966e-04] * 3),
            linear_acceleration_covariance=diagonal(*[9.2e-03] * 3),
        ),
        _imu,
    ),
    Topic(
        *(ODOMETRY, "nav_msgs/msg/Odometry", "/realtime_loop", 100.0, 0.001, (0.0006, 0.0003)),
        fixed(
            header__frame_id="odom",
            child_frame_id="base_footprint",
            pose__covariance=_SPREAD,
            twist__covariance=_SPREAD,
        ),
        _odometry,
    ),
    Topic(
        *(POSE, _POSITION, "/robot_pose_ekf", 30.0, 0.017, (0.0015, 0.0005)),
        fixed(
            header__frame_id="odom_combined",
            pose__covariance=diagonal(2.5e-5, 2.5e-5, 1e-6, 1e-6, 1e-6, 1e-4),
        ),
        *(_pose, "ekf"),
    ),
    JOINT_TOPIC,
    LINKS_TOPIC,
    BASE_TOPIC,
    *(
        topic
        for side in ("left", "right")
        for topic in (
            Topic(
                *(STEREO.format(side, "image_rect"), "sensor_msgs/msg/Image"),
                *(f"/wide_stereo_{side}", 25.0, 0.013, (0.027, 0.0015)),
                *(_image("wide_stereo_optical_frame", "mono8", 1), _frames, "stereo", 307_300),
            ),
            Topic(
                *(STEREO.format(side, "camera_info"), "sensor_msgs/msg/CameraInfo"),
                *(f"/wide_stereo_{side}", 25.0, 0.013, (0.025, 0.0008), _camera_info),
                clock="stereo",
            ),
        )
    ),
)
_KINECT = (
    Topic(
        *(KINECT_IMAGE, "sensor_msgs/msg/Image", "/camera/driver", 15.0, 0.031, (0.035, 0.003)),
        *(_image("camera_rgb_optical_frame", "bayer_grbg8", 1), _frames, "", 307_300),
    ),
    Topic(
        *(KINECT_DEPTH, "sensor_msgs/msg/Image", "/camera/driver", 15.0, 0.047, (0.04, 0.003)),
        *(_image("camera_depth_optical_frame", "16UC1", 2), _depths, "", 614_500),
    ),
)


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
        seed: Not negative. Gives the noise.
        kinect: With colour and depth images, as the later recordings have.
        name: Of the load.
    """
    if not 0 < seconds <= MAX_SECONDS or seed < 0:
        raise UsageError(
            f"no drive of {seconds:g} s from seed {seed}; choose more than 0 s, up to "
            f"{MAX_SECONDS:.0f} s, and a seed that is not negative"
        )
    types = OldTypes()
    topics = (*_MODERN, *(_KINECT if kinect else ()))
    times = [made.schedule(topic, seconds, seed, place) for place, topic in enumerate(topics)]
    links, base = topics.index(LINKS_TOPIC), topics.index(BASE_TOPIC)
    both = made.of_two_sources(times[links][1], times[base][1])
    times[links], times[base] = (times[links][0], both[0]), (times[base][0], both[1])
    nodes = {topic.name: topic for topic in reversed(topics)}
    numbers = list(dict.fromkeys(topic.name for topic in topics))
    channels = [types.channel(name, nodes[name].msgtype, nodes[name].node) for name in numbers]
    with Spool(directory) as spool:
        for topic, of in zip(topics, times, strict=True):
            made.write(spool, numbers.index(topic.name), types, topic, (START_NS, *of), seed=seed)
        return spool.finish(name, seed, channels, seconds)
