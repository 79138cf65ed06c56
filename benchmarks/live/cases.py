"""Loads that a robot publishes to the recorder, and what must be there afterwards."""

from __future__ import annotations

import shutil
import statistics
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from benchmarks.live.recorders import Kept, Recorder, speech
from benchmarks.live.talker import Load
from benchmarks.numbers import percent, size
from benchmarks.samples import Sample, Status
from benchmarks.side import SideError
from benchmarks.usage import cpu_s, rss, wait_for_mongods, with_children, working_below
from tests.live.sources.ros1_peers import FakeMaster

if TYPE_CHECKING:
    from benchmarks.studies.runs import Context

STUDY = "live"


class Case(NamedTuple):
    """A load, and how it is recorded.

    Attributes:
        load: What a node publishes.
        options: Of `hybridlog record`.
    """

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
    """Do a case.

    Args:
        context: Where and how.
        name: Key of `CASES`.
    """
    case, reason = CASES[name], ""
    values: dict[str, object] = {}
    if context.scale != "full":
        case = case._replace(load=case.load._replace(seconds=4.0))
    with context.progress.step(f"live: {case.about}"):
        try:
            values, missing = _recorded(case, context.work / "live")
            reason = f"{missing} messages are missing without a word" if missing else ""
        except SideError as error:
            reason = str(error)
    status: Status = "failed" if reason else "ok"
    context.journal.add(Sample(STUDY, {"case": name}, "hybridlog", 0, status, values, reason))


def _recorded(case: Case, work: Path) -> tuple[dict[str, object], int]:
    """What came of a case, and how many messages are missing without a word."""
    load = case.load
    memory: list[int] = []
    servers: set[int] = set()
    with _recording(work, *case.options) as (running, master):
        with speech(load, master) as talker:
            begin = time.monotonic()
            while time.monotonic() - begin < load.seconds - 1:
                time.sleep(1)
                memory.append(rss(with_children([running.process.pid])))
                servers = with_children(working_below(work / "store", "mongod"))
            sent = talker.ended()
        time.sleep(1)
        database_s = cpu_s(servers)
        kept = running.stop()
    per_gb = (kept.cpu_s + database_s) / (load.megabytes_per_s * load.seconds / 1000)
    late = statistics.median(memory[-max(len(memory) // 5, 1) :]) / 1e6
    values = {"text": _told(sent, kept), "s_per_gb": per_gb, "memory_mb": late}
    not_indexed = 0 if kept.indexed is None else kept.stored - kept.indexed
    return values, sent - kept.stored - kept.told + not_indexed


def _told(sent: int, kept: Kept) -> str:
    told = ", ".join(f"{cause} {count:,}" for cause, count in kept.causes.items())
    whole = kept.stored - kept.reduced
    share = percent(100 * whole / sent)
    return f"{whole:,} of {sent:,} stored whole ({share} %), {told or 'nothing'} in the ledger"


@contextmanager
def _recording(work: Path, *options: str) -> Iterator[tuple[Recorder, FakeMaster]]:
    """A recorder in an empty directory, and its master; nothing of them is left afterwards."""
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    try:
        with (
            FakeMaster() as master,
            closing(Recorder(work / "store", master.uri, *options)) as running,
        ):
            yield running, master
    finally:
        with suppress(TimeoutError):
            wait_for_mongods(work)
        shutil.rmtree(work, ignore_errors=True)
