"""A load like the recordings of the teleoperation study: few bytes, much to ask.

A user drags the arms of a PR2 about by markers, looks at it from viewpoints that are
changed now and then, and opens and closes the grippers. Topics and types are those that
the study's own launch file records; `docs/benchmarks-loads.md` has the sources.

Everything is planned first, so what must be found in the load is known before a message
is made: `truth.json` beside it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.loads import pr2, viewpoint
from benchmarks.loads.arm import GRID as ARM_GRID
from benchmarks.loads.arm import Drag, plan_drags
from benchmarks.loads.jpegs import Jpegs
from benchmarks.loads.simulation.wire import GRIPPER_COMMAND
from benchmarks.loads.spool import Spool
from benchmarks.loads.timing import received, steady
from benchmarks.loads.truth import BEFORE_ERROR_NS, MINUTE_NS, RobotError, Truth
from benchmarks.loads.viewpoint import GRASPS, TICK_NS, ViewpointPlan
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from benchmarks.loads.base import Load

    Times = NDArray[np.int64]

RIGHT_GRIPPER = "/r_gripper_controller/command"
LEFT_GRIPPER = "/l_gripper_controller/command"
VIEWPOINT = "/rviz_camera_publisher/camera_pose"
RIGHT_ARM = "/r_cart/command_pose"
LEFT_ARM = "/l_cart/command_pose"
FEEDBACK = "/pr2_marker_control_transparent/feedback"
DIAGNOSTICS = "/diagnostics_agg"
ROSOUT = "/rosout"
WEBCAM = "/webcam_node/image_raw/compressed"
KINECT = "/head_mount_kinect/rgb/image_color/compressed"
JOINT_STATES = "/joint_states"
TF = "/tf"

START_NS = 1_383_588_000_000_000_000  # 2013-11-04 18:00 UTC
GAP_S = 1200
"""Seconds between two sessions: another user comes."""
ERROR_LEVEL = 8
"""rosgraph_msgs/Log.ERROR"""

_INFO_LEVEL, _WARN_LEVEL = 2, 4
_CLEAR_NS = 1_500_000
"""No message is nearer to the edge of a window than this."""
_REST = {RIGHT_ARM: 20, LEFT_ARM: 400}
"""Mean ticks between two drags of an arm."""
_MARKERS = {RIGHT_ARM: "r_gripper_control", LEFT_ARM: "l_gripper_control"}
_POSE_UPDATE, _MOUSE_DOWN, _MOUSE_UP = 1, 4, 5
_CAMERA_HZ = 30.0
_ERRORS = (
    "EtherCAT dropped a packet: motors halted",
    "r_wrist_roll_joint: motor over-temperature, motors halted",
    "Lost the connection to l_forearm_cam",
    "Exception while sending pose command: no transform to base_link",
)
_REMARKS = (
    (_INFO_LEVEL, "Re-initializing all control markers"),
    (_INFO_LEVEL, "sending gripper command"),
    (_WARN_LEVEL, "waitForTransform r_wrist_roll_link took 0.31 s"),
    (_WARN_LEVEL, "Marker name [r_upper_arm_link] not handled"),
)

_TYPES = {
    RIGHT_GRIPPER: (GRIPPER_COMMAND, "/pr2_marker_control"),
    LEFT_GRIPPER: (GRIPPER_COMMAND, "/pr2_marker_control"),
    VIEWPOINT: ("geometry_msgs/msg/Pose", "/rviz"),
    RIGHT_ARM: ("geometry_msgs/msg/PoseStamped", "/pr2_marker_control"),
    LEFT_ARM: ("geometry_msgs/msg/PoseStamped", "/pr2_marker_control"),
    FEEDBACK: ("visualization_msgs/msg/InteractiveMarkerFeedback", "/rviz"),
    DIAGNOSTICS: ("diagnostic_msgs/msg/DiagnosticArray", "/diag_agg"),
    ROSOUT: ("rosgraph_msgs/msg/Log", "/rosout"),
    WEBCAM: ("sensor_msgs/msg/CompressedImage", "/webcam_node"),
    KINECT: ("sensor_msgs/msg/CompressedImage", "/head_mount_kinect"),
    JOINT_STATES: ("sensor_msgs/msg/JointState", "/realtime_loop"),
    TF: (pr2.TF_TYPE, "/robot_state_publisher"),
}
"""Type and node of each topic."""
_CAMERAS = (WEBCAM, KINECT)
_STATE = (JOINT_STATES, TF)


def hcr_like(
    directory: Path,
    *,
    seed: int,
    sessions: int = 8,
    minutes: float = 10.0,
    cameras: bool = False,
    state: bool = False,
    name: str = "hcr_like",
) -> Load:
    """Make a load of some sessions, one after the other with a gap, and its truth.

    Args:
        directory: Where it goes; what lies there is replaced.
        seed: Not negative.
        sessions: How many, above 0.
        minutes: Length of each, at least 1.
        cameras: With the two streams of JPEG images that were recorded too. They are
            nothing to the questions and twenty times the bytes.
        state: With joint states and transforms, which the robot publishes and the
            study's launch file does not record.
        name: Of the load.

    Raises:
        UsageError: An argument is out of its range, or the directory cannot be written.
    """
    if sessions < 1 or not minutes >= 1 or seed < 0:
        raise UsageError(
            f"no load of {sessions} sessions of {minutes:g} minutes from seed {seed}; choose at "
            "least 1 session of at least 1 minute, and a seed that is not negative"
        )
    types = pr2.Pr2Types()
    left_out = (() if cameras else _CAMERAS) + (() if state else _STATE)
    topics = [topic for topic in _TYPES if topic not in left_out]
    channels = [types.channel(topic, *_TYPES[topic]) for topic in topics]
    ticks = round(minutes * 60e9 / TICK_NS)
    writer = _Writer(types, topics, Jpegs(seed) if cameras else None)
    plans = []
    with Spool(directory) as spool:
        for number in range(sessions):
            start = START_NS + number * round((minutes * 60 + GAP_S) * 1e9)
            plan = _plan(seed, number, start, ticks, topics)
            writer.write(spool, plan)
            plans.append(plan)
        load = spool.finish(name, seed, channels)
    _truth(plans).save(directory)
    return load


@dataclass(slots=True)
class _Plan:
    """One session: all log times, and what happens.

    Attributes:
        seed: Of the load.
        number: Of the session.
        start: Log time of its begin, ns.
        viewpoint: The user's viewpoint and the right gripper.
        drags: Of each arm.
        left: Openings that the left gripper is sent to.
        times: Log times by topic, ascending but for /tf and the feedback.
        errors: Log times of the system errors.
    """

    seed: int
    number: int
    start: int
    viewpoint: ViewpointPlan
    drags: Mapping[str, list[Drag]]
    left: NDArray[np.float64]
    times: dict[str, Times] = field(default_factory=dict)
    errors: list[int] = field(default_factory=list)

    def rng(self, use: str) -> np.random.Generator:
        """The random numbers of one part of the session."""
        return pr2.generator(self.seed, self.number, use)

    @property
    def seconds(self) -> float:
        """Its length."""
        return self.viewpoint.ticks * TICK_NS / 1e9

    def at(self, ticks: Any, offset_ms: float) -> Times:
        """Log times so many milliseconds after ticks."""
        return self.start + np.asarray(ticks, np.int64) * TICK_NS + round(offset_ms * 1e6)


def _plan(seed: int, number: int, start: int, ticks: int, topics: Sequence[str]) -> _Plan:
    """Plan a session; the order of the ways to grasp goes on from session to session."""
    rng = pr2.generator(seed, number, "user")
    first = number % len(GRASPS)
    plan = _Plan(
        seed,
        number,
        start,
        ViewpointPlan(ticks, rng, GRASPS[first:] + GRASPS[:first]),
        {arm: plan_drags(ticks, rng, rest) for arm, rest in _REST.items()},
        np.resize([0.0, viewpoint.OPEN], int(rng.integers(2, 3 + ticks // 1000))),
    )
    times = plan.times
    jitter = rng.uniform(0, 3e6, ticks).astype(np.int64)
    times[VIEWPOINT] = plan.at(np.arange(ticks), 1) + jitter
    times[RIGHT_GRIPPER] = plan.at([c.tick for c in plan.viewpoint.commands], -TICK_NS / 2e6)
    times[LEFT_GRIPPER] = plan.at(np.sort(rng.choice(ticks, len(plan.left), replace=False)), 20)
    feedback = []
    for arm, offset in ((RIGHT_ARM, 11), (LEFT_ARM, 13)):
        moved = _ticks_of(plan.drags[arm], ends=False)
        times[arm] = plan.at(moved, offset) + rng.integers(0, 2_000_000, len(moved))
        feedback.append(plan.at(_ticks_of(plan.drags[arm], ends=True), offset - 4))
    times[FEEDBACK] = np.concatenate(feedback)
    _plan_robot(plan, topics)
    _plan_errors(plan)
    return plan


def _ticks_of(drags: Sequence[Drag], *, ends: bool) -> Times:
    """Ticks of all points of drags, and of the mouse's button before and after each."""
    found = [np.arange(d.tick - ends, d.tick + len(d.points) + ends) for d in drags]
    return np.concatenate([np.empty(0, np.int64), *found])


