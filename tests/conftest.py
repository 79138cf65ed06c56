"""Shared set-up: a mongod of our own ends soon after its last user, peers are counted."""

from __future__ import annotations

import os
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from tests import by_uri, real_peers

os.environ["HYBRIDLOG_MONGOD_LINGER_S"] = "0.2"
for name in (
    "HYBRIDLOG_STORE",
    "HYBRIDLOG_MONGO_URI",
    "HYBRIDLOG_MONGO_PASSWORD",
    "HYBRIDLOG_MONGO_PASSWORD_FILE",
):
    os.environ.pop(name, None)
# What the tests agree to is nothing that whoever runs them has agreed to.
_STATE = tempfile.TemporaryDirectory(prefix="hl-state-")
os.environ["XDG_STATE_HOME"] = _STATE.name
# Hundreds of commands are run, which need not all be compiled anew.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# A machine that is busy is no defect of what is tested, however long an example takes.
settings.register_profile(
    "any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("any machine")

LONGEST = (
    "test_identity",
    "test_healing",
    "test_faults",
    "test_commands",
    "test_stopping",
    "test_style",
    "test_writer",
    "test_bounds",
    "test_segments",
    "test_catalog_by_hand",
    "test_record_live",
    "test_mongod",
    "test_recording",
    "test_methods",
    "test_groups",
    "test_backends",
    "test_wire",
    "test_catalog",
    "test_states",
    "test_docs",
    "test_model",
    "test_engines",
    "test_many_recordings",
    "test_replica_set",
    "test_uri",
    "test_benchmarks",
    "test_follow",
    "test_hostile_store",
    "test_definitions_of_logs",
    "test_no_index",
    "test_fetch",
    "test_tls",
    "test_reader",
    "test_maintenance",
    "test_queries",
    "test_attachments",
    "test_real_logs",
    "test_ros2_live",
    "test_smoke",
    "test_mutants",
)
"""Files that take long, by seconds: they begin first, or one processor would wait at the end."""

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


SLOW = frozenset(
    (
        "across/test_align.py",
        "across/test_bins.py",
        "across/test_lost.py",
        "across/test_near.py",
        "across/test_rates.py",
        "across/test_sync.py",
        "benchmarks/test_backends.py",
        "benchmarks/test_harness.py",
        "benchmarks/test_live.py",
        "benchmarks/test_queries.py",
        "benchmarks/test_throughput.py",
        "payloads/test_compact.py",
        "payloads/test_drop.py",
        "payloads/test_format.py",
        "cli/test_coverage.py",
        "cli/test_export.py",
        "cli/test_fetch.py",
        "cli/test_info.py",
        "cli/test_intervals.py",
        "cli/test_maintain.py",
        "cli/test_open.py",
        "cli/test_record.py",
        "cli/test_record_live.py",
        "cli/test_serve.py",
        "cli/test_start.py",
        "cli/test_stopping.py",
        "cli/test_terminal.py",
        "demo/test_tour.py",
        "drawing/test_plot.py",
        "formats/test_writing.py",
        "faults/test_some.py",
        "live/sources/test_ros2_live.py",
        "live/test_killed.py",
        "live/test_recording.py",
        "live/test_rehearsal.py",
        "view/playback/test_server.py",
        "query/test_chunk_counts.py",
        "query/test_counting.py",
        "query/test_engines.py",
        "query/test_intervals.py",
        "query/test_latest.py",
        "scale/test_many_recordings.py",
        "schema/test_codec.py",
        "schema/test_wire.py",
        "servers/test_commands.py",
        "servers/test_replica_set.py",
        "servers/test_resets.py",
        "servers/test_tls.py",
        "servers/test_uri.py",
        "formats/test_bounds.py",
        "formats/test_rosbag1.py",
        "formats/test_rosbag2.py",
        "sql/test_command.py",
        "sql/test_engine.py",
        "sql/test_paper.py",
        "sql/test_running.py",
        "sql/test_views.py",
        "storage/test_catalog.py",
        "storage/test_mongod.py",
        "storage/test_segments.py",
        "tables/test_maintenance.py",
        "tables/test_reader.py",
        "tables/test_writer.py",
        "test_benchmarks.py",
        "test_cache_size.py",
        "test_catalog_by_hand.py",
        "test_consent.py",
        "test_definitions_of_logs.py",
        "test_docs.py",
        "test_exact_values.py",
        "test_faults.py",
        "test_field_indexes.py",
        "test_groups.py",
        "test_healing.py",
        "test_hostile_store.py",
        "test_many_topics.py",
        "test_model.py",
        "test_mutants.py",
        "test_no_index.py",
        "test_packaging.py",
        "test_power_cut.py",
        "test_reader.py",
        "test_real_logs.py",
        "test_second_opinion.py",
        "test_sensor_messages.py",
        "test_sizes.py",
        "test_style.py",
        "view/test_guard.py",
        "view/test_mcap.py",
        "view/test_panels.py",
        "view/test_spatial.py",
    )
)
"""Files left out by `-m "not slow"`: with them, a run takes ten minutes instead of one."""


EMBEDDED = (
    "benchmarks/",
    "cli/",
    "demo/",
    "faults/",
    "storage/test_mongod.py",
    "test_consent.py",
    "test_docs.py",
    "test_faults.py",
    "test_healing.py",
    "test_hostile_store.py",
    "test_many_topics.py",
    "test_packaging.py",
    "test_power_cut.py",
)
"""Files about the MongoDB that comes with hybridlog, and such whose stores are opened by other
processes, which use it. `@pytest.mark.embedded` marks single tests of other files."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--mongo-uri",
        default=os.environ.get("HYBRIDLOG_TESTS_MONGO"),
        help="MongoDB for the tests' stores (default: HYBRIDLOG_TESTS_MONGO), each in a database "
        "of its own that is dropped at the end; tests about the embedded one are left out",
    )


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "embedded: about the MongoDB that comes with hybridlog")
    config.addinivalue_line("markers", 'slow: left out by -m "not slow", the quick loop')
    config.addinivalue_line("markers", "exhaustive: takes hours; run by -m exhaustive")
    config.addinivalue_line("markers", "peer(kind): speaks with a real peer, not one of ours")
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(real_peers.Attendance())


def pytest_unconfigure() -> None:
    _STATE.cleanup()


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Two more than there are processors: much of the time is waiting for others."""
    return (os.cpu_count() or 1) + 2


@pytest.fixture(scope="session", autouse=True)
def mongo_by_uri(request: pytest.FixtureRequest) -> Iterator[None]:
    """Stores that would use the embedded MongoDB use the one of `--mongo-uri`, if it is given."""
    uri = request.config.getoption("--mongo-uri")
    if uri is None:
        yield
        return
    with by_uri.stores_at(uri):
        yield


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    real_peers.mark(items)
    here = Path(__file__).parent
    for item in items:
        if item.path.relative_to(here).as_posix() in SLOW or item.get_closest_marker("exhaustive"):
            item.add_marker(pytest.mark.slow)
        if item.path.relative_to(here).as_posix().startswith(EMBEDDED):
            item.add_marker(pytest.mark.embedded)
    if config.getoption("--mongo-uri") is not None:
        left = [item for item in items if item.get_closest_marker("embedded")]
        config.hook.pytest_deselected(items=left)
        items[:] = [item for item in items if not item.get_closest_marker("embedded")]
    rank = {name: at for at, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path.stem, len(rank)))
