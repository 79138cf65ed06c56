"""Predicates as values: equal, hashed, pickled, joined, shown."""

from __future__ import annotations

import math
import pickle

from hybridlog.query.predicate.mongo_filter import mongo_filter
from hybridlog.query.predicate.parser import parse
from hybridlog.query.predicate.tree import And, Condition, Field, Predicate

TEXTS = [
    "x < 5",
    "x == nan",
    "x == 1",
    "x == true",
    "x in [1, 'a']",
    "x in [true, 'a']",
    "x not in [1, 'a']",
    "a[0].b exists",
    "a.b exists",
    "a[0].b missing",
    "a[0:5] < 1",
    "a[0:] < 1",
    "a[0:5].b missing",
    "a[3][1:2].min in [1, 2]",
    "s ~ 'a'",
    "s !~ 'a'",
    "not (x < 5 or s ~ 'a') and y == 'x'",
    "x == null",
    "x == 'null'",
]


def test_predicates_are_equal_when_they_ask_for_the_same() -> None:
    predicates = [parse(text) for text in TEXTS]
    assert len(set(predicates)) == len(TEXTS)
    for predicate in predicates:
        again = pickle.loads(pickle.dumps(predicate))
        assert again == predicate
        assert hash(again) == hash(predicate)
        assert again.text == predicate.text
    assert parse("x   ==  1") == parse("1 == x")
    one, other = (Predicate(Condition(Field(("x",)), "==", (float("nan"),))) for _ in range(2))
    assert one == other == parse("x == nan")
    assert hash(one) == hash(other)
    assert parse("x == 1") != 1


def test_joined() -> None:
    everything = mongo_filter({}, None)
    one, two = parse("x < 5"), parse("y > 1 and z == 2")
    assert not everything
    assert one
    assert one & everything is one
    assert everything & one is one
    assert not everything & everything
    assert one & two == parse("x < 5 and y > 1 and z == 2")
    assert parse((one & two).text).fields() == ["x", "y", "z"]
    assert (two & one).fields() == ["y", "z", "x"]
    assert isinstance((one & two).root, And)


def test_a_predicate_does_not_change_with_its_filter() -> None:
    query: dict[str, object] = {"a": [1, {"b": 2}]}
    predicate = mongo_filter(query, None)
    inner = query["a"]
    assert isinstance(inner, list)
    inner[1]["b"] = 3
    assert predicate == mongo_filter({"a": [1, {"b": 2}]}, None)
    assert predicate != mongo_filter(query, None)
    assert math.isnan(parse("x == nan").root.operands[0])  # type: ignore[union-attr, arg-type]
