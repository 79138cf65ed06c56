"""Lines of progress: what was done, how long it took, and about how much is left."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field


@dataclass
class Progress:
    """How far a run has come.

    Args:
        pieces: Names of its pieces in their order, and the minutes that each may take.
        quiet: Print nothing.
    """

    pieces: Sequence[tuple[str, float]] = ()
    quiet: bool = False
    _begun: float = field(default_factory=time.monotonic)
    _piece: int = -1
    _piece_begun: float = 0.0

    @property
    def minutes(self) -> float:
        """Since the run was started."""
        return (time.monotonic() - self._begun) / 60

    def begin(self, piece: int) -> None:
        """A piece begins."""
        self._piece, self._piece_begun = piece, time.monotonic()

    def left(self) -> float:
        """Minutes that the rest of the run may take."""
        if self._piece < 0:
            return sum(minutes for _, minutes in self.pieces)
        done = (time.monotonic() - self._piece_begun) / 60
        rest = sum(minutes for _, minutes in self.pieces[self._piece + 1 :])
        return max(self.pieces[self._piece][1] - done, 0.0) + rest

    @contextmanager
    def step(self, text: str) -> Iterator[None]:
        """Write a line to standard error when the block has ended well."""
        started = time.monotonic()
        yield
        self.say(f"{text} ({time.monotonic() - started:.1f} s)")

    def say(self, text: str) -> None:
        """Write a line, with the time so far and the time that is left."""
        if not self.quiet:
            seconds = round(self.minutes * 60)
            left = f", about {self.left():.0f} min left" if self.pieces else ""
            clock = f"{seconds // 60}:{seconds % 60:02}"
            print(f"[{clock}{left}] {text}", file=sys.stderr, flush=True)
