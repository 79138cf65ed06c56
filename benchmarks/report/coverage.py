"""Which backend was measured in which study: what was left out shows in no other table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import NamedTuple

from benchmarks.backends.registry import BACKENDS
from benchmarks.questions.askers import ASKERS, READERS
from benchmarks.report.book import Book, by_backend, by_case
from benchmarks.report.look import title
from benchmarks.report.model import Table
from benchmarks.report.numbers import listed
from benchmarks.samples import Sample


class _Study(NamedTuple):
    """A study as it is counted.

    Attributes:
        title: For people.
        axes: Of a case; others, such as the rate of a search, are its own affair.
        settings: Lists among those of a run that say which values of the axes it was to
            measure; real logs, which are paths there, do not count.
        cases: What it calls them.
        backends: All that can take part.
    """

    title: str
    axes: tuple[str, ...]
    settings: tuple[str, ...]
    cases: str
    backends: Sequence[str]


def _rows(of: Mapping[str, Mapping[str, str]]) -> list[str]:
    return [row for rows in of.values() for row in rows]


STUDIES = {
    "throughput": _Study(
        "throughput", ("size", "rate"), ("sizes", "rates"), "streams", list(BACKENDS)
    ),
    "ceiling": _Study("ceilings", ("size",), ("sizes",), "sizes", list(BACKENDS)),
    "persistence": _Study("logs", ("log",), ("made",), "logs", list(BACKENDS)),
    "speed-up": _Study("logs, faster", ("log",), ("made",), "logs", list(BACKENDS)),
    "queries": _Study("questions", ("question",), (), "questions", _rows(ASKERS)),
    "reading": _Study("reading back", ("task",), (), "tasks", _rows(READERS)),
}
"""By the names that samples have for them."""


def what(sample: Sample) -> tuple[tuple[int, float], str]:
    """What a sample is of, in the words of its study, behind its place among all studies."""
    rate = float(sample.case.get("rate", 0)) if sample.study == "throughput" else 0.0
    name = f"streams, {rate:g} Hz" if rate else STUDIES[sample.study].title
    return (list(STUDIES).index(sample.study), rate), name


def table(book: Book) -> Table | None:
    """What each study lacks; None when nothing does."""
    rows = tuple(
        (study.title, text)
        for name, study in STUDIES.items()
        if (text := _lacks(study, book.good(name), _planned(study, book, name)))
    )
    return Table("What was not measured", ("study", "without"), rows) if rows else None


def _planned(study: _Study, book: Book, name: str) -> set[tuple[object, ...]]:
    """What the runs of a study were to measure, as far as they list it."""
    lists = [book.planned(name, setting) for setting in study.settings]
    return set(product(*lists)) if lists else set()


def _lacks(study: _Study, good: Sequence[Sample], planned: set[tuple[object, ...]]) -> str:
    if not good:
        return "all of it"
    whole, of = len(planned | by_case(good, *study.axes).keys()), by_backend(good)
    absent, parts = [], []
    for name in study.backends:
        done = len(by_case(of.get(name, ()), *study.axes))
        if not done:
            absent.append(title(name))
        elif done < whole:
            parts.append(f"{title(name)} ({done} of {whole} {study.cases} were)")
    return listed([*absent, *parts])
