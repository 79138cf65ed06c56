"""Every method of `Query` and `Store` about a recording that goes on: right at any moment."""

from __future__ import annotations

import inspect
import json
import time
from collections.abc import Callable, Iterator

import pytest

import hybridlog as hl
from hybridlog.query.query import Query, tables_of
from tests.every_output import written
from tests.running.methods import EXEMPT_METHODS, LABEL, METHODS, STORE, same
from tests.running.running import NO_MONGODB, Running, begun
from tests.running.sequence import Known
from tests.some import in_turn

pytestmark = pytest.mark.mongo("embedded")

SPECIAL = {"__iter__", "__eq__", "__hash__", "__repr__"}
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
        running.before.shared.index.connect()
        yield running.before
    else:
        mongo = NO_MONGODB if request.param == "without mongodb" else None
        with hl.open(running.path, mongo=mongo) as store:
            yield store


def test_every_method_has_a_rule() -> None:
    """A new method of `Query` needs a rule, or a reason why it has none."""
    names = {n for n, _ in inspect.getmembers(Query) if not n.startswith("_")}
    assert len(names) <= 29
    assert names | SPECIAL == METHODS.keys() | EXEMPT_METHODS.keys()
    assert all(EXEMPT_METHODS.values())
    assert len([n for n, _ in inspect.getmembers(hl.Store) if not n.startswith("_")]) <= 35


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


def sent_of(store: hl.Store, running: Running) -> Known:
    """What the recording has at the moment."""
    return Known(running.sent, store.entry(LABEL).messages_by_topic())


def check_all(store: hl.Store, running: Running) -> None:
    """Ask everything of a snapshot: all answers are of one moment."""
    then = store.snapshot()
    known = sent_of(then, running)
    for name, rule in [*METHODS.items(), *STORE.items()]:
        found, wanted = rule.ask(then), rule.right(known)
        assert same(found, wanted), (name, found, wanted)
    assert sent_of(then, running).counts == known.counts


@pytest.mark.parametrize("running", ["many"], indirect=True)
def test_one_moment_while_segments_are_sealed(running: Running) -> None:
    """A snapshot sees one state of the recording, whatever is sealed meanwhile."""
    segments = running.before.entry(LABEL).segments
    with running.writing(60, 0.01) as writing, hl.open(running.path, mongo=NO_MONGODB) as store:
        while writing.is_alive():
            check_all(store, running)
    running.flushed()
    check_all(running.before, running)
    assert running.before.entry(LABEL).segments > segments or not segments > 3


CALLS: dict[str, Callable[[hl.Store], list[int]]] = {
    "rows": lambda s: [json.loads(m.raw)["n"] for m in s.topic("said")],
    "fields": lambda s: [m.fields["n"] for m in s.topic("said").where("n >= 0")],  # type: ignore[misc]
    "frame": lambda s: s.topic("said").to_pandas()["n"].tolist(),
    "table": lambda s: s.topic("said").where("x > -1000").to_arrow().column("n").to_pylist(),
    "tables": lambda s: [
        n for table in tables_of(s.topic("said")) for n in table.column("n").to_pylist()
    ],
    "lines": lambda s: [
        json.loads(line)["n"] for line in written(s.topic("said"), "jsonl").splitlines()
    ],
    "count": lambda s: [*range(s.topic("said").count())],
    "count where": lambda s: [*range(s.topic("said").where("n >= 0").count())],
    "count in time": lambda s: [*range(s.topic("said").between("start", "end").count())],
    "intervals": lambda s: [
        *range(sum(one.messages for one in s.topic("said").where("n >= 0").intervals()))
    ],
    "stats": lambda s: [*range(s.topic("said").stats("n")[0].count)],
    "sql": lambda s: [n for (n,) in s.sql("select n from said").rows()],
    "entry": lambda s: [*range(s.entry(LABEL).messages_by_topic()["/said"])],
    "synced": lambda s: [
        json.loads(one.raw)["n"]
        for one, _ in s.sync([s.topic("said"), s.topic("said").where("n >= 0")], clock="log")
    ],
}
"""The numbers of the messages of `/said`, from one call; a count stands for the first ones."""
MAX_BEHIND_S = 2.0


@pytest.mark.parametrize(
    ("running", "mongo"), in_turn(["one", "many"], [None, NO_MONGODB]), indirect=["running"]
)
def test_each_call_while_segments_are_sealed(running: Running, mongo: str | None) -> None:
    """Each answer is a beginning of the sequence, without a gap, and at most 2 s short."""
    with hl.open(running.path, mongo=mongo) as store:
        with running.writing(50, 0.02) as writing:
            while writing.is_alive():
                for name, call in CALLS.items():
                    begun = time.monotonic()
                    behind = running.recording.filled  # a busy machine writes late
                    found = sorted(call(store))
                    assert found == [*range(len(found))], (name, found)
                    assert len(found) <= running.step
                    due = running.written_before(begun - MAX_BEHIND_S)
                    assert len(found) >= due or behind > 0, (name, len(found), due)
        running.flushed()
        for name, call in CALLS.items():
            assert sorted(call(store)) == [*range(running.step)], name
