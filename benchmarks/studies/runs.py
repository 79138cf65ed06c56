"""What the studies share: one run of one case, kept in the journal."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.harness.run import run as run_load
from benchmarks.loads.base import Load
from benchmarks.progress import Progress
from benchmarks.samples import Journal, Sample, Scale

if TYPE_CHECKING:
    from benchmarks.backends.base import Backend

_DIGESTED_S = 500e6  # bytes a second of what a run has kept that the machine is done with,
_DIGESTING_S = 12.0  # and seconds after which it is done with all


@dataclass
class Context:
    """Where and how studies run.

    Attributes:
        work: Directory for loads (kept) and the data of runs (removed after each).
        backends: Those that take part, by name, in the order in which they take turns.
        journal: Where samples go.
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
        place = self.work / "loads" / "-".join(map(str, [name, *settings.values()]))
        if not place.exists():
            place.mkdir(parents=True)
            make(place)
        return Load.open(place)

    def run(self, wanted: Sample, load: Callable[[], Load], *, speed: float = 1.0) -> Sample:
        """Run one case with one backend.

        Args:
            wanted: Study, case, backend and repetition.
            load: Gives the load; called only when it is needed.
            speed: Times as fast as the load says.

        Returns:
            The sample, which is in the journal.
        """
        reason = self.missing.get(wanted.backend)
        if reason is not None:
            sample = replace(wanted, status="missing", reason=reason)
        else:
            with self.progress.step(_described(wanted)):
                sample = self._run(wanted, load(), speed)
        if sample.status == "missing":
            self.missing[wanted.backend] = sample.reason
        self.journal.add(sample)
        return sample

    def _run(self, wanted: Sample, load: Load, speed: float) -> Sample:
        backend = self.backends[wanted.backend]
        if self.scale == "full":
            time.sleep(max(self.quiet_at - time.monotonic(), 0))
        with run_directory(self.work) as directory:
            outcome = run_load(load, backend, directory, speed)
        self.quiet_at = time.monotonic() + _digesting_s(outcome.values)
        values = {name: v for name, v in outcome.values.items() if name != "topics"}
        return replace(wanted, status=outcome.status, values=values, reason=outcome.reason)


def _described(sample: Sample) -> str:
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
    """An empty directory for one run, removed with all that is in it, however the run ends."""
    work.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(dir=work, ignore_cleanup_errors=True) as directory:
        yield Path(directory)
