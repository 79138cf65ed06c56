"""Shared set-up: a mongod of our own ends soon after its last user, peers are counted."""

from __future__ import annotations

import os

import pytest

from tests import real_peers

os.environ["HYBRIDLOG_MONGOD_LINGER_S"] = "0.2"
for name in ("HYBRIDLOG_STORE", "HYBRIDLOG_MONGO_URI"):
    os.environ.pop(name, None)


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "peer(kind): speaks with a real peer, not one of ours")
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(real_peers.Attendance())


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    real_peers.mark(items)
