"""Shared set-up: a mongod of our own ends soon after its last user, peers are counted."""

from __future__ import annotations

import gc
import os
import signal
import tempfile
from collections.abc import Iterator

import pytest
from hypothesis import HealthCheck, settings

from tests import databases, real_peers
from tests.calls import Calls
from tests.limits import Limit

collect_ignore = [
    "benchmarks",
    "formats/test_contributing.py",
    "test_docs.py",
    "test_packaging.py",
]
"""Tests that run when they are named, and as steps of `.ci/run`."""

LONG = (
    *("running/", "live/", "cli/", "test_faults", "test_model", "view/", "formats/test_bounds"),
    *("test_groups", "test_healing", "test_hostile_store", "servers/", "formats/test_writing"),
    *("test_power_cut", "remote/", "test_keep", "test_real_logs", "storage/test_mongod"),
    *("tables/test_other_readers", "payloads/", "copying/", "scale/", "tables/test_writer"),
    *("schema/test_wire", "test_mending", "test_repair", "contract/", "query/test_latest"),
    *("training/", "query/test_intervals", "storage/test_segments", "query/test_differences"),
    *(
        "tf/test_in_frame",
        "across/test_sync",
        "test_definitions_of_logs",
        "storage/test_append_file",
    ),
    *("test_interrupted", "test_edits_at_once", "demo/", "simulator/"),
)
"""Tests that take long, the longest first: they begin first, or one processor would wait at the
end; and the quick loop leaves them out, as it does those with MongoDB."""

os.environ["HYBRIDLOG_MONGOD_LINGER_S"] = "0.2"
for name in (
    "HYBRIDLOG_STORE",
    "HYBRIDLOG_MONGO_URI",
    "HYBRIDLOG_MONGO_PASSWORD",
):
    os.environ.pop(name, None)
# What the tests agree to is nothing that whoever runs them has agreed to.
_STATE = tempfile.TemporaryDirectory(prefix="hl-state-")
os.environ["XDG_STATE_HOME"] = os.environ["XDG_CACHE_HOME"] = _STATE.name
# Hundreds of commands are run, which need not all be compiled anew.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# A machine that is busy is no defect of what is tested, however long an example takes.
settings.register_profile(
    "any machine",
    max_examples=40,
    deadline=None,
    database=None,
    suppress_health_check=list(HealthCheck),
)
settings.load_profile("any machine")

# Whoever runs the tests in the background may have had signals ignored; programs that the
# tests start would inherit that, and Ctrl-C would do nothing.
for number, handler in (
    (signal.SIGINT, signal.default_int_handler),
    (signal.SIGTERM, signal.SIG_DFL),
    (signal.SIGHUP, signal.SIG_DFL),
):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, handler)


@pytest.fixture(autouse=True)
def signals_as_before() -> Iterator[None]:
    """Handlers that a test or a command has installed in this process go with the test."""
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.getsignal(number) for number in numbers}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Calls:
    """Notes, delays or fails calls of functions."""
    return Calls(monkeypatch)


@pytest.fixture
def limit(monkeypatch: pytest.MonkeyPatch) -> Limit:
    """Sets limits of the product."""
    return Limit(monkeypatch)


@pytest.fixture
def mongo(pytestconfig: pytest.Config) -> str:
    """The URI of a database of its own, for a store that is opened with `mongo=`."""
    return pytestconfig.stash[DATABASES].new()


DATABASES = pytest.StashKey[databases.Databases]()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--mongo-uri",
        default=os.environ.get("HYBRIDLOG_TESTS_MONGO"),
        help="MongoDB for the tests that need one (default: HYBRIDLOG_TESTS_MONGO), each in a "
        "database of its own that is dropped at the end; tests about ours are left out",
    )


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "mongo: stores have an index in MongoDB; see databases.py")
    config.addinivalue_line("markers", 'slow: left out by -m "not slow", the quick loop')
    config.addinivalue_line("markers", "exhaustive: takes hours; run by -m exhaustive")
    config.addinivalue_line("markers", "peer(kind): speaks with a real peer, not one of ours")
    config.stash[DATABASES] = databases.Databases(config.getoption("--mongo-uri"))
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(real_peers.Attendance())


def pytest_unconfigure(config: pytest.Config) -> None:
    config.stash[DATABASES].close()
    _STATE.cleanup()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    item.config.stash[DATABASES].choose(item)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Thousands of tests stay to the end: the garbage collector need not look at them again."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Two more than there are processors: much of the time is waiting for others."""
    return (os.cpu_count() or 1) + 2


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    real_peers.mark(items)
    for item in items:
        place = item.nodeid.removeprefix("tests/")
        marks = {mark.name for mark in item.iter_markers()}
        if place.startswith(LONG) or marks & {"exhaustive", "mongo"}:
            item.add_marker(pytest.mark.slow)
    if config.getoption("--mongo-uri") is not None:
        config.hook.pytest_deselected(items=[i for i in items if databases.is_embedded(i)])
        items[:] = [item for item in items if not databases.is_embedded(item)]
    items.sort(key=lambda item: _rank(item.nodeid.removeprefix("tests/")))


def _rank(place: str) -> int:
    return next((n for n, name in enumerate(LONG) if place.startswith(name)), len(LONG))
