"""How much a backend can take: the largest offered load of which nothing is lost.

Streams of twenty topics with messages of one size, whose first trial of 64 Hz a topic shows
memory, disk and processor time; and the log of a robot, published faster than it was recorded.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

from benchmarks.loads import streams
from benchmarks.loads.robot import robot_load
from benchmarks.samples import Sample, Scale
from benchmarks.studies.runs import Context

if TYPE_CHECKING:
    from benchmarks.loads.base import Load


class Bounds(NamedTuple):
    """Where a search looks: its first rate, and the least and greatest that it tries."""

    start: float
    lowest: float
    highest: float


HARNESS = "nothing"
"""The backend that shows what the harness itself can carry."""
SIZES = (5_000, 40_000, 640_000)
"""Bytes of a message."""
TOPICS = 20
START = 64.0
"""Rate of the first trial, messages a second on each topic."""
STREAMS: dict[Scale, tuple[float, int, Bounds]] = {
    "full": (5.0, 60, Bounds(START, 1.0, 16_384.0)),
    "tiny": (0.1, 3, Bounds(START, START, START)),
}
"""Seconds of publishing in a trial; messages on each topic at least, much more than a queue holds,
or the queue would take the whole trial; and the rates."""
LOGS: dict[Scale, tuple[int, Bounds]] = {
    "full": (20, Bounds(2.0, 0.5, 256.0)),
    "tiny": (1, Bounds(2.0, 2.0, 2.0)),
}
"""Seconds of the log, in its own time, and the speeds, times that of the recording."""


def stream(context: Context, size: int, repetition: int) -> None:
    """Look for the ceilings of messages of a size; the backends take turns."""
    seconds, least, bounds = STREAMS[context.scale]

    def trial(name: str, rate: float) -> Sample:
        messages = max(math.ceil(rate * seconds), least)
        case = {"size": size, "rate": short(rate), "topics": TOPICS, "messages": messages}
        load = partial(_make_stream, context, size=size, rate=rate, messages=messages)
        return context.run(Sample("record", case, name, repetition), load)

    _search(context, bounds, trial)


def play(context: Context, repetition: int) -> None:
    """Look for the greatest speeds of the robot's log; the backends take turns."""
    seconds, bounds = LOGS[context.scale]

    def trial(name: str, speed: float) -> Sample:
        case = {"seconds": seconds, "speed": short(speed)}
        load = partial(robot_log, context, seconds)
        return context.run(Sample("logs", case, name, repetition), load, speed=speed)

    _search(context, bounds, trial)


def _search(context: Context, bounds: Bounds, trial: Callable[[str, float], Sample]) -> None:
    names = [name for name, kind in context.backends.items() if kind.records]
    take_turns([Search(bounds, partial(trial, name)) for name in names])


def robot_log(context: Context, seconds: int) -> Load:
    """The log of a robot, made once."""
    about = {"seconds": seconds, "seed": context.seed}
    return context.load("robot", about, lambda place: robot_load(place, **about))


def _make_stream(context: Context, *, size: int, rate: float, messages: int) -> Load:
    """A stream, made once; streams of a size share their payloads."""
    about = {"size": size, "topics": TOPICS, "messages": messages, "seed": context.seed}
    count = streams.pool_messages(size, TOPICS, messages)
    pool = context.work / "loads" / f"pool-{size}-{count}-{context.seed}.bin"

    def make(directory: Path) -> Load:
        shared = pool if pool.exists() else None
        made = streams.stream(directory, rate=rate, pool=shared, **about)
        if shared is None:
            os.link(made.payloads, pool)
        return made

    return context.load(f"stream-{rate:g}", about, make)


def short(number: float) -> float:
    """64 and not 64.0: two spellings of a case would be two cases."""
    return int(number) if number == int(number) else number


# The search for the greatest rate at which a backend still keeps everything. The rate is doubled
# until something is lost, then the gap is halved once. Chance decides about the last trials, so
# each search is made twice where there is time, and begins anew.

Verdict = Literal["kept", "lost", "late"]
"""`late`: the publisher could not keep its own schedule, so the load was not offered."""

_LATE_SHARE = 0.05
_LATE_S = 0.1


@dataclass(frozen=True, slots=True)
class Search:
    """One search of one backend.

    Attributes:
        bounds: Where it looks.
        trial: Does the trial at a rate.
        kept: Of the rates that were tried, whether all was kept.
    """

    bounds: Bounds
    trial: Callable[[float], Sample]
    kept: dict[float, bool] = field(default_factory=dict)


def verdict(sample: Sample) -> Verdict:
    """What a trial shows."""
    values = sample.values
    if sample.status != "ok" or values["persisted"] < values["published"]:
        return "lost"
    late = values["publish_s"] - values["due_s"]
    return "late" if late > _LATE_SHARE * values["due_s"] + _LATE_S else "kept"


def bracket(kept: Mapping[float, bool]) -> tuple[float | None, float | None]:
    """The greatest rate that was kept below all that were not, and the least that was not.

    Luck above a loss does not count.
    """
    lost = min((rate for rate, good in kept.items() if not good), default=None)
    below = (rate for rate, good in kept.items() if good and (lost is None or rate < lost))
    return max(below, default=None), lost


def next_rate(kept: Mapping[float, bool], bounds: Bounds) -> float | None:
    """The rate to try next; None when the search is over."""
    best, lost = bracket(kept)
    if best is None and lost is None:
        return bounds.start
    if best is None:
        assert lost is not None
        return lost / 2 if lost / 2 >= bounds.lowest else None
    if lost is None:
        return best * 2 if best * 2 <= bounds.highest else None
    return best * 1.5 if best * 1.5 < lost else None


def take_turns(searches: Iterable[Search]) -> None:
    """Do searches, which take turns."""
    waiting = list(searches)
    while waiting:
        waiting = [search for search in waiting if _try(search)]


def _try(search: Search) -> bool:
    """Do the next trial of a search; returns whether there was one."""
    rate = next_rate(search.kept, search.bounds)
    if rate is None:
        return False
    found = search.trial(rate)
    search.kept[rate] = verdict(found) == "kept"
    return found.status != "missing"


class Found(NamedTuple):
    """The end of one search.

    Attributes:
        rate: The greatest of which all was persisted; None when something was always lost.
        best: The trial at that rate.
        is_above: The limit is higher: none higher was tried, or the harness did no better.
    """

    rate: float | None
    best: Sample | None
    is_above: bool


def searches(samples: Iterable[Sample], axis: str, harness: str) -> dict[str, list[Found]]:
    """What searches have found, by backend."""
    trials: dict[tuple[str, int], dict[float, Sample]] = {}
    carried = math.inf
    for sample in samples:
        if sample.status != "missing":
            rate = float(sample.case[axis])
            trials.setdefault((sample.backend, sample.repetition), {})[rate] = sample
            if sample.backend == harness and verdict(sample) != "kept":
                carried = min(carried, rate)
    found: dict[str, list[Found]] = {}
    for (name, _), by_rate in trials.items():
        verdicts = {rate: verdict(sample) for rate, sample in by_rate.items()}
        best, lost = bracket({rate: shown == "kept" for rate, shown in verdicts.items()})
        is_above = lost is None or verdicts[lost] == "late" or lost >= carried
        trial = None if best is None else by_rate[best]
        found.setdefault(name, []).append(Found(best, trial, is_above))
    return found
