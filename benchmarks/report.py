"""From a journal to `report.md`: tables, figures, and sentences on what they show."""

from __future__ import annotations

import json
import re
import shlex
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from benchmarks.disturbance import is_disturbed
from benchmarks.figures import Figure, bars, lines
from benchmarks.numbers import (
    OURS,
    Spread,
    databases,
    listed,
    number,
    ordered,
    percents,
    size,
    title,
    with_spread,
)
from benchmarks.samples import DAMAGE, Journal, Sample, naming
from benchmarks.studies.ceiling import Ceiling, ceilings
from benchmarks.studies.speed_up import speeds
from hybridlog.cli.output import printable

NAME = "report.md"
DISTURBED = "†"
PAPER_MS: Final = {
    "MongoDB": ("<1", "40", "32", "2,680"),
    "MongoDB (indexed)": ("<1", "12", "44", "668"),
    "PostgreSQL": ("21.49", "232.25", "347.27", "19,900"),
    "PostgreSQL (indexed)": ("1.14", "225.45", "352.11", "19,500"),
    "SQLite (Python functions)": ("1.20", "2,414.52", "1,547.70", "485,000"),
}
"""Milliseconds of the paper's Table 1, for Q1 to Q4."""

LATE_MS = 20
"""A publisher whose 99th percentile is later did not offer what it was to offer."""
SPIN = 1.25
"""A machine whose runs differ more in a fixed piece of work is not quiet."""

_LOAD_STUDIES = ("throughput", "persistence", "ceiling", "speed-up")
_MB, _GB = 1e6, 1e9

Measure = Callable[[Sample], float | None]
Cell = str | Spread | None
Groups = dict[Any, list[Sample]]

_TEMPLATE = """\
# What a robot's log store can keep, and how fast it answers{quick}

{warnings}## What was found

{findings}

{sections}
"""