def _plan_robot(plan: _Plan, topics: Sequence[str]) -> None:
    """Log times of what the robot says whatever the user does."""
    times, seconds = plan.times, plan.seconds
    rng = plan.rng("robot")

    def regular(hz: float, phase: float, least: float, mean: float) -> Times:
        stamps = plan.start + steady(rng, hz, seconds - 0.2, phase=phase)
        return received(rng, stamps, least, mean)

    times[DIAGNOSTICS] = regular(1.0, 0.4, 0.004, 0.001)
    remarks = np.sort(rng.choice(int(seconds * 1000), int(seconds / 4), replace=False))
    times[ROSOUT] = plan.start + remarks * 1_000_000 + 500_000
    if WEBCAM in topics:
        times[WEBCAM] = regular(_CAMERA_HZ, 0.012, 0.03, 0.002)
        times[KINECT] = regular(_CAMERA_HZ, 0.021, 0.04, 0.003)
    if TF in topics:
        times[JOINT_STATES] = regular(pr2.JOINTS_HZ, 0.003, 0.0006, 0.0002)
        links = regular(pr2.STATE_TF_HZ, 0.005, 0.001, 0.0003)
        pose = regular(pr2.POSE_TF_HZ, 0.009, 0.001, 0.0003)
        times[TF] = np.concatenate(pr2.of_two_sources(links, pose))


