"""How much faster than it was recorded a log may be published until a backend drops.

The speed is doubled until something is lost, then the gap is halved twice. Each trial
is a sample, and what to try next follows from the samples alone, so a search that was
stopped goes on where it was.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import partial
from typing import Any

from benchmarks.samples import Sample
from benchmarks.studies.ceiling import next_rate, verdict
from benchmarks.studies.replays import MADE, LogSettings, Replay
from benchmarks.studies.runs import RUN_OVERHEAD_S, Context, chosen
from benchmarks.studies.throughput import short

STUDY = "speed-up"
QUICK_SECONDS = 5.0

_TRIALS = 6
"""About how many trials a search takes."""


@dataclass(frozen=True, slots=True)
class Settings(LogSettings):
    """How the speeds are looked for.

    Attributes:
        start: Speed of the first trial, times that of the recording.
        lowest: No speed below is tried: what is lost in real time is study 2.
        highest: No speed above is tried.
        halvings: Of the gap between the speeds that was kept and that was not.
    """

    seconds: float = 20.0
    start: float = 1.0
    lowest: float = 1.0
    highest: float = 256.0
    halvings: int = 2

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
            seconds=QUICK_SECONDS, made=MADE[:1], chosen=False, start=4.0, highest=64.0, halvings=0
        )

    def header(self) -> dict[str, Any]:
        """What a journal says of these settings."""
        return {STUDY: self.to_json()}


def expected_seconds(context: Context, settings: Settings | None = None) -> float:
    """About how long the searches take that are not at their end."""
    settings = settings or Settings.usual(quick=context.quick)
    total = 0.0
    for replay in settings.replays(context.seed):
        for name in chosen(context.backends, settings.backends):
            if next_speed(context, settings, name, replay) is not None:
                # Each trial takes half as long as the one before.
                total += 2 * replay.seconds / settings.start + _TRIALS * RUN_OVERHEAD_S
    return total


def run(context: Context, settings: Settings | None = None) -> None:
    """Look for the speeds that are not known yet; the backends take turns.

    Raises:
        SourceError: There is no log at a path, or nothing of it can be read.
        ValueError: A backend or a log is not known.
    """
    settings = settings or Settings.usual(quick=context.quick)
    names = list(chosen(context.backends, settings.backends))
    for replay in settings.replays(context.seed):
        # A trial that failed is tried again by the next process, not by this one.
        failed: set[str] = set()
        waiting = [name for name in names if name not in context.missing]
        while waiting:
            waiting = [name for name in waiting if _try(context, settings, name, replay, failed)]


def next_speed(
    context: Context,
    settings: Settings,
    name: str,
    replay: Replay,
    failed: Collection[str] = (),
) -> float | None:
    """The speed that a backend is to be tried with next.

    Args:
        context: Its journal holds the trials so far.
        settings: How it is looked for.
        name: Of the backend.
        replay: The log.
        failed: Keys of the trials that count although they failed.

    Returns:
        None at the end of the search.
    """
    kept = {}
    for sample in context.journal.samples.values():
        if (sample.study, sample.backend) != (STUDY, name) or "speed" not in sample.case:
            continue
        if sample.status != "ok" and sample.key not in failed:
            continue
        speed = float(sample.case["speed"])
        if sample.key == _sample(name, replay, speed).key:
            kept[speed] = verdict(sample) == "kept"
    return next_rate(
        kept,
        start=settings.start,
        lowest=settings.lowest,
        highest=settings.highest,
        halvings=settings.halvings,
    )


def _try(context: Context, settings: Settings, name: str, replay: Replay, failed: set[str]) -> bool:
    """Do the next trial of a backend.

    Returns:
        Whether there was one to do.
    """
    speed = next_speed(context, settings, name, replay, failed)
    if speed is None:
        return False
    found = context.run(
        _sample(name, replay, speed),
        partial(replay.load, context),
        seconds=replay.seconds / speed + RUN_OVERHEAD_S,
        speed=speed,
    )
    if found.status == "failed":
        failed.add(found.key)
    return found.status != "missing"


def _sample(name: str, replay: Replay, speed: float) -> Sample:
    return Sample(STUDY, {**replay.case, "speed": short(speed)}, name, 0)
