"""Progress bars, on a terminal only."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Self

from hybridlog.cli.output import console, cut, has_bars, printable
from hybridlog_storage.stopping import safe_point

if TYPE_CHECKING:
    from rich.progress import Progress


class Bar:
    """A bar with rate and remaining time; a context manager that removes it.

    It appears at the first progress, on a terminal. Elsewhere there is nothing. The total is in
    bytes, about; None if it is unknown, or each part tells its own.
    """

    def __init__(self, label: str, total: int | None = None, *, quiet: bool = False) -> None:
        self._label, self._total = label, total
        self._quiet = quiet or not has_bars() or not sys.stderr.isatty()
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
            self._bar = _make(has_end=total is not None)
            self._bar.add_task(_short(self._label), total=total, note="")
            self._bar.start()
        self._bar.update(self._bar.task_ids[0], completed=done, total=total, note=_short(note))

    def part(self, recording: str, done: int, total: int) -> None:
        """Report `done` of `total` bytes of a recording, until it is complete; a safe point."""
        safe_point()
        self(done, recording, max(total, 1))
        if done >= total:
            self.__exit__()


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


def _short(text: str) -> str:
    return cut(printable(text), 22)
