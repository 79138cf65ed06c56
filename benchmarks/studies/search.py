"""The search for the greatest rate at which a backend still keeps everything.

The rate is doubled until something is lost, then the gap is halved once. Chance decides about
the last trials, so each search is made twice where there is time, and begins anew.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

from benchmarks.samples import Sample

Verdict = Literal["kept", "lost", "late"]
"""`late`: the publisher could not keep its own schedule, so the load was not offered."""

_LATE_SHARE = 0.05
_LATE_S = 0.1


class Bounds(NamedTuple):
    """Where a search looks: its first rate, and the least and greatest that it tries."""

    start: float
    lowest: float
    highest: float


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
