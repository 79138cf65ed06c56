"""How much a backend can take: the largest offered load of which nothing is lost."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

from benchmarks.samples import Sample
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
from benchmarks.studies.throughput import QUICK_SIZES, SIZES, make_stream, short

STUDY = "ceiling"
HARNESS = "nothing"
"""The backend that shows what the harness itself can carry."""

Limit = Literal["backend", "harness", "plan", "stopped"]

_RATE = "rate"


@dataclass(frozen=True, slots=True)
class Settings:
    """How ceilings are looked for.

    Attributes:
        sizes: Bytes of a message.
        topics: Number of topics.
        seconds: Of publishing in a trial.
        messages: On each topic at least; a trial at a low rate takes longer. Much more
            than a queue holds, or the queue would take the whole trial.
        start: Rate of the first trial, messages a second on each topic.
        lowest: No rate below is tried.
        highest: No rate above is tried.
        halvings: Of the gap between the rates that was kept and that was not.
        repetitions: Of each search.
        backends: Names of those that take part; None for all.
    """

    sizes: Sequence[int] = SIZES
    topics: int = 20
    seconds: float = 8.0
    messages: int = 100
    start: float = 64.0
    lowest: float = 1.0
    highest: float = 16384.0
    halvings: int = 2
    repetitions: int = 3
    backends: Sequence[str] | None = None

    @classmethod
    def usual(cls, *, quick: bool) -> Settings:
        """Those of a full or of a quick run."""
        if not quick:
            return cls()
        return cls(sizes=QUICK_SIZES, seconds=1.0, messages=20, halvings=0, repetitions=1)

    def messages_at(self, rate: float) -> int:
        """Messages on each topic in a trial."""
        return max(math.ceil(rate * self.seconds), self.messages)


@dataclass(frozen=True, slots=True)
class Ceiling:
    """What one search found for one backend and one message size.

    Attributes:
        backend: Name.
        size: Bytes of a message.
        repetition: Which of the searches.
        rate: Largest rate of which all was persisted, messages a second on each topic;
            None when something was lost at every rate that was tried.
        offered_bytes_s: What was published a second at that rate.
        stored_bytes_s: Bytes persisted over the wall time at that rate: less than what
            was offered when the backend still had work after the last message.
        lost_rate: Smallest rate above at which something was lost; None when none was tried.
        limit: What ended the search: the `backend` lost messages, the `harness` could
            offer no more (so the true ceiling is above), the `plan` had no higher rate, or
            it was `stopped`, and may go on.
    """

    backend: str
    size: int
    repetition: int
    rate: float | None
    offered_bytes_s: float
    stored_bytes_s: float
    lost_rate: float | None
    limit: Limit


def ceilings(
    samples: Iterable[Sample], settings: Callable[[Sample], Mapping[str, Any]] = lambda _: {}
) -> list[Ceiling]:
    """What the samples of this study show, for each backend, size and search in their order.

    Backends that are missing have none.

    Args:
        samples: Of any study.
        settings: Those of this study in the run of a sample; without, no search is taken for
            one that was stopped.
    """
    trials: dict[tuple[str, int, int], list[Sample]] = {}
    harness: dict[int, list[Sample]] = {}
    for sample in samples:
        if sample.study != STUDY or sample.status == "missing":
            continue
        size = sample.case["size"]
        trials.setdefault((sample.backend, size, sample.repetition), []).append(sample)
        if sample.backend == HARNESS:
            harness.setdefault(size, []).append(sample)
    return [
        _ceiling(group, harness.get(size, []), settings(group[-1]))
        for (_, size, _), group in trials.items()
    ]


def _ceiling(
    trials: Sequence[Sample], harness: Sequence[Sample], settings: Mapping[str, Any]
) -> Ceiling:
    backend, size, repetition = trials[0].backend, trials[0].case["size"], trials[0].repetition
    by_rate = {float(trial.case[_RATE]): trial for trial in trials}
    verdicts = {rate: verdict(trial) for rate, trial in by_rate.items()}
    kept = {rate: found == "kept" for rate, found in verdicts.items()}
    rate, lost_rate = bracket(kept)
    limit: Limit = "backend"
    if not is_over(kept, settings):
        limit = "stopped"
    elif lost_rate is None:
        limit = "plan"
    elif verdicts[lost_rate] == "late" or (
        _has_queues(backend)
        and any(
            verdict(trial) != "kept" and float(trial.case[_RATE]) <= lost_rate for trial in harness
        )
    ):
        # The same queues with a backend that keeps nothing do no better.
        limit = "harness"
    if rate is None:
        return Ceiling(backend, size, repetition, None, 0.0, 0.0, lost_rate, limit)
    values = by_rate[rate].values
    return Ceiling(
        backend,
        size,
        repetition,
        rate,
        values["published_bytes"] / values["publish_s"],
        values["persisted_bytes"] / values["wall_s"],
        lost_rate,
        limit,
    )


def _has_queues(backend: str) -> bool:
    from benchmarks.backends.registry import BACKENDS

    return backend not in BACKENDS or BACKENDS[backend].intake == "threads"


def run(context: Context, settings: Settings | None = None) -> None:
    """Look for the ceilings that are not known yet; the backends take turns."""
    settings = settings or Settings.usual(quick=context.quick)
    for searches in _rounds(context, settings):
        take_turns(context, searches)


def _rounds(context: Context, settings: Settings) -> Iterator[list[Search]]:
    """All backends' searches for one size."""
    names = list(chosen(context.backends, settings.backends))
    for size in settings.sizes:
        for repetition in range(settings.repetitions):
            yield [_search(context, settings, name, size, repetition) for name in names]


def _search(context: Context, settings: Settings, name: str, size: int, repetition: int) -> Search:
    def trial(rate: float) -> Trial:
        messages = settings.messages_at(rate)
        case = {
            "size": size,
            _RATE: short(rate),
            "topics": settings.topics,
            "messages": messages,
        }
        load = partial(
            make_stream, context, size=size, rate=rate, topics=settings.topics, messages=messages
        )
        return Trial(Sample(STUDY, case, name, repetition), load)

    bounds = Bounds(settings.start, settings.lowest, settings.highest, settings.halvings)
    return Search(_RATE, bounds, trial)
