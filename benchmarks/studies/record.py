"""How much a backend can take: the largest offered load of which nothing is lost.

Streams of twenty topics with messages of one size, whose first trial of 64 Hz a topic shows
memory, disk and processor time; and the log of a robot, published faster than it was recorded.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.loads import streams
from benchmarks.loads.robot import robot_load
from benchmarks.samples import Sample, Scale
from benchmarks.studies.runs import Context
from benchmarks.studies.search import Bounds, Search, take_turns

if TYPE_CHECKING:
    from benchmarks.loads.base import Load

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
