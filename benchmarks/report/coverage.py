"""Which backend was measured in which study: what was left out shows in no other table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from benchmarks.backends.registry import BACKENDS
from benchmarks.questions.askers import ASKERS, READERS
from benchmarks.report.book import Book
from benchmarks.report.look import title
from benchmarks.report.model import Table
from benchmarks.report.numbers import listed
from benchmarks.samples import Sample


class _Study(NamedTuple):
    """A study as it is counted.

    Attributes:
        title: For people.
        axes: Of a case; others, such as the rate of a search, are its own affair.
        cases: What it calls them.
        backends: All that can take part.
    """

    title: str
    axes: tuple[str, ...]
    cases: str
    backends: Sequence[str]


def _rows(of: Mapping[str, Mapping[str, str]]) -> list[str]:
    return [row for rows in of.values() for row in rows]


_STUDIES = {
    "throughput": _Study("throughput", ("size", "rate"), "streams", list(BACKENDS)),
    "ceiling": _Study("ceilings", ("size",), "sizes", list(BACKENDS)),
    "persistence": _Study("whole logs", ("log",), "logs", list(BACKENDS)),
    "speed-up": _Study("whole logs, faster", ("log",), "logs", list(BACKENDS)),
    "queries": _Study("questions", ("question",), "questions", _rows(ASKERS)),
    "reading": _Study("reading back", ("task",), "tasks", _rows(READERS)),
}


def table(book: Book) -> Table | None:
    """What each study lacks; None when nothing does."""
    rows = tuple(
        (study.title, text)
        for name, study in _STUDIES.items()
        if (text := _lacks(study, [one for one in book.all if one.study == name]))
    )
    return Table("What was not measured", ("study", "without"), rows) if rows else None


def _lacks(study: _Study, samples: Sequence[Sample]) -> str:
    good = [one for one in samples if one.status == "ok"]
    if not good:
        return "all of it"
    cases = {_case(study, one) for one in good}
    absent, parts = [], []
    for name in study.backends:
        done = len({_case(study, one) for one in good if one.backend == name})
        if not done:
            absent.append(title(name))
        elif done < len(cases):
            parts.append(f"{title(name)} ({done} of {len(cases)} {study.cases} were)")
    return listed([*absent, *parts])


def _case(study: _Study, sample: Sample) -> tuple[str, ...]:
    return tuple(str(sample.case.get(axis)) for axis in study.axes)
