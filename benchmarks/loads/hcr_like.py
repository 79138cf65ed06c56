"""A load like the recordings of the teleoperation study: few bytes, much to ask.

A user drags the arms of a PR2 about by markers, looks at it from viewpoints that are
changed now and then, and opens and closes the grippers. Topics and types are those that
the study's own launch file records; `docs/benchmarks-method.md` has the sources.

Everything is planned first, so what must be answered about the load is known before a
message is made: a file of answers lies beside it. No viewpoint lies within a millisecond of
the edge of a window, so that a system that keeps milliseconds finds the same.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.loads import made, user
from benchmarks.loads.made import RobotTypes, Values, payloads, yaw
from benchmarks.loads.spool import Spool
from benchmarks.loads.user import ARM_GRID, GRASPS, TICK_NS, Drag, ViewpointPlan, plan_drags
from benchmarks.questions.base import ARM, GRIPPER, VIEWPOINT, Answer

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from benchmarks.loads.base import Load

Times = np.ndarray[Any, np.dtype[np.int64]]

LEFT_GRIPPER = "/l_gripper_controller/command"
LEFT_ARM = "/l_cart/command_pose"
FEEDBACK = "/pr2_marker_control_transparent/feedback"
DIAGNOSTICS = "/diagnostics_agg"
ROSOUT = "/rosout"

_ANSWERS = "answers.json"
_GRIPPER = "pr2_controllers_msgs/msg/Pr2GripperCommand"
START_NS = 1_383_588_000_000_000_000  # 2013-11-04 18:00 UTC
GAP_S = 1200
"""Seconds between two sessions: another user comes."""
_INFO_LEVEL, _WARN_LEVEL = 2, 4
_REST = {ARM: 20, LEFT_ARM: 400}
"""Mean ticks between two drags of an arm."""
_MARKERS = {ARM: "r_gripper_control", LEFT_ARM: "l_gripper_control"}
_POSE_UPDATE, _MOUSE_DOWN, _MOUSE_UP = 1, 4, 5
_REMARKS = (
    (_INFO_LEVEL, "Re-initializing all control markers"),
    (_INFO_LEVEL, "sending gripper command"),
    (_WARN_LEVEL, "waitForTransform r_wrist_roll_link took 0.31 s"),
    (_WARN_LEVEL, "Marker name [r_upper_arm_link] not handled"),
)

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


def hcr_like(directory: Path, *, seed: int, sessions: int, minutes: float) -> Load:
    """Make a load of some sessions, one after the other with a gap, and its answers.

    Args:
        directory: Where it goes; exists.
        seed: Not negative.
        sessions: How many, above 0.
        minutes: Length of each, at least 1.
    """
    types = RobotTypes()
    topics = list(_TYPES)
    channels = [types.channel(topic, *_TYPES[topic]) for topic in topics]
    ticks = round(minutes * 60e9 / TICK_NS)
    plans = []
    spool = Spool(directory)
    for number in range(sessions):
        start = START_NS + number * round((minutes * 60 + GAP_S) * 1e9)
        plan = _plan(seed, number, start, ticks)
        _write(spool, types, topics, plan)
        plans.append(plan)
    load = spool.finish(seed, channels)
    (directory / _ANSWERS).write_text(json.dumps(_answers(plans)))
    return load


def true_answers(load: Load) -> dict[str, Answer]:
    """What must be answered about such a load, by question."""
    found: dict[str, Answer] = json.loads((load.payloads.parent / _ANSWERS).read_text())
    return found


@dataclass(slots=True)
class _Plan:
    """One session: all log times, and what happens."""

    seed: int
    number: int
    start: int
    viewpoint: ViewpointPlan
    drags: Mapping[str, list[Drag]]
    left: NDArray[np.float64]
    times: dict[str, Times] = field(default_factory=dict)

    def rng(self, use: str) -> np.random.Generator:
        """The random numbers of one part of the session."""
        return made.generator(self.seed, self.number, use)

    @property
    def seconds(self) -> float:
        """Its length."""
        return self.viewpoint.ticks * TICK_NS / 1e9

    def at(self, ticks: Any, offset_ms: float) -> Times:
        """Log times so many milliseconds after ticks."""
        return self.start + np.asarray(ticks, np.int64) * TICK_NS + round(offset_ms * 1e6)


def _plan(seed: int, number: int, start: int, ticks: int) -> _Plan:
    """Plan a session; the order of the ways to grasp goes on from session to session."""
    rng = made.generator(seed, number, "user")
    first = number % len(GRASPS)
    plan = _Plan(
        seed,
        number,
        start,
        ViewpointPlan(ticks, rng, GRASPS[first:] + GRASPS[:first]),
        {arm: plan_drags(ticks, rng, rest) for arm, rest in _REST.items()},
        np.resize([0.0, user.OPEN], int(rng.integers(2, 3 + ticks // 1000))),
    )
    times = plan.times
    jitter = rng.uniform(0, 3e6, ticks).astype(np.int64)
    times[VIEWPOINT] = plan.at(np.arange(ticks), 1) + jitter
    times[GRIPPER] = plan.at([c.tick for c in plan.viewpoint.commands], -TICK_NS / 2e6)
    times[LEFT_GRIPPER] = plan.at(np.sort(rng.choice(ticks, len(plan.left), replace=False)), 20)
    feedback = []
    for arm, offset in ((ARM, 11), (LEFT_ARM, 13)):
        moved = _ticks_of(plan.drags[arm], ends=False)
        times[arm] = plan.at(moved, offset) + rng.integers(0, 2_000_000, len(moved))
        feedback.append(plan.at(_ticks_of(plan.drags[arm], ends=True), offset - 4))
    times[FEEDBACK] = np.concatenate(feedback)
    _plan_robot(plan)
    return plan


def _ticks_of(drags: Sequence[Drag], *, ends: bool) -> Times:
    """Ticks of all points of drags, and of the mouse's button before and after each."""
    found = [np.arange(d.tick - ends, d.tick + len(d.points) + ends) for d in drags]
    return np.concatenate([np.empty(0, np.int64), *found])


