"""The plan of an arm that a user drags about: where each command sends it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

GRID = 256
"""Parts of a metre in which positions are counted: exact in any floating point."""

_Range = tuple[int, int]
_INSIDE: tuple[_Range, _Range, _Range] = ((129, 255), (-127, 127), (257, 400))
"""Least and most x, y and z of points in the region; a line between two stays in it."""
_OUTSIDE: tuple[tuple[_Range, _Range, _Range], ...] = (
    ((64, 320), (-230, 230), (64, 256)),  # too low
    ((129, 255), (-127, 127), (256, 256)),  # on its lower face, which does not count
    ((129, 255), (128, 230), (257, 400)),  # to the left of it
    ((129, 255), (-230, -128), (257, 400)),  # to the right
    ((64, 128), (-127, 127), (257, 400)),  # before it
    ((256, 320), (-127, 127), (257, 400)),  # beyond it
)


@dataclass(frozen=True, slots=True)
class Drag:
    """The marker is held by the mouse and moved.

    Attributes:
        tick: First one.
        points: int64[n, 3], a tick each, in parts of a metre.
        inside: How many of them lie in the region.
    """

    tick: int
    points: NDArray[np.int64]
    inside: int


def plan_drags(ticks: int, rng: np.random.Generator, rest: int) -> list[Drag]:
    """What is done with an arm in a session.

    Args:
        ticks: Length of the session.
        rng: What the user does.
        rest: Mean ticks between two drags.
    """
    drags: list[Drag] = []
    at = int(rng.integers(10, 40))
    while True:
        pieces = [_piece(rng) for _ in range(int(rng.integers(2, 6)))]
        points = np.concatenate([points for points, _ in pieces])
        if at + len(points) + 2 > ticks:
            return drags
        drags.append(Drag(at, points, sum(inside for _, inside in pieces)))
        at += len(points) + 2 + int(rng.integers(rest // 2, rest * 2))


def _piece(rng: np.random.Generator) -> tuple[NDArray[np.int64], int]:
    """A straight line wholly in or out of the region, and how many points are in it."""
    is_inside = bool(rng.random() < 0.4)
    box = _INSIDE if is_inside else _OUTSIDE[int(rng.integers(len(_OUTSIDE)))]
    least, most = np.array(box, np.int64).T
    start, end = rng.integers(least, most + 1, (2, 3))
    count = int(rng.integers(10, 60))
    part = np.linspace(0, 1, count)[:, None]
    points = np.rint(start + part * (end - start)).astype(np.int64)
    return points, count if is_inside else 0
