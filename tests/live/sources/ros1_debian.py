"""ROS 1 as Debian packs it: rosmaster, rospy, rosbag's recorder and player.

The packages are fetched once into the cache and unpacked there, which needs apt but neither
root nor an installation.
"""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from tests.debian import libraries, unpack
from tests.peer_cache import made_once

PACKAGES = (
    "python3-rosmaster",
    "python3-rospy",
    "python3-std-msgs",
    "python3-sensor-msgs",
    "python3-rosbag",
)
_OF_ROS = re.compile("^Source: ros-", re.MULTILINE)


class Ros1(NamedTuple):
    """Where ROS 1 lies."""

    python: str
    tools: Path
    environment: dict[str, str]


def ros1() -> Ros1 | str:
    """ROS 1, or why it cannot be had."""
    place = made_once("ros1-debian", lambda place: unpack(place, PACKAGES, _without_ros))
    return place if isinstance(place, str) else _in(place / "tree")


def _in(root: Path) -> Ros1:
    own_python = root / "usr/bin/python3"
    environment = {
        "PYTHONPATH": str(root / "usr/lib/python3/dist-packages"),
        # Where the player looks for the package that reads bags, and for its plugin.
        "ROS_PACKAGE_PATH": str(root / "usr/share"),
        "CMAKE_PREFIX_PATH": str(_plugins(root)),
        "LD_LIBRARY_PATH": libraries(root),
    }
    if own_python.exists():
        # Debian's Python was missing, too.
        environment["PYTHONHOME"] = str(root / "usr")
    else:
        own_python = Path("/usr/bin/python3")
    return Ros1(str(own_python), root / "usr/lib/rosbag", environment)


def _plugins(root: Path) -> Path:
    """A directory below which `lib` has a tree's plugins: they are found in no other way."""
    prefix = root / "plugins"
    prefix.mkdir(exist_ok=True)
    for plugins in root.glob("usr/lib/*-linux-gnu/ros"):
        with suppress(FileExistsError):  # also of a test that runs beside this one
            (prefix / "lib").symlink_to(plugins)
    return prefix


def _without_ros(status: str) -> str:
    """What dpkg says of a system, as if that had nothing of ROS: a tree has all or nothing."""
    packages = status.split("\n\n")
    return "\n\n".join(package for package in packages if not _OF_ROS.search(package))
