"""How much a backend can take: the largest offered load of which nothing is lost.

Twenty topics with messages of one size. The first trial of each search is the stream of
64 Hz a topic, of which memory, disk and processor time are shown.
"""

from __future__ import annotations

import math
import os
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from benchmarks.loads import streams
from benchmarks.samples import Sample, Scale
from benchmarks.studies.runs import Context
from benchmarks.studies.search import Bounds, Search, take_turns

if TYPE_CHECKING:
    from benchmarks.loads.base import Load

STUDY = "record"
HARNESS = "nothing"
"""The backend that shows what the harness itself can carry."""
SIZES = (5_000, 40_000, 640_000)
"""Bytes of a message."""
TOPICS = 20
START = 64.0
"""Rate of the first trial, messages a second on each topic."""


class Settings(NamedTuple):
    """How ceilings are looked for.

    Attributes:
        seconds: Of publishing in a trial.
        messages: On each topic at least; a trial at a low rate takes longer. Much more
            than a queue holds, or the queue would take the whole trial.
        bounds: Where each search looks.
    """

    seconds: float
    messages: int
    bounds: Bounds


SETTINGS: dict[Scale, Settings] = {
    "full": Settings(5.0, 60, Bounds(START, 1.0, 16_384.0, 1)),
    "tiny": Settings(0.1, 3, Bounds(START, START, START, 0)),
}


def run(context: Context, size: int, repetition: int) -> None:
    """Look for the ceilings; the backends take turns.

    Args:
        context: Where and how.
        size: Bytes of a message.
        repetition: Which of the searches.
    """
    names = [name for name, kind in context.backends.items() if kind.records]
    take_turns([_search(context, name, size, repetition) for name in names])


def _search(context: Context, name: str, size: int, repetition: int) -> Search:
    settings = SETTINGS[context.scale]

    def trial(rate: float) -> Sample:
        messages = max(math.ceil(rate * settings.seconds), settings.messages)
        case = {"size": size, "rate": short(rate), "topics": TOPICS, "messages": messages}
        load = partial(make_stream, context, size=size, rate=rate, messages=messages)
        return context.run(Sample(STUDY, case, name, repetition), load)

    return Search(settings.bounds, trial)


def make_stream(context: Context, *, size: int, rate: float, messages: int) -> Load:
    """A stream, made once; streams of a size share their payloads."""
    about = {"size": size, "rate": short(rate), "topics": TOPICS, "messages": messages}
    about["seed"] = context.seed
    count = streams.pool_messages(size, TOPICS, messages)
    pool = context.work / "loads" / f"pool-{size}-{count}-{context.seed}.bin"

    def make(directory: Path) -> Load:
        shared = pool if pool.exists() else None
        made = streams.stream(
            directory,
            size=size,
            rate=rate,
            topics=TOPICS,
            messages=messages,
            seed=context.seed,
            pool=shared,
        )
        if shared is None:
            os.link(made.payloads, pool)
        return made

    return context.load(f"stream-{size}-{rate:g}", about, make)


def short(number: float) -> float:
    """64 and not 64.0: two spellings of a case would be two cases."""
    return int(number) if number == int(number) else number
