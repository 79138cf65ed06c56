"""The recorder as a process, and the talker that it listens to."""

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

from benchmarks.live.talker import TYPE, Load
from benchmarks.side import SideError
from benchmarks.usage import cpu_s, with_children
from tests.live.sources.ros1_peers import FakeMaster

_STOP_S = 120.0
_START_S = 2.5
_ROOT = Path(__file__).parents[2]
_SOURCES = (str(_ROOT), str(_ROOT / "storage"))


@dataclass(slots=True)
class Kept:
    """What the recorder made of a load.

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


class Recorder:
    """`hybridlog record --ros1`.

    Args:
        store: Made anew.
        master: URI of the master.
        more: Further options.

    Attributes:
        process: It.
    """

    def __init__(self, store: Path, master: str, *more: str) -> None:
        self._is_indexed = "none" not in more
        self._said = tempfile.TemporaryFile("w+")  # noqa: SIM115 - closed by close()
        plain = {name: value for name, value in os.environ.items() if not name.startswith("ROS_")}
        node = {"ROS_MASTER_URI": master, "ROS_IP": "127.0.0.1"}
        command = [sys.executable, "-m", "hybridlog", "record", "--ros1", "--json"]
        self.process = subprocess.Popen(
            [*command, "--store", str(store), *more],
            env={**plain, **node, "PYTHONPATH": os.pathsep.join(_SOURCES)},
            stdout=self._said,
            stderr=subprocess.DEVNULL,
            cwd=store.parent,
            start_new_session=True,
        )
        time.sleep(_START_S)

    def stop(self) -> Kept:
        """Ends it and reads what it says of itself."""
        used = cpu_s(with_children([self.process.pid]))
        self.process.send_signal(signal.SIGTERM)
        try:
            self.process.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            raise SideError(f"hybridlog record did not end within {_STOP_S:g} s") from None
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

    def close(self) -> None:
        """Ends it when it still runs."""
        self.process.kill()
        self.process.wait()
        self._said.close()


class Speech:
    """A talker that runs, known to a master."""

    def __init__(self, load: Load, master: FakeMaster) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.live.talker", json.dumps(load)],
            stdout=subprocess.PIPE,
            text=True,
            cwd=_ROOT,
        )
        self._master = master
        self._topics = [f"/t{number}" for number in range(load.topics)]
        uri = self.line()
        for topic in self._topics:
            master.add(topic, TYPE, "/talker", uri)

    def line(self) -> str:
        """What it says next: where it is, that it speaks, how many messages it has sent."""
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise SideError("the talker has ended: nobody listened")
        return line.strip()

    def ended(self) -> int:
        """Waits until a talker that speaks has said everything: so many messages."""
        sent = int(self.line())
        for topic in self._topics:
            self._master.remove(topic, "/talker")
        return sent

    def kill(self) -> None:
        """Ends it at once."""
        self._process.kill()
        with self._process:  # closes its pipe
            pass


@contextmanager
def speech(load: Load, master: FakeMaster) -> Iterator[Speech]:
    """A talker that speaks while the block runs."""
    found = Speech(load, master)
    try:
        found.line()
        yield found
    finally:
        found.kill()
