"""Which documents go with a recording, in a real MongoDB; the model test tells the rest."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import bson
import pytest
from msgspec.structs import replace

from hybridlog_storage.catalog import ChannelStats, RecordingEntry, channel_entry
from hybridlog_storage.manifest import Manifest
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.mongo.database import Database
from hybridlog_storage.mongo.index_documents import IndexState, key_bound

ONE, OTHER = "0123456789abcdef" * 2, "fedcba9876543210" * 2
HOUR = 3600 * 10**9


@pytest.fixture
def database(mongo: str) -> Iterator[Database]:
    with Database.connect(mongo) as connected:
        yield connected


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
