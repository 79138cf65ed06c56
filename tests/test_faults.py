"""What is killed, filled up, lost or altered: nothing stored may be lost, nothing be wrong."""

from __future__ import annotations

import os
import resource
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pymongo
import pytest

import hybridlog as hl
from benchmarks.simulator.topics import RobotConfig
from benchmarks.simulator.write import write_bag
from hybridlog_storage.errors import DatabaseError, StoreError
from hybridlog_storage.messages import Channel
from hybridlog_storage.mongo.index_documents import RECORDINGS
from hybridlog_storage.mongo.mongod import EmbeddedMongod
from tests import places
from tests.cli.running import run
from tests.indexed import misindexed
from tests.limits import Limit
from tests.waiting import wait_for

pytestmark = pytest.mark.mongo("embedded")

# Logs and stores.


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """About 5 MB of the simulated robot."""
    return write_bag(tmp_path_factory.mktemp("robot") / "robot.bag", duration_s=3.0).path


@pytest.fixture
def path(tmp_path: Path) -> Iterator[Path]:
    """A store without recordings, whose mongod runs throughout the test."""
    place = tmp_path / "store"
    with hl.open(place, create=True, require_database=True):
        yield place


# MongoDB that is killed.


def kill_mongod(store: Path) -> None:
    """End the mongod of this store, as its own record names it, and nothing else."""
    pid = int((store / "mongod/data/mongod.lock").read_text())
    command = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
    assert bytes(store / "mongod" / "data") in command
    os.kill(pid, signal.SIGKILL)


# A disk that is full.


def at_most(limit: int) -> Callable[[], None]:
    """Files of the process may not grow beyond this, as on a full disk."""

    def set_limit() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    return set_limit


def test_a_disk_that_fills_up(path: Path, robot: Path) -> None:
    # Where files may not grow, Python would cut short what it compiles.
    limited: Any = {"before": at_most(2_000_000), "PYTHONDONTWRITEBYTECODE": "1"}
    done = run("record", robot, "--quiet", store=path, code=7, **limited)
    assert "No space left" in done.err
    with hl.open(path, require_database=True) as store:
        assert store.recordings() == []
        assert places.folders(path) == []
        assert store.shared.index.reached() is not None
        for name in {*store.shared.index.reached().list_collections()} - {"hybridlog.store"}:
            assert store.shared.index.reached().count(name, {}) == 0, name
        assert not store.shared.repairs.recovered
    run("record", robot, "--quiet", store=path, code=0)


# An index that is altered behind our back.


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    """One store for all alterations: each test ends with a sound index."""
    place = tmp_path_factory.mktemp("shared")
    config = RobotConfig(image_size=(64, 48), cloud_columns=20, scan_beams=180)
    write_bag(place / "short.bag", duration_s=2.0, config=config)
    with hl.open(place / "store", create=True) as opened:
        opened.record(place / "short.bag")
        yield opened


@contextmanager
def altered(store: hl.Store) -> Iterator[Any]:
    """The database of a store, by another client."""
    uri = EmbeddedMongod(store.directory.mongod).start()
    database = store.shared.index.reached()
    assert database is not None
    with pymongo.MongoClient[dict[str, Any]](uri) as client:
        yield client[database.name]


def test_an_altered_index_is_mended_by_a_rebuild(shared: hl.Store) -> None:
    good = {"_meta.rec": shared.entry("short").key}
    for alter in (
        lambda db: db["imu__data"].delete_one(good),
        lambda db: db["imu__data"].update_one(good, {"$set": {"_meta.rec": "other"}}),
        lambda db: db["imu__data"].insert_one(
            {**db["imu__data"].find_one(good), "_id": b"\xff" * 24}
        ),
        lambda db: db["imu__data"].update_one(good, {"$set": {"_meta.rec": {"a": 1}}}),
        lambda db: db["imu__data"].update_one(good, {"$unset": {"_meta": 1}}),
        lambda db: db.drop_collection("base__scan"),
    ):
        before = misindexed(shared)
        with altered(shared) as database:
            alter(database)
        assert misindexed(shared) != before
    shared.index.rebuild()
    assert misindexed(shared) == {}


@pytest.mark.parametrize(
    "alter",
    [
        lambda db: db[RECORDINGS].update_one({}, {"$set": {"segments.0": "x"}}),
        lambda db: db[RECORDINGS].update_one({}, {"$unset": {"segments": 1}}),
        lambda db: db.drop_collection(RECORDINGS),
        lambda db: db[RECORDINGS].insert_one({"_id": "0" * 16, "segments": {}}),
    ],
    ids=["digest", "state-deleted", "dropped", "stranger"],
)
def test_what_the_index_says_of_itself_is_put_right_by_the_next_who_connects(
    shared: hl.Store, alter: Callable[[Any], Any]
) -> None:
    with altered(shared) as database:
        found = database[RECORDINGS]
        before = list(found.find({}))
        alter(database)
        assert list(found.find({})) != before
        if found.count_documents({}) == len(before):
            # All that alters the index notes first that it is not known to be whole.
            shared.shared.catalog.put_indexed([entry.id for entry in shared.recordings()], "")
        with hl.open(shared.directory.path, require_database=True) as opened:
            opened.shared.index.connect()
            assert list(found.find({})) == before
            assert misindexed(opened) == {}


# Several at once.


def test_reindex_does_not_cost_a_running_recording_its_index(shared: hl.Store) -> None:
    said = Channel("/said", "json", None)
    with shared.start("live", flush_interval_s=0.05) as recording:
        for number in range(50):
            recording.write(said, b'{"n": %d}' % number)
        wait_for(lambda: not recording.lag)
        with hl.open(shared.directory.path, require_database=True) as other:
            with pytest.raises(StoreError, match="being written"):
                other.index.rebuild(["live"])
            assert [entry.name for entry in other.index.rebuild()] == ["short"]
    shared.refresh()
    assert misindexed(shared) == {}


@pytest.mark.parametrize("short_s", [0.0, 60.0], ids=["process", "here"])
def test_mongod_killed_and_not_to_be_had_again(
    tmp_path: Path, robot: Path, monkeypatch: pytest.MonkeyPatch, limit: Limit, short_s: float
) -> None:
    """Whoever follows the recording: a process, or its own at the end."""
    limit(short_recording_s=short_s)
    place, killed = tmp_path / "store", list[int]()

    def progress(_done: int, messages: int) -> None:
        if messages > 200 and not killed:
            killed.append(messages)
            monkeypatch.setenv("HYBRIDLOG_MONGOD", "/bin/false")
            kill_mongod(place)

    with hl.open(place, create=True, require_database=True) as store:
        if not short_s:
            progress(0, 1 << 30)  # the process finds none
        report = store.record(robot, progress=progress)
        assert isinstance(report.failure, DatabaseError)
        assert report.missed > 0
        assert report.indexed + report.missed == report.entry.messages
        assert len([*store.all_topics()]) == report.entry.messages  # of the segments
    monkeypatch.delenv("HYBRIDLOG_MONGOD")
    with hl.open(place, require_database=True) as store:
        assert store.shared.repairs.indexed["robot"] > 0
        assert misindexed(store) == {}
