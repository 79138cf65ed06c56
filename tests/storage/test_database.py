from __future__ import annotations

import json
import logging
import os
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from urllib.parse import quote

import bson
import numpy as np
import pymongo
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymongo import MongoClient, monitoring

from hybridlog_storage.errors import DatabaseError, DiskFullError, UsageError, WhereError
from hybridlog_storage.mongo import database as module
from hybridlog_storage.mongo.database import (
    CollectionStats,
    Database,
    _batches,
    _document_ends,
    _mapped,
    without_secrets,
)
from hybridlog_storage.mongo.mongod import EmbeddedMongod, find_mongod
from tests.calls import Calls
from tests.limits import Limit
from tests.waiting import wait_for

NUMBERS = count()


@pytest.fixture(scope="module")
def runtime() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="hl-", dir="/tmp") as name:
        yield Path(name)


@pytest.fixture(scope="module")
def mongod(runtime: Path) -> Iterator[EmbeddedMongod]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HYBRIDLOG_RUNTIME_DIR", str(runtime))
        with EmbeddedMongod(runtime / "mongod", linger_s=0) as running:
            yield running
        wait_for_end(runtime / "mongod")


def wait_for_end(directory: Path) -> None:
    wait_for(lambda: not (directory / "mongod.json").exists())


@pytest.fixture(scope="module")
def database(mongod: EmbeddedMongod) -> Iterator[Database]:
    with Database.connect(mongod.start(), "test") as connected:
        yield connected


@pytest.fixture
def plain(mongod: EmbeddedMongod, database: Database) -> Iterator[pymongo.database.Database]:
    """The same database through an ordinary client."""
    with MongoClient(mongod.start()) as client:
        yield client[database.name]


@pytest.fixture
def name(database: Database) -> str:
    """An empty clustered collection."""
    result = f"c{next(NUMBERS)}"
    database.ensure_collection(result)
    return result


def encoded(number: int, size: int = 20) -> list[bytes]:
    return [
        bson.encode({"_id": i.to_bytes(20, "big"), "x": i, "nan": float("nan"), "s": "ü" * size})
        for i in range(number)
    ]


def lengths_of(documents: list[bytes]) -> np.ndarray:
    return np.array([len(d) for d in documents], dtype=np.int64)


# --- raw documents ---


@pytest.mark.parametrize("with_lengths", [True, False])
def test_bytes_arrive_and_come_back_as_they_are(
    database: Database, plain: pymongo.database.Database, name: str, with_lengths: bool
) -> None:
    documents = encoded(12_345)
    raw = b"".join(documents)
    lengths = lengths_of(documents) if with_lengths else None
    assert database.insert_raw(name, raw, len(documents), lengths=lengths) == len(documents)
    assert b"".join(database.find_raw(name)) == raw
    # An ordinary client sees ordinary documents.
    assert plain[name].count_documents({}) == len(documents)
    found = plain[name].find_one({"x": 7})
    assert bson.encode(found) == documents[7]
    assert plain[name].find_one(sort=[("x", -1)])["x"] == 12_344


@pytest.mark.parametrize("kind", [bytes, bytearray, memoryview])
def test_any_buffer_will_do(database: Database, name: str, kind: type) -> None:
    raw = b"".join(encoded(10))
    assert database.insert_raw(name, kind(raw), 10) == 10
    assert b"".join(database.find_raw(name)) == raw


def test_more_than_one_message_can_hold(database: Database, name: str) -> None:
    documents = encoded(60, size=500_000)  # 1 MB each
    raw = b"".join(documents)
    assert len(raw) > 48_000_000
    assert database.insert_raw(name, raw, 60, lengths=lengths_of(documents)) == 60
    assert b"".join(database.find_raw(name)) == raw


def test_a_document_of_nearly_sixteen_mebibytes(database: Database, name: str) -> None:
    big = bson.encode({"_id": 1, "x": b"\1" * ((16 << 20) - 100)})
    small = bson.encode({"_id": 0})
    assert database.insert_raw(name, small + big, 2) == 2
    assert b"".join(database.find_raw(name)) == small + big
    too_big = bson.encode({"_id": 1, "x": b"\1" * (16 << 20)})
    with pytest.raises(DatabaseError, match="larger than MongoDB allows"):
        database.insert_raw(name, too_big, 1)


