"""How long tests take, as measured: which ones the quick loop leaves out, and which begin first.

`pytest --measure` writes the file anew, for all tests that ran. A test that is not in it is quick.
"""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

import pytest

FILE = Path(__file__).with_suffix(".json")
LEAST_S = 0.4
"""What takes less is not noted."""
QUICK_S = 12
"""What the tests in the file may take of the quick loop, one after another; the others are many,
and take most of its two minutes."""


def name_of(nodeid: str) -> str:
    """File and function of a test: the cases of a function are measured together."""
    return nodeid.removeprefix("tests/").split("[")[0]


class Measuring:
    """Adds up what each function takes, and writes the file at the end."""

    def __init__(self) -> None:
        self._seconds: Counter[str] = Counter()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self._seconds[name_of(report.nodeid)] += report.duration

    def pytest_sessionfinish(self) -> None:
        found = {name: round(s, 1) for name, s in self._seconds.items() if s >= LEAST_S}
        FILE.write_text(json.dumps(dict(sorted(found.items())), indent=0) + "\n")


def measured() -> dict[str, float]:
    """Seconds of each function that takes long."""
    found: dict[str, float] = json.loads(FILE.read_text())
    return found


def slow_ones(seconds: dict[str, float]) -> frozenset[str]:
    """The functions that the quick loop leaves out: the longest, until the rest is quick."""
    total = sum(seconds.values())
    slow = set()
    for name in sorted(seconds, key=seconds.__getitem__, reverse=True):
        if total <= QUICK_S:
            break
        slow.add(name)
        total -= seconds[name]
    return frozenset(slow)
