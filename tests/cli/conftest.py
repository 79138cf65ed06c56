"""One store for all tests that only look, and logs to record."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.simulator.write import write_bag

from . import odd_log
from .running import run

DURATION_S = 6.0


@pytest.fixture(scope="session")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with `robot.bag`, `small.bag`, `odd.mcap` and a damaged `torn.bag`."""
    directory = tmp_path_factory.mktemp("logs")
    write_bag(directory / "robot.bag", duration_s=DURATION_S)
    small = ["/imu/data", "/joint_states", "/tf", "/base/scan"]
    write_bag(directory / "small.bag", duration_s=5, seed=2, topics=small)
    whole = (directory / "small.bag").read_bytes()
    (directory / "torn.bag").write_bytes(whole[: len(whole) * 3 // 5])
    odd_log.write(directory / "odd.mcap")
    return directory


@pytest.fixture(scope="session")
def store(logs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with `robot`, `odd` and the damaged `torn`, without MongoDB. Not to be changed."""
    path = tmp_path_factory.mktemp("shared") / "store"
    no_index = ("--mongo", "none", "--quiet")
    run("record", logs / "robot.bag", "--set-tag", "place=lab", *no_index, store=path)
    run("record", logs / "odd.mcap", *no_index, store=path)
    run("record", logs / "torn.bag", *no_index, store=path, code=4)
    return path


@pytest.fixture
def fresh(logs: Path, tmp_path: Path) -> Path:
    """A store with `small`, to be changed."""
    path = tmp_path / "store"
    run("record", logs / "small.bag", "--quiet", store=path)
    return path
