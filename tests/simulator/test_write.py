"""Bags of the simulated robot, read by rosbags and mcap."""

from __future__ import annotations

import io
import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from rosbags.rosbag1 import Reader

from benchmarks.simulator.robot import Robot
from benchmarks.simulator.topics import RobotConfig, Types
from benchmarks.simulator.write import write_bag, write_demo

ROOT = Path(__file__).parents[2]
SMALL = RobotConfig(image_size=(48, 32), cloud_columns=40, scan_beams=180)


def read(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """All messages by topic as rosbags decodes them."""
    types = Types().store
    messages: dict[str, list[tuple[int, Any]]] = defaultdict(list)
    with Reader(path) as reader:
        for connection, log_time, raw in reader.messages():
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
    found, wanted = read(committed), read(made.path)
    assert found.keys() == wanted.keys()
    for topic, messages in wanted.items():
        assert [t for t, _ in found[topic]] == [t for t, _ in messages], topic
        pairs = zip(found[topic], messages, strict=True)
        assert not any(differs(one, other) for (_, one), (_, other) in pairs), topic
