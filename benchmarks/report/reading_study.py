"""Reading in a report: slices by time, messages at random, whole tables."""

from __future__ import annotations

from collections.abc import Sequence

from benchmarks.report.book import Book, by_backend, by_case, middle, named, repetitions, value
from benchmarks.report.look import OURS, title
from benchmarks.report.model import Cell, Graph, Line, Panel, Section, Table
from benchmarks.report.numbers import faster, listed
from benchmarks.samples import Sample

STUDY = "reading"
TASK = "task"
MS = "ms"
FIRST_MS = "first_ms"


def section(book: Book) -> Section | None:
    """Milliseconds for each way of reading; None without samples."""
    samples = book.good(STUDY)
    if not samples:
        return None
    tasks = list(dict.fromkeys(str(one.case[TASK]) for one in samples if TASK in one.case))
    lines = [
        Line(
            name,
            tuple(
                (task, one)
                for task in tasks
                if (one := value(_done(group, task), named(MS))) is not None
            ),
        )
        for name, group in by_backend(samples).items()
    ]
    tables = (
        _table(samples, "Milliseconds", tasks, MS),
        _table(samples, "The first of each repetition, milliseconds", tasks, FIRST_MS),
    )
    graph = Graph(
        "reading",
        "Time to read",
        f"Logarithmic; less is better. Median of {repetitions(samples)}; the bars reach from the "
        "least to the greatest.",
        "bars",
        (Panel("", tuple(lines)),),
        "",
        "ms",
        log_y=True,
    )
    text = (
        "What comes after a question, decoded: a second of a laser's scans at a random time; the "
        "scan that was current at a random moment; a topic as a pandas frame. What must come out "
        "is decoded from the load itself, and everything is compared with it. A backend is opened "
        "once for all of it.",
    )
    return Section("reading", "Reading back", text, (graph,), tables)


def _done(samples: Sequence[Sample], task: str) -> list[Sample]:
    return [one for one in samples if one.case.get(TASK) == task]


def _table(samples: Sequence[Sample], heading: str, tasks: Sequence[str], measure: str) -> Table:
    rows: tuple[tuple[Cell, ...], ...] = tuple(
        (title(name), *(value(_done(group, task), named(measure)) for task in tasks))
        for name, group in by_backend(samples).items()
    )
    note = f"Median (least…greatest) of {repetitions(samples)}."
    return Table(heading, ("backend", *tasks), rows, note, title(OURS))


def findings(book: Book) -> list[str]:
    """Our times against the fastest other way, task by task."""
    parts = []
    for (task,), group in by_case(book.good(STUDY), TASK).items():
        medians = {
            name: found
            for name, of in by_backend(group).items()
            if (found := middle(of, named(MS))) is not None
        }
        others = {name: found for name, found in medians.items() if name != OURS and found}
        if not medians.get(OURS) or not others:
            continue
        best = min(others, key=lambda name: others[name])
        parts.append(f"{task} {faster(medians[OURS], others[best], title(best))}")
    return (
        [f"Reading with hybridlog, beside the fastest other way: {listed(parts)}."] if parts else []
    )
