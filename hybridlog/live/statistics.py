"""Statistics of a robot's topics: counts, rates, jitter and silence.

Messages are counted as sources deliver them, before any can be dropped. A message costs a
few additions. Once a second the sums become rates; the rates of the last minute give the
expected rate.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from statistics import median

_RATES = 60  # so many past rates give the expected rate
_NS = 1e9


@dataclass(slots=True)
class Tally:
    """Counters of one channel; one thread at a time updates them. Times in ns."""

    messages: int = 0
    payload_bytes: int = 0
    last: int = 0
    gaps: int = 0
    squares: int = 0
    counted: int = 0

    def add(self, size: int, received: int) -> None:
        """Count a message."""
        if self.last:
            gap = received - self.last
            self.gaps += gap
            self.squares += gap * gap
            self.counted += 1
        self.last = received
        self.messages += 1
        self.payload_bytes += size


@dataclass(frozen=True, slots=True)
class TopicState:
    """Statistics of a topic at one time."""

    topic: str
    type: str
    messages: int
    payload_bytes: int
    hz: float
    expected_hz: float | None
    bytes_per_s: float
    jitter_ms: float | None
    silent_s: float | None
    thinned: int
    lost: int


@dataclass(slots=True)
class TopicRates:
    """Turns the counters of a topic into rates."""

    topic: str
    type: str
    tallies: list[Tally] = field(default_factory=list)
    _messages: int = 0
    _bytes: int = 0
    _usual: deque[float] = field(default_factory=lambda: deque(maxlen=_RATES))

    def look(self, elapsed_s: float, now: int, *, thinned: int, lost: int) -> TopicState:
        """The topic's statistics since the last call."""
        messages = sum(tally.messages for tally in self.tallies)
        size = sum(tally.payload_bytes for tally in self.tallies)
        hz = (messages - self._messages) / elapsed_s
        rate = (size - self._bytes) / elapsed_s
        self._messages, self._bytes = messages, size
        expected = median(self._usual) if len(self._usual) >= 3 else None
        self._usual.append(hz)
        last = max((tally.last for tally in self.tallies), default=0)
        return TopicState(
            self.topic,
            self.type,
            messages,
            size,
            hz,
            expected,
            rate,
            self._jitter(),
            max(now - last, 0) / _NS if last else None,
            thinned,
            lost,
        )

    def _jitter(self) -> float | None:
        """Largest standard deviation of the time between messages of a channel, ms."""
        worst: float | None = None
        for tally in self.tallies:
            # A message that arrives between these lines counts at the next call.
            count, total, squares = tally.counted, tally.gaps, tally.squares
            tally.counted = tally.gaps = tally.squares = 0
            if count >= 2:
                deviation = math.sqrt(max(squares / count - (total / count) ** 2, 0.0)) / 1e6
                worst = deviation if worst is None else max(worst, deviation)
        return worst
