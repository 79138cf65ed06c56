"""Samples of a journal, as the sections of a report ask for them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from itertools import chain
from typing import Any, TypeVar

from benchmarks.disturbance import is_disturbed
from benchmarks.report import numbers
from benchmarks.report.look import ordered
from benchmarks.report.model import Cell, Value
from benchmarks.samples import Journal, Sample

MB = 1e6
GB = 1e9

K = TypeVar("K", bound=Hashable)
T = TypeVar("T")


class Book:
    """Samples by study.

    Args:
        journal: Of which.
    """

    def __init__(self, journal: Journal) -> None:
        self.all = list(journal.samples.values())
        self._runs = journal.runs
        self._headers = journal.headers

    def good(self, study: str) -> list[Sample]:
        """Samples of a study that went well."""
        return [one for one in self.all if one.study == study and one.status == "ok"]

    def bad(self, status: str) -> list[Sample]:
        """Samples that are `missing` or `failed`, of all studies."""
        return [one for one in self.all if one.status == status]

    def settings(self, sample: Sample) -> Mapping[str, Any]:
        """Those of the study of a sample, in the run in which it was taken."""
        return _settings(self._headers[self._runs[sample.key]], sample.study)

    def planned(self, study: str, name: str) -> set[Any]:
        """All that the runs of a study were to measure of one setting, which is a list."""
        found = (_settings(header, study).get(name) for header in self._headers)
        lists = [values for values in found if isinstance(values, list)]
        return {one for one in chain.from_iterable(lists) if isinstance(one, int | float | str)}

    def in_same_runs(
        self, one: Sequence[Sample], other: Sequence[Sample]
    ) -> tuple[Sequence[Sample], Sequence[Sample]] | None:
        """Of two groups of samples those of the runs that both have; None without such a run."""
        runs = {self._runs[s.key] for s in one} & {self._runs[s.key] for s in other}
        if not runs:
            return None
        mine, theirs = ([s for s in of if self._runs[s.key] in runs] for of in (one, other))
        return mine, theirs


def _settings(header: Mapping[str, Any], study: str) -> Mapping[str, Any]:
    return mapping(mapping(header.get("settings")).get(study))


def mapping(found: object) -> Mapping[str, Any]:
    """A part of a journal that should be a mapping; an empty one where it is none."""
    return found if isinstance(found, Mapping) else {}


def grouped(items: Iterable[T], key: Callable[[T], K]) -> dict[K, list[T]]:
    """Samples, or what else there is, by what `key` says of each, in their order."""
    found: dict[K, list[T]] = defaultdict(list)
    for item in items:
        found[key(item)].append(item)
    return dict(found)


def by_case(samples: Iterable[Sample], *names: str) -> dict[tuple[Any, ...], list[Sample]]:
    """Samples by parts of their case, the least first; those that lack one are left out."""
    whole = [one for one in samples if all(name in one.case for name in names)]
    found = grouped(whole, lambda one: tuple(one.case[name] for name in names))
    return dict(sorted(found.items(), key=lambda item: tuple(map(_sortable, item[0]))))


def ends(values: Iterable[K]) -> list[K]:
    """The first and the last of them, or the only one."""
    found = list(values)
    return found if len(found) < 2 else [found[0], found[-1]]


def _sortable(part: object) -> tuple[bool, float, str]:
    if isinstance(part, int | float):
        return False, float(part), ""
    return True, 0.0, str(part)


def by_backend(samples: Iterable[Sample]) -> dict[str, list[Sample]]:
    """Samples by backend, in the order of every table."""
    found = grouped(samples, lambda one: one.backend)
    return {name: found[name] for name in ordered(found)}


def backends(samples: Iterable[Sample]) -> list[str]:
    """Names of the backends in samples, in the order of every table."""
    return ordered(sample.backend for sample in samples)


def value(samples: Iterable[Sample], measure: Callable[[Sample], float | None]) -> Value | None:
    """One measure of several repetitions; None when no sample has it."""
    found = (measure(sample) for sample in samples)
    return Value.of(number for number in found if number is not None)


def middle(samples: Iterable[Sample], measure: Callable[[Sample], float | None]) -> float | None:
    """The median of one measure; None when no sample has it."""
    found = value(samples, measure)
    return None if found is None else found.median


def named(name: str, scale: float = 1.0) -> Callable[[Sample], float | None]:
    """The measure that a sample has by this name, over `scale`."""

    def measure(sample: Sample) -> float | None:
        found = number(sample.values, name)
        return None if found is None else found / scale

    return measure


def number(values: Mapping[str, Any], name: str) -> float | None:
    """A number among values; None when there is none by that name."""
    found = values.get(name)
    if isinstance(found, bool) or not isinstance(found, int | float):
        return None
    return float(found)


def ratio(sample: Sample, over: str, under: str) -> float | None:
    """One value over another; None when either is missing or the second is 0."""
    upper, lower = number(sample.values, over), number(sample.values, under)
    return None if upper is None or not lower else upper / lower


def throughput(sample: Sample) -> float | None:
    """MB/s: bytes found in the backend over the time of the whole run."""
    found = ratio(sample, "persisted_bytes", "wall_s")
    return None if found is None else found / MB


def offered(sample: Sample) -> float | None:
    """MB/s that were published."""
    found = ratio(sample, "published_bytes", "publish_s")
    return None if found is None else found / MB


def offered_messages(sample: Sample) -> float | None:
    """Messages a second that were published."""
    return ratio(sample, "published", "publish_s")


def persisted(sample: Sample) -> float | None:
    """Percent of the published messages that were found in the backend."""
    found = ratio(sample, "persisted", "published")
    return None if found is None else 100 * found


DISTURBED = "†"
MEANING = (
    f"{DISTURBED} The host of this machine took more than a twentieth of the processors' time "
    "during the run, the least disturbed of several: on a quiet one more may have been kept."
)
"""What the mark says to whoever reads a table."""


def percents(samples: Iterable[Sample]) -> Cell:
    """The persisted share of some repetitions, as text that never rounds up to 100.

    Where the machine may be why something was lost, it carries the mark `DISTURBED`.
    """
    of = list(samples)
    found = value(of, persisted)
    if found is None:
        return None
    mark = DISTURBED if any(is_disturbed(one.values) for one in of) else ""
    return f"{numbers.percents(found)}{mark}"


def with_meaning(note: str, samples: Iterable[Sample]) -> str:
    """A note under shares that were kept; it explains the mark where one of them has it."""
    return f"{note} {MEANING}" if any(is_disturbed(one.values) for one in samples) else note


def is_whole(samples: Sequence[Sample]) -> bool:
    """Whether nothing was dropped in any of some repetitions."""
    return bool(samples) and all((persisted(one) or 0) >= 100 for one in samples)


def cpu_per_gb(name: str) -> Callable[[Sample], float | None]:
    """CPU seconds by one name over the GB that were kept."""

    def measure(sample: Sample) -> float | None:
        found = ratio(sample, name, "persisted_bytes")
        return None if found is None else found * GB

    return measure


def repetitions(samples: Sequence[Sample]) -> str:
    """How many repetitions stand behind figures: `5 repetitions`, `2 to 5 repetitions`."""
    groups = grouped(samples, lambda one: (one.backend, str(dict(one.case))))
    return numbers.counted([len(of) for of in groups.values()], "repetition", "repetitions")
