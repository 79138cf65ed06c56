"""The robot's sensors: laser scanner, 3D lidar, camera, wheel encoders, inertial unit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchmarks.simulator.plan import DEPTH, WALL_HEIGHT, WIDTH, Floats
from benchmarks.simulator.robot import Robot, State

Singles = NDArray[np.float32]

GRAVITY = 9.80665
GYRO_NOISE, ACCELERATION_NOISE = 0.002, 0.03
LASER_OFFSET, LASER_HEIGHT, LIDAR_HEIGHT, CAMERA_HEIGHT = 0.2, 0.3, 1.05, 0.9
"""Distance in front of the robot's centre, and height above the floor, metres."""
SCAN_HZ = 20.0
SCAN_ANGLE_MIN, SCAN_RANGE_MIN, SCAN_RANGE_MAX, SCAN_NOISE = -0.75 * np.pi, 0.05, 10.0, 0.008
"""Angle in radians, and range in metres."""
RINGS = 16
POINT = np.dtype([*((name, "<f4") for name in ("x", "y", "z", "intensity")), ("ring", "<u4")])
"""A point of the lidar."""

# Blue, green, red of asphalt, floor, sky, ceiling, walls and furniture.
_GROUND, _ABOVE = ((84, 84, 84), (104, 112, 118)), ((244, 226, 200), (226, 230, 230))
_PALETTE = np.array([*_GROUND, *_ABOVE, (200, 208, 212), (74, 122, 172)], np.float32)
_GREY = np.array([0.114, 0.587, 0.299], np.float32)


def scan_steps(beams: int) -> tuple[float, float]:
    """Radians and seconds between two beams of a scan, which covers three quarters of a turn."""
    return -2 * SCAN_ANGLE_MIN / (beams - 1), 0.75 / SCAN_HZ / beams


def scan(
    robot: Robot, seconds: Floats, beams: int, rng: np.random.Generator
) -> tuple[Singles, Singles]:
    """Ranges in metres (infinite without return) and intensities, float32[n, beams]."""
    number, (angle_step, time_step) = np.arange(beams), scan_steps(beams)
    # The robot moves while the scanner turns: every beam has its own pose.
    state = robot.at((seconds[:, None] + number * time_step).ravel())
    angle = np.tile(SCAN_ANGLE_MIN + number * angle_step, len(seconds))
    hits = robot.plan.cast(*state.ahead(LASER_OFFSET), state.heading + angle)
    light = 2800 * hits.cosine / (1 + (hits.distance / 4.0) ** 2)
    light *= 1 + 0.03 * rng.standard_normal(len(light), np.float32)
    distance = hits.distance + SCAN_NOISE * rng.standard_normal(len(light), np.float32)
    gone = (light < 40.0) | (distance > SCAN_RANGE_MAX)
    gone |= rng.random(len(light), np.float32) < 0.0005
    ranges = np.where(gone, np.inf, np.maximum(distance, SCAN_RANGE_MIN)).astype(np.float32)
    intensities = np.where(gone, 0, light).astype(np.float32)
    return ranges.reshape(-1, beams), intensities.reshape(-1, beams)


def cloud(robot: Robot, seconds: float, columns: int, rng: np.random.Generator) -> NDArray[np.void]:
    """A turn of a lidar that sees walls and floor: `POINT`[rings * columns], NaN for none."""
    state, plan = robot.at(np.array([seconds])), robot.plan
    angle = np.linspace(-np.pi, np.pi, columns, endpoint=False)
    origin = np.repeat(state.x, columns), np.repeat(state.y, columns)
    walls = plan.cast(*origin, angle + state.heading, plan.tall)
    slope = np.tan(np.radians(np.linspace(-15, 15, RINGS)))[:, None]
    distance = np.minimum(walls.distance, np.where(slope < 0, -LIDAR_HEIGHT / slope, np.inf))
    distance[np.isinf(distance)] = np.nan
    distance += 0.01 * rng.standard_normal(distance.shape)
    points = np.zeros(distance.shape, POINT)
    points["x"], points["y"] = distance * np.cos(angle), distance * np.sin(angle)
    points["z"], points["ring"] = distance * slope, np.arange(RINGS)[:, None]
    points["intensity"] = np.nan_to_num(175 / (1 + (distance / 4.0) ** 2))
    return points.ravel()


