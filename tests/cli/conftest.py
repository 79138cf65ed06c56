"""One store for all tests that only look, and logs to record."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog.demo.write import write_bag

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
def store(logs: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A store with `robot`, `odd` and the damaged `torn`. Not to be changed."""
    path = tmp_path_factory.mktemp("shared") / "store"
    run("record", logs / "robot.bag", "--set-tag", "place=lab", "--quiet", store=path)
    run("record", logs / "odd.mcap", "--quiet", store=path)
    run("record", logs / "torn.bag", "--quiet", store=path, code=4)
    # While this is open, no command has to start mongod anew.
    with hl.open(path, require_database=True):
        yield path


@pytest.fixture
def fresh(logs: Path, tmp_path: Path) -> Iterator[Path]:
    """A store with `small`, to be changed."""
    path = tmp_path / "store"
    run("record", logs / "small.bag", "--quiet", store=path)
    with hl.open(path, require_database=True):
        yield path
