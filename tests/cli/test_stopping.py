"""Commands that are stopped, starved, or left without MongoDB."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from pymongo import MongoClient

from tests import places
from tests.independent import read_bag
from tests.servers.mongods import Mongod
from tests.waiting import wait_for

from .running import (
    BACKGROUND,
    environment,
    open_bytes,
    run,
    started,
)

pytestmark = pytest.mark.mongo

Server = tuple[str, Mongod]

# Strong compression makes the robot's images take seconds.
SLOW = ("--level", "12", "--again")


def test_a_stopped_record_leaves_nothing(logs: Path, fresh: Path, tmp_path: Path) -> None:
    with started(
        *("record", logs / "odd.mcap", logs / "robot.bag", "--store", fresh, *SLOW),
        output=tmp_path / "out",
        wrapper=BACKGROUND,
    ) as process:
        wait_for(lambda: process.poll() is not None or open_bytes(fresh) > 100_000)
        assert process.poll() is None
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 130
    text = (tmp_path / "out").read_text()
    assert "interrupted: undone, or finished by a later command." in text
    assert "Traceback" not in text
    assert places.names(fresh) == ["odd", "small"]
    assert {r["name"] for r in run("ls", "--json", store=fresh).json} == {"odd", "small"}
    assert "all is well" in run("verify", store=fresh).out


def test_what_a_kill_leaves_is_recovered_and_told(logs: Path, fresh: Path, tmp_path: Path) -> None:
    with started(
        *("record", logs / "robot.bag", "--store", fresh, *SLOW),
        output=tmp_path / "out",
    ) as process:
        wait_for(lambda: process.poll() is not None or open_bytes(fresh) > 200_000)
        process.kill()
        assert process.wait(60) == -signal.SIGKILL
    done = run("edit", "robot", "--note", "found", store=fresh)
    assert "Recording robot was cut short by a crash:" in done.err
    done = run("ls", store=fresh)
    assert "cut short by a crash" in next(line for line in done.lines if line.startswith("robot"))
    assert done.err == ""
    (found,) = run("info", "robot", "--json", store=fresh).json
    assert 0 < found["messages"] < len(read_bag(logs / "robot.bag"))
    # Chunks of large messages are written first.
    count = run("fetch", "-t", "front/image_raw", "-r", "robot", "--count", store=fresh)
    assert "robot is not complete" in count.err
    assert "lost in 1 place (cut short by a crash);" in count.err
    assert "all is well" in run("verify", store=fresh).out


STOPS_AT_EACH = """
import os, select, signal, sys
from importlib import import_module

main = import_module("hybridlog.cli.app").main
MOMENTS = sys.argv.pop(1).split(",")

def stop(frame, event, argument):
    place = f"{event} {frame.f_code.co_qualname}"
    if waiting and place == waiting[0]:
        waiting.pop(0)
        if not waiting:
            sys.setprofile(None)
            os.kill(os.getpid(), signal.SIGTERM)

for moment in MOMENTS:
    waiting = ["call RecordingWriter.append", *[moment] * 3]
    child = os.fork()
    if child == 0:
        sys.setprofile(stop)
        main()
    ended = os.pidfd_open(child)
    if not select.select([ended], [], [], 30)[0]:
        print(f"{moment} hangs", flush=True)
        os.kill(child, signal.SIGKILL)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    print(f"{moment} {code}", flush=True)
"""

LOCKED = (
    "c_return Condition.__enter__",
    "call Condition._acquire_restore",
    "c_call ThreadPoolExecutor.submit",
    "call Threads.submit",
)
"""Moments at which an exception would leave a lock held, or a thread without its partner."""


def test_a_signal_never_finds_a_lock_that_it_leaves_held(
    logs: Path, fresh: Path, tmp_path: Path
) -> None:
    ended = subprocess.run(
        [
            *(sys.executable, "-c", STOPS_AT_EACH, ",".join(LOCKED), "record"),
            *(str(logs / "robot.bag"), "--store", str(fresh)),
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=environment(TMPDIR=str(tmp_path)),
        check=False,
    )
    codes = [line for line in ended.stdout.splitlines() if line.startswith(("call", "c_"))]
    assert codes == [f"{moment} 143" for moment in LOCKED], ended.stdout
    assert ended.stdout.count("interrupted: undone") == len(LOCKED)
    assert "Traceback" not in ended.stdout
    assert places.names(fresh) == ["small"]


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    """The URI of a mongod of one's own, and it."""
    with Mongod(tmp_path / "db") as server:
        uri = f"mongodb://{server.address}/logs?directConnection=true"
        with MongoClient(uri, serverSelectionTimeoutMS=30_000) as client:
            client.admin.command("ping")
        yield f"{uri}&serverSelectionTimeoutMS=2000", server


@pytest.mark.mongo("embedded")
def test_a_mongodb_of_ones_own_that_goes_away(server: Server, logs: Path, tmp_path: Path) -> None:
    uri, mongod = server
    store = tmp_path / "s"
    with started(
        *("record", logs / "robot.bag", "--store", store, "--mongo", uri, *SLOW),
        output=tmp_path / "out",
    ) as recording:
        wait_for(lambda: recording.poll() is not None or open_bytes(store) > 100_000)
        assert recording.poll() is None
        mongod.kill()
        # Recording goes on without the index; the exit code says that it is missing.
        assert recording.wait(120) == 6
    text = (tmp_path / "out").read_text()
    assert "stored but not in the index" in text
    assert "Traceback" not in text

    # The store remembers its server; that one is away now, and the segments know.
    seen = [m for m in read_bag(logs / "robot.bag") if m.topic == "/base/scan"]
    near = run("fetch", "-t", "scan", "--where", "range_min < 1", "--count", store=store)
    assert near.out.strip() == str(len(seen))
    assert "does not answer" in run("index", "rebuild", store=store, code=6).err
    assert "all is well" in run("verify", store=store).out

    # Another server is as good: the index is made anew from the segments.
    run("index", "rebuild", "--mongo", "embedded", store=store)
    assert "robot" in run("ls", store=store).out


def test_a_server_that_is_not_there_makes_no_store(logs: Path, tmp_path: Path) -> None:
    uri = "mongodb://user:secret@127.0.0.1:1/?serverSelectionTimeoutMS=300"
    done = run("record", logs / "odd.mcap", "--mongo", uri, store=tmp_path / "s", code=6)
    assert "does not answer" in done.err
    assert "secret" not in done.err
    assert not (tmp_path / "s").exists()


def test_a_database_of_another_store(server: Server, logs: Path, tmp_path: Path) -> None:
    uri, _ = server
    run("record", logs / "odd.mcap", "--mongo", uri, "-q", store=tmp_path / "one")
    done = run("record", logs / "odd.mcap", "--mongo", uri, store=tmp_path / "two", code=6)
    assert "another store" in done.err
    assert not (tmp_path / "two").exists()
