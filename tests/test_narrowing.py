"""Indexes on fields of MongoDB leave recordings out, and never a message."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

import hybridlog as hl
from hybridlog.query import planner
from hybridlog.query.planner import Planner
from hybridlog.query.topics import matcher
from hybridlog_storage.messages import Channel, Schema
from tests.calls import Calls
from tests.limits import Limit
from tests.servers.commands import commands

pytestmark = pytest.mark.mongo

SECOND = 10**9
MANY = 40
THINGS = Schema("pkg/T", "ros1msg", b"float64 x\nuint64 u\nstring s\nfloat64[] a")
CHANNEL = Channel("/t", "ros1", THINGS)
CONDITIONS = [
    "x > 30.5",
    "x == 7",
    "x in [3, 1000, 12.0]",
    "x >= 12 and x < 14 and s == 'even'",
    "s == 'odd 9'",
    "s in ['odd 9', 'odd 11', 'no']",
    "u >= 18446744073709551613",
    "u == 9223372036854775809",
    "x < 2 and a.n == 40",
]
NOT_NARROWED = ["x > 3 or s == 'odd 9'", "not (x > 3)", "x != 3", "s ~ 'odd'", "a > 5", "x == nan"]


def thing(n: int, row: int) -> bytes:
    text = f"odd {n}" if n % 2 else "even"
    numbers = np.full(40 if n < 3 else 1, float(n))
    return b"".join(
        (
            np.float64(n + row / 100).tobytes(),
            np.uint64(2**63 + n if n < 20 else 2**64 - n).tobytes(),
            np.uint32(len(text)).tobytes() + text.encode(),
            np.uint32(len(numbers)).tobytes() + numbers.tobytes(),
        )
    )


def record(store: hl.Store, n: int, *extra: bytes, no_index: str | None = None) -> None:
    choices = {"no_index": matcher([no_index])} if no_index else {}
    with store.start(f"log {n}", **choices) as recording:
        for row, payload in enumerate((*(thing(n, row) for row in range(5)), *extra)):
            recording.write(CHANNEL, payload, log_time=(n * 100 + row) * SECOND)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("fleet") / "store"
    with hl.open(path, create=True, require_database=True) as store:
        for n in range(MANY):
            record(store, n)
        for field in ("x", "u", "s"):
            store.index.add("/t", field)
    return path


@pytest.fixture
def store(path: Path) -> Iterator[hl.Store]:
    with hl.open(path, require_database=True) as opened:
        yield opened


def planned(calls: Calls) -> list[str]:
    """Ids of the recordings that are asked."""
    asked: list[str] = []
    calls(Planner, "parts_in", lambda _, summary, *__: asked.append(summary.id))
    return asked


@pytest.mark.parametrize("condition", [*CONDITIONS, *NOT_NARROWED])
def test_the_same_answers_with_and_without(
    path: Path, store: hl.Store, calls: Calls, condition: str
) -> None:
    ways: dict[str, Callable[[hl.Store], object]] = {
        "count": lambda s: s.topic("/t").where(condition).count(),
        "rows": lambda s: [(m.recording, m.seq) for m in s.topic("/t").where(condition)],
        "last": lambda s: [m.seq for m in s.topic("/t").where(condition).reverse().limit(3)],
        "table": lambda s: s.topic("/t").where(condition).to_arrow().to_pylist(),
        "times": lambda s: [*s.topic("/t").where(condition).windows(0, "1ns")],
        "some": lambda s: s.topic("/t").where(condition).between("+1s", "+4s").count(),
        "recordings": lambda s: s.recordings(where=f"/t: {condition}").labels,
        "states": lambda s: [*s.topic("/t").where(condition).intervals()],
    }
    with hl.open(path) as alone:
        want = {name: ask(alone) for name, ask in ways.items()}
        # Now bounds leave recordings out.
        assert {name: ask(alone) for name, ask in ways.items()} == want
        assert alone.session.connected is None
    asked = planned(calls)
    assert store.topic("/t").where(condition).count() == want["count"]
    if condition in CONDITIONS:
        assert len(asked) <= MANY / 2
    else:
        assert len(asked) == MANY
    assert {name: ask(store) for name, ask in ways.items()} == want


def test_one_command_and_a_look_at_what_has_changed(path: Path) -> None:
    with hl.open(path, require_database=True) as store:
        assert store.session.field_indexes
        question = store.topic("/t").where("s == 'odd 7'")
        assert question.count() == 5  # looks at the recordings once
    with commands() as sent, hl.open(path, require_database=True) as store:
        question = store.topic("/t").where("s == 'odd 7'")
        assert question.count() == 5
        sent.clear()
        assert question.count() == 5
        assert [(one.name, one.collection) for one in sent] == [
            ("aggregate", "t"),
            ("find", "hybridlog.store"),
        ]
        sent.clear()
        assert store.topic("/t").where("a > 3").count() > 0
        assert store.topic("/t").in_recording("log 3").where("x > 3").count() > 0
        assert not sent


def test_what_many_messages_satisfy_is_looked_at_in_part(
    store: hl.Store, monkeypatch: pytest.MonkeyPatch, calls: Calls, limit: Limit
) -> None:
    asked = planned(calls)
    monkeypatch.setattr(planner, "within_bounds", lambda _session, _question, found: found)
    assert store.topic("/t").where("x >= 0").count() == 5 * MANY
    assert len(asked) == MANY
    limit(min_matches=10)
    del asked[:]
    assert store.topic("/t").where("x >= 38").count() == 10
    assert len(asked) == 2
    del asked[:]
    assert store.topic("/t").where("x >= 37").count() == 15
    assert len(asked) == MANY


def test_recordings_whose_documents_may_not_tell_are_asked(tmp_path: Path, calls: Calls) -> None:
    with hl.open(tmp_path / "store", create=True, require_database=True) as store:
        for n in range(20):
            record(store, n)
        store.index.add("/t", "x")
        record(store, 20, b"short")
        record(store, 21, no_index="**")
    with hl.open(tmp_path / "store", require_database=True) as store:
        running = store.start("running", flush_interval_s=0.05)
        running.write(CHANNEL, thing(22, 0), log_time=2200 * SECOND)
        asked = planned(calls)
        query = store.topic("/t").where("x >= 19")
        for _ in range(100):
            if query.count() == 16:
                break
        names = {store.entry(one).name for one in asked}
        assert {"log 19", "log 20", "log 21", "running"} <= names
        assert len(names) < 8
        assert [m.fields["x"] >= 19 for m in query] == [True] * 16
        nothing = store.topic("/t").where("x == 99")
        assert (nothing.count(), nothing.counters.unreadable) == (0, 1)
        running.close()


def test_an_index_that_others_change_is_not_believed(path: Path, tmp_path: Path) -> None:
    with hl.open(path, require_database=True) as store:
        query = store.topic("/t").where("x >= 38")
        assert query.count() == 10
        with hl.open(path, require_database=True) as other:
            other.index.rebuild(["log 38"])
            assert query.count() == 10
            key = other.select(["log 39"])[0].key
            database = other.session.database_for("the test")
            state = {"$set": {"index.state": "clearing"}}
            database.update("hybridlog.recordings", {"_id": key}, state)
            database.update("hybridlog.store", {"_id": "turn"}, {"$inc": {"turn": 1}})
            database.delete("t", {"_meta.rec": key})
        assert query.count() == 10
        assert query.count() == 10
        store.index.rebuild(["log 39"])
        assert query.count() == 10


def test_an_index_that_was_dropped_is_not_missed(path: Path) -> None:
    with hl.open(path, require_database=True) as store:
        store.session.database_for("the test").drop_index("t", [("x", 1)])
        assert store.topic("/t").where("x >= 38").count() == 10
        store.index.add("/t", "x")
        assert store.index.remove("/t", "s") == 1
        assert [one.fields for one in store.session.field_indexes] == [("x",), ("u",)]
        assert store.topic("/t").where("s == 'odd 9'").count() == 5
        store.index.add("/t", "s")
