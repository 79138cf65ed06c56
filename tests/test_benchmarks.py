"""The benchmarks' own parts: figures, marks, the table in the docs, and their inputs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from benchmarks.documents import replace_section
from benchmarks.side import SideError, run_side
from benchmarks.speed import logs
from benchmarks.speed.command import DOCS, STUDIES
from benchmarks.speed.report import markdown
from benchmarks.speed.results import Finding, Outcome, Sample, figure, ratio, values_of
from tests.imports import ROOT

HEADER = {
    "quick": False,
    "repetitions": 3,
    "seed": 1,
    "cpu": "a processor",
    "cores": 2,
    "memory_gib": 1.0,
    "system": "Linux",
    "python": "3",
    "packages": {"mcap": "1"},
    "mongod": "6",
    "revision": "abc",
    "started": "now",
    "load_1min": 0.0,
}


def test_ratio_is_of_medians_and_its_spread_of_pairs() -> None:
    found = ratio("s", "a", [8.0, 20.0, 9.0], [1.0, 2.0, 3.0], target=4.5)
    assert (found.value, found.low, found.high) == (4.5, 3.0, 10.0)
    assert found.passed


@pytest.mark.parametrize(
    ("relation", "value", "passed"),
    [(">=", 1.9, False), (">=", 2.0, True), ("<=", 2.0, True), ("<", 2.0, False), ("<", 1.0, True)],
)
def test_targets(relation: str, value: float, passed: bool) -> None:
    found = figure("s", "a", [value], "s", target=2.0, relation=relation)  # type: ignore[arg-type]
    assert found.passed is passed
    assert figure("s", "a", [value], "s").passed is None


def test_values_by_side() -> None:
    samples = [Sample("s", side, 0, {"seconds": n}) for n, side in enumerate("aba")]
    assert values_of(samples, "a", "seconds") == [0.0, 2.0]


def test_table_in_the_docs_is_replaced(tmp_path: Path) -> None:
    outcome = Outcome(HEADER)
    outcome.findings.append(Finding("study", "what", 3.0, 2.0, 4.0, target=20.0))
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- results -->\nold\n<!-- /results -->\nafter\n")
    for _ in range(2):
        replace_section(page, "results", markdown(outcome))
    text = page.read_text()
    assert text.count(markdown(outcome)) == 1
    assert "old" not in text
    assert text.startswith("before\n<!-- results -->\n")
    assert text.endswith("<!-- /results -->\nafter\n")
    assert "| study | what | 3x | 2x to 4x | ≥ 20x | ✗ missed |" in text
    page.write_text("nothing")
    with pytest.raises(ValueError, match="one section"):
        replace_section(page, "results", markdown(outcome))


def test_docs_name_every_study_and_hold_the_section() -> None:
    text = DOCS.read_text(encoding="utf-8")
    assert text.count("<!-- results -->\n") == text.count("<!-- /results -->\n") == 1
    assert [name for name in STUDIES if f"`{name}`" not in text] == []


def test_command_lists_studies_and_refuses_others() -> None:
    command = [sys.executable, "-m", "benchmarks"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert "speed" in listed.stdout
    wrong = subprocess.run(
        [*command, "nosuch"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert (wrong.returncode, wrong.stdout) == (2, "")
    assert "nosuch" in wrong.stderr


def test_a_side_that_fails_says_why(tmp_path: Path) -> None:
    with pytest.raises(SideError, match="nosuch"):
        run_side(
            "benchmarks.speed.ours:record",
            {"bag": str(tmp_path / "nosuch"), "store": str(tmp_path / "store")},
        )


def test_logs_are_what_they_say_and_the_same_again(tmp_path: Path) -> None:
    path, again, longer = (tmp_path / f"{name}.bag" for name in ("one", "again", "longer"))
    logs.write_small(path, 800, 3)
    logs.write_small(again, 800, 3)
    logs.write_small(longer, 1200, 3)
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
    logs.write_drive(path, 0.5, 1)
    logs.bag_to_mcap(path, file)
    with AnyReader([path]) as bag:
        sizes = {c.topic: len(raw) for c, _, raw in bag.messages()}
        counts = {c.topic: c.msgcount for c in bag.connections}
        one = [(t, bytes(raw)) for _, t, raw in bag.messages()]
    assert counts[logs.SCAN_TOPIC] == 10
    assert len(counts) == 3
    assert sorted(sizes.values())[1:] == [sizes["/camera/left/image_raw"]] * 2
    with file.open("rb") as stream:
        copied = [(m.log_time, m.data) for _, _, m in make_reader(stream).iter_messages()]
    assert copied == one
