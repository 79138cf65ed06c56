"""Says loudly which real peers a run of the tests did not meet.

Tests that speak with a peer of someone else's are marked `@pytest.mark.peer(KIND)`. A peer
that cannot be had skips them. A run in which all tests of a kind were skipped says so at its
end, and fails when `HYBRIDLOG_TESTS_NEED_PEERS` is set, as continuous integration sets it.
"""

from __future__ import annotations

import os
from collections import Counter

import pytest

NEEDED = "HYBRIDLOG_TESTS_NEED_PEERS"
_PROPERTY = "peer"


def mark(items: list[pytest.Item]) -> None:
    """Has the reports of tests say which kind of peer they need, from whatever process."""
    for item in items:
        marker = item.get_closest_marker("peer")
        if marker is not None:
            item.user_properties.append((_PROPERTY, marker.args[0]))


class Attendance:
    """Counts the tests that met a peer, and those that did not."""

    def __init__(self) -> None:
        self._met: Counter[str] = Counter()
        self._missed: Counter[str] = Counter()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Counts one test."""
        for name, kind in report.user_properties:
            if name == _PROPERTY and report.when == "call" and not report.skipped:
                self._met[str(kind)] += 1
            elif name == _PROPERTY and report.skipped:
                self._missed[str(kind)] += 1

    @property
    def absent(self) -> list[str]:
        """Kinds of which all tests were skipped."""
        return sorted(kind for kind in self._missed if not self._met[kind])

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Fails the run when a kind is absent that must not be."""
        if self.absent and os.environ.get(NEEDED):
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Says which kinds are absent."""
        for kind in self.absent:
            terminalreporter.section(f"{kind}: NOTHING was tested with a real one", red=True)
            terminalreporter.line(
                f"All {self._missed[kind]} tests were skipped; the reasons are above. "
                f"With {NEEDED}=1 this fails."
            )
