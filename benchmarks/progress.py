"""Progress of a benchmark: a line a step, with the time left."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager


class Steps:
    """Counts steps, each with a weight: about the seconds that it takes.

    Args:
        total: Sum of all weights.
    """

    def __init__(self, total: float) -> None:
        self._total = max(total, 1e-9)
        self._done = 0.0

    @contextmanager
    def step(self, text: str, weight: float) -> Iterator[None]:
        """One step: `text` is shown when it is done."""
        started = time.monotonic()
        yield
        self._done += weight
        took, left = time.monotonic() - started, max(self._total - self._done, 0.0)
        share = min(self._done / self._total, 1)
        print(
            f"{share:4.0%} {text} ({took:.1f} s), {short(left)} left", file=sys.stderr, flush=True
        )


def short(seconds: float) -> str:
    """A length of time for people: `12 s`, `3 min`, `2 h 05 min`."""
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60:02} min"
