"""A copy into a bucket never takes the place of more than it brings, and proves what it sent."""

from __future__ import annotations

import shutil
import struct
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import hybridlog as hl
from hybridlog.live.state import choose
from hybridlog.maintenance.copying import CopyOptions
from hybridlog_storage.disk import files
from hybridlog_storage.errors import UsageError
from hybridlog_storage.remote import directory_of
from hybridlog_storage.remote.bucket import Bucket
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests.cli.within import answer
from tests.copying.conftest import expire
from tests.remote.conftest import BEGIN, SCAN
from tests.remote.server import Proxy

THEN = CopyOptions(then_expire=True)
COUNT = 60


@pytest.fixture
def robot(tmp_path: Path) -> hl.Store:
    """A store with a recording of three groups, with a log each besides the first one."""
    store = hl.open(tmp_path / "robot", mongo="none", create=True)
    noise = np.random.default_rng(1)
    settings = SegmentSettings(chunk_size=4096, segment_size=45_000)
    with store.start("run", settings=settings) as run:
        for number in range(COUNT):
            scan = struct.pack("<II", number, 500) + noise.random(500, np.float32).tobytes()
            run.write(SCAN, scan, log_time=BEGIN + number * 10**8)
    assert store.entry("run").segments == 6
    return store


def states(address: str | Path) -> dict[str, int]:
    files.mounted.clear()
    with hl.open(address) as store:
        return dict(Counter(str(one.state) for one in store.topic("scan")))


def test_messages_have_addresses(robot: hl.Store, address: str) -> None:
    robot.copy(address)
    with pytest.raises(UsageError, match=f"bucket of {address};"):
        choose(directory_of(Path(address)), [])


def lose(address: str, *names: str) -> None:
    bucket = Bucket(address)
    found = [one.name for one in bucket.objects("recordings") if one.name.endswith(names)]
    assert len(found) == len(names)
    bucket.delete(found)
    files.mounted.clear()


def lose_manifest(address: str) -> None:
    bucket = Bucket(address)
    bucket.delete([one.name for one in bucket.objects("manifests") if one.name.endswith(".json")])
    files.mounted.clear()


def test_only_lost_objects_are_replaced(robot: hl.Store, address: str) -> None:
    """What only the bucket has stays, whatever was deleted here."""
    robot.copy(address)
    expire(robot, "run", [0, 1])
    assert states(robot.directory.path)["expired"] > COUNT // 2
    lose(address, "000005.mcap")
    report = robot.copy(address, options=THEN)
    assert (report.copied, report.problems) == (["run"], [])
    assert states(robot.directory.path) == {"expired": COUNT}  # all of it is there
    assert states(address) == {"whole": COUNT}


def test_what_another_store_has_let_go_keeps_its_place(
    robot: hl.Store, address: str, tmp_path: Path
) -> None:
    """Payloads that only this store has stay here, and those of others go."""
    shutil.copytree(robot.directory.path, tmp_path / "other")
    expire(robot, "run", [0])
    with hl.open(tmp_path / "other", mongo="none") as other:
        expire(other, "run", [1])
        assert other.copy(address).copied == ["run"]
    report = robot.copy(address, options=THEN)
    assert (report.known, report.lacking) == (["run"], ["run"])
    assert "Payloads of 1 segment of run stay" in report.problems[0]
    with hl.open(robot.directory.path, mongo="none") as store:
        logs = store.directory.manifests.read(store.entry("run").id).logs
        assert {number for number, log in logs.items() if not log.is_here} == {1, 5}


def test_what_neither_has_is_told(robot: hl.Store, address: str) -> None:
    assert robot.copy(address, options=THEN).freed_bytes
    lose(address, "000001.mcap")
    there = states(address)
    for _ in range(2):
        report = robot.copy(address, options=THEN)
        assert report.copied == []
        assert "has lost 000001.mcap, which this store does not have" in report.refused["run"]
        assert states(address) == there


def test_payloads_that_only_the_bucket_has_stay_without_a_manifest(
    robot: hl.Store, address: str
) -> None:
    robot.copy(address, options=THEN)
    bucket = Bucket(address)
    bucket.delete(["manifests/catalog"])
    lose_manifest(address)
    before = [one.name for one in bucket.objects("recordings")]
    report = robot.copy(address)
    assert "has payloads that are not here, in 000001.mcap, 0000" in report.refused["run"]
    assert [one.name for one in bucket.objects("recordings")] == before


