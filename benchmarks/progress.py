"""How far a benchmark has come: a bar with the time left on a terminal, lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

_TRUSTED_S = 30.0
"""Until so much expected time is over, the expectation counts more than what was seen."""


class Steps:
    """Counts steps, each with a weight: about the seconds that it takes.

    Args:
        total: Sum of all weights.
        bar: Where the bar is drawn; None to write a line a step to standard error.
        task: The bar.
        clock: Seconds, ever growing.
    """

    def __init__(
        self,
        total: float,
        bar: Progress | None,
        task: TaskID | None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._total = total
        self._done = 0.0
        self._stepped = 0.0
        self._took = 0.0
        self._weight = 0.0
        self._started: float | None = None
        self._bar = bar
        self._task = task
        self._clock = clock

    @contextmanager
    def step(self, text: str, weight: float) -> Iterator[None]:
        """One step: `text` is shown while it runs."""
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, description=text)
        self._started, self._weight = self._clock(), weight
        try:
            yield
        finally:
            took = self._clock() - self._started
            self._started = None
        self._done += weight
        self._stepped += weight
        self._took += took
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, completed=self._done)
        else:
            share = min(self._done / self._total, 1) if self._total else 1
            left = short(self.left_s)
            print(f"{share:4.0%} {text} ({took:.1f} s), {left} left", file=sys.stderr, flush=True)

    def reach(self, weight: float) -> None:
        """A part is over, with fewer steps than were expected, or more.

        Args:
            weight: Of all parts until here.
        """
        self._done = weight
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, completed=weight)

    @property
    def left_s(self) -> float:
        """Seconds until the end: what is left, as much slower as the steps were until now."""
        pace = (self._took + _TRUSTED_S) / (self._stepped + _TRUSTED_S)
        left = max(self._total - self._done, 0.0) * pace
        if self._started is not None:
            # A step that takes longer than it should does not eat up the time of the others.
            left -= min(self._clock() - self._started, self._weight * pace)
        return max(left, 0.0)


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
    from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn
    from rich.text import Text

    class Left(ProgressColumn):
        """The time left, counting down also while a step runs."""

        def render(self, task: Task) -> Text:
            found: Steps | None = task.fields.get("steps")
            return Text("" if found is None else f"{short(found.left_s)} left")

    with Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=None),
        TextColumn("{task.percentage:>3.0f} %"),
        Left(),
        console=Console(stderr=True, highlight=False),
        expand=True,
    ) as bar:
        task = bar.add_task("", total=max(total, 1e-9), steps=None)
        counted = Steps(total, bar, task)
        bar.update(task, steps=counted)
        yield counted


def short(seconds: float) -> str:
    """A length of time for people: `12 s`, `3 min`, `2 h 05 min`."""
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    if minutes < 100:
        return f"{minutes} min"
    return f"{minutes // 60} h {minutes % 60:02} min"
