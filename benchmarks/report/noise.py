"""Whether the machine was quiet: a figure that was taken while it was not says less."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.report.book import Book, number
from benchmarks.report.model import Cell, Section, Table, Value
from benchmarks.report.numbers import number as shown
from benchmarks.samples import Sample

SPIN_RATIO = 1.25
"""The fixed piece of work may take so much longer in the slowest tenth of the runs than in
the fastest tenth."""

STEAL_SHARE = 0.02
"""So much of the processors' time may be taken by other machines on the same host."""

STEAL_LIMIT = f"up to {100 * STEAL_SHARE:.0f} in sum"

LATE_MS = 20.0
"""A publisher whose 99th percentile is later than this did not offer what it was to offer."""

_TIMED = frozenset({"throughput", "persistence"})
"""Studies whose offered load means something only if the publisher was on time. In the two
others that publish, the load is raised until something gives way."""


def warnings(book: Book, headers: Sequence[Mapping[str, Any]]) -> list[str]:
    """Sentences on what was not quiet, with the figures; none when all was."""
    good = [one for one in book.all if one.status == "ok"]
    found = [*_spin(good), *_steal(good, _cores(headers)), *_late(good)]
    if found:
        found.insert(0, "This machine was not quiet while it measured:")
    return [" ".join(found)] if found else []


def section(book: Book, headers: Sequence[Mapping[str, Any]]) -> Section:
    """What the harness saw of the machine, in figures."""
    good = [one for one in book.all if one.status == "ok"]
    cores = _cores(headers)
    rows: list[tuple[Cell, ...]] = []
    spins = _numbers(good, "spin_ms")
    if spins:
        low, high = _percentile(spins, 0.1), _percentile(spins, 0.9)
        rows.append(
            ("fixed piece of work before each run, ms", Value.of(spins), _spin_limit(low, high))
        )
    for name, label, limit in (
        ("steal_s", "taken by other machines on this host, % of all processors", STEAL_LIMIT),
        ("other_cpu_s", "used by others, the kernel's writing included, %", ""),
    ):
        shares = _shares(good, name, cores)
        if shares:
            rows.append((label, Value.of(100 * share for share in shares), limit))
    late = _numbers([one for one in good if one.study in _TIMED], "late_ms_p99")
    if late:
        limit_text = f"up to {LATE_MS:.0f} in each run"
        rows.append(("publisher's lateness, 99th percentile, ms", Value.of(late), limit_text))
    text = (
        "A publisher that is late offers less than it says, and a processor that others use makes "
        "every backend look worse. These figures are of all runs together; those of a backend "
        "stand under “On time”.",
    )
    if not rows:
        return Section("quiet", "Was the machine quiet?", ("No run has told.",))
    table = Table(
        "What the harness saw of the machine",
        ("", "median (least…greatest)", "quiet means"),
        tuple(rows),
    )
    return Section("quiet", "Was the machine quiet?", text, (), (table,))


def _spin(good: Sequence[Sample]) -> list[str]:
    spins = _numbers(good, "spin_ms")
    if len(spins) < 2:
        return []
    low, high = _percentile(spins, 0.1), _percentile(spins, 0.9)
    if low <= 0 or high / low <= SPIN_RATIO:
        return []
    return [
        f"The same piece of work took {shown(low)} ms in the fastest tenth of the runs and "
        f"{shown(high)} ms in the slowest ({shown(high / low)} times)."
    ]


def _steal(good: Sequence[Sample], cores: float) -> list[str]:
    whole = [one for one in good if _has(one, "steal_s")]
    time = sum(float(one.values["wall_s"]) for one in whole) * cores
    share = sum(float(one.values["steal_s"]) for one in whole) / time if time else 0.0
    if share <= STEAL_SHARE:
        return []
    return [f"Other machines on the same host took {100 * share:.1f} % of the processors' time."]


def _late(good: Sequence[Sample]) -> list[str]:
    timed = [one for one in good if one.study in _TIMED and number(one.values, "late_ms_p99")]
    late = [one for one in timed if (number(one.values, "late_ms_p99") or 0) > LATE_MS]
    if not late:
        return []
    most = max(number(one.values, "late_ms_p99") or 0 for one in late)
    return [
        f"The publisher was late in {len(late)} of {len(timed)} runs (99th percentile "
        f"{shown(most)} ms at the most; up to {LATE_MS:.0f} ms is on time)."
    ]


def _spin_limit(low: float, high: float) -> str:
    if low <= 0:
        return "—"
    return f"slowest over fastest tenth {shown(high / low)}, up to {SPIN_RATIO}"


def _shares(good: Sequence[Sample], name: str, cores: float) -> list[float]:
    return [
        float(one.values[name]) / (float(one.values["wall_s"]) * cores)
        for one in good
        if _has(one, name)
    ]


def _has(sample: Sample, name: str) -> bool:
    return number(sample.values, name) is not None and bool(number(sample.values, "wall_s"))


def _numbers(samples: Sequence[Sample], name: str) -> list[float]:
    found = (number(one.values, name) for one in samples)
    return [one for one in found if one is not None]


def _percentile(values: Sequence[float], share: float) -> float:
    ranked = sorted(values)
    return ranked[min(len(ranked) - 1, int(share * len(ranked)))]


def _cores(headers: Sequence[Mapping[str, Any]]) -> float:
    found = (number(header, "cores") for header in reversed(headers))
    return next((one for one in found if one), 1.0)
