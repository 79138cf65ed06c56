"""What the PR2 says, whoever drives it: types, channels, joint states and transforms."""

from __future__ import annotations

import zlib
from typing import TYPE_CHECKING, Any

import numpy as np
from rosbags.typesys import get_types_from_msg

from benchmarks.loads.simulation.wire import Types
from hybridlog_storage.messages import Channel, Schema

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from benchmarks.loads.simulation.wire import Template

    Floats = NDArray[np.float64]

TF_TYPE = "tf/msg/tfMessage"
"""What /tf had before ROS Hydro."""
JOINTS_HZ = 100.0
STATE_TF_HZ = 50.0
POSE_TF_HZ = 30.0

JOINTS = (
    *(
        f"{caster}_caster_{part}_joint"
        for caster in ("fl", "fr", "bl", "br")
        for part in ("rotation", "l_wheel", "r_wheel")
    ),
    "torso_lift_joint",
    "torso_lift_motor_screw_joint",
    "head_pan_joint",
    "head_tilt_joint",
    "laser_tilt_mount_joint",
    *(
        f"{side}_{joint}_joint"
        for side in ("r", "l")
        for joint in (
            "upper_arm_roll",
            "shoulder_pan",
            "shoulder_lift",
            "forearm_roll",
            "elbow_flex",
            "wrist_flex",
            "wrist_roll",
            "gripper",
            "gripper_l_finger",
            "gripper_r_finger",
            "gripper_r_finger_tip",
            "gripper_l_finger_tip",
            "gripper_motor_screw",
            "gripper_motor_slider",
        )
    ),
)
"""Joints of the robot's description, in the order of `/joint_states`."""

TILT = JOINTS.index("laser_tilt_mount_joint")
WHEELS = tuple(number for number, name in enumerate(JOINTS) if "wheel" in name)
WHEEL_RADIUS = 0.074792
"""Metres."""
_ENCODER_NOISE = 2e-4
_EFFORT_NOISE = 0.15


class Pr2Types(Types):
    """The message types of ROS 1, with those that only old robots have."""

    def __init__(self) -> None:
        super().__init__(1)
        definition = "geometry_msgs/TransformStamped[] transforms\n"
        self.store.register(get_types_from_msg(definition, TF_TYPE))

    def channel(self, topic: str, msgtype: str, node: str) -> Channel:
        """The channel of a topic, as a ROS 1 bag describes it.

        Args:
            topic: Name.
            msgtype: As rosbags spells it.
            node: Who publishes it.
        """
        text, checksum = self.store.generate_msgdef(msgtype, ros_version=1)
        name = msgtype.replace("/msg/", "/")
        return Channel(
            topic=topic,
            message_encoding="ros1",
            schema=Schema(name=name, encoding="ros1msg", data=text.encode()),
            metadata={"callerid": node, "latching": "0", "md5sum": checksum},
            has_publish_time=False,
        )


def generator(seed: int, *names: str | int) -> np.random.Generator:
    """The random numbers of one stream: others do not change when one is left out."""
    parts = [zlib.crc32(name.encode()) if isinstance(name, str) else name for name in names]
    return np.random.default_rng([seed, *parts])


def stamped(stamps: NDArray[np.int64], prefix: str = "header") -> dict[str, NDArray[Any]]:
    """Columns of a header: stamp (ns since the epoch), and a number that counts up."""
    return {f"{prefix}.stamp": stamps, f"{prefix}.seq": np.arange(len(stamps))}


def joint_template(types: Types) -> Template:
    """A joint state; fill `joint_columns`."""
    zeros = [0.0] * len(JOINTS)
    values = {"name": list(JOINTS), "position": zeros, "velocity": zeros, "effort": zeros}
    return types.template("sensor_msgs/msg/JointState", values)


def joint_columns(
    rng: np.random.Generator, seconds: Floats, driven: Floats, pitch: Floats
) -> dict[str, NDArray[Any]]:
    """Positions, velocities and efforts of all joints.

    Args:
        rng: Of the stream.
        seconds: float64[n], since the start.
        driven: float64[n], metres that the wheels have rolled.
        pitch: float64[n], radians of the tilting laser.
    """
    count = len(seconds)
    rest = np.random.default_rng(len(JOINTS)).uniform(-1.5, 1.5, len(JOINTS))
    position = np.tile(rest, (count, 1))
    position[:, WHEELS] = (driven / WHEEL_RADIUS)[:, None]
    position[:, TILT] = pitch
    velocity = np.zeros_like(position)
    if count > 1:
        velocity = np.gradient(position, seconds, axis=0)
    position += _ENCODER_NOISE * rng.standard_normal(position.shape)
    velocity += _ENCODER_NOISE * JOINTS_HZ * rng.standard_normal(position.shape)
    effort = rest * 3 + _EFFORT_NOISE * rng.standard_normal(position.shape)
    return {"position": position, "velocity": velocity, "effort": effort}


def tilt(seconds: Floats) -> Floats:
    """Radians by which the tilting laser looks down, float64[n]: up and down in 3.6 s."""
    phase = np.abs((seconds / 3.6) % 1.0 * 2 - 1)
    return -0.5 + 1.3 * phase


def links_template(types: Types) -> Template:
    """The transforms of all moving links in one message; fill `links_columns`."""
    transforms = [
        {"header": {"frame_id": "torso_lift_link"}, "child_frame_id": _link(name)}
        for name in JOINTS
    ]
    return types.template(TF_TYPE, {"transforms": transforms})


def links_columns(
    rng: np.random.Generator, stamps: NDArray[np.int64], angles: Sequence[Floats]
) -> dict[str, NDArray[Any]]:
    """Transforms of all links, each turned about its own z axis.

    Args:
        rng: Of the stream.
        stamps: int64[n], ns since the epoch.
        angles: float64[n] each, radians, of the joints in order; the last goes on.
    """
    columns: dict[str, NDArray[Any]] = {}
    places = np.random.default_rng(7).uniform(-0.5, 0.5, (len(JOINTS), 3))
    for number in range(len(JOINTS)):
        path = f"transforms.{number}"
        angle = angles[min(number, len(angles) - 1)]
        angle = angle + _ENCODER_NOISE * rng.standard_normal(len(stamps))
        columns |= stamped(stamps, f"{path}.header")
        for axis, value in zip("xyz", places[number], strict=True):
            columns[f"{path}.transform.translation.{axis}"] = np.full(len(stamps), value)
        columns[f"{path}.transform.rotation.z"] = np.sin(angle / 2)
        columns[f"{path}.transform.rotation.w"] = np.cos(angle / 2)
    return columns


def pose_template(types: Types) -> Template:
    """The transform from odometry to robot; fill `pose_columns`."""
    one = {"header": {"frame_id": "odom_combined"}, "child_frame_id": "base_footprint"}
    return types.template(TF_TYPE, {"transforms": [one]})


def pose_columns(
    stamps: NDArray[np.int64], x: Floats, y: Floats, heading: Floats
) -> dict[str, NDArray[Any]]:
    """Where the robot stands: metres, metres, radians, float64[n] each."""
    return {
        **stamped(stamps, "transforms.0.header"),
        "transforms.0.transform.translation.x": x,
        "transforms.0.transform.translation.y": y,
        "transforms.0.transform.rotation.z": np.sin(heading / 2),
        "transforms.0.transform.rotation.w": np.cos(heading / 2),
    }


def of_two_sources(
    first: NDArray[np.int64], second: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Log times of two publishers of one topic, made distinct by a nanosecond."""
    return first & ~1, second | 1


def _link(joint: str) -> str:
    return joint.removesuffix("_joint") + "_link"
