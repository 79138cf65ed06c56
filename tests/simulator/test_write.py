"""Bags of the simulated robot, read by rosbags and mcap."""

from __future__ import annotations

import hashlib
import io
import json
import subprocess
import sys
from collections import defaultdict
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from benchmarks.simulator.robot import Robot
from benchmarks.simulator.topics import TOPICS, RobotConfig, Types
from benchmarks.simulator.write import BagSummary, write_bag, write_demo
from hybridlog_storage.errors import TopicError, UsageError

ROOT = Path(__file__).parents[2]
DURATION = 17.0
SMALL = RobotConfig(image_size=(48, 32), cloud_columns=40, scan_beams=180)
RATES = {
    "/base/scan": 20,
    "/camera/front/image_raw": 5,
    "/camera/front/camera_info": 5,
    "/camera/rear/image_raw": 2.5,
    "/lidar/points": 0.5,
    "/odom": 50,
    "/tf": 50,
    "/joint_states": 50,
    "/imu/data": 100,
    "/cmd_vel": 20,
    "/rviz_camera_publisher/camera_pose": 10,
    "/battery": 1,
    "/diagnostics": 1,
}


def read(path: Path, ros: int) -> tuple[dict[str, list[tuple[int, Any]]], dict[str, Any]]:
    """All messages by topic as rosbags decodes them, and the connections."""
    types = Types(1 if ros == 1 else 2).store
    messages: dict[str, list[tuple[int, Any]]] = defaultdict(list)
    if ros == 1:
        from rosbags.rosbag1 import Reader
    else:
        from rosbags.rosbag2 import Reader  # type: ignore[assignment]
    with Reader(path) as reader:
        connections = {c.topic: c for c in reader.connections}
        for connection, log_time, raw in reader.messages():
            decode = types.deserialize_ros1 if ros == 1 else types.deserialize_cdr
            encode = types.serialize_ros1 if ros == 1 else types.serialize_cdr
            message = decode(raw, connection.msgtype)
            # The columns made the same bytes that rosbags would have made.
            assert bytes(encode(message, connection.msgtype)) == bytes(raw), connection.topic
            messages[connection.topic].append((log_time, message))
    return messages, connections


def closings_of(robot: Robot) -> int:
    return sum(command.position == 0 for command in robot.gripper_commands)


def stamps(messages: list[tuple[int, Any]]) -> np.ndarray[Any, Any]:
    return np.array(
        [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for _, m in messages], np.int64
    )


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> BagSummary:
    path = tmp_path_factory.mktemp("bag") / "robot.bag"
    return write_bag(path, duration_s=DURATION, seed=5, config=SMALL)


@pytest.fixture(scope="module")
def log(bag: BagSummary) -> dict[str, list[tuple[int, Any]]]:
    return read(bag.path, 1)[0]


def test_counts_rates_and_order(bag: BagSummary, log: dict[str, list[tuple[int, Any]]]) -> None:
    assert {t: n for t, n in bag.messages.items() if n} == {t: len(m) for t, m in log.items()}
    for topic, hz in RATES.items():
        assert abs(len(log[topic]) - hz * DURATION) <= 1 + 0.06 * hz, topic
    for topic, messages in log.items():
        times = np.array([t for t, _ in messages])
        assert (np.diff(times) >= 0).all(), topic
        assert times[0] >= bag.start_ns
        assert times[-1] < bag.start_ns + DURATION * 10**9
    assert bag.size == bag.path.stat().st_size


def test_the_file_is_in_log_time_order(bag: BagSummary) -> None:
    from rosbags.rosbag1 import Reader

    with Reader(bag.path) as reader:
        ranges = [(c.start_time, c.end_time) for c in reader.chunk_infos]
        assert len(ranges) >= 2
        assert all(a[1] <= b[0] for a, b in pairwise(ranges))
        assert reader.duration < DURATION * 1e9 <= reader.duration + 10**9


