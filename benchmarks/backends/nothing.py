"""Keeps nothing: what the harness itself can carry."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from benchmarks.backends.base import Backend, BackendFailedError

if TYPE_CHECKING:
    from pathlib import Path

    from hybridlog_storage.messages import Channel

_COUNTS = "counts.json"


class Nothing(Backend):
    """Counts messages and lets them go.

    It writes its counts in `finish`, so that another process can read them as it reads
    those of a real system.
    """

    name, title = "nothing", "harness alone"

    def __init__(self, directory: Path) -> None:
        super().__init__(directory)
        self._topics: list[str] = []
        self._counts: list[int] = []

    def open(self, channels: Sequence[Channel]) -> None:
        """Note the topics."""
        self._topics = [channel.topic for channel in channels]
        self._counts = [0] * len(channels)

    def insert(self, channel: int, log_time: int, payload: bytes) -> None:
        """Count a message. A channel has one thread, so its number has one writer."""
        self._counts[channel] += 1

    def finish(self) -> None:
        """Write the counts."""
        totals: Counter[str] = Counter()
        for topic, count in zip(self._topics, self._counts, strict=True):
            totals[topic] += count
        (self.directory / _COUNTS).write_text(json.dumps(totals), encoding="utf-8")

    def counts(self) -> Mapping[str, int]:
        """The counts that were written."""
        try:
            text = (self.directory / _COUNTS).read_text(encoding="utf-8")
        except FileNotFoundError:
            raise BackendFailedError("nothing was counted: the run did not finish") from None
        counts: dict[str, int] = json.loads(text)
        return counts

    def close(self) -> None:
        """Nothing to stop."""
