"""Study 1 in a report: throughput over message size and rate, Figures 3 and 4."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import ceil

from benchmarks.report.book import (
    Book,
    backends,
    by_backend,
    by_case,
    is_whole,
    middle,
    offered,
    percents,
    persisted,
    repetitions,
    throughput,
    value,
    with_meaning,
)
from benchmarks.report.look import OURS, databases, title
from benchmarks.report.model import Cell, Graph, Line, Panel, Section, Table
from benchmarks.report.numbers import listed, number, size, times
from benchmarks.samples import Sample

STUDY = "throughput"
_POSTGRES = ("postgres_autocommit", "postgres_tuned")


def section(book: Book) -> Section | None:
    """Figures 3 and 4 with their numbers; None without samples."""
    samples = book.good(STUDY)
    if not samples:
        return None
    graphs = [_figure_4(samples)]
    tuned = [one for one in samples if one.backend in _POSTGRES]
    if len({one.backend for one in tuned}) == len(_POSTGRES):
        graphs.insert(0, _figure_3(tuned))
    text = [
        f"{_topics(samples)} at one rate, all messages of one size; half of each payload is "
        "noise, half is smooth. Throughput is the bytes that were found in the backend afterwards "
        "over the time from the first message until everything was safe on the disk. A message "
        "that finds ten ahead of it in its topic's queue is dropped.",
        "The databases and files work in the threads of the queues. hybridlog takes a message "
        "into memory there, a sixteenth of the machine's at most, and writes with threads of its "
        "own; the time until all is safe includes what it then has still to write. hybridlog "
        "(recorder) has one thread instead of the queues, before which 512 MiB may wait.",
        "While a backend keeps up, its throughput is the offered load: all lines lie on top of "
        "each other. What differs there is the CPU time (below).",
    ]
    return Section(
        "throughput", "Study 1: throughput", tuple(text), tuple(graphs), _tables(samples)
    )


def _topics(samples: Sequence[Sample]) -> str:
    counts = sorted({str(one.case["topics"]) for one in samples if "topics" in one.case})
    return f"{listed(counts)} topics" if counts else "Topics"


def findings(book: Book) -> list[str]:
    """What Figure 4 shows, in sentences."""
    samples = book.good(STUDY)
    if not samples:
        return []
    found = []
    streams = by_case(samples, "size", "rate")
    heaviest = max(streams, key=lambda case: middle(streams[case], offered) or 0)
    at = f"{size(heaviest[0])} messages at {number(heaviest[1])} Hz a topic"
    load = middle(streams[heaviest], offered)
    if load is not None:
        shares = [
            f"{title(name)} {share} %"
            for name, group in by_backend(streams[heaviest]).items()
            if (share := percents(group)) is not None
        ]
        found.append(
            f"Of the heaviest stream ({at}, {number(load)} MB/s) these shares were kept: "
            f"{listed(shares)}."
        )
    found.extend(_against(streams[heaviest], at))
    whole = [
        f"{title(name)} {sum(is_whole(group) for group in cases.values())} of {len(cases)}"
        for name, group in by_backend(samples).items()
        if (cases := by_case(group, "size", "rate"))
    ]
    found.append(f"Streams of which nothing was dropped in any repetition: {listed(whole)}.")
    return found


def paper_says(book: Book) -> list[tuple[str, str]]:
    """The paper's sentences on study 1 beside what was found here."""
    samples = book.good(STUDY)
    peaks = {
        name: max(medians)
        for name, group in by_backend(samples).items()
        if name in databases([name])
        and (
            medians := [
                found
                for one in by_case(group, "size", "rate").values()
                if (found := middle(one, throughput)) is not None
            ]
        )
    }
    said = []
    systems = {_system(name) for name in peaks}
    if len(systems) > 1:
        best = max(peaks, key=lambda name: peaks[name])
        shown = listed([f"{title(name)} {number(peak)}" for name, peak in peaks.items()])
        said.append(
            (
                "SQLite3 has the highest synthetic throughput, PostgreSQL by far the least.",
                f"Of the databases, {title(best)} reached the most; the highest MB/s of each: "
                f"{shown}.",
            )
        )
    groups = by_backend(samples)
    if all(name in groups for name in _POSTGRES):
        gains = [
            tuned / plain
            for case, group in by_case(groups[_POSTGRES[0]], "size", "rate").items()
            if (plain := middle(group, throughput))
            and (
                tuned := middle(
                    by_case(groups[_POSTGRES[1]], "size", "rate").get(case, []), throughput
                )
            )
        ]
        if gains:
            said.append(
                (
                    "Batches of two seconds and larger buffers help PostgreSQL, by a small amount.",
                    f"The tuned one reached {times(min(gains))} to {times(max(gains))} the "
                    "throughput of autocommit, depending on the stream.",
                )
            )
    return said