def _plan_robot(plan: _Plan) -> None:
    """Log times of what the robot says whatever the user does."""
    times, seconds = plan.times, plan.seconds
    rng = plan.rng("robot")
    remarks = np.sort(rng.choice(int(seconds * 1000), int(seconds / 4), replace=False))
    times[ROSOUT] = plan.start + remarks * 1_000_000 + 500_000
    stamps = made.steady(rng, 1.0, seconds - 0.2, phase=0.4)
    times[DIAGNOSTICS] = made.received(rng, plan.start + stamps, 0.004, 0.001)


def _answers(plans: Sequence[_Plan]) -> dict[str, Answer]:
    """What the plans say, added up."""
    behind = np.concatenate([plan.viewpoint.behind() for plan in plans])
    users = [plan.viewpoint for plan in plans]
    return {
        "Q1": sum(command.position == 0.0 for one in users for command in one.commands),
        "Q2": len(behind),
        "Q3": sum(drag.inside for plan in plans for drag in plan.drags[ARM]),
        "Q4": sum(one.wide for one in users),
        "Q2 positions": [float(len(behind)), *(behind.sum(axis=0) / user.GRID).tolist()],
    }


def _write(spool: Spool, types: RobotTypes, topics: Sequence[str], plan: _Plan) -> None:
    """Add the messages of a session."""

    def add(topic: str, times: Times, values: Values, columns: Values) -> None:
        if len(times):
            rows = payloads(types, _TYPES[topic][0], values, columns)
            spool.messages(np.full(len(times), topics.index(topic)), rows, times)

    at = plan.viewpoint.points() / user.GRID
    # It looks at the robot; so it turns when it moves, and only then.
    turned = yaw("orientation", np.arctan2(-at[:, 1], -at[:, 0]))
    add(VIEWPOINT, plan.times[VIEWPOINT], {}, made.xyz("position", *at.T) | turned)
    commands = plan.viewpoint.commands
    right = {name: [getattr(c, name) for c in commands] for name in ("position", "max_effort")}
    add(GRIPPER, plan.times[GRIPPER], {}, right)
    left = {"position": plan.left, "max_effort": np.full(len(plan.left), 100.0)}
    add(LEFT_GRIPPER, plan.times[LEFT_GRIPPER], {}, left)
    _write_arms(add, plan)
    times = plan.times[DIAGNOSTICS]
    warns = plan.rng("warnings").random(len(times)) < 0.05
    columns = _stamped(times, 4_000_000) | {"status.3.level": warns.astype(np.uint8)}
    add(DIAGNOSTICS, times, {"status": _diagnostics(types)}, columns)
    _write_rosout(add, plan)