class Camera:
    """A pinhole camera, `focal` pixels long, with its axis at `center`; bgr8, else mono8."""

    def __init__(self, size: tuple[int, int], yaw: float, offset: float, *, colour: bool) -> None:
        (self.width, self.height), self.channels = size, 3 if colour else 1
        self.focal = self.width / 2 / float(np.tan(np.radians(72) / 2))
        self.center = ((self.width - 1) / 2, (self.height - 1) / 2)
        self._yaw, self._offset = yaw, offset
        self._angle: Floats = np.arctan((self.center[0] - np.arange(self.width)) / self.focal)
        # Downward slope of each row's rays; none is exactly level.
        rows = np.arange(self.height)[:, None] - self.center[1] + 0.01
        self._slope = (rows / self.focal).astype(np.float32)
        level = np.where(rows > 0, CAMERA_HEIGHT, WALL_HEIGHT - CAMERA_HEIGHT).astype(np.float32)
        self._away = level / np.abs(self._slope)

    def render(self, robot: Robot, seconds: float, rng: np.random.Generator) -> NDArray[np.uint8]:
        """The picture at a time, uint8[height * width * channels]."""
        state, plan = robot.at(np.array([seconds])), robot.plan
        angle = state.heading + self._yaw + self._angle
        x, y = state.ahead(self._offset)
        # Floor and ceiling, without walls.
        stretch = 1 / np.cos(self._angle)
        px = x.astype(np.float32) + self._away * (np.cos(angle) * stretch).astype(np.float32)
        py = y.astype(np.float32) + self._away * (np.sin(angle) * stretch).astype(np.float32)
        inside = (px >= 0) & (px <= WIDTH) & (py >= 0) & (py <= DEPTH)
        material = inside + np.uint8(2) * (self._slope < 0)
        shade = np.repeat(0.55 + 0.45 / (1 + self._away**2 / 30), self.width, axis=1)
        rays = np.repeat(x, self.width), np.repeat(y, self.width), angle
        walls, things = plan.cast(*rays, plan.tall), plan.cast(*rays, ~plan.tall)
        for number, hits in enumerate((walls, things), 4):
            columns = np.flatnonzero((hits.surface >= 0) & (hits.distance <= walls.distance))
            distance = hits.distance[columns]
            light = 0.4 + 0.6 * hits.cosine[columns]
            light = (light * (0.35 + 0.65 / (1 + (distance / 7) ** 2))).astype(np.float32)
            depth = (distance * np.cos(self._angle[columns])).astype(np.float32)
            z = CAMERA_HEIGHT - self._slope * depth
            drawn = (z >= 0) & (z <= plan.height[hits.surface[columns]])
            # A dark skirting board where a surface meets the floor.
            light = light * np.where(z < 0.08, np.float32(0.55), np.float32(1))
            shade[:, columns] = np.where(drawn, light, shade[:, columns])
            material[:, columns] = np.where(drawn, np.uint8(number), material[:, columns])
        palette = _PALETTE if self.channels == 3 else (_PALETTE @ _GREY)[:, None]
        flat = np.asarray(palette.take(material, axis=0) * shade[:, :, None], np.float32).ravel()
        flat += 2.0 * rng.standard_normal(flat.size, np.float32)
        return np.asarray(np.clip(flat, 0, 255).astype(np.uint8))


class Odometer:
    """Wheel encoders that drift because of a wrong radius, a wrong track and slip."""

    def __init__(self, robot: Robot) -> None:
        self._robot, self._before = robot, robot.at(np.zeros(1))
        self._pose = (0.0, 0.0, 0.0)

    def measure(self, seconds: Floats, rng: np.random.Generator) -> State:
        """Motion in the odom frame at ascending times, later than those of the last call."""
        truth, before = self._robot.at(seconds), self._before
        driven = np.diff(truth.distance, prepend=before.distance[-1])
        turned = np.diff(truth.heading, prepend=before.heading[-1])
        driven = driven * (1.006 + 0.01 * rng.standard_normal(len(driven)))
        turned = turned * (0.994 + 0.01 * rng.standard_normal(len(turned)))
        x, y, heading = self._pose
        headings = heading + np.cumsum(turned)
        xs = x + np.cumsum(driven * np.cos(headings - turned / 2))
        ys = y + np.cumsum(driven * np.sin(headings - turned / 2))
        self._before, self._pose = truth, (xs[-1], ys[-1], headings[-1])
        speed, yaw_rate = truth.speed * 1.006, truth.yaw_rate * 0.994
        return truth._replace(x=xs, y=ys, heading=headings, speed=speed, yaw_rate=yaw_rate)


def inertial(state: State, rng: np.random.Generator) -> tuple[Floats, Floats, Floats, Floats]:
    """Turn rate about z, and acceleration forward, left and up, float64[n] each."""
    noise = rng.standard_normal((4, len(state.x)))
    return (
        state.yaw_rate + GYRO_NOISE * noise[0],
        state.acceleration + ACCELERATION_NOISE * noise[1],
        state.speed * state.yaw_rate + ACCELERATION_NOISE * noise[2],
        GRAVITY + ACCELERATION_NOISE * noise[3],
    )
