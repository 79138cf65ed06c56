"""The search for the greatest rate at which a backend still keeps everything.

The rate is doubled until something is lost, then the gap is halved a few times. Chance
decides about the last trials, so each search is made several times, and every one of them
begins anew.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal

from benchmarks.samples import Sample

Verdict = Literal["kept", "lost", "late"]
"""`late`: the publisher could not keep its own schedule, so the load was not offered."""

_LATE_SHARE = 0.05
_LATE_S = 0.1


@dataclass(frozen=True, slots=True)
class Bounds:
    """Where a search looks.

    Attributes:
        start: Rate of the first trial.
        lowest: No rate below is tried.
        highest: No rate above is tried.
        halvings: Of the gap between the rates that was kept and that was not.
    """

    start: float
    lowest: float
    highest: float
    halvings: int


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
    """Between which rates the limit lies.

    Args:
        kept: Of the rates that were tried, whether all was kept.

    Returns:
        The greatest rate that was kept below all that were not, and the least that was
        not; None for each that there is not. Luck above a loss does not count.
    """
    lost = min((rate for rate, good in kept.items() if not good), default=None)
    below = (rate for rate, good in kept.items() if good and (lost is None or rate < lost))
    return max(below, default=None), lost


def next_rate(kept: Mapping[float, bool], bounds: Bounds) -> float | None:
    """The rate to try next.

    Args:
        kept: Of the rates that were tried, whether all was kept.
        bounds: Where to look.

    Returns:
        None when the search is over.
    """
    if not kept:
        return bounds.start
    best, lost = bracket(kept)
    if lost is None:
        assert best is not None
        return best * 2 if best * 2 <= bounds.highest else None
    if best is None:
        return lost / 2 if lost / 2 >= bounds.lowest else None
    # The gap was once as wide as the rate below it, which was `start`, doubled or halved.
    first_gap = bounds.start * 2.0 ** math.floor(math.log2(best / bounds.start) + 1e-9)
    is_wide = lost - best > first_gap / 2**bounds.halvings * 1.001
    return (best + lost) / 2 if is_wide else None


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


@dataclass(frozen=True, slots=True)
class Found:
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
    """What searches have found, by backend.

    Args:
        samples: Those of the searches, of one case.
        axis: Name of the rate in the case of a trial.
        harness: The backend that keeps nothing, and so shows what the harness can carry.
    """
    trials: dict[tuple[str, int], dict[float, Sample]] = {}
    for sample in samples:
        if sample.status != "missing":
            by_rate = trials.setdefault((sample.backend, sample.repetition), {})
            by_rate[float(sample.case[axis])] = sample
    carried = min(
        (
            rate
            for (name, _), by_rate in trials.items()
            for rate, sample in by_rate.items()
            if name == harness and verdict(sample) != "kept"
        ),
        default=math.inf,
    )
    found: dict[str, list[Found]] = {}
    for (name, _), by_rate in trials.items():
        verdicts = {rate: verdict(sample) for rate, sample in by_rate.items()}
        rate, lost = bracket({rate: shown == "kept" for rate, shown in verdicts.items()})
        is_above = lost is None or verdicts[lost] == "late" or lost >= carried
        best = None if rate is None else by_rate[rate]
        found.setdefault(name, []).append(Found(rate, best, is_above))
    return found
