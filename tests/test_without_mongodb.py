"""Recording without MongoDB, and what is made of it where MongoDB is."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

import hybridlog as hl
from benchmarks.simulator.write import write_bag
from hybridlog_storage.errors import (
    ConnectionLostError,
    DatabaseError,
    StoreError,
    WithoutMongoError,
)
from hybridlog_storage.mongo.index_documents import IndexState
from hybridlog_storage.segments.segment_reader import SegmentReader
from hybridlog_storage.segments.segment_writer import SegmentSettings
from hybridlog_storage.settings import (
    EMBEDDED,
    NAME,
    NONE,
    StoreSettings,
    read_settings,
    write_settings,
)
from tests.calls import Calls
from tests.cli.within import answer
from tests.indexed import misindexed
from tests.running.running import NO_MONGODB

pytestmark = pytest.mark.mongo("embedded")

TOPICS = ("/imu/data", "/base/scan", "/tf")
SMALL = SegmentSettings(chunk_size=8192, segment_size=80_000)


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bags") / "robot.bag"
    write_bag(path, duration_s=2.0, topics=[*TOPICS])
    return path


@pytest.fixture(scope="module")
def stores(bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, hl.Store]]:
    """One recording, without MongoDB and with it."""
    path = tmp_path_factory.mktemp("stores")
    opened = {mongo: hl.open(path / mongo, create=True, mongo=mongo) for mongo in (NONE, EMBEDDED)}
    for store in opened.values():
        report = store.record(bag, settings=SMALL)
        assert (report.failure, report.missed) == (None, 0)
        assert report.indexed == (0 if store is opened[NONE] else report.entry.messages)
    yield opened
    for store in opened.values():
        store.close()


def test_what_only_mongodb_can_is_refused(stores: dict[str, hl.Store]) -> None:
    store = stores[NONE]
    for ask in (
        lambda: store.topic("scan").where({"header.seq": {"$gt": 3}}).count(),
        lambda: list(store.topic("scan").where({"range_max": 1})),
        store.index.list,
        store.index.rebuild,
        store.shared.index.connect,
    ):
        with pytest.raises(DatabaseError, match=r"without MongoDB.*--mongo embedded"):
            ask()
    assert isinstance(store.shared.index.unavailable, WithoutMongoError)
    assert store.verify().findings == []
    assert store.shared.index.place == "none"


@pytest.mark.parametrize("way", ["option", "variable", "settings"])
def test_the_ways_to_say_so(
    way: str, bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "store"
    words: tuple[str, ...] = ()
    if way == "option":
        words = ("--mongo", NONE)
    elif way == "variable":
        monkeypatch.setenv("HYBRIDLOG_MONGO_URI", NONE)
    else:
        hl.open(path, create=True).close()
        before = read_settings(path)
        write_settings(path, StoreSettings(before.store_id, NONE))
        assert 'mongo = "none"' in (path / NAME).read_text()
    done = answer("record", bag, *words, store=path)
    assert "MongoDB" not in done.err
    assert not (path / "mongod").exists()
    assert read_settings(path).mongo == NONE
    done = answer("index", "list", *words, store=path, code=6)


def test_no_mongod_is_none(bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HYBRIDLOG_MONGOD", "/nowhere/mongod")
    done = answer("record", bag, "-q", store=tmp_path / "store")
    (line,) = done.err.splitlines()
    assert line.startswith("MongoDB is unavailable, so there is no index:")
    assert "/nowhere/mongod" in line
    with hl.open(tmp_path / "store") as store:
        assert store.topic("scan").where("range_max > 0").count() == store.topic("scan").count() > 0


def test_a_server_that_is_away_gets_its_index_later(bag: Path, tmp_path: Path) -> None:
    hl.open(tmp_path / "store", create=True).close()
    done = answer("record", bag, "-q", "--mongo", NO_MONGODB, store=tmp_path / "store")
    assert "MongoDB is unavailable, so the index is made later: " in done.err
    assert "not in the index" in done.err
    with hl.open(tmp_path / "store") as store:
        store.shared.index.connect()
        (entry,) = store.recordings()
        assert entry.is_decoded
        assert store.shared.repairs.indexed == {entry.name: entry.chunks}
        assert misindexed(store) == {}


def test_a_live_recording_while_the_server_comes(tmp_path: Path, calls: Calls) -> None:
    from hybridlog.live import LiveOptions
    from tests.running.sequence import CHANNELS, messages

    with hl.open(tmp_path / "store", create=True) as store:
        away = True

        def another() -> None:
            if away:
                raise ConnectionLostError("MongoDB does not answer")

        calls(store.shared.index, "_another", another)
        with store.start("live", LiveOptions(flush_interval_s=0.1)) as recording:
            for one in messages(0, 50, 0):
                recording.write(CHANNELS[one.topic], one.raw, log_time=one.log_time)
            assert str(recording.index_failure) == "MongoDB does not answer"
            away = False
        report = recording.close()
        assert (report.failure, report.indexed) == (None, report.entry.documents)
        assert misindexed(store) == {}


def test_a_store_is_adopted_where_mongodb_is(
    bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An adoption that ends in between goes on where it was."""
    path = tmp_path / "store"
    with hl.open(path, create=True, mongo=NONE) as store:
        for name in ("one", "two"):
            store.record(bag, name=name, again=True, settings=SMALL)
        chunks = {entry.name: entry.chunks for entry in store.recordings()}
    left = [chunks["one"] + chunks["two"] // 2]

    def killed(*_: object) -> None:
        left[0] -= 1
        if left[0] < 0:
            raise StoreError("killed")

    with hl.open(path, mongo=EMBEDDED) as store, monkeypatch.context() as patch:
        Calls(patch)(SegmentReader, "read_chunk", killed)
        with pytest.raises(StoreError, match="killed"):
            store.shared.index.connect()
    with hl.open(path, mongo=EMBEDDED) as store:
        store.shared.index.connect()
        assert "one" not in store.shared.repairs.indexed
        assert 0 < store.shared.repairs.indexed["two"] <= chunks["two"]
        assert misindexed(store) == {}
        every = store.topic("scan").where({"header.seq": {"$gte": 0}})
        assert every.count() == store.topic("scan").count()


def test_as_many_were_removed_as_recorded_without_mongodb(bag: Path, tmp_path: Path) -> None:
    """One connection removes the documents of what is gone, and adds those of what is new."""
    path = tmp_path / "store"
    with hl.open(path, create=True, mongo=EMBEDDED) as store:
        first = store.record(bag, name="first").entry
    with hl.open(path, mongo=NONE) as store:
        store.remove("first")
        store.record(bag, name="second")
    with hl.open(path, mongo=EMBEDDED) as store:
        database = store.shared.index.connect()
        second = store.entry("second")
        assert IndexState(database).of().keys() == {second.key} != {first.key}
        assert misindexed(store) == {}
