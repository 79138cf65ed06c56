"""The simulation obeys physics: motion, plan, ray casting, events."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.simulator import sensors
from benchmarks.simulator.plan import WALL_HEIGHT, FloorPlan
from benchmarks.simulator.robot import MOTOR_ERROR, Robot
from benchmarks.simulator.sensors import CAMERA_HEIGHT, GRAVITY, Camera, Odometer, inertial
from benchmarks.simulator.topics import TOPICS
from hybridlog_storage.errors import UsageError

DT = 0.002


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


def test_nothing_comes_back_from_the_open_gate(robot: Robot) -> None:
    hits = robot.plan.cast(np.array([12.2]), np.array([5.0]), np.array([0.0]))
    assert np.isinf(hits.distance[0])
    assert hits.surface[0] == -1


def test_speed_and_turning_integrate_to_the_path(robot: Robot) -> None:
    seconds = np.arange(0, robot.duration_s, DT)
    state = robot.at(seconds)
    x = state.x[0] + np.cumsum(state.speed * np.cos(state.heading)) * DT
    y = state.y[0] + np.cumsum(state.speed * np.sin(state.heading)) * DT
    heading = state.heading[0] + np.cumsum(state.yaw_rate) * DT
    assert np.hypot(x - state.x, y - state.y).max() < 0.02
    assert np.abs(heading - state.heading).max() < 0.01
    assert np.abs(np.cumsum(state.speed) * DT - state.distance).max() < 0.02
    assert np.abs(np.cumsum(state.acceleration) * DT - state.speed).max() < 0.02
    assert state.speed[0] == pytest.approx(0, abs=1e-9)


def test_motion_is_smooth_and_keeps_clear_of_the_walls(robot: Robot) -> None:
    state = robot.at(np.arange(0, robot.duration_s, DT))
    assert state.speed.min() >= 0
    assert 0.7 < state.speed.max() < 1.0
    assert np.abs(np.diff(state.speed)).max() < 0.02
    assert np.abs(np.diff(state.yaw_rate)).max() < 0.02
    assert np.abs(state.yaw_rate).max() < 1.1
    assert state.acceleration.min() > -4
    assert min_clearance(robot) > 0.3


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


def test_errors_come_from_hot_motors_after_hard_braking(robot: Robot) -> None:
    assert len(brakings(robot)) >= 4
    for seconds in error_times(robot):
        assert robot.motor_temperature(np.array([seconds]))[0] >= MOTOR_ERROR
        assert any(0 <= seconds - braked < 2 for braked in brakings(robot))
    for braked in brakings(robot):
        assert any(0 <= seconds - braked < 2 for seconds in error_times(robot))


def test_gripper_follows_its_commands(robot: Robot) -> None:
    for command, after in zip(robot.gripper_commands, robot.gripper_commands[1:], strict=False):
        rest = np.array([min(command.seconds + 1.0, after.seconds)])
        assert robot.gripper_opening(rest)[0] == pytest.approx(command.reaches)


def test_imu_says_what_the_motion_does(robot: Robot) -> None:
    seconds = np.arange(0, 60, 0.01)
    state = robot.at(seconds)
    yaw_rate, forward, left, up = inertial(state, np.random.default_rng(1))
    turned = np.trapezoid(yaw_rate, seconds)
    assert turned == pytest.approx(state.heading[-1] - state.heading[0], abs=0.02)
    assert np.trapezoid(forward, seconds) == pytest.approx(state.speed[-1], abs=0.05)
    assert up.mean() == pytest.approx(GRAVITY, abs=0.005)
    curve = state.yaw_rate > 0.7
    assert left[curve].mean() == pytest.approx(
        float((state.speed * state.yaw_rate)[curve].mean()), abs=0.01
    )


def test_odometry_drifts_slightly(robot: Robot) -> None:
    odometer = Odometer(robot)
    rng = np.random.default_rng(1)
    parts = [odometer.measure(np.arange(k, k + 1, 0.02), rng) for k in range(60)]
    heading = np.concatenate([p.heading for p in parts])
    x = np.concatenate([p.x for p in parts])
    y = np.concatenate([p.y for p in parts])
    truth = robot.at(np.arange(0, 60, 0.02))
    first = truth.heading[0]
    across, up = truth.x - truth.x[0], truth.y - truth.y[0]
    true_x = np.cos(first) * across + np.sin(first) * up
    true_y = -np.sin(first) * across + np.cos(first) * up
    error = np.hypot(x - true_x, y - true_y)
    assert 0.005 < error.max() < 0.6
    assert 0.001 < np.abs(heading - (truth.heading - first)).max() < 0.1


def test_cloud_points_lie_on_the_plan(robot: Robot) -> None:
    points = sensors.cloud(robot, 30.0, 500, np.random.default_rng(1))
    assert len(points) == 16 * 500
    seen = points[np.isfinite(points["x"])]
    assert len(seen) > 6000
    z = seen["z"] + sensors.LIDAR_HEIGHT
    assert z.min() > -0.1
    assert z.max() < WALL_HEIGHT + 1.5
    upright = seen[(z > 0.1) & (z < WALL_HEIGHT)]
    at = robot.at(np.array([30.0]))
    cos, sin = math.cos(at.heading[0]), math.sin(at.heading[0])
    x = at.x[0] + cos * upright["x"] - sin * upright["y"]
    y = at.y[0] + sin * upright["x"] + cos * upright["y"]
    assert np.quantile(robot.plan.clearance(x, y), 0.999) < 0.08


def test_camera_draws_walls_as_high_as_they_are_near(robot: Robot) -> None:
    camera = Camera((160, 120), 0.0, 0.15, colour=True)
    seconds = np.array([0.5])
    picture = camera.render(robot, 0.5, np.random.default_rng(1)).reshape(120, 160, 3).astype(int)
    at = robot.at(seconds)
    heading = float(at.heading[0])
    x, y = at.x[0] + 0.15 * math.cos(heading), at.y[0] + 0.15 * math.sin(heading)
    distance = slow_cast(robot.plan, float(x), float(y), heading)
    assert camera.focal * CAMERA_HEIGHT / distance < 55
    # From the floor up, the wall begins where the pinhole says: the floor is darker
    # than the skirting board's end, the wall brighter than both.
    column = picture[:, 80].mean(axis=1)
    foot = camera.center[1] + camera.focal * CAMERA_HEIGHT / distance
    assert column[: int(foot) - 6].min() > column[int(foot) + 3 :].max()
    top = camera.center[1] - camera.focal * (WALL_HEIGHT - CAMERA_HEIGHT) / distance
    assert top < 0 or column[int(top) - 1] != column[int(top) + 2]


def test_left_of_the_picture_is_left_of_the_robot(robot: Robot) -> None:
    # At the place stop the robot looks north; the gate with the sky is on its right.
    (start,) = [stop.start for stop in robot.stops if stop.kind == "place"][:1]
    camera = Camera((64, 48), -np.pi / 4, 0.15, colour=True)
    picture = camera.render(robot, start + 1, np.random.default_rng(1))
    blue_less_red = picture.reshape(48, 64, 3)[10:23].astype(int)
    bluish = (blue_less_red[..., 0] - blue_less_red[..., 2]).mean(axis=0) > 20
    assert bluish.any()
    assert not bluish[:5].any()


@pytest.mark.parametrize(
    ("duration_s", "seed"), [(0, 1), (-1, 1), (float("nan"), 1), (float("inf"), 1), (5, -1)]
)
def test_impossible_robots_are_refused(duration_s: float, seed: int) -> None:
    with pytest.raises(UsageError):
        Robot(duration_s, seed)
