"""MongoDB filters: MongoDB's own answers, joined with everything else a question says."""

from __future__ import annotations

import json
import math
import pickle
import re
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import bson
import numpy as np
import pytest
from bson import Decimal128, Int64, MinKey
from pymongo import MongoClient

import hybridlog as hl
from hybridlog.contract import Contract
from hybridlog.follow.child import Trigger
from hybridlog.query.choice import Choice
from hybridlog.query.index_reader import keys_of
from hybridlog.query.query import Query
from hybridlog_storage.errors import (
    DatabaseError,
    HybridlogError,
    IncompleteError,
    StoreError,
    UsageError,
    WhereError,
)
from hybridlog_storage.messages import Channel, Schema
from tests.cli.within import answer

pytestmark = pytest.mark.mongo("embedded")

SECOND = 10**9
THINGS = Schema(
    "pkg/T",
    "ros1msg",
    b"""float64 x
uint64 u
string s
time at
bool odd
float32[] ranges
float64[2] two
float64[40] many
Part[] parts
================================================================================
MSG: pkg/Part
int32 n
int32 v
uint8[] data
""",
)
THING = Channel("/t", "ros1", THINGS)
JSON = Channel("/j", "json", None)
COUNT = 20


def array(values: list[float], kind: str) -> bytes:
    return np.uint32(len(values)).tobytes() + np.array(values, kind).tobytes()


def thing(n: int, ranges: int = 100, data: int = 2) -> bytes:
    text = f"odd {n}" if n % 2 else "even"
    parts = [np.array([n, 10 * n], "<i4").tobytes() + array([n] * data, "u1")] * 2
    return b"".join(
        (
            np.float64(n).tobytes(),
            np.uint64(2**64 - 1 if n == 7 else n).tobytes(),
            np.uint32(len(text)).tobytes() + text.encode(),
            np.array([1_748_937_610 + n, 0], "<u4").tobytes(),
            bytes([n % 2]),
            array([n] * ranges, "<f4"),
            np.array([n, n + 1], "<f8").tobytes(),
            np.full(40, n, "<f8").tobytes(),
            np.uint32(len(parts)).tobytes() + b"".join(parts),
        )
    )


def record(store: hl.Store, name: str, begin: int, **choices: int) -> None:
    with store.start(name) as recording:
        for n in range(COUNT):
            at = (begin + n) * SECOND
            recording.write(THING, thing(n, **choices), log_time=at)
            grid = list(range(40 if n == 3 else 2))
            said = {"n": n, "grid": grid, "deep": {"n": 1, "v": n}, "of": [{"row": grid}]}
            recording.write(JSON, json.dumps(said).encode(), log_time=at)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("filters") / "store"
    with hl.open(path, create=True, require_database=True) as store:
        record(store, "one", 0)
        record(store, "two", 100)
    return path


@pytest.fixture(scope="module")
def store(path: Path) -> Iterator[hl.Store]:
    with hl.open(path) as opened:
        yield opened


def seqs(query: Query) -> list[tuple[str, int]]:
    return [(message.recording, message.seq) for message in query]


def nested(operator: str) -> dict[str, object]:
    """A filter that is nowhere deeper than it may be."""
    found: dict[str, object] = {"x": 1}
    for _ in range(25):
        found = {operator: [found, {"x": 2}]}
    return found


@pytest.mark.parametrize(
    "own",
    [
        *map(nested, ("$and", "$or", "$nor")),
        {"x": 5},
        {"x": {"$in": [1, 4.0, 77]}, "s": "even"},
        {"$and": [{"x": {"$gte": 3}}, {"$or": [{"s": "odd 5"}, {"two.1": {"$lt": 6}}]}]},
        {"$nor": [{"x": {"$lt": 18}}, {"s": "even"}]},
        {"s": {"$regex": "ODD 1.?$", "$options": "i"}},
        {"s": re.compile("^e(?=v)")},
        {"s": {"$not": re.compile("^e")}},
        {"u": {"$gt": 2.0**63}},
        {"ranges.min": {"$lt": 2}},
        {"two": {"$size": 2}, "x": {"$mod": [5, 0]}},
        {"two": {"$elemMatch": {"$gt": 3, "$lt": 5}}},
        {"parts": {"$elemMatch": {"n": 4, "v": {"$type": "int"}}}},
        {"parts.v": {"$all": [40]}},
        {"parts.0.data.1": 6},
        {"_meta.t": {"$gte": Int64(105 * SECOND)}},
        {"_meta.inserted_at": {"$gt": datetime(2020, 1, 1, tzinfo=UTC)}, "x": 3},
        {"at": {"$gt": 1_748_937_620 * SECOND}, "odd": {"$ne": True}},
        {"at": {"$ne": None}, "x": {"$in": [None, 3]}, "s": {"$gt": MinKey()}},
        {"x": Decimal128("3")},
        {"_meta.ref.len": {"$gt": 10}, "_meta.error": {"$exists": False}, "x": 3},
        {"x": {"$nin": [1, math.inf]}, "s": {"$not": {"$regex": "a"}}},
        {"_id": b"12345678901234567890"},
        {},
    ],
    ids=lambda own: str(own)[:60],
)
def test_mongodb_answers_as_it_does_by_itself(store: hl.Store, own: dict[str, object]) -> None:
    query = store.topic("/t").where(own)
    assert pickle.loads(pickle.dumps(query.question)) == query.question
    found = seqs(query)
    address = store.index.address()
    labels = {one.key: one.id for one in store.recordings()}
    with MongoClient(address.uri) as client:
        collection = client[address.database]["t"]
        want = [
            (labels[one["_meta"]["rec"]], one["_meta"]["seq"])
            for one in collection.find(own).sort("_id")
        ]
    assert found == want
    assert query.count() == len(want)
    assert seqs(query.reverse()) == want[::-1]
    assert not query.completeness().sentences


