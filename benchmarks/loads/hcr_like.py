"""A load like the recordings of the teleoperation study: few bytes, much to ask.

A user drags the arms of a PR2 about by markers, looks at it from viewpoints that are
changed now and then, and opens and closes the grippers. Topics and types are those that
the study's own launch file records; `docs/benchmarks-method.md` has the sources.

What must be answered is worked out from the plan of the sessions, and lies beside the load.
Positions are multiples of 1/64 m and 1/256 m, exact in any floating point. No viewpoint lies
within a millisecond of the edge of a window, so that a system that keeps milliseconds finds
the same: closings come half a tick before a viewpoint's.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.backends.base import ARM, GRIPPER, HALF_NS, VIEWPOINT
from benchmarks.loads.base import Spool
from benchmarks.loads.robot import RobotTypes
from benchmarks.simulator.topics import Values, xyz, yaw

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from benchmarks.loads.base import Load

    Times = NDArray[np.int64]
    Points = NDArray[np.float64]

Answer = int | list[float]
"""A number, or a number and what else tells one answer from another."""

LEFT_GRIPPER = "/l_gripper_controller/command"
LEFT_ARM = "/l_cart/command_pose"
FEEDBACK = "/pr2_marker_control_transparent/feedback"
DIAGNOSTICS = "/diagnostics_agg"
ROSOUT = "/rosout"
_GRIPPER = "pr2_controllers_msgs/msg/Pr2GripperCommand"
_TYPES = {
    GRIPPER: (_GRIPPER, "/pr2_marker_control"),
    LEFT_GRIPPER: (_GRIPPER, "/pr2_marker_control"),
    VIEWPOINT: ("geometry_msgs/msg/Pose", "/rviz"),
    ARM: ("geometry_msgs/msg/PoseStamped", "/pr2_marker_control"),
    LEFT_ARM: ("geometry_msgs/msg/PoseStamped", "/pr2_marker_control"),
    FEEDBACK: ("visualization_msgs/msg/InteractiveMarkerFeedback", "/rviz"),
    DIAGNOSTICS: ("diagnostic_msgs/msg/DiagnosticArray", "/diag_agg"),
    ROSOUT: ("rosgraph_msgs/msg/Log", "/rosout"),
}
"""Type and node of each topic."""

_ANSWERS = "answers.json"
_START_NS = 1_383_588_000_000_000_000  # 2013-11-04 18:00 UTC
_GAP_S = 1200  # between two sessions: another user comes
_TICK_NS = 33_000_000  # the timer of the viewpoint's publisher
_OPEN = 0.088  # metres that the gripper is sent to
_GRID, _ARM_GRID = 64, 256  # parts of a metre in which positions are counted
_REST = {ARM: 20, LEFT_ARM: 400}  # mean ticks between two drags of an arm
_MARKERS = {ARM: "r_gripper_control", LEFT_ARM: "l_gripper_control"}
_INSIDE = ((129, -127, 257), (256, 128, 401))  # least, and more than the most, of the region
_AROUND = ((64, -230, 64), (321, 231, 401))
_POSE_UPDATE, _MOUSE_DOWN, _MOUSE_UP = 1, 4, 5
_INFO, _WARN = 2, 4
_REMARKS = (
    (_INFO, "Re-initializing all control markers"),
    (_INFO, "sending gripper command"),
    (_WARN, "waitForTransform r_wrist_roll_link took 0.31 s"),
    (_WARN, "Marker name [r_upper_arm_link] not handled"),
)


def hcr_like(directory: Path, *, seed: int, sessions: int, minutes: float) -> Load:
    """Make a load of some sessions, one after the other with a gap, and its answers."""
    types, spool = RobotTypes(), Spool(directory)
    answers: Counter[str] = Counter()
    positions = np.zeros(4)
    for number in range(sessions):
        start = _START_NS + number * round((minutes * 60 + _GAP_S) * 1e9)
        rng = np.random.default_rng([seed, number])
        one = _Session(types, spool, start, round(minutes * 60e9 / _TICK_NS), rng)
        one.write()
        answers.update(one.answers)
        positions += one.positions
    load = spool.finish(seed, [types.channel(topic, *_TYPES[topic]) for topic in _TYPES])
    found: dict[str, Answer] = {**answers, "Q2 positions": positions.tolist()}
    (directory / _ANSWERS).write_text(json.dumps(found))
    return load


def true_answers(load: Load) -> dict[str, Answer]:
    """What must be answered about such a load, by question."""
    found: dict[str, Answer] = json.loads((load.payloads.parent / _ANSWERS).read_text())
    return found


class _Session:
    """One session of a user."""

    def __init__(
        self, types: RobotTypes, spool: Spool, start: int, ticks: int, rng: np.random.Generator
    ) -> None:
        self.answers: dict[str, int] = {}
        self.positions = np.zeros(4)
        self._types, self._spool, self._start = types, spool, start
        self._ticks, self._rng = ticks, rng

    def write(self) -> None:
        """Make the messages, and count what is asked about them."""
        in_front = self._write_viewpoint()
        closed = self._write_grippers()
        near = np.searchsorted(in_front, closed + HALF_NS) > np.searchsorted(
            in_front, closed - HALF_NS, "right"
        )
        self.answers |= {"Q1": len(closed), "Q4": int(near.sum())}
        for arm in _REST:
            self._write_arm(arm)
        self._write_robot()

    def _number(self, least: int, most: int) -> int:
        return int(self._rng.integers(least, most + 1))

    def _at(self, ticks: Any, offset_ms: float) -> Times:
        """Log times so many milliseconds after ticks."""
        found: Times = self._start + np.asarray(ticks, np.int64) * _TICK_NS + round(offset_ms * 1e6)
        return found

    def _add(self, topic: str, times: Times, values: Values, columns: Values) -> None:
        kind, number = _TYPES[topic][0], [*_TYPES].index(topic)
        filled = self._types.filled(self._types.make(kind, values), columns, len(times))
        payloads = (self._types.encode(message, kind) for message in filled)
        self._spool.messages(np.full(len(times), number, np.int32), payloads, times)

    def _write_viewpoint(self) -> Times:
        """A viewpoint a tick, which rests or moves; returns the times of those in front."""
        knots, points = [0], [(-2 * _GRID, 0, 96)]
        while knots[-1] < self._ticks:
            knots.append(knots[-1] + self._number(1, 60))
            points.append(points[-1])
            side = self._number(-1, 1)  # in front of the robot, behind it, or at x = 0
            x = side * self._number(_GRID // 4, 4 * _GRID)
            y, z = self._number(-3 * _GRID, 3 * _GRID), self._number(_GRID // 2, 3 * _GRID)
            knots.append(knots[-1] + self._number(8, 40))
            points.append((x, y, z))
        at = _line(knots, points, np.arange(self._ticks)) / _GRID
        times = self._at(np.arange(self._ticks), 1) + self._rng.integers(0, 3_000_000, self._ticks)
        # It looks at the robot; so it turns when it moves, and only then.
        turned = yaw("orientation", np.arctan2(-at[:, 1], -at[:, 0]))
        self._add(VIEWPOINT, times, {}, xyz("position", *at.T) | turned)
        behind = at[at[:, 0] <= 0]
        self.answers["Q2"] = len(behind)
        self.positions = np.array([len(behind), *behind.sum(axis=0)])
        return times[at[:, 0] >= 0]

    def _write_grippers(self) -> Times:
        """Both grippers; returns when the right one was closed."""
        commands: list[tuple[int, float, float]] = []
        tick = self._number(60, 240)
        while tick + 460 < self._ticks:
            presses = 1 + (self._rng.random() < 0.1)  # an impatient user
            commands += [
                (tick + 9 * n, 0.0, (50.0, 100.0)[self._number(0, 1)]) for n in range(presses)
            ]
            tick += self._number(60, 450)
            commands.append((tick, _OPEN, 100.0))
            tick += self._number(60, 300)
        ticks, *columns = zip(*commands, strict=True)
        times = self._at(ticks, -_TICK_NS / 2e6)
        about = dict(zip(("position", "max_effort"), columns, strict=True))
        self._add(GRIPPER, times, {}, about)
        count = self._number(2, 2 + self._ticks // 1000)
        left = self._at(np.sort(self._rng.choice(self._ticks, count, replace=False)), 20)
        about = {"position": np.resize([0.0, _OPEN], count), "max_effort": np.full(count, 100.0)}
        self._add(LEFT_GRIPPER, left, {}, about)
        return times[np.array(columns[0]) == 0]

    def _write_arm(self, arm: str) -> None:
        """The marker of an arm is held by the mouse and moved, over and over."""
        moved, held = [], []
        tick = self._number(10, 40)
        while True:
            count = self._number(2, 5)
            knots = np.cumsum([0, *self._rng.integers(10, 60, count)])
            if tick + knots[-1] + 2 > self._ticks:
                break
            box = _INSIDE if self._rng.random() < 0.4 else _AROUND
            ticks = np.arange(knots[-1] + 1)
            points = _line(knots, self._rng.integers(*box, (count + 1, 3)), ticks)
            moved.append(np.column_stack((tick + ticks, points)))
            # The button goes down on the first point and up on the last one.
            events = np.pad(np.full(len(ticks), _POSE_UPDATE), 1)
            events[0], events[-1] = _MOUSE_DOWN, _MOUSE_UP
            around = np.pad(points, ((1, 1), (0, 0)), mode="edge")
            held.append(np.column_stack((tick - 1 + np.arange(len(events)), around, events)))
            tick += len(events) + self._number(_REST[arm] // 2, _REST[arm] * 2)
        offset = 11 if arm == ARM else 13
        rows = np.concatenate(moved)
        times = self._at(rows[:, 0], offset) + self._rng.integers(0, 2_000_000, len(rows))
        columns = _stamped(times, 2_000_000) | _posed(rows[:, 1:] / _ARM_GRID)
        self._add(arm, times, {"header.frame_id": "base_link"}, columns)
        if arm == ARM:
            low, high = np.array(_INSIDE)
            within = (rows[:, 1:] >= low) & (rows[:, 1:] < high)
            self.answers["Q3"] = int(within.all(axis=1).sum())
        rows = np.concatenate(held)
        times = self._at(rows[:, 0], offset - 4)
        columns = _stamped(times, 0) | _posed(rows[:, 1:4] / _ARM_GRID)
        columns["event_type"] = rows[:, 4].astype(np.uint8)
        values = {"header.frame_id": "base_link", "client_id": "/rviz/PR2 control markers"}
        values |= {"marker_name": _MARKERS[arm], "control_name": "move"}
        self._add(FEEDBACK, times, values, columns)

    def _write_robot(self) -> None:
        """What the robot says whatever the user does."""
        seconds = self._ticks * _TICK_NS // 10**9
        times = (
            self._start
            + np.arange(seconds) * 10**9
            + self._rng.integers(4 * 10**8, 41 * 10**7, seconds)
        )
        warns = (self._rng.random(seconds) < 0.05).astype(np.uint8)
        columns = _stamped(times, 4_000_000) | {"status.3.level": warns}
        self._add(DIAGNOSTICS, times, {"status": _diagnostics(self._types)}, columns)
        moments = np.sort(self._rng.choice(seconds * 1000, seconds // 4, replace=False))
        times = self._start + moments * 1_000_000 + 500_000
        chosen = [_REMARKS[n] for n in self._rng.integers(0, len(_REMARKS), len(times)).tolist()]
        columns = dict(zip(("level", "msg"), zip(*chosen, strict=True), strict=True))
        values = {"topics": ["/rosout", *_MARKERS], "name": "/pr2_marker_control"}
        self._add(ROSOUT, times, values, _stamped(times, 500_000) | columns)


def _line(knots: Any, points: Any, ticks: Any) -> Points:
    """Straight lines from knot to knot, in whole parts of a metre; float64[n, 3]."""
    axes = [np.interp(ticks, knots, axis) for axis in np.array(points, np.float64).T]
    found: Points = np.rint(np.stack(axes, axis=1))
    return found


def _stamped(times: Times, before_ns: int) -> Values:
    return {"header.stamp": times - before_ns, "header.seq": np.arange(len(times))}


def _posed(where: Points) -> Values:
    """The hand points away from the shoulder."""
    heading = np.arctan2(where[:, 1] + 0.2, where[:, 0])
    return xyz("pose.position", *where.T) | yaw("pose.orientation", heading)


def _diagnostics(types: RobotTypes) -> Sequence[Any]:
    keys = ("state", "temperature", "last update", "errors since start")
    kind = "diagnostic_msgs/msg/KeyValue"
    pairs = [types.make(kind, {"key": key, "value": "nominal"}) for key in keys]
    parts = ("Cameras", "Computers", "Controllers", "EtherCAT Master", "Joints", "Lasers", "Power")
    about = {"message": "OK", "hardware_id": "pr2", "values": pairs}
    names = [f"/{part}/{number}" for part in parts for number in range(3)]
    kind = "diagnostic_msgs/msg/DiagnosticStatus"
    return [types.make(kind, {"name": name, **about}) for name in names]
