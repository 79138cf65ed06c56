"""The report as one page of HTML that needs nothing else: no network, no script."""

from __future__ import annotations

import re
from collections.abc import Mapping
from html import escape
from pathlib import Path

from benchmarks.report.model import Graph, Report, Section, Table
from benchmarks.report.numbers import cell, plain

_STYLE = Path(__file__).with_name("page.css")


def page(report: Report, figures: Mapping[str, str]) -> str:
    """The whole report.

    Args:
        report: What it says.
        figures: SVG elements by key; what is not there is left out.
    """
    parts = [
        "<!doctype html>",
        '<html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        '<meta name="color-scheme" content="light dark">',
        f"<title>{escape(report.title)}</title>",
        f"<style>{_STYLE.read_text(encoding='utf-8')}</style></head><body><main>",
        f"<h1>{_text(report.title)}</h1>",
        *(f'<p class="warning">{_text(text)}</p>' for text in report.warnings),
        '<h2 id="findings">What was found</h2>',
        "<ul>",
        *(f"<li>{_text(text)}</li>" for text in report.findings),
        "</ul>",
        _contents(report),
        *(_section(section, figures, quick=report.quick) for section in report.sections),
        "</main></body></html>",
    ]
    return "\n".join(part for part in parts if part) + "\n"


def _contents(report: Report) -> str:
    links = "".join(
        f'<li><a href="#{escape(one.key)}">{_text(one.title)}</a></li>' for one in report.sections
    )
    return f"<nav><ol>{links}</ol></nav>"


def _section(section: Section, figures: Mapping[str, str], *, quick: bool) -> str:
    parts = [f'<section id="{escape(section.key)}"><h2>{_text(section.title)}{_mark(quick)}</h2>']
    parts += [f"<p>{_text(text)}</p>" for text in section.text]
    parts += [_figure(graph, figures.get(graph.key), quick=quick) for graph in section.graphs]
    parts += [_table(table) for table in section.tables]
    return "\n".join([*parts, "</section>"])


def _figure(graph: Graph, drawn: str | None, *, quick: bool) -> str:
    words = f"<b>{_text(graph.title)}.</b> {_text(graph.caption)}{_mark(quick)}"
    said = f"<figcaption>{words}</figcaption>"
    picture = f'<div class="wide">{drawn}</div>' if drawn else ""
    return f'<figure id="fig-{escape(graph.key)}">{picture}{said}</figure>'


def _mark(quick: bool) -> str:  # noqa: FBT001 - what it says
    return ' <span class="quick">quick run</span>' if quick else ""


def _table(table: Table) -> str:
    head = "".join(f'<th scope="col">{_text(one)}</th>' for one in table.columns)
    rows = []
    for row in table.rows:
        name, *others = (_text(cell(one)) for one in row)
        mark = ' class="ours"' if row[0] == table.emphasis and table.emphasis else ""
        cells = "".join(f"<td>{_spread(one)}</td>" for one in others)
        rows.append(f'<tr{mark}><th scope="row">{name}</th>{cells}</tr>')
    note = f'<p class="note">{_text(table.note)}</p>' if table.note else ""
    kind = "words" if table.is_words else "numbers"
    return (
        f'<h3>{_text(table.title)}</h3><div class="wide"><table class="{kind}">'
        f"<thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table></div>{note}"
    )


def _spread(text: str) -> str:
    """The spread, smaller than the median that it belongs to."""
    return re.sub(r" (\([^()]*…[^()]*\))$", r' <span class="spread">\1</span>', text)


def _text(text: str) -> str:
    """Text with code spans; names out of logs and messages of systems are untrusted."""
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", escape(plain(text)))
