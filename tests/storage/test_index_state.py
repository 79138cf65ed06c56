"""What MongoDB says of the index itself, in a real MongoDB."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest

from hybridlog_storage.catalog import ChannelStats, RecordingEntry, channel_entry
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.mongo.collection_names import CATALOG_PREFIX
from hybridlog_storage.mongo.database import Database
from hybridlog_storage.mongo.index_documents import key_bound
from hybridlog_storage.mongo.index_state import (
    RECORDINGS,
    STORE,
    Indexed,
    IndexState,
)

ONE, OTHER = "0123456789abcdef" * 2, "fedcba9876543210" * 2
DIGESTS = {"0": "a", "1": "b", "10": "c"}


@pytest.fixture
def database(mongo: str) -> Iterator[Database]:
    with Database.connect(mongo) as connected:
        yield connected


@pytest.fixture
def state(database: Database) -> IndexState:
    return IndexState(database)


def recording(of: str = ONE, topics: tuple[str, ...] = ("/ä b", "/b")) -> RecordingEntry:
    schema = Schema("x/msg/Y", "ros2msg", b"int8 x")
    channels = [
        channel_entry(n, Channel(topic, "cdr", schema, {"a": "b.c", "$d": ""}), None)
        for n, topic in enumerate(topics)
    ]
    channels[0].stats = ChannelStats(messages=2, first=5, last=9, skew_sum=0.5, stamped=1)
    return RecordingEntry(
        id=of,
        name="run näme",
        tags={"a.b": "c", "$x": "y", "": "z"},
        source={"path": "/x", "bytes": 2**40},
        created=2**62,
        status="complete",
        end={"losses": []},
        channels=channels,
        stored_bytes=2**50,
        segments=3,
        chunks=2,
        notes=[{"at": 5, "text": "ö"}],
        marks=[{"time": 1, "text": "m", "tags": {"k": "v"}, "id": "0" * 16}],
        spans=[(0, 5, 7), (1, 8, 9)],
        digests=dict(DIGESTS),
    )


def document(of: str, at: int, segment: int, number: int) -> dict[str, object]:
    key = bytes.fromhex(of[-16:])
    _id = key_bound(at)[:8] + key + number.to_bytes(8, "big")
    return {"_id": _id, "_meta": {"rec": of[-16:], "ref": {"seg": segment, "chunk": 0}}}


def indexed(state: IndexState, of: str = ONE) -> Indexed | None:
    found = state.of([of[-16:]])
    assert found.keys() <= {of[-16:]}
    return found.get(of[-16:])


# How far a recording is.


@pytest.mark.parametrize("step", ["open", "clearing", "indexing", "complete", "removing"])
def test_a_state_comes_back(state: IndexState, step: str) -> None:
    entry = recording()
    assert indexed(state) is None
    state.put(entry, step, turn=3, segments={"0": "a"})  # type: ignore[arg-type]
    found = indexed(state)
    assert found is not None
    assert (found.id, found.state, found.turn) == (ONE, step, 3)
    assert dict(found.segments) == {"0": "a"}
    assert dict(found.damage) == {}
    assert found.mirrors(entry)
    assert not found.is_whole(entry)


def test_a_recording_is_whole_only_when_state_and_all_digests_fit(state: IndexState) -> None:
    entry = recording()
    state.put(entry, "complete", turn=1, segments=DIGESTS)
    found = indexed(state)
    assert found is not None
    assert found.is_whole(entry)
    for digests in (
        {**DIGESTS, "1": "x"}, {"0": "a"}, {**DIGESTS, "2": "d"}, {},
    ):  # fmt: skip
        assert not found.is_whole(replace(entry, digests=digests))
    for step in ("open", "clearing", "indexing", "removing"):
        state.put(entry, step, turn=1, segments=DIGESTS)  # type: ignore[arg-type]
        again = indexed(state)
        assert again is not None
        assert not again.is_whole(entry), step


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("name", "other"), ("tags", {"a": "b"}), ("status", "damaged"),
        ("notes", []), ("marks", []),
    ],
)  # fmt: skip
def test_the_mirror_shows_a_recording_as_it_was_or_as_it_is(
    state: IndexState, name: str, value: object
) -> None:
    entry = recording()
    state.put(entry, "complete", turn=4, segments=DIGESTS, damage={(0, 1): "x"})
    changed = replace(entry, **{name: value})
    before = indexed(state)
    assert before is not None
    assert before.mirrors(entry)
    assert not before.mirrors(changed)
    state.show(changed)
    after = indexed(state)
    assert after is not None
    assert after.mirrors(changed)
    # What is said of the index stays.
    assert replace(after, shown=before.shown) == before
    assert after.is_whole(changed)


def test_the_mirror_is_what_other_programs_read(state: IndexState, database: Database) -> None:
    entry = recording()
    state.put(entry, "complete", turn=1, segments=DIGESTS)
    (found,) = database.find(RECORDINGS, {})
    assert found["_id"] == ONE[-16:]
    assert found.pop("index") == {"state": "complete", "turn": 1, "segments": DIGESTS}
    del found["_id"]
    document = entry.to_document()
    del document["held"]
    assert found == document


def test_what_the_mirror_says_otherwise_is_seen(state: IndexState, database: Database) -> None:
    entry = recording()
    assert not state.is_mirrored(entry)
    for change in (
        {"$set": {"extra": 1}}, {"$unset": {"name": 1}}, {"$inc": {"channels.0.stats.first": 1}},
        {"$set": {"channels": 5}}, {"$set": {"spans": [[0, 5]]}}, {"$push": {"notes": "x"}},
        {"$set": {"end.losses": [{"cause": "x"}]}}, {"$unset": {"channels.0.stats.skew_sum": 1}},
    ):  # fmt: skip
        state.put(entry, "complete", turn=1, segments=DIGESTS, damage={(0, 1): "x"})
        assert state.is_mirrored(entry)
        database.update(RECORDINGS, {"_id": ONE[-16:]}, change)
        assert not state.is_mirrored(entry), change


def test_chunks_without_documents_are_known(state: IndexState) -> None:
    damage = {(0, 1): "unreadable", (12, 3): "gone"}
    state.put(recording(), "complete", turn=1, segments=DIGESTS, damage=damage)
    found = indexed(state)
    assert found is not None
    assert found.damage == damage
    state.put(recording(), "complete", turn=1, segments=DIGESTS)
    found = indexed(state)
    assert found is not None
    assert found.damage == {}


def test_only_the_recordings_that_are_asked_for(state: IndexState) -> None:
    state.put(recording(), "complete", turn=1, segments=DIGESTS)
    state.put(recording(OTHER), "open", turn=2)
    assert state.of().keys() == {ONE[-16:], OTHER[-16:]}
    assert state.of([OTHER[-16:], "0" * 16]).keys() == {OTHER[-16:]}
    assert state.of([]) == {}
    both = [ONE[-16:], OTHER[-16:]]
    assert state.segments(both) == {ONE[-16:]: (1, DIGESTS), OTHER[-16:]: (2, {})}
    assert state.segments([OTHER[-16:], "0" * 16]) == {OTHER[-16:]: (2, {})}


def test_what_another_program_has_put_there_is_not_whole(
    state: IndexState, database: Database
) -> None:
    database.replace(RECORDINGS, {"_id": ONE[-16:]}, {"_id": ONE[-16:]})
    found = indexed(state)
    assert found is not None
    assert (found.state, found.turn) == ("indexing", 0)
    assert state.segments([ONE[-16:]]) == {ONE[-16:]: (0, {})}
    assert not found.is_whole(recording())
    assert not found.mirrors(recording())


def test_whoever_asks_sees_that_documents_were_about_to_go(state: IndexState) -> None:
    entry, key = recording(), ONE[-16:]
    seen = []
    for step, turn in (("open", 0), ("complete", 0), ("clearing", 1), ("complete", 1)):
        segments = DIGESTS if step == "complete" else {}
        state.put(entry, step, turn=turn, segments=segments)  # type: ignore[arg-type]
        seen.append(state.segments([key])[key])
    assert seen == [(0, {}), (0, DIGESTS), (1, {}), (1, DIGESTS)]


def test_an_index_says_which_segments_it_has(state: IndexState) -> None:
    state.put(recording(), "open", turn=1)
    for number, digest in DIGESTS.items():
        state.put_segments(ONE[-16:], {number: digest})
    found = indexed(state)
    assert found is not None
    assert (found.state, found.segments) == ("open", DIGESTS)


# Documents.


@pytest.fixture
def filled(state: IndexState, database: Database) -> IndexState:
    """Two recordings with documents in two collections, at times 0 to 4, segment by segment."""
    for name in ("one", "two"):
        database.ensure_collection(name)
        for of in (ONE, OTHER):
            for at in range(5):
                made = document(of, at, at, at)
                database.replace(name, {"_id": made["_id"]}, made)
    return state


def left(database: Database, of: str, name: str = "one") -> list[int]:
    found = database.find(name, {"_meta.rec": of[-16:]}, sort=[("_id", 1)])
    return [d["_meta"]["ref"]["seg"] for d in found]


def test_clearing_removes_the_documents_of_one_recording(
    filled: IndexState, database: Database
) -> None:
    filled.clear(ONE[-16:], ["/one", "/not_there"])
    assert left(database, ONE) == []
    assert left(database, ONE, "two") == list(range(5))
    assert left(database, OTHER) == list(range(5))


def test_clearing_leaves_the_segments_that_are_to_stay(
    filled: IndexState, database: Database
) -> None:
    filled.clear(ONE[-16:], ["/one"], but=[1, 3])
    assert left(database, ONE) == [1, 3]
    assert left(database, OTHER) == list(range(5))


def test_clearing_looks_at_some_times_only(filled: IndexState, database: Database) -> None:
    filled.clear(ONE[-16:], ["/one"], (1, 3))
    assert left(database, ONE) == [0, 4]
    filled.clear(ONE[-16:], ["/one"], (4, 2**63 - 1))
    assert left(database, ONE) == [0]
    assert left(database, OTHER) == list(range(5))


@pytest.mark.parametrize("key", ["other", "", "0123", None, 5, {"a": 1}])
def test_documents_of_what_is_no_recording_can_be_cleared(
    filled: IndexState, database: Database, key: Any
) -> None:
    made = {"_id": b"x" * 24, "_meta": {"rec": key}}
    database.replace("one", {"_id": made["_id"]}, made)
    filled.clear(key)
    assert database.count("one", {"_id": made["_id"]}) == 0
    assert left(database, ONE) == left(database, OTHER) == list(range(5))


def test_a_recording_leaves_the_mirror_last_and_alone(
    filled: IndexState, database: Database
) -> None:
    filled.put(recording(), "removing", turn=1)
    filled.put(recording(OTHER), "complete", turn=1)
    filled.remove(ONE[-16:])
    assert filled.of().keys() == {OTHER[-16:]}
    assert left(database, ONE) == list(range(5))


def test_collections_of_topics_are_not_ours(filled: IndexState, database: Database) -> None:
    filled.put(recording(), "complete", turn=1)
    filled.claim({"id": "x"})
    assert sorted(filled.document_collections()) == ["one", "two"]
    assert {RECORDINGS, STORE} <= set(database.list_collections())
    assert all(name.startswith(CATALOG_PREFIX) for name in (RECORDINGS, STORE))


# Whose it is.


def test_a_database_says_whose_it_is(state: IndexState) -> None:
    assert state.mark() is None
    state.put(recording(), "clearing", turn=1)
    assert state.mark() is None
    one = state.claim({"id": "a", "host": "h", "path": "/p"})
    assert state.mark() == one
    assert one.items() >= {"_id": "store", "id": "a", "host": "h", "path": "/p"}.items()
    other = state.claim({"id": "b"})
    assert state.mark() == other == {"_id": "store", "id": "b", "index": other["index"]}
    assert other["index"] != one["index"]  # nothing is believed that was known of the old one


def test_the_mirror_of_many_topics_fits_into_a_document(state: IndexState) -> None:
    entry = recording(topics=tuple(f"/robot/part{number}" for number in range(65_535)))
    state.put(entry, "complete", turn=1, segments=DIGESTS)
    assert state.is_mirrored(entry)
    assert state.of()[entry.key].is_whole(entry)
    other = replace(entry, channels=[*entry.channels[1:], entry.channels[0]])
    assert not state.is_mirrored(other)
