"""A pinhole camera in the floor plan, drawn column by column from ray casts."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from benchmarks.loads.simulation.plan import DEPTH, MATERIAL_NAMES, MATERIALS, WALL_HEIGHT, WIDTH
from benchmarks.loads.simulation.sensors import mounted

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from benchmarks.loads.simulation.plan import FloorPlan, Hits
    from benchmarks.loads.simulation.robot import Robot

    Floats = NDArray[np.float64]
    Image = NDArray[np.float32]

HEIGHT = 0.9
"""Metres of every camera above the floor."""

_FLOOR, _CEILING, _SKY, _ASPHALT = range(len(MATERIAL_NAMES), len(MATERIAL_NAMES) + 4)
_PALETTE = np.array(
    [m.bgr for m in MATERIALS.values()]
    + [(104, 112, 118), (226, 230, 230), (244, 226, 200), (84, 84, 84)],
    np.float32,
)
_GREY = np.array([0.114, 0.587, 0.299], np.float32)
_BRICK = MATERIAL_NAMES.index("brick")
_WOOD = MATERIAL_NAMES.index("wood")


def _noise_table() -> NDArray[np.int8]:
    """Gaussian noise of two grey levels, for a random byte each."""
    rng = np.random.default_rng(0xCA3)
    return np.sort(np.clip(np.rint(2.0 * rng.standard_normal(256)), -7, 7)).astype(np.int8)


class Camera:
    """A camera on the robot.

    Args:
        size: Width and height in pixels.
        yaw: Radians from the robot's heading.
        offset: Metres in front of the robot's centre.
        colour: bgr8 when true, else mono8.
    """

    field_of_view = np.radians(72)

    def __init__(self, size: tuple[int, int], yaw: float, offset: float, *, colour: bool) -> None:
        self.width, self.height = size
        self.colour = colour
        self.focal = self.width / 2 / float(np.tan(self.field_of_view / 2))
        """Pixels."""
        self.center = ((self.width - 1) / 2, (self.height - 1) / 2)
        """Column and row of the optical axis."""
        self._yaw, self._offset = yaw, offset
        columns = (self.center[0] - np.arange(self.width)) / self.focal
        self._angle: Floats = np.arctan(columns)
        self._stretch = np.sqrt(1 + columns**2).astype(np.float32)
        # Row r of a plane d metres below the axis is d * focal / r metres away.
        rows = (np.arange(self.height) - self.center[1]).astype(np.float32)[:, None]
        rows = np.where(np.abs(rows) < 0.25, np.float32(0.25), rows)
        self._rows = rows / np.float32(self.focal)
        level = np.where(rows > 0, HEIGHT, WALL_HEIGHT - HEIGHT)
        self._plane = (level / np.abs(self._rows)).astype(np.float32)
        self._noise = _noise_table()

    @property
    def channels(self) -> int:
        """Bytes of a pixel."""
        return 3 if self.colour else 1

    def render(
        self,
        robot: Robot,
        seconds: Floats,
        out: NDArray[np.uint8],
        rng: np.random.Generator,
    ) -> None:
        """Draw what is seen at each moment.

        Args:
            robot: Whose plan and motion.
            seconds: float64[n].
            out: uint8[n, height * width * channels], written to.
            rng: Sensor noise.
        """
        state = robot.at(seconds)
        x, y = mounted(state, self._offset)
        heading = state.heading + self._yaw
        angle = (heading[:, None] + self._angle).ravel()
        rays_x, rays_y = np.repeat(x, self.width), np.repeat(y, self.width)
        plan = robot.plan
        walls = plan.cast(rays_x, rays_y, angle, plan.tall)
        things = plan.cast(rays_x, rays_y, angle, ~plan.tall)
        for number in range(len(seconds)):
            part = slice(number * self.width, (number + 1) * self.width)
            shade, material = self._planes(x[number], y[number], angle[part])
            for hits in (walls, things):
                seen = (hits.surface[part] >= 0) & (hits.distance[part] <= walls.distance[part])
                rays = np.flatnonzero(seen) + part.start
                self._upright(plan, hits, rays, shade, material)
            self._develop(shade, material, out[number], rng)

    def _planes(self, x: float, y: float, angle: Floats) -> tuple[Image, NDArray[np.uint8]]:
        """Floor and ceiling, as if there were no walls."""
        px = np.float32(x) + self._plane * (np.cos(angle).astype(np.float32) * self._stretch)
        py = np.float32(y) + self._plane * (np.sin(angle).astype(np.float32) * self._stretch)
        inside = (px >= 0) & (px <= WIDTH) & (py >= 0) & (py <= DEPTH)
        below = self._rows > 0
        material = np.where(
            below, np.where(inside, _FLOOR, _ASPHALT), np.where(inside, _CEILING, _SKY)
        ).astype(np.uint8)
        fade = np.float32(0.55) + np.float32(0.45) / (1 + self._plane * self._plane / 30)
        joint = (_modulo(px, 0.6) < 0.03) | (_modulo(py, 0.6) < 0.03)
        lamp = (_modulo(px, 3.0) < 0.4) & (_modulo(py, 2.5) < 1.2)
        shade = np.where(below & inside & joint, fade * np.float32(0.7), fade)
        shade = np.where(material == _SKY, np.float32(1.0), shade)
        shade = np.where(~below & inside & lamp, np.float32(1.25), shade * np.float32(0.92))
        return shade, material

    def _upright(
        self,
        plan: FloorPlan,
        hits: Hits,
        rays: NDArray[np.int64],
        shade: Image,
        material: NDArray[np.uint8],
    ) -> None:
        """Draw what stands on the floor over `shade` and `material`, in place.

        `rays` are the rows of `hits` to draw, int64[n], all of one image.
        """
        if not len(rays):
            return
        columns = rays % self.width
        surface, distance = hits.surface[rays], hits.distance[rays]
        depth = (distance * np.cos(self._angle[columns])).astype(np.float32)
        top = plan.height[surface].astype(np.float32)
        z = HEIGHT - self._rows * depth
        mask = (z >= 0) & (z <= top)
        kind = plan.material[surface]
        along = hits.along[rays].astype(np.float32)
        light = 0.4 + 0.6 * hits.cosine[rays]
        light = (light * (0.35 + 0.65 / (1 + (distance / 7) ** 2))).astype(np.float32)
        grain = _texture(kind, along, z, top)
        shade[:, columns] = np.where(mask, light * grain, shade[:, columns])
        material[:, columns] = np.where(mask, kind.astype(np.uint8), material[:, columns])

    def _develop(
        self,
        shade: Image,
        material: NDArray[np.uint8],
        out: NDArray[np.uint8],
        rng: np.random.Generator,
    ) -> None:
        """Colour, noise and eight bits."""
        if self.colour:
            picture = _PALETTE[material] * shade[:, :, None]
        else:
            picture = (_PALETTE @ _GREY)[material] * shade
        flat = picture.ravel()
        flat += self._noise[np.frombuffer(rng.bytes(flat.size), np.uint8)]
        np.clip(flat, 0, 255, out=flat)
        out[:] = flat


def _modulo(values: Image, period: float) -> Image:
    """Like numpy's mod for a positive period, several times faster."""
    turns = values * np.float32(1 / period)
    turns -= np.floor(turns)
    turns *= np.float32(period)
    return turns


def _texture(kind: NDArray[np.int64], along: Image, z: Image, top: Image) -> Image:
    """Brightness of bricks, planks and skirting boards, float32[rows, columns]."""
    grain = np.ones(z.shape, np.float32)
    bricks = kind == _BRICK
    if bricks.any():
        course = np.floor(z[:, bricks] / 0.15)
        joint = _modulo(z[:, bricks], 0.15) < 0.02
        joint |= _modulo(along[bricks] + 0.17 * _modulo(course, 2), 0.34) < 0.02
        grain[:, bricks] = np.where(joint, 1.5, 1.0)
    planks = kind == _WOOD
    if planks.any():
        streaks = 1 + 0.12 * np.sin(along[planks] * 37) * np.cos(along[planks] * 11)
        grain[:, planks] = np.where(_modulo(z[:, planks], 0.5) < 0.025, 0.6, streaks)
    # A dark skirting board where a surface meets the floor, a light rim where it ends.
    grain[z < 0.08] *= np.float32(0.55)
    grain[z > top - 0.03] *= np.float32(0.8)
    return grain
