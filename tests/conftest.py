"""Shared set-up: a mongod of our own ends soon after its last user, peers are counted."""

from __future__ import annotations

import os
import signal

import pytest

from tests import real_peers

os.environ["HYBRIDLOG_MONGOD_LINGER_S"] = "0.2"
for name in ("HYBRIDLOG_STORE", "HYBRIDLOG_MONGO_URI"):
    os.environ.pop(name, None)

# Whoever runs the tests in the background may have had signals ignored; programs that the
# tests start would inherit that, and Ctrl-C would do nothing.
for number, handler in (
    (signal.SIGINT, signal.default_int_handler),
    (signal.SIGTERM, signal.SIG_DFL),
    (signal.SIGHUP, signal.SIG_DFL),
):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, handler)


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "peer(kind): speaks with a real peer, not one of ours")
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(real_peers.Attendance())


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    real_peers.mark(items)
