"""A store of more topics than MongoDB has collections for: the same answers, all maintenance."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pymongo
import pytest

import hybridlog as hl
from hybridlog_storage.mongo import topic_places
from hybridlog_storage.mongo.database import Database
from hybridlog_storage.mongo.topic_places import OWN_COLLECTIONS, SHARED, TOPICS
from tests.calls import Calls
from tests.limits import Limit
from tests.many_topics import BASE, handles, mongod_of, topic, write_log

pytestmark = pytest.mark.mongo("embedded")

FEW = 12
"""Topics of a small log, of which three have collections of their own."""


@pytest.fixture(scope="module", autouse=True)
def few_collections() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(topic_places, "OWN_COLLECTIONS", 3)
        yield


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    place = tmp_path_factory.mktemp("logs")
    return {
        "one": write_log(place / "one.mcap", FEW),
        "two": write_log(place / "two.mcap", FEW, 4, start=BASE + 10**9),
    }


@pytest.fixture
def store(tmp_path: Path, logs: dict[str, Path]) -> Iterator[hl.Store]:
    with hl.open(tmp_path / "store", create=True, require_database=True) as opened:
        for log in logs.values():
            opened.record(log)
        yield opened


def least(value: int) -> dict[str, object]:
    """A condition that MongoDB answers."""
    return {"$expr": {"$gte": ["$data", value]}}


def database_of(store: hl.Store) -> Database:
    return store.shared.index.database_for("this test")


def documents(store: hl.Store) -> Counter[str]:
    """Documents by collection and recording."""
    found: Counter[str] = Counter()
    labels = {entry.key: entry.name for entry in store.recordings()}
    for name in database_of(store).list_collections():
        if name == SHARED or not name.startswith("hybridlog."):
            for document in database_of(store).find(name, {}, {"_meta.rec": 1}):
                key = document["_meta"]["rec"]
                found[f"{'shared' if name == SHARED else 'own'} {labels.get(key, key)}"] += 1
    return found


ALL = {"own one": 15, "shared one": 45, "own two": 12, "shared two": 36}


def test_questions_are_answered_from_both_kinds_of_collections(store: hl.Store) -> None:
    assert documents(store) == ALL
    everything = store.all_topics()
    assert everything.where(least(3)).count() == 3 * FEW
    for number in (0, 2, 3, FEW - 1):
        one = store.topic(topic(number)).where(least(2))
        assert one.count() == 5
        assert [m.fields["data"] for m in one] == [n + number / 65536 for n in (2, 3, 4, 2, 3)]
        assert one.in_recording("two").count() == 2
        assert one.between(BASE, BASE + 10**9).count() == 3
    merged = everything.where({"data": {"$gte": 3}})
    assert [m.seq for m in merged] == [m.seq for m in everything.where(least(3))]
    assert merged.count() == 3 * FEW


def test_reindex_and_verify(store: hl.Store) -> None:
    assert store.verify().findings == []
    database = database_of(store)
    stray = {"_id": b"x" * 32, "_meta": {"rec": "f" * 16, "topic": topic(5)}}
    database.replace(SHARED, {"_id": stray["_id"]}, stray)
    key = store.entry("one").key
    asked = {"_meta.rec": key, "_meta.topic": topic(7)}
    assert database.delete(SHARED, asked) == 5
    findings = store.verify().findings
    assert {finding.recording for finding in findings} == {"one"}
    assert any("hybridlog.shared" in finding.place for finding in findings)
    store.index.rebuild()
    assert documents(store) == ALL
    assert store.verify().findings == []
    assert store.all_topics().where(least(3)).count() == 3 * FEW


def test_few_commands_verify_many_topics(tmp_path: Path, calls: Calls) -> None:
    log = write_log(tmp_path / "log.mcap", 200)
    with hl.open(tmp_path / "store", create=True, require_database=True) as store:
        store.record(log)
        sent = commands_of(calls)
        assert store.verify().findings == []
        assert store.verify(["log"]).findings == []
        assert sent.total() <= 40, sent
        place = store.index.place(topic(7))
        assert database_of(store).delete(place.collection, place.documents()) == 5
        assert "messages in the segments" in store.verify().findings[-1].problem


def test_a_changed_document_of_a_shared_collection_is_found(store: hl.Store) -> None:
    key = store.entry("two").key
    asked = {"_meta.rec": key, "_meta.topic": topic(9), "_meta.seq": 9}
    assert database_of(store).update(SHARED, asked, {"$set": {"data": 7.0}}) == 1
    (finding,) = store.verify(["two"]).findings
    assert "1 index documents are missing or differ" in finding.problem
    assert store.verify(["one"]).findings == []


def test_a_surplus_document_of_a_shared_collection_is_found(store: hl.Store) -> None:
    """It is of no chunk, so that only its number tells."""
    database = database_of(store)
    (entry,) = store.select(["two"])
    found = database.find_one(SHARED, {"_meta.rec": entry.key, "_meta.topic": topic(8)})
    assert found is not None
    found["_id"] = found["_id"][:-1] + bytes([found["_id"][-1] ^ 0xFF])
    found["_meta"]["ref"]["chunk"] = 99
    database.replace(SHARED, {"_id": found["_id"]}, found)
    (finding,) = store.verify(["two"]).findings
    assert "37 index documents, 36 messages" in finding.problem
    store.index.rebuild(["two"])
    assert documents(store) == ALL
    assert store.verify().findings == []


def test_a_removed_recording_leaves_the_others(store: hl.Store) -> None:
    store.remove("one")
    assert documents(store) == {"own two": 12, "shared two": 36}
    assert store.verify().findings == []


def test_a_lost_database_is_made_again(store: hl.Store) -> None:
    database_of(store).drop_all()
    path = store.directory.path
    store.close()
    with hl.open(path, require_database=True) as again:
        assert documents(again) == ALL
        assert again.topic(topic(FEW - 1)).where(least(3)).count() == 3


def test_a_lost_list_of_topics_makes_no_wrong_answer(store: hl.Store) -> None:
    database = database_of(store)
    store.connect()
    question = store.topic(topic(FEW - 1)).where(least(3))
    database.drop(TOPICS)
    store.refresh()
    assert question.count() == 0
    assert question.counters.unindexed == store.topic(topic(FEW - 1)).count()
    assert store.topic(topic(FEW - 1)).where("data >= 3").count() == 3
    assert len(store.verify().findings) > 0
    store.index.rebuild()
    assert store.verify().findings == []
    assert documents(store).total() == sum(ALL.values())
    assert question.count() == 3


def test_an_interrupted_recording_is_indexed_where_it_was_begun(
    store: hl.Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, calls: Calls
) -> None:
    """It is killed when its topics are listed, but no document is written."""

    def killed(_: Database, collection: str, *__: Any, **___: Any) -> None:
        if collection != TOPICS:
            raise KeyboardInterrupt

    log = write_log(tmp_path / "three.mcap", 4, start=BASE + 10**10, prefix="/new")
    calls(Database, "insert_raw", killed)
    with pytest.raises(KeyboardInterrupt):
        store.record(log)
    monkeypatch.undo()
    assert database_of(store).count(TOPICS, {"topic": {"$regex": "^/new"}}) == 4
    store.record(log)
    assert documents(store) == {**ALL, "shared three": 20}
    assert store.verify().findings == []


def test_an_index_on_a_field_of_a_shared_collection(store: hl.Store) -> None:
    own, mine, other = topic(0), topic(5), topic(6)
    for name in (own, mine):
        store.index.add(name, "data")
    assert [(one.topic, one.fields) for one in store.index.list()] == [
        (own, ("data",)),
        (mine, ("data",)),
    ]
    assert store.index.list(other) == []
    database = database_of(store)
    question = {"_meta.topic": mine, "data": {"$gt": 2.5}}
    with pymongo.MongoClient[dict[str, Any]](database.address) as client:
        found = client[database.name][SHARED].find(question)
        assert "IXSCAN" in str(found.explain()["queryPlanner"]["winningPlan"])
    store.index.rebuild()
    assert len(store.index.list()) == 2
    assert store.topic(mine).where(least(3)).count() == 3
    assert store.topic(other).where(least(3)).count() == 3
    assert store.index.remove(other, "data") == 0
    assert store.index.remove(mine, "data") == 1
    assert [one.topic for one in store.index.list()] == [own]


# Many.


class Walked(list[Any]):
    """A list that counts how often somebody walks through it."""

    walks = 0

    def __iter__(self) -> Iterator[Any]:
        self.walks += 1
        return super().__iter__()


def test_no_question_about_all_topics_walks_through_them_once_a_topic(tmp_path: Path) -> None:
    log = write_log(tmp_path / "log.mcap", 40)
    with hl.open(tmp_path / "store", create=True, require_database=True) as store:
        store.record(log)
        store.all_topics().where(least(3)).count()  # everything is open now
        store.shared.channels.clear()
        store.session.tables.invalidate()
        (entry,) = store.recordings()
        channels = entry.channels = Walked(entry.channels)
        everything = store.all_topics()
        for query in (everything, everything.where(least(3)), everything.where("data < 1")):
            query.count()
            list(query)
            len(query.to_pandas())
        assert 0 < channels.walks < 40
        channels.walks = 0
        assert everything.where(least(2)).count() == 120
        assert channels.walks < 10


def commands_of(calls: Calls) -> Counter[str]:
    """Counts the inserts and the questions sent to MongoDB, by method."""
    sent: Counter[str] = Counter()
    for method in ("_insert_batch", "ensure_collection", "find_raw", "find", "aggregate", "count"):
        calls(Database, method, lambda *_, name=method, **__: sent.update([name]))
    return sent


def test_a_store_of_a_thousand_topics(tmp_path: Path, calls: Calls, limit: Limit) -> None:
    limit(own_collections=100)
    log = write_log(tmp_path / "log.mcap", 1000)
    with hl.open(tmp_path / "store", create=True, require_database=True) as store:
        before = handles(store)
        sent = commands_of(calls)
        store.record(log)
        # One for each collection in each parcel, the chunks, the topics.
        assert sent["_insert_batch"] < 300
        assert sent["ensure_collection"] == 102
        assert handles(store) - before < 130
        assert database_of(store).count(SHARED, {"_meta.seq": {"$gte": 0}}) == 900 * 5
        sent.clear()
        assert store.all_topics().where(least(3)).count() == 2000
        # A hundred questions a command.
        assert sent["aggregate"] <= 12
        assert sent["find"] <= 14
        sent.clear()
        assert store.topic(topic(999)).where(least(3)).count() == 2
        assert sent.total() <= 8


@pytest.mark.exhaustive
@pytest.mark.parametrize(("topics", "handles_limit"), [(3000, 1024), (10_000, None)])
def test_thousands_of_topics(
    tmp_path: Path, limit: Limit, topics: int, handles_limit: int | None
) -> None:
    """Recorded by a command, as a user does it; with a hard limit of handles."""
    limit(own_collections=OWN_COLLECTIONS)
    log = write_log(tmp_path / "log.mcap", topics)

    def limited() -> None:
        if handles_limit is not None:
            resource.setrlimit(resource.RLIMIT_NOFILE, (handles_limit, handles_limit))

    command = [sys.executable, "-m", "hybridlog", "record", log, "--store", tmp_path / "store"]
    subprocess.run(
        command,
        check=True,
        preexec_fn=limited,
        env={**os.environ, "HYBRIDLOG_MONGOD_LINGER_S": "60"},
        timeout=600,
    )
    with hl.open(tmp_path / "store", require_database=True) as store:
        assert handles(store) < 1000
        memory = (mongod_of(store) / "status").read_text().partition("VmHWM:")[2].split()[0]
        assert int(memory) < 400_000  # kB
        if handles_limit is not None:
            said = (mongod_of(store) / "limits").read_text()
            assert f"Max open files            {handles_limit}" in said
        assert store.all_topics().count() == 5 * topics
        assert store.topic(topic(topics - 1)).where(least(3)).count() == 2
        assert database_of(store).count(SHARED, {"_meta.seq": {"$gte": 0}}) == 5 * (
            topics - OWN_COLLECTIONS
        )
