"""Some of all points, which are quick: at least one of each command and of each fault."""

from __future__ import annotations

import re

import pytest

from tests.faults.cases import Bench
from tests.faults.scenarios import scenario
from tests.faults.steps import Fault, Point

SOME: list[tuple[str, Fault, str, int, bool]] = [
    ("rm", "die", "rename", 0, True),
    ("rm", "torn", "delete number", 0, False),
    ("rm", "TERM", "update hybridlog.recordings", 0, True),
    ("reindex", "die", "delete stamped", 0, True),
    ("reindex", "INT", "insert number", 0, True),
    ("reindex one", "database", "update hybridlog.recordings", 1, False),
    ("rename", "die", "rename", 0, False),
    ("tag", "torn", "write .<id>.new", 0, False),
    ("mark", "die", "rename .<id>.new", 0, False),
    ("mark", "ENOSPC", "sync .<id>.new", 0, False),
    ("import", "torn", "write .<digest>.part", 0, False),
    ("repair", "torn", "write 000002.mcap", 0, False),
    ("record", "die", "rename 000000.mcap.open", 0, True),
    ("open after a crash", "EIO", "sync .<id>.new", 0, True),
    ("open with an unlisted segment", "torn", "write .<id>.new", 0, False),
]


@pytest.mark.parametrize(
    ("name", "fault", "step", "number", "after"),
    SOME,
    ids=[f"{name}: {fault} at {step}" for name, fault, step, _, _ in SOME],
)
def test_what_is_interrupted_is_finished_or_taken_back(
    bench: Bench, name: str, fault: Fault, step: str, number: int, after: bool
) -> None:
    case = scenario(bench, name)
    steps = [re.sub(r"[0-9]{8}-[a-z]+-[0-9a-f]{16}", "<id>", told) for told in case.steps]
    steps = [re.sub(r"[0-9a-f]{32}", "<digest>", told) for told in steps]
    places = [at for at, told in enumerate(steps) if told.startswith(step)]
    assert len(places) > number, case.steps
    assert bench.problem(case, Point(fault, places[number], after)) is None
