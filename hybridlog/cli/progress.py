"""Progress bars, on a terminal only."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Self

from hybridlog.cli.output import console, has_bars, printable
from hybridlog_storage.stopping import safe_point

if TYPE_CHECKING:
    from rich.progress import Progress


class Bar:
    """A bar with rate and remaining time; a context manager that removes it.

    It appears at the first progress, on a terminal. Elsewhere there is nothing. The total is in
    bytes, about: None if it is unknown, 0 if each part tells its own.
    """

    def __init__(self, label: str, total: int | None = 0, *, quiet: bool = False) -> None:
        self._label = _short(label)
        self._total = total
        self._quiet = quiet or not has_bars() or not sys.stderr.isatty()
        self._bar: Progress | None = None
        self._before = self._last = 0
        self._part: tuple[str, int] | None = None
        self._over = False

    def __enter__(self) -> Self:
        """The bar, which does not show yet."""
        return self

    def __exit__(self, *_: object) -> None:
        """Remove it; what comes later is shown until it is complete."""
        self._over = True
        self._remove()

    def _remove(self) -> None:
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    def __call__(self, done: int, note: str = "", total: int | None = None) -> None:
        """Set the number of finished bytes, and a note beside the bar."""
        if self._quiet:
            return
        total = self._total or total
        if self._bar is None:
            self._bar = _make(has_end=total is not None)
            self._bar.add_task(self._label, total=total, note="")
            self._bar.start()
        task = self._bar.task_ids[0]
        self._bar.update(task, completed=done, total=total, note=_short(note))

    def part(self, recording: str, done: int, total: int) -> None:
        """Report `done` of `total` bytes of a recording, which each count from 0; a safe point."""
        safe_point()
        if self._part != (recording, total) or done < self._last:
            self._before += self._last
            self._part = recording, total
        self._last = done
        self(done + (self._before if self._total else 0), recording, max(total, 1))
        if self._over and done >= total:
            self._remove()


def _make(*, has_end: bool) -> Progress:
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
    text = printable(text)
    return text if len(text) <= most else text[: most - 1] + "…"
