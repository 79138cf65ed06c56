"""Which servers a store may lead to, and that no command connects to another one."""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from hybridlog.index import access
from hybridlog_storage.errors import DatabaseError
from hybridlog_storage.mongo.database import Database
from hybridlog_storage.settings import NAME, StoreSettings, is_own, write_settings
from tests import places
from tests.cli.running import run
from tests.other_user import needs_root

pytestmark = pytest.mark.mongo("embedded")


class Listener:
    """Counts who connects."""

    def __init__(self) -> None:
        self.socket = socket.create_server(("127.0.0.1", 0))
        self.visits = 0
        threading.Thread(target=self._count, daemon=True).start()

    @property
    def uri(self) -> str:
        port = self.socket.getsockname()[1]
        return f"mongodb://127.0.0.1:{port}/x?serverSelectionTimeoutMS=500"

    def _count(self) -> None:
        while True:
            try:
                self.socket.accept()[0].close()
            except OSError:
                return
            self.visits += 1


@pytest.fixture
def listener() -> Iterator[Listener]:
    found = Listener()
    yield found
    found.socket.shutdown(socket.SHUT_RDWR)  # wakes the thread that accepts
    found.socket.close()


@pytest.fixture
def foreign(tmp_path: Path, listener: Listener, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A store of somebody else's that leads to a server."""
    store = tmp_path / "foreign"
    places.root(store).mkdir(parents=True)
    write_settings(store, StoreSettings("f0", listener.uri))
    monkeypatch.setattr(access, "is_own", lambda _: False)
    return store


@pytest.mark.parametrize(
    "command",
    [
        ("info",),
        ("fetch", "-t", "x"),
        ("verify",),
        ("index", "rebuild"),
        ("index", "list"),
        ("record", __file__),
    ],
    ids=" ".join,
)
def test_no_command_connects_to_the_server_of_another_owner(
    foreign: Path, listener: Listener, command: tuple[str, ...]
) -> None:
    done = run(*command, store=foreign, code=None)
    assert listener.visits == 0
    if command[0] == "index":
        assert done.code == 6
        assert "name it by `--mongo URI`" in done.err


@pytest.mark.parametrize("way", ["option", "variable", "owner"])
def test_what_is_named_or_owned_is_used(
    foreign: Path, listener: Listener, way: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    extra = ["--mongo", listener.uri] if way == "option" else []
    env = {"HYBRIDLOG_MONGO_URI": listener.uri} if way == "variable" else {}
    if way == "owner":
        monkeypatch.setattr(access, "is_own", is_own)
    run("index", "rebuild", *extra, store=foreign, code=6, **env)
    assert listener.visits > 0


@needs_root
def test_a_store_belongs_to_the_owner_of_its_settings(tmp_path: Path) -> None:
    write_settings(tmp_path, StoreSettings("a"))
    assert is_own(tmp_path)
    os.chown(tmp_path / NAME, 12345, -1)
    assert not is_own(tmp_path)


@pytest.mark.parametrize("is_named", [True, False])
def test_the_password_goes_only_to_a_server_that_was_named(
    tmp_path: Path, is_named: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An unpacked store is its user's own, and may come from anybody."""
    uri, given = "mongodb://me@127.0.0.1:1/x", list[str]()
    write_settings(tmp_path, StoreSettings("a", uri))

    def connect(uri: str, **_: object) -> None:
        given.append(uri)
        raise DatabaseError("no")

    monkeypatch.setattr(Database, "connect", connect)
    env = {"HYBRIDLOG_MONGO_PASSWORD": "hunter2"}
    run("index", "rebuild", *(["--mongo", uri] if is_named else []), store=tmp_path, code=6, **env)
    assert {*given} == {uri.replace("me@", "me:hunter2@") if is_named else uri}