def test_a_lost_manifest_is_brought_back(robot: hl.Store, address: str) -> None:
    """With what was added there since, as far as the catalog knows."""
    robot.copy(address)
    with hl.open(address) as there:
        there.edit("run", tag={"seen": "yes"})
        there.mark("run", "+1s", "lab")
        there.pin("run", "+1s", "+2s", topics=["scan"], reason="mine")
        before = replace(there.entry("run"), flushed={})
    lose_manifest(address)
    assert robot.copy(address).known == ["run"]
    files.mounted.clear()
    with hl.open(address) as there:
        assert not there.verify().findings
        assert before.pins
        assert replace(there.entry("run"), flushed={}) == before


@pytest.mark.parametrize("has_digests", [True, False])
def test_what_did_not_arrive_as_sent(
    robot: hl.Store, address: str, proxy: Proxy, has_digests: bool
) -> None:
    """Payloads stay here; also if the tags of the server are no digests of what it got."""

    spoiled = ["000001.mcap"]

    def spoil(number: int) -> str:
        method, path, _ = proxy.requests[number - 1]
        puts = [name for what, name, _ in proxy.requests if what == "PUT"]
        is_first_probe = "/probe-" in path and puts.count(path) == 1
        is_wrong = any(name in path for name in spoiled) or (is_first_probe and not has_digests)
        return "flip" if method == "PUT" and is_wrong else ""

    proxy.spoil = spoil
    report = robot.copy(address, options=THEN)
    assert "000001.mcap did not arrive" in report.refused["run"]
    assert states(robot.directory.path) == {"whole": COUNT}
    proxy.spoil = lambda number: (
        "" if "000001.mcap" in proxy.requests[number - 1][1] else spoil(number)
    )
    report = robot.copy(address, options=THEN)
    assert (report.copied, report.problems) == (["run"], [])
    read = [path for method, path, _ in proxy.requests if method == "GET" and ".mcap" in path]
    assert has_digests or read
    assert states(address) == {"whole": COUNT}


def test_an_edited_copy_gets_its_payloads(robot: hl.Store, address: str) -> None:
    robot.copy(address, options=CopyOptions(only_fields=True))
    files.mounted.clear()
    assert "not copied yet" in answer("info", "run", store=Path(address)).out
    with hl.open(address) as there:
        there.mark("run", "+1s", "lab")
        there.unmark("run", "lab")
        there.edit("run", tag={"seen": "yes"})
    robot.mark("run", "+2s", "here")
    assert robot.copy(address).copied == ["run"]
    assert states(address) == {"whole": COUNT}
    with hl.open(address) as there:
        assert (there.entry("run").tags, not there.verify().findings) == ({"seen": "yes"}, True)


def test_damaged_objects_are_replaced(
    robot: hl.Store,
    address: str,
    proxy: Proxy,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Also if their entity tags and the cache here tell nothing."""
    robot.copy(address)
    proxy.spoil = lambda number: "flip" if proxy.requests[number - 1][1].endswith("1.mcap") else ""
    with monkeypatch.context() as other:
        other.setenv("XDG_CACHE_HOME", str(tmp_path / "other"))
        files.mounted.clear()
        with hl.open(address) as there:
            assert "copy --check" in there.verify().findings[0].cure
    files.mounted.clear()
    assert robot.copy(address).known == ["run"]
    proxy.requests.clear()
    report = robot.copy(address, options=CopyOptions(check=True))
    assert (report.copied, report.problems) == (["run"], [])
    sent = [path for method, path, _ in proxy.requests if method == "PUT" and ".mcap" in path]
    assert len(sent) == 1
    assert states(address) == {"whole": COUNT}


def test_only_fields_mend_a_damaged_copy(robot: hl.Store, address: str) -> None:
    """With the whole file, as it was there; tables may be lost, since the messages answer."""
    robot.copy(address)
    lose(address, "000001.mcap")
    Bucket(address).delete([one.name for one in Bucket(address).objects("tables")])
    assert robot.copy(address, options=CopyOptions(only_fields=True)).copied == ["run"]
    assert states(address) == {"whole": COUNT}
    with hl.open(address) as there:
        assert there.topic("scan").where("n < 10").count() == 10
