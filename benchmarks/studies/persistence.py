"""Study 2: what is kept of logs, published as they were recorded; Figure 5."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from benchmarks.samples import Sample
from benchmarks.studies.replays import LogSettings, Replay
from benchmarks.studies.runs import Context, chosen
from benchmarks.studies.throughput import short

STUDY = "persistence"
QUICK_SECONDS = 5.0


@dataclass(frozen=True, slots=True)
class Settings(LogSettings):
    """Which logs, how long, how often.

    Attributes:
        repetitions: Of each log with each backend.
    """

    log_seconds: float = 60.0
    repetitions: int = 3

    @classmethod
    def usual(cls, *, quick: bool) -> Settings:
        """Those of a full or of a quick run: the beginning of each log that is made, once."""
        return cls(log_seconds=QUICK_SECONDS, chosen=False, repetitions=1) if quick else cls()


def plan(context: Context, settings: Settings | None = None) -> list[Sample]:
    """All runs in the order in which they are done, those of the journal included.

    The backends take turns within a log, so that what disturbs the machine for a while
    hits all of them alike.
    """
    settings = settings or Settings.usual(quick=context.quick)
    return _plan(context, settings, settings.replays(context.seed))


def run(context: Context, settings: Settings | None = None) -> None:
    """Do what is still to be done."""
    settings = settings or Settings.usual(quick=context.quick)
    found = settings.replays(context.seed)
    by_name = {replay.name: replay for replay in found}
    for sample in _plan(context, settings, found):
        replay = by_name[sample.case["log"]]
        context.run(sample, partial(replay.load, context))


def _plan(context: Context, settings: Settings, found: Sequence[Replay]) -> list[Sample]:
    names = list(chosen(context.backends, settings.backends))
    return [
        Sample(STUDY, _case(replay.case, context.speed), name, repetition)
        for repetition in range(settings.repetitions)
        for replay in found
        for name in names
    ]


def _case(case: Mapping[str, Any], speed: float) -> dict[str, Any]:
    # Runs at another speed are others; at the usual one the case is that of the paper.
    return dict(case) if speed == 1 else {**case, "speed": short(speed)}
