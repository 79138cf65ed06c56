"""Connections that are reset in the middle of commands: repeated, or one sentence."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count
from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog_storage.errors import DatabaseError
from tests import logs
from tests.indexed import misindexed
from tests.servers.mongods import Mongod
from tests.servers.proxy import Proxy
from tests.some import each

pytestmark = pytest.mark.mongo("embedded")

NUMBERS = count()
MESSAGES = 900


@pytest.fixture(scope="module")
def way(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Proxy]:
    with Mongod(tmp_path_factory.mktemp("mongod")) as server, Proxy(server.port) as found:
        yield found


@pytest.fixture
def uri(way: Proxy) -> Iterator[str]:
    way.reset_after = way.resets = 0
    yield f"mongodb://127.0.0.1:{way.port}/store{next(NUMBERS)}"
    way.reset_after = 0


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return logs.write(tmp_path_factory.mktemp("log") / "a.mcap", logs.content(0, MESSAGES))


RAW = {"n": {"$gte": 10}}


def test_answers_go_on_behind_a_reset(way: Proxy, uri: str, log: Path, tmp_path: Path) -> None:
    path = tmp_path / "store"
    with hl.open(path, create=True, mongo=uri, require_database=True) as store:
        store.record(log)
        query = store.topic("/number").where(RAW)
        way.reset_after = 150_000  # bytes: an answer, but not the next one
        for _ in range(3):
            assert [m.fields["n"] for m in query] == list(range(10, MESSAGES))
            assert query.count() == MESSAGES - 10
        assert way.resets
        way.reset_after = 0
        assert misindexed(store) == {}


@pytest.mark.parametrize("after", [700, *each(1, 3000)])
def test_resets_at_any_time(way: Proxy, uri: str, log: Path, tmp_path: Path, after: int) -> None:
    path = tmp_path / "store"
    with hl.open(path, create=True, mongo=uri, require_database=True) as store:
        store.record(log)
    way.reset_after = after
    ask = f"{uri}?serverSelectionTimeoutMS=300"
    try:
        with hl.open(path, mongo=ask, require_database=True) as store:
            assert store.topic("/number").where(RAW).count() == MESSAGES - 10
            assert sum(1 for _ in store.topic("/number").where(RAW)) == MESSAGES - 10
    except DatabaseError as error:
        said = str(error)
        assert "does not answer" in said
        assert "Traceback" not in said
        assert len(said) < 400, said
    assert way.resets
    way.reset_after = 0
    with hl.open(path, mongo=uri, require_database=True) as store:
        assert store.topic("/number").where(RAW).count() == MESSAGES - 10
        assert misindexed(store) == {}


def test_recording_over_a_way_that_breaks(way: Proxy, uri: str, log: Path, tmp_path: Path) -> None:
    with hl.open(tmp_path / "store", create=True, mongo=uri, require_database=True) as store:
        way.reset_after = 2500
        report = store.record(log)
        assert report.entry.messages == 3 * MESSAGES
        assert way.resets
        way.reset_after = 0
        assert misindexed(store) == {}