def test_headers_lag_behind_and_count_up(log: dict[str, list[tuple[int, Any]]]) -> None:
    for topic in ("/base/scan", "/camera/front/image_raw", "/odom", "/imu/data", "/lidar/points"):
        times = np.array([t for t, _ in log[topic]])
        delay = times - stamps(log[topic])
        assert delay.min() > 500_000, topic
        assert delay.max() < 200_000_000, topic
        assert [m.header.seq for _, m in log[topic]] == list(range(len(times)))
    assert np.mean(np.array([t for t, _ in log["/base/scan"]]) - stamps(log["/base/scan"])) > 1e7


def test_connections_name_their_nodes_and_latch(bag: BagSummary) -> None:
    _, connections = read(bag.path, 1)
    assert connections["/tf_static"].ext.latching == 1
    assert connections["/map"].ext.latching == 1
    assert connections["/base/scan"].ext.callerid == "/hokuyo_node"
    command = connections["/r_gripper_controller/command"]
    assert command.msgtype == "pr2_controllers_msgs/msg/Pr2GripperCommand"
    assert "float64 max_effort" in command.msgdef.data


def test_truth_is_what_the_bag_says(bag: BagSummary, log: dict[str, list[tuple[int, Any]]]) -> None:
    closings = [m for _, m in log["/r_gripper_controller/command"] if m.position == 0.0]
    near = [m for _, m in log["/base/scan"] if m.ranges.min() < 0.5]
    errors = [m for _, m in log["/diagnostics"] if any(s.level >= 2 for s in m.status)]
    assert bag.truth == {
        "gripper_closings": len(closings),
        "near_scans": len(near),
        "errors": len(errors),
    }
    assert len(closings) == closings_of(Robot(DURATION, 5)) > 0
    assert near


def test_errors_are_in_the_diagnostics(tmp_path: Path) -> None:
    robot = Robot(60.0, 2)
    topics = ["/diagnostics", "/r_gripper_controller/command", "/rosout", "/r_cart/command_pose"]
    bag = write_bag(tmp_path / "few.bag", duration_s=60, seed=2, topics=topics)
    messages, _ = read(bag.path, 1)
    assert set(messages) == set(topics)
    errors = [m for _, m in messages["/diagnostics"] if m.status[0].level == 2]
    assert bag.truth["errors"] == len(errors) > 0
    seconds = np.arange(0.4, 60, 1.0)
    assert len(errors) == np.count_nonzero(robot.motor_temperature(seconds) >= 80)
    assert bag.truth["gripper_closings"] == closings_of(robot) >= 3
    assert {m.level for _, m in messages["/rosout"]} == {2, 4, 8}


def test_odometry_integrates_twist_and_commands(log: dict[str, list[tuple[int, Any]]]) -> None:
    seconds = (stamps(log["/odom"]) - stamps(log["/odom"])[0]) / 1e9
    odom = [m for _, m in log["/odom"]]
    speed = np.array([m.twist.twist.linear.x for m in odom])
    turn = np.array([m.twist.twist.angular.z for m in odom])
    x = np.array([m.pose.pose.position.x for m in odom])
    y = np.array([m.pose.pose.position.y for m in odom])
    yaw = np.array(
        [2 * np.arctan2(m.pose.pose.orientation.z, m.pose.pose.orientation.w) for m in odom]
    )
    step = np.diff(seconds)
    heading = np.concatenate(([0], np.cumsum((turn[1:] + turn[:-1]) / 2 * step)))
    driven = (speed[1:] + speed[:-1]) / 2 * step
    middle = (heading[1:] + heading[:-1]) / 2
    assert abs(np.unwrap(yaw) - yaw[0] - heading).max() < 0.05
    assert abs(np.cumsum(driven * np.cos(middle)) - x[1:]).max() < 0.1
    assert abs(np.cumsum(driven * np.sin(middle)) - y[1:]).max() < 0.1
    commands = np.array([m.linear.x for _, m in log["/cmd_vel"]])
    assert commands.sum() / 20 == pytest.approx(driven.sum(), abs=0.2)
    # The wheels roll as far as the robot drives.
    wheels = np.array([m.position[:2] for _, m in log["/joint_states"]])
    assert wheels[-1].mean() * 0.1 == pytest.approx(driven.sum(), rel=0.02, abs=0.05)


