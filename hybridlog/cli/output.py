"""Prints JSON, notes and progress; writes sizes and times for people."""

from __future__ import annotations

import json
import shutil
import sys
import textwrap
import threading
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from typing import Final, Self, TextIO

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
            clear()
            print(folded(line, sys.stdout))  # noqa: T201


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
        print(folded(text), file=sys.stderr)  # noqa: T201


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
    """A line with bar, rate and remaining time; a context manager that removes it.

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
        rate = done / (now - self._begin or 1)
        texts = [_short(self._label), f"{size(rate)}/s", _short(note)]
        if total:
            share = min(done / total, 1)
            minutes, seconds = divmod(int((total - done) / rate) if 0 < done < total else 0, 60)
            texts[1:1] = ["", f"{share:.0%}"]
            texts.insert(-1, f"ETA {minutes:02}:{seconds:02}")
            room = max(screen_width() - len(" ".join(texts)) - 1, 0)
            texts[1] = f"{'━' * int(share * room):<{room}}"
        self._line.draw([" ".join(texts)])

    def part(self, recording: str, done: int, total: int) -> None:
        """Report `done` of `total` bytes of a recording, until it is complete; a safe point."""
        safe_point()
        self(done, recording, max(total, 1))
        if done >= total:
            self.__exit__()


def _short(text: str) -> str:
    return cut(printable(text), 22)
