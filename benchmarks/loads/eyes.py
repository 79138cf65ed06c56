"""What the sensors of a PR2 see of the simulated building: lasers, stereo and depth images."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, cast

import numpy as np

from benchmarks.loads.simulation.camera import HEIGHT, Camera
from benchmarks.loads.simulation.plan import WALL_HEIGHT
from benchmarks.loads.simulation.sensors import LaserScanner, mounted, returned_light

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from benchmarks.loads.simulation.motion import State
    from benchmarks.loads.simulation.robot import Robot

    Floats = NDArray[np.float64]
    Singles = NDArray[np.float32]

IMAGE_SIZE = (640, 480)
"""Width and height of all images, pixels."""
BASELINE = 0.09
"""Metres between the two cameras of the wide stereo pair."""

_DEPTH_RANGE = (0.5, 9.0)
_DEPTH_NOISE = 0.0012
"""Deviation at one metre; it grows with the square of the distance."""


class BaseLaser(LaserScanner):
    """The scanner at the foot of the robot: 130 degrees to either side, 0.25 degrees apart."""

    offset = 0.275
    height = 0.252
    angle_min = -2.2689
    range_min, range_max = 0.023, 30.0
    least_intensity = 2.0

    @property
    def time_increment(self) -> float:
        """Seconds between two beams: a quarter of a degree of a turn of 25 ms."""
        return 0.025 / 1440


class TiltLaser:
    """The scanner below the head, which is tilted up and down: 47.5 degrees to either side.

    Args:
        beams: Beams of a scan.
    """

    angle_min = -0.829
    range_min, range_max = 0.023, 30.0
    time_increment = 0.025 / 1440

    _offset = 0.1
    _height = 1.1
    _noise = 0.01
    _least_light = 2.0

    def __init__(self, beams: int) -> None:
        self.beams = beams
        self.angle_increment = -2 * self.angle_min / (beams - 1)
        self._angle = np.linspace(self.angle_min, -self.angle_min, beams)

    def scan(
        self, robot: Robot, seconds: Floats, pitch: Floats, rng: np.random.Generator
    ) -> tuple[Singles, Singles]:
        """Ranges in metres (infinite without return) and intensities, float32[n, beams].

        Args:
            robot: Whose plan and motion.
            seconds: float64[n].
            pitch: float64[n], radians by which the scanner looks down.
            rng: Sensor noise.
        """
        state = robot.at(seconds)
        x, y = mounted(state, self._offset)
        # The beam in the robot's frame: forward, left, down.
        forward = np.cos(self._angle) * np.cos(pitch)[:, None]
        left = np.broadcast_to(np.sin(self._angle), forward.shape)
        down = np.cos(self._angle) * np.sin(pitch)[:, None]
        angle = np.arctan2(left, forward) + state.heading[:, None]
        hits = robot.plan.cast(
            np.repeat(x, self.beams), np.repeat(y, self.beams), angle.ravel(), robot.plan.tall
        )
        wall = hits.distance.reshape(forward.shape) / np.hypot(forward, left)
        with np.errstate(divide="ignore"):
            room = np.where(down > 0, self._height, WALL_HEIGHT - self._height)
            level = room / np.abs(down)
        distance = np.minimum(wall, level)
        light = returned_light(robot.plan, hits).reshape(forward.shape)
        light = np.where(level < wall, 900.0 / (1 + (distance / 4) ** 2), light)
        light *= 1 + 0.03 * rng.standard_normal(light.shape)
        distance = distance + self._noise * rng.standard_normal(distance.shape)
        gone = (light < self._least_light) | (distance > self.range_max)
        return (
            np.where(gone, np.inf, np.maximum(distance, self.range_min)).astype(np.float32),
            np.where(gone, 0, light).astype(np.float32),
        )


class StereoCamera:
    """Two grey cameras on the head, side by side."""

    def __init__(self) -> None:
        self.camera = Camera(IMAGE_SIZE, 0.0, 0.1, colour=False)
        """Both are alike."""

    def render(
        self,
        robot: Robot,
        seconds: Floats,
        left: float,
        out: NDArray[np.uint8],
        rng: np.random.Generator,
    ) -> None:
        """Draw what one of both sees.

        Args:
            robot: Whose plan and motion.
            seconds: float64[n].
            left: Metres of the camera to the left of the middle.
            out: uint8[n, height * width], written to.
            rng: Sensor noise.
        """
        self.camera.render(cast("Robot", _Beside(robot, left)), seconds, out, rng)


class DepthCamera:
    """Depth along the optical axis, in millimetres, as a Kinect gives it."""

    def __init__(self) -> None:
        self._camera = Camera(IMAGE_SIZE, 0.0, 0.05, colour=False)
        width, height = IMAGE_SIZE
        columns = (self._camera.center[0] - np.arange(width)) / self._camera.focal
        self._angle = np.arctan(columns)
        rows = (np.arange(height) - self._camera.center[1]) / self._camera.focal
        self._rows = rows.astype(np.float32)[:, None]
        level = np.where(rows > 0, HEIGHT, WALL_HEIGHT - HEIGHT)
        self._plane = (level / np.maximum(np.abs(rows), 1e-4)).astype(np.float32)[:, None]

    def render(
        self, robot: Robot, seconds: Floats, out: NDArray[np.uint8], rng: np.random.Generator
    ) -> None:
        """Measure; what is too near or too far is 0.

        Args:
            robot: Whose plan and motion.
            seconds: float64[n].
            out: uint8[n, 2 * height * width], little-endian uint16, written to.
            rng: Sensor noise.
        """
        state = robot.at(seconds)
        x, y = mounted(state, 0.05)
        width = len(self._angle)
        angle = (state.heading[:, None] + self._angle).ravel()
        starts = np.repeat(x, width), np.repeat(y, width)
        plan = robot.plan
        walls = plan.cast(*starts, angle, plan.tall)
        things = plan.cast(*starts, angle, ~plan.tall)
        straight = np.cos(self._angle)
        top = np.where(things.surface >= 0, plan.height[things.surface], -1.0)
        near, far = _DEPTH_RANGE
        for number in range(len(seconds)):
            part = slice(number * width, (number + 1) * width)
            wall = (walls.distance[part] * straight).astype(np.float32)
            thing = np.minimum(things.distance[part] * straight, 1e6).astype(np.float32)
            depth = np.minimum(wall, self._plane)
            # A thing hides the wall from the floor up to its own top.
            seen = (HEIGHT - self._rows * thing <= top[part]) & (thing < depth)
            depth = np.where(seen, thing, depth)
            noise = rng.standard_normal(depth.shape, np.float32)
            depth += np.float32(_DEPTH_NOISE) * depth * depth * noise
            depth[(depth < near) | (depth > far)] = 0
            out[number] = np.rint(depth * 1000).astype("<u2").view(np.uint8).ravel()


class _Beside:
    """A robot whose middle lies beside that of another one: where a camera is mounted."""

    def __init__(self, robot: Robot, left: float) -> None:
        self.plan = robot.plan
        self._robot = robot
        self._left = left

    def at(self, seconds: Floats) -> State:
        """The motion of the place beside the middle."""
        state = self._robot.at(seconds)
        return replace(
            state,
            x=state.x - self._left * np.sin(state.heading),
            y=state.y + self._left * np.cos(state.heading),
        )
