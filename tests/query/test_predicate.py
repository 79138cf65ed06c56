"""What a predicate is for MongoDB."""

from __future__ import annotations

import pytest

from hybridlog.query.predicate import Predicate


def test_who_gets_the_filter_may_change_it() -> None:
    asked = Predicate({"$and": [{"x": {"$in": [1, 2]}}, {"y": 3}]})
    given = asked.to_filter()
    conditions = given["$and"]
    assert isinstance(conditions, list)
    conditions[0]["x"]["$in"].clear()
    conditions.clear()
    assert asked.to_filter() == {"$and": [{"x": {"$in": [1, 2]}}, {"y": 3}]}
    assert given == {"$and": []}


@pytest.mark.parametrize(("query", "asks"), [({}, False), ({"x": 1}, True)])
def test_whether_it_asks_for_anything(query: dict[str, object], *, asks: bool) -> None:
    assert bool(Predicate(query)) is asks
