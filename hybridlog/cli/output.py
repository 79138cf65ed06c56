"""Prints answers, tables, JSON and notes; writes sizes and times for people."""

from __future__ import annotations

import json
import shutil
import sys
import textwrap
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, is_dataclass
from itertools import islice, zip_longest
from typing import TYPE_CHECKING, Literal, TextIO

from hybridlog import wording

if TYPE_CHECKING:
    from rich.console import Console

    from hybridlog_storage.catalog import ChannelEntry

counted = wording.counted
unfit = wording.unfit
size = wording.size
parse_size = wording.parse_size

Column = tuple[str, Literal["left", "right", "whole"]]
"""Heading and justification; `whole` is left and never folded, as numbers on the right are."""

ROWS_AT_ONCE = 10_000
"""Rows of a table that are laid out together."""
_MAX_LINE = 100  # characters of a note, an attachment and the like
_MIN_ROOM = 20  # characters of a folded value


def console(*, error: bool = False) -> Console:
    """A console for a terminal."""
    from rich.console import Console

    return Console(file=sys.stderr if error else sys.stdout, highlight=False)


def print_table(columns: Sequence[Column], rows: Iterable[Sequence[str]]) -> None:
    """Print rows under headings; on a terminal, cells that do not fit are folded.

    A long table is printed some rows at a time: memory does not grow with it. Columns become
    wider where later rows need it.

    Args:
        columns: Headings, and the side on which the cells stand.
        rows: Cells; control characters in them are shown, not obeyed.
    """
    shown = (_printable_row(row) for row in rows)
    named: Sequence[Column] = [(printable(heading), side) for heading, side in columns]
    widths = [len(heading) for heading, _ in named]
    block, is_first = list(islice(shown, ROWS_AT_ONCE)), True
    while block or is_first:
        _widen(widths, block)
        if sys.stdout.isatty():
            _print_on_screen(named, block, widths, headings=is_first)
        else:
            for line in _lines_of(named, block, widths, headings=is_first):
                say(line)
        block, is_first = list(islice(shown, ROWS_AT_ONCE)), False


def print_pages(columns: Sequence[Column], rows: Sequence[Sequence[str]]) -> None:
    """As `print_table`, but in the user's pager on a terminal that has too few lines."""
    if not sys.stdout.isatty() or len(rows) < console().height:
        print_table(columns, rows)
        return
    import click

    shown = [_printable_row(row) for row in rows]
    widths = [len(heading) for heading, _ in columns]
    _widen(widths, shown)
    click.echo_via_pager(f"{line}\n" for line in _lines_of(columns, shown, widths))


def _widen(widths: list[int], rows: Sequence[Sequence[str]]) -> None:
    """Make columns as wide as their cells."""
    for n, cells in enumerate(zip(*rows, strict=True)):
        widths[n] = max(widths[n], *map(len, cells))


def _print_on_screen(
    columns: Sequence[Column],
    rows: Sequence[Sequence[str]],
    widths: Sequence[int],
    *,
    headings: bool,
) -> None:
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False, header_style="bold", show_header=headings)
    # The same columns as those of the rows above, unless they are folded.
    shared: Sequence[int | None] = widths_within(columns, rows, widths) or [None] * len(widths)
    for (heading, side), width in zip(columns, shared, strict=True):
        table.add_column(
            Text(heading),
            justify="right" if side == "right" else "left",
            no_wrap=side != "left",
            overflow="fold",
            min_width=width,
            max_width=width,
        )
    for row in rows:
        table.add_row(*(Text(cell) for cell in row))
    console().print(table)


def widths_within(
    columns: Sequence[Column], rows: Sequence[Sequence[str]], widths: Sequence[int]
) -> list[int] | None:
    """Widths in which a table fits the screen without a broken word; None if there are none.

    Args:
        columns: Headings, and the side on which the cells stand.
        rows: Cells.
        widths: Widths in which no cell is folded.
    """
    least = [
        max(map(len, " ".join([heading, *cells]).split()), default=0) if side == "left" else width
        for (heading, side), width, cells in zip(
            columns, widths, zip(*rows, strict=True) if rows else [()] * len(widths), strict=True
        )
    ]
    found, spare = list(widths), console().width - 2 * (len(widths) - 1) - sum(widths)
    while spare < 0:
        place = max(range(len(found)), key=lambda n: (found[n] > least[n], found[n]))
        if found[place] <= least[place]:
            return None
        found[place] -= 1
        spare += 1
    return found


