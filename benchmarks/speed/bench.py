"""What a study works with: its inputs, its sides, and where its results go."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.memory import wait_for_mongods
from benchmarks.side import LINGER_S, Values, run_side
from benchmarks.speed.results import Finding, Outcome, Sample, figure

if TYPE_CHECKING:
    from benchmarks.progress import Steps

PEAK_LIMIT_MB = 400
GROWTH_LIMIT = 1.15
"""What a longer log may add to the peak: less than a hundred megabytes grown by a sixth
are buffers that happened to be full at once, not memory that grows with the recording."""


@dataclass(frozen=True, slots=True)
class Settings:
    """How a run is done.

    Attributes:
        quick: Small inputs.
        repetitions: Of every side.
        seed: Of all inputs.
        work: Directory for inputs, stores and databases.
    """

    quick: bool
    repetitions: int
    seed: int
    work: Path


class Bench:
    """The run of one study.

    Args:
        study: Its name.
        settings: How.
        outcome: Where the results go.
        steps: Where the progress goes.
        step_s: About the seconds that a step of this study takes.
    """

    def __init__(
        self, study: str, settings: Settings, outcome: Outcome, steps: Steps, step_s: float
    ) -> None:
        self.study = study
        self.settings = settings
        self.samples: list[Sample] = []
        self._outcome = outcome
        self._steps = steps
        self._step_s = step_s
        self._keeps_mongod = False

    @property
    def repetitions(self) -> range:
        """Numbers of the repetitions."""
        return range(self.settings.repetitions)

    def size(self, full: int, quick: int) -> int:
        """How much of something, in a full and in a quick run."""
        return quick if self.settings.quick else full

    def place(self, name: str) -> Path:
        """A path of this study in the work directory; what is there is removed."""
        path = self.settings.work / f"{self.study}-{name}"
        discard(path)
        return path

    def input(self, name: str, make: Callable[[Path], None]) -> Path:
        """An input file; made unless an earlier run has left it. Its name says all of it."""
        path = self.settings.work / "inputs" / f"seed{self.settings.seed}-{name}"
        if not path.exists():
            path.parent.mkdir(exist_ok=True)
            with self._steps.step(f"{self.study}: making {name}", 0):
                part = path.with_name(f"part-{path.name}")
                discard(part)
                make(part)
                part.rename(path)
        return path

    def run(
        self,
        side: str,
        function: str,
        arguments: Mapping[str, object],
        *,
        warm: Sequence[Path] = (),
        repetition: int = 0,
    ) -> Values:
        """Run one side once, and keep what it found as a sample."""
        with self._steps.step(f"{self.study}: {side}, {repetition + 1}", self._step_s):
            values = run_side(f"benchmarks.speed.{function}", arguments, warm)
            if not self._keeps_mongod:
                # It would take its share of the processor from the next side.
                wait_for_mongods(self.settings.work)
        self.keep(side, repetition, values)
        return values

    @contextmanager
    def mongod_up(self, store: Path) -> Iterator[None]:
        """Keeps the mongod of a store up, as another user of the store would."""
        from hybridlog_storage.mongod import EmbeddedMongod

        self._keeps_mongod = True
        try:
            with EmbeddedMongod(store / "mongod", linger_s=LINGER_S):
                yield
        finally:
            self._keeps_mongod = False
            wait_for_mongods(store)

    def keep(self, side: str, repetition: int, values: Values) -> None:
        """Keep a sample."""
        sample = Sample(self.study, side, repetition, values)
        self.samples.append(sample)
        self._outcome.samples.append(sample)

    def find(self, finding: Finding) -> None:
        """Keep a finding."""
        self._outcome.findings.append(finding)

    def find_peak(self, side: str, about: str) -> None:
        """The greatest peak memory of our side, against the limit."""
        peaks = [s.values["peak_rss"] / 1e6 for s in self.samples if s.side == side]
        found = figure(self.study, about, [max(peaks)], "MB", target=PEAK_LIMIT_MB)
        self.find(found)

    def find_growth(self, whole: str, part: str, times: int) -> None:
        """Peak memory at the full length over that at a part of it.

        Args:
            whole: Side that ran over the full length.
            part: Side that ran over less.
            times: How much longer the full length is.
        """
        peaks = {
            side: max(s.values["peak_rss"] for s in self.samples if s.side == side)
            for side in (whole, part)
        }
        about = f"peak memory at {times} times the length over that at once the length"
        values = [peaks[whole] / peaks[part]]
        self.find(figure(self.study, about, values, "x", target=GROWTH_LIMIT, relation="<="))

    def agree(self, first: object, second: object, what: str) -> None:
        """Two sides must have given the same answer.

        Raises:
            AssertionError: They have not, so their times mean nothing.
        """
        if first != second:
            raise AssertionError(f"{self.study}: {what} differ: {first} and {second}")


def discard(path: Path) -> None:
    """Remove a file or a directory, if it is there."""
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
