"""What the laser scanner, the 3D lidar, the IMU and the wheel encoders measure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from benchmarks.loads.simulation.motion import State
    from benchmarks.loads.simulation.plan import FloorPlan, Hits
    from benchmarks.loads.simulation.robot import Robot

    Floats = NDArray[np.float64]
    Singles = NDArray[np.float32]

GRAVITY = 9.80665


@dataclass(frozen=True, slots=True)
class LaserScanner:
    """A planar scanner on the robot's front, turning counter-clockwise.

    Attributes:
        beams: Beams of a scan.
        scan_hz: Scans a second; the field of view takes three quarters of a turn.
    """

    beams: int
    scan_hz: float

    offset = 0.2
    height = 0.3
    angle_min = -0.75 * np.pi
    range_min, range_max = 0.05, 10.0
    range_noise = 0.008
    least_intensity = 40.0

    @property
    def angle_increment(self) -> float:
        """Radians between two beams."""
        return -2 * self.angle_min / (self.beams - 1)

    @property
    def time_increment(self) -> float:
        """Seconds between two beams."""
        return 0.75 / self.scan_hz / self.beams

    def rays(self, robot: Robot, seconds: Floats) -> tuple[Floats, Floats, Floats]:
        """Origin x, y and angle in the plan of each beam, float64[n * beams].

        The robot moves on while the scanner turns: every beam has its own pose.
        """
        number = np.arange(self.beams)
        state = robot.at((seconds[:, None] + number * self.time_increment).ravel())
        angle = np.tile(self.angle_min + number * self.angle_increment, len(seconds))
        x, y = mounted(state, self.offset)
        return x, y, state.heading + angle

    def scan(
        self, robot: Robot, seconds: Floats, rng: np.random.Generator
    ) -> tuple[Singles, Singles]:
        """Ranges in metres (infinite without return) and intensities, float32[n, beams]."""
        hits = robot.plan.cast(*self.rays(robot, seconds))
        light = returned_light(robot.plan, hits)
        light *= 1 + 0.03 * rng.standard_normal(len(light), np.float32)
        distance = hits.distance + self.range_noise * rng.standard_normal(len(light), np.float32)
        gone = (light < self.least_intensity) | (distance > self.range_max)
        gone |= rng.random(len(light), np.float32) < 0.0005
        ranges = np.where(gone, np.inf, np.maximum(distance, self.range_min))
        shape = (len(seconds), self.beams)
        return (
            ranges.astype(np.float32).reshape(shape),
            np.where(gone, 0, light).astype(np.float32).reshape(shape),
        )


@dataclass(frozen=True, slots=True)
class Lidar:
    """A 3D lidar of 16 rings on the robot's mast.

    Attributes:
        columns: Directions round the sensor.
    """

    columns: int

    height = 1.05
    rings = 16

    POINT = np.dtype(
        {
            "names": ["x", "y", "z", "intensity", "ring"],
            "formats": ["<f4", "<f4", "<f4", "<f4", "<u2"],
            "offsets": [0, 4, 8, 12, 16],
            "itemsize": 20,
        }
    )

    def points(self, robot: Robot, seconds: float, rng: np.random.Generator) -> NDArray[np.void]:
        """One turn, `POINT`[rings * columns] in the sensor's frame, metres; NaN: no return."""
        state = robot.at(np.array([seconds]))
        angle = np.linspace(-np.pi, np.pi, self.columns, endpoint=False)
        x, y = (np.repeat(value, self.columns) for value in mounted(state, 0.0))
        plan = robot.plan
        walls = plan.cast(x, y, angle + state.heading, plan.tall)
        things = plan.cast(x, y, angle + state.heading, ~plan.tall)
        slope = np.tan(np.radians(np.linspace(-15, 15, self.rings)))[:, None]
        # A ray that passes over a low thing goes on to the wall behind it.
        over = self.height + slope * things.distance > plan.height[things.surface]
        behind = over | (things.distance > walls.distance)
        distance = np.where(behind, walls.distance, things.distance)
        light = np.where(behind, returned_light(plan, walls), returned_light(plan, things))
        with np.errstate(divide="ignore"):
            ground = np.where(slope < 0, -self.height / slope, np.inf)
        low = ground < distance
        distance = np.where(low, ground, distance)
        light = np.where(low, 900.0 / (1 + 0.05 * distance**2), light)
        gone = ~np.isfinite(distance) | (light < 20)
        distance = np.where(gone, np.nan, distance)
        distance = distance + 0.01 * rng.standard_normal(distance.shape)
        points = np.zeros(distance.shape, self.POINT)
        points["x"] = distance * np.cos(angle)
        points["y"] = distance * np.sin(angle)
        points["z"] = distance * slope
        points["intensity"] = np.where(gone, 0, light / 16)
        points["ring"] = np.arange(self.rings)[:, None]
        return points.ravel()


