"""Times from one message of a topic to the next: the usual one, the longest, how they vary."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

GAP_PERIODS: Final = 5
"""A time without messages is a gap if it is longer than so many usual periods."""
_SAMPLED: Final = 1_000_000  # steps that are kept, and those added with the last of them


def usual_period(steps: NDArray[np.int64]) -> float:
    """The usual period of a topic, ns, also of one whose messages come in bursts; 0 if unknown.

    Nine of ten steps (ns, from one message to the next) are no longer, and one long step among few
    does not count.
    """
    return float(np.quantile(steps, 0.9, method="lower")) if len(steps) else 0.0


class Steps:
    """Times from one message to the next: the first million of them, in bounded memory."""

    def __init__(self) -> None:
        self._steps: list[NDArray[np.int64]] = []
        self._left = _SAMPLED
        self.restart()

    def restart(self) -> None:
        """The next message does not follow the last one."""
        self._last: NDArray[np.int64] = np.empty(0, np.int64)

    def add(self, times: NDArray[np.int64]) -> None:
        """Add times of the next messages, ns."""
        if self._left > 0:
            self._steps.append(np.diff(np.concatenate([self._last, times])))
            self._left -= len(self._steps[-1])
            self._last = times[-1:] if len(times) else self._last

    def usual_period(self) -> float:
        """As the function of this name."""
        return usual_period(np.concatenate([np.empty(0, np.int64), *self._steps]))


def mean_rate(messages: int, first: int, last: int) -> float | None:
    """Messages a second from the first to the last, ns; None if they do not tell."""
    return (messages - 1) * 1e9 / (last - first) if messages > 1 and last > first else None
