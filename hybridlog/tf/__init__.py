"""Transforms between the coordinate frames of a robot, as tf2 gives them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

TYPES: Final = (
    "tf2_msgs/TFMessage",
    "tf/tfMessage",
    "geometry_msgs/TransformStamped",
    "foxglove.FrameTransform",
    "foxglove.FrameTransforms",
)
"""Message types with transforms, as `plain_type` names them."""


def is_of_transforms(type_name: str) -> bool:
    """True for a type of `TYPES`, as ROS 1, ROS 2 or Foxglove name it."""
    from hybridlog.arrays.message_arrays import plain_type

    return plain_type(type_name) in TYPES


def frames_named(message: dict[str, Any]) -> Iterator[str]:
    """Names of the frames in the fields of a message of such a type."""
    for one in message.get("transforms", [message]):
        parent = one.get("parent_frame_id") or one.get("header", {}).get("frame_id")
        yield from (str(name).lstrip("/") for name in (one.get("child_frame_id"), parent) if name)
