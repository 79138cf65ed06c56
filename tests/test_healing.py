"""What a store derives from its recordings may be damaged in any way: it is made again."""

from __future__ import annotations

import contextlib
import random
import resource
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from pymongo import MongoClient

import hybridlog as hl
from benchmarks.simulator.write import write_bag
from benchmarks.usage import working_below
from hybridlog.index import access
from hybridlog_storage.cells import CATALOG
from hybridlog_storage.errors import (
    DatabaseError,
    ResourceError,
)
from hybridlog_storage.mongo.database import Database
from tests.calls import Calls
from tests.cli.running import run
from tests.indexed import EVERYTHING, misindexed
from tests.servers.mongods import Mongod, free_port
from tests.test_faults import kill_mongod
from tests.waiting import wait_for

pytestmark = pytest.mark.mongo("embedded")

TOPICS = ["/imu/data", "/base/scan", "/joint_states"]
IMU, SCAN = TOPICS[:2]
WHERE = "header.seq >= 100"
NOWHERE = "mongodb://127.0.0.1:1/none?serverSelectionTimeoutMS=1"


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with two recordings, whose mongod has ended."""
    base = tmp_path_factory.mktemp("healing")
    for number, name in enumerate(("one", "two")):
        write_bag(base / f"{name}.bag", duration_s=2, seed=number, topics=TOPICS)
    with hl.open(base / "store", create=True) as store:
        for name in ("one", "two"):
            store.record(base / f"{name}.bag")
    ended(base / "store")
    return base / "store"


@pytest.fixture
def store(template: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(template, tmp_path / "store"))


def ended(store: Path) -> None:
    wait_for(lambda: not working_below(store / "mongod", ""))


def documents(store: hl.Store) -> list[int]:
    """What only the index can answer."""
    return [store.topic(topic).where(EVERYTHING).count() for topic in TOPICS]


# --- damaged data files ---


def test_damaged_data_files_are_told_and_what_is_removed_is_made_again(store: Path) -> None:
    with hl.open(store) as opened:
        want = documents(opened)
    ended(store)
    turtle = store / "mongod/data/WiredTiger.turtle"  # without which mongod does not start
    turtle.write_bytes(random.Random(1).randbytes(turtle.stat().st_size))
    said = run("index", "rebuild", store=store, code=6).err
    assert f"remove {store / 'mongod'}, and the index is made again" in said
    assert hl.open(store).topic(IMU).where(WHERE).count() > 0
    shutil.rmtree(store / "mongod")
    run("index", "rebuild", store=store)
    with hl.open(store) as opened:
        assert documents(opened) == want


# --- a mongod that ends ---


@contextlib.contextmanager
def other_mongod(tmp_path: Path, *options: str, port: int | None = None) -> Iterator[str]:
    """The URI of a mongod that is not the store's own, on the loopback interface."""
    with Mongod(tmp_path / "other", *options, port=port) as server:
        uri = f"mongodb://{server.address}/healing?directConnection=true"
        with MongoClient(uri, serverSelectionTimeoutMS=30000) as client:
            client.admin.command("ping")
        yield uri
        server.stop()


def test_work_goes_on_though_its_mongod_was_killed(template: Path, store: Path) -> None:
    with hl.open(store, require_database=True) as opened:
        want = documents(opened)
        kill_mongod(store)
        ended(store)
        assert documents(opened) == want
        kill_mongod(store)
        opened.index.rebuild()
        kill_mongod(store)
        ended(store)
        assert opened.edit("one", name="first").name == "first"
        report = opened.record(template.parent / "one.bag", again=True, name="three")
        assert report.indexed == report.entry.messages > 0
        kill_mongod(store)
        opened.remove("first")
        opened.verify(repair=True)
        opened.shared.index.connect()
        assert misindexed(opened) == {}


