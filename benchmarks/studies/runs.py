"""What the studies share: one run of one case, kept in the journal, done once."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.disturbance import MAX_RUNS, is_disturbed
from benchmarks.harness.run import Setting
from benchmarks.harness.run import run as run_load
from benchmarks.loads.base import Load
from benchmarks.progress import Progress
from benchmarks.samples import Journal, Sample, Scale, Status

if TYPE_CHECKING:
    from benchmarks.backends.base import Backend

_PART = "part-"
_DIGESTED_S = 500e6  # bytes a second of what a run has kept that the machine is done with,
_DIGESTING_S = 12.0  # and seconds after which it is done with all


@dataclass
class Context:
    """Where and how studies run.

    Attributes:
        work: Directory for loads (kept) and the data of runs (removed after each).
        backends: Those that take part, by name, in the order in which they take turns.
        journal: Where samples go, and where those lie that need not be run again.
        scale: How much is measured.
        seed: Of all loads.
        progress: Where steps are told.
        missing: Why backends are missing that were found so: they are not tried again.
        quiet_at: When the machine will be done with what the last run left, seconds of
            `time.monotonic`.
    """

    work: Path
    backends: Mapping[str, type[Backend]]
    journal: Journal
    scale: Scale = "full"
    seed: int = 1
    progress: Progress = field(default_factory=lambda: Progress(quiet=True))
    missing: dict[str, str] = field(default_factory=dict)
    quiet_at: float = 0.0

    def load(self, name: str, settings: Mapping[str, Any], make: Callable[[Path], Load]) -> Load:
        """A load that is made once.

        Args:
            name: What it is, for people who look into the work directory.
            settings: All that it depends on, values that JSON can hold.
            make: Makes it in an empty directory.
        """
        text = json.dumps([name, settings], sort_keys=True)
        place = self.work / "loads" / f"{name}-{sha256(text.encode()).hexdigest()[:16]}"
        if not Load.is_complete(place):
            place.parent.mkdir(parents=True, exist_ok=True)
            part = Path(tempfile.mkdtemp(prefix=_PART, dir=place.parent))
            try:
                make(part)
                shutil.rmtree(place, ignore_errors=True)
                part.rename(place)
            finally:
                shutil.rmtree(part, ignore_errors=True)
        return Load.open(place)

    def to_do(self, sample: Sample) -> bool:
        """Whether a run has still to be done.

        It is not in the journal as a success, or the machine disturbed it, and it has not
        been repeated often enough. Only a full run repeats any.
        """
        if not self.journal.has(sample):
            return True
        known = self.journal.samples[sample.key]
        return (
            self.scale == "full"
            and is_disturbed(known.values)
            and self.journal.successes(sample) < MAX_RUNS
        )

    def run(self, wanted: Sample, load: Callable[[], Load], *, speed: float = 1.0) -> Sample:
        """Run one case with one backend, unless the journal has it; again when disturbed.

        Args:
            wanted: Study, case, backend and repetition.
            load: Gives the load; called only when it is needed.
            speed: Times as fast as the load says.

        Returns:
            The sample, which is in the journal.
        """
        if not self.to_do(wanted):
            return self.journal.samples[wanted.key]
        reason = self.missing.get(wanted.backend)
        if reason is not None:
            sample = _filled(wanted, "missing", {}, reason)
            self.journal.add(sample)
            return sample
        while self.to_do(wanted):
            with self.progress.step(describe_run(wanted)):
                sample = self._run(wanted, load(), speed)
            self.journal.add(sample)
            if sample.status == "missing":
                self.missing[wanted.backend] = sample.reason
            if sample.status != "ok":
                return sample
        return self.journal.samples[wanted.key]

    def _run(self, wanted: Sample, load: Load, speed: float) -> Sample:
        backend = self.backends[wanted.backend]
        if self.scale == "full":
            time.sleep(max(self.quiet_at - time.monotonic(), 0))
        with run_directory(self.work) as directory:
            outcome = run_load(load, backend, directory, Setting(speed=speed))
        self.quiet_at = time.monotonic() + _digesting_s(outcome.values)
        values = {name: v for name, v in outcome.values.items() if name != "topics"}
        return _filled(wanted, outcome.status, values, outcome.reason)


def chosen(backends: Mapping[str, type[Backend]], names: Sequence[str]) -> dict[str, type[Backend]]:
    """Those of the backends that a study has, in its order."""
    return {name: backends[name] for name in names if name in backends}


def describe_run(sample: Sample) -> str:
    """A run in a line of progress."""
    case = ", ".join(f"{name} {value}" for name, value in sample.case.items())
    return f"{sample.study}: {sample.backend}, {case}, round {sample.repetition + 1}"


def _digesting_s(values: Mapping[str, Any]) -> float:
    """Seconds for which a machine may be busy with what a run has left behind.

    A virtual machine returns freed memory to its host bit by bit, every two seconds. The
    host then loses sight of the pages that are in use, too, and who touches them next pays
    for it: 100 to 300 ms of a run's first seconds, when the one before had kept gigabytes.
    """
    kept: float = values.get("persisted_bytes", 0)
    return min(kept / _DIGESTED_S, _DIGESTING_S)


@contextmanager
def run_directory(work: Path) -> Iterator[Path]:
    """An empty directory for one run, removed with all that is in it, however the run ends.

    What runs of processes that were killed have left behind goes, too.
    """
    runs = work / "runs"
    runs.mkdir(parents=True, exist_ok=True)
    for left in runs.iterdir():
        if not _is_alive(left.name.split("-")[0]):
            shutil.rmtree(left, ignore_errors=True)
    directory = Path(tempfile.mkdtemp(prefix=f"{os.getpid()}-", dir=runs))
    try:
        yield directory
    finally:
        shutil.rmtree(directory, ignore_errors=True)


def _is_alive(pid: str) -> bool:
    try:
        os.kill(int(pid), 0)
    except (ValueError, ProcessLookupError):
        return False
    except PermissionError:
        pass
    return True


def _filled(wanted: Sample, status: Status, values: Mapping[str, Any], reason: str) -> Sample:
    return replace(wanted, status=status, values=dict(values), reason=reason)
