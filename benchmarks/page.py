"""From a journal to the page of the results, and to the table of the README."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from benchmarks.live.cases import CASES
from benchmarks.loads.robot import RATE
from benchmarks.numbers import FLOORS, OURS, Spread, number, ordered, percent, size, title
from benchmarks.samples import Journal, Sample
from benchmarks.studies import record
from benchmarks.studies.search import Found, searches
from hybridlog.cli.output import printable

Cell = str | None
Values = dict[str, Spread]
"""Figures by backend."""
MADE = "<!-- made by `python -m benchmarks`; change benchmarks/page.py -->"
BEGIN, END = "<!-- measured -->", "<!-- /measured -->"
_MB = 1e6
LARGEST = record.SIZES[-1]


class Row(NamedTuple):
    """A row of the README's table.

    Attributes:
        what: What was measured.
        short: The same, to say where a bag is ahead.
        values: By backend.
        best: `max` or `min`, whichever is better.
        unit: After a figure.
        above: Backends whose figures are higher than shown: the harness offered no more.
    """

    what: str
    short: str
    values: Values
    best: Callable[..., str]
    unit: str = ""
    above: frozenset[str] = frozenset()


class Results:
    """The samples of a journal by study.

    Args:
        journal: Of runs of one scale.
    """

    def __init__(self, journal: Journal) -> None:
        self.header = journal.header
        self.scale = str(journal.header["scale"])
        self._samples = journal.samples
        self.failed = [one for one in self._samples if one.status == "failed"]
        self.missing = sorted(
            {(s.backend, s.reason) for s in self._samples if s.status == "missing"}
        )
        self.streams = {
            bytes_: searches(
                [s for s in self.of("record", failed=True) if s.case["size"] == bytes_],
                "rate",
                record.HARNESS,
            )
            for bytes_ in record.SIZES
        }
        self.speeds = searches(self.of("logs", failed=True), "speed", record.HARNESS)

    def of(self, study: str, *, failed: bool = False) -> list[Sample]:
        """Samples of a study that succeeded, or failed as well."""
        wanted = ("ok", "failed") if failed else ("ok",)
        return [s for s in self._samples if s.study == study and s.status in wanted]

    def spread(self, study: str, measure: Callable[[Sample], float | None], **case: Any) -> Values:
        """A measure of the samples of a case, by backend."""
        found: dict[str, list[float | None]] = {}
        for sample in self.of(study):
            if all(sample.case.get(name) == value for name, value in case.items()):
                found.setdefault(sample.backend, []).append(measure(sample))
        spreads = {name: Spread.of(found[name]) for name in ordered(found)}
        return {name: spread for name, spread in spreads.items() if spread is not None}

    def group(self, name: str) -> Mapping[str, Any]:
        """What a group of tasks has measured."""
        for sample in self.of("tasks"):
            if sample.case["group"] == name:
                return sample.values
        return {}


# --- measures -------------------------------------------------------------------------


def _measured(name: str, scale: float = 1.0) -> Callable[[Sample], float | None]:
    def measure(sample: Sample) -> float | None:
        value = sample.values.get(name)
        return value / scale if isinstance(value, int | float) else None

    return measure


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


def _ceilings(found: Mapping[str, Sequence[Found]], measure: Callable[[Found], float]) -> Values:
    spreads = {name: Spread.of(map(measure, found[name])) for name in ordered(found)}
    return {name: spread for name, spread in spreads.items() if spread is not None}


def _above(found: Mapping[str, Sequence[Found]]) -> frozenset[str]:
    return frozenset(name for name, ends in found.items() if any(end.is_above for end in ends))


# --- cells and tables -----------------------------------------------------------------


def _shown(value: Spread | None, *, above: bool = False, of_hundred: bool = False) -> str:
    """A median, and how far the values lie apart when that is more than a tenth of it."""
    if value is None:
        return "—"
    if of_hundred:
        return percent(value.median)
    apart = value.high - value.low > 0.1 * abs(value.median)
    spread = f" ({number(value.low)}…{number(value.high)})" if apart else ""
    return f"{'≥ ' if above else ''}{number(value.median)}{spread}"


def _table(head: Sequence[str], rows: Iterable[Sequence[Cell]]) -> str:
    lines = [_line(head), "| --- |" + " ---: |" * (len(head) - 1)]
    return "\n".join([*lines, *(_line([cell or "—" for cell in row]) for row in rows)])


def _line(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def escaped(text: str) -> str:
    """Text as Markdown shows it: messages of systems are untrusted."""
    return re.sub(r"([\\`*_|<>\[\]])", r"\\\1", printable(" ".join(text.split())))


def _by_backend(head: Sequence[str], columns: Sequence[Mapping[str, str]]) -> str:
    names = ordered({name for column in columns for name in column})
    return _table(
        head, [[title(name), *(column.get(name) for column in columns)] for name in names]
    )


# --- the page -------------------------------------------------------------------------


def page(journal: Journal) -> str:
    """The page of the results."""
    results = Results(journal)
    parts = [
        MADE,
        "# Benchmarks: results",
        _about(results),
        *_recording(results),
        *_live(results),
        *_questions(results),
        *_reading(results),
        *_tasks(results),
        *_missing(results),
    ]
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
    quick = {
        "full": "",
        "quick": "\n\n> **A short run: loads are only doubled, and each is searched once.**",
        "tiny": "\n\n> **A test of the command. Its figures mean nothing.**",
    }[results.scale]
    option = "" if results.scale == "full" else f" --{results.scale}"
    versions = ", ".join(
        f"{name} {version}"
        for name, version in (
            ("Python", last["python"]),
            ("MongoDB", last["mongod"]),
            ("PostgreSQL", last["postgres"]),
            ("SQLite", last["sqlite"]),
            ("rosbags", last["packages"]["rosbags"]),
            ("mcap", last["packages"]["mcap"]),
        )
    )
    spins = sorted(filter(None, (s.values.get("spin_ms") for s in results.of("record"))))
    noise = ""
    if spins:
        fast, slow = spins[len(spins) // 10], spins[len(spins) * 9 // 10]
        noise = (
            f" A fixed piece of work took {number(fast)} ms in the fastest tenth of the trials "
            f"and {number(slow)} ms in the slowest."
        )
    return (
        f"All figures are made by `python -m benchmarks{option}` in under an hour "
        f"([method](benchmarks-method.md), [samples](benchmarks-results/samples.jsonl)). "
        f"{conditions(results)} {escaped(versions)}.{noise} A cell is the median; where values "
        f"lie more than a tenth apart, the least and the greatest follow.{quick}"
    )


def _recording(results: Results) -> list[str]:
    if not results.of("record"):
        return []
    streams = results.streams
    columns: list[dict[str, str]] = []
    for bytes_ in record.SIZES:
        above = _above(streams[bytes_])
        values = _ceilings(streams[bytes_], _offered)
        columns.append({n: _shown(v, above=n in above) for n, v in values.items()})
    above = _above(results.speeds)
    speeds = _ceilings(results.speeds, lambda found: found.rate or 0.0)
    columns.append({n: _shown(v, above=n in above) for n, v in speeds.items()})
    kept = results.spread("record", _kept, size=LARGEST, rate=record.START)
    columns.append({n: f"{_shown(v, of_hundred=True)} %" for n, v in kept.items()})
    costs = []
    for bytes_ in record.SIZES:
        used = results.spread("record", _cpu, size=bytes_, rate=record.START)
        costs.append({n: _shown(v) for n, v in used.items() if n != record.HARNESS})
    for measure, bytes_ in ((_memory, record.SIZES[1]), (_memory, LARGEST), (_disk, LARGEST)):
        used = results.spread("record", measure, size=bytes_, rate=record.START)
        costs.append({n: _shown(v) for n, v in used.items() if n != record.HARNESS})
    sizes = [size(bytes_) for bytes_ in record.SIZES]
    return [
        "## Recording",
        "Twenty topics with messages of one size: the largest load in MB/s of which every message "
        "was found afterwards; how much faster than real time the log of a robot "
        f"({RATE} messages a second, with camera and laser) is kept whole; and what is kept of "
        "640 kB at 64 Hz a topic, 819 MB/s. ≥: the harness could not offer more.",
        _by_backend(["system", *sizes, "a robot's log, times", "kept of 819 MB/s"], columns),
        "A trial is short, so part of a heavy stream may wait in memory: hybridlog within its "
        "budget, files in the cache of the system. ROS bag and MCAP index no fields; the ROS bag "
        "does not compress.",
        "At 64 Hz a topic: seconds of processor time for a GB that was kept, servers included; "
        "peak memory in MB, servers included; bytes on the disk over bytes kept of 640 kB, half "
        "of which cannot be compressed. hybridlog compresses only what it has time for.",
        _by_backend(
            [
                *("system", *(f"s/GB, {text}" for text in sizes)),
                *(f"memory, {text}" for text in sizes[1:]),
                "disk",
            ],
            costs,
        ),
    ]


def _live(results: Results) -> list[str]:
    rows = [
        [_about_case(str(row["case"])), str(row["recorder"]), str(row["text"])]
        for sample in results.of("live", failed=True)
        for row in sample.values.get("rows", ())
    ]
    if not rows:
        return []
    return [
        "## Recording a running robot",
        "A ROS 1 node publishes, `hybridlog record --ros1` records; it must be that nothing is "
        "*missing without a word*. The largest age of the last message at a kill -9 is what a "
        "crash may cost.",
        "\n".join(
            [_line(["case", "recorder", "what came of it"]), "| --- | --- | --- |"]
            + [_line(row) for row in rows]
        ),
    ]


def _about_case(name: str) -> str:
    return CASES[name].about if name in CASES else name


def _pivot(results: Results, study: str, axis: str, measures: Sequence[str]) -> str:
    """A row for each question, a column for each backend."""
    places = list(dict.fromkeys(str(s.case[axis]) for s in results.of(study)))
    names = ordered({s.backend for s in results.of(study)})
    rows = []
    for place in places:
        found = [results.spread(study, _measured(one), **{axis: place}) for one in measures]
        cells = []
        for name in names:
            values = [number(of[name].median) for of in found if name in of]
            cells.append(" / ".join(values) or None)
        rows.append([place, *cells])
    return _table(["ms", *map(title, names)], rows)


def _questions(results: Results) -> list[str]:
    if not results.of("queries"):
        return []
    case = results.of("queries")[0].case
    return [
        "## Questions",
        f"Milliseconds, asked for the first time / again by a process that has opened the store, "
        f"on {case['sessions']} x {case['minutes']:g} minutes of teleoperation (the "
        "paper's study). Q1: how often the gripper was closed. Q2: viewpoints behind the robot. "
        "Q3: poses of the arm within a region. Q4: grasps with the camera in front within half a "
        "second. All systems gave the true answers. The databases have the paper's indexes; for "
        "the ROS bag it is a loop over the messages.",
        _pivot(results, "queries", "question", ("cold_ms", "ms")),
    ]


def _reading(results: Results) -> list[str]:
    if not results.of("reading"):
        return []
    return [
        "## Reading",
        "Milliseconds, decoded, from an open store: a second of laser scans, the scan at a random "
        "moment, an IMU's topic as a pandas frame.",
        _pivot(results, "reading", "task", ("ms",)),
    ]


def _tasks(results: Results) -> list[str]:
    parts = ["## A store in use"] if results.of("tasks") else []
    commands, many = results.group("commands"), results.group("many")
    if commands:
        case = next(s.case for s in results.of("tasks") if s.case["group"] == "commands")
        parts += [
            f"One recording of {case['seconds']} s of the robot's log, {case['seconds'] * RATE:,} "
            f"messages: {size(commands['log_bytes'])} of MCAP, {size(commands['segment_bytes'])} "
            f"of segments, {size(commands['disk_bytes'])} with all indexes. Each command is a "
            "process of its own.",
            _rows("command", commands["rows"]),
        ]
    page_, sql = (results.group(name) for name in ("page", "sql"))
    if sql:
        head = ["SQL in an open store", "ms", "DuckDB alone, ms"]
        rows = [[n, _ms(v), number(v["duckdb_ms"])] for n, v in sql["rows"].items()]
        parts.append(_table(head, rows))
    if many:
        case = next(s.case for s in results.of("tasks") if s.case["group"] == "many")
        parts.append(_rows(f"store of {case['recordings']:,} recordings", many["rows"]))
    if page_:
        memory = f"page of `hybridlog view` ({number(page_['memory_mb'])} MB)"
        rows = [[name, _ms(values)] for name, values in page_["rows"].items()]
        parts.append(_table([memory, "ms"], rows))
    if bucket := results.group("remote"):
        head = ["a store in a bucket", "requests", "bytes received", "bytes sent"]
        names = ("requests", "received", "sent")
        rows = [[row["step"], *(f"{row[name]:,}" for name in names)] for row in bucket["rows"]]
        parts.append(_table(head, rows))
    return parts


def _rows(what: str, rows: Mapping[str, Mapping[str, float]]) -> str:
    """Time on the clock, of the processor, and memory where it was measured."""
    has_memory = any("peak_mb" in values for values in rows.values())
    head = [what, "ms", "of the processor", *(["memory, MB"] if has_memory else [])]
    cells = []
    for name, values in rows.items():
        peak = [number(values["peak_mb"]) if "peak_mb" in values else "—"] if has_memory else []
        cells.append([name, _ms(values), number(values["cpu_ms"]), *peak])
    return _table(head, cells)


def _ms(values: Mapping[str, float]) -> str:
    low, high = values.get("low", values["ms"]), values.get("high", values["ms"])
    return _shown(Spread(values["ms"], low, high))


def _missing(results: Results) -> list[str]:
    lines = [f"* {title(name)} is missing: {escaped(why)}" for name, why in results.missing]
    lines += [
        f"* {one.study}, {title(one.backend)}, {escaped(str(dict(one.case)))} failed: "
        f"{escaped(one.reason[:300])}"
        for one in results.failed
    ]
    return ["## What was not measured", "\n".join(lines)] if lines else []


# --- the README -----------------------------------------------------------------------


def readme_rows(results: Results) -> list[Row]:
    """The rows of the README's table."""
    ms = _measured("ms")
    stream = {"size": LARGEST, "rate": record.START}
    rows = [
        Row(
            "20 topics of 640 kB at 64 Hz, 819 MB/s: kept",
            "819 MB/s",
            results.spread("record", _kept, **stream),
            max,
            " %",
        )
    ]
    for bytes_ in record.SIZES:
        what = "largest load without a loss, messages of {}, in MB/s"
        if bytes_ != record.SIZES[0]:
            what = "the same, messages of {}"
        found = results.streams[bytes_]
        values = _ceilings(found, _offered)
        short = f"the load of {size(bytes_)}"
        rows.append(Row(what.format(size(bytes_)), short, values, max, above=_above(found)))
    speeds = _ceilings(results.speeds, lambda found: found.rate or 0.0)
    above = _above(results.speeds)
    rows.append(
        Row("a robot's log: fastest play that is kept", "fast play", speeds, max, "x", above)
    )
    frame, moment = (
        results.spread("reading", ms, task=task) for task in ("IMU to pandas", "scan at a time")
    )
    cold = _measured("cold_ms")
    return [
        *rows,
        Row("a topic of an IMU as a frame, in ms", "frames", frame, min),
        Row("a scan at a time, at random moments, in ms", "scans", moment, min),
        Row(
            "poses within a region, counted for the first time, in ms",
            "poses",
            results.spread("queries", cold, question="Q3"),
            min,
        ),
        Row(
            "positions on one side as a frame, asked again, in ms",
            "positions",
            results.spread("queries", ms, question="Q2 positions"),
            min,
        ),
        Row(
            "a count over a few hundred messages, first time, in ms",
            "counts of few messages",
            results.spread("queries", cold, question="Q1"),
            min,
        ),
    ]


