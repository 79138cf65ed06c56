"""Lays rows out for people: a table that fits the terminal, else a block for each row."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, islice, zip_longest
from typing import Any, Literal

from hybridlog.cli.output import cut, printable, say, screen_width, size, time_text, wrapped

ROWS_AT_ONCE = 10_000
"""Rows of a table that are laid out together."""
_MIN_ROOM = 20  # characters of a folded value

Get = str | int | Callable[[Any], object]


@dataclass(frozen=True, slots=True)
class Column:
    """A column of a table.

    Attributes:
        get: Key or function that gives the value of a row; empty for the name as the key.
        side: Numbers stand on the right. Cells on the left may be folded between words, `whole`
            ones are not.
        short: Gives a shorter value, for a table that does not fit.
        cut: Cells may be cut off to so many characters; 0 for no.
        order: Columns are left out in this order where there is no room; 0 for never.
        varies: It is left out where it is the same in all rows.
    """

    name: str
    get: Get = ""
    side: Literal["left", "right", "whole"] = "left"
    short: Get | None = None
    cut: int = 0
    order: int = 0
    varies: bool = False

    def cell(self, row: Any, *, short: bool = False) -> str:
        """The text for a row."""
        get = self.get if self.short is None or not short else self.short
        value = get(row) if callable(get) else row[self.name if get == "" else get]
        if isinstance(value, float):
            value = f"{value:.6g}"
        return "" if value is None else printable(str(value))

    def folded(self, cell: str, width: int) -> list[str]:
        """The lines of a cell."""
        return [cut(cell, width)] if self.cut or self.side != "left" else wrapped(cell, width)


def numbers(*names: str) -> list[Column]:
    """Columns of numbers whose headings are the keys."""
    return [Column(name, side="right") for name in names]


def bytes_of(name: str, key: str, order: int = 0) -> Column:
    """A column of sizes; `-` for one that is not known."""

    def shown(row: Mapping[str, Any]) -> str:
        return "-" if row[key] is None else size(row[key])

    return Column(name, shown, "right", order=order)


@dataclass(slots=True)
class _Shape:
    """The columns of a table that are shown, and their widths; `width` is that of the screen."""

    columns: Sequence[Column]
    widths: list[int]
    short: bool
    width: int | None = None
    folds: bool = False

    def cells(self, rows: Iterable[Any]) -> list[list[str]]:
        """The cells of rows; columns become as wide as they are."""
        found = [[one.cell(row, short=self.short) for one in self.columns] for row in rows]
        if not self.folds:
            self.widths = [
                max(width, *map(len, cells))
                for width, cells in zip(self.widths, zip(*found, strict=True), strict=False)
            ] or self.widths
        return found

    def lines(self, row: Sequence[str]) -> Iterator[str]:
        parts = [[cell] for cell in row]
        if self.folds:
            parts = [*map(Column.folded, self.columns, row, self.widths)]
        for cells in zip_longest(*parts, fillvalue=""):
            aligned = (
                f"{cell:{'>' if one.side == 'right' else '<'}{width}}"
                for cell, one, width in zip(cells, self.columns, self.widths, strict=True)
            )
            yield "  ".join(aligned).rstrip()

    def room(self) -> int:
        """Columns of the screen that the table leaves; files and pipes have room for all."""
        taken = sum(self.widths) + 2 * (len(self.widths) - 1)
        return 0 if self.width is None else self.width - taken

    def narrow(self, rows: Sequence[Sequence[str]]) -> bool:
        """Fold and cut cells until the table fits; False if a word would be broken."""
        least = list(self.widths)
        for n, one in enumerate(self.columns):
            words = [word for row in rows for word in (one.name, *row[n].split())]
            if one.cut:
                least[n] = min(least[n], max(len(one.name), one.cut))
            elif one.side == "left":
                least[n] = max(map(len, words), default=0)
        self.folds = True
        for _ in range(-self.room()):
            place = max(
                range(len(least)), key=lambda n: (self.widths[n] > least[n], self.widths[n])
            )
            if self.widths[place] <= least[place]:
                return False
            self.widths[place] -= 1
        return True


def _shape(columns: Sequence[Column], block: Sequence[Any], width: int | None) -> _Shape | None:
    """The widest table that fits a screen of that width (None: no screen); None if none does."""
    order = sorted((one for one in columns if one.order), key=lambda one: one.order)
    for without in range(len(order) + 1):
        left = [one for one in columns if one not in order[:without]]
        for short in (False, True):
            found = _Shape(left, [len(one.name) for one in left], short, width)
            cells = found.cells(block)
            if found.room() >= 0:
                return found
        if found.narrow(cells):
            return found
    return None


def table_lines(columns: Sequence[Column], rows: Sequence[Any], width: int) -> list[str]:
    """The lines of a table, headings first; they are cut where no table fits the width."""
    shape = _shape(columns, rows, width) or _Shape(columns, [0] * len(columns), short=True)
    cells = [[one.name for one in shape.columns], *shape.cells(rows)]
    return [cut(line, width) for line in chain.from_iterable(map(shape.lines, cells))]


def print_table(
    columns: Sequence[Column],
    rows: Iterable[Any],
) -> bool:
    """Print rows under headings; on a terminal that has no room for them, a block for each row.

    Prints nothing without rows, and returns False.

    A long table is printed some rows at a time: memory does not grow with it. Columns become wider
    where later rows need it.
    """
    source = iter(rows)
    block = [*islice(source, ROWS_AT_ONCE)]
    if not block:
        return False
    is_all = len(block) < ROWS_AT_ONCE
    alike = [one for one in columns if is_all and one.varies and len({*map(one.cell, block)}) < 2]
    columns = [one for one in columns if one not in alike]
    shape = _shape(columns, block, screen_width() if sys.stdout.isatty() else None)
    if shape is None:
        for number, row in enumerate(chain(block, source)):
            (_, title), *fields = ((one.name, one.cell(row)) for one in columns)
            if number:
                say()
            say(title)
            print_fields([pair for pair in fields if pair[1]], indent=2)
        return True
    cells = [[one.name for one in shape.columns], *shape.cells(block)]
    while cells:
        for line in chain.from_iterable(map(shape.lines, cells)):
            print(line)  # noqa: T201
        cells = shape.cells(islice(source, ROWS_AT_ONCE))
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


def times() -> list[Column]:
    """Columns of `begin_ns` and `end_ns`; the short end has no day if it is that of the begin."""

    def end(row: Mapping[str, int]) -> str:
        begin, last = (time_text(row[name], 10**6) for name in ("begin_ns", "end_ns"))
        return last.partition("T")[2] if begin[:10] == last[:10] else last

    begin = Column(
        "begin",
        lambda row: time_text(row["begin_ns"]),
        "whole",
        lambda row: time_text(row["begin_ns"], 10**6),
    )
    return [begin, Column("end", lambda row: time_text(row["end_ns"]), "whole", end)]
