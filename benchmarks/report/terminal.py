"""What a run has found, for a terminal: the findings, and what is missing. Short."""

from __future__ import annotations

import sys

from benchmarks.report.book import Book, grouped
from benchmarks.report.conditions import about
from benchmarks.report.model import Report
from benchmarks.report.numbers import plain
from hybridlog.cli.output import counted, print_table, say

_SHOWN = 5


def show(report: Report, book: Book) -> None:
    """Print the findings to standard output.

    Args:
        report: What was found.
        book: The same journal's samples, for what was not.
    """
    say(report.title)
    for text in report.warnings:
        _item("!", text)
    for text in report.findings:
        _item("*", text)
    missing = grouped(book.bad("missing"), lambda one: (one.backend, one.reason))
    if missing:
        say()
        print_table(
            (("missing", "whole"), ("why, and what would help", "left")),
            [(name, reason) for name, reason in missing],
        )
    failed = book.bad("failed")
    if failed:
        say()
        say(f"{counted(len(failed), 'run')} failed:")
        for one in failed[:_SHOWN]:
            _item("-", f"{one.backend}: {about(one)}: {one.reason}")
        if len(failed) > _SHOWN:
            say(f"- and {len(failed) - _SHOWN} more, all of them in the report")


def _item(mark: str, text: str) -> None:
    line = plain(text)
    if not sys.stdout.isatty():
        say(f"{mark} {line}")
        return
    from rich.text import Text

    from hybridlog.cli.output import console

    style = {"!": "bold yellow", "-": "red"}.get(mark, "")
    console().print(Text(f"{mark} {line}", style=style))
