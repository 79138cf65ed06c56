"""Showing what was found: a table on a terminal, Markdown elsewhere, and in the docs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from benchmarks.speed.results import Finding, Outcome

_HEADINGS = ("study", "figure", "value", "spread", "target", "")


def show(outcome: Outcome, *, terminal: bool) -> None:
    """Print the findings to standard output."""
    if not terminal:
        print(markdown(outcome))
        return
    from rich.console import Console
    from rich.table import Table

    table = Table(title=_title(outcome), title_justify="left", caption=_machine(outcome))
    for heading in _HEADINGS:
        table.add_column(heading, justify="right" if heading in {"value", "target"} else "left")
    last = ""
    for row, finding in zip(_rows(outcome.findings), outcome.findings, strict=True):
        style = {True: "green", False: "red", None: ""}[finding.passed]
        if finding.aim and not finding.passed:
            style = "yellow"
        if last and finding.study != last:
            table.add_section()
        name = "" if finding.study == last else row[0]
        table.add_row(name, *row[1:], style=style)
        last = finding.study
    Console().print(table)


def markdown(outcome: Outcome) -> str:
    """The findings as a Markdown table, with the machine below."""
    rows = [_HEADINGS, ("---", "---", "---:", "---", "---:", "---"), *_rows(outcome.findings)]
    table = "\n".join("| " + " | ".join(row) + " |" for row in rows)
    return f"{_title(outcome)}\n\n{table}\n\n{_machine(outcome)}"


def _title(outcome: Outcome) -> str:
    header = outcome.header
    quick = " Quick run: small inputs, the ratios are rough." if header["quick"] else ""
    return (
        f"Median of {header['repetitions']} repetitions; the spread is the least and the "
        f"greatest of them.{quick}"
    )


def _machine(outcome: Outcome) -> str:
    header = outcome.header
    packages = ", ".join(f"{name} {number}" for name, number in header["packages"].items())
    return (
        f"{header['cpu']}, {header['cores']} cores, {header['memory_gib']} GiB; "
        f"{header['system']}; Python {header['python']}, MongoDB {header['mongod']}, {packages}; "
        f"revision {header['revision']}; {header['started']}; load {header['load_1min']} "
        f"at the start; seed {header['seed']}."
    )


def _rows(findings: Sequence[Finding]) -> list[tuple[str, ...]]:
    return [
        (
            finding.study,
            finding.about,
            _number(finding.value, finding.unit),
            f"{_number(finding.low, finding.unit)} to {_number(finding.high, finding.unit)}",
            _target(finding),
            _mark(finding),
        )
        for finding in findings
    ]


def _number(value: float, unit: str) -> str:
    if value >= 100:
        text = f"{value:,.0f}"
    elif value >= 1:
        text = f"{value:.3g}"
    else:
        text = f"{value:.2g}"
    return f"{text}{unit}" if unit == "x" else f"{text} {unit}"


def _target(finding: Finding) -> str:
    if finding.target is None:
        return ""
    relation = {">=": "≥", "<=": "≤", "<": "<"}[finding.relation]
    aim = "aim " if finding.aim else ""
    return f"{aim}{relation} {_number(finding.target, finding.unit)}"


def _mark(finding: Finding) -> str:
    if finding.passed is None:
        return ""
    if finding.passed:
        return "✓ pass"
    return "✗ missed" if not finding.aim else "not reached"
