"""The files of a report: a page, a document, the figures."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from benchmarks.report.figures import FiguresMissingError, svg
from benchmarks.report.markdown import markdown
from benchmarks.report.model import Report
from benchmarks.report.page import page
from benchmarks.samples import naming

PAGE = "report.html"
DOCUMENT = "report.md"
FIGURES = "figures"


class Written(NamedTuple):
    """What was written.

    Attributes:
        files: The page, the document.
        note: What is missing in them and the cure; empty when nothing is.
    """

    files: tuple[Path, ...]
    note: str


def write(report: Report, directory: Path) -> Written:
    """Write `report.html`, `report.md` and `figures/*.svg`; older ones are replaced.

    Without matplotlib, page and document have tables only.

    Raises:
        OSError: A file cannot be written.
    """
    directory.mkdir(parents=True, exist_ok=True)
    inline: dict[str, str] = {}
    places: dict[str, str] = {}
    note = ""
    try:
        for graph in report.graphs:
            inline[graph.key] = svg(graph, ink="var(--ink)", grid="var(--line)")
            places[graph.key] = f"{FIGURES}/{graph.key}.svg"
            _replace(directory / places[graph.key], svg(graph))
    except FiguresMissingError as error:
        note = str(error)
    _replace(directory / PAGE, page(report, inline))
    _replace(directory / DOCUMENT, markdown(report, places))
    return Written((directory / PAGE, directory / DOCUMENT), note)


def _replace(path: Path, text: str) -> None:
    """A file appears whole or not at all: somebody may be looking at the last one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    new = path.with_name(path.name + ".new")
    try:
        with naming(path):
            new.write_text(text, encoding="utf-8")
            new.replace(path)
    except OSError:
        new.unlink(missing_ok=True)
        raise
