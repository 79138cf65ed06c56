"""The recorders that are compared, as processes, and the talker they listen to."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from benchmarks.live.talker import Load
from benchmarks.side import SideError
from benchmarks.usage import cpu_s, with_children

_STOP_S = 120.0
_START_S = 2.5
_ROOT = Path(__file__).parents[2]
_SOURCES = (str(_ROOT), str(_ROOT / "storage"))
_ROSBAG = ("/usr/lib/rosbag/record", "/opt/ros/noetic/lib/rosbag/record")


@dataclass(slots=True)
class Kept:
    """What a recorder made of a load.

    Attributes:
        stored: Messages in its files.
        told: Messages that it says were lost.
        reduced: Messages stored without their payload: their fields, size and hash.
        indexed: Documents in the database; None where there is none.
        causes: Of those it tells, by cause.
        cpu_s: Processor seconds, all its processes together.
    """

    stored: int
    told: int
    reduced: int
    indexed: int | None
    causes: dict[str, int]
    cpu_s: float


def rosbag() -> Path | None:
    """The recorder of ROS 1, where it is installed."""
    return next((Path(path) for path in _ROSBAG if Path(path).exists()), None)


def environment(master: str) -> dict[str, str]:
    """For a ROS node that talks to nobody but this machine."""
    plain = {name: value for name, value in os.environ.items() if not name.startswith("ROS_")}
    return {**plain, "ROS_MASTER_URI": master, "ROS_IP": "127.0.0.1", "PYTHONPATH": ""}


class Ours:
    """`hybridlog record --ros1`.

    Args:
        store: Made anew.
        master: URI of the master.
        more: Further options.

    Attributes:
        process: It.
    """

    def __init__(self, store: Path, master: str, *more: str) -> None:
        self._store = store
        self._is_indexed = "none" not in more
        self._said = tempfile.TemporaryFile("w+")  # noqa: SIM115 - closed by close()
        command = [sys.executable, "-m", "hybridlog", "record", "--ros1", "--json"]
        self.process = subprocess.Popen(
            [*command, "--store", str(store), *more],
            env={**environment(master), "PYTHONPATH": os.pathsep.join(_SOURCES)},
            stdout=self._said,
            stderr=subprocess.DEVNULL,
            cwd=store.parent,
            start_new_session=True,
        )
        time.sleep(_START_S)

    def stop(self) -> Kept:
        """Ends it and reads what it says of itself."""
        processes = with_children([self.process.pid])
        used = cpu_s(processes)
        _end(self.process)
        self._said.seek(0)
        last = json.loads(self._said.read().splitlines()[-1])
        if self.process.returncode or "report" not in last:
            raise SideError(f"hybridlog record ended with {self.process.returncode}")
        report = last["report"]
        (recording,) = report["recordings"]
        causes = {cause: count for cause, count in report["lost"].items() if count}
        reduced = causes.get("degrade", 0)
        return Kept(
            recording["messages"],
            sum(causes.values()) - reduced,
            reduced,
            recording["messages_indexed"] if self._is_indexed else None,
            causes,
            used,
        )

    def kill(self) -> int:
        """Ends it without a word.

        Returns:
            When, ns since the epoch.
        """
        self.process.kill()
        now = time.time_ns()
        self.process.wait()
        return now

    def close(self) -> None:
        """Ends it when it still runs."""
        self.process.kill()
        self.process.wait()
        self._said.close()


class Rosbag:
    """`rosbag record -a`.

    Args:
        bag: Its file.
        master: URI of the master.
    """

    def __init__(self, bag: Path, master: str) -> None:
        program = rosbag()
        assert program is not None
        self._bag = bag
        self.process = subprocess.Popen(
            [str(program), "-O", str(bag), "-e", "/t[0-9]+"],
            env=environment(master),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        time.sleep(_START_S)

    def stop(self) -> Kept:
        """Ends it and counts what its bag has."""
        from rosbags.rosbag1 import Reader

        used = cpu_s(with_children([self.process.pid]))
        _end(self.process)
        with Reader(self._bag) as reader:
            stored = reader.message_count
        return Kept(stored, 0, 0, None, {}, used)

    def close(self) -> None:
        """Ends it when it still runs."""
        self.process.kill()
        self.process.wait()


def _end(process: subprocess.Popen[bytes]) -> None:
    process.send_signal(signal.SIGTERM)
    try:
        process.wait(_STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        raise SideError(f"{process.args!r} did not end within {_STOP_S:g} s") from None


class Speech:
    """A talker that runs."""

    def __init__(self, load: Load, master: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.live.talker", master, *map(str, load)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            cwd=_ROOT,
        )
        self._output: IO[bytes] | None = self._process.stdout
        self._speaks = False

    def began(self) -> None:
        """Waits until it speaks."""
        if not self._speaks:
            self._line()
            self._speaks = True

    def ended(self) -> dict[str, Any]:
        """Waits until it has said everything, and tells what it did."""
        self.began()
        assert self._process.stdin is not None
        self._process.stdin.close()
        found = self._line()
        self._process.wait()
        return found

    def kill(self) -> None:
        """Ends it at once."""
        self._process.kill()
        with self._process:  # closes its pipes
            pass

    def _line(self) -> dict[str, Any]:
        assert self._output is not None
        line = self._output.readline()
        if not line:
            raise SideError("the talker has ended: nobody listened")
        found: dict[str, Any] = json.loads(line)
        return found


@contextmanager
def speech(load: Load, master: str) -> Iterator[Speech]:
    """A talker while the block runs."""
    found = Speech(load, master)
    try:
        yield found
    finally:
        found.kill()
