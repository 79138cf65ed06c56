"""Everything that is printed: tables, sizes, times, progress, JSON."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from rich.console import Console

    from hybridlog.store import Store

_UNITS = ("B", "kB", "MB", "GB", "TB")
_SIZE = re.compile(r"\s*(\d+(?:\.\d+)?)\s*([kKmMgG]?)(i?)[bB]?\s*")


def console(*, error: bool = False) -> Console:
    """A console; on a pipe it is as wide as its content needs, without colour."""
    from rich.console import Console

    stream = sys.stderr if error else sys.stdout
    width = None if stream.isatty() else 240
    return Console(file=stream, width=width, highlight=False, soft_wrap=not stream.isatty())


def print_table(
    columns: Sequence[tuple[str, str]], rows: Sequence[Sequence[str]], *, title: str | None = None
) -> None:
    """Print rows under headings.

    Args:
        columns: Heading and justification (`left`, `right`) of each.
        rows: Cells; control characters in them are shown, not obeyed.
        title: Printed above.
    """
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False, title=title, title_justify="left", header_style="bold")
    for heading, side in columns:
        table.add_column(
            heading,
            justify="right" if side == "right" else "left",
            no_wrap=not sys.stdout.isatty() or side == "right",
            overflow="fold",
        )
    for row in rows:
        table.add_row(*(Text(printable(cell)) for cell in row))
    console().print(table)


def print_records(names: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print rows as a table when it fits the screen, else as one block a row."""
    widths = [
        max([len(name), *(len(row[i]) for row in rows)]) for i, name in enumerate(names)
    ]
    if not sys.stdout.isatty() or sum(widths) + 2 * len(widths) <= console().width:
        print_table([(name, "left") for name in names], rows)
        return
    longest = max(map(len, names))
    for row in rows:
        for name, cell in zip(names, row, strict=True):
            print(printable(f"{name:<{longest}}  {cell}"))  # noqa: T201
        print()  # noqa: T201


def printable(text: str) -> str:
    """Text without control characters: names in logs are untrusted."""
    return "".join(c if c.isprintable() else f"\\x{ord(c):02x}" for c in text)


def print_json(value: object) -> None:
    """Print a value as JSON."""
    print(json.dumps(value, default=_plain, indent=2, ensure_ascii=False))  # noqa: T201


def note(text: str) -> None:
    """A line for the person, on standard error."""
    print(printable(text), file=sys.stderr)  # noqa: T201


def size(count: float) -> str:
    """Bytes for people: `12.3 MB`."""
    value = float(count)
    for unit in _UNITS:
        if value < 1000 or unit == _UNITS[-1]:
            return f"{value:.0f} {unit}" if unit == "B" else f"{value:.1f} {unit}"
        value /= 1000
    raise AssertionError


def parse_size(text: str) -> int:
    """Bytes from `1MiB`, `500kB`, `65536`.

    Raises:
        UsageError: it is no size.
    """
    match = _SIZE.fullmatch(text)
    if match is None:
        raise UsageError(f"{text!r} is no size: write 65536, 500kB or 1MiB.")
    number, prefix, binary = match.groups()
    base = 1024 if binary else 1000
    power = " kmg".index(prefix.lower()) if prefix else 0
    return int(float(number) * base**power)


class Bar(Protocol):
    """Shows progress."""

    def __call__(self, done: int, note: str = "") -> None:
        """So much is done."""


@contextmanager
def progress_bar(label: str, total: int, *, quiet: bool) -> Iterator[Bar]:
    """A bar with rate and remaining time on a terminal; nothing elsewhere."""
    if quiet or not sys.stderr.isatty():
        yield lambda done, note="": None  # noqa: ARG005
        return
    from rich.progress import (
        BarColumn,
        DownloadColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
        TransferSpeedColumn,
    )

    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        DownloadColumn(),
        TransferSpeedColumn(),
        TextColumn("{task.fields[note]}"),
        TextColumn("ETA"),
        TimeRemainingColumn(),
        console=console(error=True),
        transient=True,
    )
    with bar:
        task = bar.add_task(printable(label), total=total, note="")
        yield lambda done, note="": bar.update(task, completed=done, note=note)


@contextmanager
def opened(
    path: Path | None, mongo: str | None, *, create: bool = False, needs_database: bool = False
) -> Iterator[Store]:
    """A store, with a word about what had to be mended."""
    from hybridlog.store import open_store

    with open_store(path, mongo=mongo, create=create, require_database=needs_database) as store:
        for recording, segments in store.tended.recovered.items():
            kept = sum(s.messages for s in segments)
            note(f"Recording {recording} was cut short by a crash; {kept} messages are recovered.")
            for segment in segments:
                for damage in segment.damage:
                    note(f"  damaged: {damage}")
        if store.without_database is not None:
            note(f"MongoDB is away, so only topics and times can be asked for: "
                 f"{store.without_database}")
        yield store


def _plain(value: object) -> object:
    if is_dataclass(value) and not isinstance(value, type):
        return asdict(value)
    if isinstance(value, Path):
        return str(value)
    return str(value)
