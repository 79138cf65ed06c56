"""Prints rows, JSON, notes and progress; writes sizes and times for people."""

from __future__ import annotations

import json
import shutil
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from itertools import chain, islice, zip_longest
from typing import Any, Final, Self

from msgspec import Struct
from msgspec.structs import asdict

from hybridlog import wording
from hybridlog_storage.stopping import safe_point

_manner = {"quiet": False, "as_json": False}

counted = wording.counted
unfit = wording.unfit
size = wording.size

_MAX_LINE = 100  # characters of a note, an attachment and the like
_REDRAW_S: Final = 0.1


def begin(given: object) -> None:
    """Print from now on as the options of a command say: `--quiet`, `--json`."""
    _manner.update({name: getattr(given, name, False) for name in _manner})


def is_quiet() -> bool:
    """Whether the command prints errors only."""
    return _manner["quiet"]


def has_bars() -> bool:
    """Whether the command shows its progress where there is a terminal."""
    return not any(_manner.values()) and sys.stderr.isatty()


def screen_width() -> int:
    """Columns of the terminal."""
    return shutil.get_terminal_size().columns


def printable(text: str) -> str:
    """Text without control characters: names in logs are untrusted."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def cut(line: str, most: int = _MAX_LINE) -> str:
    """A line, cut off where it is longer than so many characters."""
    return line if len(line) <= most else f"{line[: most - 1]}…"


def quoted(text: str) -> str:
    """Typed text in quotes; bytes that are not UTF-8 are shown as escapes."""
    raw = text.encode("utf-8", "surrogateescape")
    return f"'{printable(raw.decode('utf-8', 'backslashreplace'))}'"


def say(text: str = "") -> None:
    """A line of the answer, on standard output."""
    print(printable(text))  # noqa: T201


def tell(value: object, lines: Iterable[str], *, at_once: bool = False) -> None:
    """Print a result as JSON, with `at_once` on a line; or in lines, which --quiet leaves out."""
    if _manner["as_json"]:
        print_json(value, at_once=at_once)
    elif not is_quiet():
        for line in lines:
            clear()
            print(printable(line))  # noqa: T201


def print_json(value: object, *, at_once: bool = False) -> None:
    """Print a value as JSON; with `at_once` on a line."""
    text = json.dumps(value, default=_plain, indent=None if at_once else 2, ensure_ascii=False)
    print(text, flush=at_once)  # noqa: T201


def _plain(value: object) -> object:
    if isinstance(value, Struct):
        return asdict(value)
    return str(value)


def note(text: str) -> None:
    """A line for the person, on standard error; who reads it may go, and the work goes on."""
    with suppress(BrokenPipeError), _drawing:
        clear()
        print(printable(text), file=sys.stderr)  # noqa: T201


def clear() -> None:
    """Remove what is drawn at the end of the terminal, until it is drawn again."""
    for one in _shown:
        one.erase()


def notes(lines: Iterable[str]) -> None:
    """Lines for the person, on standard error."""
    for line in lines:
        note(line)


def remarks(lines: Iterable[str]) -> None:
    """Notes that --quiet leaves out."""
    if not is_quiet():
        notes(lines)


def time_text(ns: int | None, step: int = 1) -> str:
    """A time in UTC, cut to whole steps of so many ns; `-` without one."""
    from hybridlog.query.times import format_time

    return "-" if ns is None else format_time(ns - ns % step)


def short_duration(ns: int) -> str:
    """A length of time, to the ms from a second on, else to the µs."""
    from hybridlog.query.times import format_duration

    step = 10**6 if abs(ns) >= 10**9 else 1000
    return format_duration(round(ns / step) * step)


class Drawn:
    """Lines at the end of a terminal that are drawn anew; a context manager that removes them.

    Notes appear above them. The terminal cuts lines that are too long for it.
    """

    def __init__(self, *, error: bool = True) -> None:
        self._stream = sys.stderr if error else sys.stdout
        self._count = 0

    def __enter__(self) -> Self:
        """Nothing is drawn yet."""
        return self

    def __exit__(self, *_: object) -> None:
        """Remove the lines."""
        self.erase()

    def draw(self, lines: Sequence[str]) -> None:
        """Draw lines in place of the last ones."""
        with _drawing:
            self.erase()
            self._write("\x1b[?25l\x1b[?7l" + "\n".join(lines) + "\x1b[?7h")
            self._count = len(lines)
            _shown[:] = [self]

    def erase(self) -> None:
        """Remove the lines until they are drawn again."""
        with _drawing:
            if self._count:
                up = f"\x1b[{self._count - 1}A" if self._count > 1 else ""
                self._write(f"\r{up}\x1b[J\x1b[?25h")
            self._count = 0

    def _write(self, text: str) -> None:
        with suppress(OSError):  # the terminal may be gone, and the work goes on
            self._stream.write(text)
            self._stream.flush()


_drawing = threading.RLock()
_shown: list[Drawn] = []


class Bar:
    """A line with share and rate; a context manager that removes it.

    It appears at the first progress, on a terminal. Elsewhere there is nothing. The total is in
    bytes, about; None if it is unknown, or each part tells its own.
    """

    def __init__(self, label: str, total: int | None = None, *, quiet: bool = False) -> None:
        self._label, self._total = label, total
        self._line = None if quiet or not has_bars() else Drawn()
        self._begin = self._next = 0.0

    def __enter__(self) -> Self:
        """The bar, which does not show yet."""
        return self

    def __exit__(self, *_: object) -> None:
        """Remove the bar."""
        self._begin = self._next = 0.0
        if self._line is not None:
            self._line.erase()

    def __call__(self, done: int, note: str = "", total: int | None = None) -> None:
        """Set the number of finished bytes, and a note beside the bar."""
        now, total = time.monotonic(), total or self._total
        if self._line is None or now < self._next:
            return
        self._begin, self._next = self._begin or now, now + _REDRAW_S
        share = f" {min(done / total, 1):.0%}" if total else ""
        rate = size(done / (now - self._begin or 1))
        self._line.draw([printable(f"{self._label}{share}  {rate}/s  {note}")])

    def part(self, recording: str, done: int, total: int) -> None:
        """Report `done` of `total` bytes of a recording, until it is complete; a safe point."""
        safe_point()
        self(done, recording, max(total, 1))
        if done >= total:
            self.__exit__()


# Rows for people: a table that fits the terminal, else a block for each row.

ROWS_AT_ONCE = 10_000
"""Rows of a table that are laid out together."""
_MIN_ROOM = 20  # characters of a folded value


def _text(value: Any) -> str:
    return printable(f"{value:.6g}" if isinstance(value, float) else str(value))


_SHOWN: Final[dict[str, Callable[[Any], str]]] = {
    "text": _text,
    "number": _text,
    "bytes": size,
    "rate": "{:.2f}".format,
    "duration": lambda ns: short_duration(round(ns)),
    "time": time_text,
    "second": lambda ns: time_text(ns, 10**9),
}
"""How values of each kind are written: rates in hertz, times and durations of ns."""
_LEFT: Final = frozenset({"text", "time", "second"})

Get = str | int | Callable[[Any], object]


class Column(Struct, frozen=True):
    """A column of a table.

    Attributes:
        get: Key or function that gives the value of a row; empty for the name as the key. None is
            not written, but for sizes and times.
        kind: What the values are; numbers stand on the right.
        cut: Cells may be cut off to so many characters; 0 for no.
        order: Columns are left out in this order where there is no room; 0 for never.
        varies: It is left out where it is the same in all rows.
    """

    name: str
    get: Get = ""
    kind: str = "text"
    cut: int = 0
    order: int = 0
    varies: bool = False

    def cell(self, row: Any) -> str:
        """The text for a row."""
        get = self.get
        value = get(row) if callable(get) else row[self.name if get == "" else get]
        if value is None:
            return "-" if self.kind in {"bytes", "time", "second"} else ""
        return _SHOWN[self.kind](value)

    def aligned(self, cell: str, width: int) -> str:
        """A cell in a column of that width."""
        shown = cut(cell, width) if self.cut else cell
        return f"{shown:{'<' if self.kind in _LEFT else '>'}{width}}"


_Fitting = list[tuple[Column, int]]
"""Columns and their widths."""


def _fitting(columns: Sequence[Column], block: Sequence[Any], width: int | None) -> _Fitting | None:
    """As many columns as fit on a screen `width` characters wide (None: all), or None.

    They are as wide as their cells, or narrower where these may be cut, the last column first.
    """
    left = [*columns]
    for gone in (None, *sorted((one for one in columns if one.order), key=lambda one: one.order)):
        left = [one for one in left if one is not gone]
        widths = [max([len(one.name), *map(len, map(one.cell, block))]) for one in left]
        over = 0 if width is None else sum(widths) + 2 * (len(widths) - 1) - width
        for place, one in reversed([*enumerate(left)]):
            spare = widths[place] - max(len(one.name), one.cut)
            if one.cut and over > 0 and spare > 0:
                widths[place] -= min(spare, over)
                over -= spare
        if over <= 0:
            return [*zip(left, widths, strict=True)]
    return None


def _lines(fitting: _Fitting, rows: Iterable[Any]) -> Iterator[str]:
    """Headings, and rows below them."""
    yield "  ".join(one.aligned(one.name, width) for one, width in fitting).rstrip()
    for row in rows:
        yield "  ".join(one.aligned(one.cell(row), width) for one, width in fitting).rstrip()


def table_lines(columns: Sequence[Column], rows: Sequence[Any], width: int) -> list[str]:
    """The lines of a table, headings first; they are cut where no table fits the width."""
    fitting = _fitting(columns, rows, width) or _fitting(columns, rows, None) or []
    return [cut(line, width) for line in _lines(fitting, rows)]


def print_table(columns: Sequence[Column], rows: Iterable[Any]) -> bool:
    """Print rows under headings; on a terminal that has no room for them, a block for each row.

    Prints nothing without rows, and returns False. The first rows of a long table say how wide its
    columns are: memory does not grow with it.
    """
    source = iter(rows)
    block = [*islice(source, ROWS_AT_ONCE)]
    if not block:
        return False
    if len(block) < ROWS_AT_ONCE:
        columns = [one for one in columns if not one.varies or len({*map(one.cell, block)}) > 1]
    fitting = _fitting(columns, block, screen_width() if sys.stdout.isatty() else None)
    if fitting is not None:
        for line in _lines(fitting, chain(block, source)):
            print(line)  # noqa: T201
        return True
    for number, row in enumerate(chain(block, source)):
        title, *fields = ((one.name, one.cell(row)) for one in columns)
        if number:
            say()
        say(title[1])
        print_fields([pair for pair in fields if pair[1]], indent=2)
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
