"""How a robot's topics are doing: counted at the seam, before anything can be given up.

A message costs a few additions. Once a second the sums since the last look become rates,
and the rates of the last minute say what to expect.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from statistics import median

_REMEMBERED = 60  # looks whose rates say what is usual
_NS = 1e9


@dataclass(slots=True)
class Tally:
    """What has come on one channel; all of it is written by one thread at a time.

    Attributes:
        messages: Received so far.
        payload_bytes: Received so far.
        last: When the last one was received, ns since the epoch, 0 before the first.
        gaps: Sum of the times between messages since the last look, ns.
        squares: Sum of their squares, ns².
        counted: How many they are.
    """

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
    """A topic as it was at one look.

    Attributes:
        topic: Its name.
        type: Its type.
        messages: Received so far.
        payload_bytes: Received so far.
        hz: Messages a second since the look before.
        expected_hz: What is usual: the median of the last minute; None when too new.
        bytes_per_s: Payload bytes a second since the look before.
        jitter_ms: Standard deviation of the time between messages, None for too few.
        silent_s: Seconds since the last message, None before the first.
        thinned: Messages left out because the user wants fewer.
        lost: Messages lost so far otherwise, as far as they can be counted.
    """

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
    """What a topic's tallies become when they are looked at.

    Attributes:
        topic: Its name.
        type: Its type.
        tallies: One a channel.
    """

    topic: str
    type: str
    tallies: list[Tally] = field(default_factory=list)
    _messages: int = 0
    _bytes: int = 0
    _usual: deque[float] = field(default_factory=lambda: deque(maxlen=_REMEMBERED))

    def look(self, elapsed_s: float, now: int, *, thinned: int, lost: int) -> TopicState:
        """The topic now.

        Args:
            elapsed_s: Since the last look.
            now: ns since the epoch.
            thinned: Messages left out by wish so far.
            lost: Messages lost so far.
        """
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
        """Deviation of the gaps of the channel that has most of them, ms."""
        worst: float | None = None
        for tally in self.tallies:
            # A message that comes between these lines is counted at the next look.
            count, total, squares = tally.counted, tally.gaps, tally.squares
            tally.counted = tally.gaps = tally.squares = 0
            if count >= 2:
                deviation = math.sqrt(max(squares / count - (total / count) ** 2, 0.0)) / 1e6
                worst = deviation if worst is None else max(worst, deviation)
        return worst


class Lateness:
    """Tells messages that the index should have by now from those that came a moment ago.

    Args:
        within_s: Seconds after which the index has a message that came.
    """

    def __init__(self, within_s: float) -> None:
        self._within_s = within_s
        self._seen: deque[tuple[float, int]] = deque()

    def late(self, now: float, stored: int, lag: int) -> int:
        """Messages that are not in the index, and should be.

        Args:
            now: Monotonic, seconds.
            stored: Messages so far.
            lag: Of these, those that are not in the index.
        """
        self._seen.append((now, stored))
        due = now - self._within_s
        while len(self._seen) > 1 and self._seen[1][0] <= due:
            self._seen.popleft()
        at, expected = self._seen[0]
        return max(expected - (stored - lag), 0) if at <= due else 0
