"""Bags of the simulated robot, read by rosbags and mcap."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rosbags.rosbag1 import Reader

from benchmarks.simulator.robot import Robot
from benchmarks.simulator.topics import RobotConfig, Types
from benchmarks.simulator.write import write_bag, write_demo

ROOT = Path(__file__).parents[2]
SMALL = RobotConfig(image_size=(48, 32), cloud_columns=40, scan_beams=180)


def said(path: Path) -> Iterator[Any]:
    """All messages as they are stored."""
    with Reader(path) as reader:
        yield from reader.messages()


def read(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """All messages by topic as rosbags decodes them."""
    types = Types().store
    messages: dict[str, list[tuple[int, Any]]] = defaultdict(list)
    for connection, log_time, raw in said(path):
        message = types.deserialize_ros1(raw, connection.msgtype)
        # The columns made the same bytes that rosbags would have made.
        assert bytes(types.serialize_ros1(message, connection.msgtype)) == bytes(raw)
        messages[connection.topic].append((log_time, message))
    return messages


def test_truth_is_what_the_bag_says(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "robot.bag", duration_s=17, seed=5, config=SMALL)
    log = read(bag.path)
    assert {t: n for t, n in bag.messages.items() if n} == {t: len(m) for t, m in log.items()}
    assert bag.size == bag.path.stat().st_size
    closings = [m for _, m in log["/r_gripper_controller/command"] if m.position == 0.0]
    near = [m for _, m in log["/base/scan"] if m.ranges.min() < 0.5]
    errors = [m for _, m in log["/diagnostics"] if any(s.level >= 2 for s in m.status)]
    assert bag.truth == {
        "gripper_closings": len(closings),
        "near_scans": len(near),
        "errors": len(errors),
    }
    assert len(closings) == sum(c.position == 0 for c in Robot(17, 5).gripper_commands) > 0
    assert near


def test_the_bag_in_the_package_is_what_the_simulator_writes(tmp_path: Path) -> None:
    package = ROOT / "hybridlog" / "demo"
    made = write_demo(tmp_path / "robot.bag")
    told = json.loads((package / "robot.json").read_text())
    assert told == json.loads((tmp_path / "robot.json").read_text())
    assert told == {"messages": made.messages, **made.truth}
    committed = package / "robot.bag"
    assert committed.stat().st_size <= 8_000_000
    # Pictures differ by the version of libjpeg, the last digits by the processor.
    found, wanted = ({(c.topic, time) for c, time, _ in said(p)} for p in (committed, made.path))
    assert found == wanted
