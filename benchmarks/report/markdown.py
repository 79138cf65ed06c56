"""The report as Markdown, its figures in files beside it."""

from __future__ import annotations

import re
from collections.abc import Mapping

from benchmarks.report.model import Report, Section, Table
from benchmarks.report.numbers import cell, plain


def markdown(report: Report, figures: Mapping[str, str]) -> str:
    """The whole report.

    Args:
        report: What it says.
        figures: Places of the figures that exist, relative to the document, by key.
    """
    parts = [f"# {escaped(report.title)}"]
    parts += [f"> **{escaped(text)}**" for text in report.warnings]
    parts.append("## What was found")
    parts.append("\n".join(f"* {escaped(text)}" for text in report.findings) or "Nothing yet.")
    for section in report.sections:
        parts += _section(section, figures)
    return "\n\n".join(parts) + "\n"


def _section(section: Section, figures: Mapping[str, str]) -> list[str]:
    parts = [f"## {escaped(section.title)}"]
    parts += [escaped(text) for text in section.text]
    for graph in section.graphs:
        place = figures.get(graph.key)
        if place is not None:
            parts.append(f"![{escaped(graph.title)}]({place})")
        parts.append(f"*{escaped(graph.title)}.* {escaped(graph.caption)}")
    for table in section.tables:
        parts.append(f"### {escaped(table.title)}")
        parts.append(_table(table))
        if table.note:
            parts.append(escaped(table.note))
    return parts


def _table(table: Table) -> str:
    side = "---" if table.is_words else "---:"
    lines = [
        _row(table.columns),
        _row(["---", *([side] * (len(table.columns) - 1))], raw=True),
    ]
    for row in table.rows:
        shown = [cell(one) for one in row]
        lines.append(_row(shown))
    return "\n".join(lines)


def _row(cells: list[str] | tuple[str, ...], *, raw: bool = False) -> str:
    return "| " + " | ".join(one if raw else escaped(one) for one in cells) + " |"


def escaped(text: str) -> str:
    """Text as Markdown shows it: names out of logs and messages of systems are untrusted."""
    pieces = re.split(r"(`[^`]+`)", plain(text))
    # Between backticks only the bar means something, and only in a table.
    return "".join(
        piece.replace("|", "\\|") if place % 2 else re.sub(r"([\\`*_|<>\[\]])", r"\\\1", piece)
        for place, piece in enumerate(pieces)
    )