def readme(journal: Journal) -> str:
    """The README's table with what belongs to it, from `BEGIN` to `END`."""
    results = Results(journal)
    lines, bags, at_least = [], [], False
    for what, short, values, best, unit, above in readme_rows(results):

        def shown(name: str, of: Values = values, unit: str = unit, up: Any = above) -> str:
            median = of[name].median
            text = percent(median) if unit == " %" else number(median)
            return f"{'≥ ' if name in up else ''}{text}{unit}"

        rivals = {n: v.median for n, v in values.items() if n not in FLOORS and n != OURS}
        strongest = best(rivals, key=rivals.__getitem__) if rivals else None
        rival = f"{shown(strongest)} ({title(strongest).split(' (')[0]})" if strongest else ""
        bag = shown("bagfile") if "bagfile" in values else ""
        at_least |= bool(above)
        lines.append(_line([what, shown(OURS) if OURS in values else "", rival, bag]))
        if bag and OURS in values:
            two = {name: values[name].median for name in (OURS, "bagfile")}
            if shown(OURS) != bag and best(two, key=two.__getitem__) == "bagfile":
                bags.append(short)
    names = " and ".join(", ".join(bags).rsplit(", ", 1))
    ahead = f"A ROS bag is ahead in {names}. " if bags else ""
    option = "" if results.scale == "full" else f" --{results.scale}"
    offered = "≥: no more could be offered, so two such figures rank nothing. " if at_least else ""
    short = "It was a short run, in which loads are only doubled. " if option else ""
    text = (
        f"{conditions(results)} `python -m benchmarks{option}` makes them again in under an hour. "
        f"{short}{offered}The best database is the best of MongoDB, PostgreSQL and SQLite. "
        f"{ahead}A ROS bag neither compresses nor indexes; to count in it is a loop over its "
        "messages. The [benchmarks](docs/benchmarks.md) have the other systems, the spread of "
        "each figure, and what a store costs in use."
    )
    head = ["", "hybridlog", "the best database", "a ROS bag"]
    table = "\n".join(["| | " + " | ".join(head[1:]) + " |", "|---|---|---|---|", *lines])
    return f"{BEGIN}\n{table}\n\n{text}\n{END}"
