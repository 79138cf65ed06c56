from __future__ import annotations

import math
import pickle
import re

import numpy as np
import pytest
from bson import Code, Int64, ObjectId, Regex
from pymongo.collection import Collection

from hybridlog.query.predicate.from_mongo import from_mongo
from hybridlog.query.predicate.parser import parse
from hybridlog.query.predicate.to_mongo import replaced, to_mongo
from hybridlog.query.predicate.tree import Node, Opaque
from hybridlog_storage.errors import WhereError

Document = dict[str, object]


@pytest.mark.parametrize(
    "query",
    [
        {},
        {"position": 0.0},
        {"a.b": {"$gt": 1, "$lt": 2}, "c": None},
        {"$and": [{"a": 1}, {"$or": [{"b": 2}, {"c": {"$exists": False}}]}]},
        {"a": {"$in": [1, "x", None]}, "b": {"$nin": [1]}},
        {"a": {"$not": {"$gt": 5}}},
        {"a": {"$elemMatch": {"b": 1, "c": {"$gt": 2}}}},
        {"a": {"$elemMatch": {"$gt": 1, "$lt": 2}}},
        {"a": {"$all": [1, 2]}},
        {"a": {"$all": [{"$elemMatch": {"b": 1}}]}},
        {"a": {"$size": 3}, "b": {"$type": ["int", "double"]}, "c": {"$mod": [4, 0]}},
        {"a": {"$regex": "^x", "$options": "i"}},
        {"a": {"b": 1, "c": [1, {"d": 2}]}},
        {"_id": b"12345678901234567890"},
        {"_id": ObjectId("0123456789abcdef01234567"), "n": Int64(5)},
        {"$expr": {"$gt": [{"$size": {"$ifNull": ["$a", []]}}, 3]}},
        {"$expr": {"$let": {"vars": {"x": "$a"}, "in": {"$eq": ["$$x", {"$literal": "$b"}]}}}},
        {"a": math.inf},
    ],
)
def test_allowed(query: Document, collection: Collection[Document]) -> None:
    collection.delete_many({})
    predicate = from_mongo(query)
    assert bool(predicate) is bool(query)
    assert pickle.loads(pickle.dumps(predicate)) == predicate
    assert hash(predicate) == hash(from_mongo(query))

    def ask(node: Node) -> Node:
        list(collection.find(to_mongo(node)))
        return node

    replaced(predicate.root, ask)
    if isinstance(predicate.root, Opaque):
        assert to_mongo(predicate.root) == query


@pytest.mark.parametrize(
    ("query", "text"),
    [
        ({"x": 5}, "x == 5"),
        ({"x": {"$gt": 1, "$lte": 2}}, "x > 1 and x <= 2"),
        ({"x": {"$ne": "a"}}, "not x == 'a'"),
        ({"a.0.b": {"$in": [1, 2.5, True]}}, "a[0].b in [1, 2.5, true]"),
        ({"x": {"$nin": [1]}}, "not x in [1]"),
        ({"x": {"$exists": False}}, "x missing"),
        ({"x": {"$not": {"$lt": 1}}}, "not x < 1"),
        ({"x": 1, "y": 2}, "x == 1 and y == 2"),
        ({"$or": [{"x": 1}, {"y": 2}]}, "x == 1 or y == 2"),
        ({"$nor": [{"x": 1}, {"y": 2}]}, "not (x == 1 or y == 2)"),
        ({"$comment": "why", "x": 1}, "x == 1"),
        ({"x": Int64(5)}, "x == 5"),
        ({"x": 2**64 - 1}, "x == 18446744073709551615"),
        ({"s": {"$regex": "^x", "$options": "si"}}, "s ~ '(?is)^x'"),
        ({"s": {"$not": re.compile("x", re.MULTILINE)}}, "not s ~ '(?m)x'"),
        ({"x": math.nan}, "x == nan"),
        ({"x": {"$in": [True]}}, "x in [true]"),
    ],
)
def test_the_same_tree_as_the_text(query: Document, text: str) -> None:
    assert from_mongo(query) == parse(text)
    assert hash(from_mongo(query)) == hash(parse(text))


@pytest.mark.parametrize(
    "query",
    [
        {"a": None},  # a missing field, too
        {"a": {"$in": [1, None]}},
        {"a": {"$lt": True}},
        {"a": {"$lte": math.nan}},
        {"a": [1, 2]},
        {"a": {"$eq": {"b": 1}}},
        {"a..b": 1},
        {"_id": 1},
        {"a": {"$size": 3}},
        {"$expr": {"$gt": ["$a", 1]}},
        {"a": b"x"},
    ],
)
def test_what_only_mongodb_says_stays_with_it(query: Document) -> None:
    predicate = from_mongo(query)
    assert isinstance(predicate.root, Opaque)
    assert predicate.is_opaque
    assert to_mongo(predicate.root) == query