def mounted(state: State, offset: float) -> tuple[Floats, Floats]:
    """Position in the plan of something `offset` metres in front of the centre."""
    return (
        state.x + offset * np.cos(state.heading),
        state.y + offset * np.sin(state.heading),
    )


def returned_light(plan: FloorPlan, hits: Hits) -> Floats:
    """Intensity of each return, float64[n], about 0 to 4000: surface, angle, distance."""
    light = np.zeros(len(hits.distance))
    hit = hits.surface >= 0
    surface = hits.surface[hit]
    light[hit] = 4000 * plan.reflectivity[surface] * hits.cosine[hit] ** plan.sharpness[surface]
    light[hit] /= 1 + (hits.distance[hit] / 4.0) ** 2
    return light


@dataclass(frozen=True, slots=True)
class Odometry:
    """What the wheel encoders say at n moments, all float64[n], in the odom frame.

    Attributes:
        x: Position, metres from where the robot started.
        y: Position.
        heading: Radians from where it looked at the start.
        speed: Metres a second.
        yaw_rate: Radians a second.
    """

    x: Floats
    y: Floats
    heading: Floats
    speed: Floats
    yaw_rate: Floats


class Odometer:
    """Integrates the wheels: a wrong radius, a wrong track and slip make it drift.

    Moments must come in order; the state is carried from call to call.
    """

    scale_error = 1.006
    turn_error = 0.994

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        first = robot.at(np.zeros(1))
        self._distance, self._truth = float(first.distance[0]), float(first.heading[0])
        self._x = self._y = self._heading = 0.0
        self._key = -1
        self._last: Odometry | None = None

    def at(self, key: int, seconds: Floats, rng: np.random.Generator) -> Odometry:
        """The next moments, or the same again.

        Args:
            key: Names the moments; a repeated key gives the last answer again.
            seconds: float64[n], rising, after those of the call before.
            rng: Slip.
        """
        if self._last is not None and key == self._key:
            return self._last
        state = self._robot.at(seconds)
        driven = np.diff(state.distance, prepend=self._distance)
        turned = np.diff(state.heading, prepend=self._truth)
        driven = driven * (self.scale_error + 0.01 * rng.standard_normal(len(driven)))
        turned = turned * (self.turn_error + 0.01 * rng.standard_normal(len(turned)))
        heading = self._heading + np.cumsum(turned)
        middle = heading - turned / 2
        odometry = Odometry(
            x=self._x + np.cumsum(driven * np.cos(middle)),
            y=self._y + np.cumsum(driven * np.sin(middle)),
            heading=heading,
            speed=state.speed * self.scale_error,
            yaw_rate=state.yaw_rate * self.turn_error,
        )
        if len(seconds):
            self._distance, self._truth = float(state.distance[-1]), float(state.heading[-1])
            self._x, self._y = float(odometry.x[-1]), float(odometry.y[-1])
            self._heading = float(heading[-1])
        self._key, self._last = key, odometry
        return odometry


@dataclass(frozen=True, slots=True)
class Inertial:
    """What the IMU says at n moments: z turn rate and the acceleration, float64[n]."""

    yaw_rate: Floats
    forward: Floats
    left: Floats
    up: Floats

    gyro_noise = 0.002
    acceleration_noise = 0.03

    @classmethod
    def measure(cls, state: State, rng: np.random.Generator) -> Inertial:
        """Turn rate, acceleration along, centripetal acceleration, gravity, and noise."""
        noise = rng.standard_normal((4, len(state.x)))
        return cls(
            yaw_rate=state.yaw_rate + cls.gyro_noise * noise[0],
            forward=state.acceleration + cls.acceleration_noise * noise[1],
            left=state.speed * state.yaw_rate + cls.acceleration_noise * noise[2],
            up=GRAVITY + cls.acceleration_noise * noise[3],
        )
