"""The simulation obeys physics: motion, plan, ray casting, events."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridlog.demo.camera import HEIGHT, Camera
from hybridlog.demo.config import RobotConfig
from hybridlog.demo.plan import WALL_HEIGHT, FloorPlan
from hybridlog.demo.robot import MOTOR_ERROR, Robot
from hybridlog.demo.sensors import GRAVITY, Inertial, LaserScanner, Lidar, Odometer
from hybridlog_storage.errors import UsageError

DT = 0.002


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
    angle=st.floats(-7, 7),
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
    laser = LaserScanner(720, 20.0)
    seconds = np.array([1.0, 9.0, 24.0, 40.0])
    ranges, intensities = laser.scan(robot, seconds, np.random.default_rng(1))
    rng = np.random.default_rng(2)
    compared = 0
    for scan, beam in zip(rng.integers(0, 4, 200), rng.integers(0, 720, 200), strict=True):
        at = robot.at(np.array([seconds[scan] + beam * laser.time_increment]))
        heading = float(at.heading[0])
        x = float(at.x[0]) + laser.offset * math.cos(heading)
        y = float(at.y[0]) + laser.offset * math.sin(heading)
        angle = heading + laser.angle_min + beam * laser.angle_increment
        true = slow_cast(robot.plan, x, y, angle)
        if math.isfinite(ranges[scan, beam]):
            assert abs(ranges[scan, beam] - true) < 6 * laser.range_noise
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
    assert robot.min_clearance > 0.3


@pytest.mark.parametrize("seed", range(8))
def test_every_seed_drives_clear_and_stands_at_its_stops(seed: int) -> None:
    robot = Robot(70.0, seed)
    assert robot.min_clearance > 0.3
    for start, stop in robot.stops:
        middle = start + (stop.end - stop.start) / 2
        assert robot.at(np.array([middle])).speed[0] < 1e-9
    assert 3 <= len(robot.gripper_closings) <= 6
    assert 1 <= len(robot.error_times) <= 6
    for braked in robot.hard_brakings:
        near = np.array([braked - 0.15, braked, braked + 0.1])
        assert robot.at(near).acceleration.min() < -1.5


def test_errors_come_from_hot_motors_after_hard_braking(robot: Robot) -> None:
    assert len(robot.hard_brakings) >= 4
    for seconds in robot.error_times:
        assert robot.motor_temperature(np.array([seconds]))[0] >= MOTOR_ERROR
        assert any(0 <= seconds - braked < 2 for braked in robot.hard_brakings)
    for braked in robot.hard_brakings:
        assert any(0 <= seconds - braked < 2 for seconds in robot.error_times)


def test_gripper_follows_its_commands(robot: Robot) -> None:
    for command, after in zip(robot.gripper_commands, robot.gripper_commands[1:], strict=False):
        rest = np.array([min(command.seconds + 1.0, after.seconds)])
        assert robot.gripper_opening(rest)[0] == pytest.approx(command.reaches)


def test_imu_says_what_the_motion_does(robot: Robot) -> None:
    seconds = np.arange(0, 60, 0.01)
    state = robot.at(seconds)
    imu = Inertial.measure(state, np.random.default_rng(1))
    turned = np.trapezoid(imu.yaw_rate, seconds)
    assert turned == pytest.approx(state.heading[-1] - state.heading[0], abs=0.02)
    assert np.trapezoid(imu.forward, seconds) == pytest.approx(state.speed[-1], abs=0.05)
    assert imu.up.mean() == pytest.approx(GRAVITY, abs=0.005)
    curve = state.yaw_rate > 0.7
    assert imu.left[curve].mean() == pytest.approx(
        float((state.speed * state.yaw_rate)[curve].mean()), abs=0.01
    )


def test_odometry_drifts_slightly(robot: Robot) -> None:
    odometer = Odometer(robot)
    rng = np.random.default_rng(1)
    parts = [odometer.at(k, np.arange(k, k + 1, 0.02), rng) for k in range(60)]
    again = odometer.at(59, np.arange(59, 60, 0.02), rng)
    assert again is parts[-1]
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
    lidar = Lidar(500)
    points = lidar.points(robot, 30.0, np.random.default_rng(1))
    assert len(points) == 16 * 500
    seen = points[np.isfinite(points["x"])]
    assert len(seen) > 6000
    z = seen["z"] + lidar.height
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
    out = np.zeros((1, 160 * 120 * 3), np.uint8)
    camera.render(robot, seconds, out, np.random.default_rng(1))
    picture = out.reshape(120, 160, 3).astype(int)
    at = robot.at(seconds)
    heading = float(at.heading[0])
    x, y = at.x[0] + 0.15 * math.cos(heading), at.y[0] + 0.15 * math.sin(heading)
    distance = slow_cast(robot.plan, float(x), float(y), heading)
    assert camera.focal * HEIGHT / distance < 55
    # From the floor up, the wall begins where the pinhole says: the floor is darker
    # than the skirting board's end, the wall brighter than both.
    column = picture[:, 80].mean(axis=1)
    foot = camera.center[1] + camera.focal * HEIGHT / distance
    assert column[: int(foot) - 6].min() > column[int(foot) + 3 :].max()
    top = camera.center[1] - camera.focal * (WALL_HEIGHT - HEIGHT) / distance
    assert top < 0 or column[int(top) - 1] != column[int(top) + 2]


def test_left_of_the_picture_is_left_of_the_robot(robot: Robot) -> None:
    # At the place stop the robot looks north; the gate with the sky is on its right.
    (start,) = [t for t, stop in robot.stops if stop.kind == "place"][:1]
    out = np.zeros((1, 64 * 48 * 3), np.uint8)
    Camera((64, 48), -np.pi / 4, 0.15, colour=True).render(
        robot, np.array([start + 1]), out, np.random.default_rng(1)
    )
    blue_less_red = out.reshape(48, 64, 3)[10:23].astype(int)
    bluish = (blue_less_red[..., 0] - blue_less_red[..., 2]).mean(axis=0) > 20
    assert bluish.any()
    assert not bluish[:5].any()


@pytest.mark.parametrize(
    ("duration_s", "seed"), [(0, 1), (-1, 1), (float("nan"), 1), (float("inf"), 1), (5, -1)]
)
def test_impossible_robots_are_refused(duration_s: float, seed: int) -> None:
    with pytest.raises(UsageError):
        Robot(duration_s, seed)


@pytest.mark.parametrize(
    "setting",
    [
        {"cameras": 5},
        {"image_size": (1, 240)},
        {"scan_hz": -1.0},
        {"imu_hz": float("nan")},
        {"scan_beams": 10**9},
    ],
)
def test_impossible_settings_are_refused(setting: dict[str, object]) -> None:
    with pytest.raises(UsageError, match=next(iter(setting))):
        RobotConfig(**setting)  # type: ignore[arg-type]
