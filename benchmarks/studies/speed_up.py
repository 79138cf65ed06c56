"""How much faster than it was recorded a log may be published until a backend drops."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from benchmarks.numbers import Spread
from benchmarks.samples import Sample
from benchmarks.studies.replays import MADE, LogSettings, Replay
from benchmarks.studies.runs import Context, chosen
from benchmarks.studies.search import (
    Bounds,
    Search,
    Trial,
    bracket,
    is_over,
    take_turns,
    verdict,
)
from benchmarks.studies.throughput import short

STUDY = "speed-up"
QUICK_SECONDS = 5.0

_SPEED = "speed"


@dataclass(frozen=True, slots=True)
class Settings(LogSettings):
    """How the speeds are looked for.

    Attributes:
        start: Speed of the first trial, times that of the recording.
        lowest: No speed below is tried: what is lost in real time is study 2.
        highest: No speed above is tried.
        halvings: Of the gap between the speeds that was kept and that was not.
        repetitions: Of each search.
    """

    log_seconds: float = 20.0
    start: float = 1.0
    lowest: float = 1.0
    highest: float = 256.0
    halvings: int = 2
    repetitions: int = 3

    def __post_init__(self) -> None:
        """Refuse speeds at which nothing can be published."""
        if not 0 < self.lowest <= self.start <= self.highest:
            raise ValueError(
                f"speeds from {self.lowest:g} by {self.start:g} to {self.highest:g}; "
                "give them above 0 and ascending"
            )

    @classmethod
    def usual(cls, *, quick: bool) -> Settings:
        """Those of a full or of a quick run: one log, and only roughly."""
        if not quick:
            return cls()
        return cls(
            log_seconds=QUICK_SECONDS,
            made=MADE[:1],
            chosen=False,
            start=4.0,
            highest=64.0,
            halvings=0,
            repetitions=1,
        )


def speeds(
    samples: Iterable[Sample], settings: Callable[[Sample], Mapping[str, Any]]
) -> dict[tuple[str, str], tuple[Spread, bool]]:
    """The greatest speed at which a backend kept all of a log.

    Args:
        samples: Of any study.
        settings: Those of this study in the run of a sample.

    Returns:
        By backend and log: the speed in the searches, 0 when something was lost at every
        speed; and whether it may be above, since no higher one was planned or published.
    """
    searches: dict[tuple[str, str], dict[int, list[Sample]]] = {}
    for one in samples:
        if one.study == STUDY and one.status != "missing":
            of = searches.setdefault((one.backend, str(one.case["log"])), {})
            of.setdefault(one.repetition, []).append(one)
    found = {}
    for place, of in searches.items():
        greatest, is_above = [], False
        for trials in of.values():
            verdicts = {float(trial.case[_SPEED]): verdict(trial) for trial in trials}
            kept = {speed: shown == "kept" for speed, shown in verdicts.items()}
            speed, lost = bracket(kept)
            greatest.append(speed or 0.0)
            over = is_over(kept, settings(trials[-1]))
            is_above |= not over or lost is None or verdicts[lost] == "late"
        spread = Spread.of(greatest)
        assert spread is not None
        found[place] = (spread, is_above)
    return found


def run(context: Context, settings: Settings | None = None) -> None:
    """Look for the speeds that are not known yet; the backends take turns."""
    settings = settings or Settings.usual(quick=context.quick)
    for replay in settings.replays(context.seed):
        for searches in _rounds(context, settings, replay):
            take_turns(context, searches)


def _rounds(context: Context, settings: Settings, replay: Replay) -> Iterator[list[Search]]:
    """All backends' searches for one log."""
    names = list(chosen(context.backends, settings.backends))
    for repetition in range(settings.repetitions):
        yield [
            _search(context, settings, name, replay, repetition)
            for name in names
            if name not in context.missing
        ]


def _search(
    context: Context, settings: Settings, name: str, replay: Replay, repetition: int
) -> Search:
    def trial(speed: float) -> Trial:
        case = {**replay.case, _SPEED: short(speed)}
        load = partial(replay.load, context)
        return Trial(Sample(STUDY, case, name, repetition), load, speed)

    bounds = Bounds(settings.start, settings.lowest, settings.highest, settings.halvings)
    return Search(_SPEED, bounds, trial)
