"""The simulated robot: where it is, what it does, and what must be found in its log."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from benchmarks.loads.simulation.motion import Lap
from benchmarks.loads.simulation.plan import FloorPlan
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from benchmarks.loads.simulation.motion import State, Stop, StopKind

    Floats = NDArray[np.float64]

MAX_DURATION_S = 7 * 86_400.0
WHEEL_RADIUS = 0.1
"""Metres."""
TRACK = 0.42
"""Metres between the wheels."""
GRIPPER_OPEN = 0.08
"""Opening in metres that the gripper is sent to when it lets go."""
MOTOR_WARN, MOTOR_ERROR = 70.0, 80.0
"""Motor temperatures in degrees Celsius from which diagnostics complain."""
DIAGNOSTICS_PHASE_S = 0.4
"""Diagnostics come once a second, this long after the full second."""

_OBJECT_WIDTH = 0.03
_GRIPPER_SPEED = 0.1
_HEAT_OF_BRAKING = 40.0
_COOLING_S = 4.0
_FIRST_DAY_S = 1_748_851_200  # 2025-06-02 08:00 UTC


@dataclass(frozen=True, slots=True)
class GripperCommand:
    """One command to the gripper.

    Attributes:
        seconds: When, since the start.
        position: Wanted opening in metres; 0 closes it.
        max_effort: Newtons; -1 for no limit.
        reaches: Opening in metres where the fingers come to rest.
    """

    seconds: float
    position: float
    max_effort: float
    reaches: float


@dataclass(frozen=True, slots=True)
class Remark:
    """A line of the robot's text log.

    Attributes:
        seconds: When, since the start.
        severity: How bad.
        node: Who says it.
        text: What.
    """

    seconds: float
    severity: Literal["info", "warn", "error"]
    node: str
    text: str


class Robot:
    """A differential-drive robot on its loop through the plan.

    The same duration and seed give the same robot. Times are seconds since the start.

    Args:
        duration_s: Seconds of simulated time, above 0, up to a week.
        seed: Not negative. Changes the furniture, the speeds, the noise, and the day.

    Raises:
        UsageError: An argument is out of its range.
    """

    def __init__(self, duration_s: float, seed: int) -> None:
        if not 0 < duration_s <= MAX_DURATION_S:
            raise UsageError(
                f"a robot cannot drive for {duration_s} s; choose a duration above 0 s"
                f" and up to {MAX_DURATION_S:.0f} s"
            )
        if seed < 0:
            raise UsageError(f"seed is {seed}; it must not be negative")
        self.duration_s = float(duration_s)
        self.seed = seed
        self.plan = FloorPlan(seed)
        self.lap = Lap(seed)
        # A day for each seed, so that several recordings do not lie over each other.
        self.start_ns = (_FIRST_DAY_S + seed % 3_000 * 86_400) * 1_000_000_000
        """Log time at which the recording starts, nanoseconds since the epoch."""
        self.stops: tuple[tuple[float, Stop], ...] = tuple(self._visits())
        """Start of each stop within the duration, seconds, in order."""
        self.gripper_commands = tuple(self._gripper_commands())
        """Commands within the duration, in order."""
        self.remarks = tuple(self._remarks())
        """Lines of the text log within the duration, in order."""
        self._braked: Floats = np.array([t for t, stop in self.stops if stop.kind == "brake"])
        self._finger_times, self._finger_opening = self._fingers()

    def at(self, seconds: Floats) -> State:
        """The true motion at float64[n] seconds."""
        return self.lap.at(seconds)

    @property
    def gripper_closings(self) -> tuple[float, ...]:
        """Seconds of each command that closes the gripper."""
        return tuple(c.seconds for c in self.gripper_commands if c.position == 0.0)

    @property
    def hard_brakings(self) -> tuple[float, ...]:
        """Seconds of each sudden stop."""
        return tuple(float(t) for t in self._braked)

    @property
    def error_times(self) -> tuple[float, ...]:
        """Seconds of each diagnostics message with an error in it."""
        seconds = np.arange(DIAGNOSTICS_PHASE_S, self.duration_s, 1.0)
        return tuple(float(t) for t in seconds[self.motor_temperature(seconds) >= MOTOR_ERROR])

    @property
    def min_clearance(self) -> float:
        """Metres between the robot's centre and the nearest surface, at its smallest."""
        seconds = np.arange(0.0, min(self.duration_s, self.lap.period), 0.02)
        state = self.at(seconds)
        return float(self.plan.clearance(state.x, state.y).min())

    def motor_temperature(self, seconds: Floats) -> Floats:
        """Degrees Celsius of the drive motors, float64[n]: hard braking heats them."""
        temperature = 50.0 + 4.0 * self.at(seconds).speed
        if len(seconds) and len(self._braked):
            recent = self._braked[self._braked > seconds.min() - 20 * _COOLING_S]
            for braked in recent[recent <= seconds.max()]:
                since = seconds - braked
                heat = _HEAT_OF_BRAKING * np.exp(-np.maximum(since, 0) / _COOLING_S)
                temperature += np.where(since >= 0, heat, 0.0)
        return temperature

    def gripper_opening(self, seconds: Floats) -> Floats:
        """Metres between the fingers, float64[n]."""
        return np.interp(seconds, self._finger_times, self._finger_opening)

    def arm_moves(self, seconds: Floats) -> Floats:
        """Part of the arm's movement done, float64[n]; NaN when the arm is still."""
        part = np.full(len(seconds), np.nan)
        for start, stop in self.stops:
            if stop.kind in {"pick", "place"}:
                length = stop.end - stop.start - 0.7
                here = (seconds - start - 0.4) / length
                inside = (here >= 0) & (here <= 1)
                part[inside] = here[inside]
        return part

    def _visits(self) -> list[tuple[float, Stop]]:
        laps = int(self.duration_s // self.lap.period) + 1
        starts = [
            (lap * self.lap.period + stop.start, stop)
            for lap in range(laps)
            for stop in self.lap.stops
        ]
        return [(start, stop) for start, stop in starts if start < self.duration_s]

    def _gripper_commands(self) -> list[GripperCommand]:
        commands = []
        for start, stop in self.stops:
            if stop.kind == "pick" and stop.end - stop.start > 4.0:
                # The first grip at this shelf slips: it opens and closes again.
                commands.append(GripperCommand(start + 0.8, 0.0, 50.0, 0.0))
                commands.append(GripperCommand(start + 1.9, GRIPPER_OPEN, -1.0, GRIPPER_OPEN))
                commands.append(GripperCommand(start + 3.0, 0.0, 75.0, _OBJECT_WIDTH))
            elif stop.kind == "pick":
                commands.append(GripperCommand(start + 0.8, 0.0, 50.0, _OBJECT_WIDTH))
            elif stop.kind in {"place", "dock"}:
                commands.append(GripperCommand(start + 0.8, GRIPPER_OPEN, -1.0, GRIPPER_OPEN))
        return [c for c in commands if c.seconds < self.duration_s]

    def _fingers(self) -> tuple[Floats, Floats]:
        times, openings = [0.0], [GRIPPER_OPEN]
        for command in self.gripper_commands:
            now = openings[-1]
            travel = abs(command.reaches - now) / _GRIPPER_SPEED
            times += [command.seconds, command.seconds + max(travel, 1e-6)]
            openings += [now, command.reaches]
        return np.array(times), np.array(openings)

    def _remarks(self) -> list[Remark]:
        remarks = [Remark(0.05, "info", "/move_base", "route loaded, leaving the dock")]
        texts: dict[StopKind, str] = {
            "dock": "dock reached, lap finished",
            "pick": "shelf reached, arm takes over",
            "place": "place reached, arm takes over",
            "brake": "obstacle in the safety field: emergency stop",
        }
        for number, (start, stop) in enumerate(self.stops):
            severity: Literal["info", "warn"] = "warn" if stop.kind == "brake" else "info"
            if number:
                remarks.append(Remark(start + 0.2, severity, "/move_base", texts[stop.kind]))
            if stop.kind == "brake":
                remarks.append(
                    Remark(start + 0.5, "error", "/motor_driver", "drive motor over-temperature")
                )
        for before, command in zip(
            (None, *self.gripper_commands), self.gripper_commands, strict=False
        ):
            slipped = command.position > 0 and before is not None and before.reaches == 0.0
            text = "grip slipped, opening" if slipped else "opening"
            if command.position == 0.0:
                text = "closing"
            remarks.append(
                Remark(
                    command.seconds + 0.01,
                    "warn" if slipped else "info",
                    "/r_gripper_controller",
                    f"gripper: {text}",
                )
            )
        remarks.sort(key=lambda remark: remark.seconds)
        return [remark for remark in remarks if remark.seconds < self.duration_s]
