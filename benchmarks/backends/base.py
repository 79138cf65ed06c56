"""What a system must be able to do to take part: this is all that the harness knows.

To add one, write a class in a module of its own, and name it in `registry.py`. Classes in
`benchmarks.questions` ask it and read from it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

if TYPE_CHECKING:
    from hybridlog_storage.messages import Channel


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


class Backend(ABC):
    """One system under test. Made once a run, in a process of its own.

    Args:
        directory: Where all its data goes. It exists, and may hold what an earlier
            process has left there, which `open` then goes on with.

    Attributes:
        name: As on the command line.
        title: As in tables.
        records: Whether streams and logs are published to it.
        asker: Class that asks it the questions, `module:class`; empty for none.
        reader: Class that reads messages back from it, the same way.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    records: ClassVar[bool] = True
    asker: ClassVar[str] = ""
    reader: ClassVar[str] = ""

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
