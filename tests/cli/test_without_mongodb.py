"""What needs no server asks none: no driver is imported, and no mongod is started."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks.simulator.write import write_bag
from tests.waiting import wait_for

from .running import environment, run

pytestmark = pytest.mark.mongo("embedded")

BLOCKED = """
import sys

class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "pymongo" or name in {
            "hybridlog_storage.mongo.mongod", "hybridlog_storage.mongo.mongod_keeper"
        }:
            print("imported", name, file=sys.stderr, flush=True)
            raise ImportError(name)

sys.meta_path.insert(0, Blocked())
from hybridlog.cli import main
main()
"""
COMMANDS = {
    "sql": ["sql", "select avg(ranges[1]) from scan where ranges_summary.min < 1"],
    "mcap": ["fetch", "-t", "/imu/data", "--between", "+1s", "+2s", "-F", "mcap"],
    "jsonl": ["fetch", "-t", "/imu/data", "--between", "+1s", "+2s", "-F", "jsonl"],
    "csv": ["fetch", "-t", "/imu/data", "--between", "+1s", "+2s", "-F", "csv"],
    "parquet": ["fetch", "-t", "/imu/data", "--between", "+1s", "+2s", "-F", "parquet"],
    "by header stamps": ["fetch", "-t", "/imu/data", "--clock", "header",
                         "--between", "+1s", "+2s", "-F", "raw"],
}  # fmt: skip


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A store whose mongod has ended."""
    base = tmp_path_factory.mktemp("without")
    write_bag(base / "robot.bag", duration_s=4.0, topics=["/imu/data", "/base/scan", "/tf"])
    path = base / "store"
    run("record", base / "robot.bag", "--quiet", store=path)
    wait_for(lambda: not mongods(path))
    yield path
    # Nobody has started one meanwhile, however shortly it ran.
    assert not mongods(path)


def mongods(store: Path) -> list[str]:
    """Processes that say the store's mongod directory in their command line."""
    found = []
    for place in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            line = place.read_bytes().decode("utf-8", "replace")
        except OSError:
            continue
        if str(store / "mongod") in line:
            found.append(line)
    return found


def blocked(store: Path, *arguments: object) -> subprocess.CompletedProcess[bytes]:
    return subprocess.run(
        [sys.executable, "-c", BLOCKED, *map(str, arguments)],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        env=environment(HYBRIDLOG_STORE=str(store)),
        timeout=120,
        check=False,
    )


def without(store: Path, *arguments: object) -> bytes:
    """What a command says that can import no driver and start no server."""
    log = store / "mongod" / "mongod.log"
    before = log.stat().st_mtime_ns if log.exists() else time.time_ns()
    ended = blocked(store, *arguments)
    assert b"imported" not in ended.stderr, ended.stderr[-2000:]
    assert ended.returncode == 0, ended.stderr[-2000:]
    assert not log.exists() or log.stat().st_mtime_ns == before
    return ended.stdout


@pytest.mark.parametrize("name", COMMANDS)
def test_topics_and_times_are_answered_without_a_server(store: Path, name: str) -> None:
    assert without(store, *COMMANDS[name])


def test_the_blocker_blocks(store: Path) -> None:
    """The tests above can fail: making the index again does need the server."""
    ended = blocked(store, "index", "rebuild")
    assert ended.returncode != 0
    assert b"imported" in ended.stderr


@pytest.mark.parametrize("kind", ["log", "live"])
def test_recording_needs_no_server(store: Path, tmp_path: Path, kind: str) -> None:
    """Neither a driver nor a process beside the recorder; then every question is answered."""
    path = tmp_path / "store"
    bag = store.parent / "robot.bag"
    source = ("--replay", bag, "--speed", "20", "--name", "robot") if kind == "live" else (bag,)
    without(path, "record", *source, "--mongo", "none", "--quiet")
    assert not (path / "mongod").exists()
    for words in (
        ("fetch", "-t", "/base/scan", "--where", "ranges.min < 1", "--count"),
        ("stats", "-t", "/imu/data", "--fields", "orientation.x"),
        ("mark", "-r", "robot", "--at", "+0s", "here"),
        ("verify",),
        ("verify", "--repair"),
    ):
        without(path, *words)
    script = "import hybridlog, sys; s = hybridlog.open(sys.argv[1]); "
    script += "print(s.topic('scan').where('range_max > 0').count() == s.topic('scan').count() > 0)"
    asked = BLOCKED.replace("from hybridlog.cli import main\nmain()", script)
    done = subprocess.run(
        [sys.executable, "-c", asked, str(path)], capture_output=True, timeout=120, check=False
    )
    assert (done.stdout, done.stderr) == (b"True\n", b"")