def _plan_errors(plan: _Plan) -> None:
    """Choose when the robot fails, away from all messages, and so do the windows' edges."""
    rng = plan.rng("errors")
    length = round(plan.seconds * 1e9)
    times = np.sort(np.concatenate(list(plan.times.values())))
    for _ in range(max(1, round(plan.seconds / 180))):
        near = plan.start + int(rng.uniform(0.15, 0.95) * length)
        for moment in range(near, near + length // 50, 1_000_000):
            others = np.array([edge for e in plan.errors for edge in (e, e - BEFORE_ERROR_NS)])
            edges = (moment, moment - BEFORE_ERROR_NS)
            is_clear = all(_is_clear(times, edge) for edge in edges)
            if is_clear and (np.abs(others - moment) > _CLEAR_NS).all():
                plan.errors.append(moment)
                times = np.insert(times, np.searchsorted(times, moment), moment)
                break
    plan.errors.sort()


def _is_clear(times: Times, edge: int) -> bool:
    """Whether no time is near an edge; `times` ascend."""
    first, last = np.searchsorted(times, (edge - _CLEAR_NS, edge + _CLEAR_NS))
    return bool(first == last)


def _truth(plans: Sequence[_Plan]) -> Truth:
    """Add the plans up."""
    counts: dict[str, int] = {}
    closed: list[tuple[int, int]] = []
    behind = []
    errors: list[RobotError] = []
    before_errors = 0
    for plan in plans:
        for topic, times in plan.times.items():
            counts[topic] = counts.get(topic, 0) + len(times)
        counts[ROSOUT] += len(plan.errors)
        behind.append(plan.viewpoint.behind())
        for ticks in plan.viewpoint.closed:
            begin, end = plan.at(ticks, -TICK_NS / 2e6).tolist()
            closed.append((begin, end))
        times = np.sort(np.concatenate([*plan.times.values(), np.array(plan.errors, np.int64)]))
        windows = [(error - BEFORE_ERROR_NS, error) for error in plan.errors]
        for begin, end in windows:
            errors.append(RobotError(end, _between(times, begin, end)))
        before_errors += sum(_between(times, *window) for window in _joined(windows))
    sums = np.concatenate(behind).sum(axis=0) / viewpoint.GRID
    return Truth(
        sessions=tuple((p.start, p.start + round(p.seconds * 1e9)) for p in plans),
        messages=counts,
        q1=sum(c.position == 0.0 for plan in plans for c in plan.viewpoint.commands),
        q2=sum(len(points) for points in behind),
        q2_sum=(float(sums[0]), float(sums[1]), float(sums[2])),
        q3=sum(drag.inside for plan in plans for drag in plan.drags[RIGHT_ARM]),
        q4_near=sum(plan.viewpoint.near for plan in plans),
        q4_wide=sum(plan.viewpoint.wide for plan in plans),
        viewpoint_changes=sum(plan.viewpoint.changes for plan in plans),
        closed=tuple(closed),
        closed_minutes=tuple(
            begin + minute * MINUTE_NS
            for begin, end in closed
            for minute in range((end - begin) // MINUTE_NS)
        ),
        errors=tuple(errors),
        before_errors=before_errors,
    )


def _between(times: Times, begin: int, end: int) -> int:
    """How many of the ascending times lie in `[begin, end)`."""
    first, last = np.searchsorted(times, (begin, end))
    return int(last - first)


def _joined(windows: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """Windows, ordered by their begin, of which none overlap any more."""
    found: list[tuple[int, int]] = []
    for begin, end in windows:
        if found and begin <= found[-1][1]:
            found[-1] = (found[-1][0], end)
        else:
            found.append((begin, end))
    return found


class _Writer:
    """Makes the messages that a plan wants.

    Args:
        types: Message types.
        topics: In the order of the load's channels.
        jpegs: Images of the cameras; None without cameras.
    """

    def __init__(self, types: pr2.Pr2Types, topics: Sequence[str], jpegs: Jpegs | None) -> None:
        self._types = types
        self._number = {topic: number for number, topic in enumerate(topics)}
        self._jpegs = jpegs
        self._gripper = types.template(GRIPPER_COMMAND, {})
        self._pose = types.template("geometry_msgs/msg/Pose", {})
        self._arm = types.template(
            "geometry_msgs/msg/PoseStamped", {"header": {"frame_id": "base_link"}}
        )
        self._feedback = {
            arm: types.template(
                _TYPES[FEEDBACK][0],
                {
                    "header": {"frame_id": "base_link"},
                    "client_id": "/rviz/PR2 control markers",
                    "marker_name": marker,
                    "control_name": "move",
                },
            )
            for arm, marker in _MARKERS.items()
        }
        self._diagnostics = types.template(_TYPES[DIAGNOSTICS][0], _diagnostics())
        self._joints = pr2.joint_template(types)
        self._links = pr2.links_template(types)
        self._base = pr2.pose_template(types)
        self._steps: tuple[Callable[[Spool, _Plan], None], ...] = (
            self._write_viewpoint,
            self._write_grippers,
            self._write_arms,
            self._write_diagnostics,
            self._write_rosout,
            *((self._write_cameras,) if jpegs is not None else ()),
            *((self._write_state,) if TF in topics else ()),
        )

    def write(self, spool: Spool, plan: _Plan) -> None:
        """Add the messages of a session."""
        for step in self._steps:
            step(spool, plan)

    def _write_viewpoint(self, spool: Spool, plan: _Plan) -> None:
        position = plan.viewpoint.points() / viewpoint.GRID
        # It looks at the robot; so it turns when it moves, and only then.
        heading = np.arctan2(-position[:, 1], -position[:, 0])
        columns = {
            **_axes("position", position),
            "orientation.z": np.sin(heading / 2),
            "orientation.w": np.cos(heading / 2),
        }
        spool.template(self._number[VIEWPOINT], self._pose, columns, plan.times[VIEWPOINT])

    def _write_grippers(self, spool: Spool, plan: _Plan) -> None:
        commands = plan.viewpoint.commands
        right = {
            "position": np.array([command.position for command in commands]),
            "max_effort": np.array([command.max_effort for command in commands]),
        }
        left = {"position": plan.left, "max_effort": np.full(len(plan.left), 100.0)}
        for topic, columns in ((RIGHT_GRIPPER, right), (LEFT_GRIPPER, left)):
            spool.template(self._number[topic], self._gripper, columns, plan.times[topic])

    def _write_arms(self, spool: Spool, plan: _Plan) -> None:
        first = 0
        for arm, drags in plan.drags.items():
            times = plan.times[arm]
            points = [drag.points for drag in drags]
            where = np.concatenate([np.empty((0, 3), np.int64), *points]) / ARM_GRID
            columns = {
                **pr2.stamped(times - 2_000_000),
                **_axes("pose.position", where),
                **_turned("pose.orientation", where),
            }
            spool.template(self._number[arm], self._arm, columns, times)
            # The button goes down on the first point and up on the last one.
            held = [np.pad(p, ((1, 1), (0, 0)), mode="edge") for p in points]
            where = np.concatenate([np.empty((0, 3), np.int64), *held]) / ARM_GRID
            events = [np.pad(np.full(len(p), _POSE_UPDATE), 1) for p in points]
            for event in events:
                event[0], event[-1] = _MOUSE_DOWN, _MOUSE_UP
            times = plan.times[FEEDBACK][first : first + len(where)]
            first += len(where)
            columns = {
                **pr2.stamped(times),
                "event_type": np.concatenate([np.empty(0, np.int64), *events]),
                **_axes("pose.position", where),
                **_turned("pose.orientation", where),
            }
            spool.template(self._number[FEEDBACK], self._feedback[arm], columns, times)

    def _write_diagnostics(self, spool: Spool, plan: _Plan) -> None:
        times = plan.times[DIAGNOSTICS]
        warns = plan.rng("warnings").random(len(times)) < 0.05
        columns = {**pr2.stamped(times - 4_000_000), "status.3.level": warns.astype(np.uint8)}
        spool.template(self._number[DIAGNOSTICS], self._diagnostics, columns, times)

    def _write_rosout(self, spool: Spool, plan: _Plan) -> None:
        rng = plan.rng("texts")
        chosen = rng.integers(0, len(_REMARKS), len(plan.times[ROSOUT]))
        said = [
            (time, *_REMARKS[choice], "/pr2_marker_control")
            for time, choice in zip(plan.times[ROSOUT].tolist(), chosen.tolist(), strict=True)
        ]
        said += [
            (time, ERROR_LEVEL, _ERRORS[int(rng.integers(len(_ERRORS)))], "/realtime_loop")
            for time in plan.errors
        ]
        said.sort()
        payloads = [
            self._types.encode(
                _TYPES[ROSOUT][0],
                {
                    "header": {"seq": number, "stamp": time - 500_000},
                    "level": level,
                    "name": node,
                    "msg": text,
                    "topics": ["/rosout", *_MARKERS],
                },
            )
            for number, (time, level, text, node) in enumerate(said)
        ]
        times = np.array([time for time, *_ in said], np.int64)
        spool.messages(np.full(len(said), self._number[ROSOUT], np.int32), payloads, times)

    def _write_cameras(self, spool: Spool, plan: _Plan) -> None:
        assert self._jpegs is not None
        for topic, frame in ((WEBCAM, "webcam"), (KINECT, "head_mount_kinect_rgb_optical_frame")):
            times = plan.times[topic]
            for picture, rows in self._jpegs.shown(len(times)):
                template = self._types.template(
                    _TYPES[topic][0],
                    {"header": {"frame_id": frame}, "format": "jpeg", "data": picture},
                )
                columns = {"header.stamp": times[rows] - 30_000_000, "header.seq": rows}
                spool.template(self._number[topic], template, columns, times[rows])

    def _write_state(self, spool: Spool, plan: _Plan) -> None:
        rng = plan.rng("state")
        times = plan.times[JOINT_STATES]
        seconds = (times - plan.start) / 1e9
        still = np.zeros(len(times))
        columns = {
            **pr2.stamped(times - 600_000),
            **pr2.joint_columns(rng, seconds, still, pr2.tilt(seconds)),
        }
        spool.template(self._number[JOINT_STATES], self._joints, columns, times)
        for is_pose in (False, True):
            # The two publishers tell themselves apart by odd and even nanoseconds.
            times = plan.times[TF][plan.times[TF] % 2 == is_pose]
            still = np.zeros(len(times))
            if is_pose:
                columns = pr2.pose_columns(times - 1_000_000, still, still, still)
            else:
                columns = pr2.links_columns(rng, times - 1_000_000, [still])
            template = self._base if is_pose else self._links
            spool.template(self._number[TF], template, columns, times)


def _axes(prefix: str, values: NDArray[np.float64]) -> dict[str, NDArray[Any]]:
    """Columns of float64[n, 3]."""
    return {f"{prefix}.{axis}": values[:, number] for number, axis in enumerate("xyz")}


def _turned(prefix: str, where: NDArray[np.float64]) -> dict[str, NDArray[Any]]:
    """The hand points away from the shoulder."""
    heading = np.arctan2(where[:, 1] + 0.2, where[:, 0])
    return {f"{prefix}.z": np.sin(heading / 2), f"{prefix}.w": np.cos(heading / 2)}


def _diagnostics() -> dict[str, object]:
    parts = ("Cameras", "Computers", "Controllers", "EtherCAT Master", "Joints", "Lasers", "Power")
    keys = ("state", "temperature", "last update", "errors since start")
    return {
        "status": [
            {
                "name": f"/{part}/{number}",
                "message": "OK",
                "hardware_id": "pr2",
                "values": [{"key": key, "value": "nominal"} for key in keys],
            }
            for part in parts
            for number in range(3)
        ]
    }
