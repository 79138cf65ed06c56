"""The floor plan: what the robot's sensors can hit, and ray casting against it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

WALL_HEIGHT = 2.6
"""Height of the ceiling in metres."""

WIDTH, DEPTH = 14.0, 10.0
"""The building spans x in [0, WIDTH) and y in [0, DEPTH) metres."""

_THICKNESS = 0.12
_FAR = 1e9


class Material(NamedTuple):
    """How a surface looks.

    Attributes:
        reflectivity: Part of the laser's light that comes back at normal incidence.
        sharpness: Exponent of the cosine of incidence: 1 is matt, 10 a mirror.
        bgr: Colour seen by the cameras, 0 to 255 each.
    """

    reflectivity: float
    sharpness: float
    bgr: tuple[int, int, int]


MATERIALS: dict[str, Material] = {
    "plaster": Material(0.80, 1.0, (205, 214, 218)),
    "brick": Material(0.45, 1.2, (72, 88, 158)),
    "wood": Material(0.55, 1.0, (74, 122, 172)),
    "metal": Material(0.90, 3.0, (168, 160, 150)),
    "glass": Material(0.10, 8.0, (196, 188, 148)),
    "cardboard": Material(0.65, 1.0, (110, 158, 196)),
}
MATERIAL_NAMES = tuple(MATERIALS)


@dataclass(frozen=True, slots=True)
class Hits:
    """Where rays ended.

    Attributes:
        distance: float64[n], metres in the plane; infinite without a hit.
        surface: int64[n], row of the plan's surfaces, -1 without a hit.
        cosine: float64[n], cosine of the angle between ray and surface normal, 0 to 1.
        along: float64[n], metres along the surface from its first end.
    """

    distance: Floats
    surface: NDArray[np.int64]
    cosine: Floats
    along: Floats


class FloorPlan:
    """Upright surfaces: straight segments and round pillars.

    Surfaces are numbered, segments first, then pillars.

    Args:
        seed: Moves pillars and boxes a little; walls and doors stay.
    """

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng([seed, 0xF100])
        self._ends: list[tuple[float, float, float, float]] = []
        self._material: list[int] = []
        self._height: list[float] = []
        self._build_walls()
        self._build_furniture(rng)
        pillars = [(8.4, 5.0, 0.28), (10.6, 5.0, 0.28), (8.4, 8.9, 0.22), (12.9, 8.9, 0.22)]
        pillars = [
            (x + float(rng.uniform(-0.15, 0.15)), y + float(rng.uniform(-0.15, 0.15)), r)
            for x, y, r in pillars
        ]
        self.segments: Floats = np.array(self._ends)
        """float64[s, 4]: x and y of both ends, metres."""
        self.pillars: Floats = np.array(pillars)
        """float64[p, 3]: x, y and radius, metres."""
        metal = MATERIAL_NAMES.index("metal")
        self.material: NDArray[np.int64] = np.array(self._material + [metal] * len(pillars))
        """int64[s + p]: row of `MATERIALS`."""
        self.height: Floats = np.array(self._height + [WALL_HEIGHT] * len(pillars))
        """float64[s + p]: metres above the floor."""
        self.reflectivity = np.array([m.reflectivity for m in MATERIALS.values()])[self.material]
        self.sharpness = np.array([m.sharpness for m in MATERIALS.values()])[self.material]
        self.tall: NDArray[np.bool_] = self.height >= WALL_HEIGHT
        """bool[s + p]: surfaces that reach the ceiling."""

    def _box(
        self, corners: Sequence[tuple[float, float]], material: str, height: float = WALL_HEIGHT
    ) -> None:
        for (x0, y0), (x1, y1) in zip(corners, [*corners[1:], corners[0]], strict=True):
            self._ends.append((x0, y0, x1, y1))
            self._material.append(MATERIAL_NAMES.index(material))
            self._height.append(height)

    def _wall(self, x0: float, y0: float, x1: float, y1: float, material: str) -> None:
        """An axis-parallel wall given by its centre line."""
        half = _THICKNESS / 2
        (left, right), (low, high) = sorted((x0, x1)), sorted((y0, y1))
        if left == right:
            left, right = left - half, right + half
        else:
            low, high = low - half, high + half
        self._box([(left, low), (right, low), (right, high), (left, high)], material)

    def _build_walls(self) -> None:
        self._wall(0, 0, WIDTH, 0, "plaster")
        self._wall(0, DEPTH, WIDTH, DEPTH, "brick")
        self._wall(0, 0, 0, DEPTH, "plaster")
        # The gate between y = 4 and 6 stands open: beyond it there is nothing to hit.
        self._wall(WIDTH, 0, WIDTH, 4, "brick")
        self._wall(WIDTH, 6, WIDTH, DEPTH, "brick")
        # Doors of 0.9 m at y = 2.0 and 6.95, a window between them.
        self._wall(6, 0, 6, 2.0, "plaster")
        self._wall(6, 2.9, 6, 3.5, "plaster")
        self._wall(6, 3.5, 6, 4.6, "glass")
        self._wall(6, 4.6, 6, 6.95, "plaster")
        self._wall(6, 7.85, 6, DEPTH, "plaster")
        # A door at x = 2.45.
        self._wall(0, 5, 2.45, 5, "plaster")
        self._wall(3.35, 5, 6, 5, "wood")

    def _build_furniture(self, rng: np.random.Generator) -> None:
        # The two shelves where the gripper works; the path passes close by.
        for left, low, right, high in ((8.4, 1.15, 10.0, 1.65), (3.3, 8.35, 4.7, 8.85)):
            self._box([(left, low), (right, low), (right, high), (left, high)], "wood", 1.5)
        for x, y, size in ((13.1, 1.0, 0.7), (0.9, 0.9, 0.6), (0.8, 9.0, 0.8), (4.9, 4.2, 0.6)):
            dx, dy = rng.uniform(-0.15, 0.15, 2)
            turn = float(rng.uniform(0, np.pi / 2))
            corners = [
                (
                    x + float(dx) + size * 0.7071 * float(np.cos(turn + k * np.pi / 2)),
                    y + float(dy) + size * 0.7071 * float(np.sin(turn + k * np.pi / 2)),
                )
                for k in range(4)
            ]
            self._box(corners, "cardboard", 1.1)

    def cast(
        self,
        x: Floats,
        y: Floats,
        angle: Floats,
        surfaces: NDArray[np.bool_] | None = None,
    ) -> Hits:
        """The nearest surface in each ray's way.

        One pass over all rays a surface: memory is a few arrays of n, whatever the plan.

        Args:
            x: float64[n], where each ray starts, metres.
            y: float64[n].
            angle: float64[n], direction, radians from the x axis, counter-clockwise.
            surfaces: Surfaces that count; all when None.
        """
        dx, dy = np.cos(angle), np.sin(angle)
        best = np.full(len(x), _FAR)
        which = np.full(len(x), -1, np.int64)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            for number, (x0, y0, x1, y1) in enumerate(self.segments):
                if surfaces is not None and not surfaces[number]:
                    continue
                ex, ey = x1 - x0, y1 - y0
                px, py = x0 - x, y0 - y
                scale = 1.0 / (dx * ey - dy * ex)
                distance = (px * ey - py * ex) * scale
                part = (px * dy - py * dx) * scale
                # Parallel rays give NaN or infinity, for which this is false.
                hit = (distance > 0) & (distance < best) & (part >= 0) & (part <= 1)
                best[hit] = distance[hit]
                which[hit] = number
            for number, (cx, cy, radius) in enumerate(self.pillars, len(self.segments)):
                if surfaces is not None and not surfaces[number]:
                    continue
                px, py = cx - x, cy - y
                middle = px * dx + py * dy
                distance = middle - np.sqrt(radius**2 - (px * px + py * py - middle**2))
                hit = (distance > 0) & (distance < best)
                best[hit] = distance[hit]
                which[hit] = number
        return self._hits(x + best * dx, y + best * dy, (dx, dy), best, which)

    def _hits(
        self,
        hx: Floats,
        hy: Floats,
        direction: tuple[Floats, Floats],
        best: Floats,
        which: NDArray[np.int64],
    ) -> Hits:
        straight = (which >= 0) & (which < len(self.segments))
        rounded = which >= len(self.segments)
        cosine, along = np.zeros(len(hx)), np.zeros(len(hx))
        dx, dy = direction
        ends = self.segments[which[straight]]
        ex, ey = ends[:, 2] - ends[:, 0], ends[:, 3] - ends[:, 1]
        length = np.hypot(ex, ey)
        cosine[straight] = np.abs(dx[straight] * ey - dy[straight] * ex) / length
        along[straight] = np.hypot(hx[straight] - ends[:, 0], hy[straight] - ends[:, 1])
        circle = self.pillars[which[rounded] - len(self.segments)]
        nx, ny = hx[rounded] - circle[:, 0], hy[rounded] - circle[:, 1]
        cosine[rounded] = np.abs(nx * dx[rounded] + ny * dy[rounded]) / circle[:, 2]
        along[rounded] = np.arctan2(ny, nx) * circle[:, 2]
        distance = np.where(which >= 0, best, np.inf)
        return Hits(distance, which, np.minimum(cosine, 1.0), along)

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
        """The plan as an occupancy grid, int8[rows, columns]: 100 occupied, 0 free.

        Row 0 is at y = 0; cells are squares of `resolution` metres.
        """
        columns, rows = round(WIDTH / resolution), round(DEPTH / resolution)
        gx, gy = np.meshgrid(
            (np.arange(columns) + 0.5) * resolution, (np.arange(rows) + 0.5) * resolution
        )
        near = self.clearance(gx.ravel(), gy.ravel()) < resolution * 0.75
        return np.where(near, 100, 0).astype(np.int8).reshape(rows, columns)
