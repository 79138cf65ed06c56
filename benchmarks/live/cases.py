"""The cases: each a load, what may go wrong with it, and what must be there afterwards."""

from __future__ import annotations

import random
import shutil
import signal
import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from os import kill
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from benchmarks.live.recorders import Kept, Recorder, speech
from benchmarks.live.talker import Data, Load
from benchmarks.numbers import percent, size
from benchmarks.samples import Sample, Status
from benchmarks.side import SideError
from benchmarks.usage import cpu_s, rss, wait_for_mongods, with_children, working_below
from tests.live.sources.ros1_peers import FakeMaster

if TYPE_CHECKING:
    from benchmarks.studies.runs import Context

STUDY = "live"
_FLUSH_S = 1.0
"""The recorder's own interval between flushes, as it is by default."""


class Row(NamedTuple):
    """What a recorder did with a load.

    Attributes:
        case: Which case.
        recorder: Whose.
        text: What came of it.
        holds: Nothing is missing without a word, and what was damaged came back.
    """

    case: str
    recorder: str
    text: str
    holds: bool


class Case(NamedTuple):
    """One case.

    Attributes:
        about: What it is.
        run: Does it in a directory, fully or quickly.
    """

    about: str
    run: Callable[[Path, bool], Iterator[Row]]


def _plain(name: str, load: Load) -> Case:
    """A load and nothing else."""

    def run(work: Path, quick: bool) -> Iterator[Row]:  # noqa: FBT001 - one shape for all cases
        said = load._replace(seconds=2.0) if quick else load
        with _recording(work, "--reserve", "0") as (running, master):
            with speech(said, master) as talker:
                sent = talker.ended()
            time.sleep(1)
            yield _row(name, "hybridlog", sent, running.stop())

    about = (
        f"{load.topics} topic{'s'[: load.topics > 1]} of {size(load.size)} at {load.hz:g} Hz, "
        f"{load.megabytes_per_s:,.0f} MB/s"
    )
    return Case(about, run)


def _row(name: str, recorder: str, sent: int, kept: Kept) -> Row:
    missing = sent - kept.stored - kept.told
    not_indexed = 0 if kept.indexed is None else kept.stored - kept.indexed
    told = ", ".join(f"{cause} {count:,}" for cause, count in kept.causes.items())
    whole = kept.stored - kept.reduced
    text = (
        f"{whole:,} of {sent:,} stored whole ({percent(100 * whole / sent)} %), "
        f"{told or 'nothing'} in the ledger, {missing:,} missing without a word"
    )
    return Row(name, recorder, text, missing == 0 and not_indexed == 0)


def _stopped_database(work: Path, quick: bool) -> Iterator[Row]:  # noqa: FBT001
    """mongod is halted, later killed, while a robot speaks."""
    pause = 3.0 if quick else 10.0
    load = Load(20, 40_000, 50, 2 * pause + 4)
    for how in ("halted", "killed"):
        case = f"mongod {how} for {pause:g} s" if how == "halted" else "mongod killed"
        with _recording(work, "--reserve", "0") as (running, master):
            with speech(load, master) as talker:
                time.sleep(2)
                _disturb(work / "store", how, pause)
                sent = talker.ended()
            yield _row(case, "hybridlog", sent, running.stop())


def _disturb(store: Path, how: str, pause: float) -> None:
    servers = working_below(store, "mongod")
    if not servers:
        raise SideError("the recorder has no mongod of its own")
    for server in servers:
        kill(server, signal.SIGSTOP if how == "halted" else signal.SIGKILL)
    if how == "halted":
        time.sleep(pause)
        for server in servers:
            kill(server, signal.SIGCONT)


def _kills(work: Path, quick: bool) -> Iterator[Row]:  # noqa: FBT001
    """kill -9 at random moments."""
    load = Load(20, 40_000, 100, 0)
    moments = random.Random(1)
    lost_s, stored, wrong = [], 0, 0
    count = 3 if quick else 15
    for _ in range(count):
        with _recording(work, "--reserve", "0") as (running, master):
            with speech(load, master):
                time.sleep(moments.uniform(0, 6))
                killed_ns = running.kill()
            behind, messages, faults = _recovered(work / "store", load, killed_ns)
            if messages:
                lost_s.append(behind)
            stored += messages
            wrong += faults
    worst = max(lost_s, default=0.0)
    usual = statistics.median(lost_s) if lost_s else 0.0
    text = (
        f"{count} kills: {stored:,} messages came back, {wrong} of them wrong or out of order; "
        f"the last one was {usual:.2f} s old at the kill, {worst:.2f} s at most"
    )
    yield Row("kill -9", "hybridlog", text, wrong == 0 and worst < 2 * _FLUSH_S)


