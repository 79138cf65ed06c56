"""The simulation obeys physics: motion, plan, ray casting, events."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.simulator import sensors
from benchmarks.simulator.plan import FloorPlan
from benchmarks.simulator.robot import MOTOR_ERROR, Robot
from benchmarks.simulator.topics import TOPICS
from hybridlog_storage.errors import UsageError


def min_clearance(robot: Robot) -> float:
    """Metres between the robot's centre and the nearest surface, at its smallest."""
    state = robot.at(np.arange(0.0, min(robot.duration_s, robot.period), 0.02))
    return float(robot.plan.clearance(state.x, state.y).min())


def brakings(robot: Robot) -> list[float]:
    return [stop.start for stop in robot.stops if stop.kind == "brake"]


def error_times(robot: Robot) -> list[float]:
    """Seconds of each diagnostics message with an error in it."""
    (topic,) = [topic for topic in TOPICS if topic.name == "/diagnostics"]
    seconds = np.arange(topic.phase, robot.duration_s, 1 / topic.hz)
    return [float(t) for t in seconds[robot.motor_temperature(seconds) >= MOTOR_ERROR]]


def slow_cast(plan: FloorPlan, x: float, y: float, angle: float) -> float:
    """One ray, by solving for each surface in plain Python, in another way."""
    dx, dy = math.cos(angle), math.sin(angle)
    best = math.inf
    for x0, y0, x1, y1 in plan.segments.tolist():
        # Coordinates of the ends in the ray's own frame: along and to the left.
        a0, l0 = (x0 - x) * dx + (y0 - y) * dy, (y0 - y) * dx - (x0 - x) * dy
        a1, l1 = (x1 - x) * dx + (y1 - y) * dy, (y1 - y) * dx - (x1 - x) * dy
        if (l0 > 0) == (l1 > 0):
            continue
        along = a0 + (a1 - a0) * l0 / (l0 - l1)
        if 0 < along < best:
            best = along
    for cx, cy, radius in plan.pillars.tolist():
        along, left = (cx - x) * dx + (cy - y) * dy, (cy - y) * dx - (cx - x) * dy
        if abs(left) < radius:
            along -= math.sqrt(radius**2 - left**2)
            if 0 < along < best:
                best = along
    return best


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot(150.0, 3)


@given(
    seed=st.integers(0, 5),
    x=st.floats(0.3, 13.7),
    y=st.floats(0.3, 9.7),
    # Along a wall, which of its ends is hit depends on the last bit.
    angle=st.floats(-7, 7).filter(lambda angle: abs(angle) > 1e-6),
)
@settings(max_examples=150, deadline=None)
def test_ray_casting_agrees_with_a_slow_one(seed: int, x: float, y: float, angle: float) -> None:
    plan = FloorPlan(seed)
    # On the very edge of a surface both answers are right.
    expected = {slow_cast(plan, x, y, angle + d) for d in (-1e-7, 0.0, 1e-7)}
    hits = plan.cast(np.array([x]), np.array([y]), np.array([angle]))
    got = float(hits.distance[0])
    assert any(got == e or abs(got - e) < 1e-4 for e in expected)
    assert (hits.surface[0] >= 0) == math.isfinite(got)
    assert 0 <= hits.cosine[0] <= 1


def test_scan_ranges_are_distances_to_the_plan(robot: Robot) -> None:
    angle_step, time_step = sensors.scan_steps(720)
    assert time_step == 0.75 / 20 / 720
    assert angle_step * 719 == pytest.approx(1.5 * math.pi)
    seconds = np.array([1.0, 9.0, 24.0, 40.0])
    ranges, intensities = sensors.scan(robot, seconds, 720, np.random.default_rng(1))
    rng = np.random.default_rng(2)
    compared = 0
    for scan, beam in zip(rng.integers(0, 4, 200), rng.integers(0, 720, 200), strict=True):
        at = robot.at(np.array([seconds[scan] + beam * time_step]))
        heading = float(at.heading[0])
        x = float(at.x[0]) + sensors.LASER_OFFSET * math.cos(heading)
        y = float(at.y[0]) + sensors.LASER_OFFSET * math.sin(heading)
        angle = heading + sensors.SCAN_ANGLE_MIN + beam * angle_step
        true = slow_cast(robot.plan, x, y, angle)
        if math.isfinite(ranges[scan, beam]):
            assert abs(ranges[scan, beam] - true) < 6 * sensors.SCAN_NOISE
            assert intensities[scan, beam] > 0
            compared += 1
        else:
            assert intensities[scan, beam] == 0
    assert compared > 150


@pytest.mark.parametrize("seed", range(8))
def test_every_seed_drives_clear_and_stands_at_its_stops(seed: int) -> None:
    robot = Robot(70.0, seed)
    assert min_clearance(robot) > 0.3
    for stop in robot.stops:
        middle = (stop.start + stop.end) / 2
        assert robot.at(np.array([middle])).speed[0] < 1e-9
    assert 3 <= sum(c.position == 0 for c in robot.gripper_commands) <= 6
    assert 1 <= len(error_times(robot)) <= 6
    for braked in brakings(robot):
        near = np.array([braked - 0.15, braked, braked + 0.1])
        assert robot.at(near).acceleration.min() < -1.5


@pytest.mark.parametrize(
    ("duration_s", "seed"), [(0, 1), (-1, 1), (float("nan"), 1), (float("inf"), 1), (5, -1)]
)
def test_impossible_robots_are_refused(duration_s: float, seed: int) -> None:
    with pytest.raises(UsageError):
        Robot(duration_s, seed)
