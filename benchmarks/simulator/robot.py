"""The simulated robot: its motion, an endless lap through the floor plan, and its events."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from benchmarks.simulator.plan import Floats, FloorPlan

MOTOR_WARN, MOTOR_ERROR = 70.0, 80.0
"""Motor temperatures in degrees Celsius that cause a warning and an error."""

_FIRST_DAY_S = 1_748_851_200  # 2025-06-02 08:00 UTC
_STEP_S, _SMOOTHING_S = 0.002, 0.3
_GRIPPER_OPEN, _GRIPPED = 0.08, 0.03  # Metres between the fingers.
_ACCELERATION, _BRAKING, _HARD_BRAKING, _YAW_RATE = 0.6, 0.7, 3.5, 0.9

# Control points of the closed path in metres, in driving order.
_PATH = np.array(
    [
        *((2.9, 3.4), (2.9, 2.2), (4.3, 2.45), (6.0, 2.45), (7.7, 2.25), (9.2, 2.1)),
        *((10.6, 2.1), (12.2, 2.6), (12.2, 5.0), (12.2, 7.3), (10.2, 7.6), (7.7, 7.35)),
        *((6.0, 7.4), (4.3, 7.85), (3.2, 7.85), (2.3, 7.7), (2.9, 6.3), (2.9, 5.0)),
    ]
)
# Kind, a point close by, seconds of standing. `brake` is a sudden stop for an obstacle.
_STOPS = (
    *(("dock", 2.9, 3.4, 2.0), ("pick", 9.2, 2.1, 3.0), ("place", 12.2, 4.6, 2.4)),
    *(("brake", 10.0, 7.6, 1.4), ("pick", 4.0, 7.85, 4.2), ("brake", 2.9, 5.9, 1.2)),
)
_ARRIVALS = {
    "dock": "dock reached, lap finished",
    "pick": "shelf reached, arm takes over",
    "place": "place reached, arm takes over",
    "brake": "obstacle in the safety field: emergency stop",
}


class Stop(NamedTuple):
    """A stop: its kind, and the times, in seconds, at which the robot stops and drives on."""

    kind: str
    start: float
    end: float


class State(NamedTuple):
    """The motion at n times, float64[n] each, in metres, seconds and radians."""

    x: Floats
    y: Floats
    heading: Floats
    distance: Floats
    speed: Floats
    acceleration: Floats
    yaw_rate: Floats

    def ahead(self, offset: float) -> tuple[Floats, Floats]:
        """Position of something mounted `offset` metres in front of the centre."""
        return self.x + offset * np.cos(self.heading), self.y + offset * np.sin(self.heading)


class GripperCommand(NamedTuple):
    """A command: its time, requested opening (0 closes), effort, and the resulting opening."""

    seconds: float
    position: float
    max_effort: float
    reaches: float


class Remark(NamedTuple):
    """A line of the text log: its time, severity, node and text."""

    seconds: float
    severity: str
    node: str
    text: str


class Robot:
    """A differential-drive robot. Times are seconds since the start, at `start_ns`.

    The seed changes the furniture, the speeds, the noise, and the day.
    """

    def __init__(self, duration_s: float, seed: int) -> None:
        self.duration_s, self.seed = float(duration_s), seed
        self.plan = FloorPlan(seed)
        # A day for each seed, so that recordings do not overlap.
        self.start_ns = (_FIRST_DAY_S + seed % 3_000 * 86_400) * 1_000_000_000
        self._path_s, *self._path = _loop()
        self._length = float(self._path_s[-1])
        self._curvature = np.gradient(self._path[2], self._path_s)
        lap = self._drive_lap(np.random.default_rng([seed, 0x1A9]))
        starts = np.arange(int(self.duration_s // self.period) + 1) * self.period
        every = [Stop(s.kind, t + s.start, t + s.end) for t in starts.tolist() for s in lap]
        self.stops = [stop for stop in every if stop.start < self.duration_s]
        self.gripper_commands = self._gripper_commands()
        self.remarks = self._remarks()
        times, openings = [0.0], [_GRIPPER_OPEN]
        for command in self.gripper_commands:
            travel_s = abs(command.reaches - openings[-1]) / 0.1
            times += [command.seconds, command.seconds + max(travel_s, 1e-6)]
            openings += [openings[-1], command.reaches]
        self._fingers = times, openings

    def at(self, seconds: Floats) -> State:
        """The true motion at float64[n] seconds, from 0 on."""
        laps = np.floor(seconds / self.period)
        clock = seconds - laps * self.period
        along, speed, acceleration = (np.interp(clock, self._times, v) for v in self._motion)
        curvature = np.interp(along, self._path_s, self._curvature, period=self._length)
        whole, part = np.divmod(along, self._length)
        x, y, heading = (np.asarray(np.interp(part, self._path_s, v)) for v in self._path)
        heading = heading + (laps + whole) * (self._path[2][-1] - self._path[2][0])
        distance = along + laps * self._length
        return State(x, y, heading, distance, speed, acceleration, curvature * speed)

    def motor_temperature(self, seconds: Floats) -> Floats:
        """Degrees Celsius of the drive motors, float64[n]: hard braking heats them."""
        temperature = 50.0 + 4.0 * self.at(seconds).speed
        for kind, start, _ in self.stops:
            since = seconds - start
            is_hot = (since >= 0) & (kind == "brake")
            temperature += np.where(is_hot, 40.0 * np.exp(-np.maximum(since, 0) / 4.0), 0.0)
        return temperature

    def gripper_opening(self, seconds: Floats) -> Floats:
        """Metres between the fingers, float64[n]."""
        return np.interp(seconds, *self._fingers)

    def _drive_lap(self, rng: np.random.Generator) -> list[Stop]:
        """Drive one lap from dock to dock, as fast as curves, acceleration and stops allow."""
        s, length = self._path_s, self._length
        top = float(rng.uniform(0.82, 0.95))
        limit = np.minimum(top, _YAW_RATE / np.maximum(np.abs(self._curvature), 1e-6)) ** 2
        plans = []
        for kind, x, y, hold in _STOPS:
            nearest = float(s[np.hypot(self._path[0] - x, self._path[1] - y).argmin()])
            plans.append((nearest, kind, hold + float(rng.uniform(0, 0.4))))
        plans.sort()
        # The lap begins exactly where the path does, so that laps join.
        plans[0] = (0.0, "dock", plans[0][2])
        times: list[Floats] = []
        distances: list[Floats] = []
        stops, clock, ahead = [], 0.0, [*plans[1:], (length, "dock", 0.0)]
        for (start, kind, hold), (end, next_kind, _) in zip(plans, ahead, strict=True):
            stops.append(Stop(kind, clock, clock + hold))
            leg = np.concatenate(([start], s[(s > start + 1e-6) & (s < end - 1e-6)], [end]))
            braking = _HARD_BRAKING if next_kind == "brake" else _BRAKING
            squared = np.minimum(np.interp(leg, s, limit), 2 * _ACCELERATION * (leg - start))
            squared = np.minimum(squared, 2 * braking * (end - leg))
            # Curves bind both ways: v^2 changes by at most 2 a per metre.
            squared = _slope_limited(leg, squared, 2 * _ACCELERATION)
            squared = _slope_limited(leg[::-1], squared[::-1], 2 * braking)[::-1]
            speed = np.sqrt(squared)
            spent = np.cumsum(2 * np.diff(leg) / (speed[1:] + speed[:-1]))
            times.append(np.concatenate(([clock, clock + hold], clock + hold + spent)))
            distances.append(np.concatenate(([start], leg)))
            clock = clock + hold + float(spent[-1])
        # A short rest at the end, so that smoothing carries no speed into the next lap.
        self.period = clock + _SMOOTHING_S
        count = round(self.period / _STEP_S)
        self._times = np.arange(count + 1) * (self.period / count)
        times.append(np.array([self.period]))
        distances.append(np.array([length]))
        distance = np.interp(self._times[:-1], np.concatenate(times), np.concatenate(distances))
        # Averaging distance over a short window rounds the corners of the speed. Distance,
        # speed and acceleration remain derivatives of one another.
        window = round(_SMOOTHING_S / _STEP_S) | 1
        padded = np.concatenate((distance[-window:] - length, distance, distance[:window] + length))
        kernel = np.convolve(np.ones(window // 2), np.ones(window // 2))
        smooth = np.convolve(padded, kernel / kernel.sum(), mode="same")
        speed = np.gradient(smooth, self._times[1])
        acceleration = np.gradient(speed, self._times[1])[window:-window]
        smooth, speed = smooth[window:-window], np.maximum(speed[window:-window], 0.0)
        # With the first value of the next lap, interpolation reaches the end.
        ends = (smooth, smooth[0] + length), (speed, speed[0]), (acceleration, acceleration[0])
        self._motion = [np.append(*both) for both in ends]
        return stops

    def _gripper_commands(self) -> list[GripperCommand]:
        commands = []
        for kind, start, end in self.stops:
            if kind == "pick" and end - start > 4.0:
                # The first grip at this shelf slips: it opens and closes again.
                commands.append(GripperCommand(start + 0.8, 0.0, 50.0, 0.0))
                commands.append(GripperCommand(start + 1.9, _GRIPPER_OPEN, -1.0, _GRIPPER_OPEN))
                commands.append(GripperCommand(start + 3.0, 0.0, 75.0, _GRIPPED))
            elif kind == "pick":
                commands.append(GripperCommand(start + 0.8, 0.0, 50.0, _GRIPPED))
            elif kind != "brake":
                commands.append(GripperCommand(start + 0.8, _GRIPPER_OPEN, -1.0, _GRIPPER_OPEN))
        return [c for c in commands if c.seconds < self.duration_s]

    def _remarks(self) -> list[Remark]:
        remarks = [Remark(0.05, "info", "/move_base", "route loaded, leaving the dock")]
        for number, (kind, start, _) in enumerate(self.stops):
            severity = "warn" if kind == "brake" else "info"
            if number:
                remarks.append(Remark(start + 0.2, severity, "/move_base", _ARRIVALS[kind]))
            if kind == "brake":
                text = "drive motor over-temperature"
                remarks.append(Remark(start + 0.5, "error", "/motor_driver", text))
        reached, node = _GRIPPER_OPEN, "/r_gripper_controller"
        for command in self.gripper_commands:
            severity, text = "info", "opening" if command.position else "closing"
            if command.position and reached == 0.0:
                severity, text = "warn", "grip slipped, opening"
            remarks.append(Remark(command.seconds + 0.01, severity, node, f"gripper: {text}"))
            reached = command.reaches
        remarks.sort(key=lambda remark: remark.seconds)
        return [remark for remark in remarks if remark.seconds < self.duration_s]


def _loop() -> tuple[Floats, Floats, Floats, Floats]:
    """Distance, x, y and heading along the closed path: a cubic B-spline from the dock."""
    u = np.linspace(0, 1, 400, endpoint=False)[:, None]
    basis = ((1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, -3 * u**3 + 3 * u**2 + 3 * u + 1, u**3)
    around = [np.roll(_PATH, 1 - k, axis=0)[:, None] * basis[k] for k in range(4)]
    curve = ((((around[0] + around[1]) + around[2]) + around[3]) / 6).reshape(-1, 2)
    closed = np.concatenate((curve, curve[:1]))
    steps = np.diff(closed, axis=0)
    distance = np.concatenate(([0.0], np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))))
    # The heading of each chord belongs to its middle; averaging moves it to the points.
    chord = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    turn = 2 * np.pi * np.round((chord[-1] - chord[0]) / (2 * np.pi))
    before, after = np.append(chord[-1] - turn, chord), np.append(chord, chord[0] + turn)
    return distance, closed[:, 0], closed[:, 1], (before + after) / 2


def _slope_limited(at: Floats, values: Floats, slope: float) -> Floats:
    # The largest function below `values` that rises by at most `slope` a metre.
    ramp = slope * np.abs(at - at[0])
    return np.asarray(np.minimum.accumulate(values - ramp) + ramp)