def test_documents_that_are_there_are_passed_over(database: Database, name: str) -> None:
    documents = encoded(6000)
    even = b"".join(documents[::2])
    assert database.insert_raw(name, even, 3000) == 3000
    assert database.insert_raw(name, even, 3000) == 0
    assert database.insert_raw(name, b"".join(documents), 6000) == 3000
    assert b"".join(database.find_raw(name)) == b"".join(documents)


def test_nothing_to_insert(database: Database, name: str) -> None:
    assert database.insert_raw(name, b"", 0) == 0
    assert database.insert_raw(name, b"", 0, lengths=np.zeros(0, np.int64)) == 0
    assert list(database.find_raw(name)) == []


@pytest.mark.parametrize(
    ("raw", "number", "lengths"),
    [
        (b"", 1, None),
        (bson.encode({}) * 2, 1, None),
        (bson.encode({}) * 2, 3, None),
        (bson.encode({})[:-1], 1, None),
        (b"\x05\0\0\0\1", 1, None),
        (b"\x04\0\0\0\0", 1, None),
        (b"\xff\xff\xff\xff\0", 1, None),
        (b"\x7f\0\0\0\0", 1, None),
        (bson.encode({}), 1, [5, 0]),
        (bson.encode({}) * 2, 2, [4, 6]),
        (bson.encode({}) * 2, 2, [10, 0]),
        (bson.encode({"a": 1}) + bson.encode({}), 2, [5, 12]),
        (bson.encode({}), 1, [6]),
    ],
)
def test_what_is_not_so_many_documents_is_not_sent(
    database: Database, name: str, raw: bytes, number: int, lengths: list[int] | None
) -> None:
    stated = None if lengths is None else np.array(lengths, dtype=np.int64)
    with pytest.raises(ValueError, match=r"document|length"):
        database.insert_raw(name, raw, number, lengths=stated)
    assert database.count(name) == 0


def test_a_document_the_server_refuses(database: Database, name: str) -> None:
    bad = bson.encode({"_id": [1]})  # an array cannot be a key
    good = bson.encode({"_id": 1})
    with pytest.raises(DatabaseError, match="refuses"):
        database.insert_raw(name, bad + good, 2)


@settings(max_examples=200, deadline=None)
@given(st.lists(st.integers(5, 400), max_size=60), st.integers(400, 1000), st.integers(1, 12))
def test_batches_are_a_partition_within_the_limits(
    sizes: list[int], most_bytes: int, most_documents: int
) -> None:
    raw = b"".join(n.to_bytes(4, "little") + b"\1" * (n - 5) + b"\0" for n in sizes)
    walked = _document_ends(memoryview(raw), len(sizes), None)
    given_lengths = _document_ends(memoryview(raw), len(sizes), np.array(sizes, dtype=np.int64))
    assert walked.tolist() == given_lengths.tolist() == [0, *np.cumsum(sizes, dtype=int).tolist()]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "BATCH_BYTES", most_bytes)
        patch.setattr(module, "BATCH_DOCUMENTS", most_documents)
        batches = list(_batches(walked))
    assert [row for first, last in batches for row in range(first, last)] == list(range(len(sizes)))
    for (first, last), following in zip(batches, [*batches, None][1:], strict=True):
        assert 0 < last - first <= most_documents
        assert walked[last] - walked[first] <= most_bytes
        if following and last - first < most_documents:
            assert walked[last + 1] - walked[first] > most_bytes, "as full as it can be"


def test_the_drivers_own_log_and_monitors_cope(
    mongod: EmbeddedMongod, name: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG, logger="pymongo")
    seen: list[str] = []

    class Listener(monitoring.CommandListener):
        def started(self, event: monitoring.CommandStartedEvent) -> None:
            seen.append(repr(event.command))

        def succeeded(self, event: monitoring.CommandSucceededEvent) -> None:
            seen.append(event.command_name)

        def failed(self, event: monitoring.CommandFailedEvent) -> None:
            seen.append(event.command_name)

    with MongoClient(mongod.start(), event_listeners=[Listener()]) as client:
        watched = Database(client, "test", "here")
        assert watched.insert_raw(name, b"".join(encoded(100)), 100) == 100
    assert any("bytes of documents" in text for text in seen)


