"""Stores with and without columns."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

import hybridlog as hl
from tests.payloads.logs import SETTINGS, robot, write_log


@pytest.fixture(scope="session")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store of one recording, without columns."""
    path = tmp_path_factory.mktemp("plain")
    log = write_log(path / "log.mcap", robot())
    with hl.open(path / "store", create=True) as store:
        store.record(log, name="log", settings=SETTINGS)
    shutil.rmtree(path / "store" / "mongod")
    return path / "store"


@pytest.fixture
def copy(plain: Path, tmp_path: Path) -> Path:
    """A store without columns that a test may change."""
    shutil.copytree(plain, tmp_path / "store")
    return tmp_path / "store"
