"""A store of one recording."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

import hybridlog as hl
from tests.payloads.logs import SETTINGS, robot, write_log


@pytest.fixture(scope="session")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store of one recording."""
    path = tmp_path_factory.mktemp("plain")
    log = write_log(path / "log.mcap", robot())
    with hl.open(path / "store", create=True) as store:
        store.record(log, name="log", settings=SETTINGS)
    return path / "store"


@pytest.fixture
def copy(plain: Path, tmp_path: Path) -> Path:
    """A copy that a test may change."""
    shutil.copytree(plain, tmp_path / "store")
    return tmp_path / "store"