# --- reading ---


def test_find_raw_with_all_its_arguments(database: Database, name: str) -> None:
    documents = encoded(500)
    database.insert_raw(name, b"".join(documents), 500)
    batches = list(database.find_raw(name, {"x": {"$gte": 100}}, {"x": 1}, sort=[("x", -1)]))
    assert [d["x"] for b in batches for d in bson.decode_all(b)] == list(range(499, 99, -1))
    begin, end = ((i).to_bytes(20, "big") for i in (5, 8))
    found = database.find_raw(name, {"_id": {"$gte": begin, "$lt": end}})
    assert b"".join(found) == b"".join(documents[5:8])
    assert len(list(database.find_raw(name))) == 1, "not a hundred documents at a time"
    assert list(database.find_raw("none")) == []


def test_many_questions_at_once(database: Database, name: str) -> None:
    documents = encoded(500)
    database.insert_raw(name, b"".join(documents), 500)
    database.create_index(name, [("x", 1)])
    keys = [number.to_bytes(20, "big") for number in range(501)]
    spans = [(n, min(n + n % 4, 500)) for n in range(0, 500, 2)]
    ranges = [{"_id": {"$gte": keys[a], "$lt": keys[b]}, "x": {"$ne": 6}} for a, b in spans]
    want = [sum(x != 6 for x in range(a, b)) for a, b in spans]
    assert database.count_each([(name, one) for one in ranges]) == want
    total = database.count(name, {"s": "ü" * 20})
    assert database.count_by(["none", name], "s") == [[], [("ü" * 20, total)]]
    # A collection that is not there is empty, at the beginning and elsewhere.
    mixed = [("none", ranges[1]), (name, ranges[1]), ("none", {})]
    assert database.count_each(mixed) == [0, want[1], 0]
    assert database.count_each([]) == []
    parts = [[x for x in range(a, b) if x != 6] for a, b in spans]
    some = list(database.find_each([(name, one) for one in ranges], {"x": 1}))
    assert [d["x"] for b in some for d in bson.decode_all(b)] == [x for part in parts for x in part]
    assert b"".join(database.find_each([("none", one) for one in ranges], {"x": 1})) == b""
    assert list(database.find_each([], {"x": 1})) == []
    assert database.count(name, ranges[1]) == want[1]


def test_large_questions_go_in_several_commands(
    database: Database, name: str, limit: Limit
) -> None:
    database.insert_raw(name, b"".join(encoded(5)), 5)
    limit(inserted_bytes_together=2000)
    long = [(name, {"x": {"$in": [n, *range(-200, 0)]}}) for n in range(7)]
    assert database.count_each(long) == [1, 1, 1, 1, 1, 0, 0]


def test_a_reader_that_stops_early_leaves_no_cursor(
    database: Database, plain: pymongo.database.Database, name: str
) -> None:
    database.insert_raw(name, b"".join(encoded(500)), 500)
    before = plain.command("serverStatus")["metrics"]["cursor"]["open"]["total"]
    for reader in (database.find_raw(name), database.find(name)):
        assert next(reader)
        reader.close()
    assert plain.command("serverStatus")["metrics"]["cursor"]["open"]["total"] == before


