"""The primary of a replica set is killed: nothing is lost, and questions go on."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from itertools import count
from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog_storage.mongo.database import Database
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests import logs
from tests.calls import Calls
from tests.indexed import misindexed
from tests.limits import Limit
from tests.servers.commands import commands
from tests.servers.mongods import Mongod, ReplicaSet, eventually, replica_set

pytestmark = pytest.mark.mongo("embedded")

NUMBERS = count()
MESSAGES = 4000  # of each of three topics
KILLED_AT = 3  # inserts


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ReplicaSet]:
    with replica_set(tmp_path_factory.mktemp("set")) as found:
        yield found


@pytest.fixture
def members(running: ReplicaSet) -> ReplicaSet:
    running.heal()
    return running


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return logs.write(tmp_path_factory.mktemp("log") / "a.mcap", logs.content(0, MESSAGES))


@pytest.fixture
def store(members: ReplicaSet, tmp_path: Path) -> Iterator[hl.Store]:
    uri = members.uri(f"store{next(NUMBERS)}")
    with hl.open(tmp_path / "store", create=True, mongo=uri, require_database=True) as opened:
        yield opened


def check(store: hl.Store, messages: int) -> None:
    """All messages are in the index, byte for byte."""
    assert misindexed(store) == {}
    assert store.all_topics().count() == messages


@pytest.fixture
def killing(members: ReplicaSet, calls: Calls) -> list[str]:
    """The primary is killed when some documents are on their way; collections of all inserts."""
    inserts: list[str] = []

    def counted(_: Database, collection: str, *__: object, **___: object) -> None:
        inserts.append(collection)
        if len(inserts) == KILLED_AT:
            members.kill_primary()

    calls(Database, "_insert_batch", counted)
    return inserts


def test_killed_while_a_log_is_recorded(
    store: hl.Store, log: Path, killing: list[str], limit: Limit
) -> None:
    limit(inserted_documents=MESSAGES // 4)
    database = store.shared.index.reached()
    report = store.record(log, settings=SegmentSettings(chunk_size=1 << 12))
    assert len(killing) > KILLED_AT
    assert report.failure is None
    assert report.missed == 0
    assert store.shared.index.reached() is database, "indexing has not gone on, but was begun again"
    check(store, 3 * MESSAGES)


def test_the_state_of_the_index_cannot_be_rolled_back(members: ReplicaSet, tmp_path: Path) -> None:
    """It is read as a majority has it, before and after what is asked of documents."""
    log = logs.write(tmp_path / "a.mcap", logs.content(0, 10))
    uri = members.uri(f"store{next(NUMBERS)}", "&readPreference=secondary&w=1")
    with hl.open(tmp_path / "store", create=True, mongo=uri, require_database=True) as store:
        store.record(log)
    with hl.open(tmp_path / "store", mongo=uri) as store, commands() as sent:
        assert store.topic("/number").where({"n": {"$gt": 3}}).count() == 6
    # The number of recordings is a hint at what to look at, and decides nothing.
    own = ("number", "hybridlog.recordings")
    asked = [one for one in sent if one.collection in own and one != ("aggregate", own[1], "local")]
    assert {one.read for one in asked if one.collection == own[1]} == {"majority"}
    documents = [n for n, one in enumerate(asked) if one.collection == own[0]]
    assert documents
    assert asked[documents[0] - 1].collection == asked[documents[-1] + 1].collection == own[1]


def test_what_only_the_primary_had_is_not_lost(
    members: ReplicaSet, log: Path, tmp_path: Path, calls: Calls
) -> None:
    """Writes that are acknowledged by the primary alone, as the URI wants, are taken back."""
    uri = members.uri("weak", "&w=1")
    killer: list[threading.Thread] = []

    def kill_when_written(primary: Mongod, collection: str) -> None:
        alone = f"mongodb://{primary.address}/weak?directConnection=true"
        with Database.connect(alone) as old:
            eventually(lambda: old.count(collection), "nothing is written")
        primary.kill()
        members.resume()

    def alone(_: Database, collection: str, *__: object, **___: object) -> None:
        if not killer:
            primary = members.stop_secondaries()
            killer.append(threading.Thread(target=kill_when_written, args=(primary, collection)))
            killer[0].start()

    with hl.open(tmp_path / "store", create=True, mongo=uri, require_database=True) as store:
        calls(Database, "_insert_batch", alone)
        report = store.record(log)
        killer[0].join()
        assert report.failure is None
        check(store, 3 * MESSAGES)
        members.heal()  # the old primary takes back what it had alone
        check(store, 3 * MESSAGES)
