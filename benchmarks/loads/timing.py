"""When the messages of a stream are stamped, and when a logger gets them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

_STALL_PART = 0.001
_STALL_NS = (5e6, 25e6)
_APART_NS = 2_000
"""Messages of one stream that were held up come this close after one another."""


def steady(
    rng: np.random.Generator,
    hz: float,
    seconds: float,
    *,
    phase: float = 0.0,
    jitter: float = 0.01,
) -> NDArray[np.int64]:
    """Header stamps of a driver that is triggered by a clock.

    Args:
        rng: Of the stream.
        hz: Rate.
        seconds: The stamps lie in `[0, seconds)`.
        phase: Seconds after the start of the first one.
        jitter: Most that one is late, as a part of the period.

    Returns:
        int64[n], ns since the start, ascending, distinct.
    """
    count = max(0, int(np.ceil((seconds - phase) * hz - 1e-9)))
    number = np.arange(count)
    late = jitter * rng.random(count)
    stamps = np.rint((phase + (number + late) / hz) * 1e9).astype(np.int64)
    return stamps[stamps < round(seconds * 1e9)]


def received(
    rng: np.random.Generator, stamps: NDArray[np.int64], least: float, mean: float
) -> NDArray[np.int64]:
    """Log times: transport takes a little, and now and then something stalls.

    What follows a message that was held up arrives right behind it, as from a socket.

    Args:
        rng: Of the stream.
        stamps: int64[n], ns, ascending.
        least: Least delay, seconds.
        mean: Mean of what comes on top of it, seconds.

    Returns:
        int64[n], ns, ascending, distinct.
    """
    count = len(stamps)
    delay = 1e9 * (least + mean * rng.standard_exponential(count))
    stalled = rng.random(count) < _STALL_PART
    delay += np.where(stalled, rng.uniform(*_STALL_NS, count), 0.0)
    room = _APART_NS * np.arange(count)
    times = stamps + np.rint(delay).astype(np.int64)
    return np.maximum.accumulate(times - room) + room
