"""Lines of progress: what was done, and how long it took."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field


@dataclass
class Progress:
    """How far a run has come.

    Args:
        quiet: Print nothing.
    """

    quiet: bool = False
    _begun: float = field(default_factory=time.monotonic)

    @property
    def minutes(self) -> float:
        """Since the run was started."""
        return (time.monotonic() - self._begun) / 60

    @contextmanager
    def step(self, text: str) -> Iterator[None]:
        """Write a line to standard error when the block has ended well."""
        started = time.monotonic()
        yield
        self.say(f"{text} ({time.monotonic() - started:.1f} s)")

    def say(self, text: str) -> None:
        """Write a line, with the time so far."""
        if not self.quiet:
            minutes, seconds = divmod(round(self.minutes * 60), 60)
            print(f"[{minutes}:{seconds:02}] {text}", file=sys.stderr, flush=True)
