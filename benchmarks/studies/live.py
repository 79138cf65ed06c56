"""Loads that a robot publishes to the recorder, and what must be there afterwards."""

from __future__ import annotations

import json
import os
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from benchmarks.numbers import percent, size
from benchmarks.samples import Sample, Status
from benchmarks.side import SideError
from benchmarks.studies.talker import TYPE, Load
from benchmarks.usage import cpu_s, rss, wait_for_mongods, with_children, working_below
from tests.imports import ROOT, SOURCE_ROOTS
from tests.live.sources.ros1_peers import FakeMaster

if TYPE_CHECKING:
    from benchmarks.studies.runs import Context

_STOP_S = 120.0
_START_S = 2.5


class Case(NamedTuple):
    """A load that a node publishes, and the options of `hybridlog record`."""

    load: Load
    options: tuple[str, ...]

    @property
    def about(self) -> str:
        """What it is."""
        load, options = self.load, " ".join(self.options)
        topics = f"{load.topics} topic{'s'[: load.topics > 1]} of {size(load.size)}"
        return f"{topics} at {load.hz:g} Hz, {load.megabytes_per_s:,.0f} MB/s, `{options}`"


# The budget is that of a machine with 2 GiB of memory.
CASES: dict[str, Case] = {
    "small": Case(Load(1, 500, 30_000, 15, queue=1000), ("--reserve", "0")),
    "large": Case(Load(12, 640_000, 128, 10), ("--reserve", "0")),
    "robot": Case(Load(20, 50_000, 50, 60), ("--budget", "128MiB", "--mongo", "none")),
    "indexed robot": Case(Load(20, 50_000, 50, 60), ("--budget", "128MiB")),
}


def run(context: Context, name: str) -> None:
    """Do a case."""
    case, reason = CASES[name], ""
    values: dict[str, object] = {}
    if context.scale != "full":
        case = case._replace(load=case.load._replace(seconds=4.0))
    with context.step(f"live: {case.about}"):
        try:
            values, missing = _recorded(case, context.work / "live")
            reason = f"{missing} messages are missing without a word" if missing else ""
        except SideError as error:
            reason = str(error)
    status: Status = "failed" if reason else "ok"
    context.journal.add(Sample("live", {"case": name}, "hybridlog", 0, status, values, reason))


def _recorded(case: Case, work: Path) -> tuple[dict[str, object], int]:
    """What came of a case, and how many messages are missing without a word."""
    load = case.load
    memory: list[int] = []
    servers: set[int] = set()
    with _recording(work, *case.options) as (recorder, said, master):
        with _speech(load, master) as talker:
            begin = time.monotonic()
            while time.monotonic() - begin < load.seconds - 1:
                time.sleep(1)
                memory.append(rss(with_children([recorder.pid])))
                servers = with_children(working_below(work / "store", "mongod"))
            sent = int(_line(talker))
            for topic in master.publishers:
                master.remove(topic, "/talker")
        time.sleep(1)
        used = cpu_s(servers) + cpu_s(with_children([recorder.pid]))
        report = _stopped(recorder, said)
    (recording,) = report["recordings"]
    stored = recording["messages"]
    causes = {cause: count for cause, count in report["lost"].items() if count}
    whole = stored - causes.get("degrade", 0)  # others are stored without their payload
    told = ", ".join(f"{cause} {count:,}" for cause, count in causes.items()) or "nothing"
    share = percent(100 * whole / sent)
    text = f"{whole:,} of {sent:,} stored whole ({share} %), {told} in the ledger"
    per_gb = used / (load.megabytes_per_s * load.seconds / 1000)
    late = statistics.median(memory[-max(len(memory) // 5, 1) :]) / 1e6
    lost = sent - stored - (sum(causes.values()) - causes.get("degrade", 0))
    not_indexed = 0 if "none" in case.options else stored - recording["messages_indexed"]
    return {"text": text, "s_per_gb": per_gb, "memory_mb": late}, lost + not_indexed


@contextmanager
def _recording(
    work: Path, *options: str
) -> Iterator[tuple[subprocess.Popen[bytes], Any, FakeMaster]]:
    """`hybridlog record --ros1` in an empty directory, what it prints, and its master."""
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    plain = {name: value for name, value in os.environ.items() if not name.startswith("ROS_")}
    sources = os.pathsep.join(map(str, SOURCE_ROOTS))
    command = [sys.executable, "-m", "hybridlog", "record", "--ros1", "--json"]
    try:
        with FakeMaster() as master, tempfile.TemporaryFile("w+") as said, ExitStack() as stack:
            node = {"ROS_MASTER_URI": master.uri, "ROS_IP": "127.0.0.1", "PYTHONPATH": sources}
            recorder = subprocess.Popen(
                [*command, "--store", str(work / "store"), *options],
                env={**plain, **node},
                stdout=said,
                stderr=subprocess.DEVNULL,
                cwd=work,
                start_new_session=True,
            )
            stack.callback(recorder.wait)
            stack.callback(recorder.kill)
            time.sleep(_START_S)
            yield recorder, said, master
    finally:
        with suppress(TimeoutError):
            wait_for_mongods(work)
        shutil.rmtree(work, ignore_errors=True)


def _stopped(recorder: subprocess.Popen[bytes], said: Any) -> dict[str, Any]:
    """End a recorder; what it says of itself."""
    recorder.send_signal(signal.SIGTERM)
    try:
        recorder.wait(_STOP_S)
    except subprocess.TimeoutExpired:
        raise SideError(f"hybridlog record did not end within {_STOP_S:g} s") from None
    said.seek(0)
    last = json.loads(said.read().splitlines()[-1])
    if recorder.returncode or "report" not in last:
        raise SideError(f"hybridlog record ended with {recorder.returncode}")
    report: dict[str, Any] = last["report"]
    return report


@contextmanager
def _speech(load: Load, master: FakeMaster) -> Iterator[subprocess.Popen[str]]:
    """A talker, known to a master, that speaks while the block runs."""
    command = [sys.executable, "-m", "benchmarks.studies.talker", json.dumps(load)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT) as talker:
        try:
            uri = _line(talker)
            for number in range(load.topics):
                master.add(f"/t{number}", TYPE, "/talker", uri)
            _line(talker)
            yield talker
        finally:
            talker.kill()


def _line(talker: subprocess.Popen[str]) -> str:
    """What it says next: where it is, that it speaks, how many messages it has sent."""
    assert talker.stdout is not None
    line = talker.stdout.readline()
    if not line:
        raise SideError("the talker has ended: nobody listened")
    return line.strip()