_Add = Callable[[str, Times, Values, Values], None]


def _write_arms(add: _Add, plan: _Plan) -> None:
    first = 0
    nowhere = np.empty((0, 3), np.int64)
    for arm, drags in plan.drags.items():
        times, points = plan.times[arm], [drag.points for drag in drags]
        where = np.concatenate([nowhere, *points]) / ARM_GRID
        columns = _stamped(times, 2_000_000) | _posed("pose.", where)
        add(arm, times, {"header.frame_id": "base_link"}, columns)
        # The button goes down on the first point and up on the last one.
        held = [np.pad(p, ((1, 1), (0, 0)), mode="edge") for p in points]
        where = np.concatenate([nowhere, *held]) / ARM_GRID
        events = [np.pad(np.full(len(p), _POSE_UPDATE), 1) for p in points]
        for event in events:
            event[0], event[-1] = _MOUSE_DOWN, _MOUSE_UP
        times = plan.times[FEEDBACK][first : first + len(where)]
        first += len(where)
        columns = _stamped(times, 0) | _posed("pose.", where)
        columns["event_type"] = np.concatenate([nowhere[:, 0], *events])
        values = {"header.frame_id": "base_link", "client_id": "/rviz/PR2 control markers"}
        values |= {"marker_name": _MARKERS[arm], "control_name": "move"}
        add(FEEDBACK, times, values, columns)


def _write_rosout(add: _Add, plan: _Plan) -> None:
    times = plan.times[ROSOUT]
    chosen = plan.rng("texts").integers(0, len(_REMARKS), len(times)).tolist()
    columns = {name: [_REMARKS[n][at] for n in chosen] for at, name in enumerate(("level", "msg"))}
    values = {"topics": ["/rosout", *_MARKERS], "name": "/pr2_marker_control"}
    add(ROSOUT, times, values, _stamped(times, 500_000) | columns)


def _stamped(times: Times, before_ns: int) -> Values:
    return {"header.stamp": times - before_ns, "header.seq": np.arange(len(times))}


def _posed(path: str, where: NDArray[np.float64]) -> Values:
    """The hand points away from the shoulder."""
    heading = np.arctan2(where[:, 1] + 0.2, where[:, 0])
    return made.xyz(f"{path}position", *where.T) | yaw(f"{path}orientation", heading)


def _diagnostics(types: RobotTypes) -> list[Any]:
    keys = ("state", "temperature", "last update", "errors since start")
    kind = "diagnostic_msgs/msg/KeyValue"
    pairs = [types.make(kind, {"key": key, "value": "nominal"}) for key in keys]
    parts = ("Cameras", "Computers", "Controllers", "EtherCAT Master", "Joints", "Lasers", "Power")
    about = {"message": "OK", "hardware_id": "pr2", "values": pairs}
    names = [f"/{part}/{number}" for part in parts for number in range(3)]
    kind = "diagnostic_msgs/msg/DiagnosticStatus"
    return [types.make(kind, {"name": name, **about}) for name in names]
