"""Bounds of fields leave recordings out, and never a message."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest

import hybridlog as hl
from hybridlog.query.choice import Choice
from hybridlog.query.planner import Planner
from hybridlog_storage.messages import Channel, Schema
from tests.calls import Calls

SECOND = 10**9
MANY = 40
CHANNEL = Channel("/t", "ros1", Schema("pkg/T", "ros1msg", b"float64 x\nuint64 u\nfloat64[] a"))
CONDITIONS = [
    "x > 30.5",
    "x == 7",
    "x in [3, 1000, 12.0]",
    "x >= 12 and x < 14 and a.n == 1",
    "u >= 18446744073709551613",
    "u == 9223372036854775809",
    "x > 3 or u == 5",
    "not (x > 3)",
    "x != 3",
    "a > 5",
    "x == nan",
]


def thing(n: int, row: int) -> bytes:
    numbers = np.full(40 if n < 3 else 1, float(n))
    number = np.uint64(2**63 + n if n < 20 else 2**64 - n)
    head = np.float64(n + row / 100).tobytes() + number.tobytes()
    return head + np.uint32(len(numbers)).tobytes() + numbers.tobytes()


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    path = tmp_path_factory.mktemp("fleet") / "store"
    with hl.open(path, create=True, mongo="none") as opened:
        for n in range(MANY + 1):
            with opened.start(f"log {n}") as recording:
                for row in range(5):
                    payload = thing(n, row) if n < MANY or row else b"short"
                    recording.write(CHANNEL, payload, log_time=(n * 100 + row) * SECOND)
        yield opened


@pytest.mark.parametrize("condition", CONDITIONS)
def test_the_same_answers_with_and_without(store: hl.Store, calls: Calls, condition: str) -> None:
    ways: dict[str, Callable[[hl.Store], object]] = {
        "rows": lambda s: [(m.recording, m.seq) for m in s.topic("/t").where(condition)],
        "count": lambda s: s.topic("/t").where(condition).count(),
        "last": lambda s: [m.seq for m in s.topic("/t").where(condition).reverse().limit(3)],
        "table": lambda s: s.topic("/t").where(condition).to_arrow().to_pylist(),
        "times": lambda s: [*s.topic("/t").where(condition).windows(0, "1ns")],
        "some": lambda s: s.topic("/t").where(condition).between("+1s", "+4s").count(),
        "recordings": lambda s: s.choose(Choice.of(where=f"/t: {condition}")).names,
        "states": lambda s: [*s.topic("/t").where(condition).intervals()],
    }
    with hl.open(store.directory.path) as other:
        want = {name: ask(other) for name, ask in ways.items()}
    asked = calls(Planner, "parts_in")
    assert {name: ask(store) for name, ask in ways.items()} == want
    asked.clear()
    query = store.topic("/t").where(condition)
    assert (query.count(), query.counters.unreadable) == (want["count"], 1)
    if condition in {"x == 7", "x > 30.5"}:
        assert len(asked) < MANY / 2