def test_an_unreachable_server_is_not_waited_for_by_each_question(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, calls: Calls
) -> None:
    tried = calls(Database, "connect")
    port = free_port()
    uri = f"mongodb://127.0.0.1:{port}/healing?directConnection=true&serverSelectionTimeoutMS=100"
    with hl.open(store, mongo=uri) as opened:
        for _ in range(3):
            with pytest.raises(DatabaseError, match="does not answer"):
                documents(opened)
            assert opened.topic(IMU).where(WHERE).count() > 0
        assert len(tried) == 1
        # When that is some time ago, the next question tries again.
        later = SimpleNamespace(monotonic=lambda: time.monotonic() + 1e9, sleep=time.sleep)
        monkeypatch.setattr(access, "time", later)
        with other_mongod(tmp_path, port=port):
            assert sum(documents(opened)) == 0  # nothing is indexed there
            assert len(tried) == 2


def test_an_index_deleted_under_an_open_store(store: Path) -> None:
    with hl.open(store, require_database=True) as opened:
        want = documents(opened)
        while (store / "mongod").exists():  # the keeper writes and removes files meanwhile
            shutil.rmtree(store / "mongod", ignore_errors=True)
        ended(store)  # its keeper notices
        assert sum(documents(opened)) == 0
        opened.shared.index.connect()
        assert documents(opened) == want
        assert sorted(opened.shared.repairs.indexed) == ["one", "two"]


# --- handles, roles ---


@pytest.fixture
def reader(tmp_path: Path) -> Iterator[tuple[str, str]]:
    """URIs of users of one database who may write and who may only read."""
    with other_mongod(tmp_path) as uri, MongoClient(uri) as client:
        for name, role in (("writer", "readWrite"), ("reader", "read")):
            roles = [{"role": role, "db": "healing"}]
            client["healing"].command("createUser", name, pwd="secret", roles=roles)
    with other_mongod(tmp_path, "--auth") as uri:
        yield (
            uri.replace("//", "//writer:secret@"),
            uri.replace("//", "//reader:secret@"),
        )


def test_a_user_who_may_only_read_can_ask_everything(
    store: Path, reader: tuple[str, str], tmp_path: Path
) -> None:
    """Of an index that is complete; what it lacks is for one who may write."""
    writes, reads = reader
    with hl.open(store, mongo=reads) as empty:
        assert empty.topic(IMU).where(WHERE).count() > 0
        with pytest.raises(DatabaseError, match="the role readWrite"):
            documents(empty)
    with hl.open(store, mongo=writes, require_database=True) as opened:
        want = documents(opened)
        assert all(want)
    with hl.open(store, mongo=reads, require_database=True) as opened:
        assert documents(opened) == want
        assert misindexed(opened) == {}
        for change in (
            opened.index.rebuild,
            lambda: opened.index.add(IMU, "header.seq"),
        ):
            with pytest.raises(DatabaseError, match="the role readWrite"):
                change()
        write_bag(tmp_path / "three.bag", duration_s=1, seed=3, topics=TOPICS)
        assert "the role readWrite" in str(opened.record(tmp_path / "three.bag").failure)
        assert opened.topic(IMU).where(WHERE).count() > 0
        with pytest.raises(DatabaseError, match="the role readWrite"):
            hl.open(store, mongo=reads, require_database=True)
        opened.remove("three")


def test_a_store_without_handles_is_not_a_damaged_one(store: Path) -> None:
    def ask() -> tuple[int, int]:
        (store / CATALOG).unlink(missing_ok=True)
        with hl.open(store, mongo=NOWHERE) as opened:
            return len(opened.recordings()), opened.topic(SCAN).where("ranges < 1").count()

    want = ask()
    used = {int(path.name) for path in Path("/proc/self/fd").iterdir()}
    spare = [number for number in range(1000) if number not in used]
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    failures, answers = list[str](), 0
    # Threads of other tests in this process may take some of the handles.
    for limit in spare[:100]:
        resource.setrlimit(resource.RLIMIT_NOFILE, (limit, before[1]))
        try:
            assert ask() == want
            answers += 1
        except ResourceError as error:
            failures.append(str(error))
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, before)
        if answers == 3:
            break
    assert answers == 3
    assert failures
    assert all("ulimit -n" in failure for failure in failures)
    assert run("verify", store=store).err == ""
