"""The floor plan: walls, furniture and pillars, and ray casting against them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

WIDTH, DEPTH, WALL_HEIGHT = 14.0, 10.0, 2.6
"""Size of the building in x and y, and height of its ceiling, metres."""

# Left, low, right, high of walls 0.12 m thick. A gate at x = 14 and three doorways are open.
_WALLS = (
    *((0, -0.06, 14, 0.06), (0, 9.94, 14, 10.06), (-0.06, 0, 0.06, 10)),
    *((13.94, 0, 14.06, 4), (13.94, 6, 14.06, 10), (5.94, 0, 6.06, 2.0), (5.94, 2.9, 6.06, 3.5)),
    *((5.94, 3.5, 6.06, 4.6), (5.94, 4.6, 6.06, 6.95), (5.94, 7.85, 6.06, 10)),
    *((0, 4.94, 2.45, 5.06), (3.35, 4.94, 6, 5.06)),
)
_SHELVES = ((8.4, 1.15, 10.0, 1.65), (3.3, 8.35, 4.7, 8.85))
_BOXES = ((13.1, 1.0, 0.7), (0.9, 0.9, 0.6), (0.8, 9.0, 0.8), (4.9, 4.2, 0.6))
_PILLARS = ((8.4, 5.0, 0.28), (10.6, 5.0, 0.28), (8.4, 8.9, 0.22), (12.9, 8.9, 0.22))


class Hits(NamedTuple):
    """Ends of n rays: metres (infinite without a hit), row of the surface, cosine of incidence."""

    distance: Floats
    surface: NDArray[np.int64]
    cosine: Floats


class FloorPlan:
    """Vertical surfaces: float64[s, 4] straight `segments` and float64[p, 3] round `pillars`.

    The seed moves pillars and boxes slightly; the walls are fixed.
    """

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng([seed, 0xF100])
        outlines = [[(a, b), (c, b), (c, d), (a, d)] for a, b, c, d in (*_WALLS, *_SHELVES)]
        for x, y, size in _BOXES:
            dx, dy = rng.uniform(-0.15, 0.15, 2)
            turn = rng.uniform(0, np.pi / 2) + np.arange(4) * np.pi / 2
            corners = x + dx + size * 0.7071 * np.cos(turn), y + dy + size * 0.7071 * np.sin(turn)
            outlines.append(list(zip(*(c.tolist() for c in corners), strict=True)))
        ends = [(*corners[k], *corners[(k + 1) % 4]) for corners in outlines for k in range(4)]
        self.segments: Floats = np.array(ends)
        pillars = [(*np.add(at, rng.uniform(-0.15, 0.15, 2)), radius) for *at, radius in _PILLARS]
        self.pillars: Floats = np.array(pillars)
        low, walls = [1.5] * len(_SHELVES) + [1.1] * len(_BOXES), [WALL_HEIGHT] * len(_WALLS)
        self.height: Floats = np.append(np.repeat(walls + low, 4), [WALL_HEIGHT] * len(_PILLARS))
        self.tall: NDArray[np.bool_] = self.height >= WALL_HEIGHT

    def cast(
        self, x: Floats, y: Floats, angle: Floats, surfaces: NDArray[np.bool_] | None = None
    ) -> Hits:
        """The nearest surface, of all or some, that rays hit: metres and radians."""
        dx, dy = np.cos(angle), np.sin(angle)
        best, which, cosine = np.full(len(x), np.inf), np.full(len(x), -1), np.zeros(len(x))
        counted = range(len(self.height)) if surfaces is None else np.flatnonzero(surfaces)
        # Parallel rays give NaN or infinity, for which every comparison is false.
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            for number in counted:
                if number < len(self.segments):
                    x0, y0, x1, y1 = self.segments[number]
                    ex, ey, px, py = x1 - x0, y1 - y0, x0 - x, y0 - y
                    across = dx * ey - dy * ex
                    scale = 1.0 / across
                    distance, part = (px * ey - py * ex) * scale, (px * dy - py * dx) * scale
                    hit = (distance > 0) & (distance < best) & (part >= 0) & (part <= 1)
                    facing = np.abs(across) / np.hypot(ex, ey)
                else:
                    cx, cy, radius = self.pillars[number - len(self.segments)]
                    px, py = cx - x, cy - y
                    middle = px * dx + py * dy
                    half = np.sqrt(radius**2 - (px * px + py * py - middle**2))
                    distance, facing = middle - half, half / radius
                    hit = (distance > 0) & (distance < best)
                best[hit], which[hit], cosine[hit] = distance[hit], number, facing[hit]
        return Hits(best, which, np.minimum(cosine, 1.0))

    def clearance(self, x: Floats, y: Floats) -> Floats:
        """Distance from each point to the nearest surface, metres, float64[n]."""
        nearest = np.full(len(x), np.inf)
        for x0, y0, x1, y1 in self.segments:
            ex, ey = x1 - x0, y1 - y0
            part = np.clip(((x - x0) * ex + (y - y0) * ey) / (ex * ex + ey * ey), 0, 1)
            nearest = np.minimum(nearest, np.hypot(x - x0 - part * ex, y - y0 - part * ey))
        for cx, cy, radius in self.pillars:
            nearest = np.minimum(nearest, np.hypot(x - cx, y - cy) - radius)
        return nearest

    def occupancy(self, resolution: float) -> NDArray[np.int8]:
        """Occupancy grid, int8[rows, columns] from y = 0 up: 100 occupied, 0 free."""
        columns, rows = (np.arange(round(m / resolution)) + 0.5 for m in (WIDTH, DEPTH))
        gx, gy = np.meshgrid(columns * resolution, rows * resolution)
        near = self.clearance(gx.ravel(), gy.ravel()) < resolution * 0.75
        return np.where(near, 100, 0).astype(np.int8).reshape(gx.shape)