def test_it_is_joined_with_all_else(store: hl.Store) -> None:
    query = store.topic("/t").where({"x": {"$gte": 4}})
    both = query.where("x < 12 and ranges > 5").where({"s": "even"})
    assert [m.fields["x"] for m in both] == [6, 8, 10] * 2
    assert both.count() == 6
    assert [m.fields["x"] for m in both.between(107 * SECOND, 200 * SECOND)] == [8, 10]
    assert [m.fields["x"] for m in both.in_recording("one").reverse().limit(2)] == [10, 8]
    assert [m.fields["x"] for m in both.every(2)] == [6, 10, 8]
    assert both.fields("x").to_pandas()["x"].tolist() == [6, 8, 10] * 2
    assert [(i.begin_ns, i.end_ns) for i in both.in_recording("one").intervals()] == [
        (n * SECOND, (n + 1) * SECOND) for n in (6, 8, 10)
    ]
    assert both.stats("x")[0].count == 6
    near = store.topic("/j").during(both.windows("1ns", "1ns"))
    assert [m.fields["n"] for m in near] == [6, 8, 10] * 2
    again = pickle.loads(pickle.dumps(both.question))
    assert hash(again) == hash(both.question)
    assert Query(store.session, again).count() == 6
    assert store.all_topics().where({"_meta.seq": {"$lt": 4}}).count() == 8
    assert store.topic("/t").where({"x": -1}).count() == 0
    assert len(store.choose(Choice.of(where='t: {"x": 3}')).summaries) == 2
    assert store.choose(Choice.of(where='t: {"x": -3}')).summaries == ()


@pytest.mark.parametrize(
    ("topic", "own", "says"),
    [
        (
            "/t",
            {"ranges": {"$gt": 3}},
            r"ranges of more than 32 .*predicate, .*, or, if all .*ranges\.min",
        ),
        ("/t", {"ranges.5": 3}, r"ranges\.min"),
        ("/t", {"ranges.5": {"$exists": True}}, r"ranges\.min"),
        ("/t", {"ranges": {"$size": 100}}, r"ranges\.n"),
        ("/t", {"$nor": [{"ranges": {"$elemMatch": {"$gt": 3}}}]}, r"ranges\.min"),
        ("/t", {"many.0": 3}, r"many\.min"),
        ("/t", {"two.min": {"$lt": 3}}, r"two of up to 32 elements.*predicate, such as 'two\.min"),
        ("/j", {"grid": 1}, r"grid\.min"),
        ("/j", {"grid.1": 1}, r"grid\.min"),
        ("/j", {"grid.max": 39}, r"grid of up to 32"),
        ("/j", {"of.row": 1}, r"of\.row\.min"),
        ("/j", {"of": [{"row": [0, 1]}]}, None),
    ],
)
def test_arrays_that_the_index_has_otherwise(
    store: hl.Store, topic: str, own: dict[str, object], says: str | None
) -> None:
    query = store.topic(topic).where(own)
    if says is None:
        assert query.count() == 2 * (COUNT - 1)
        return
    with pytest.raises(WhereError, match=says):
        query.count()
    with pytest.raises(WhereError, match=says):
        list(query.limit(1))


def test_short_arrays_are_whole(tmp_path: Path) -> None:
    with hl.open(tmp_path / "store", create=True, require_database=True) as store:
        record(store, "short", 0, ranges=3)
        assert store.topic("/t").where({"ranges": {"$gt": 17}}).count() == 2
        assert store.topic("/t").where({"parts.data.0": 4}).count() == 1
        assert store.topic("/j").where({"deep.v": {"$lt": 3}}).count() == 3
        record(store, "long", 100, data=50)
        assert store.topic("/t").in_recording("short").where({"ranges": 3}).count() == 1
        with pytest.raises(WhereError, match=r"parts\.data\.min"):
            store.topic("/t").where({"parts.data": 4}).count()


@pytest.mark.parametrize(
    ("own", "says"),
    [
        ({"$where": "sleep(1000)"}, r"\$where"),
        ({"y": 1}, "there is no field y"),
        ({"two.2": 1}, "two has 2 elements"),
    ],
)
def test_what_is_refused(store: hl.Store, own: dict[str, object], says: str) -> None:
    with pytest.raises(WhereError, match=says):
        store.topic("/t").where(own)


