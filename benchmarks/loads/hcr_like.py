"""A load like the recordings of the teleoperation study: few bytes, much to ask.

A user drags the arms of a PR2 about by markers, looks at it from viewpoints that are
changed now and then, and opens and closes the grippers. Topics and types are those that
the study's own launch file records; `docs/benchmarks-method.md` has the sources.

Everything is planned first, so what must be found in the load is known before a message
is made: `truth.json` beside it.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.loads import made, user
from benchmarks.loads import mit_like as pr2
from benchmarks.loads.made import OldTypes, Values, payloads, scene, yaw
from benchmarks.loads.spool import Spool
from benchmarks.loads.truth import BEFORE_ERROR_NS, MINUTE_NS, NAME, RobotError, Truth
from benchmarks.loads.user import ARM_GRID, GRASPS, TICK_NS, Drag, ViewpointPlan, plan_drags
from hybridlog_storage.errors import MissingDependencyError, UsageError

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from benchmarks.loads.base import Load

Times = np.ndarray[Any, np.dtype[np.int64]]

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

_GRIPPER = "pr2_controllers_msgs/msg/Pr2GripperCommand"
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
_REGULAR = {
    DIAGNOSTICS: (1.0, 0.4, 0.004, 0.001),
    WEBCAM: (30.0, 0.012, 0.03, 0.002),
    KINECT: (30.0, 0.021, 0.04, 0.003),
    JOINT_STATES: (100.0, 0.003, 0.0006, 0.0002),
    TF: (50.0, 0.005, 0.001, 0.0003),
    "pose": (30.0, 0.009, 0.001, 0.0003),
}
"""Rate, phase, and least and mean delay of what the robot says by itself."""
_PICTURES = 16
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
    RIGHT_GRIPPER: (_GRIPPER, "/pr2_marker_control"),
    LEFT_GRIPPER: (_GRIPPER, "/pr2_marker_control"),
    VIEWPOINT: ("geometry_msgs/msg/Pose", "/rviz"),
    RIGHT_ARM: ("geometry_msgs/msg/PoseStamped", "/pr2_marker_control"),
    LEFT_ARM: ("geometry_msgs/msg/PoseStamped", "/pr2_marker_control"),
    FEEDBACK: ("visualization_msgs/msg/InteractiveMarkerFeedback", "/rviz"),
    DIAGNOSTICS: ("diagnostic_msgs/msg/DiagnosticArray", "/diag_agg"),
    ROSOUT: ("rosgraph_msgs/msg/Log", "/rosout"),
    WEBCAM: ("sensor_msgs/msg/CompressedImage", "/webcam_node"),
    KINECT: ("sensor_msgs/msg/CompressedImage", "/head_mount_kinect"),
    JOINT_STATES: ("sensor_msgs/msg/JointState", "/realtime_loop"),
    TF: (made.TF_TYPE, "/robot_state_publisher"),
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
    """
    if sessions < 1 or not minutes >= 1 or seed < 0:
        raise UsageError(
            f"no load of {sessions} sessions of {minutes:g} minutes from seed {seed}; choose at "
            "least 1 session of at least 1 minute, and a seed that is not negative"
        )
    types = OldTypes()
    left_out = (() if cameras else _CAMERAS) + (() if state else _STATE)
    topics = [topic for topic in _TYPES if topic not in left_out]
    channels = [types.channel(topic, *_TYPES[topic]) for topic in topics]
    ticks = round(minutes * 60e9 / TICK_NS)
    pictures = _jpegs(seed) if cameras else []
    plans = []
    with Spool(directory) as spool:
        for number in range(sessions):
            start = START_NS + number * round((minutes * 60 + GAP_S) * 1e9)
            plan = _plan(seed, number, start, ticks, topics)
            _write(spool, types, topics, plan, pictures)
            plans.append(plan)
        load = spool.finish(name, seed, channels)
    _truth(plans).save(directory)
    return load


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
    errors: list[int] = field(default_factory=list)

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


def _plan(seed: int, number: int, start: int, ticks: int, topics: Sequence[str]) -> _Plan:
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

    def regular(topic: str) -> Times:
        hz, phase, least, mean = _REGULAR[topic]
        stamps = plan.start + made.steady(rng, hz, seconds - 0.2, phase=phase)
        return made.received(rng, stamps, least, mean)

    remarks = np.sort(rng.choice(int(seconds * 1000), int(seconds / 4), replace=False))
    times[ROSOUT] = plan.start + remarks * 1_000_000 + 500_000
    for topic in (DIAGNOSTICS, WEBCAM, KINECT, JOINT_STATES):
        if topic in topics:
            times[topic] = regular(topic)
    if TF in topics:
        times[TF] = np.concatenate(made.of_two_sources(regular(TF), regular("pose")))


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
    sums = np.concatenate(behind).sum(axis=0) / user.GRID
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


