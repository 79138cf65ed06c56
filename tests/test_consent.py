"""Which servers a store may lead to, and that no command connects to another one."""

from __future__ import annotations

import socket
import stat
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from hybridlog.index import consent
from hybridlog_storage.errors import DatabaseError, StoreError
from hybridlog_storage.settings import StoreSettings, write_settings
from tests import places
from tests.cli.running import run

pytestmark = pytest.mark.mongo("embedded")

STORE = Path("some/store")
URI = "mongodb://me@lab-server/robots?tls=true"


@pytest.fixture(autouse=True)
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return tmp_path / "state" / "hybridlog"


def test_a_server_has_to_be_agreed_to(state: Path) -> None:
    settings = StoreSettings("a", URI)
    with pytest.raises(DatabaseError, match=r"mongodb://lab-server/robots\b.*") as caught:
        consent.trusted_uri(settings, STORE)
    assert "name it once by `--mongo URI`" in str(caught.value)
    assert "me@" not in str(caught.value)
    consent.trust("a", URI)
    assert consent.trusted_uri(settings, STORE) == URI
    for other in (StoreSettings("b", URI), StoreSettings("a", URI.replace("lab", "evil"))):
        with pytest.raises(DatabaseError):
            consent.trusted_uri(other, STORE)


def test_what_is_agreed_to_is_kept_private_and_without_a_password(state: Path) -> None:
    consent.trust("a", URI.replace("me@", "me:hunter2@"))
    assert consent.is_trusted("a", URI)
    (file,) = (state / "trusted").iterdir()
    assert file.read_bytes() == b""
    assert stat.S_IMODE((state / "trusted").stat().st_mode) == 0o700
    file.rename(state / "other")
    assert not consent.is_trusted("a", URI)
    file.symlink_to(state / "other")
    assert not consent.is_trusted("a", URI)


def test_a_home_that_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    with pytest.raises(StoreError, match="trusted"):
        consent.trust("a", URI)
    assert not consent.is_trusted("a", URI)


# --- the commands ---


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
def foreign(tmp_path: Path, listener: Listener) -> Path:
    """A store of somebody else's that leads to a server."""
    store = tmp_path / "foreign"
    places.root(store).mkdir(parents=True)
    write_settings(store, StoreSettings("f0", listener.uri))
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
def test_no_command_connects_without_consent(
    foreign: Path, listener: Listener, command: tuple[str, ...]
) -> None:
    done = run(*command, store=foreign, code=None)
    assert listener.visits == 0
    if command[0] in {"verify", "index"}:
        assert done.code == 6
        assert "name it once by `--mongo URI`" in done.err


@pytest.mark.parametrize("way", ["option", "variable"])
def test_what_was_named_once_is_used(foreign: Path, listener: Listener, way: str) -> None:
    extra = ["--mongo", listener.uri] if way == "option" else []
    env = {"HYBRIDLOG_MONGO_URI": listener.uri} if way == "variable" else {}
    run("verify", *extra, store=foreign, code=6, **env)
    assert listener.visits > 0
    before = listener.visits
    done = run("verify", store=foreign, code=6)
    assert listener.visits > before
    assert "--mongo" not in done.err


def test_another_server_that_is_named_agrees_to_nothing(foreign: Path, listener: Listener) -> None:
    run("verify", "--mongo", "mongodb://127.0.0.1:1/y", store=foreign, code=6)
    assert listener.visits == 0
    assert not consent.is_trusted("f0", listener.uri)
    run("verify", store=foreign, code=6)
    assert listener.visits == 0
