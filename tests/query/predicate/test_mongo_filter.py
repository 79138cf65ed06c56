from __future__ import annotations

import re

import numpy as np
import pytest
from bson import Regex

from hybridlog.query.predicate.mongo_filter import mongo_filter
from hybridlog_storage.errors import WhereError

Document = dict[str, object]


@pytest.mark.parametrize(
    ("query", "place"),
    [
        ({"$where": "sleep(1000)"}, r"\$where"),
        ({"a": {"$where": "1"}}, r"\$where"),
        ({"$or": [{"a": 1}, {"$where": "1"}]}, r"\$or → \$where"),
        ({"$expr": {"$function": {"body": "x", "args": [], "lang": "js"}}}, r"\$expr"),
        ({"a": {"$elemMatch": {"$where": "1"}}}, r"\$where"),
        ({"a": {"$elemMatch": {"b": {"$where": "1"}}}}, r"\$where"),
        ({"a": {"$all": [{"$elemMatch": {"$where": "1"}}]}}, r"\$where"),
        ({"a": {"$not": {"$where": "1"}}}, r"\$where"),
        ({"a": {"$eq": {"$where": "1"}}}, r"\$where"),
        ({"a": {"$gt": 1, "b": 2}}, "a → b: .* not allowed"),
        ({"a": {"$mod": [2**63, 0]}}, "64 bits"),
        ({"a": [1, {"b": -(2**63) - 1}]}, "64 bits"),
        ({"a": object()}, "object"),
        ({"a": np.zeros(3)}, "ndarray"),
        ({"a": "\ud800"}, "surrogates"),
        ({"\ud800": 1}, "surrogates"),
        ({"a\0": 1}, "NUL"),
        ({5: 1}, "string keys"),
        ({"a": [0] * 200_000}, "too large"),
    ],
)
def test_refused(query: Document, place: str) -> None:
    with pytest.raises(WhereError, match=place):
        mongo_filter(query, None)


def test_deep_filters() -> None:
    deep: object = 1
    for _ in range(5_000):
        deep = {"a": deep}
    with pytest.raises(WhereError, match="deep"):
        mongo_filter({"x": deep}, None)
    for operator in ("$and", "$or", "$nor"):
        deepest: Document = {"a": 1}
        for _ in range(25):
            deepest = {operator: [deepest, {"b": 2}]}
        assert mongo_filter(deepest, None).filters  # MongoDB takes it: see `test_mongo_filters.py`
    clause: Document = {"a": 1}
    for _ in range(5_000):
        clause = {"$or": [clause]}
    with pytest.raises(WhereError, match="deep"):
        mongo_filter(clause, None)
    with pytest.raises(WhereError, match="mapping"):
        mongo_filter([], None)  # type: ignore[arg-type]


def test_values_become_plain() -> None:
    query = {
        "a": (1, np.int64(2), np.float32(0.5), np.str_("s"), np.bool_(True)),
        "b": re.compile("^x", re.IGNORECASE),
        "c": {"$regex": re.compile("y"), "$not": Regex("z", "m")},
    }
    (node,) = mongo_filter(query, None).filters
    plain = node.to_filter()
    assert plain["a"] == [1, 2, 0.5, "s", True]
    assert [type(value) for value in plain["a"]] == [int, int, float, str, bool]  # type: ignore[attr-defined]
    assert plain["b"] == Regex.from_native(query["b"])  # type: ignore[type-var]
    assert [*plain["c"]] == ["$regex", "$not"]  # type: ignore[call-overload]


def test_the_paths_it_asks_for() -> None:
    query: Document = {
        "a": 1,
        "b": {"$exists": True},
        "$or": [{"c.0": {"$gt": 1}}, {"d": {"$eq": {"e": 1}}}],
        "f": {"$elemMatch": {"g": 1}},
        "_meta.seq": {"$in": [1]},
    }
    (node,) = mongo_filter(query, None).filters
    assert dict(node.paths) == {
        **dict.fromkeys(("a", "c.0", "d", "f", "f.g", "_meta.seq"), True),
        "b": False,
    }
    assert node.asks_fields
    assert not mongo_filter({"_meta.error": {"$exists": True}}, None).asks_fields
