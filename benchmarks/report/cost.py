"""What keeping a stream costs: CPU time, memory, disk; and whether all was on time."""

from __future__ import annotations

from collections.abc import Sequence

from benchmarks.report.book import (
    MB,
    Book,
    by_backend,
    by_case,
    cpu_per_gb,
    ends,
    middle,
    named,
    number,
    ratio,
    repetitions,
    value,
)
from benchmarks.report.look import OURS, databases, title
from benchmarks.report.model import Cell, Graph, Line, Panel, Section, Table, Value
from benchmarks.report.numbers import number as shown
from benchmarks.report.numbers import size, times
from benchmarks.samples import Sample

_STUDY = "throughput"


def section(book: Book) -> Section | None:
    """CPU seconds a GB, peak memory, bytes on the disk; None without samples."""
    samples = book.good(_STUDY)
    if not samples:
        return None
    text = (
        "CPU time of the logger's process and of the servers it started, over the payload that "
        "was kept; the publisher's is not in it. All rates together at which a backend was "
        "measured: a slow stream of small messages costs more a GB than a fast one.",
        "Memory is the kernel's high-water mark of resident memory: of the logger without the "
        "payload file that it maps, of servers with what their processes share counted once.",
    )
    return Section(
        "cost",
        "What it costs: processor, memory, disk",
        text,
        (_graph(samples),),
        (_cpu(samples), _memory(samples), _disk(samples)),
    )


def findings(book: Book) -> list[str]:
    """CPU time of ours against the thriftiest database, at the ends of both axes.

    A slow stream costs more a GB than a fast one, so each rate stands alone.
    """
    told: dict[int, list[str]] = {}
    for (length, rate), group in by_case(book.good(_STUDY), "size", "rate").items():
        if text := _beside_databases(book, length, rate, group):
            told.setdefault(length, []).append(text)
    return [text for length in ends(told) for text in ends(told[length])]


def _beside_databases(book: Book, length: int, rate: float, samples: Sequence[Sample]) -> str:
    """CPU time of ours and of the thriftiest database; empty when either was not measured.

    A machine is faster on one day than on another, so it is that of runs of both, if any.
    """
    groups = by_backend(samples)
    medians = {name: one for name, of in groups.items() if (one := middle(of, _cpu_both))}
    others = databases(medians)
    if OURS not in medians or not others:
        return ""
    best = min(others, key=lambda name: medians[name])
    ours, theirs, where = medians[OURS], medians[best], ""
    if (both := book.in_same_runs(groups[OURS], groups[best])) is not None:
        mine, other = (middle(group, _cpu_both) for group in both)
        if mine and other:
            ours, theirs, where = mine, other, " in the same runs"
    return (
        f"At {size(length)} a message and {rate:g} Hz a topic, a GB costs hybridlog "
        f"{shown(ours)} s of CPU time; the thriftiest database, {title(best)}, takes "
        f"{shown(theirs)} s{where} ({times(theirs / ours)} as much)."
    )


def timing(book: Book) -> Section | None:
    """How late the publisher was, and how deep the queues were."""
    samples = [one for one in book.all if one.status == "ok" and "late_ms_p99" in one.values]
    if not samples:
        return None
    tables = tuple(
        Table(
            f"{study}: queues and publisher",
            (
                "backend",
                "queue depth p50",
                "p90",
                "p99",
                "most",
                "publisher late p50, ms",
                "p99, ms",
                "most, ms",
            ),
            tuple(
                (
                    title(name),
                    *(_median_of(group, f"depth_{part}") for part in ("p50", "p90", "p99")),
                    _most(group, "depth_max"),
                    *(_median_of(group, f"late_ms_{part}") for part in ("p50", "p99")),
                    _most(group, "late_ms_max"),
                )
                for name, group in by_backend(of_study).items()
            ),
            f"Medians over all runs of the study ({len(of_study)}); “most” is of any run.",
            title(OURS),
        )
        for study in ("throughput", "persistence", "ceiling", "speed-up")
        if (of_study := [one for one in samples if one.study == study])
    )
    text = (
        "A queue holds ten messages; the depth is what a message finds ahead of it in its "
        "topic's queue, with hybridlog (recorder) ahead of it of all topics. A publisher that is "
        "late while a backend is busy is short of processor time: logger and publisher share the "
        "machine, as they do on a robot.",
    )
    return Section("timing", "On time: queues and publisher", text, (), tables)


def _cpu_both(sample: Sample) -> float | None:
    own = cpu_per_gb("cpu_s")(sample)
    servers = cpu_per_gb("server_cpu_s")(sample)
    return None if own is None else own + (servers or 0.0)


def _graph(samples: Sequence[Sample]) -> Graph:
    lines = []
    for name, group in by_backend(samples).items():
        points = ((float(n), value(one, _cpu_both)) for (n,), one in by_case(group, "size").items())
        lines.append(Line(name, tuple((x, y) for x, y in points if y is not None)))
    return Graph(
        "cpu",
        "CPU seconds for a GB of payload",
        "Logger and servers together; less is better. Median over all rates; the bars reach from "
        f"the least to the greatest. {repetitions(samples)} a stream.",
        "lines",
        (Panel("", tuple(lines)),),
        "message size",
        "CPU s / GB",
        log_x=True,
        log_y=True,
        ticks=tuple((float(n), size(n)) for (n,) in by_case(samples, "size")),
    )


def _cpu(samples: Sequence[Sample]) -> Table:
    extremes = ends(by_case(samples, "size"))
    columns = ["backend"]
    for (n,) in extremes:
        columns += [f"{size(n)}: logger", f"{size(n)}: servers"]
    rows: list[tuple[Cell, ...]] = []
    for name, group in by_backend(samples).items():
        row: list[Cell] = [title(name)]
        for case in extremes:
            of_size = by_case(group, "size").get(case, [])
            row += [value(of_size, cpu_per_gb(part)) for part in ("cpu_s", "server_cpu_s")]
        rows.append(tuple(row))
    return Table(
        "CPU seconds for a GB of payload",
        tuple(columns),
        tuple(rows),
        "Median (least…greatest) over all rates and repetitions.",
        title(OURS),
    )


def _memory(samples: Sequence[Sample]) -> Table:
    rows = tuple(
        (
            title(name),
            value(group, named("peak_rss", MB)),
            value(group, named("server_peak_rss", MB)),
        )
        for name, group in by_backend(samples).items()
    )
    return Table(
        "Peak memory, MB",
        ("backend", "logger", "servers"),
        rows,
        "Median (least…greatest) over all streams and repetitions.",
        title(OURS),
    )


def _disk(samples: Sequence[Sample]) -> Table:
    cases = by_case(samples, "size")
    rows = tuple(
        (
            title(name),
            *(
                value(
                    [one for one in group if one.backend == name],
                    lambda one: ratio(one, "disk_bytes", "persisted_bytes"),
                )
                for group in cases.values()
            ),
        )
        for name in by_backend(samples)
    )
    return Table(
        "Bytes on the disk over bytes of payload",
        ("backend", *(size(n) for (n,) in cases)),
        rows,
        "Everything below the backend's directory after it was closed: journals, logs and space "
        "set aside included, which weighs most in short streams.",
        title(OURS),
    )


def _median_of(samples: Sequence[Sample], name: str) -> Cell:
    found = value(samples, named(name))
    return None if found is None else shown(found.median)


def _most(samples: Sequence[Sample], name: str) -> Cell:
    known = [one for sample in samples if (one := number(sample.values, name)) is not None]
    found = Value.of(known)
    return None if found is None else shown(found.high)
