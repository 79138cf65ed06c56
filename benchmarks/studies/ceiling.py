"""How much a backend can take: the largest offered load of which nothing is lost.

The rate is doubled until something is lost, then the gap is halved a few times. Each
trial is a sample, and what to try next follows from the samples alone, so a search
that was stopped goes on where it was.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

from benchmarks.samples import Sample
from benchmarks.studies.runs import Context, chosen, overhead_s
from benchmarks.studies.throughput import QUICK_SIZES, SIZES, make_stream, short

STUDY = "ceiling"
HARNESS = "nothing"
"""The backend that shows what the harness itself can carry."""

Verdict = Literal["kept", "lost", "late"]
"""`late`: the publisher could not keep its own schedule, so the load was not offered."""

_LATE_SHARE = 0.05
_LATE_S = 0.1
_TRIALS = 6
"""About how many trials a search takes."""


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
    backends: Sequence[str] | None = None

    @classmethod
    def usual(cls, *, quick: bool) -> Settings:
        """Those of a full or of a quick run."""
        if not quick:
            return cls()
        return cls(sizes=QUICK_SIZES, seconds=1.0, messages=20, halvings=0)

    def header(self) -> dict[str, Any]:
        """What a journal says of these settings."""
        values = asdict(self)
        values["sizes"] = list(self.sizes)
        values["backends"] = None if self.backends is None else list(self.backends)
        return {STUDY: values}

    def messages_at(self, rate: float) -> int:
        """Messages on each topic in a trial."""
        return max(math.ceil(rate * self.seconds), self.messages)


@dataclass(frozen=True, slots=True)
class Ceiling:
    """What was found for one backend and one message size.

    Attributes:
        backend: Name.
        size: Bytes of a message.
        rate: Largest rate of which all was persisted, messages a second on each topic;
            None when something was lost at every rate that was tried.
        offered_bytes_s: What was published a second at that rate.
        stored_bytes_s: Bytes persisted over the wall time at that rate: less than what
            was offered when the backend still had work after the last message.
        lost_rate: Smallest rate above at which something was lost; None when none was tried.
        limit: What ended the search: the `backend` lost messages, the `harness` could
            offer no more (so the true ceiling is above), or the `plan` had no higher rate.
    """

    backend: str
    size: int
    rate: float | None
    offered_bytes_s: float
    stored_bytes_s: float
    lost_rate: float | None
    limit: Literal["backend", "harness", "plan"]


def verdict(sample: Sample) -> Verdict:
    """What a trial shows."""
    values = sample.values
    if sample.status != "ok" or values["persisted"] < values["published"]:
        return "lost"
    late = values["publish_s"] - values["due_s"]
    return "late" if late > _LATE_SHARE * values["due_s"] + _LATE_S else "kept"


def next_rate(
    kept: Mapping[float, bool],
    *,
    start: float,
    lowest: float,
    highest: float,
    halvings: int,
) -> float | None:
    """The rate to try next.

    Args:
        kept: Of the rates that were tried, whether all was kept.
        start: The first one.
        lowest: No rate below is tried.
        highest: No rate above is tried.
        halvings: Of the gap in the end.

    Returns:
        None when the search is over.
    """
    if not kept:
        return start
    lost = min((rate for rate, good in kept.items() if not good), default=None)
    best = max((r for r, good in kept.items() if good and (lost is None or r < lost)), default=None)
    if lost is None:
        assert best is not None
        return best * 2 if best * 2 <= highest else None
    if best is None:
        return lost / 2 if lost / 2 >= lowest else None
    # The gap was once as wide as the rate below it, which was `start`, doubled or halved.
    first_gap = start * 2.0 ** math.floor(math.log2(best / start) + 1e-9)
    return (best + lost) / 2 if lost - best > first_gap / 2**halvings * 1.001 else None


def ceilings(samples: Iterable[Sample]) -> list[Ceiling]:
    """What the samples of this study show, for each backend and size in their order.

    Backends that are missing have none.
    """
    trials: dict[tuple[str, int], list[Sample]] = {}
    for sample in samples:
        if sample.study == STUDY and sample.status != "missing":
            trials.setdefault((sample.backend, sample.case["size"]), []).append(sample)
    return [
        _ceiling(backend, size, group, trials.get((HARNESS, size), []))
        for (backend, size), group in trials.items()
    ]


def _ceiling(
    backend: str, size: int, trials: Sequence[Sample], harness: Sequence[Sample]
) -> Ceiling:
    verdicts = {float(trial.case["rate"]): verdict(trial) for trial in trials}
    lost_rate = min((rate for rate, found in verdicts.items() if found != "kept"), default=None)
    best = max(
        (
            trial
            for trial in trials
            if verdict(trial) == "kept"
            and (lost_rate is None or float(trial.case["rate"]) < lost_rate)
        ),
        key=lambda trial: float(trial.case["rate"]),
        default=None,
    )
    limit: Literal["backend", "harness", "plan"] = "backend"
    if lost_rate is None:
        limit = "plan"
    elif verdicts[lost_rate] == "late" or any(
        verdict(trial) != "kept" and float(trial.case["rate"]) <= lost_rate for trial in harness
    ):
        # The harness with a backend that keeps nothing does no better.
        limit = "harness"
    if best is None:
        return Ceiling(backend, size, None, 0.0, 0.0, lost_rate, limit)
    values = best.values
    return Ceiling(
        backend,
        size,
        float(best.case["rate"]),
        values["published_bytes"] / values["publish_s"],
        values["persisted_bytes"] / values["wall_s"],
        lost_rate,
        limit,
    )


def expected_seconds(context: Context, settings: Settings | None = None) -> float:
    """About how long the searches take that are not at their end."""
    settings = settings or Settings.usual(quick=context.quick)
    return sum(
        _TRIALS * (settings.seconds + overhead_s(backend))
        for name, backend in chosen(context.backends, settings.backends).items()
        for size in settings.sizes
        if name not in context.missing and _next(context, settings, name, size) is not None
    )


def run(context: Context, settings: Settings | None = None) -> None:
    """Look for the ceilings that are not known yet; the backends take turns.

    Raises:
        ValueError: A backend is not known.
    """
    settings = settings or Settings.usual(quick=context.quick)
    names = list(chosen(context.backends, settings.backends))
    for size in settings.sizes:
        # A trial that failed is tried again by the next process, not by this one.
        failed: set[str] = set()
        waiting = names
        while waiting:
            waiting = [name for name in waiting if _try(context, settings, name, size, failed)]


def _try(context: Context, settings: Settings, name: str, size: int, failed: set[str]) -> bool:
    """Do the next trial of a backend.

    Returns:
        Whether there was one to do.
    """
    rate = _next(context, settings, name, size, failed)
    if rate is None:
        return False
    wanted = _sample(settings, name, size, rate)
    messages = settings.messages_at(rate)
    found = context.run(
        wanted,
        lambda: make_stream(
            context, size=size, rate=rate, topics=settings.topics, messages=messages
        ),
        seconds=messages / rate + overhead_s(context.backends[name]),
        speed=1.0,
    )
    if found.status == "failed":
        failed.add(found.key)
    return found.status != "missing"


def _next(
    context: Context,
    settings: Settings,
    name: str,
    size: int,
    failed: Iterable[str] = (),
) -> float | None:
    """The rate that a backend is to be tried with next; None at the end of its search."""
    kept = {}
    for sample in context.journal.samples.values():
        of_search = (sample.study, sample.backend, sample.case.get("size")) == (STUDY, name, size)
        if not of_search or (sample.status != "ok" and sample.key not in failed):
            continue
        rate = float(sample.case["rate"])
        if sample.key == _sample(settings, name, size, rate).key:
            kept[rate] = verdict(sample) == "kept"
    return next_rate(
        kept,
        start=settings.start,
        lowest=settings.lowest,
        highest=settings.highest,
        halvings=settings.halvings,
    )


def _sample(settings: Settings, name: str, size: int, rate: float) -> Sample:
    case = {
        "size": size,
        "rate": short(rate),
        "topics": settings.topics,
        "messages": settings.messages_at(rate),
    }
    return Sample(STUDY, case, name, 0)
