"""`hybridlog plot`."""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import click

from hybridlog.cli import output
from hybridlog.cli.answers import answering, check_room, form_of, write_bytes
from hybridlog.cli.binder import command, option
from hybridlog.cli.options import Filtered, Forced, Verbose, parse_fields
from hybridlog.cli.render import Column, print_table
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from hybridlog.drawing.figure import Line
    from hybridlog.drawing.series import Series

_FORMATS = ("png", "svg", "pdf")
_WIDTH, _HEIGHT = 1200, 400
_LETTERS = 60  # of a line of text in a file
_MAX_LETTERS = 500
_SIZE = re.compile(r"(\d{2,4})x(\d{2,4})")


@dataclass(frozen=True, kw_only=True)
class _Given(Verbose, Filtered, Forced):
    needs_topic: ClassVar[bool] = True
    fields: str | None = option(
        "Fields that are numbers (ranges.min, position[2]), or messages with numbers.",
        "A,B.C",
    )
    output: Path | None = option(
        "Write a picture (.png, .svg, .pdf); - is standard output. Without: a line of text for "
        "each field.",
        "FILE",
        short="-o",
    )
    form: str | None = option(
        "Without: by the suffix of -o.",
        name="--format",
        short="-F",
        type=click.Choice(_FORMATS),
        needs=("output",),
    )
    size: str | None = option(
        f"Pixels of the picture; without, {_WIDTH}x{_HEIGHT}, and as high again for each "
        "further topic.",
        "WxH",
    )


@command(_Given)
def plot_command(given: _Given) -> None:
    """Draw fields over time."""
    form = _form(given.output, given.form)
    shape = None if given.size is None else _size(given.size)
    path = None if given.output is None or str(given.output) == "-" else given.output
    if path is not None:
        check_room(path, force=given.force)
    with answering(given) as query:
        from hybridlog.drawing.figure import figure, lines

        names = [] if given.fields is None else parse_fields(given.fields)
        width = _WIDTH if shape is None else shape[0]
        found = lines(query, names, pixels=width if form else _MAX_LETTERS)
        if form:
            height = _HEIGHT * max(1, len({line.topic for line in found}))
            size = shape or (width, height)
            write_bytes(path or sys.stdout.buffer, figure(found, size=size, form=form))
        elif not print_table(
            _COLUMNS, found if any(len(one.series.times) for one in found) else ()
        ):
            output.note("No message.")
        if not found:
            query.counters.messages = 0


def _form(path: Path | None, form: str | None) -> str:
    """The format; empty for text."""
    if path is None:
        return ""
    if str(path) == "-" and form is not None and sys.stdout.isatty():
        raise UsageError(f"{form} is no text for a terminal: name a file with -o.")
    return form or form_of(path, {f".{name}": name for name in _FORMATS})


def _size(text: str) -> tuple[int, int]:
    match = _SIZE.fullmatch(text)
    if match is None:
        raise UsageError(f"A size is 1200x400, from 10 to 9999 pixels, not {text!r}.")
    return int(match[1]), int(match[2])


def _ends(series: Series) -> tuple[str, str]:
    """The least and the greatest finite value."""
    import numpy as np

    least, greatest = (side[np.isfinite(side)] for side in (series.least, series.greatest))
    if not len(least) or not len(greatest):
        return "", ""
    return f"{least.min():.6g}", f"{greatest.max():.6g}"


def _line(line: Line, width: int = _LETTERS) -> str:
    from hybridlog.cli.render import sparkline

    return sparkline(line.series.by_column(width))


_COLUMNS = [
    Column("topic", lambda line: line.topic, varies=True),
    Column("recording", lambda line: line.recording, varies=True),
    Column("field", lambda line: line.series.field),
    Column("least", lambda line: _ends(line.series)[0], "right"),
    Column("greatest", lambda line: _ends(line.series)[1], "right"),
    Column("", _line, "whole", lambda line: _line(line, _LETTERS // 3)),
]
"""Columns of the lines on a terminal: name, least and greatest value, sparkline."""
