"""Shared set-up of the benchmarks: the source, the inputs, a store, and what is told."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from benchmarks.micro import inputs as making
from benchmarks.micro import isolation

_reasons = pytest.StashKey[dict[str, list[str]]]()


def pytest_configure(config: pytest.Config) -> None:
    """Bind the process to one source."""
    config.stash[_reasons] = {}
    os.environ.setdefault("HYBRIDLOG_MONGOD_LINGER_S", "0.2")
    for name in ("HYBRIDLOG_STORE", "HYBRIDLOG_MONGO_URI"):
        os.environ.pop(name, None)
    root = isolation.source()
    if root is not None:
        isolation.leave_path(root)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Iterator[None]:
    """Keep why a benchmark has no figure."""
    report: Any = yield
    if not report.passed:
        reason = call.excinfo.exconly() if call.excinfo is not None else report.outcome
        if report.skipped and isinstance(report.longrepr, tuple):
            reason = report.longrepr[2].removeprefix("Skipped: ")
        item.config.stash[_reasons][item.name] = [report.outcome, reason[:500]]
    return report  # type: ignore[no-any-return]


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Tell what was not timed, and from where the source came."""
    file = os.environ.get(isolation.OUTCOME)
    if file is None:
        return
    root = isolation.source()
    outcome = {
        "hybridlog": isolation.file_of("hybridlog"),
        "strangers": isolation.strangers(root) if root is not None else [],
        "reasons": session.config.stash[_reasons],
    }
    Path(file).write_text(json.dumps(outcome), encoding="utf-8")


@pytest.fixture(scope="session")
def bags(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The directory with the bags."""
    given = os.environ.get(isolation.INPUTS)
    if given:
        return Path(given)
    directory = tmp_path_factory.mktemp("inputs")
    making.make(directory)
    return directory


@pytest.fixture(scope="session")
def store(bags: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A store with the IMU messages and the drive in it, recorded by the measured source."""
    opened = isolation.need("hybridlog", "open").open(
        tmp_path_factory.mktemp("store") / "store", create=True, require_database=True
    )
    with opened:
        for name in (making.IMU, making.DRIVE):
            opened.record(bags / name)
        yield opened
