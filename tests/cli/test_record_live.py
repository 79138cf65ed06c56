"""`hybridlog record` of what speaks, and the commands that visit a recorder."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.cli.running import COMMAND, environment, run
from tests.independent import read

SMALL_S = 5


@contextmanager
def recorder(store: Path, *arguments: object) -> Iterator[subprocess.Popen[str]]:
    """A recorder that says on standard output, in JSON, how it is doing."""
    process = subprocess.Popen(
        [
            *COMMAND,
            "record",
            "--store",
            str(store),
            "--json",
            "--reserve",
            "0",
            *map(str, arguments),
        ],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment(),
    )
    try:
        yield process
    finally:
        if process.poll() is None:
            process.kill()
        process.communicate()


def until_it_speaks(process: subprocess.Popen[str]) -> dict[str, Any]:
    """Wait until messages have come; the state then."""
    assert process.stdout is not None
    for line in process.stdout:
        state: dict[str, Any] = json.loads(line)["state"]
        if state["messages"]:
            return state
    raise AssertionError("it ended before anything came")


def end(process: subprocess.Popen[str], number: int | None = signal.SIGINT) -> dict[str, Any]:
    """End it as Ctrl-C does; its report."""
    if number is not None:
        process.send_signal(number)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, (process.returncode, err)
    assert "Traceback" not in err, err
    report: dict[str, Any] = json.loads(out.splitlines()[-1])["report"]
    return report


def test_a_replay_is_recorded_whole(logs: Path, tmp_path: Path) -> None:
    store = tmp_path / "store"
    done = run("record", "--replay", logs / "small.bag", "--speed", 20, "--reserve", 0, store=store)
    assert "all has been played" in done.out
    assert "lost" in done.out
    assert "nothing" in done.out
    expected = read(logs / "small.bag")
    run("export", tmp_path / "out.mcap", store=store)
    found = read(tmp_path / "out.mcap")
    assert Counter((m.topic, m.payload) for m in found) == Counter(
        (m.topic, m.payload) for m in expected
    )
    assert "complete" in run("info", "small", store=store).out
    assert "Nothing is missing" in run("losses", store=store).out


def test_ctrl_c_ends_it_with_everything_stored(logs: Path, tmp_path: Path) -> None:
    store = tmp_path / "store"
    with recorder(store, "--replay", logs / "robot.bag") as process:
        until_it_speaks(process)
        report = end(process)
    (recording,) = report["recordings"]
    assert recording["status"] == "complete"
    assert recording["messages"] == report["messages_received"] > 0
    assert recording["messages_indexed"] == recording["messages"]
    assert run("verify", store=store).code == 0


def test_a_second_ctrl_c_leaves_at_once_and_what_was_flushed_is_there(
    logs: Path, tmp_path: Path
) -> None:
    store = tmp_path / "store"
    with recorder(store, "--replay", logs / "robot.bag", "--flush-interval", "100ms") as process:
        until_it_speaks(process)
        time.sleep(1)
        # The second one may find it closing, or closed.
        process.send_signal(signal.SIGTERM)
        process.send_signal(signal.SIGINT)
        code = process.wait(30)
        assert code in {0, 128 + signal.SIGTERM, 128 + signal.SIGINT}
    listed = run("ls", "--json", store=store)
    (entry,) = listed.json
    assert entry["messages"] > 0
    run("verify", store=store)


def test_what_is_thinned_out_is_told(logs: Path, tmp_path: Path) -> None:
    store = tmp_path / "store"
    with recorder(
        store, "--replay", logs / "small.bag", "--throttle", "/imu/data", "5Hz", "-x", "/tf"
    ) as process:
        report = end(process, None)
    topics = report["topics"]
    assert "/tf" not in topics
    counted = {t: n["received"] for t, n in topics.items()}
    lost = report["lost"]["throttle"]
    assert 0 < lost < counted["/imu/data"]
    (recording,) = report["recordings"]
    assert recording["messages"] + lost == report["messages_received"]
    rows = run("losses", "--json", "-t", "imu/data", store=store).json
    assert sum(row["count"] for row in rows) == lost
    assert {row["cause"] for row in rows} == {"throttle"}
    assert run("losses", "--json", "-t", "/joint_states", store=store).json == []
    assert "thinned out by wish" in run("fetch", "-t", "imu/data", "--count", store=store).err
    assert "/imu/data" in run("losses", store=store).out


def test_a_recorder_is_visited(logs: Path, tmp_path: Path) -> None:
    store = tmp_path / "store"
    with recorder(store, "--replay", logs / "robot.bag", "--speed", 0.3) as process:
        until_it_speaks(process)
        run("mark", "gripper slipped", "--tag", "trial=7", store=store)
        state = run("top", "--json", "--once", "--field", "base/scan:ranges.min", store=store).json
        assert state["messages"] > 0
        (field,) = state["fields"]
        assert field["topic"] == "/base/scan"
        if field["n"]:
            assert field["least"] <= field["mean"] <= field["greatest"]
        shown = run("top", store=store).out
        assert "/imu/data" in shown
        assert "messages/s" in shown
        refused = run("trigger", "now", store=store, code=2)
        assert "--ring" in refused.err
        end(process)
    found = run(
        "fetch", "-t", "marks", "--where", "tags.trial = '7'", "--format", "jsonl", store=store
    )
    assert json.loads(found.out.splitlines()[0])["text"] == "gripper slipped"
    for command in (["top"], ["mark", "x"], ["trigger", "x"]):
        assert "Nothing is being recorded" in run(*command, store=store, code=2).err


def test_a_ring_keeps_what_lies_around_a_trigger(logs: Path, tmp_path: Path) -> None:
    store = tmp_path / "store"
    with recorder(
        *(store, "--replay", logs / "robot.bag", "--speed", 0.3),
        *("--ring", "30s", "--before", "1s", "--after", "1s"),
    ) as process:
        until_it_speaks(process)
        time.sleep(2)
        run("trigger", "bump", store=store)
        time.sleep(2.5)
        os.kill(process.pid, signal.SIGUSR1)
        time.sleep(1.5)
        report = end(process)
    assert [r["tags"]["trigger"] for r in report["recordings"]] == ["bump", "SIGUSR1"]
    for entry in run("ls", "--json", store=store).json:
        assert 0 < entry["messages"] < report["messages_received"]
        assert entry["last_ns"] - entry["start_ns"] < 4_000_000_000


def test_nothing_triggered_nothing_kept(logs: Path, tmp_path: Path) -> None:
    done = run(
        *("record", "--replay", logs / "small.bag", "--speed", 20, "--ring", "10s"),
        *("--reserve", 0, "--trigger", "/imu/data: linear_acceleration.x > 1e9"),
        store=tmp_path / "store",
    )
    assert "Nothing was triggered" in done.err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "Nothing to record"),
        (["--replay", "{logs}/small.bag", "{logs}/small.bag"], "not both"),
        (["--replay", "{logs}/small.bag", "--between", "+1s", "+2s"], "for logs"),
        (["--replay", "{logs}/small.bag", "--throttle", "/a"], "wants a topic and a value"),
        (["--replay", "{logs}/small.bag", "--throttle", "/a", "fast"], "is no rate"),
        (["--replay", "{logs}/small.bag", "--priority", "/a", "urgent"], "no priority"),
        (["--replay", "{logs}/small.bag", "--before", "1s"], "are for --ring"),
        (["--replay", "{logs}/small.bag", "--ring", "1s", "--before", "2s"], "longer than --ring"),
        (["--replay", "{logs}/small.bag", "--ring", "1s", "--trigger", "/a: x >"], "x >"),
        (["--replay", "{logs}/small.bag", "--duration", "soon"], "soon"),
        (["--replay", "{logs}/small.bag", "--max-size", "much"], "is no size"),
        (["--replay", "{logs}/small.bag", "--split-duration", "0s"], "longer than no time"),
    ],
)
def test_options_that_make_no_sense_leave_no_store(
    logs: Path, tmp_path: Path, arguments: list[str], said: str
) -> None:
    store = tmp_path / "store"
    done = run("record", *(a.format(logs=logs) for a in arguments), store=store, code=2)
    assert said in done.err, done.err
    assert not store.exists()