def test_small_things(database: Database, name: str) -> None:
    database.replace(name, {"_id": 1}, {"_id": 1, "a": "x"})
    database.replace(name, {"_id": 1}, {"_id": 1, "a": "y"})
    database.replace(name, {"_id": 2}, {"_id": 2}, upsert=False)
    assert list(database.find(name)) == [{"_id": 1, "a": "y"}]
    assert database.update(name, {"_id": 1}, {"$set": {"b": 2}}) == 1
    assert database.update(name, {"_id": 9}, {"$set": {"b": 2}}) == 0
    assert database.find_one(name, {"b": 2}, {"_id": 0, "b": 1}) == {"b": 2}
    assert database.find_one(name, {"b": 3}) is None
    assert database.count(name) == database.count(name, {"b": 2}) == 1
    assert list(database.aggregate(name, [{"$group": {"_id": None, "n": {"$sum": "$b"}}}])) == [
        {"_id": None, "n": 2}
    ]
    for _ in range(2):
        database.create_index(name, [("b", 1), ("a", -1)])
    assert database.indexes(name) == [(("b", 1), ("a", -1))]
    stats = database.stats(name)
    assert stats.documents == 1
    assert stats.storage_bytes > 0
    assert stats.index_bytes > 0
    assert database.stats("none") == CollectionStats(0, 0, 0)
    assert name in database.list_collections()
    assert database.delete(name, {"_id": 1}) == 1
    database.drop(name)
    database.drop(name)
    assert name not in database.list_collections()
    assert database.ping()


def test_collections_are_clustered(
    database: Database, plain: pymongo.database.Database, name: str
) -> None:
    database.ensure_collection(name)
    assert plain[name].options()["clusteredIndex"]["key"] == {"_id": 1}
    database.insert_raw(name, b"".join(encoded(10)), 10)
    assert database.stats(name).index_bytes == 0


def test_dropping_all_leaves_other_databases(
    mongod: EmbeddedMongod, plain: pymongo.database.Database
) -> None:
    with Database.connect(mongod.start(), "other") as other:
        other.ensure_collection("a")
        assert other.list_collections() == ["a"]
        other.drop_all()
        assert other.list_collections() == []
    assert "other" not in plain.client.list_database_names()


def nested(depth: int) -> dict[str, object]:
    result: dict[str, object] = {}
    for _ in range(depth):
        result = {"$and": [result]}
    return result


@pytest.mark.parametrize(
    "predicate",
    [
        {"x": {"$foo": 1}},
        {"s": {"$regex": "a" * 40_000}},
        {"x": {"$type": "colour"}},
        {"x": {"$gt": 1 << 70}},
        {"$expr": {"$toInt": "$s"}},
        {"$expr": {"$divide": [1, 0]}},
        {"$expr": {"$substrBytes": ["$s", -1, 2]}},
        nested(300),
        nested(5000),
    ],
    ids=range(9),
)
def test_a_wrong_predicate_is_the_users_error(
    database: Database, name: str, predicate: dict[str, object]
) -> None:
    database.insert_raw(name, b"".join(encoded(3)), 3)
    for ask in (database.find_raw, database.find, database.find_one):
        with pytest.raises(WhereError, match="predicate"):
            list(ask(name, predicate) or ())
    with pytest.raises(WhereError):
        database.count(name, predicate)
    with pytest.raises(WhereError):
        database.count_each([(name, predicate), (name, {})])
    with pytest.raises(WhereError):
        list(database.find_each([(name, {}), (name, predicate)], {"x": 1}))
    with pytest.raises(WhereError):
        list(database.aggregate(name, [{"$match": predicate}]))


@pytest.mark.parametrize("bad", ["", "a$b", "a\0b", ".a", "x" * 300])
def test_names_that_no_collection_can_have(database: Database, bad: str) -> None:
    with pytest.raises(DatabaseError):
        database.ensure_collection(bad)


def test_a_full_disk_is_told_apart() -> None:
    with pytest.raises(DiskFullError), _mapped("here"):
        raise pymongo.errors.OperationFailure("no room", 14031, {"errmsg": "no room"})


# --- connections ---


def test_nobody_there(tmp_path: Path) -> None:
    begin = time.monotonic()
    with pytest.raises(DatabaseError, match="does not answer") as caught:
        Database.connect(
            f"mongodb://u:s3cret@{quote(str(tmp_path), safe='')}%2Fa.sock/", timeout_s=0.3
        )
    assert time.monotonic() - begin < 20, "it waits as long as the driver does by itself"
    assert "s3cret" not in str(caught.value)


