"""Commands and errors of MongoDB, and which documents go with a recording, in a real one."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import bson
import pymongo
import pytest
from msgspec.structs import replace
from pymongo import MongoClient

from hybridlog_storage.catalog import ChannelStats, RecordingEntry, channel_entry
from hybridlog_storage.errors import DatabaseError, DiskFullError, UsageError, WhereError
from hybridlog_storage.manifest import Manifest
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.mongo.database import Database, _mapped, without_secrets
from hybridlog_storage.mongo.index_documents import IndexState, key_bound
from tests.limits import Limit


@pytest.fixture
def database(mongo: str) -> Iterator[Database]:
    with Database.connect(mongo) as connected:
        yield connected


@pytest.fixture
def plain(mongo: str, database: Database) -> Iterator[pymongo.database.Database]:
    """The same database through an ordinary client."""
    with MongoClient(mongo) as client:
        yield client[database.name]


@pytest.fixture
def name(database: Database) -> str:
    """An empty clustered collection."""
    database.ensure_collection("c")
    return "c"


def encoded(number: int, size: int = 20) -> list[bytes]:
    return [
        bson.encode({"_id": i.to_bytes(20, "big"), "x": i, "nan": float("nan"), "s": "ü" * size})
        for i in range(number)
    ]


# --- raw documents ---


def raw_of(database: Database, name: str) -> bytes:
    return b"".join(database.each([(name, {})], lambda _: {"$match": {}}))


def test_bytes_arrive_and_come_back_as_they_are(
    database: Database, plain: pymongo.database.Database, name: str
) -> None:
    documents = encoded(12_345)
    database.insert_raw(name, documents)
    assert raw_of(database, name) == b"".join(documents)
    # An ordinary client sees ordinary documents.
    assert plain[name].count_documents({}) == len(documents)
    found = plain[name].find_one({"x": 7})
    assert bson.encode(found) == documents[7]
    assert plain[name].find_one(sort=[("x", -1)])["x"] == 12_344


def test_a_document_of_nearly_sixteen_mebibytes(database: Database, name: str) -> None:
    big = bson.encode({"_id": 1, "x": b"\1" * ((16 << 20) - 100)})
    small = bson.encode({"_id": 0})
    database.insert_raw(name, [small, big])
    assert raw_of(database, name) == small + big


def test_documents_that_are_there_are_passed_over(database: Database, name: str) -> None:
    documents = encoded(6000)
    for part in (documents[::2], documents[::2], documents):
        database.insert_raw(name, part)
    assert raw_of(database, name) == b"".join(documents)


def test_a_document_the_server_refuses(database: Database, name: str) -> None:
    bad = bson.encode({"_id": [1]})  # an array cannot be a key
    good = bson.encode({"_id": 1})
    with pytest.raises(DatabaseError, match="refuses"):
        database.insert_raw(name, [bad, good])


# --- reading ---


def test_many_questions_at_once(database: Database, name: str) -> None:
    database.insert_raw(name, encoded(500))
    database.run(lambda db: db[name].create_index([("x", 1)]))
    keys = [number.to_bytes(20, "big") for number in range(501)]
    spans = [(n, min(n + n % 4, 500)) for n in range(0, 500, 2)]
    ranges = [{"_id": {"$gte": keys[a], "$lt": keys[b]}, "x": {"$ne": 6}} for a, b in spans]
    # A collection that is not there is empty, at the beginning and elsewhere.
    mixed = [("none", ranges[1]), *((name, one) for one in ranges), ("none", {})]
    parts = [[x for x in range(a, b) if x != 6] for a, b in spans]
    some = list(database.each(mixed, lambda _: {"$project": {"x": 1}}))
    assert [d["x"] for b in some for d in bson.decode_all(b)] == [x for part in parts for x in part]
    assert len(some) == 3, "a hundred questions a command"
    assert list(database.each([], lambda _: {})) == []
    assert database.count(name, ranges[1]) == len(parts[1])
    assert database.count_each(mixed) == [0, *map(len, parts), 0]
    assert database.count_each([]) == []


def test_large_questions_go_in_several_commands(
    database: Database, name: str, limit: Limit
) -> None:
    database.insert_raw(name, encoded(5))
    limit(inserted_bytes_together=2000)
    long = [(name, {"x": {"$in": [n, *range(-200, 0)]}}) for n in range(7)]
    found = list(database.each(long, lambda _: {"$project": {"x": 1, "_id": 0}}))
    assert [bson.decode_all(raw) for raw in found] == [[{"x": n}] for n in range(5)] + [[], []]


def test_collections_are_clustered(
    database: Database, plain: pymongo.database.Database, name: str
) -> None:
    database.ensure_collection(name)
    assert plain[name].options()["clusteredIndex"]["key"] == {"_id": 1}
    database.insert_raw(name, encoded(10))


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
    database.insert_raw(name, encoded(3))
    with pytest.raises(WhereError, match="predicate"):
        database.find(name, predicate)
    with pytest.raises(WhereError):
        database.count(name, predicate)
    with pytest.raises(WhereError):
        list(database.each([(name, {}), (name, predicate)], lambda _: {"$project": {"x": 1}}))


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
        "mongodb://host/?authMechanism=s3cret",
    ],
)
def test_a_uri_that_is_none(uri: str) -> None:
    with pytest.raises(UsageError) as caught:
        Database.connect(uri, timeout_s=0.1)
    assert "s3cret" not in str(caught.value)
    assert "p@ss" not in str(caught.value)


def test_a_database_in_the_uri_wins(mongo: str) -> None:
    own = mongo.partition("?")[0].rpartition("/")[2]
    with Database.connect(mongo.replace(f"/{own}", "/")) as connected:
        assert connected.name == "hybridlog"
    with Database.connect(mongo) as connected:
        assert connected.name == own
        assert connected.address.endswith(f"/{own}")


# --- states of recordings; the model test tells the rest ---

ONE, OTHER = "0123456789abcdef" * 2, "fedcba9876543210" * 2
HOUR = 3600 * 10**9


@pytest.fixture
def state(database: Database) -> IndexState:
    """Two recordings with documents in two collections, at times 0 to 4, segment by segment."""
    for name in ("one", "two"):
        database.ensure_collection(name)
        for of in (ONE, OTHER):
            for at in range(5):
                key = key_bound(at)[:8] + bytes.fromhex(of[-16:]) + bytes(8)
                meta = {"rec": of[-16:], "ref": {"seg": at}}
                database.insert_raw(name, [bson.encode({"_id": key, "_meta": meta})])
    return IndexState(database)


def recording(*topics: str) -> RecordingEntry:
    schema = Schema("x/msg/Y", "ros2msg", b"int8 x")
    channels = [
        channel_entry(n, Channel(topic, "cdr", schema, {})) for n, topic in enumerate(topics)
    ]
    channels[0].stats = ChannelStats(messages=2, first=5, last=9)
    return RecordingEntry(
        Manifest(ONE, "one", 1),
        "complete",
        channels=channels,
        spans=[(0, 5, 9)],
    )


def left(database: Database, of: str, name: str = "one") -> list[int]:
    found = database.find(name, {"_meta.rec": of[-16:]})
    return [d["_meta"]["ref"]["seg"] for d in found]


def test_clearing_looks_around_the_times_of_its_topics(
    state: IndexState, database: Database
) -> None:
    state.clear(recording("/one", "/not_there"), but=["1", "3"])
    assert left(database, ONE) == [1, 3]
    assert left(database, ONE, "two") == list(range(5))
    entry = recording("/one")
    entry.channels[0].stats = ChannelStats(messages=1, first=HOUR + 2, last=HOUR + 3)
    state.clear(replace(entry, spans=[(0, HOUR + 2, HOUR + 3)]))
    assert left(database, ONE) == [1]
    state.clear(recording("/one", "/two"))
    assert left(database, ONE) == left(database, ONE, "two") == []
    assert left(database, OTHER) == list(range(5))


@pytest.mark.parametrize("key", ["other", "", None, {"a": 1}])
def test_documents_of_what_is_no_recording_can_be_cleared(
    state: IndexState, database: Database, key: Any
) -> None:
    database.insert_raw("one", [bson.encode({"_id": b"x" * 24, "_meta": {"rec": key}})])
    state.forget([key])
    assert database.count("one", {"_id": b"x" * 24}) == 0
    assert left(database, ONE) == left(database, OTHER) == list(range(5))