@pytest.mark.parametrize(
    ("query", "place"),
    [
        ({"$where": "sleep(1000)"}, r"\$where"),
        ({"a": {"$where": "1"}}, r"\$where"),
        ({"$or": [{"a": 1}, {"$where": "1"}]}, r"\$or → \$where"),
        ({"$expr": {"$function": {"body": "x", "args": [], "lang": "js"}}}, r"\$function"),
        ({"$expr": {"$eq": [1, {"$accumulator": {}}]}}, r"\$accumulator"),
        ({"$expr": {"$range": [0, 10**9]}}, r"\$range"),
        ({"$expr": {"$reduce": {}}}, r"\$reduce"),
        ({"$expr": {"$gt": [1, 2], "$lt": [1, 2]}}, "one operator"),
        ({"$text": {"$search": "x"}}, r"\$text"),
        ({"$jsonSchema": {}}, r"\$jsonSchema"),
        ({"a": {"$near": [0, 0]}}, r"\$near"),
        ({"a": {"$elemMatch": {"$where": "1"}}}, r"\$where"),
        ({"a": {"$elemMatch": {"$or": [{"$where": "1"}]}}}, r"\$where"),
        ({"a": {"$elemMatch": {"b": {"$where": "1"}}}}, r"\$where"),
        ({"a": {"$elemMatch": {"$expr": {}, "$or": [{}]}}}, r"\$expr"),
        ({"a": {"$all": [{"$elemMatch": {"$where": "1"}}]}}, r"\$where"),
        ({"a": {"$not": {"$where": "1"}}}, r"\$where"),
        ({"a": {"$not": 5}}, "mapping"),
        ({"a": {"$not": {}}}, "operators"),
        ({"a": {"$eq": {"$where": "1"}}}, r"\$where"),
        ({"a": {"b": {"$gt": 1}}}, r"\$gt"),
        ({"a": {"$gt": 1, "b": 2}}, "mixes"),
        ({"a": {"$in": 5}}, "list"),
        ({"$or": []}, "list"),
        ({"$or": {}}, "list"),
        ({"$or": [5]}, "mapping"),
        ({"a": Code("x")}, "Code"),
        ({"a": [Code("x", {})]}, "Code"),
        ({"a": {"$regex": "(?=a)"}}, "RE2"),
        ({"a": {"$elemMatch": {"$regex": "a"}}}, "within"),
        ({"a": {"$elemMatch": {"b": {"$regex": "a"}}}}, "within"),
        ({"a": {"$all": [{"$elemMatch": {"b": {"$not": {"$regex": "a"}}}}]}}, "within"),
        ({"a": {"$elemMatch": {"b": re.compile("a")}}}, "Pattern"),
        ({"a": {"$in": [re.compile("a")]}}, "Pattern"),
        ({"_id": {"$regex": "a"}}, "field of a message"),
        ({"a": {"$regex": "a", "$options": "x"}}, "options"),
        ({"a": {"$options": "i"}}, r"\$options"),
        ({"a": re.compile("(?=a)")}, "RE2"),
        ({"a": re.compile("a", re.VERBOSE)}, "flags"),
        ({"a": re.compile(b"a")}, "string"),
        ({"a": Regex("(?<=a)")}, "RE2"),
        ({"a": {"$mod": [2**63, 0]}}, "64 bits"),
        ({"a": [1, {"b": -(2**63) - 1}]}, "64 bits"),
        ({"a": object()}, "object"),
        ({"a": {1, 2}}, "set"),
        ({"a": 1j}, "complex"),
        ({"a": np.zeros(3)}, "ndarray"),
        ({"a": "\ud800"}, "surrogates"),
        ({"\ud800": 1}, "Unicode"),
        ({"a\0": 1}, "NUL"),
        ({5: 1}, "no string"),
        ({"a": "x" * 2_000_000}, "too large"),
        ({"a": [0] * 30_000}, "too large"),
    ],
)
def test_refused(query: Document, place: str) -> None:
    with pytest.raises(WhereError, match=place):
        from_mongo(query)


def test_deep_filters() -> None:
    deep: object = 1
    for _ in range(5_000):
        deep = {"a": deep}
    with pytest.raises(WhereError, match="deeper"):
        from_mongo({"x": deep})
    clause: Document = {"a": 1}
    for _ in range(5_000):
        clause = {"$or": [clause]}
    with pytest.raises(WhereError, match="deeper"):
        from_mongo(clause)
    with pytest.raises(WhereError, match="mapping"):
        from_mongo([])  # type: ignore[arg-type]


def test_values_become_plain() -> None:
    query = {
        "a": np.float32(0.5),
        "b": np.int64(2),
        "c": re.compile("^x", re.IGNORECASE),
        "d": np.str_("s"),
        "e": np.bool_(True),
    }
    expected = "a == 0.5 and b == 2 and c ~ '(?i)^x' and d == 's' and e == true"
    assert from_mongo(query) == parse(expected)
    whole = to_mongo(from_mongo({"a": (1, np.int64(2))}).root)
    assert whole == {"a": [1, 2]}
    assert [type(value) for value in whole["a"]] == [int, int]  # type: ignore[attr-defined]
