"""From a journal to the page of the results, and to the table of the README."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from statistics import median
from typing import Any, NamedTuple

from benchmarks.backends.registry import BACKENDS
from benchmarks.loads.robot import RATE
from benchmarks.numbers import FLOORS, OURS, number, percent, size, title
from benchmarks.samples import Journal, Sample
from benchmarks.studies import record
from benchmarks.studies.live import CASES
from benchmarks.studies.record import Found, searches
from hybridlog.cli.output import printable

Values = dict[str, float]
"""Medians by backend."""
MADE = "<!-- made by `python -m benchmarks`; change benchmarks/page.py -->"
BEGIN, END = "<!-- measured -->", "<!-- /measured -->"
_MB = 1e6
_MIDDLE, LARGEST = record.SIZES[1:]


class Row(NamedTuple):
    """What was measured of several systems.

    Attributes:
        short: The same, to say where another one is ahead; empty to leave it out of the README.
        best: `max` or `min`, whichever is better.
        above: Backends whose figures are higher than shown: the harness offered no more.
    """

    what: str
    short: str
    values: Values
    best: Callable[..., str]
    unit: str = ""
    above: frozenset[str] = frozenset()

    def shown(self, name: str) -> str:
        """The figure of a backend; empty without one."""
        if name not in self.values:
            return ""
        value = self.values[name]
        text = percent(value) if self.unit == " %" else number(value)
        return f"{'≥ ' if name in self.above else ''}{text}{self.unit}"

    def first(self, names: Iterable[str]) -> str | None:
        """Which of some backends is ahead; None if there is none."""
        there = [name for name in names if name in self.values]
        return self.best(there, key=self.values.__getitem__) if there else None

    def is_behind(self, names: Iterable[str]) -> bool:
        """Whether we are behind one of some backends, as far as the figures tell."""
        first = self.first([*names, OURS])
        if OURS not in self.values or first is None:
            return False
        return first != OURS and self.shown(first) != self.shown(OURS)


class Results:
    """The samples of a journal by study."""

    def __init__(self, journal: Journal) -> None:
        self.header = journal.header
        self.scale = str(journal.header["scale"])
        self._samples = journal.samples
        self.failed = [one for one in self._samples if one.status == "failed"]
        self.missing = sorted(
            {(s.backend, s.reason) for s in self._samples if s.status == "missing"}
        )

    def of(self, study: str, *, failed: bool = False, **case: Any) -> list[Sample]:
        """Samples of a case of a study that succeeded, or failed as well."""
        wanted = ("ok", "failed") if failed else ("ok",)
        found = [s for s in self._samples if s.study == study and s.status in wanted]
        return [s for s in found if all(s.case.get(name) == case[name] for name in case)]

    def medians(self, study: str, measure: Callable[[Sample], float | None], **case: Any) -> Values:
        """A measure of the samples of a case, by backend."""
        found: dict[str, list[float]] = {}
        for sample in self.of(study, **case):
            value = measure(sample)
            if value is not None:
                found.setdefault(sample.backend, []).append(value)
        return {name: median(values) for name, values in found.items()}


# --- measures -------------------------------------------------------------------------


def _measured(name: str) -> Callable[[Sample], float | None]:
    return lambda sample: sample.values.get(name)


def _kept(sample: Sample) -> float:
    """Percent of the published messages that were found in the backend."""
    return float(100 * sample.values["persisted"] / sample.values["published"])


def _cpu(sample: Sample) -> float | None:
    """Seconds of processor time of logger and servers for a GB that was kept."""
    values = sample.values
    used: float = values["cpu_s"] + values["server_cpu_s"]
    return used / values["persisted_bytes"] * 1e9 if values["persisted_bytes"] else None


def _memory(sample: Sample) -> float:
    return float((sample.values["peak_rss"] + sample.values["server_peak_rss"]) / _MB)


def _disk(sample: Sample) -> float | None:
    kept = sample.values["persisted_bytes"]
    return sample.values["disk_bytes"] / kept if kept else None


def _offered(found: Found) -> float:
    """MB/s at the greatest rate of which nothing was lost."""
    if found.best is None:
        return 0.0
    return float(found.best.values["published_bytes"] / found.best.values["publish_s"] / _MB)


def _ceiling(
    trials: Sequence[Sample],
    axis: str,
    of: Callable[[Found], float],
    *,
    what: str,
    short: str,
    unit: str = "",
) -> Row:
    """What searches for the greatest rate have found."""
    found = searches(trials, axis, record.HARNESS)
    values = {name: median(map(of, ends)) for name, ends in found.items()}
    above = {name for name, ends in found.items() if any(end.is_above for end in ends)}
    return Row(what, short, values, max, unit, frozenset(above))


def rows(results: Results) -> Iterator[Row]:
    """All that was measured of several systems."""
    stream = {"size": LARGEST, "rate": record.START}
    kept = results.medians("record", _kept, **stream)
    yield Row("20 topics of 640 kB at 64 Hz, 819 MB/s: kept", "819 MB/s", kept, max, " %")
    for bytes_ in record.SIZES:
        what = "largest load without a loss, messages of {}, in MB/s"
        if bytes_ != record.SIZES[0]:
            what = "the same, messages of {}"
        trials = results.of("record", failed=True, size=bytes_)
        about = {"what": what.format(size(bytes_)), "short": f"the load of {size(bytes_)}"}
        yield _ceiling(trials, "rate", _offered, **about)
    about = {"what": "a robot's log: fastest play that is kept", "short": "fast play", "unit": "x"}
    trials = results.of("logs", failed=True)
    yield _ceiling(trials, "speed", lambda found: found.rate or 0.0, **about)
    for what, measure, bytes_ in (
        ("processor time for a GB kept of messages of 40 kB, in s", _cpu, _MIDDLE),
        ("the same of messages of 640 kB", _cpu, LARGEST),
        ("peak memory, messages of 640 kB, in MB", _memory, LARGEST),
        ("bytes on the disk for a byte kept of messages of 640 kB", _disk, LARGEST),
    ):
        used = results.medians("record", measure, size=bytes_, rate=record.START)
        yield Row(what, "", {n: v for n, v in used.items() if n != record.HARNESS}, min)
    for what, short, task in (
        ("a topic of an IMU as a frame, in ms", "frames", "IMU to pandas"),
        ("a scan at a time, at random moments, in ms", "scans", "scan at a time"),
        ("a second of scans, in ms", "", "1 s of scans"),
    ):
        yield Row(what, short, results.medians("reading", _measured("ms"), task=task), min)
    for what, short, question, when in (
        ("poses within a region, counted for the first time, in ms", "poses", "Q3", "cold_ms"),
        (
            "positions on one side as a frame, asked again, in ms",
            *("positions", "Q2 positions", "ms"),
        ),
        (
            "a count over a few hundred messages, first time, in ms",
            *("counts of few messages", "Q1", "cold_ms"),
        ),
        ("positions on one side, counted for the first time, in ms", "", "Q2", "cold_ms"),
        ("grasps with the camera in front, first time, in ms", "", "Q4", "cold_ms"),
        ("the same, asked again, in ms", "", "Q4", "ms"),
    ):
        values = results.medians("queries", _measured(when), question=question)
        yield Row(what, short, values, min)


# --- cells and tables -----------------------------------------------------------------


def _table(head: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    rule = "| --- |" + " ---: |" * (len(head) - 1)
    return "\n".join([_line(head), rule, *(_line([cell or "—" for cell in row]) for row in lines)])


def _line(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def escaped(text: str) -> str:
    """Text as Markdown shows it: messages of systems are untrusted."""
    return re.sub(r"([\\`*_|<>\[\]])", r"\\\1", printable(" ".join(text.split())))


def _ahead(behind: Sequence[str]) -> str:
    return " and ".join(", ".join(behind).rsplit(", ", 1))


# --- the page -------------------------------------------------------------------------


def page(journal: Journal) -> str:
    """The page of the results."""
    results = Results(journal)
    parts = [MADE, "# Benchmarks: results", _about(results), *_systems(results)]
    parts += [*_live(results), *_in_use(results), *_missing(results)]
    return "\n\n".join(part for part in parts if part) + "\n"


def conditions(results: Results) -> str:
    """Date, revision and machine of the run, in a sentence."""
    about = results.header
    machine = (
        f"{about['cpu']}, {about['cores']} processors, {about['memory_gib']} GiB, {about['disk']}"
    )
    return escaped(f"Revision {about['revision']}; {about['started'][:10]}, on {machine}.")


def _about(results: Results) -> str:
    last = results.header
    test = results.scale != "full"
    warning = "\n\n> **A test of the command. Its figures mean nothing.**" if test else ""
    versions = {
        "Python": last["python"],
        "MongoDB": last["mongod"],
        "PostgreSQL": last["postgres"],
        "SQLite": last["sqlite"],
        "rosbags": last["packages"]["rosbags"],
    }
    versions["mcap"] = last["packages"]["mcap"]
    listed = ", ".join(f"{name} {version}" for name, version in versions.items())
    spins = sorted(filter(None, (s.values.get("spin_ms") for s in results.of("record"))))
    noise = ""
    if spins:
        fast, slow = spins[len(spins) // 10], spins[len(spins) * 9 // 10]
        noise = (
            f" A fixed piece of work took {number(fast)} ms in the fastest tenth of the trials "
            f"and {number(slow)} ms in the slowest."
        )
    return (
        f"All figures are made by `python -m benchmarks{f' --{results.scale}' if test else ''}` "
        f"([method](benchmarks-method.md), [samples](benchmarks-results/samples.jsonl)), and are "
        f"medians. {conditions(results)} {escaped(listed)}.{noise}{warning}"
    )


def _systems(results: Results) -> list[str]:
    found = [row for row in rows(results) if row.values]
    if not found:
        return []
    columns: dict[str, list[str]] = {}
    for name, kind in BACKENDS.items():  # a system may stream in one form, and answer in another
        if any(name in row.values for row in found):
            columns.setdefault(kind.title, []).append(name)
    lines = []
    for row in found:
        named = [row.first(names) or "" for names in columns.values()]
        best = row.first(set(BACKENDS) - {record.HARNESS})
        shown = [f"**{row.shown(name)}**" if name == best else row.shown(name) for name in named]
        lines.append([row.what, *shown])
    return [
        "## Beside other systems",
        "Twenty topics with messages of one size, the log of a robot "
        f"({RATE} messages a second, with camera and laser), and the paper's questions about "
        "teleoperation, which all answered rightly. The best figure of a row is bold, but for that "
        "of the harness alone. ≥: no more could be offered. ROS bag and MCAP index no fields, so "
        "each question is a loop over messages; the ROS bag does not compress.",
        _table(["", *columns], lines),
    ]


def _live(results: Results) -> list[str]:
    lines = []
    for sample in results.of("live"):
        values, case = sample.values, CASES[str(sample.case["case"])]
        figures = (values.get("s_per_gb"), values.get("memory_mb"))
        cells = [number(one) if one is not None else "" for one in figures]
        lines.append([case.about, str(values["text"]), *cells])
    if not lines:
        return []
    return [
        "## Recording a running robot",
        "A ROS 1 node publishes, `hybridlog record --ros1` records; nothing may be missing that "
        "the loss ledger does not count.",
        _table(["load", "what came of it", "processor time for a GB, s", "memory, MB"], lines),
    ]


def _in_use(results: Results) -> list[str]:
    lines: list[list[str]] = []
    for sample in results.of("tasks"):
        for name, values in sample.values["rows"].items():
            what = f"SQL: {name}" if sample.case["group"] == "sql" else name
            alone = values.get("duckdb_ms")
            beside = "" if alone is None else f" (DuckDB alone {number(alone)})"
            measured = [values.get(one) for one in ("cpu_ms", "peak_mb")]
            cells = [number(one) if one is not None else "" for one in measured]
            lines.append([what, number(values["ms"]) + beside, *cells])
    if not lines:
        return []
    case = results.of("tasks")[0].case
    return [
        "## A store in use",
        f"A recording of {case['seconds']} s of the robot's log, {case['seconds'] * RATE:,} "
        f"messages; then a store of {case['recordings']:,} recordings. Commands are processes of "
        "their own.",
        _table(["", "ms", "of the processor", "memory, MB"], lines),
    ]


def _missing(results: Results) -> list[str]:
    lines = [f"* {title(name)} is missing: {escaped(why)}" for name, why in results.missing]
    lines += [
        f"* {one.study}, {title(one.backend)}, {escaped(str(dict(one.case)))} failed: "
        f"{escaped(one.reason[:300])}"
        for one in results.failed
    ]
    return ["## What was not measured", "\n".join(lines)] if lines else []


# --- the README -----------------------------------------------------------------------


def readme(journal: Journal) -> str:
    """The README's table with what belongs to it, from `BEGIN` to `END`."""
    results = Results(journal)
    found = [row for row in rows(results) if row.short]
    lines = []
    for row in found:
        best = row.first([name for name in row.values if name not in FLOORS and name != OURS])
        rival = f"{row.shown(best)} ({title(best)})" if best else ""
        lines.append(_line([row.what, row.shown(OURS), rival, row.shown("bagfile")]))
    bags = [row.short for row in found if row.is_behind(["bagfile"])]
    ahead = f"A ROS bag is ahead in {_ahead(bags)}. " if bags else ""
    above = any(row.above for row in found)
    offered = "≥: no more could be offered, so two such figures rank nothing. " if above else ""
    text = (
        f"{conditions(results)} `python -m benchmarks` makes them again in under an hour. "
        f"{offered}The best database is the best of MongoDB, PostgreSQL and SQLite. "
        f"{ahead}A ROS bag neither compresses nor indexes; to count in it is a loop over its "
        "messages. The [benchmarks](docs/benchmarks.md) have the other systems, and what a store "
        "costs in use."
    )
    head = ["", "hybridlog", "the best database", "a ROS bag"]
    table = "\n".join(["| | " + " | ".join(head[1:]) + " |", "|---|---|---|---|", *lines])
    return f"{BEGIN}\n{table}\n\n{text}\n{END}"
