"""What a system must be able to do to take part: this is all that the studies know.

To add one, write a class in a module of its own, and name it in `registry.py`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Final

import numpy as np

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray

    from hybridlog_storage.messages import Channel

GRIPPER: Final = "/r_gripper_controller/command"
VIEWPOINT: Final = "/rviz_camera_publisher/camera_pose"
ARM: Final = "/r_cart/command_pose"
HALF_NS: Final = 500_000_000
"""Half of the window of Q4, as the code in the paper's appendix has it."""
IMU_COLUMNS: Final = tuple(
    f"{name}.{axis}" for name in ("angular_velocity", "linear_acceleration") for axis in "xyz"
)
"""What is compared of an IMU's table."""


class BackendMissingError(Exception):
    """A system is not there or does not start; the message names the cure."""


class BackendFailedError(Exception):
    """A system has stopped working in the middle: a dead server, a full disk."""


def need(module: str, package: str) -> None:
    """See that a package can be imported, without importing it.

    Args:
        module: What is imported.
        package: What is installed, as pip calls it.
    """
    if find_spec(module) is None:
        raise BackendMissingError(
            f"The package {package} is not installed. Install it: pip install {package}, "
            "or all that the benchmarks use: pip install 'hybridlog[bench]'."
        )


@contextmanager
def failing(system: str, *errors: type[Exception]) -> Iterator[None]:
    """What a driver raises in the block is a failure of the system."""
    try:
        yield
    except errors as error:
        raise BackendFailedError(f"{system}: {' '.join(str(error).split())}") from error


def sums(rows: Sequence[Sequence[float]]) -> list[float]:
    """Number of rows, and the sum of each of three columns."""
    columns = np.array(rows, np.float64).reshape(-1, 3).sum(axis=0)
    return [float(len(rows)), *map(float, columns)]


class Backend(ABC):
    """One system under test. Made once a run, in a process of its own.

    Args:
        directory: Where all its data goes. It exists, and may hold what an earlier
            process has left there, which `open` then goes on with.

    Attributes:
        name: As on the command line.
        title: As in tables.
        records: Whether streams and logs are published to it.
        answers: Whether it is asked the paper's questions.
        reads: Whether messages are read back from it.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    records: ClassVar[bool] = True
    answers: ClassVar[bool] = False
    reads: ClassVar[bool] = False

    def __init__(self, directory: Path) -> None:
        self.directory = directory

    @classmethod  # noqa: B027 - most backends need nothing
    def check(cls) -> None:
        """See that it can be used here, without starting it.

        Raises:
            BackendMissingError: It cannot; the message says what to install.
        """

    @abstractmethod
    def open(self, channels: Sequence[Channel]) -> None:
        """Start what has to be started, make tables or files for these channels.

        Raises:
            BackendMissingError: It does not start.
        """

    @abstractmethod
    def insert(self, channel: int, log_time: int, payload: bytes) -> None:
        """Take a message. Called by the channel's own thread, several at a time.

        Args:
            channel: Index into the channels given to `open`.
            log_time: When the message was received, ns since the epoch.
            payload: The serialized message.

        Raises:
            BackendFailedError: It cannot go on.
        """

    @abstractmethod
    def finish(self) -> None:
        """See everything inserted safe on the disk; no `insert` follows."""

    @abstractmethod
    def counts(self) -> Mapping[str, int]:
        """Messages of each topic, read back from the system itself."""

    @abstractmethod
    def close(self) -> None:
        """Stop what was started; the data stays. Also called after a failure."""

    def processes(self) -> Sequence[int]:
        """Process ids of the servers that belong to it, without their children."""
        return ()

    # The paper's questions, in the system's own language.

    def closings(self) -> int:
        """Q1: how many times was the right gripper closed."""
        raise NotImplementedError

    def behind(self) -> int:
        """Q2, as the appendix counts it: viewpoints behind the robot."""
        raise NotImplementedError

    def positions(self) -> list[float]:
        """Q2, as its text asks: those viewpoints; their number, sums of x, y and z."""
        raise NotImplementedError

    def in_region(self) -> int:
        """Q3: how many times was the gripper moved in a region."""
        raise NotImplementedError

    def grasps(self) -> int:
        """Q4: closings with a viewpoint in front of the robot nearer than `HALF_NS`."""
        raise NotImplementedError

    # What comes after a question.

    def slice(self, topic: str, begin: int, end: int) -> NDArray[np.float32]:
        """Field `ranges` of the messages with a log time in `[begin, end)`, in order."""
        raise NotImplementedError

    def last(self, topic: str, time: int) -> NDArray[np.float32]:
        """Field `ranges` of the last message with a log time up to `time`."""
        raise NotImplementedError

    def table(self, topic: str) -> pd.DataFrame:
        """All messages of a topic in the order of log time, at least with `IMU_COLUMNS`."""
        raise NotImplementedError
