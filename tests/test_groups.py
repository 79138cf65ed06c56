"""Stores that several users of one machine use, tried as those users."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from pathlib import Path

import pytest

import hybridlog as hl
from benchmarks.simulator.write import write_bag
from tests import places
from tests.other_user import User, needs_root, open_place
from tests.waiting import wait_for

LAB = 23456  # a group that nobody has to know


def mode(path: Path) -> int:
    return stat.S_IMODE(path.lstat().st_mode)


def everything(store: Path) -> list[Path]:
    """A store's folders and files, but for the servers' own."""
    return [
        path
        for path in [store, *sorted(store.rglob("*"))]
        if not path.relative_to(store).parts[:1]
        or not path.relative_to(store).parts[0].startswith("mongod")
    ]


# --- modes, as one user ---


@pytest.mark.parametrize(("umask", "bits"), [(0o022, 0o755), (0o077, 0o700), (0o002, 0o775)])
def test_the_umask_decides_in_a_store_of_ones_own(tmp_path: Path, umask: int, bits: int) -> None:
    parent = tmp_path / "lab"
    parent.mkdir()
    parent.chmod(0o2775)
    write_bag(tmp_path / "small.bag", duration_s=5, topics=["/imu/data"])
    before = os.umask(umask)
    try:
        with hl.open(parent / "store", create=True) as store:
            store.record(tmp_path / "small.bag")
    finally:
        os.umask(before)
    for path in everything(parent / "store"):
        assert mode(path) & 0o777 == (bits if path.is_dir() else bits & 0o666), path


# --- as others ---


@pytest.fixture
def place() -> Iterator[Path]:
    with open_place() as found:
        write_bag(found / "small.bag", duration_s=5, seed=2, topics=["/imu/data", "/joint_states"])
        (found / "small.bag").chmod(0o644)
        lab = found / "lab"
        lab.mkdir()
        os.chown(lab, 0, LAB)
        lab.chmod(0o2775)
        yield found


MESSAGES = 50
CRASH = f"""
import os, sys, time
import hybridlog as hl
from tests.live.speaker import text, text_channel
store = hl.open(sys.argv[1], create=True)
live = store.start("cut", flush_interval_s=0.1)
channel = text_channel()
for number in range({MESSAGES}):
    live.write(channel, text(str(number)))
deadline = time.monotonic() + 30
while not live.lag == 0 == {MESSAGES} - live.stored[0] and time.monotonic() < deadline:
    time.sleep(0.02)
time.sleep(0.5)  # five times what flushing takes
os._exit(9)
"""
COUNT = ("fetch", "-t", "/imu/data", "--count", "-q")
ASK = (*COUNT, "--where", "header.seq >= 0")


def assert_is_the_groups(store: Path, *, others_may_read: bool) -> None:
    for path in everything(store):
        assert path.stat().st_gid == LAB, path
        wanted = 0o2770 if path.is_dir() else 0o660
        assert mode(path) & wanted == wanted, path
        assert bool(mode(path) & 0o007) == others_may_read, path


@needs_root
@pytest.mark.mongo("embedded")
def test_two_users_of_a_group_share_a_store(place: Path) -> None:
    ann = User(place, 12345, 12345, (LAB,), 0o007)
    bob = User(place, 12346, 12346, (LAB,), 0o007)
    store, bag = place / "lab" / "store", place / "small.bag"
    where = ("--store", store)
    ann.run("record", bag, "--name", "anns", "-q", *where)
    expected = ann.run(*ASK, *where).out
    assert int(expected) > 0
    assert bob.run(*ASK, *where).out == expected
    bob.run("record", bag, "--name", "bobs", "--again", "-q", *where)
    assert int(ann.run(*ASK, *where).out) == 2 * int(expected)
    bob.run("tag", "anns", "weather=rain", *where)
    assert [r["name"] for r in ann.run("ls", "--tag", "weather=rain", "--json", *where).json] == [
        "anns"
    ]
    assert_is_the_groups(store, others_may_read=False)
    assert (store / "mongod").stat().st_uid == ann.uid
    assert (store / f"mongod-{bob.uid}").stat().st_uid == bob.uid
    for own in ("mongod", f"mongod-{bob.uid}"):
        assert mode(store / own) & 0o077 == 0
    # Each may remove what the other one made.
    bob.run("rm", "-y", "anns", *where)
    ann.run("rm", "-y", "bobs", *where)
    assert places.names(store) == []


@needs_root
def test_a_crash_of_one_is_mended_by_the_other(place: Path) -> None:
    ann = User(place, 12345, 12345, (LAB,), 0o002)
    bob = User(place, 12346, 12346, (LAB,), 0o002)
    store = place / "lab" / "store"
    ann.python("-c", CRASH, store, code=9)
    assert list(places.folder(store, "cut").glob("*.mcap.open"))
    done = bob.run("edit", "cut", "--note", "found", "--store", store)
    assert f"{MESSAGES} messages of it are recovered" in done.err
    listed = bob.run("ls", "--json", "--store", store).json
    assert [r["messages"] for r in listed] == [MESSAGES]
    assert not list(places.folder(store, "cut").glob("*.mcap.open"))
    assert_is_the_groups(store, others_may_read=True)
    ann.run("rm", "-y", "cut", "--store", store)


@needs_root
@pytest.mark.mongo("embedded")
def test_somebody_outside_of_the_group_changes_nothing(place: Path) -> None:
    ann = User(place, 12345, 12345, (LAB,), 0o002)
    eve = User(place, 12347, 12347)
    store = place / "lab" / "store"
    where = ("--store", store)
    ann.run("record", place / "small.bag", "-q", *where)
    wait_for(lambda: not (store / "mongod/data/mongod.lock").read_bytes())
    expected = ann.run(*COUNT, *where).out
    before = {p: (mode(p), p.stat().st_mtime_ns) for p in everything(store)}
    assert eve.run(*COUNT, *where).out == expected, "who can read asks by topic and time"
    typed = {"_HYBRIDLOG_COMPLETE": "bash_complete", "COMP_CWORD": "4"}
    offered = eve.run(**typed, COMP_WORDS=f"hybridlog fetch --store {store} /imu/d").out
    assert offered == "plain,/imu/data\n"
    for command in (("rm", "-y", "small"), ("record", place / "small.bag"), ("index", "rebuild")):
        assert eve.run(*command, *where, code=None).code in {5, 6}
    assert {p: (mode(p), p.stat().st_mtime_ns) for p in everything(store)} == before


@needs_root
@pytest.mark.mongo("embedded")
def test_root_takes_no_ones_server(place: Path) -> None:
    ann = User(place, 12345, 12345, (LAB,), 0o002)
    store = place / "lab" / "store"
    ann.run("record", place / "small.bag", "-q", "--store", store)
    with hl.open(store, require_database=True) as opened:
        assert opened.topic("/imu/data").where({"_meta.seq": {"$gte": 0}}).count() > 0
    assert (store / "mongod-0").stat().st_uid == 0
    theirs = [store / "mongod", *(store / "mongod").rglob("*")]
    assert {p.stat().st_uid for p in theirs if p.exists()} == {ann.uid}
    ann.run(*ASK, "--store", store)
