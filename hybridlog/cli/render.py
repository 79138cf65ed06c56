"""Lays rows out for people: a table that fits the terminal, else a block for each row."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, islice, zip_longest
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from hybridlog.cli.output import (
    cut,
    printable,
    say,
    screen_width,
    short_duration,
    size,
    time_text,
    wrapped,
)

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

ROWS_AT_ONCE = 10_000
"""Rows of a table that are laid out together."""
_MIN_ROOM = 20  # characters of a folded value
_BLOCKS = "▁▂▃▄▅▆▇█"

Get = str | int | Callable[[Any], object]


@dataclass(frozen=True, slots=True)
class Column:
    """A column of a table.

    Attributes:
        get: Key or function that gives the value of a row; empty for the name as the key.
        side: Numbers stand on the right. Cells on the left may be folded between words, `whole`
            ones are not.
        short: Gives a shorter value, for a table that does not fit.
        shown: Writes a value; None is not written.
        cut: Cells may be cut off to so many characters; 0 for no.
        order: Columns are left out in this order where there is no room; 0 for never.
        varies: It is left out where it is the same in all rows.
    """

    name: str
    get: Get = ""
    side: Literal["left", "right", "whole"] = "left"
    short: Get | None = None
    shown: Callable[[Any], str] | None = None
    cut: int = 0
    order: int = 0
    varies: bool = False

    def cell(self, row: Any, *, short: bool = False) -> str:
        """The text for a row."""
        get = self.get if self.short is None or not short else self.short
        value = get(row) if callable(get) else row[self.name if get == "" else get]
        if value is None:
            return ""
        if self.shown is not None:
            return self.shown(value)
        return printable(f"{value:.6g}" if isinstance(value, float) else str(value))

    def folded(self, cell: str, width: int) -> list[str]:
        """The lines of a cell."""
        return [cut(cell, width)] if self.cut or self.side != "left" else wrapped(cell, width)


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
    return Column(name, get, "right", shown="{:.2f}".format, order=order)


def duration_of(name: str, get: Get, order: int = 0) -> Column:
    """A column of lengths of time, of ns."""
    return Column(name, get, "right", shown=lambda ns: short_duration(round(ns)), order=order)


def times() -> list[Column]:
    """Columns of `begin_ns` and `end_ns`; the short end has no day if it is that of the begin."""

    def end(row: Mapping[str, int]) -> str:
        begin, last = (time_text(row[name], 10**6) for name in ("begin_ns", "end_ns"))
        return last.partition("T")[2] if begin[:10] == last[:10] else last

    def begin(row: Mapping[str, int]) -> str:
        return time_text(row["begin_ns"], 10**6)

    return [
        Column("begin", lambda row: time_text(row["begin_ns"]), "whole", begin),
        Column("end", lambda row: time_text(row["end_ns"]), "whole", end),
    ]


class _Table(NamedTuple):
    """The columns of a table that are shown, as wide as their cells."""

    columns: Sequence[Column]
    widths: list[int]
    short: bool = False
    folds: bool = False

    @property
    def width(self) -> int:
        return sum(self.widths) + 2 * (len(self.widths) - 1)

    def cells(self, rows: Iterable[Any]) -> list[list[str]]:
        """The cells of rows; columns become as wide as they are."""
        found = [[one.cell(row, short=self.short) for one in self.columns] for row in rows]
        if found and not self.folds:
            wide = (max(map(len, cells)) for cells in zip(*found, strict=True))
            self.widths[:] = map(max, self.widths, wide)
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

    def narrowed(self, cells: Sequence[Sequence[str]], width: int) -> _Table | None:
        """The table with folded and cut cells; None if a word would be broken."""
        widths, least = list(self.widths), list(self.widths)
        for n, one in enumerate(self.columns):
            if one.cut:
                least[n] = min(least[n], max(len(one.name), one.cut))
            elif one.side == "left":
                words = (word for row in cells for word in row[n].split())
                least[n] = max(map(len, chain([one.name], words)))
        for _ in range(self.width - width):
            place = max(range(len(least)), key=lambda n: (widths[n] > least[n], widths[n]))
            if widths[place] <= least[place]:
                return None
            widths[place] -= 1
        return self._replace(widths=widths, folds=True)


def _fitting(columns: Sequence[Column], block: Sequence[Any], width: int | None) -> _Table | None:
    """The widest table that fits a screen of that width (None: no screen); None if none does."""
    order = sorted((one for one in columns if one.order), key=lambda one: one.order)
    for without in range(len(order) + 1):
        left = [one for one in columns if one not in order[:without]]
        for short in (False, True):
            table = _Table(left, [len(one.name) for one in left], short)
            cells = table.cells(block)
            if width is None or table.width <= width:
                return table
        if width is not None and (narrow := table.narrowed(cells, width)) is not None:
            return narrow
    return None


def table_lines(columns: Sequence[Column], rows: Sequence[Any], width: int) -> list[str]:
    """The lines of a table, headings first; they are cut where no table fits the width."""
    table = _fitting(columns, rows, width) or _Table(columns, [0] * len(columns), short=True)
    cells = [[one.name for one in table.columns], *table.cells(rows)]
    return [cut(line, width) for line in chain.from_iterable(map(table.lines, cells))]


def print_table(columns: Sequence[Column], rows: Iterable[Any]) -> bool:
    """Print rows under headings; on a terminal that has no room for them, a block for each row.

    Prints nothing without rows, and returns False.

    A long table is printed some rows at a time: memory does not grow with it. Columns become wider
    where later rows need it.
    """
    source = iter(rows)
    block = [*islice(source, ROWS_AT_ONCE)]
    if len(block) < ROWS_AT_ONCE:
        alike = [one for one in columns if one.varies and len({*map(one.cell, block)}) < 2]
        columns = [one for one in columns if one not in alike]
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
    cells = [[one.name for one in table.columns], *table.cells(block)]
    while cells:
        for line in chain.from_iterable(map(table.lines, cells)):
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


def sparkline(values: NDArray[np.float64]) -> str:
    """A letter for each number, from the least to the greatest; a space for NaN."""
    import numpy as np

    is_known = np.isfinite(values)
    letters = np.full(len(values), " ")
    if is_known.any():
        # Halved, so that the range of the greatest numbers is finite, too.
        known = values[is_known] / 2
        low, high = known.min(), known.max()
        share = (known - low) / (high - low) if high > low else np.full(len(known), 0.5)
        steps = np.minimum(share * len(_BLOCKS), len(_BLOCKS) - 1)
        letters[is_known] = np.array(list(_BLOCKS))[steps.astype(np.intp)]
    return "".join(letters.tolist())


def densities(counts: NDArray[np.int64]) -> str:
    """A letter for each count, from 0 to the greatest; a space for 0."""
    steps, most = len(_BLOCKS), max(int(counts.max(initial=0)), 1)
    return "".join(f" {_BLOCKS}"[-(-int(count) * steps // most)] for count in counts)
