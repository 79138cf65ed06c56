"""No question asks MongoDB once a recording, and neither does opening: commands are counted.

With a latency of 50 ms, each command costs more than most answers.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

import hybridlog as hl
from tests import logs
from tests.servers.commands import Sent, commands

pytestmark = pytest.mark.mongo("embedded")

MESSAGES = 12
GAP = 1000  # messages that would lie between two recordings
ABSOLUTE = f"{logs.BEGIN_NS + 3 * logs.STEP_NS}ns", f"{logs.BEGIN_NS + 9_005 * logs.STEP_NS}ns"
RELATIVE = "+0s", "+0.055s"
RAW = {"n": {"$gt": 1}}
BY_MONGODB: dict[str, Callable[[hl.Store], object]] = {
    "count": lambda s: s.topic("/number").where(RAW).count(),
    "count of times": lambda s: s.topic("/number").where(RAW).between(*ABSOLUTE).count(),
    "count of relative times": lambda s: s.topic("/number").where(RAW).between(*RELATIVE).count(),
    "count of several topics": lambda s: s.topic("/number", "/stamped").where(RAW).count(),
    "fetch": lambda s: [m.raw for m in s.topic("/number").where(RAW).where("x > 1")],
    "table": lambda s: s.topic("/number").where(RAW).to_pandas()["n"].tolist(),
    "intervals": lambda s: [*s.topic("/number").where(RAW).intervals()],
    "intervals of relative times": lambda s: [
        *s.topic("/number").where(RAW).between("+0.025s", "+0.045s").intervals()
    ],
    "windows": lambda s: [*s.topic("/number").where(RAW).windows(0, "1ms")],
}


def add(path: Path, numbers: range) -> None:
    with hl.open(path, create=True) as store:
        for n in numbers:
            log = path.parent / f"{n}.mcap"
            store.record(logs.write(log, logs.content(n * GAP, MESSAGES)), name=f"log {n}")


def asked(path: Path) -> tuple[dict[str, list[Sent]], dict[str, object]]:
    """What MongoDB gets for each question and for opening, and the answers."""
    heard, answers = {}, {}
    with hl.open(path, require_database=True):
        pass  # new recordings are looked at once
    with commands() as sent, hl.open(path, require_database=True) as store:
        heard["open"] = [*sent]
        log = logs.write(path.parent / "more.mcap", logs.content(900 * GAP, MESSAGES))
        sent.clear()
        more = store.record(log, name="more")
        heard["record"] = [*sent]
        store.shared.index.connect()
        sent.clear()
        store.index.rebuild(["more"])
        heard["reindex"] = [*sent]
        store.shared.index.connect()
        sent.clear()
        store.remove(more.entry.id)
        heard["remove"] = [*sent]
    for name, ask in BY_MONGODB.items():
        with hl.open(path, require_database=True) as store, commands() as sent:
            answers[name] = ask(store)
            heard[name] = [*sent]
    return heard, answers


def test_no_question_asks_once_a_recording(tmp_path: Path) -> None:
    path = tmp_path / "store"
    add(path, range(4))
    with hl.open(path, require_database=True) as store:  # one mongod for all
        truth = {name: ask(store) for name, ask in BY_MONGODB.items()}
        few, answers = asked(path)
        assert answers == truth
        add(path, range(4, 12))
        many, _ = asked(path)
    assert {name: len(sent) for name, sent in many.items()} == {
        name: len(sent) for name, sent in few.items()
    }
    assert all(few.values())
    assert "create" not in {one.name for one in few["record"]}, "once a topic, though it exists"
