"""`hybridlog open`, in a process of its own."""

from __future__ import annotations

import signal
import socket
from pathlib import Path

import pytest

pytest.importorskip("websockets", reason="websockets is not installed: no playback is tested")

from tests.independent import Seen, read_bag
from tests.view.viewer import Viewer
from tests.waiting import wait_for

from .running import run, started


def test_it_plays_until_ctrl_c(logs: Path, store: Path, tmp_path: Path) -> None:
    output = tmp_path / "output"
    command = ("open", "/imu/data", "/map", "-r", "robot", "--store", store)
    with started(*command, "--port", 0, "--speed", 100, output=output) as process:
        wait_for(lambda: "Ctrl-C ends it." in output.read_text())
        lines = output.read_text().splitlines()
        address = lines[0]
        assert lines[1] == f"Foxglove or Lichtblick: Open connection, {address}. Ctrl-C ends it."
        with Viewer(address) as viewer:
            viewer.subscribe()
            found = viewer.until_end()
            process.send_signal(signal.SIGINT)
            assert process.wait(30) == 0
    wanted = [m for m in read_bag(logs / "robot.bag") if m.topic in {"/imu/data", "/map"}]
    assert [Seen(*m) for m in found] == wanted
    assert output.read_text().splitlines() == lines


def test_wrong_ways(store: Path) -> None:
    assert "0.01<=x<=100" in run("open", "--speed", 0, store=store, code=2).err
    assert "nothing" in run("open", "nothing", store=store, code=2).err
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        done = run("open", "/map", "-r", "robot", "--port", port, store=store, code=2)
    assert f"Port {port} is in use" in done.err
    assert done.out == ""
