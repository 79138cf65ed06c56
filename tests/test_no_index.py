"""Topics without documents in MongoDB: the same answers, in every rebuild."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from mcap.reader import make_reader

import hybridlog as hl
from hybridlog.follow.follower import bring as bring_up_to_date
from hybridlog.query.topics import matcher
from hybridlog_storage.cells import CATALOG
from hybridlog_storage.errors import TopicError
from hybridlog_storage.messages import Channel
from hybridlog_storage.mongo.index_documents import collection_of
from tests import places
from tests.cli.running import run
from tests.copies import bring
from tests.indexed import misindexed
from tests.many_topics import topic, write_log

pytestmark = pytest.mark.mongo

FOUR = [topic(number) for number in range(4)]
LEFT_OUT = FOUR[2:]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_log(tmp_path_factory.mktemp("log") / "log.mcap", 4, 20)


@pytest.fixture
def store(tmp_path: Path, log: Path) -> Iterator[hl.Store]:
    with hl.open(tmp_path / "store", create=True, require_database=True) as opened:
        report = opened.record(log, no_index=matcher(["re:.*signal[23]"]))
        assert (report.indexed, report.missed, report.entry.documents) == (40, 0, 40)
        yield opened


def documents(store: hl.Store) -> dict[str, int]:
    database = store.shared.index.database_for("this test")
    found = {name: database.count(collection_of(name), {"_meta.seq": {"$gte": 0}}) for name in FOUR}
    return {name: count for name, count in found.items() if count}


INDEXED = dict.fromkeys(FOUR[:2], 20)


def test_tables_and_messages_answer(store: hl.Store) -> None:
    assert documents(store) == INDEXED
    everything = store.all_topics()
    assert everything.count() == 80
    assert everything.where("data >= 18").count() == 8
    assert [m.topic for m in everything.where("data >= 19")] == FOUR
    for name in FOUR:
        assert store.topic(name).where("data >= 10").count() == 10
        assert len(store.topic(name).where("data >= 10").to_pandas()) == 10
    shutil.rmtree(store.directory.path / "tables")
    store.refresh()
    assert store.topic(FOUR[3]).where("data >= 10").count() == 10


def test_index_documents_that_are_not_there_are_no_empty_answer(store: hl.Store) -> None:
    assert store.topic(FOUR[0]).where({"data": {"$mod": [2, 0]}}).count() == 10
    with pytest.raises(TopicError, match=f"{LEFT_OUT[0]} has no index documents.*--no-index"):
        store.all_topics().where({"data": {"$mod": [2, 0]}}).count()


def test_every_rebuild_keeps_it(store: hl.Store) -> None:
    assert misindexed(store) == {}
    store.index.rebuild()
    assert documents(store) == INDEXED
    store.index.rebuild(["log"])
    assert documents(store) == INDEXED
    database = store.shared.index.database_for("this test")
    database.run(lambda db: db.client.drop_database(db.name))
    path = store.directory.path
    store.close()
    (path / CATALOG).unlink()
    with hl.open(path, require_database=True) as again:
        assert documents(again) == INDEXED
        assert misindexed(again) == {}
        (entry,) = again.recordings()
        assert [c.topic for c in entry.channels if not c.is_indexed] == LEFT_OUT
        database = again.shared.index.connect()
        assert bring_up_to_date(again.directory, again.shared.catalog, entry, database) is None


@pytest.mark.mongo("embedded")
def test_copies_and_other_readers(store: hl.Store, tmp_path: Path) -> None:
    (segment,) = places.folder(store.directory.path, "log").glob("*.mcap")
    with segment.open("rb") as file:
        channels = make_reader(file).get_summary().channels.values()  # type: ignore[union-attr]
    marked = {c.topic for c in channels if c.metadata.get("hybridlog.no_index") == "1"}
    assert marked == set(LEFT_OUT)
    with hl.open(tmp_path / "other", create=True) as other:
        bring(other, store.directory.path)
    with hl.open(tmp_path / "other", require_database=True) as other:
        assert documents(other) == INDEXED
        # A slice is a new log.
        run("fetch", "-t", "**", "-o", tmp_path / "slice.mcap", store=store.directory.path)
        other.record(tmp_path / "slice.mcap")
        assert documents(other) == {name: 20 + INDEXED.get(name, 0) for name in FOUR}


def test_a_live_recording(tmp_path: Path) -> None:
    with hl.open(tmp_path / "store", create=True, require_database=True) as store:
        said, silent = (Channel(name, "json", None) for name in ("/said", "/silent"))
        with store.start("talk", no_index=matcher(["silent"])) as recording:
            for number in range(5):
                for channel in (said, silent):
                    recording.write(channel, b'{"n": %d}' % number)
        database = store.shared.index.database_for("this test")
        assert database.count("said") == 5
        assert not {"silent", "hybridlog.shared"} & set(database.list_collections())
        assert store.topic("silent").where("n >= 3").count() == 2
        assert misindexed(store) == {}


def test_as_a_command(tmp_path: Path, log: Path) -> None:
    place = tmp_path / "store"
    arguments = ("record", log, "--no-index", "signal[23]", "--no-index", "nothing", "--json")
    done = run(*arguments, store=place)
    assert "no topic fits 'nothing'" in done.err
    told = done.json
    assert told["messages_indexed"] == 40
    assert told["not_indexed"] == dict.fromkeys(LEFT_OUT, "recorded with --no-index")
    channels = run("info", "log", "--json", store=place).json[0]["channels"]
    shown = {channel["topic"]: channel["not_indexed"] for channel in channels}
    assert [name for name in FOUR if shown[name]] == LEFT_OUT
    assert run("info", "log", store=place).out.count("not indexed: recorded with --no-index") == 2
    (told,) = run("index", "rebuild", "--json", store=place).json
    assert told == {"recording": "log", "messages": 80, "documents": 40}
