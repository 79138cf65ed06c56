"""Messages, images and points as numpy arrays. Imports: none."""

from __future__ import annotations

from typing import Final

VIDEOS: Final = frozenset(("foxglove.CompressedVideo", "foxglove_msgs/CompressedVideo"))
"""Types of messages with a frame of video, without `/msg/`."""


def is_video_type(name: str) -> bool:
    """True for the type of messages with a frame of video."""
    return name.replace("/msg/", "/") in VIDEOS