def test_transforms_chain_to_the_truth(log: dict[str, list[tuple[int, Any]]]) -> None:
    robot = Robot(DURATION, 5)
    for _, message in log["/tf"][:: len(log["/tf"]) // 20]:
        a, b = (t.transform for t in message.transforms)
        stamp = message.transforms[1].header.stamp
        turn = 2 * np.arctan2(a.rotation.z, a.rotation.w)
        x = a.translation.x + np.cos(turn) * b.translation.x - np.sin(turn) * b.translation.y
        y = a.translation.y + np.sin(turn) * b.translation.x + np.cos(turn) * b.translation.y
        seconds = (stamp.sec * 10**9 + stamp.nanosec - robot.start_ns) / 1e9
        truth = robot.at(np.array([seconds]))
        assert (x, y) == pytest.approx((float(truth.x[0]), float(truth.y[0])), abs=1e-3)


def digest(path: Path) -> str:
    files = [path] if path.is_file() else sorted(path.iterdir())
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


@pytest.mark.parametrize(("ros", "storage"), [(1, "mcap"), (2, "mcap"), (2, "sqlite3")])
def test_same_arguments_same_bytes(tmp_path: Path, ros: Any, storage: Any) -> None:
    paths = [tmp_path / name / "robot" for name in ("a", "b", "c")]
    for path, seed in zip(paths, (4, 4, 5), strict=True):
        path.parent.mkdir()
        write_bag(path, duration_s=1.5, seed=seed, ros=ros, storage=storage, config=SMALL)
    a, b, c = (digest(path) for path in paths)
    assert a == b != c


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_ros2_says_the_same(tmp_path: Path, storage: Any) -> None:
    one = write_bag(tmp_path / "one.bag", duration_s=3, seed=7, config=SMALL)
    two = write_bag(tmp_path / "two", duration_s=3, seed=7, ros=2, storage=storage, config=SMALL)
    assert one.messages == two.messages
    assert one.truth == two.truth
    first, _ = read(one.path, 1)
    second, _ = read(two.path, 2)
    for topic, messages in first.items():
        assert [t for t, _ in messages] == [t for t, _ in second[topic]], topic
    for (_, a), (_, b) in zip(first["/base/scan"], second["/base/scan"], strict=True):
        assert np.array_equal(a.ranges, b.ranges)
        assert a.header.stamp.nanosec == b.header.stamp.nanosec
    a, b = first["/lidar/points"][0][1], second["/lidar/points"][0][1]
    assert np.array_equal(a.data, b.data)
    assert [m.level for _, m in second["/rosout"]] == [20, 20]


@pytest.mark.parametrize("compression", ["lz4", "bz2"])
def test_compressed_chunks_hold_the_same(tmp_path: Path, compression: Any) -> None:
    topics = ["/odom", "/base/scan"]
    plain = write_bag(tmp_path / "a.bag", duration_s=2, topics=topics, config=SMALL)
    small = write_bag(
        tmp_path / "b.bag", duration_s=2, topics=topics, config=SMALL, compression=compression
    )
    assert small.size < plain.size
    assert small.messages == plain.messages
    read(small.path, 1)


def test_settings_are_honoured(tmp_path: Path) -> None:
    config = RobotConfig(image_size=(64, 40), scan_beams=1081, cloud_columns=30)
    summary = write_bag(tmp_path / "x.bag", duration_s=1, config=config)
    messages, _ = read(summary.path, 1)
    rear = messages["/camera/rear/image_raw"][0][1]
    assert (rear.width, rear.height, rear.encoding, rear.step) == (64, 40, "mono8", 64)
    assert len(messages["/base/scan"][0][1].ranges) == 1081
    cloud = messages["/lidar/points"][0][1]
    assert (cloud.width, cloud.height) == (30, 16)
    assert len(cloud.data) == cloud.height * cloud.row_step == 16 * 30 * cloud.point_step
    assert list(summary.messages) == [topic.name for topic in TOPICS]


def test_a_second_does_not_depend_on_what_follows(tmp_path: Path) -> None:
    short = write_bag(tmp_path / "a.bag", duration_s=2, config=SMALL)
    long = write_bag(tmp_path / "b.bag", duration_s=3, config=SMALL)
    whole, _ = read(long.path, 1)
    for topic, messages in read(short.path, 1)[0].items():
        assert [t for t, _ in messages] == [t for t, _ in whole[topic][: len(messages)]], topic


def test_unknown_topics_and_taken_names_are_refused(tmp_path: Path) -> None:
    with pytest.raises(TopicError, match="/nonsense"):
        write_bag(tmp_path / "x.bag", duration_s=1, topics=["/nonsense"])
    taken = tmp_path / "taken.bag"
    taken.write_bytes(b"precious")
    with pytest.raises(UsageError, match="exists"):
        write_bag(taken, duration_s=1)
    assert taken.read_bytes() == b"precious"
    with pytest.raises(UsageError, match="compression"):
        write_bag(tmp_path / "y", duration_s=1, ros=2, compression="lz4")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["taken.bag"]


def test_the_writer_as_a_command(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "benchmarks.simulator", str(tmp_path / "r.bag")]
    command += ["--duration", "1"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert "MB" in done.stdout
    again = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert again.returncode == 2
    assert again.stderr.endswith("r.bag exists already; remove it or choose another name\n")


def differs(found: Any, wanted: Any) -> bool:
    """Whether messages differ by more than processors and versions of libjpeg do."""
    if hasattr(wanted, "__dataclass_fields__"):
        if "CompressedImage" in wanted.__msgtype__:
            one, other = (
                np.asarray(Image.open(io.BytesIO(m.data)), np.float32) for m in (found, wanted)
            )
            return found.format != wanted.format or abs(one - other).mean() > 1
        names = wanted.__dataclass_fields__
        return any(differs(getattr(found, n), getattr(wanted, n)) for n in names)
    if isinstance(wanted, list):
        return len(found) != len(wanted) or any(map(differs, found, wanted))
    if isinstance(wanted, np.ndarray) and wanted.dtype.kind == "f":
        return not np.allclose(found, wanted, 1e-5, 1e-5, equal_nan=True)
    if isinstance(wanted, float):
        return not np.isclose(found, wanted, 1e-9, 1e-9, equal_nan=True)
    return not np.array_equal(found, wanted)


def test_the_bag_in_the_package_is_what_the_simulator_writes(tmp_path: Path) -> None:
    package = ROOT / "hybridlog" / "demo"
    made = write_demo(tmp_path / "robot.bag")
    told = json.loads((package / "robot.json").read_text())
    assert told == json.loads((tmp_path / "robot.json").read_text())
    assert told == {"messages": made.messages, **made.truth}
    committed = package / "robot.bag"
    assert committed.stat().st_size <= 8_000_000
    if committed.read_bytes() == made.path.read_bytes():
        return
    found, wanted = read(committed, 1)[0], read(made.path, 1)[0]
    assert found.keys() == wanted.keys()
    for topic, messages in wanted.items():
        assert [t for t, _ in found[topic]] == [t for t, _ in messages], topic
        pairs = zip(found[topic], messages, strict=True)
        assert not any(differs(one, other) for (_, one), (_, other) in pairs), topic


def test_images_are_compressed(tmp_path: Path) -> None:
    config = SMALL._replace(jpeg=90, intensity_step=50.0)
    plain = write_bag(tmp_path / "a.bag", duration_s=1, config=SMALL)
    small = write_bag(tmp_path / "b.bag", duration_s=1, config=config)
    raw, packed = (read(summary.path, 1)[0] for summary in (plain, small))
    assert "/camera/rear/image_raw" not in small.messages
    for name, shape in (("front", (32, 48, 3)), ("rear", (32, 48))):
        topic = f"/camera/{name}/image_raw"
        (_, image), (_, message) = raw[topic][0], packed[f"{topic}/compressed"][0]
        assert image.header.stamp == message.header.stamp
        pixels = np.asarray(Image.open(io.BytesIO(message.data)), np.float32)
        assert pixels.shape == shape
        # The noise in a picture depends on its topic.
        wanted = (
            image.data.reshape(shape)[..., ::-1] if name == "front" else image.data.reshape(shape)
        )
        assert abs(pixels - wanted).mean() < 5
    for (_, one), (_, other) in zip(raw["/base/scan"], packed["/base/scan"], strict=True):
        assert np.array_equal(one.ranges, other.ranges)
        assert not (other.intensities % 50).any()
        assert abs(one.intensities - other.intensities).max() <= 25
