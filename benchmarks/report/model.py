"""What a report is made of: values with a spread, tables, graphs, sections. No layout."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from statistics import median
from typing import Any, Literal


@dataclass(frozen=True, slots=True)
class Value:
    """What was measured several times.

    Attributes:
        median: The middle one, or the mean of the two in the middle.
        low: The least of them.
        high: The greatest of them.
        count: How many there are.
    """

    median: float
    low: float
    high: float
    count: int

    @classmethod
    def of(cls, numbers: Iterable[float]) -> Value | None:
        """Of some numbers; None when there are none."""
        known = sorted(numbers)
        if not known:
            return None
        return cls(float(median(known)), float(known[0]), float(known[-1]), len(known))


_LONGEST_NUMBER = 40  # characters

Cell = str | Value | None
"""None is what was not measured: it is shown as a dash, never as a zero."""


@dataclass(frozen=True, slots=True)
class Table:
    """Rows under headings; the first column is text, the others are mostly numbers.

    Attributes:
        title: A line above; units of all cells may stand there.
        columns: Headings, with units.
        rows: Cells, as many as there are columns.
        note: A sentence below; may be empty.
        emphasis: Text of a first cell whose row stands out.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    note: str = ""
    emphasis: str = ""

    @property
    def is_words(self) -> bool:
        """Whether the cells are sentences, which stand on the left."""
        cells = (cell for row in self.rows for cell in row[1:])
        return any(isinstance(cell, str) and len(cell) > _LONGEST_NUMBER for cell in cells)


@dataclass(frozen=True, slots=True)
class Line:
    """One backend's values.

    Attributes:
        backend: Its name.
        points: Places on the x axis (numbers, or names of groups of bars) and values.
    """

    backend: str
    points: tuple[tuple[float | str, Value], ...]


@dataclass(frozen=True, slots=True)
class Panel:
    """One graph of a figure.

    Attributes:
        title: Above it.
        lines: One a backend.
        offered: What nobody can be above: drawn as a dashed line. May be empty.
    """

    title: str
    lines: tuple[Line, ...]
    offered: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True, slots=True)
class Graph:
    """A figure.

    Attributes:
        key: Name of its file.
        title: What it shows.
        caption: How to read it, and how many repetitions stand behind it.
        kind: `lines` over numbers, or `bars` in named groups.
        panels: Side by side.
        x_label: With its unit.
        y_label: With its unit.
        log_x: Whether the x axis is logarithmic.
        log_y: Whether the y axis is.
        y_range: Where the y axis begins and ends; None to fit.
        ticks: Places on a numeric x axis that get a label, with the label.
    """

    key: str
    title: str
    caption: str
    kind: Literal["lines", "bars"]
    panels: tuple[Panel, ...]
    x_label: str
    y_label: str
    log_x: bool = False
    log_y: bool = False
    y_range: tuple[float, float] | None = None
    ticks: tuple[tuple[float, str], ...] = ()


@dataclass(frozen=True, slots=True)
class Section:
    """A part of the report under a heading.

    Attributes:
        key: For links.
        title: The heading.
        text: Paragraphs, plain.
        graphs: Figures, shown before the tables.
        tables: Tables.
    """

    key: str
    title: str
    text: tuple[str, ...] = ()
    graphs: tuple[Graph, ...] = ()
    tables: tuple[Table, ...] = ()


@dataclass(frozen=True, slots=True)
class Report:
    """All that the samples of a journal say.

    Attributes:
        title: Of the whole.
        quick: Whether any of the runs was a quick one.
        warnings: Sentences that must be read before any figure.
        findings: What was found, in plain sentences with numbers.
        sections: In order.
        headers: What the runs ran on and with, as the journal has it.
        failed: How many samples failed.
        differing: Questions to which not every backend gave the same answer.
    """

    title: str
    quick: bool
    warnings: tuple[str, ...]
    findings: tuple[str, ...]
    sections: tuple[Section, ...]
    headers: tuple[Mapping[str, Any], ...] = field(default=())
    failed: int = 0
    differing: tuple[str, ...] = ()

    @property
    def graphs(self) -> tuple[Graph, ...]:
        """Every figure, in order."""
        return tuple(graph for section in self.sections for graph in section.graphs)
