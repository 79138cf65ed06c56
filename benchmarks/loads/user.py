"""The plan of a user: the viewpoint, the gripper that is closed meanwhile, and the arms.

Time is counted in ticks of the viewpoint's publisher. A plan is a row of stretches, each
at rest or moving, each wholly on one side of the robot, so that what must be found in it
is known from the stretches.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Point = tuple[int, int, int]

GRID = 64
"""Parts of a metre in which positions are counted: exact in any floating point."""
TICK_NS = 33_000_000
"""The publisher's timer."""
OPEN = 0.088
"""Opening in metres that the gripper is sent to."""

Grasp = Literal["front", "behind", "level", "arriving", "leaving"]
"""Where the viewpoint is as the gripper closes: in front of the robot (x > 0) long before
and after, behind it (x < 0), at x = 0; behind and 0.3 s later in front; in front until
0.3 s before."""
GRASPS: tuple[Grasp, ...] = ("front", "behind", "level", "arriving", "leaving")

HOME: Point = (-2 * GRID, 0, 96)
_LEAD = 24
"""Ticks, 0.8 s, for which the viewpoint stays on its side before and after a closing."""
_NEAR = 9
"""Ticks, 0.3 s: outside of a window of 0.1 s, inside of one of 0.5 s."""
_LEAST_HOLD, _MAX_HOLD = 60, 450
_MAX_EPISODE = 4 * (42 + 60) + 42 + 3 * _LEAD + 2 * _NEAR + 40
"""Ticks of an episode without the time for which the gripper stays closed."""
_HOMEWARD = 80


@dataclass(frozen=True, slots=True)
class Stretch:
    """A part of the plan in which the viewpoint rests or moves.

    Attributes:
        side: 1 when all its points have x > 0, -1 for x < 0, 0 for x == 0.
        points: int64[n, 3], in parts of a metre.
    """

    side: int
    points: NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Command:
    """A command to the gripper.

    Attributes:
        tick: It comes half a tick before this one.
        position: Wanted opening, metres; 0.0 closes it.
        max_effort: Newtons.
    """

    tick: int
    position: float
    max_effort: float


@dataclass(slots=True)
class ViewpointPlan:
    """The viewpoint of a session, tick by tick.

    Args:
        ticks: Length of the session.
        rng: What the user does.
        grasps: How the gripper is closed, in this order, over and over.

    Attributes:
        stretches: In order; they cover all ticks.
        commands: To the right gripper, in order. The last one opens it.
        wide: Closings with a viewpoint in front within 0.5 s.
    """

    ticks: int
    rng: np.random.Generator
    grasps: tuple[Grasp, ...]
    stretches: list[Stretch] = field(default_factory=list)
    commands: list[Command] = field(default_factory=list)
    wide: int = 0
    _done: int = 0
    _here: Point = HOME

    def __post_init__(self) -> None:
        """Make the plan."""
        self._rest(30)
        number = 0
        while self.ticks - self._done - _HOMEWARD - _MAX_EPISODE >= _MAX_HOLD:
            hold = self._number(_LEAST_HOLD, _MAX_HOLD)
            self._episode(self.grasps[number % len(self.grasps)], hold)
            number += 1
        self._move(HOME, self._number(20, 40))
        self._rest(self.ticks - self._done)

    def points(self) -> NDArray[np.int64]:
        """All ticks, int64[ticks, 3], in parts of a metre."""
        return np.concatenate([stretch.points for stretch in self.stretches])

    def behind(self) -> NDArray[np.int64]:
        """The points with x <= 0, int64[n, 3], in order."""
        found = [stretch.points for stretch in self.stretches if stretch.side <= 0]
        return np.concatenate(found)

    def _number(self, least: int, most: int) -> int:
        return int(self.rng.integers(least, most + 1))

    def _somewhere(self, side: int) -> Point:
        x = side * self._number(GRID // 4, 4 * GRID)
        return x, self._number(-3 * GRID, 3 * GRID), self._number(GRID // 2, 3 * GRID)

    def _episode(self, grasp: Grasp, hold: int) -> None:
        """Look round, close the gripper, hold on for some ticks, open it."""
        for _ in range(self._number(1, 4)):
            self._move(self._somewhere(self._number(-1, 1)), self._number(8, 40))
            self._rest(self._number(1, 60))
        side = {"front": 1, "behind": -1, "level": 0, "arriving": -1, "leaving": 1}[grasp]
        self._move(self._somewhere(side), self._number(8, 40))
        self._rest(_LEAD)
        if grasp == "leaving":
            before = self._done
            self._move(self._somewhere(-1), 1)
            self._rest(before + _NEAR - self._done)
        start = self._close(grasp)
        if grasp == "arriving":
            self._rest(_NEAR)
            self._move(self._somewhere(1), self._number(8, 40))
        elif grasp != "leaving" and self.rng.random() < 0.2:
            # An impatient user closes it once more.
            self._rest(_NEAR)
            self._close(grasp)
        self._rest(_LEAD)
        while self._done < start + hold:
            left = start + hold - self._done
            if left > 60:
                self._move(self._somewhere(self._number(-1, 1)), self._number(8, 40))
            self._rest(min(left, self._number(1, 60)) if left <= 60 else self._number(1, 15))
        self.commands.append(Command(self._done, OPEN, 100.0))
        self._rest(2)

    def _close(self, grasp: Grasp) -> int:
        self.commands.append(Command(self._done, 0.0, (50.0, 100.0)[self._number(0, 1)]))
        self.wide += grasp != "behind"
        return self._done

    def _rest(self, ticks: int) -> None:
        points = np.tile(np.array(self._here, np.int64), (ticks, 1))
        self._add(Stretch(int(np.sign(self._here[0])), points))

    def _move(self, to: Point, steps: int) -> None:
        """Move on in a straight line; to another side the first step is a leap."""
        here, side = self._here, int(np.sign(to[0]))
        leaps = int(np.sign(here[0])) != side
        start = (side * GRID // 4, here[1], here[2]) if leaps else here
        part = np.arange(0 if leaps else 1, steps + 1)[:, None] / steps
        line = np.rint(start + part * (np.array(to) - np.array(start))).astype(np.int64)
        # Steps that are shorter than the grid would be a rest.
        before = np.concatenate((np.array([here]), line[:-1]))
        line = line[(line != before).any(axis=1)]
        if len(line):
            self._here = to
            self._add(Stretch(side, line))

    def _add(self, stretch: Stretch) -> None:
        if not len(stretch.points):
            return
        self.stretches.append(stretch)
        self._done += len(stretch.points)


# --- the arms -------------------------------------------------------------------------

ARM_GRID = 256
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
