"""Finds the messages around times: binary searches in sorted arrays."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from hybridlog_storage.times import BEGIN

if TYPE_CHECKING:
    from numpy.typing import NDArray

How = Literal["asof", "nearest", "interpolate"]
HOWS: tuple[How, ...] = ("asof", "nearest", "interpolate")
UNKNOWN = BEGIN
"""The time of a message that has none on a clock: it matches nothing."""


class Matched(NamedTuple):
    """The messages that belong to some times.

    Attributes:
        before: int64[n], row of the message; -1 where none is near enough.
        after: int64[n], row of the other one; equal to `before` if that decides alone.
        distance: int64[n], time of the message minus the time, ns; of the farther one of two.
            0 where there is none.
    """

    before: NDArray[np.int64]
    after: NDArray[np.int64]
    distance: NDArray[np.int64]


def match(
    times: NDArray[np.int64], rows: NDArray[np.int64], how: How, tolerance: int | None
) -> Matched:
    """The messages that belong to some times.

    `asof` finds the last message not after a time, of equal times the last one. `nearest`
    finds that one or the first one after the time, and the earlier one if both are equally
    near. `interpolate` finds both, and a message of exactly that time alone.

    Args:
        times: int64[n], ns; `UNKNOWN` matches nothing.
        rows: int64[m], times of the messages, ns, ascending.
        how: Which of them.
        tolerance: Greatest distance, ns; None for any.
    """
    if not len(rows):
        nothing = np.full(len(times), -1, np.int64)
        return Matched(nothing, nothing, np.zeros_like(nothing))
    before = np.searchsorted(rows, times, "right").astype(np.int64) - 1
    after = np.minimum(before + 1, len(rows) - 1)
    has_before, has_after = before >= 0, before + 1 < len(rows)
    earlier = rows[np.maximum(before, 0)] - times  # not positive where there is one
    later = rows[after] - times
    found = has_before
    distance = earlier
    if how == "nearest":
        takes_after = has_after & (~has_before | (later < -earlier))
        before = np.where(takes_after, after, before)
        distance = np.where(takes_after, later, earlier)
        found = has_before | has_after
    elif how == "interpolate":
        is_exact = has_before & (earlier == 0)
        found = is_exact | (has_before & has_after)
        distance = np.where(is_exact | (-earlier >= later), earlier, later)
        after = np.where(is_exact, before, after)
    if how != "interpolate":
        after = before
    found = found & (times != UNKNOWN)
    if tolerance is not None:
        found = found & (np.abs(distance) <= tolerance)
    return Matched(
        np.where(found, before, -1), np.where(found, after, -1), np.where(found, distance, 0)
    )
