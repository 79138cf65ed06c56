"""How far a benchmark has come: a bar with the time left on a terminal, lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID


class Steps:
    """Counts steps, each with a weight: about the seconds that it takes.

    Args:
        total: Sum of all weights.
        bar: Where the bar is drawn; None to write a line a step to standard error.
        task: The bar.
    """

    def __init__(self, total: float, bar: Progress | None, task: TaskID | None) -> None:
        self._total = total
        self._done = 0.0
        self._bar = bar
        self._task = task

    @contextmanager
    def step(self, text: str, weight: float) -> Iterator[None]:
        """One step: `text` is shown while it runs."""
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, description=text)
        started = time.monotonic()
        yield
        self._done += weight
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, completed=self._done)
        else:
            share = min(self._done / self._total, 1) if self._total else 1
            took = time.monotonic() - started
            print(f"{share:4.0%} {text} ({took:.1f} s)", file=sys.stderr, flush=True)


@contextmanager
def steps(total: float) -> Iterator[Steps]:
    """Show progress on standard error while the block runs.

    Args:
        total: Sum of the weights of all steps.
    """
    if not sys.stderr.isatty():
        yield Steps(total, None, None)
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description:32}"), BarColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), speed_estimate_period=600) as bar:
        yield Steps(total, bar, bar.add_task("", total=total))
