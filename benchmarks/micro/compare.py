"""Ratios of two sources, path by path, with their spread."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from benchmarks.micro.running import Run

_UNITS = ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs"), (1e-9, "ns"))


@dataclass(frozen=True, slots=True)
class HotPath:
    """One hot path on both sources.

    Attributes:
        name: `transcode[imu]`.
        before_s: Seconds before; the median over the runs, each the fastest round of its
            own, as whatever disturbs a round makes it slower. None without a figure.
        now_s: The same of the source as it is.
        ratio: Now over before: above 1 it has become slower. None without both figures.
        low: The least ratio of two neighbouring runs.
        high: The greatest ratio of two neighbouring runs.
        note: Why a figure is missing.
        failed: It does not run on the source as it is.
    """

    name: str
    before_s: float | None = None
    now_s: float | None = None
    ratio: float | None = None
    low: float | None = None
    high: float | None = None
    note: str = ""
    failed: bool = False

    def slower_than(self, limit: float) -> bool:
        """Whether the ratio is above `limit`, and every pair of runs says it is slower.

        One that was disturbed for the length of a run has a high ratio, too.
        """
        if self.ratio is None or self.low is None:
            return False
        return self.ratio > limit and self.low > 1

    def to_json(self) -> dict[str, Any]:
        """As one line of the results."""
        return {"kind": "path", **asdict(self)}


def compare(before: Sequence[Run], now: Sequence[Run]) -> list[HotPath]:
    """Compare runs of two sources.

    Args:
        before: Runs of the other revision; the n-th was next to the n-th of `now`.
        now: Runs of the source as it is, as many.

    Returns:
        One for each path of either side, in the order of the files.
    """
    names: dict[str, None] = {}
    for side in (*now, *before):
        names.update(dict.fromkeys((*side.timed, *side.skipped, *side.failed)))
    return [_compare_one(name, before, now) for name in names]


def _compare_one(name: str, before: Sequence[Run], now: Sequence[Run]) -> HotPath:
    old, new = _least(name, before), _least(name, now)
    before_s = statistics.median(old) if len(old) == len(before) else None
    now_s = statistics.median(new) if len(new) == len(now) else None
    failed = any(name in run.failed for run in now)
    if before_s is None or now_s is None:
        note = "; ".join(filter(None, [_why(name, "before", before), _why(name, "now", now)]))
        return HotPath(name, before_s, now_s, note=note, failed=failed)
    pairs = [b / a for a, b in zip(old, new, strict=True)]
    return HotPath(name, before_s, now_s, now_s / before_s, min(pairs), max(pairs))


def _least(name: str, runs: Sequence[Run]) -> list[float]:
    return [run.timed[name].least for run in runs if name in run.timed]


def _why(name: str, side: str, runs: Sequence[Run]) -> str:
    for run in runs:
        if name in run.skipped:
            return f"skipped {side}: {run.skipped[name]}"
        if name in run.failed:
            return f"failed {side}: {run.failed[name]}"
    return "" if all(name in run.timed for run in runs) else f"not there {side}"


def comparison_table(paths: Sequence[HotPath], limit: float | None = None) -> str:
    """A table for people.

    Args:
        paths: The rows.
        limit: Ratio above which a row is marked.
    """
    rows = [("path", "before", "now", "ratio", "spread", "")]
    for path in paths:
        mark = "SLOWER" if limit is not None and path.slower_than(limit) else ""
        rows.append(
            (
                path.name,
                duration(path.before_s),
                duration(path.now_s),
                "-" if path.ratio is None else f"{path.ratio:.2f}x",
                "-" if path.low is None else f"{path.low:.2f}x to {path.high:.2f}x",
                path.note or mark,
            )
        )
    return _aligned(rows)


def run_table(run: Run) -> str:
    """A table of one run alone."""
    rows = [("path", "least", "median", "rounds", "")]
    for name, timed in run.timed.items():
        rows.append((name, duration(timed.least), duration(timed.median), str(timed.rounds), ""))
    for what, reasons in (("skipped", run.skipped), ("failed", run.failed)):
        rows.extend((name, "-", "-", "-", f"{what}: {why}") for name, why in reasons.items())
    return _aligned(rows)


def duration(seconds: float | None) -> str:
    """Three digits and a unit; a dash for None."""
    if seconds is None:
        return "-"
    size, unit = next(((s, u) for s, u in _UNITS if seconds >= s), _UNITS[-1])
    return f"{seconds / size:.3g} {unit}" if seconds < 999.5 else f"{seconds:.0f} s"


def _aligned(rows: Sequence[tuple[str, ...]]) -> str:
    """Columns of text: names to the left, figures to the right, notes as they are."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]) - 1)]
    lines = []
    for name, *figures, note in rows:
        cells = [name.ljust(widths[0])]
        cells += [text.rjust(width) for text, width in zip(figures, widths[1:], strict=True)]
        lines.append("  ".join([*cells, note]).rstrip())
    return "\n".join(lines)
