"""What needs no server asks none: no driver is imported, and no mongod is started."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from benchmarks.simulator.write import write_bag
from tests.waiting import wait_for

from .running import environment, run

pytestmark = pytest.mark.mongo("embedded")

BLOCKED = """
import json, os, sys

class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "pymongo" or name in {
            "hybridlog_storage.mongo.mongod", "hybridlog_storage.mongo.mongod_keeper"
        }:
            print("imported", name, file=sys.stderr, flush=True)
            raise ImportError(name)

sys.meta_path.insert(0, Blocked())
from hybridlog.cli import main
for words in json.loads(sys.argv[1]):
    sys.argv[1:] = words
    if not os.fork():
        main()
    if code := os.waitstatus_to_exitcode(os.wait()[1]):
        sys.exit(code)
"""
SLICE = ("fetch", "-t", "/imu/data", "--between", "+1s", "+2s")
COMMANDS = (
    ("sql", "select avg(ranges[1]) from scan where ranges_summary.min < 1"),
    *((*SLICE, "-F", form, "-o", "-") for form in ("mcap", "jsonl", "csv", "parquet")),
    (*SLICE, "--clock", "header", "-F", "raw"),
)


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


def blocked(
    store: Path, *commands: Sequence[object], script: str = BLOCKED
) -> subprocess.CompletedProcess[bytes]:
    """Run commands that can import no driver and start no server, up to one that fails."""
    words = json.dumps([[*map(str, command)] for command in commands])
    return subprocess.run(
        [sys.executable, "-c", script, words],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        env=environment(HYBRIDLOG_STORE=str(store)),
        timeout=120,
        check=False,
    )


def without(store: Path, *commands: Sequence[object]) -> None:
    log = store / "mongod" / "mongod.log"
    before = log.stat().st_mtime_ns if log.exists() else time.time_ns()
    ended = blocked(store, *commands)
    assert b"imported" not in ended.stderr, ended.stderr[-2000:]
    assert ended.returncode == 0, ended.stderr[-2000:]
    assert not log.exists() or log.stat().st_mtime_ns == before


def test_topics_and_times_are_answered_without_a_server(store: Path) -> None:
    without(store, *COMMANDS)


def test_the_blocker_blocks(store: Path) -> None:
    """The tests above can fail: making the index again does need the server."""
    ended = blocked(store, ("index", "rebuild"))
    assert ended.returncode != 0
    assert b"imported" in ended.stderr


@pytest.mark.parametrize("kind", ["log", "live"])
def test_recording_needs_no_server(store: Path, tmp_path: Path, kind: str) -> None:
    """Neither a driver nor a process beside the recorder; then every question is answered."""
    path = tmp_path / "store"
    bag = store.parent / "robot.bag"
    source = ("--replay", bag, "--speed", "20", "--name", "robot") if kind == "live" else (bag,)
    asked = (
        ("fetch", "-t", "/base/scan", "--where", "ranges.min < 1", "--count"),
        ("stats", "-t", "/imu/data", "--fields", "orientation.x"),
        ("mark", "-r", "robot", "--at", "+0s", "here"),
        ("verify", "--repair"),
    )
    recorded = ("record", *source, "--mongo", "none", "--quiet")
    without(path, recorded, *(asked if kind == "log" else asked[:1]))
    assert not (path / "mongod").exists()
    script = "import hybridlog; s = hybridlog.open(); "
    script += "print(s.topic('scan').where('range_max > 0').count() == s.topic('scan').count() > 0)"
    done = blocked(path, script=BLOCKED.partition("from hybridlog")[0] + script)
    assert (done.stdout, done.stderr) == (b"True\n", b"")