def _recovered(store: Path, load: Load, killed_ns: int) -> tuple[float, int, int]:
    """Age in seconds of the last message at the kill, messages, and faults among them."""
    import hybridlog

    data = Data(load.size)
    last_ns, wrong = 0, 0
    before: dict[str, int] = defaultdict(int)
    with hybridlog.open(store) as opened:
        messages = 0
        for message in opened.all_topics():
            raw = bytes(message.raw)
            sequence = int.from_bytes(raw[:4], "little")
            wrong += sequence != before[message.topic] + 1 or raw[20:] != data.of(sequence)
            before[message.topic] = sequence
            last_ns = max(last_ns, message.log_time_ns)
            messages += 1
        wrong += len(opened.verify().findings)
    return (killed_ns - last_ns) / 1e9, messages, wrong


def _robot(work: Path, quick: bool) -> Iterator[Row]:  # noqa: FBT001
    """Memory and processor time at the rate of a robot, without and with MongoDB.

    The budget is that of a machine with 2 GiB of memory.
    """
    load = Load(20, 50_000, 50, 10.0 if quick else 60.0)
    for mongo, recorder in (("none", "hybridlog --mongo none"), ("embedded", "hybridlog")):
        yield _watched(recorder, load, work, "--mongo", mongo, "--budget", "128MiB")


def _watched(name: str, load: Load, work: Path, *options: str) -> Row:
    """A load to ours alone, and its memory meanwhile."""
    seconds = load.seconds
    recorder: list[int] = []
    servers: set[int] = set()
    with _recording(work, *options) as (running, master):
        with speech(load, master) as talker:
            begin = time.monotonic()
            while time.monotonic() - begin < seconds - 1:
                time.sleep(1)
                recorder.append(rss(with_children([running.process.pid])))
                servers = with_children(working_below(work / "store", "mongod"))
            sent = talker.ended()
        database_s = cpu_s(servers)
        kept = running.stop()
    row = _row("robot", name, sent, kept)
    fifth = max(len(recorder) // 5, 1)
    early, late = (
        statistics.median(part) / 1e6 for part in (recorder[fifth : 2 * fifth], recorder[-fifth:])
    )
    per_gb = (kept.cpu_s + database_s) / (load.megabytes_per_s * seconds / 1000)
    text = (
        f"{per_gb:.1f} s of processor time a gigabyte; "
        f"{load.megabytes_per_s:.0f} MB/s for {seconds:.0f} s: {early:.0f} MB in the second "
        f"fifth, {late:.0f} MB in the last, {max(recorder) / 1e6:.0f} MB at most; {row.text}"
    )
    return row._replace(text=text, holds=row.holds and late < 1.1 * early + 20)


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


CASES: dict[str, Case] = {
    "small": _plain("small", Load(1, 500, 30_000, 15, queue=1000)),
    "large": _plain("large", Load(12, 640_000, 128, 10)),
    "database": Case("mongod halted, and killed", _stopped_database),
    "kills": Case("kill -9 at random moments under 80 MB/s", _kills),
    "robot": Case("50 MB/s, --budget 128MiB, without and with MongoDB", _robot),
}


def run(context: Context, name: str) -> None:
    """Do a case.

    Args:
        context: Where and how.
        name: Key of `CASES`.
    """
    wanted = Sample(STUDY, {"case": name}, "hybridlog", 0)
    case, rows, reason = CASES[name], [], ""
    with context.progress.step(f"live: {case.about}"):
        try:
            rows = list(case.run(context.work / "live", context.scale != "full"))
        except SideError as error:
            reason = str(error)
    reason = reason or "; ".join(row.text for row in rows if not row.holds)
    status: Status = "failed" if reason else "ok"
    values = {"rows": [row._asdict() for row in rows]}
    context.journal.add(replace(wanted, status=status, values=values, reason=reason))
