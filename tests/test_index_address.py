"""The address of the index for other programs: it stays the same, and the server stays for them."""

from __future__ import annotations

import time
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest
from pymongo import MongoClient

import hybridlog as hl
from tests import logs
from tests.cli.running import run
from tests.limits import Limit

pytestmark = pytest.mark.mongo("embedded")


@pytest.fixture
def path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("HYBRIDLOG_MONGOD_LINGER_S", "0")
    log = logs.write(tmp_path / "a.mcap", logs.content(0, 20))
    with hl.open(tmp_path / "store", create=True) as store:
        store.record(log)
    return tmp_path / "store"


def mongod(path: Path) -> psutil.Process:
    return psutil.Process(int((path / "mongod/data/mongod.lock").read_text()))


def test_a_server_stays_while_a_client_is_connected(path: Path, limit: Limit) -> None:
    limit(clients_wait_s=1.0)
    with hl.open(path) as store:
        address = store.index.address()
    server = mongod(path)
    with MongoClient[dict[str, object]](address.uri) as client:
        time.sleep(2)
        assert server.is_running()
        assert client[address.database]["number"].count_documents({"n": {"$gte": 5}}) == 15
    server.wait(30)
    with hl.open(path) as store:
        assert store.index.address() == address


def test_as_a_command(path: Path) -> None:
    told = run("index", "address", "--json", store=path).json
    assert run("index", "address", "-q", store=path).lines == [told["uri"]]
    out = run("index", "address", store=path).out
    assert out == f"{told['uri']}\ndatabase hybridlog\n"
    mongod(path).terminate()


def test_an_address_has_no_password(tmp_path: Path) -> None:
    uri = "mongodb://me:secret@127.0.0.1:1/robots?serverSelectionTimeoutMS=1&authSource=admin"
    with hl.open(tmp_path / "store", create=True, mongo=uri) as store:
        index = store.shared.index
        index.wanted = uri
        index.connect = lambda: SimpleNamespace(name="robots")  # type: ignore[method-assign, assignment, return-value]
        assert index.address(1).uri == uri.replace(":secret", "")
