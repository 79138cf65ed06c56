"""Lays rows out for people: a table that fits the terminal, else a block for each row."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, islice, zip_longest
from typing import Any, Literal

from hybridlog.cli.output import cut, printable, say, screen_width, short_duration, size, time_text

ROWS_AT_ONCE = 10_000
"""Rows of a table that are laid out together."""
_MIN_ROOM = 20  # characters of a folded value

Get = str | int | Callable[[Any], object]


@dataclass(frozen=True, slots=True)
class Column:
    """A column of a table.

    Attributes:
        get: Key or function that gives the value of a row; empty for the name as the key.
        side: Numbers stand on the right.
        shown: Writes a value; None is not written.
        cut: Cells may be cut off to so many characters; 0 for no.
        order: Columns are left out in this order where there is no room; 0 for never.
        varies: It is left out where it is the same in all rows.
    """

    name: str
    get: Get = ""
    side: Literal["left", "right"] = "left"
    shown: Callable[[Any], str] | None = None
    cut: int = 0
    order: int = 0
    varies: bool = False

    def cell(self, row: Any) -> str:
        """The text for a row."""
        get = self.get
        value = get(row) if callable(get) else row[self.name if get == "" else get]
        if value is None:
            return ""
        if self.shown is not None:
            return self.shown(value)
        return printable(f"{value:.6g}" if isinstance(value, float) else str(value))


def numbers(*names: str, **how: Any) -> list[Column]:
    """Columns of numbers whose headings are the keys."""
    return [Column(name, side="right", **how) for name in names]


def bytes_of(name: str, key: str, order: int = 0) -> Column:
    """A column of sizes; `-` for one that is not known."""

    def shown(row: Mapping[str, Any]) -> str:
        return "-" if row[key] is None else size(row[key])

    return Column(name, shown, "right", order=order)


def rate_of(name: str, get: Get, order: int = 0) -> Column:
    """A column of rates, in hertz."""
    return Column(name, get, "right", "{:.2f}".format, order=order)


def duration_of(name: str, get: Get, order: int = 0) -> Column:
    """A column of lengths of time, of ns."""
    return Column(name, get, "right", lambda ns: short_duration(round(ns)), order=order)


def time_of(name: str, key: str, order: int = 0) -> Column:
    """A column of times in UTC, of ns."""
    return Column(name, lambda row: time_text(row[key]), order=order)


class _Table:
    """Some columns, as wide as their cells, or narrower where these may be cut."""

    def __init__(self, columns: Sequence[Column]) -> None:
        self.columns = columns
        self.widths = [len(one.name) for one in columns]
        self._is_narrow = False

    def cells(self, rows: Iterable[Any]) -> list[list[str]]:
        """The cells of rows; columns become as wide as they are."""
        found = [[one.cell(row) for one in self.columns] for row in rows]
        if found and not self._is_narrow:
            wide = (max(map(len, cells)) for cells in zip(*found, strict=True))
            self.widths = [*map(max, self.widths, wide)]
        return found

    def fits(self, width: int) -> bool:
        """True if it is no wider than that; cells of the widest columns are cut for it."""
        least = [
            max(len(one.name), one.cut) if one.cut else own
            for one, own in zip(self.columns, self.widths, strict=True)
        ]
        for _ in range(sum(self.widths) + 2 * (len(least) - 1) - width):
            place = max(
                range(len(least)), key=lambda n: (self.widths[n] > least[n], self.widths[n])
            )
            if self.widths[place] <= least[place]:
                return False
            self.widths[place] -= 1
            self._is_narrow = True
        return True

    def lines(self, rows: Iterable[Sequence[str]]) -> Iterable[str]:
        """Rows of cells as text."""
        for row in rows:
            aligned = (
                f"{cut(cell, width):{'>' if one.side == 'right' else '<'}{width}}"
                for cell, one, width in zip(row, self.columns, self.widths, strict=True)
            )
            yield "  ".join(aligned).rstrip()

    @property
    def heading(self) -> list[str]:
        return [one.name for one in self.columns]


def _fitting(columns: Sequence[Column], block: Sequence[Any], width: int | None) -> _Table | None:
    """The table with most columns that fits a screen of that width (None: any); None without."""
    left = [*columns]
    for gone in (None, *sorted((one for one in columns if one.order), key=lambda one: one.order)):
        left = [one for one in left if one is not gone]
        table = _Table(left)
        table.cells(block)
        if width is None or table.fits(width):
            return table
    return None


def table_lines(columns: Sequence[Column], rows: Sequence[Any], width: int) -> list[str]:
    """The lines of a table, headings first; they are cut where no table fits the width."""
    table = _fitting(columns, rows, width) or _Table(columns)
    cells = table.cells(rows)
    return [cut(line, width) for line in table.lines([table.heading, *cells])]


def print_table(columns: Sequence[Column], rows: Iterable[Any]) -> bool:
    """Print rows under headings; on a terminal that has no room for them, a block for each row.

    Prints nothing without rows, and returns False.

    A long table is printed some rows at a time: memory does not grow with it. Columns become wider
    where later rows need it.
    """
    source = iter(rows)
    block = [*islice(source, ROWS_AT_ONCE)]
    if len(block) < ROWS_AT_ONCE:
        columns = [one for one in columns if not one.varies or len({*map(one.cell, block)}) > 1]
    if not block:
        return False
    table = _fitting(columns, block, screen_width() if sys.stdout.isatty() else None)
    if table is None:
        for number, row in enumerate(chain(block, source)):
            (_, title), *fields = ((one.name, one.cell(row)) for one in columns)
            if number:
                say()
            say(title)
            print_fields([pair for pair in fields if pair[1]], indent=2)
        return True
    cells = [table.heading, *table.cells(block)]
    while cells:
        for line in table.lines(cells):
            print(line)  # noqa: T201
        cells = table.cells(islice(source, ROWS_AT_ONCE))
    return True


def print_fields(fields: Sequence[tuple[str, object]], indent: int = 0) -> None:
    """Print a line for each name and value, folded on a terminal."""
    width = max((len(name) for name, _ in fields), default=0)
    room = max(screen_width() - width - 2 - indent, _MIN_ROOM)
    for name, value in fields:
        lines = [printable(str(value))]
        if sys.stdout.isatty():
            lines = textwrap.wrap(lines[0], room, break_on_hyphens=False)
        for heading, line in zip_longest([printable(name)], lines, fillvalue=""):
            say(f"{' ' * indent}{heading:<{width}}  {line}".rstrip())