def _write(
    spool: Spool,
    types: OldTypes,
    topics: Sequence[str],
    plan: _Plan,
    pictures: Sequence[NDArray[np.uint8]],
) -> None:
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
    add(RIGHT_GRIPPER, plan.times[RIGHT_GRIPPER], {}, right)
    left = {"position": plan.left, "max_effort": np.full(len(plan.left), 100.0)}
    add(LEFT_GRIPPER, plan.times[LEFT_GRIPPER], {}, left)
    _write_arms(add, plan)
    times = plan.times[DIAGNOSTICS]
    warns = plan.rng("warnings").random(len(times)) < 0.05
    columns = _stamped(times, 4_000_000) | {"status.3.level": warns.astype(np.uint8)}
    add(DIAGNOSTICS, times, {"status": _diagnostics(types)}, columns)
    _write_rosout(add, plan)
    for topic, frame in ((WEBCAM, "webcam"), (KINECT, "head_mount_kinect_rgb_optical_frame")):
        if topic in topics:
            times = plan.times[topic]
            # A short drive, shown forwards and backwards for ever.
            turn = np.arange(len(times)) % (2 * _PICTURES - 2)
            shown = np.minimum(turn, 2 * _PICTURES - 2 - turn)
            columns = _stamped(times, 30_000_000) | {"data": [pictures[n] for n in shown]}
            add(topic, times, {"header.frame_id": frame, "format": "jpeg"}, columns)
    if TF in topics:
        # The two publishers of /tf tell themselves apart by odd and even nanoseconds.
        tf = plan.times[TF]
        of = ((pr2.JOINT_TOPIC, plan.times[JOINT_STATES]), (pr2.LINKS_TOPIC, tf[tf % 2 == 0]))
        for row, log_times in (*of, (pr2.BASE_TOPIC, tf[tf % 2 == 1])):
            since = log_times - plan.start
            both = (since - 600_000, since)
            made.write(
                spool, topics.index(row.name), types, row, (plan.start, *both), seed=plan.seed
            )


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
    rng = plan.rng("texts")
    chosen = rng.integers(0, len(_REMARKS), len(plan.times[ROSOUT]))
    said: list[tuple[int, int, str, str]] = [
        (time, *_REMARKS[choice], "/pr2_marker_control")
        for time, choice in zip(plan.times[ROSOUT].tolist(), chosen.tolist(), strict=True)
    ]
    said += [
        (time, ERROR_LEVEL, _ERRORS[int(rng.integers(len(_ERRORS)))], "/realtime_loop")
        for time in plan.errors
    ]
    said.sort()
    times = np.array([time for time, *_ in said], np.int64)
    names = ("level", "msg", "name")
    columns = {name: [line[n] for line in said] for n, name in enumerate(names, 1)}
    add(ROSOUT, times, {"topics": ["/rosout", *_MARKERS]}, _stamped(times, 500_000) | columns)


def _stamped(times: Times, before_ns: int) -> Values:
    return {"header.stamp": times - before_ns, "header.seq": np.arange(len(times))}


def _posed(path: str, where: NDArray[np.float64]) -> Values:
    """The hand points away from the shoulder."""
    heading = np.arctan2(where[:, 1] + 0.2, where[:, 0])
    return made.xyz(f"{path}position", *where.T) | yaw(f"{path}orientation", heading)


def _diagnostics(types: OldTypes) -> list[Any]:
    keys = ("state", "temperature", "last update", "errors since start")
    kind = "diagnostic_msgs/msg/KeyValue"
    pairs = [types.make(kind, {"key": key, "value": "nominal"}) for key in keys]
    parts = ("Cameras", "Computers", "Controllers", "EtherCAT Master", "Joints", "Lasers", "Power")
    about = {"message": "OK", "hardware_id": "pr2", "values": pairs}
    names = [f"/{part}/{number}" for part in parts for number in range(3)]
    kind = "diagnostic_msgs/msg/DiagnosticStatus"
    return [types.make(kind, {"name": name, **about}) for name in names]


def _jpegs(seed: int) -> list[NDArray[np.uint8]]:
    """Pictures as JPEG files, of the quality that the image transport of ROS sets."""
    try:
        from PIL import Image
    except ImportError as error:
        raise MissingDependencyError(
            "JPEG images need Pillow; install it with: pip install 'hybridlog[images]'"
        ) from error
    found = []
    for frame in scene(np.random.default_rng([seed, 0x19E6]), 0, (_PICTURES, 480, 640)):
        stream = io.BytesIO()
        Image.fromarray(frame).convert("RGB").save(stream, "JPEG", quality=80)
        found.append(np.frombuffer(stream.getvalue(), np.uint8))
    return found


def cut(load: Load, seconds: float) -> Load:
    """Keep what is due in the first seconds, and save that in the place of the whole.

    A truth beside it goes: it is one of the whole load. At least the first message stays.
    """
    directory = load.payloads.parent
    (directory / NAME).unlink(missing_ok=True)
    rows = slice(max(1, int(np.searchsorted(load.due, round(seconds * 1e9)))))
    names = ("channel", "due", "log_time", "offset", "length")
    shorter = replace(load, **{name: getattr(load, name)[rows] for name in names})
    shorter.save(directory)
    return shorter