class Report:
    """What the samples of a journal show.

    Args:
        journal: Of one or more runs.
        directory: Where figures go; None for none.
    """

    def __init__(self, journal: Journal, directory: Path | None = None) -> None:
        self._journal, self._directory = journal, directory
        self.quick = any(header.get("quick") for header in journal.headers)
        samples = list(journal.samples.values())
        self.failed = [one for one in samples if one.status == "failed"]
        self.missing = [one for one in samples if one.status == "missing"]
        self.differing = _differing(samples)
        self._studies = _grouped((s for s in samples if s.status == "ok"), lambda s: s.study)
        found = ceilings(samples, journal.settings_of)
        self._ceilings: dict[tuple[str, int], list[Ceiling]] = defaultdict(list)
        for one in found:
            self._ceilings[one.backend, one.size].append(one)
        self.findings = [
            *self._answers(),
            *self._noise(),
            *self._heaviest(),
            *self._best_ceilings(),
            *self._logs(),
        ]

    def markdown(self) -> str:
        """The whole report."""
        sections = [
            *self._throughput(),
            *self._ceiling_tables(),
            *self._cost(),
            *self._persistence(),
            *self._speed_up(),
            *self._queries(),
            *self._reading(),
            *self._queues(),
            *self._not_measured(),
            *self._runs(),
        ]
        warning = "> **A quick run: few messages and repetitions. Do not cite its figures.**\n\n"
        return _TEMPLATE.format(
            quick=" (quick run)" if self.quick else "",
            warnings=warning if self.quick else "",
            findings="\n".join(f"* {escaped(text)}" for text in self.findings) or "Nothing yet.",
            sections="\n\n".join(sections),
        )

    # --- sentences --------------------------------------------------------------------

    def _answers(self) -> list[str]:
        if not self.differing:
            return []
        return [f"The backends do not agree on {listed(self.differing)}: that is a mistake."]

    def _noise(self) -> list[str]:
        """Signs that the machine had other work to do."""
        timed = [s for name in ("throughput", "persistence") for s in self._studies.get(name, ())]
        late = [s for s in timed if (_measured("late_ms_p99")(s) or 0) > LATE_MS]
        every = (s for samples in self._studies.values() for s in samples)
        spins = sorted(filter(None, map(_measured("spin_ms"), every)))
        found = []
        if spins and spins[len(spins) * 9 // 10] > SPIN * spins[len(spins) // 10]:
            fast, slow = number(spins[len(spins) // 10]), number(spins[len(spins) * 9 // 10])
            found.append(
                f"This machine was not quiet: a fixed piece of work took {fast} ms in the "
                f"fastest tenth of the runs and {slow} ms in the slowest."
            )
        if late:
            share = f"{len(late)} of {len(timed)} runs"
            found.append(f"The publisher was more than {LATE_MS} ms late in {share}.")
        return found

    def _heaviest(self) -> list[str]:
        streams = _by_case(self._studies.get("throughput", ()), "size", "rate")
        if not streams:
            return []
        case, group = max(streams.items(), key=lambda item: item[0][0] * item[0][1])
        kept = [f"{title(n)} {_share(s)} %" for n, s in _by_backend(group).items()]
        load = f"{size(case[0])} messages at {number(case[1])} Hz a topic"
        found = [f"Of the heaviest stream ({load}) these shares were kept: {listed(kept)}."]
        rates = {n: Spread.of(map(throughput, s)) for n, s in _by_backend(group).items()}
        best = _best({n: s.median for n, s in rates.items() if s})
        if best:
            ours, name, theirs = best
            found.append(
                f"Of it hybridlog kept {number(ours)} MB/s, {number(ours / theirs)} times what the "
                f"best database kept ({title(name)}, {number(theirs)} MB/s)."
            )
        return found

    def _best_ceilings(self) -> list[str]:
        found = []
        for bytes_ in sorted({place[1] for place in self._ceilings}):
            offered = {
                name: Spread.of(one.offered_bytes_s / _MB for one in searches)
                for (name, length), searches in self._ceilings.items()
                if length == bytes_
            }
            best = _best({name: one.median for name, one in offered.items() if one})
            if best:
                ours, name, theirs = best
                is_above = any(one.limit != "backend" for one in self._ceilings[OURS, bytes_])
                load = f"{number(ours)} MB/s{' or more' if is_above else ''}"
                found.append(
                    f"With {size(bytes_)} messages hybridlog keeps everything up to {load}, "
                    f"{number(ours / theirs)} times what the best database does "
                    f"({title(name)}, {number(theirs)} MB/s)."
                )
        return found

    def _logs(self) -> list[str]:
        found, whole = [], []
        for (log,), group in _by_case(self._studies.get("persistence", ()), "log").items():
            lossy = {n: s for n, s in _by_backend(group).items() if not _is_whole(s)}
            if lossy:
                shares = listed([f"{title(n)} {_share(s)} %" for n, s in lossy.items()])
                found.append(f"Of {log} something was lost by {shares}.")
            else:
                whole.append(log)
            damage = next((str(s.values[DAMAGE]) for s in group if DAMAGE in s.values), "")
            if damage:
                found.append(f"Of {log} only what can be read was published: {damage}.")
        if whole:
            found.append(f"Of {listed(whole)} every backend that took part kept everything.")
        return found

    # --- sections ---------------------------------------------------------------------

    def _throughput(self) -> list[str]:
        samples = self._studies.get("throughput", [])
        if not samples:
            return []
        parts = [
            "## Study 1: throughput",
            "Throughput is the bytes found in the backend afterwards over the time from the first "
            "message until everything was safe on the disk. A message that finds ten ahead of it "
            "in its topic's queue is dropped.",
        ]
        rates = _by_case(samples, "rate")
        panels = [
            (f"{number(rate)} Hz a topic", _series(group, "size", throughput))
            for (rate,), group in rates.items()
        ]
        postgres = [
            (heading, {n: s for n, s in series.items() if n.startswith("postgres")})
            for heading, series in panels
        ]
        names = "PostgreSQL, autocommit and tuned", "throughput over message size"
        if all(len(series) > 1 for _, series in postgres):
            parts.append(self._figure("figure-3", f"Figure 3: {names[0]}", "MB/s", postgres))
        parts.append(self._figure("figure-4", f"Figure 4: {names[1]}", "MB/s", panels))
        for (rate,), group in rates.items():
            at = f"at {number(rate)} Hz a topic"
            offered = _by_case(group, "size")
            first = ["offered", *(_spread(g, offered_rate) for g in offered.values())]
            parts.append(_pivot(f"Throughput {at}, MB/s", group, "size", throughput, first))
            parts.append(_pivot(f"Persisted {at}, % of the messages", group, "size", _share))
        return parts

    def _ceiling_tables(self) -> list[str]:
        if not self._ceilings:
            return []
        sizes = sorted({place[1] for place in self._ceilings})
        names = ordered(place[0] for place in self._ceilings)
        topics = {s.case["size"]: s.case["topics"] for s in self._studies.get("ceiling", ())}

        def table(heading: str, measure: Callable[[Ceiling], float]) -> str:
            rows = []
            for name in names:
                found = (self._ceilings.get((name, bytes_), []) for bytes_ in sizes)
                rows.append([title(name), *(_bound(searches, measure) for searches in found)])
            return _table(heading, ["backend", *map(size, sizes)], rows)

        series: dict[str, dict[int, Spread]] = {name: {} for name in names}
        for (name, bytes_), searches in sorted(self._ceilings.items()):
            spread = Spread.of(one.offered_bytes_s / _MB for one in searches)
            if spread and spread.median:
                series[name][bytes_] = spread
        return [
            "## How much each can take",
            "The ceiling is the largest offered load of which everything was found in the backend "
            "afterwards. ≥: it is above, since the harness could offer no more (harness), no "
            "higher rate was planned (plan), or the search was stopped (stopped). none: "
            "something was lost at every rate.",
            self._figure(
                "ceilings", "Largest load that is kept", "MB/s", [("", series)], log_y=True
            ),
            table("Ceiling, MB/s", lambda one: one.offered_bytes_s / _MB),
            table(
                "Ceiling, messages/s of all topics",
                lambda one: (one.rate or 0) * topics.get(one.size, 0),
            ),
            table("Stored at that load, MB/s", lambda one: one.stored_bytes_s / _MB),
        ]

    def _cost(self) -> list[str]:
        samples = self._studies.get("throughput", [])
        if not samples:
            return []
        whole = "CPU seconds of logger and servers for a GB that was kept"
        names = ["logger", "servers"]
        peaks = [_measured("peak_rss", _MB), _measured("server_peak_rss", _MB)]
        rows = [
            [title(name), *(_spread(group, peak) for peak in peaks)]
            for name, group in _by_backend(samples).items()
        ]
        disk = _ratio("disk_bytes", "persisted_bytes")
        return [
            "## What it costs",
            _pivot(whole, samples, "size", _cpu),
            _table("Peak memory, MB", ["backend", *names], rows),
            _pivot("Bytes on the disk over bytes of payload", samples, "size", disk),
        ]

    def _persistence(self) -> list[str]:
        samples = self._studies.get("persistence", [])
        if not samples:
            return []
        loads: list[list[Cell]] = []
        for (log,), group in _by_case(samples, "log").items():
            columns = (_measured("published"), _measured("publish_s"), offered_rate)
            loads.append([log, *(_spread(group, measure) for measure in columns)])
        series = _series(samples, "log", persisted)
        return [
            "## Study 2: what is kept of logs",
            "Published at the pace at which they were recorded. `mit1`, `mit2`, `hcr1` and `hcr2` "
            "are made after what is published about the robots of the paper; others are real.",
            self._figure("figure-5", "Figure 5: persisted messages", "%", [("", series)], bars),
            _pivot("Persisted, % of the messages", samples, "log", _share),
            _table("The logs", ["log", "messages", "seconds", "MB/s"], loads),
        ]

    def _speed_up(self) -> list[str]:
        samples = self._journal.samples.values()
        found = speeds(samples, self._journal.settings_of)
        if not found:
            return []
        logs = list(dict.fromkeys(log for _, log in found))
        rows = []
        for name in ordered(backend for backend, _ in found):
            cells = [found.get((name, log)) for log in logs]
            shown = [
                "—" if c is None else f"{'≥ ' if c[1] else ''}{with_spread(c[0])}" for c in cells
            ]
            rows.append([title(name), *shown])
        heading = "Greatest speed at which everything was kept, times real time"
        return ["## Faster than real time", _table(heading, ["backend", *logs], rows)]

    def _queries(self) -> list[str]:
        samples = self._studies.get("queries", [])
        if not samples:
            return []
        agree = (
            f"The answers to {listed(self.differing)} DIFFER between backends."
            if self.differing
            else "Every backend gave the same answers, and they are those of the plan of the load."
        )
        paper = [[name, *times] for name, times in PAPER_MS.items()]
        asked = [("", _series(samples, "question", _measured("ms")))]
        return [
            "## Study 3: questions",
            "Q1: how often was the right gripper closed. Q2: every viewpoint behind the robot. "
            "Q3: how often was the gripper moved within a region. Q4: how many grasps with the "
            f"camera in front, within half a second. {escaped(agree)}",
            self._figure("table-1", "Time to answer", "ms", asked, bars, log_y=True),
            _pivot("Table 1: milliseconds", samples, "question", _measured("ms")),
            _pivot("The first time, milliseconds", samples, "question", _measured("cold_ms")),
            _table("The paper's Table 1, milliseconds", ["system", "Q1", "Q2", "Q3", "Q4"], paper),
        ]

    def _reading(self) -> list[str]:
        samples = self._studies.get("reading", [])
        if not samples:
            return []
        panels = [("", _series(samples, "task", _measured("ms")))]
        return [
            "## Reading back",
            self._figure("reading", "Time to read", "ms", panels, bars, log_y=True),
            _pivot("Milliseconds", samples, "task", _measured("ms")),
            _pivot("The first, milliseconds", samples, "task", _measured("first_ms")),
        ]

    def _queues(self) -> list[str]:
        names = ("depth_p50", "depth_p90", "depth_p99", "late_ms_p50", "late_ms_p99")
        tables = []
        for study in _LOAD_STUDIES:
            samples = self._studies.get(study, [])
            rows = [
                [title(name), *(_spread(group, _measured(one)) for one in names)]
                for name, group in _by_backend(samples).items()
            ]
            if rows:
                head = ["backend", *(name.replace("_", " ") for name in names)]
                tables.append(_table(study, head, rows))
        about = "Messages that a message finds ahead of it, and how late the publisher was."
        return ["## Queues and publisher", about, *tables] if tables else []

    def _not_measured(self) -> list[str]:
        rows: list[list[Cell]] = []
        for one in (*self.failed, *self.missing):
            case = ", ".join(f"{name} {value}" for name, value in one.case.items())
            if one.status == "missing":
                case = ""
            row: list[Cell] = [one.status, one.study, title(one.backend), case, one.reason]
            if row not in rows:
                rows.append(row)
        head = ["status", "study", "backend", "case", "reason"]
        return ["## What was not measured", _table("", head, rows)] if rows else []

    def _runs(self) -> list[str]:
        rows: list[list[Cell]] = []
        for header in self._journal.headers:
            machine = [
                str(header.get(name, "?")) for name in ("cpu", "cores", "memory_gib", "disk")
            ]
            versions = {**header.get("packages", {}), "MongoDB": header.get("mongod", "?")}
            command = shlex.join(map(str, header.get("command", ())))
            packages = ", ".join(f"{name} {version}" for name, version in versions.items())
            about = [header.get("started", "?"), header.get("revision", "?"), ", ".join(machine)]
            rows.append([*map(str, about), packages, f"`{command}`"])
        head = ["started", "revision", "machine", "versions", "command"]
        return ["## The runs", _table("", head, rows)] if rows else []

    def _figure(
        self,
        key: str,
        heading: str,
        label: str,
        panels: Sequence[tuple[str, Mapping[str, Mapping[Any, Spread]]]],
        kind: Callable[[Figure, Path], str] = lines,
        *,
        log_y: bool = False,
    ) -> str:
        if self._directory is None:
            return f"*{heading}*"
        figure = Figure(key, heading, label, panels, log_y=log_y)
        try:
            return f"![{heading}]({kind(figure, self._directory)})"
        except ImportError:
            return f"*{heading}: figures need matplotlib, pip install 'hybridlog[bench]'*"


def write(journal: Journal, directory: Path) -> tuple[Report, Path]:
    """Write `report.md` and its figures; older ones are replaced."""
    report = Report(journal, directory)
    path = directory / NAME
    new = path.with_name(path.name + ".new")
    try:
        with naming(path):
            new.write_text(report.markdown(), encoding="utf-8")
            new.replace(path)
    finally:
        new.unlink(missing_ok=True)
    return report, path


# --- measures -------------------------------------------------------------------------


def throughput(sample: Sample) -> float | None:
    """MB/s: bytes found in the backend over the time of the whole run."""
    return _ratio("persisted_bytes", "wall_s", _MB)(sample)


def offered_rate(sample: Sample) -> float | None:
    """MB/s that were published."""
    return _ratio("published_bytes", "publish_s", _MB)(sample)


def persisted(sample: Sample) -> float | None:
    """Percent of the published messages that were found in the backend."""
    return _ratio("persisted", "published", 0.01)(sample)


def _measured(name: str, scale: float = 1.0) -> Measure:
    def measure(sample: Sample) -> float | None:
        value = sample.values.get(name)
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        return value / scale if is_number else None

    return measure


def _ratio(over: str, under: str, scale: float = 1.0) -> Measure:
    def measure(sample: Sample) -> float | None:
        upper, lower = _measured(over)(sample), _measured(under)(sample)
        return None if upper is None or not lower else upper / lower / scale

    return measure


def _cpu(sample: Sample) -> float | None:
    parts = [_ratio(name, "persisted_bytes", 1 / _GB)(sample) for name in ("cpu_s", "server_cpu_s")]
    return None if None in parts else sum(part or 0.0 for part in parts)


def _spread(samples: Iterable[Sample], measure: Measure) -> Spread | None:
    return Spread.of(map(measure, samples))


def _share(samples: Sequence[Sample]) -> str | None:
    """Percent that was kept, marked where the host of the machine may be why not more."""
    found = _spread(samples, persisted)
    if found is None:
        return None
    return percents(found) + (DISTURBED if any(is_disturbed(s.values) for s in samples) else "")


def _is_whole(samples: Iterable[Sample]) -> bool:
    return all(s.values.get("persisted") == s.values.get("published") for s in samples)


def _bound(searches: Sequence[Ceiling], measure: Callable[[Ceiling], float]) -> str | None:
    found = Spread.of(map(measure, searches))
    if found is None:
        return None
    limits = {one.limit for one in searches}
    if all(one.rate is None for one in searches):
        return "none so far (stopped)" if "stopped" in limits else "none"
    above = next((limit for limit in ("stopped", "harness", "plan") if limit in limits), "")
    return f"≥ {with_spread(found)} ({above})" if above else with_spread(found)


def _speed(found: tuple[Spread, bool] | None) -> str | None:
    if found is None:
        return None
    spread, is_above = found
    return f"{'≥ ' if is_above else ''}{with_spread(spread)}"


def _best(medians: Mapping[str, float]) -> tuple[float, str, float] | None:
    """Ours, the best database, and its own."""
    others = [name for name in databases(medians) if medians[name]]
    if not medians.get(OURS) or not others:
        return None
    best = max(others, key=lambda name: medians[name])
    return medians[OURS], best, medians[best]


def _differing(samples: Iterable[Sample]) -> list[str]:
    """Questions to which not every backend gave the same answer, wrong ones included."""
    answers: dict[str, set[str]] = defaultdict(set)
    names = {}
    for one in samples:
        name = one.case.get("question") or one.case.get("task")
        if "answer" in one.values and name is not None:
            place = json.dumps([one.study, dict(one.case), one.repetition], sort_keys=True)
            answers[place].add(json.dumps(one.values["answer"], sort_keys=True))
            names[place] = str(name)
    return list(dict.fromkeys(names[place] for place, found in answers.items() if len(found) > 1))


# --- groups and tables ----------------------------------------------------------------


def _grouped(samples: Iterable[Sample], key: Callable[[Sample], Any]) -> Groups:
    found: Groups = defaultdict(list)
    for sample in samples:
        found[key(sample)].append(sample)
    return dict(found)


def _by_case(samples: Iterable[Sample], *names: str) -> Groups:
    """By parts of their case; numbers ascend, names stay in their order."""
    whole = (one for one in samples if all(name in one.case for name in names))
    found = _grouped(whole, lambda one: tuple(one.case[name] for name in names))
    is_number = all(isinstance(part, int | float) for case in found for part in case)
    return dict(sorted(found.items())) if is_number else found


def _by_backend(samples: Iterable[Sample]) -> dict[str, list[Sample]]:
    found = _grouped(samples, lambda one: one.backend)
    return {name: found[name] for name in ordered(found)}


def _series(samples: Sequence[Sample], axis: str, measure: Measure) -> dict[str, dict[Any, Spread]]:
    return {
        name: {
            place: spread
            for (place,), of in _by_case(group, axis).items()
            if (spread := _spread(of, measure)) is not None
        }
        for name, group in _by_backend(samples).items()
    }


def _pivot(
    heading: str,
    samples: Sequence[Sample],
    axis: str,
    measure: Any,
    first: Sequence[Cell] | None = None,
) -> str:
    """A table with a row a backend and a column a place on an axis."""
    places = [place for (place,) in _by_case(samples, axis)]
    rows: list[Sequence[Cell]] = [first] if first else []
    for name, group in _by_backend(samples).items():
        of = {place: found for (place,), found in _by_case(group, axis).items()}
        cells = (of.get(place, []) for place in places)
        shown = (_share(c) if measure is _share else _spread(c, measure) for c in cells)
        rows.append([title(name), *shown])
    columns = [size(place) if axis == "size" else str(place) for place in places]
    runs = sorted({len(g) for g in _grouped(samples, lambda s: (s.backend, str(s.case))).values()})
    counts = f"{runs[0]} to {runs[-1]}" if len(runs) > 1 else str(runs[0])
    note = f"Median (least…greatest) of {counts} repetition{'s' if runs[-1] > 1 else ''}."
    if measure is _share and any(is_disturbed(s.values) for s in samples):
        note += f" {DISTURBED} The host of this machine took processor time away meanwhile."
    return f"{_table(heading, ['backend', *columns], rows)}\n\n{note}"


def _table(heading: str, columns: Sequence[str], rows: Iterable[Sequence[Cell]]) -> str:
    lines_ = [f"### {escaped(heading)}\n"] if heading else []
    lines_ += [_row(columns), "|" + "---|" * len(columns)]
    lines_ += [_row([_cell(cell) for cell in row]) for row in rows]
    return "\n".join(lines_)


def _cell(cell: Cell) -> str:
    if cell is None:
        return "—"
    return with_spread(cell) if isinstance(cell, Spread) else cell


def _row(cells: Iterable[str]) -> str:
    return "| " + " | ".join(map(escaped, cells)) + " |"


def escaped(text: str) -> str:
    """Text as Markdown shows it: names out of logs and messages of systems are untrusted."""
    pieces = re.split(r"(`[^`]+`)", printable(" ".join(text.split())))
    # Between backticks only the bar means something, and only in a table.
    return "".join(
        piece.replace("|", "\\|") if place % 2 else re.sub(r"([\\`*_|<>\[\]])", r"\\\1", piece)
        for place, piece in enumerate(pieces)
    )