def _lines_of(
    columns: Sequence[Column],
    rows: Sequence[Sequence[str]],
    widths: Sequence[int],
    *,
    headings: bool = True,
) -> Iterator[str]:
    """Headings and rows at full width: nothing is folded or left out."""
    sides = (">" if side == "right" else "<" for _, side in columns)
    line = "  ".join(f"{{:{side}{width}}}" for side, width in zip(sides, widths, strict=True))
    for row in [[heading for heading, _ in columns], *rows] if headings else rows:
        yield line.format(*row).rstrip()


def is_narrow() -> bool:
    """True on a terminal that is too narrow for the less important columns."""
    return sys.stdout.isatty() and console().width < 100


def fits(names: Sequence[str], rows: Sequence[Sequence[str]]) -> bool:
    """True when rows fit the terminal as a table; files and pipes fit any row."""
    return not sys.stdout.isatty() or room(names, rows) >= 0


def fitted(
    columns: Sequence[Column], rows: Sequence[Sequence[str]], spare: Sequence[str]
) -> tuple[Sequence[Column], Sequence[Sequence[str]]]:
    """A table without its less important columns, where the terminal has no room for them.

    Args:
        columns: Headings, and the side on which the cells stand.
        rows: Cells.
        spare: Headings of columns that may be left out, the least important first.
    """
    for name in spare:
        headings = [heading for heading, _ in columns]
        if fits(headings, rows):
            break
        kept = [n for n, heading in enumerate(headings) if heading != name]
        columns, rows = [columns[n] for n in kept], [[row[n] for n in kept] for row in rows]
    return columns, rows


def room(names: Sequence[str], rows: Sequence[Sequence[str]]) -> int:
    """Columns of the terminal that a table leaves.

    Args:
        names: Headings; one more than cells in a row is a column that is yet empty.
        rows: Cells.
    """
    widths = [max(map(len, cells)) for cells in zip_longest(names, *rows, fillvalue="")]
    return console().width - sum(widths) - 2 * len(widths)


def print_rows(
    columns: Sequence[Column],
    rows: Sequence[Sequence[str]],
    titles: int,
    spare: Sequence[str] = (),
) -> None:
    """Print a table, or a block for each row where the screen would break words of a table.

    Args:
        columns: Headings, and the side on which the cells stand.
        rows: Cells.
        titles: Number of cells that are the title of a block.
        spare: Columns that a table may leave out, see `fitted`; a block has them all.
    """
    less, cells = fitted(columns, rows, spare)
    widths = [len(heading) for heading, _ in less]
    _widen(widths, cells)
    if not sys.stdout.isatty() or widths_within(less, cells, widths) is not None:
        print_table(less, cells)
        return
    for row in rows:
        named = zip(columns[titles:], row[titles:], strict=True)
        print_record("  ".join(row[:titles]), [(heading, cell) for (heading, _), cell in named])


def print_record(title: str, fields: Sequence[tuple[str, str]]) -> None:
    """Print one message: a title, a line a field, folded on a terminal, and an empty one."""
    width = max((len(name) for name, _ in fields), default=0)
    room = max(console().width - width - 4, _MIN_ROOM) if sys.stdout.isatty() else None
    say(title)
    for name, value in fields:
        lines = [value]
        if room is not None:
            lines = textwrap.wrap(printable(value), room, break_on_hyphens=False) or [""]
        for heading, line in zip_longest([name], lines, fillvalue=""):
            say(f"  {heading:<{width}}  {line}".rstrip())
    say()


def _printable_row(row: Sequence[str]) -> Sequence[str]:
    return row if all(map(str.isprintable, row)) else [*map(printable, row)]


