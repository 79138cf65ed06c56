"""What a predicate is for MongoDB and for columns."""

from __future__ import annotations

import numpy as np
import pytest

from hybridlog.query import predicate as module
from hybridlog.query.column_filter import combined
from hybridlog.query.predicate import Predicate
from hybridlog.schema.column import Scalars

TYPES = {"x": "int32", "y": "float64"}
COLUMNS = {
    "x": Scalars(np.array([1, 2, 3, 4], np.int32), "number"),
    "y": Scalars(np.array([0.5, 1.5, 2.5, 3.5]), "number"),
}


def test_what_it_is_on_columns_is_found_out_once_for_the_same_types() -> None:
    asked = Predicate({"x": {"$gt": 2}})
    found = asked.on_columns(TYPES)
    assert found is not None
    assert found.mask(COLUMNS, 4).tolist() == [False, False, True, True]
    assert asked.on_columns(TYPES) is found
    assert asked.on_columns({"x": "string"}) is not found
    assert asked.on_columns({"y": "float64"}) is None
    assert asked.on_columns(TYPES) is found


def test_types_that_come_to_lie_where_others_were_are_not_taken_for_them() -> None:
    asked = Predicate({"x": 1})
    for number in range(4 * module._MOST_KINDS):
        kind = ("int32", "uint64")[number % 2]  # the second cannot be a column
        assert (asked.on_columns({"x": kind}) is None) is (kind == "uint64")
    assert len(asked._of_types) <= module._MOST_KINDS


def test_several_must_all_hold_and_all_be_answered() -> None:
    two = [Predicate({"x": {"$gt": 1}}), Predicate({"y": {"$lt": 3}})]
    found = combined([one.on_columns(TYPES) for one in two])
    assert found is not None
    assert found.fields == {"x", "y"}
    assert found.mask(COLUMNS, 4).tolist() == [False, True, True, False]
    assert combined([one.on_columns({"x": "int32"}) for one in two]) is None


def test_who_gets_the_filter_may_change_it() -> None:
    asked = Predicate({"$and": [{"x": {"$in": [1, 2]}}, {"y": 3}]})
    given = asked.to_filter()
    conditions = given["$and"]
    assert isinstance(conditions, list)
    conditions[0]["x"]["$in"].clear()
    conditions.clear()
    assert asked.to_filter() == {"$and": [{"x": {"$in": [1, 2]}}, {"y": 3}]}
    assert asked == Predicate(asked.to_filter()) != Predicate(given)


@pytest.mark.parametrize(("query", "asks"), [({}, False), ({"x": 1}, True)])
def test_whether_it_asks_for_anything(query: dict[str, object], *, asks: bool) -> None:
    assert bool(Predicate(query)) is asks
