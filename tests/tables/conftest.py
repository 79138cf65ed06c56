"""A store with tables."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog_storage.segments.segment_writer import SegmentSettings
from hybridlog_storage.settings import NONE
from tests.tables.logs import BASE, varied, write_log

SMALL_CHUNKS = SegmentSettings(chunk_size=4096)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[hl.Store]:
    with hl.open(tmp_path / "store", create=True, mongo=NONE) as opened:
        yield opened


@pytest.fixture
def indexed(tmp_path: Path, mongo: str) -> Iterator[hl.Store]:
    """A store with an index in MongoDB."""
    with hl.open(tmp_path / "store", create=True, mongo=mongo, require_database=True) as opened:
        yield opened


@pytest.fixture(scope="session")
def recorded_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of three topics, one of them with a file of its own."""
    place = tmp_path_factory.mktemp("recorded")
    topics = ["/large", "/large", "/large", "/small/one", "/large", "/small/two"]
    said = [(BASE + n * 11 // 3, topics[n % 6], varied(n)) for n in range(1800)]
    log = write_log(place / "log.mcap", said)
    with hl.open(place / "store", create=True, mongo=NONE) as store:
        store.record(log, name="log", settings=SegmentSettings(chunk_size=32 << 10))
    return place / "store"


@pytest.fixture(scope="session")
def kept(recorded_once: Path) -> Iterator[hl.Store]:
    """The store with that recording, for tests that change nothing."""
    with hl.open(recorded_once, mongo=NONE, read_only=True) as store:
        yield store


@pytest.fixture
def recorded(recorded_once: Path, tmp_path: Path) -> Iterator[hl.Store]:
    """A store of its own with that recording, without MongoDB."""
    shutil.copytree(recorded_once, tmp_path / "store")
    with hl.open(tmp_path / "store", mongo=NONE) as store:
        yield store