def printable(text: str) -> str:
    """Text without control characters: names in logs are untrusted."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else _escaped(ord(c)) for c in text)


def _escaped(code: int) -> str:
    if code < 0x100:
        return f"\\x{code:02x}"
    return f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"


def quoted(text: str) -> str:
    """Typed text in quotes; bytes that are not UTF-8 are shown as escapes."""
    raw = text.encode("utf-8", "surrogateescape")
    return f"'{printable(raw.decode('utf-8', 'backslashreplace'))}'"


def cut(line: str, most: int = _MAX_LINE) -> str:
    """A line, cut off where it is longer than so many characters."""
    return line if len(line) <= most else f"{line[: most - 1]}…"


def say(text: str = "") -> None:
    """A line of the answer, on standard output."""
    print(printable(text))  # noqa: T201


def print_json(value: object) -> None:
    """Print a value as JSON."""
    print(_json(value))  # noqa: T201


def _json(value: object) -> str:
    return json.dumps(value, default=_plain, indent=2, ensure_ascii=False)


def print_json_line(value: object) -> None:
    """Print a value as JSON on one line, at once."""
    print(json.dumps(value, default=_plain, ensure_ascii=False), flush=True)  # noqa: T201


def note(text: str) -> None:
    """A line for the person, on standard error."""
    print(folded(text), file=sys.stderr)  # noqa: T201


def say_folded(text: str) -> None:
    """A long line of the answer, which a terminal shows without broken words."""
    for line in folded(text, sys.stdout).split("\n"):
        say(line)


def folded(text: str, stream: TextIO | None = None) -> str:
    """A line for standard error or another stream: a terminal shows it without broken words."""
    text = printable(text)
    if not (stream or sys.stderr).isatty():
        return text
    width = shutil.get_terminal_size().columns
    return textwrap.fill(text, width, break_long_words=False, break_on_hyphens=False)


def notes(lines: Iterable[str]) -> None:
    """Lines for the person, on standard error."""
    for line in lines:
        note(line)


def stored(messages: int) -> str:
    """A number of stored messages: `1 message is stored`."""
    return f"{counted(messages, 'message')} {'is' if messages == 1 else 'are'} stored"


def without_documents(messages: int) -> str:
    """The end of a line that names messages of topics recorded with `--no-index`, if any."""
    verb = "has" if messages == 1 else "have"
    return f"; {counted(messages, 'message')} {verb} no documents (--no-index)" if messages else ""


def surpluses(channels: Sequence[ChannelEntry]) -> Iterator[str]:
    """A line for each topic with messages that are longer than their type."""
    counts: Counter[str] = Counter()
    for channel in channels:
        counts[channel.topic] += channel.stats.surplus
    for topic, messages in counts.items():
        if messages:
            types = {channel.type for channel in channels if channel.topic == topic}
            verb = "has" if messages == 1 else "have"
            yield (
                f"{topic}: {counted(messages, 'message')} {verb} bytes left over behind the last "
                f"field of {', '.join(sorted(types))}; the fields are read"
            )


def short_time(ns: int, *, minutes: bool = False) -> str:
    """A time in UTC to the second, or to the minute, for lists."""
    from hybridlog.query.times import format_time

    whole = format_time(ns - ns % 10**9)
    return whole[:16] + "Z" if minutes else whole


def begin_and_end(begin: int, end: int) -> tuple[str, str]:
    """Times in UTC; on a narrow terminal to the ms, and the end without the day of the begin."""
    from hybridlog.query.times import format_time

    if not is_narrow():
        return format_time(begin), format_time(end)
    first, last = (format_time(ns - ns % 10**6) for ns in (begin, end))
    day, _, time = last.partition("T")
    return first, time if first.startswith(day) else last


def short_duration(ns: int) -> str:
    """A length of time to four digits; from a second on to the ms, from a day on to the hour."""
    from hybridlog.query.times import format_duration

    step = 10**6
    if abs(ns) < 10**9:
        step = 10 ** max(0, len(str(abs(ns))) - 4)
    elif abs(ns) >= 86_400 * 10**9:
        step = 3_600 * 10**9
    return format_duration(round(ns / step) * step)


def _plain(value: object) -> object:
    if is_dataclass(value) and not isinstance(value, type):
        return asdict(value)
    return str(value)
