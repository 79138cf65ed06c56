"""What publisher and logger count together, in a small file that both have mapped.

Each number has one writer and is eight aligned bytes, so a reader sees it as it was
before or after a change, never in between, and nobody needs a lock. The file outlives
both processes: of a run that crashed it says how far that had come.
"""

from __future__ import annotations

import mmap
from pathlib import Path

import numpy as np


class Counters:
    """The numbers of one run.
    Attributes:
        sent: Messages of each channel that entered its queue; the publisher writes.
        dropped: Messages of each channel that found their queue full; the publisher writes.
        taken: Messages of each channel that left their queue; the channel's subscriber writes.
        errors: Messages of each channel whose insert raised; the channel's subscriber writes.
    """

    def __init__(self, path: Path, topics: int | None = None) -> None:
        if topics is not None:
            path.write_bytes(bytes(8 * 4 * topics))
        with path.open("r+b") as stream:
            whole = memoryview(mmap.mmap(stream.fileno(), 0)).cast("q")
        count = len(whole) // 4
        self.sent, self.dropped, self.taken, self.errors = (
            whole[n * count : (n + 1) * count] for n in range(4)
        )

    def published(self) -> list[int]:
        """Messages that were due, of each channel: those sent and those dropped."""
        sums: list[int] = (np.array(self.sent) + np.array(self.dropped)).tolist()
        return sums
