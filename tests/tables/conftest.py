"""A store with tables."""

from __future__ import annotations

import secrets
from collections.abc import Iterator
from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog_storage.mongo.mongod import EmbeddedMongod
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests.tables.logs import BASE, varied, write_log

SMALL_CHUNKS = SegmentSettings(chunk_size=4096)


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A MongoDB for all stores."""
    with EmbeddedMongod(tmp_path_factory.mktemp("server") / "mongod") as user:
        yield user.start()


@pytest.fixture
def store(tmp_path: Path, server: str) -> Iterator[hl.Store]:
    mongo = server.replace("/?", f"/t{secrets.token_hex(6)}?")
    with hl.open(tmp_path / "store", create=True, mongo=mongo, require_database=True) as opened:
        yield opened


@pytest.fixture
def recorded(store: hl.Store, tmp_path: Path) -> hl.Store:
    """A recording of three topics, one of them with a file of its own."""
    topics = ["/large", "/large", "/large", "/small/one", "/large", "/small/two"]
    said = [(BASE + n * 11 // 3, topics[n % 6], varied(n)) for n in range(1800)]
    log = write_log(tmp_path / "log.mcap", said)
    store.record(log, name="log", settings=SegmentSettings(chunk_size=32 << 10))
    return store
