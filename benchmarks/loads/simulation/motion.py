"""How the robot moves: one lap of a loop through the plan, repeated for ever.

The lap is computed once on a fine grid of time; any later moment is the same lap
with the turns and metres of the laps before it added. Nothing here grows with the
duration of a recording.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

STEP_S = 0.002
"""Grid of the lap in seconds."""

_PATH = (
    (2.9, 3.4),
    (2.9, 2.2),
    (4.3, 2.45),
    (6.0, 2.45),
    (7.7, 2.25),
    (9.2, 2.1),
    (10.6, 2.1),
    (12.2, 2.6),
    (12.2, 5.0),
    (12.2, 7.3),
    (10.2, 7.6),
    (7.7, 7.35),
    (6.0, 7.4),
    (4.3, 7.85),
    (3.2, 7.85),
    (2.3, 7.7),
    (2.9, 6.3),
    (2.9, 5.0),
)
"""Control points of the closed path, metres, in driving order."""

_ACCELERATION = 0.6
_BRAKING = 0.7
_HARD_BRAKING = 3.5
_YAW_RATE = 0.9
_SMOOTHING_S = 0.3

StopKind = Literal["dock", "pick", "place", "brake"]


@dataclass(frozen=True, slots=True)
class Stop:
    """A place on the loop where the robot stands still.

    Attributes:
        kind: What it does there; `brake` is a sudden stop for an obstacle.
        distance: Metres along the lap.
        start: Seconds of lap time when it stands.
        end: Seconds of lap time when it drives on.
    """

    kind: StopKind
    distance: float
    start: float
    end: float


@dataclass(frozen=True, slots=True)
class State:
    """The true motion at n moments, all float64[n], metres, seconds and radians.

    Attributes:
        x: Position in the plan.
        y: Position in the plan.
        heading: Unwrapped over laps.
        distance: Driven since the start.
        speed: Forward.
        acceleration: Forward.
        yaw_rate: Counter-clockwise.
    """

    x: Floats
    y: Floats
    heading: Floats
    distance: Floats
    speed: Floats
    acceleration: Floats
    yaw_rate: Floats


# Where it stops: kind, a point of the plan close by, and how long it stands.
_STOPS: tuple[tuple[StopKind, float, float, float], ...] = (
    ("dock", 2.9, 3.4, 2.0),
    ("pick", 9.2, 2.1, 3.0),
    ("place", 12.2, 4.6, 2.4),
    ("brake", 10.0, 7.6, 1.4),
    ("pick", 4.0, 7.85, 4.2),
    ("brake", 2.9, 5.9, 1.2),
)


class Lap:
    """One lap of the loop: starts at the dock, standing, and ends there.

    Args:
        seed: Changes the top speed and how long the robot stands at each stop.
    """

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng([seed, 0x1A9])
        self._path_s, self._path_x, self._path_y, self._path_heading = _loop()
        self.length = float(self._path_s[-1])
        """Metres of one lap."""
        self.turn = float(self._path_heading[-1] - self._path_heading[0])
        """Radians of one lap: one full turn, counter-clockwise."""
        top = float(rng.uniform(0.82, 0.95))
        plans = [(k, self._nearest(x, y), h + float(rng.uniform(0, 0.4))) for k, x, y, h in _STOPS]
        plans.sort(key=lambda stop: stop[1])
        # The lap begins exactly where the path does, so that laps join.
        plans[0] = ("dock", 0.0, plans[0][2])
        self.stops: tuple[Stop, ...]
        """In driving order; the first is the dock at distance 0."""
        times, distances, self.stops = self._drive(top, plans)
        self.period = float(times[-1])
        """Seconds of one lap."""
        self._grid(times, distances)

    def _nearest(self, x: float, y: float) -> float:
        return float(self._path_s[np.hypot(self._path_x - x, self._path_y - y).argmin()])

    def _drive(
        self, top: float, plans: list[tuple[StopKind, float, float]]
    ) -> tuple[Floats, Floats, tuple[Stop, ...]]:
        """Time over distance: as fast as curves, acceleration and stops allow."""
        s = self._path_s
        curvature = np.abs(np.gradient(self._path_heading, s))
        limit = np.minimum(top, _YAW_RATE / np.maximum(curvature, 1e-6)) ** 2
        times: list[Floats] = []
        distances: list[Floats] = []
        stops: list[Stop] = []
        clock = 0.0
        ahead = [*plans[1:], ("dock", self.length, 0.0)]
        for (kind, start, hold), (next_kind, end, _) in zip(plans, ahead, strict=True):
            stops.append(Stop(kind, start, clock, clock + hold))
            times.append(np.array([clock]))
            distances.append(np.array([start]))
            clock += hold
            inner = s[(s > start + 1e-6) & (s < end - 1e-6)]
            leg = np.concatenate(([start], inner, [end]))
            braking = _HARD_BRAKING if next_kind == "brake" else _BRAKING
            squared = np.minimum(np.interp(leg, s, limit), 2 * _ACCELERATION * (leg - start))
            squared = np.minimum(squared, 2 * braking * (end - leg))
            # Curves bind both ways: v^2 changes by at most 2 a per metre.
            squared = _slope_limited(leg, squared, 2 * _ACCELERATION)
            squared = _slope_limited(leg[::-1], squared[::-1], 2 * braking)[::-1]
            speed = np.sqrt(squared)
            spent = np.cumsum(2 * np.diff(leg) / (speed[1:] + speed[:-1]))
            times.append(np.concatenate(([clock], clock + spent)))
            distances.append(leg)
            clock += float(spent[-1])
        # A little rest at the end, so that smoothing carries no speed into the next lap.
        times.append(np.array([clock + _SMOOTHING_S]))
        distances.append(np.array([self.length]))
        return np.concatenate(times), np.concatenate(distances), tuple(stops)

    def _grid(self, times: Floats, distances: Floats) -> None:
        count = round(self.period / STEP_S)
        self._times = np.arange(count + 1) * (self.period / count)
        distance = np.interp(self._times[:-1], times, distances)
        # Averaging distance over a short window rounds the corners of the speed and
        # keeps distance, speed and acceleration derivatives of one another.
        window = round(_SMOOTHING_S / STEP_S) | 1
        margin = window
        padded = np.concatenate(
            (distance[-margin:] - self.length, distance, distance[:margin] + self.length)
        )
        kernel = np.convolve(np.ones(window // 2), np.ones(window // 2))
        smooth = np.convolve(padded, kernel / kernel.sum(), mode="same")
        step = self._times[1]
        speed = np.gradient(smooth, step)
        acceleration = np.gradient(speed, step)
        self._distance = _closed(smooth[margin:-margin], self.length)
        self._speed = _closed(np.maximum(speed[margin:-margin], 0.0), 0.0)
        self._acceleration = _closed(acceleration[margin:-margin], 0.0)
        self._curvature = np.gradient(self._path_heading, self._path_s)

    def at(self, seconds: Floats) -> State:
        """The true motion at `seconds` since the start, float64[n], from 0 on."""
        laps = np.floor(seconds / self.period)
        clock = seconds - laps * self.period
        along = np.interp(clock, self._times, self._distance)
        speed = np.interp(clock, self._times, self._speed)
        curvature = np.interp(along, self._path_s, self._curvature, period=self.length)
        whole, part = np.divmod(along, self.length)
        heading = np.interp(part, self._path_s, self._path_heading)
        return State(
            x=np.interp(part, self._path_s, self._path_x),
            y=np.interp(part, self._path_s, self._path_y),
            heading=heading + (laps + whole) * self.turn,
            distance=along + laps * self.length,
            speed=speed,
            acceleration=np.interp(clock, self._times, self._acceleration),
            yaw_rate=curvature * speed,
        )


def _loop() -> tuple[Floats, Floats, Floats, Floats]:
    """Distance, x, y and heading along the closed path, which starts at the dock.

    A cubic B-spline: the curvature is continuous, so the yaw rate has no steps.
    """
    points = np.array(_PATH)
    u = np.linspace(0, 1, 400, endpoint=False)[:, None]
    basis = ((1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, -3 * u**3 + 3 * u**2 + 3 * u + 1, u**3)
    pieces = [
        sum((basis[k] * points[(i + k - 1) % len(points)] for k in range(4)), np.zeros((400, 2)))
        / 6
        for i in range(len(points))
    ]
    curve = np.concatenate(pieces)
    closed = np.concatenate((curve, curve[:1]))
    steps = np.diff(closed, axis=0)
    distance = np.concatenate(([0.0], np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))))
    # Heading of each chord belongs to its middle; back to the points by averaging.
    chord = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    turn = 2 * np.pi * np.round((chord[-1] - chord[0]) / (2 * np.pi))
    before = np.concatenate(([chord[-1] - turn], chord))
    after = np.concatenate((chord, [chord[0] + turn]))
    return distance, closed[:, 0], closed[:, 1], (before + after) / 2


def _slope_limited(at: Floats, values: Floats, slope: float) -> Floats:
    """The largest function below `values` that rises by at most `slope` a metre."""
    ramp = slope * np.abs(at - at[0])
    lowest: Floats = np.minimum.accumulate(values - ramp)
    limited: Floats = lowest + ramp
    return limited


def _closed(values: Floats, step: float) -> Floats:
    """Append the first value of the next lap, so that interpolation reaches the end."""
    return np.append(values, values[0] + step)
