"""How much faster than it was recorded the log of a robot may be published until some is lost."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from benchmarks.loads.robot import robot_load
from benchmarks.samples import Sample, Scale
from benchmarks.studies.record import short
from benchmarks.studies.runs import Context
from benchmarks.studies.search import Bounds, Search, take_turns

if TYPE_CHECKING:
    from benchmarks.loads.base import Load

STUDY = "logs"


class Settings(NamedTuple):
    """How speeds are looked for.

    Attributes:
        seconds: Of the log, in its own time.
        bounds: Speeds, times that of the recording.
    """

    seconds: int
    bounds: Bounds


SETTINGS: dict[Scale, Settings] = {
    "full": Settings(20, Bounds(2.0, 0.5, 256.0, 1)),
    "tiny": Settings(1, Bounds(2.0, 2.0, 2.0, 0)),
}


def run(context: Context, repetition: int) -> None:
    """Look for the greatest speeds; the backends take turns."""
    seconds, bounds = SETTINGS[context.scale]

    def search(name: str) -> Search:
        def trial(speed: float) -> Sample:
            case = {"seconds": seconds, "speed": short(speed)}
            load = partial(make_load, context, seconds)
            return context.run(Sample(STUDY, case, name, repetition), load, speed=speed)

        return Search(bounds, trial)

    take_turns([search(name) for name, kind in context.backends.items() if kind.records])


def make_load(context: Context, seconds: int) -> Load:
    """The log, made once."""
    about = {"seconds": seconds, "seed": context.seed}

    def make(directory: Path) -> Load:
        return robot_load(directory, seconds=seconds, seed=context.seed)

    return context.load("robot", about, make)
