"""The speed and micro benchmarks: all run, and their inputs are what they say."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from benchmarks.loads import bags
from benchmarks.side import SideError, run_side
from tests.imports import ROOT


@pytest.mark.parametrize(("name", "paths"), [("speed", 15), ("micro", 43)])
def test_every_benchmark_runs_and_its_answers_agree(name: str, paths: int, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "pytest", f"benchmarks/{name}.py", "--benchmark-disable"]
    command += ["-q", "--quick", f"--basetemp={tmp_path / 'made'}"]
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTEST_")}
    done = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout[-4000:]
    assert re.search(rf"^{paths} passed in", done.stdout, re.MULTILINE), done.stdout[-400:]


def test_a_side_that_fails_says_why(tmp_path: Path) -> None:
    arguments = {"bag": str(tmp_path / "nosuch"), "store": str(tmp_path / "store")}
    with pytest.raises(SideError, match="nosuch"):
        run_side("benchmarks.speed:record_side", arguments, tmp_path, 60.0)


def test_logs_are_what_they_say_and_the_same_again(tmp_path: Path) -> None:
    path, again, longer = (tmp_path / f"{name}.bag" for name in ("one", "again", "longer"))
    bags.write_small(path, 800, 3)
    bags.write_small(again, 800, 3)
    bags.write_small(longer, 1200, 3)
    assert path.read_bytes() == again.read_bytes()
    with AnyReader([path]) as one, AnyReader([longer]) as other:
        assert {c.topic: c.msgcount for c in one.connections} == dict.fromkeys(
            ("/pose", "/imu/data", "/tf", "/joint_states"), 200
        )
        first = [(c.topic, t, bytes(raw)) for c, t, raw in one.messages()]
        more = [(c.topic, t, bytes(raw)) for c, t, raw in other.messages()]
        assert first == more[:800]
        for connection, log_time, raw in one.messages():
            message: Any = one.deserialize(raw, connection.msgtype)
            if connection.topic == "/imu/data":
                stamp = message.header.stamp
                assert log_time - stamp.sec * 10**9 - stamp.nanosec == 1_000_000
                turn = message.orientation
                assert np.hypot(np.hypot(turn.x, turn.y), np.hypot(turn.z, turn.w)) == (
                    pytest.approx(1.0)
                )


def test_drive_has_two_cameras_and_a_scan(tmp_path: Path) -> None:
    path, file = tmp_path / "drive.bag", tmp_path / "drive.mcap"
    bags.write_drive(path, 0.5, 1)
    bags.bag_to_mcap(path, file)
    with AnyReader([path]) as bag:
        sizes = {c.topic: len(raw) for c, _, raw in bag.messages()}
        counts = {c.topic: c.msgcount for c in bag.connections}
        one = [(t, bytes(raw)) for _, t, raw in bag.messages()]
    assert counts[bags.SCAN_TOPIC] == 10
    assert len(counts) == 3
    assert sorted(sizes.values())[1:] == [sizes["/camera/left/image_raw"]] * 2
    with file.open("rb") as stream:
        copied = [(m.log_time, m.data) for _, _, m in make_reader(stream).iter_messages()]
    assert copied == one
