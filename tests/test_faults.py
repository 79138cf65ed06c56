"""What is killed, filled up, lost or altered: nothing stored may be lost, nothing be wrong."""

from __future__ import annotations

import os
import resource
import signal
import threading
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pymongo
import pytest

import hybridlog as hl
from benchmarks.simulator.topics import RobotConfig
from benchmarks.simulator.write import write_bag
from hybridlog_storage.errors import DatabaseError, StoreError
from hybridlog_storage.mongo.index_documents import RECORDINGS
from hybridlog_storage.mongo.mongod import EmbeddedMongod
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests import independent, places
from tests.cli.running import run
from tests.indexed import misindexed
from tests.limits import Limit

pytestmark = pytest.mark.mongo("embedded")

LIMIT_S = 120
Message = independent.Seen


# Logs and stores.


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """About 14 MB of the simulated robot."""
    path = tmp_path_factory.mktemp("robot") / "robot.bag"
    return write_bag(path, duration_s=8.0).path


@pytest.fixture(scope="module")
def spoken(robot: Path) -> dict[str, list[Message]]:
    """What the robot said, by topic, as `rosbags` reads it."""
    found: dict[str, list[Message]] = defaultdict(list)
    for message in independent.read_bag(robot):
        found[message.topic].append(message)
    return dict(found)


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seconds of a robot with small sensors."""
    path = tmp_path_factory.mktemp("short") / "short.bag"
    config = RobotConfig(image_size=(64, 48), cloud_columns=20, scan_beams=180)
    return write_bag(path, duration_s=2.0, config=config).path


@pytest.fixture(scope="module")
def said(short: Path) -> Counter[Message]:
    return Counter(independent.read_bag(short))


@pytest.fixture
def path(tmp_path: Path) -> Iterator[Path]:
    """A store without recordings, whose mongod runs throughout the test."""
    place = tmp_path / "store"
    with hl.open(place, create=True, require_database=True):
        yield place


@pytest.fixture
def store(path: Path, short: Path) -> Iterator[hl.Store]:
    """A store with the recording `short`, in several segments."""
    with hl.open(path, require_database=True) as opened:
        settings = SegmentSettings(chunk_size=16 << 10, segment_size=55_000, span_size=0)
        report = opened.record(short, settings=settings)
        assert report.entry.name == "short"
        assert report.entry.segments > 2
        yield opened


def fetched(store: hl.Store, recording: str) -> list[hl.Message]:
    entry = store.entry(recording)
    topics = sorted({c.topic for c in entry.channels})
    return list(store.query(topics, [entry.id])) if topics else []


def content(messages: list[hl.Message]) -> Counter[Message]:
    return Counter(Message(m.topic, m.log_time_ns, m.raw) for m in messages)


# MongoDB that is killed.


def kill_mongod(store: Path) -> None:
    """End the mongod of this store, as its own record names it, and nothing else."""
    pid = int((store / "mongod/data/mongod.lock").read_text())
    command = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
    assert bytes(store / "mongod" / "data") in command
    os.kill(pid, signal.SIGKILL)


def killing(place: Path, before: Callable[[], object] = bool) -> tuple[Any, list[int]]:
    """Progress of a log that kills mongod once, and the number of messages by then."""
    killed: list[int] = []

    def progress(_done: int, messages: int) -> None:
        if messages > 1000 and not killed:
            killed.append(messages)
            before()
            kill_mongod(place)

    return progress, killed


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
        for name in store.shared.index.reached().list_collections():
            if name not in {"hybridlog.store", "hybridlog.topics"}:
                assert store.shared.index.reached().count(name, {}) == 0, name
        assert not store.shared.repairs.recovered
    run("record", robot, "--quiet", store=path, code=0)


# An index that is altered behind our back.


@pytest.mark.parametrize(
    "alter",
    [
        lambda db: db["imu__data"].delete_one({}),
        lambda db: db["imu__data"].update_one({}, {"$set": {"_meta.rec": "other"}}),
        lambda db: db["imu__data"].insert_one(
            {**db["imu__data"].find_one({}), "_id": b"\xff" * 24}
        ),
        lambda db: db["imu__data"].update_one({}, {"$set": {"_meta.rec": {"a": 1}}}),
        lambda db: db["imu__data"].update_one({}, {"$unset": {"_meta": 1}}),
        lambda db: db.drop_collection("base__scan"),
    ],
    ids=[
        "deleted", "wrong-recording", "no-recording", "no-meta", "doubled",
        "collection-dropped",
    ],
)  # fmt: skip
def test_an_altered_index_is_mended_by_a_rebuild(
    shared: hl.Store, alter: Callable[[Any], Any]
) -> None:
    store = shared
    uri = EmbeddedMongod(store.directory.mongod).start()
    assert store.shared.index.reached() is not None
    with pymongo.MongoClient[dict[str, Any]](uri) as client:
        alter(client[store.shared.index.reached().name])
    assert misindexed(store) != {}
    store.index.rebuild()
    assert misindexed(store) == {}


@pytest.mark.parametrize(
    "alter",
    [
        lambda db: db[RECORDINGS].update_one({}, {"$set": {"segments.0": "x"}}),
        lambda db: db[RECORDINGS].update_one({}, {"$unset": {"segments": 1}}),
        lambda db: db[RECORDINGS].delete_one({}),
        lambda db: db.drop_collection(RECORDINGS),
        lambda db: db[RECORDINGS].insert_one({"_id": "0" * 16, "segments": {}}),
    ],
    ids=["digest", "state-deleted", "deleted", "dropped", "stranger"],
)
def test_what_the_index_says_of_itself_is_put_right_by_the_next_who_connects(
    shared: hl.Store, said: Counter[Message], alter: Callable[[Any], Any]
) -> None:
    uri = EmbeddedMongod(shared.directory.mongod).start()
    assert shared.shared.index.reached() is not None
    with pymongo.MongoClient[dict[str, Any]](uri) as client:
        found = client[shared.shared.index.reached().name][RECORDINGS]
        before = list(found.find({}))
        alter(client[shared.shared.index.reached().name])
        assert list(found.find({})) != before
        if found.count_documents({}) == len(before):
            # All that alters the index notes first that it is not known to be whole.
            shared.shared.catalog.put_indexed([entry.id for entry in shared.recordings()], "")
        with hl.open(shared.directory.path, require_database=True) as opened:
            everything = opened.all_topics().where("_meta.seq >= 0")
            assert everything.count() == said.total()
            assert list(found.find({})) == before
            assert misindexed(opened) == {}


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory, short: Path) -> Iterator[hl.Store]:
    """One store for all alterations: each test ends with a sound index."""
    with hl.open(tmp_path_factory.mktemp("shared") / "store", create=True) as opened:
        opened.record(short)
        yield opened


# Several at once.


class Writing:
    """A recording held half way, as another process sees it."""

    def __init__(self, path: Path, log: Path, **choices: Any) -> None:
        self.entered, self.go = threading.Event(), threading.Event()
        self.result: list[object] = []
        self._thread = threading.Thread(target=self._record, args=(path, log, choices))

    def _record(self, path: Path, log: Path, choices: dict[str, Any]) -> None:
        def progress(_done: int, messages: int) -> None:
            if messages > 200 and not self.entered.is_set():
                self.entered.set()
                self.go.wait(LIMIT_S)

        try:
            with hl.open(path, require_database=True) as store:
                self.result.append(store.record(log, progress=progress, **choices))
        except Exception as error:
            self.result.append(error)
        finally:
            self.entered.set()

    def __enter__(self) -> Writing:
        self._thread.start()
        assert self.entered.wait(LIMIT_S)
        assert not self.result, self.result
        return self

    def __exit__(self, *_: object) -> None:
        self.go.set()
        self._thread.join(LIMIT_S)


def test_reindex_does_not_cost_a_running_recording_its_index(
    path: Path, robot: Path, short: Path, said: Counter[Message]
) -> None:
    with hl.open(path, require_database=True) as store:
        store.record(short)
    with Writing(path, robot) as writing, hl.open(path, require_database=True) as store:
        with pytest.raises(StoreError, match="being written"):
            store.index.rebuild(["robot"])
        assert [entry.name for entry in store.index.rebuild()] == ["short"]
        assert content(fetched(store, "short")) == said
    (report,) = writing.result
    assert not isinstance(report, Exception), report
    with hl.open(path, require_database=True) as store:
        assert misindexed(store) == {}


def test_while_the_index_is_made_anew_others_answer_as_always(
    store: hl.Store, short: Path, said: Counter[Message]
) -> None:
    store.record(short, again=True, name="zz")
    asked = 0
    topics = sorted({one.topic for one in said})
    with hl.open(store.directory.path) as other:

        def ask(label: str, _done: int, _total: int) -> None:
            nonlocal asked
            asked += 1
            if asked % 7 == 1:
                for name in ("short", "zz"):
                    query = other.query(topics, [name])
                    assert query.count() == said.total(), (label, name)
                    query = query.where("_meta.seq >= 0")
                    assert query.count() == said.total(), (label, name)

        store.index.rebuild(progress=ask)
        assert asked > 14
    assert misindexed(store) == {}


@pytest.mark.parametrize("short_s", [0.0, 60.0], ids=["process", "here"])
def test_mongod_killed_and_not_to_be_had_again(
    tmp_path: Path,
    robot: Path,
    spoken: dict[str, list[Message]],
    monkeypatch: pytest.MonkeyPatch,
    limit: Limit,
    short_s: float,
) -> None:
    """Whoever follows the recording: a process, or its own at the end."""
    limit(short_recording_s=short_s)
    place = tmp_path / "store"
    progress, _ = killing(place, lambda: monkeypatch.setenv("HYBRIDLOG_MONGOD", "/bin/false"))
    whole = Counter(m for part in spoken.values() for m in part)
    with hl.open(place, create=True, require_database=True) as store:
        if not short_s:
            progress(0, 1 << 30)  # the process finds none
        report = store.record(robot, progress=progress)
        assert isinstance(report.failure, DatabaseError)
        assert report.missed > 0
        assert report.indexed + report.missed == report.entry.messages == whole.total()
        # By time it can be fetched even now, out of the segments alone.
        assert content(fetched(store, "robot")) == whole
    monkeypatch.delenv("HYBRIDLOG_MONGOD")
    with hl.open(place, require_database=True) as store:
        assert store.shared.repairs.indexed["robot"] > 0
        assert misindexed(store) == {}
        assert store.topic("/imu/data").where("_meta.t > 0").count() == len(spoken["/imu/data"])
