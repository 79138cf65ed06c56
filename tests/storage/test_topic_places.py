"""Which topics share a collection, and that they stay apart in it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import bson
import numpy as np
import pytest

from hybridlog_storage.mongo import topic_places
from hybridlog_storage.mongo.collection_names import collection_of
from hybridlog_storage.mongo.database import Database
from hybridlog_storage.mongo.index_columns import KEY, key_columns
from hybridlog_storage.mongo.index_documents import key_bound, recording_key, with_prefix
from hybridlog_storage.mongo.index_state import IndexState
from hybridlog_storage.mongo.topic_places import SHARED, TOPICS, TopicPlace, TopicPlaces
from tests.calls import Calls
from tests.limits import Limit

ONE, OTHER = "1" * 16, "2" * 16


@pytest.fixture
def database(mongo: str, limit: Limit) -> Iterator[Database]:
    limit(own_collections=2)
    with Database.connect(mongo) as connected:
        yield connected


def shared(places: dict[str, TopicPlace]) -> list[str]:
    return [topic for topic, place in places.items() if place.is_shared]


def plain(recording: str, time: int, seq: int) -> bytes:
    """A document as the indexer makes it, for a collection of its own."""
    key = key_bound(time)[:8] + bytes.fromhex(recording) + seq.to_bytes(8, "big")
    return bson.encode({"_id": key, "_meta": {"rec": recording, "topic": "/?", "t": time}})


def put(database: Database, place: TopicPlace, recording: str, times: range) -> None:
    rows = []
    for time in times:
        document: dict[str, Any] = bson.decode(plain(recording, time, time))
        document["_meta"]["topic"] = topic_places.text_of(place.topic)
        row = np.frombuffer(bson.encode(document), np.uint8)[None]
        rows.append(with_prefix(row, place.prefix).tobytes())
    database.insert_raw(place.collection, b"".join(rows), len(rows))


def times(database: Database, place: TopicPlace, *bounds: int | None) -> list[int]:
    found = database.find(place.collection, place.documents(*bounds), sort=[("_id", 1)])
    return [document["_meta"]["t"] for document in found]


def test_the_first_topics_have_collections_and_all_later_ones_share_one(
    database: Database,
) -> None:
    places = TopicPlaces(database)
    assert shared(places.assigned(["/a"])) == []
    assert shared(places.assigned(["/a", "/b", "/c"])) == ["/c"]
    assert shared(places.assigned(["/d", "/a"])) == ["/d"]
    assert database.list_collections() == ["a", "b", SHARED, TOPICS]
    again = TopicPlaces(database)
    assert shared(again.of(["/a", "/b", "/c", "/d", "/e"])) == ["/c", "/d"]
    assert shared(again.assigned(["/e"])) == ["/e"]
    assert IndexState(database).document_collections() == ["a", "b", SHARED]


def test_of_two_writers_the_first_one_decides(database: Database, calls: Calls) -> None:
    TopicPlaces(database).assigned(["/a"])

    def slow(*_: Any) -> None:
        # Another one lists /c in the meantime, with a collection of its own.
        if len(listed) == 1:
            assert shared(TopicPlaces(database).assigned(["/c"])) == []

    listed = calls(Database, "insert_missing", slow)
    assert shared(TopicPlaces(database).assigned(["/b", "/c"])) == []
    assert shared(TopicPlaces(database).of(["/a", "/b", "/c"])) == []
    assert shared(TopicPlaces(database).assigned(["/d"])) == ["/d"]


def test_a_writer_that_died_before_it_made_a_collection(database: Database) -> None:
    for topic, is_shared in (("/a", False), ("/b", True)):
        row = {"_id": collection_of(topic), "topic": topic, "shared": is_shared}
        database.insert_missing(TOPICS, [row])
    assert shared(TopicPlaces(database).assigned(["/a", "/b"])) == ["/b"]
    assert {"a", SHARED} <= set(database.list_collections())


def test_few_commands_place_many_topics(database: Database, calls: Calls) -> None:
    methods = ("find", "insert_raw", "ensure_collection", "count")
    commands = [calls(Database, method) for method in methods]
    places = TopicPlaces(database)
    places.assigned([f"/t{number}" for number in range(1000)])
    # Two finds, the list, the count, one insert; two collections of their own, one shared.
    assert sum(map(len, commands)) == 8
    places.assigned([f"/t{number}" for number in range(1000)])
    places.of(["/t7"])
    assert sum(map(len, commands)) == 8


NAMES = ("/a", "a", "/A", "/a b", "/\udc80", "/\udc81", "")


def test_topics_stay_apart_in_a_shared_collection(database: Database, limit: Limit) -> None:
    limit(own_collections=0)
    places = TopicPlaces(database).assigned(NAMES)
    assert {place.collection for place in places.values()} == {SHARED}
    assert len({place.prefix for place in places.values()}) == len(NAMES)
    for at, place in enumerate(places.values()):
        put(database, place, ONE, range(at, at + 4))
        put(database, place, OTHER, range(at, at + 1))
    for at, place in enumerate(places.values()):
        assert times(database, place) == [at, *range(at, at + 4)]
        assert times(database, place, at + 1, at + 3) == [at + 1, at + 2]
        assert times(database, place, None, at + 2) == [at, at, at + 1]
        assert times(database, place, at + 3) == [at + 3]


def test_names_of_one_hash_stay_apart(database: Database, limit: Limit) -> None:
    limit(own_collections=0)
    places = TopicPlaces(database).assigned(["/a", "/b"])
    for place in places.values():
        place.__dict__["prefix"] = b"8 bytes."
    put(database, places["/a"], ONE, range(3))
    put(database, places["/b"], ONE, range(3, 5))
    assert times(database, places["/a"]) == [0, 1, 2]
    assert times(database, places["/b"], 0, 9) == [3, 4]


def test_clearing_in_a_shared_collection(database: Database, limit: Limit) -> None:
    limit(own_collections=1)
    places = TopicPlaces(database).assigned(["/a", "/b", "/c"])
    for place in places.values():
        put(database, place, ONE, range(4))
        put(database, place, OTHER, range(4, 6))
    IndexState(database).clear(ONE, [places["/a"], places["/b"]], (1, 2))
    assert times(database, places["/a"]) == times(database, places["/b"]) == [0, 3, 4, 5]
    assert times(database, places["/c"]) == [*range(6)]
    IndexState(database).clear(ONE)
    for place in places.values():
        assert times(database, place) == [4, 5]


def test_documents_with_and_without_a_prefix() -> None:
    place = TopicPlace("/a", is_shared=True)
    document = plain(ONE, 77, 5)
    table = np.frombuffer(document * 3, np.uint8).reshape(3, -1)
    assert with_prefix(table, b"") is table
    (longer, *_) = (row.tobytes() for row in with_prefix(table, place.prefix))
    before, after = bson.decode(document), bson.decode(longer)
    assert after == {**before, "_id": place.prefix + before["_id"]}
    assert recording_key(document) == recording_key(longer) == ONE
    for each in (before, after):
        keys = key_columns(bson.encode({name: each[name] for name in KEY}) * 2)
        assert (keys.time.tolist(), keys.seq.tolist()) == ([77, 77], [5, 5])
        assert keys.recording.tolist() == [int(ONE, 16)] * 2


def test_an_index_holds_one_topic_of_a_shared_collection(database: Database, limit: Limit) -> None:
    limit(own_collections=0)
    places = TopicPlaces(database).assigned(["/a", "/b"])
    for place in places.values():
        for _ in range(2):
            database.create_index(SHARED, [("x", 1)], only=place.of_topic)
    assert [(i.keys, i.only) for i in database.indexes(SHARED)] == [
        ((("x", 1),), {"_meta.topic": topic}) for topic in ("/a", "/b")
    ]
    assert not database.drop_index(SHARED, [("x", 1)])
    assert database.drop_index(SHARED, [("x", 1)], only=places["/a"].of_topic)
    assert [index.only for index in database.indexes(SHARED)] == [{"_meta.topic": "/b"}]
