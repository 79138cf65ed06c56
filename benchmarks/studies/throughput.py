"""Study 1: streams of one message size at one rate, Figures 3 and 4 of the paper."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.loads import streams
from benchmarks.samples import Sample
from benchmarks.studies.runs import Context, chosen

if TYPE_CHECKING:
    from benchmarks.loads.base import Load

STUDY = "throughput"
SIZES = tuple(5000 << n for n in range(8))
"""Bytes of a message: 5 kB doubled up to 640 kB."""
RATES = (4.0, 16.0, 64.0)
"""Messages a second on each topic."""
QUICK_SIZES = (SIZES[0], SIZES[-1])
QUICK_RATES = (RATES[0], RATES[-1])


@dataclass(frozen=True, slots=True)
class Settings:
    """Which streams, how long, how often. Without arguments: those of the paper.

    Attributes:
        sizes: Bytes of a message.
        rates: Messages a second on each topic.
        messages: On each topic.
        topics: Number of topics.
        repetitions: Of each stream with each backend.
        backends: Names of those that take part; None for all.
    """

    sizes: Sequence[int] = SIZES
    rates: Sequence[float] = RATES
    messages: int = 500
    topics: int = 20
    repetitions: int = 5
    backends: Sequence[str] | None = None

    @classmethod
    def usual(cls, *, quick: bool) -> Settings:
        """Those of a full or of a quick run: the extremes of each axis, once."""
        if not quick:
            return cls()
        return cls(sizes=QUICK_SIZES, rates=QUICK_RATES, messages=20, repetitions=1)


def plan(context: Context, settings: Settings | None = None) -> list[Sample]:
    """All runs in the order in which they are done, those of the journal included.

    The backends take turns within a stream, so that what disturbs the machine for a
    while hits all of them alike.
    """
    settings = settings or Settings.usual(quick=context.quick)
    backends = chosen(context.backends, settings.backends)
    return [
        Sample(STUDY, _case(size, rate, settings, context.speed), name, repetition)
        for repetition in range(settings.repetitions)
        for rate in settings.rates
        for size in settings.sizes
        for name in backends
    ]


def run(context: Context, settings: Settings | None = None) -> None:
    """Do what is still to be done."""
    for sample in plan(context, settings):
        context.run(sample, partial(_stream, context, sample.case))


def make_stream(context: Context, *, size: int, rate: float, topics: int, messages: int) -> Load:
    """A stream, made once; streams of a size share their payloads."""
    settings = {
        "size": size,
        "rate": short(rate),
        "topics": topics,
        "messages": messages,
        "seed": context.seed,
    }
    count = streams.pool_messages(size, topics, messages)
    pool = context.work / "loads" / f"pool-{size}-{count}-{context.seed}.bin"

    def make(directory: Path) -> Load:
        shared = pool if pool.exists() else None
        made = streams.stream(
            directory,
            size=size,
            rate=rate,
            topics=topics,
            messages=messages,
            seed=context.seed,
            pool=shared,
        )
        if shared is None:
            with suppress(FileExistsError):
                os.link(made.payloads, pool)
        return made

    return context.load(f"stream-{size}-{rate:g}", settings, make)


def _stream(context: Context, case: Mapping[str, Any]) -> Load:
    return make_stream(
        context,
        size=case["size"],
        rate=case["rate"],
        topics=case["topics"],
        messages=case["messages"],
    )


def _case(size: int, rate: float, settings: Settings, speed: float) -> dict[str, Any]:
    case = {
        "size": size,
        "rate": short(rate),
        "topics": settings.topics,
        "messages": settings.messages,
    }
    # Runs at another speed are others; at the usual one the case is that of the paper.
    return case if speed == 1 else {**case, "speed": short(speed)}


def short(number: float) -> float:
    """64 and not 64.0: two spellings of a case would be two cases."""
    return int(number) if number == int(number) else number