@pytest.mark.parametrize(
    ("uri", "shown"),
    [
        ("mongodb://u:p@h1:1,h2:2/db?tlsCertificateKeyFilePassword=q", "mongodb://h1:1,h2:2/db"),
        ("mongodb://u:p/a@b?c@host/", "mongodb://host/"),
        ("mongodb+srv://u@host", "mongodb+srv://host"),
        ("u:p@host", "the given URI"),
    ],
)
def test_secrets_are_not_shown(uri: str, shown: str) -> None:
    assert without_secrets(uri) == shown


@pytest.mark.parametrize(
    "uri",
    [
        "",
        "localhost",
        "http://localhost/",
        "mongodb://",
        "mongodb://u:p@ss:w@host/",
        "mongodb:///tmp/a.sock",
        "mongodb://host:port/",
        "mongodb://host:99999/",
        "mongodb://host/admin",
        "mongodb://host/a.b",
        "mongodb://host/?w=0",
        "mongodb://host/?authMechanism=s3cret",
    ],
)
def test_a_uri_that_is_none(uri: str) -> None:
    with pytest.raises(UsageError) as caught:
        Database.connect(uri, timeout_s=0.1)
    assert "s3cret" not in str(caught.value)
    assert "p@ss" not in str(caught.value)


def test_a_database_in_the_uri_wins(mongod: EmbeddedMongod) -> None:
    uri = mongod.start()
    with Database.connect(uri) as connected:
        assert connected.name == "hybridlog"
    with Database.connect(uri.replace("/?", "/mine?"), "yours") as connected:
        assert connected.name == "mine"
        assert connected.address.endswith("/mine")


def test_an_old_server_is_refused(mongod: EmbeddedMongod, calls: Calls) -> None:
    old = {"version": "5.0.9", "versionArray": [5, 0, 9, 0]}
    calls.change(MongoClient, "server_info", lambda *_: old)
    with pytest.raises(DatabaseError, match=r"version 5\.0\.9; hybridlog needs 5\.3"):
        Database.connect(mongod.start(), timeout_s=5)


def test_a_server_of_somebody_elses(runtime: Path) -> None:
    """By URI: a plain mongod, started by hand, which then goes away."""
    data = runtime / "plain"
    data.mkdir()
    path = runtime / "plain.sock"
    command = [str(find_mongod()), "--dbpath", str(data), "--bind_ip", str(path), "--nounixsocket"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as server:
        try:
            uri = f"mongodb://{quote(str(path), safe='')}/theirs?directConnection=true"
            Database.connect(uri, timeout_s=20).close()
            with Database.connect(uri, timeout_s=1) as connected:
                connected.ensure_collection("a")
                assert connected.insert_raw("a", b"".join(encoded(10)), 10) == 10
                assert connected.ping()
                server.kill()
                server.wait()
                assert not connected.ping()
            with pytest.raises(DatabaseError, match="does not answer"):
                Database.connect(uri, timeout_s=0.3)
        finally:
            server.kill()


def test_killed_in_the_middle_of_inserting(
    tmp_path: Path, runtime: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HYBRIDLOG_RUNTIME_DIR", str(runtime))
    directory = tmp_path / "mongod"
    documents = encoded(40_000, 200)
    raw, lengths = b"".join(documents), lengths_of(documents)
    with EmbeddedMongod(directory, linger_s=0) as user:
        with Database.connect(user.start(), timeout_s=0.5) as database:
            database.ensure_collection("a")
            # What was written before a checkpoint outlives a kill.
            assert database.insert_raw("a", raw[: lengths[:10].sum()], 10) == 10
            database.checkpoint()
            pid = json.loads((directory / "mongod.json").read_text())["mongod"]
            threading.Timer(0.05, os.kill, (pid, signal.SIGKILL)).start()

            def insert_for_ever() -> None:
                while True:
                    database.insert_raw("a", raw, len(documents), lengths=lengths)
                    database.delete("a", {"x": {"$gte": 10}})

            with pytest.raises(DatabaseError, match="does not answer"):
                insert_for_ever()
        with Database.connect(user.start()) as database:
            there = database.count("a", {"x": {"$gte": 0}})
            assert 10 <= there <= len(documents)
            new = database.insert_raw("a", raw, len(documents), lengths=lengths)
            assert there + new == len(documents)
            assert b"".join(database.find_raw("a")) == raw
    wait_for_end(directory)