@pytest.mark.parametrize(
    "own",
    [
        {"x": {"$not": {}}},
        {"x": {"$in": 5}},
        {"$or": []},
        {"$or": {"x": 1}},
        {"$or": [5]},
    ],
    ids=str,
)
def test_what_mongodb_does_not_understand(store: hl.Store, own: dict[str, object]) -> None:
    with pytest.raises(WhereError, match="MongoDB does not understand the predicate: "):
        store.topic("/t").where(own).count()


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("{x: 1}", "Expecting property name"),
        ('{"x": 1} and x > 2', "Extra data"),
        ('{"xx": 1}', "no field xx"),
        ('{"x":' * 50_000 + "1" + "}" * 50_000, "deeply"),
        ('{"s": "' + "x" * 2_000_000 + '"}', "too large"),
        ('{"x": 99999999999999999999}', "64 bits"),
    ],
)
def test_text_that_is_refused(store: hl.Store, text: str, says: str) -> None:
    with pytest.raises(WhereError, match=says):
        store.topic("/t").where(text)


def test_where_only_predicates_are_possible(store: hl.Store) -> None:
    with pytest.raises(UsageError, match="write a predicate instead of a MongoDB filter"):
        store.topic("/t").where({"x": 1}).follow()
    for text in ("_meta.error exists", "x > 1 and _meta.ref.len > 4", "_meta.inserted_at > 1"):
        with pytest.raises(WhereError, match="no field _meta"):
            store.topic("/t").where(text)
    with pytest.raises(WhereError, match="write a predicate"):
        Trigger.of('t: {"x": 1}')
    with pytest.raises(HybridlogError, match="write a predicate"):
        Contract.parse("topics: {t: {share: {'{\"x\": 1}': 50%}}}")


def test_the_command_line_takes_json(path: Path) -> None:
    def fetched(*words: str, code: int = 0) -> str:
        done = answer("fetch", "-t", "/t", *words, store=path, code=code)
        return done.out

    assert fetched("--where", '{"x": {"$in": [2, 3]}}', "--where", "x > 2", "--count") == "2\n"
    lines = fetched("--where", ' {"s": {"$regex": "7$"}}', "--fields", "x", "-F", "csv")
    assert lines.splitlines()[1].endswith(',"one",7')
    fetched("--where", '{"$where": "1"}', code=2)
    found = answer("intervals", "-t", "/t", "--where", '{"x": 4}', "-F", "csv", store=path)
    assert len(found.lines) == 3


def test_what_the_index_lacks_is_said(tmp_path: Path) -> None:
    path = tmp_path / "store"
    with hl.open(path, create=True, require_database=True) as store:
        record(store, "one", 0)
    with hl.open(path, mongo="none") as store:
        record(store, "two", 100)
        with pytest.raises(DatabaseError, match=r"predicate needs none.*--mongo embedded"):
            store.topic("/t").where({"x": 3}).count()
    with hl.open(path, mongo="embedded") as store:
        query = store.topic("/t").where({"x": 3})
        with pytest.raises(IncompleteError, match="20 messages of two are not in the index"):
            query.completeness().check()
        assert query.count() == 1
        assert query.counters.unindexed == query.completeness().unindexed == 20
        (says,) = query.completeness().sentences
        assert says.startswith("20 messages of two are not in the index, nor in this answer")
        assert "`hybridlog index rebuild`" in says
        part = query.between(105 * SECOND, 108 * SECOND)
        assert (part.count(), part.counters.unindexed) == (0, 3)
        assert not query.in_recording("one").completeness().sentences
    answer(
        "fetch",
        "-t",
        "/t",
        "--where",
        '{"x": 3}',
        "--strict",
        store=path,
        code=IncompleteError.exit_code,
    )
    answer("index", "rebuild", "-q", store=path)
    with hl.open(path) as store:
        query = store.topic("/t").where({"x": 3})
        assert query.count() == 2
        assert not query.completeness().sentences


def test_messages_without_fields_are_told(tmp_path: Path) -> None:
    """One is broken, and one too large for a document."""
    with hl.open(tmp_path / "store", create=True, require_database=True) as store:
        with store.start("one") as recording:
            for n, text in enumerate(("{", '{"n": 1}', '{"n": 2}', "large")):
                large = json.dumps({"n": 3, "text": "x" * 9_000_000})
                raw = (large if text == "large" else text).encode()
                recording.write(JSON, raw, log_time=n * SECOND)
        query = store.topic("/j").where({"n": {"$ne": 1}})
        assert query.count() == 1
        assert query.counters.unreadable == 2
        assert "could not be tested: no fields in the index" in query.completeness().sentences[0]
        both = query.where("n < 5")
        assert (both.count(), both.counters.unreadable) == (1, 2)
        assert store.topic("/j").where({"_meta.error": {"$exists": True}}).count() == 2


@pytest.mark.parametrize(
    "document", [{"_meta": {"seq": Int64(1)}}, {"_id": b"x" * 23}, {"_id": "x" * 24}]
)
def test_a_strange_document_is_refused(document: dict[str, object]) -> None:
    with pytest.raises(StoreError, match="index rebuild"):
        keys_of(bson.encode(document))
