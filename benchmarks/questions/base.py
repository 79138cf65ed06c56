"""The questions of study 3, what must be answered, and what answers them.

Each system has a class of its own that asks in the system's own language. All answers
are plain values, compared with what the load's plan says must be found.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from operator import methodcaller
from typing import TYPE_CHECKING, ClassVar, Final

import numpy as np

if TYPE_CHECKING:
    from benchmarks.backends.base import Backend

GRIPPER: Final = "/r_gripper_controller/command"
VIEWPOINT: Final = "/rviz_camera_publisher/camera_pose"
ARM: Final = "/r_cart/command_pose"

SECOND_NS: Final = 10**9
WIDE_NS: Final = SECOND_NS // 2
"""Half of the window of Q4, as the code in the paper's appendix has it."""

Answer = int | list[float]
"""A number, or a number and what else tells one answer from another."""


class Asker(ABC):
    """Asks one open backend.

    Args:
        backend: Open, with the load in it.
    """

    def __init__(self, backend: Backend) -> None:
        self.start(backend)

    @abstractmethod
    def start(self, backend: Backend) -> None:
        """Connect, define functions."""

    @abstractmethod
    def closings(self) -> int:
        """Q1: how many times was the right gripper closed."""

    @abstractmethod
    def behind(self) -> int:
        """Q2, as the appendix counts it: viewpoints behind the robot."""

    @abstractmethod
    def positions(self) -> list[float]:
        """Q2, as its text asks: those viewpoints; their number, sums of x, y and z."""

    @abstractmethod
    def in_region(self) -> int:
        """Q3: how many times was the gripper moved in a region."""

    @abstractmethod
    def grasps(self, half_ns: int) -> int:
        """Q4: closings with a viewpoint in front of the robot nearer than half the window."""

    def close(self) -> None:  # noqa: B027 - most have nothing to give back
        """Give back what `start` took."""


QUESTIONS: Final[dict[str, Callable[[Asker], Answer]]] = {
    "Q1": methodcaller("closings"),
    "Q2": methodcaller("behind"),
    "Q3": methodcaller("in_region"),
    "Q4": methodcaller("grasps", WIDE_NS),
    "Q2 positions": methodcaller("positions"),
}
"""By name; the first four are those of the paper's Table 1."""


def sums(rows: Sequence[Sequence[float]]) -> list[float]:
    """Number of rows, and the sum of each of three columns."""
    columns = np.array(rows, np.float64).reshape(-1, 3).sum(axis=0)
    return [float(len(rows)), *map(float, columns)]


class Reading(ABC):
    """Reads messages back from one open backend.

    Args:
        backend: Open, with the load in it.
    """

    columns: ClassVar[tuple[str, ...]] = (
        "angular_velocity.x",
        "angular_velocity.y",
        "angular_velocity.z",
        "linear_acceleration.x",
        "linear_acceleration.y",
        "linear_acceleration.z",
    )
    """What is compared of an IMU's table."""

    def __init__(self, backend: Backend) -> None:
        self.start(backend)

    @abstractmethod
    def start(self, backend: Backend) -> None:
        """Connect, define functions."""

    @abstractmethod
    def slice(self, topic: str, begin: int, end: int) -> Rows:
        """Field `ranges` of the messages with a log time in `[begin, end)`, in order."""

    @abstractmethod
    def last(self, topic: str, time: int) -> Row:
        """Field `ranges` of the last message with a log time up to `time`."""

    @abstractmethod
    def table(self, topic: str) -> pd.DataFrame:
        """All messages of a topic in the order of log time, at least with `columns`."""

    def close(self) -> None:  # noqa: B027 - most have nothing to give back
        """Give back what `start` took."""


if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray

    Row = NDArray[np.float32]
    Rows = NDArray[np.float32]
