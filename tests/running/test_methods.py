"""Every method of `Query` and `Store` about a recording that goes on: right at any moment."""

from __future__ import annotations

import inspect
from collections.abc import Iterator

import pytest

import hybridlog as hl
from hybridlog.query.query import Query
from tests.running.methods import EXEMPT_METHODS, METHODS, STORE, same
from tests.running.running import NO_MONGODB, Running, begun

SPECIAL = {"__iter__", "__getitem__", "__eq__", "__hash__", "__repr__"}
PRIVATE = {"_repr_html_", "_ipython_key_completions_"}
READERS = ("writer", "before", "without mongodb", "later")


@pytest.fixture(scope="module", params=["one", "many"])
def running(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Running]:
    path = tmp_path_factory.mktemp("running") / "store"
    with begun(path, request.param) as found:
        assert bool(found.before.entry("live").digests) == (request.param == "many")
        yield found


@pytest.fixture(scope="module", params=READERS)
def reader(request: pytest.FixtureRequest, running: Running) -> Iterator[hl.Store]:
    if request.param == "writer":
        yield running.store
    elif request.param == "before":
        running.before.connect()
        yield running.before
    else:
        mongo = NO_MONGODB if request.param == "without mongodb" else None
        with hl.open(running.path, mongo=mongo) as store:
            yield store


def test_every_method_has_a_rule() -> None:
    """A new method of `Query` needs a rule, or a reason why it has none."""
    names = {n for n, _ in inspect.getmembers(Query) if not n.startswith("_")}
    assert names | SPECIAL | PRIVATE == METHODS.keys() | EXEMPT_METHODS.keys()
    assert all(EXEMPT_METHODS.values())


@pytest.mark.parametrize("name", METHODS)
def test_methods_at_rest(running: Running, reader: hl.Store, name: str) -> None:
    running.seen_by(reader)
    rule = METHODS[name]
    found, wanted = rule.ask(reader), rule.right(running.flushed())
    assert same(found, wanted), (found, wanted)


@pytest.mark.parametrize("name", STORE)
def test_store_at_rest(running: Running, reader: hl.Store, name: str) -> None:
    running.seen_by(reader)
    rule = STORE[name]
    found, wanted = rule.ask(reader), rule.right(running.flushed())
    assert same(found, wanted), (found, wanted)
