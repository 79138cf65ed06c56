"""Prints JSON, notes and progress; writes sizes and times for people."""

from __future__ import annotations

import json
import shutil
import sys
import textwrap
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict, is_dataclass
from typing import TYPE_CHECKING, Self, TextIO

from hybridlog import wording
from hybridlog_storage.stopping import safe_point

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

_manner = {"quiet": False, "as_json": False}

counted = wording.counted
unfit = wording.unfit
size = wording.size

_MAX_LINE = 100  # characters of a note, an attachment and the like


def begin(given: object) -> None:
    """Print from now on as the options of a command say: `--quiet`, `--json`."""
    _manner.update({name: getattr(given, name, False) for name in _manner})


def is_quiet() -> bool:
    """Whether the command prints errors only."""
    return _manner["quiet"]


def has_bars() -> bool:
    """Whether the command shows its progress where there is a terminal."""
    return not any(_manner.values()) and sys.stderr.isatty()


def console(*, error: bool = False) -> Console:
    """A console for a terminal."""
    from rich.console import Console

    return Console(file=sys.stderr if error else sys.stdout, highlight=False)


def screen_width() -> int:
    """Columns of the terminal."""
    return shutil.get_terminal_size().columns


def wrapped(text: str, width: int) -> list[str]:
    """Lines of at most so many characters, without broken words."""
    return textwrap.wrap(text, width, break_long_words=False, break_on_hyphens=False)


def printable(text: str) -> str:
    """Text without control characters: names in logs are untrusted."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else _escaped(ord(c)) for c in text)


def _escaped(code: int) -> str:
    if code < 0x100:
        return f"\\x{code:02x}"
    return f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"


def cut(line: str, most: int = _MAX_LINE) -> str:
    """A line, cut off where it is longer than so many characters."""
    return line if len(line) <= most else f"{line[: most - 1]}…"


def quoted(text: str) -> str:
    """Typed text in quotes; bytes that are not UTF-8 are shown as escapes."""
    raw = text.encode("utf-8", "surrogateescape")
    return f"'{printable(raw.decode('utf-8', 'backslashreplace'))}'"


def folded(text: str, stream: TextIO | None = None) -> str:
    """A line for standard error or another stream: a terminal shows it without broken words."""
    text = printable(text)
    return "\n".join(wrapped(text, screen_width())) if (stream or sys.stderr).isatty() else text


def say(text: str = "") -> None:
    """A line of the answer, on standard output."""
    print(printable(text))  # noqa: T201


def tell(value: object, lines: Iterable[str], *, at_once: bool = False) -> None:
    """Print a result as JSON, with `at_once` on a line; or in lines, which --quiet leaves out."""
    if _manner["as_json"]:
        print_json(value, at_once=at_once)
    elif not is_quiet():
        for line in lines:
            print(folded(line, sys.stdout))  # noqa: T201


def print_json(value: object, *, at_once: bool = False) -> None:
    """Print a value as JSON; with `at_once` on a line."""
    text = json.dumps(value, default=_plain, indent=None if at_once else 2, ensure_ascii=False)
    print(text, flush=at_once)  # noqa: T201


def _plain(value: object) -> object:
    if is_dataclass(value) and not isinstance(value, type):
        return asdict(value)
    return str(value)


def note(text: str) -> None:
    """A line for the person, on standard error; who reads it may go, and the work goes on."""
    with suppress(BrokenPipeError):
        print(folded(text), file=sys.stderr)  # noqa: T201


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


def short_time(ns: int | None) -> str:
    """A time in UTC to the second, for lists."""
    return time_text(ns, 10**9)


def short_duration(ns: int) -> str:
    """A length of time to four digits; from a second on to the ms, from a day on to the hour."""
    from hybridlog.query.times import format_duration

    step = 10**6
    if abs(ns) < 10**9:
        step = 10 ** max(0, len(str(abs(ns))) - 4)
    elif abs(ns) >= 86_400 * 10**9:
        step = 3_600 * 10**9
    return format_duration(round(ns / step) * step)


class Bar:
    """A bar with rate and remaining time; a context manager that removes it.

    It appears at the first progress, on a terminal. Elsewhere there is nothing. The total is in
    bytes, about; None if it is unknown, or each part tells its own.
    """

    def __init__(self, label: str, total: int | None = None, *, quiet: bool = False) -> None:
        self._label, self._total = label, total
        self._quiet = quiet or not has_bars()
        self._bar: Progress | None = None

    def __enter__(self) -> Self:
        """The bar, which does not show yet."""
        return self

    def __exit__(self, *_: object) -> None:
        """Remove the bar."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    def __call__(self, done: int, note: str = "", total: int | None = None) -> None:
        """Set the number of finished bytes, and a note beside the bar."""
        if self._quiet:
            return
        total = total or self._total
        if self._bar is None:
            self._bar = _progress(has_end=total is not None)
            self._bar.add_task(_short(self._label), total=total, note="")
            self._bar.start()
        self._bar.update(self._bar.task_ids[0], completed=done, total=total, note=_short(note))

    def part(self, recording: str, done: int, total: int) -> None:
        """Report `done` of `total` bytes of a recording, until it is complete; a safe point."""
        safe_point()
        self(done, recording, max(total, 1))
        if done >= total:
            self.__exit__()


def _progress(*, has_end: bool) -> Progress:
    from rich import progress as rich

    # Texts are names out of logs: they are never read as markup.
    return rich.Progress(
        rich.TextColumn("{task.description}", markup=False),
        rich.BarColumn(bar_width=None),
        *((rich.TaskProgressColumn(),) if has_end else ()),
        rich.TransferSpeedColumn(),
        *((rich.TextColumn("ETA"), rich.TimeRemainingColumn(compact=True)) if has_end else ()),
        rich.TextColumn("{task.fields[note]}", markup=False),
        console=console(error=True),
        transient=True,
        expand=True,
    )


def _short(text: str) -> str:
    return cut(printable(text), 22)