def _system(backend: str) -> str:
    return backend.partition("_")[0]


def _against(samples: Sequence[Sample], at: str) -> list[str]:
    medians = {
        name: found
        for name, group in by_backend(samples).items()
        if (found := middle(group, throughput)) is not None
    }
    others = [name for name in databases(medians) if medians[name]]
    if OURS not in medians or not others:
        return []
    best = max(others, key=lambda name: medians[name])
    return [
        f"With {at}, hybridlog kept {number(medians[OURS])} MB/s, "
        f"{times(medians[OURS] / medians[best])} what the best database kept "
        f"({title(best)}, {number(medians[best])} MB/s)."
    ]


def _figure_3(samples: Sequence[Sample]) -> Graph:
    panels = _panels(samples)
    # What is offered may be a hundred times as much, and would press both lines to the ground.
    most = max(
        (
            one.high
            for panel in panels
            for line in panel.lines
            if line.backend in _POSTGRES
            for _, one in line.points
        ),
        default=0.0,
    )
    return Graph(
        "figure-3",
        "Figure 3: PostgreSQL, autocommit and tuned",
        f"Throughput over message size, by rate. {_how(samples)} Where it is far above, it leaves "
        "the picture.",
        "lines",
        panels,
        "message size",
        "throughput, MB/s",
        log_x=True,
        y_range=(0.0, 4.0 * max(1, ceil(1.05 * most / 4))),
        ticks=_ticks(samples),
    )


def _figure_4(samples: Sequence[Sample]) -> Graph:
    return Graph(
        "figure-4",
        "Figure 4: throughput over message size",
        "One graph a rate, one line a backend, broken where sizes between were not measured. "
        f"{_how(samples)}",
        "lines",
        _panels([one for one in samples if one.backend != _POSTGRES[0]]),
        "message size",
        "throughput, MB/s",
        log_x=True,
        ticks=_ticks(samples),
    )


def _how(samples: Sequence[Sample]) -> str:
    return (
        f"Median of {repetitions(samples)}; the bars reach from the least to the greatest. "
        "The dashed line is the offered load."
    )


def _panels(samples: Sequence[Sample]) -> tuple[Panel, ...]:
    return tuple(
        Panel(
            f"{number(rate)} Hz a topic",
            tuple(_line(name, group) for name, group in by_backend(of_rate).items()),
            tuple(
                (float(bytes_), load)
                for (bytes_,), group in by_case(of_rate, "size").items()
                if (load := middle(group, offered)) is not None
            ),
        )
        for (rate,), of_rate in by_case(samples, "rate").items()
    )


def _line(backend: str, samples: Sequence[Sample]) -> Line:
    points = (
        (float(bytes_), value(group, throughput))
        for (bytes_,), group in by_case(samples, "size").items()
    )
    return Line(backend, tuple((x, y) for x, y in points if y is not None))


def _ticks(samples: Sequence[Sample]) -> tuple[tuple[float, str], ...]:
    return tuple((float(bytes_), size(bytes_)) for (bytes_,) in by_case(samples, "size"))


def _tables(samples: Sequence[Sample]) -> tuple[Table, ...]:
    tables = []
    for (rate,), of_rate in by_case(samples, "rate").items():
        tables.append(
            _table(
                of_rate,
                f"Throughput at {number(rate)} Hz a topic, MB/s",
                lambda group: value(group, throughput),
            )
        )
        if any((persisted(one) or 0) < 100 for one in of_rate):
            tables.append(
                _table(
                    of_rate,
                    f"Persisted at {number(rate)} Hz a topic, % of the messages",
                    percents,
                )
            )
    return tuple(tables)


def _table(
    samples: Sequence[Sample], heading: str, measure: Callable[[list[Sample]], Cell]
) -> Table:
    cases = by_case(samples, "size")
    rows: list[tuple[Cell, ...]] = []
    if "MB/s" in heading:
        loads = (value(group, offered) for group in cases.values())
        rows.append(("offered", *(None if one is None else number(one.median) for one in loads)))
    for name in backends(samples):
        cells = (measure([one for one in group if one.backend == name]) for group in cases.values())
        rows.append((title(name), *cells))
    columns = ("backend", *(size(bytes_) for (bytes_,) in cases))
    note = f"Median (least…greatest) of {repetitions(samples)}."
    if measure is percents:
        note = with_meaning(note, samples)
    return Table(heading, columns, tuple(rows), note, title(OURS))
