"""Progress bars, on a terminal only."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Protocol

from hybridlog.cli.output import console, printable
from hybridlog_storage.stopping import safe_point

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID


class Bar(Protocol):
    """Shows progress."""

    def __call__(self, done: int, note: str = "") -> None:
        """Set the number of finished bytes, and a note beside the bar."""


@contextmanager
def progress_bar(label: str, total: int | None, *, quiet: bool) -> Iterator[Bar]:
    """A bar with rate and remaining time on a terminal; nothing elsewhere.

    Args:
        label: Name of the work.
        total: Approximate number of bytes; None if unknown.
        quiet: No bar.
    """
    if quiet or not sys.stderr.isatty():
        yield _nothing
        return
    bar = _make(has_end=total is not None)
    with bar:
        end = None if total is None else max(total, 1)
        task = bar.add_task(_short(printable(label)), total=end, note="")
        yield _Updater(bar, task)


class Stages:
    """One bar for several parts that each count from zero."""

    def __init__(self, bar: Bar) -> None:
        self._bar = bar
        self._before = 0
        self._part: tuple[str, int] | None = None
        self._last = 0

    def __call__(self, recording: str, done: int, total: int) -> None:
        """Report `done` of `total` bytes of a recording."""
        part = (recording, total)
        if self._part != part or done < self._last:
            self._before += self._last
            self._part = part
        self._last = done
        self._bar(self._before + done, recording)


class LateBar:
    """A bar that appears at the first progress, for work that is seldom needed."""

    def __init__(self, label: str, *, quiet: bool) -> None:
        self._label = label
        self._quiet = quiet or not sys.stderr.isatty()
        self._bar: Progress | None = None
        self._task: TaskID | None = None

    def __call__(self, recording: str, done: int, total: int) -> None:
        """Report `done` of `total` bytes of a recording; a safe point."""
        safe_point()
        if self._quiet:
            return
        if self._bar is None:
            self._bar = _make()
            self._bar.start()
        if self._task is None:
            self._task = self._bar.add_task(self._label, total=total, note="")
        self._bar.update(self._task, completed=done, total=total, note=_short(printable(recording)))

    def close(self) -> None:
        """Remove it."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = None


class _Updater:
    def __init__(self, bar: Progress, task: TaskID) -> None:
        self._bar = bar
        self._task = task

    def __call__(self, done: int, note: str = "") -> None:
        self._bar.update(self._task, completed=done, note=_short(printable(note)))


def _nothing(done: int, note: str = "") -> None:
    """No bar."""


def _make(*, has_end: bool = True) -> Progress:
    from rich.progress import (
        BarColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeRemainingColumn,
        TransferSpeedColumn,
    )

    # Texts are names out of logs: they are never read as markup.
    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=None),
        *((TaskProgressColumn(),) if has_end else ()),
        TransferSpeedColumn(),
        *((TextColumn("ETA"), TimeRemainingColumn(compact=True)) if has_end else ()),
        TextColumn("{task.fields[note]}", markup=False),
        console=console(error=True),
        transient=True,
        expand=True,
    )


def _short(text: str, most: int = 22) -> str:
    return text if len(text) <= most else text[: most - 1] + "…"
