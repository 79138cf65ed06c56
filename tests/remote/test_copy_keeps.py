"""A copy into a bucket never takes the place of more than it brings, and proves what it sent."""

from __future__ import annotations

import shutil
import struct
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

import hybridlog as hl
from hybridlog.live.control_server import choose
from hybridlog.maintenance.bucket_place import BucketPlace
from hybridlog.maintenance.copying import CopyOptions, run
from hybridlog.maintenance.places import CopiedSegment
from hybridlog_storage.disk import files
from hybridlog_storage.errors import UsageError
from hybridlog_storage.remote.bucket import Bucket, path_of
from hybridlog_storage.remote.store import RemoteDirectory
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests.calls import Calls
from tests.cli import running as commands
from tests.cli.within import answer
from tests.copying.conftest import expire
from tests.remote.conftest import BEGIN, SCAN
from tests.remote.server import Proxy

THEN = CopyOptions(then_expire=True)
COUNT = 60


@pytest.fixture
def robot(tmp_path: Path) -> hl.Store:
    """A store with a recording of three segments."""
    store = hl.open(tmp_path / "robot", mongo="none", create=True)
    noise = np.random.default_rng(1)
    settings = SegmentSettings(chunk_size=4096, segment_size=45_000)
    with store.start("run", settings=settings) as run:
        for number in range(COUNT):
            scan = struct.pack("<II", number, 500) + noise.random(500, np.float32).tobytes()
            run.write(SCAN, scan, log_time=BEGIN + number * 10**8)
    assert store.entry("run").segments == 3
    return store


def states(address: str | Path) -> dict[str, int]:
    files.mounted.clear()
    with hl.open(address) as store:
        return dict(Counter(str(one.state) for one in store.topic("scan")))


def test_messages_have_addresses(address: str) -> None:
    with pytest.raises(UsageError, match=f"bucket of {address};"):
        choose(Path(address), [])


def lose(address: str, *names: str) -> None:
    bucket = Bucket(address)
    found = [
        one.name
        for one in bucket.objects("recordings")
        if path_of(one.name.rpartition("/")[2]) in names
    ]
    bucket.delete(found)
    files.mounted.clear()


def test_only_lost_objects_are_replaced(robot: hl.Store, address: str) -> None:
    """What only the bucket has stays, whatever was deleted here."""
    robot.copy(address)
    expire(robot, "run", [0, 1])
    assert states(robot.directory.path)["expired"] > COUNT // 2
    lose(address, "000002.mcap")
    there = states(address)
    assert there["whole"] < COUNT
    report = robot.copy(address, options=THEN)
    assert (report.copied, report.problems) == (["run"], [])
    assert states(robot.directory.path) == {"expired": COUNT}  # all of it is there
    assert states(address) == {"whole": COUNT}


def test_another_store_that_lost_more_was_faster(
    robot: hl.Store, address: str, tmp_path: Path, calls: Calls
) -> None:
    """Payloads that only this store has stay, and the copy is not called whole."""
    shutil.copytree(robot.directory.path, tmp_path / "other")
    expire(robot, "run", [0])
    before = states(robot.directory.path)

    def meanwhile(*_: object, **__: object) -> None:
        if len(published) > 1:  # by the other store
            return
        with hl.open(tmp_path / "other", mongo="none") as other:
            expire(other, "run", [1])
            assert other.copy(address).copied == ["run"]

    published = calls(BucketPlace, "publish", meanwhile)
    report = robot.copy(address, options=THEN)
    assert "with fewer payloads" in report.refused["run"]
    assert report.held == [robot.entry("run").id]
    report = robot.copy(address, options=THEN)
    assert (report.known, report.lacking) == (["run"], ["run"])
    assert "run stay" in report.problems[0]
    assert states(robot.directory.path) == before


def test_what_neither_has_is_told(robot: hl.Store, address: str) -> None:
    assert robot.copy(address, options=THEN).freed_bytes
    lose(address, "000001.mcap")
    there = states(address)
    for _ in range(2):
        report = robot.copy(address, options=THEN)
        assert report.copied == []
        assert "has lost 000001.mcap, which this store does not have" in report.refused["run"]
        assert states(address) == there
    lose(address, "manifest.json")
    report = robot.copy(address, options=THEN)
    assert "has payloads that are not here, in 000000.mcap, 0000" in report.refused["run"]


def test_a_lost_manifest_is_brought_back(robot: hl.Store, address: str) -> None:
    """With what was added there since."""
    robot.copy(address)
    with hl.open(address) as there:
        there.edit("run", tag={"seen": "yes"})
        there.mark("run", "+1s", "lab")
        there.pin("run", "+1s", "+2s", topics=["scan"], reason="mine")
        before = there.entry("run")
    lose(address, "manifest.json")
    assert robot.copy(address).copied == ["run"]
    files.mounted.clear()
    with hl.open(address) as there:
        assert not there.verify().findings
        assert before.pins
        assert there.entry("run") == before


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


def test_nothing_is_deleted_there_while_it_is_deleted_here(robot: hl.Store, address: str) -> None:
    told: list[str] = []

    def proved(recording: str, _: object) -> None:
        told.append(recording)
        with hl.open(address) as there:
            assert there.keep({"quota": "1kB", "fields-age": "1d"}).freed_bytes == 0

    place = BucketPlace(
        RemoteDirectory.create_in(address), robot.directory, robot.catalog, robot.session.tables
    )
    report = run(robot.directory, place, robot.summaries(), THEN, proved=proved)
    assert (told, report.problems) == ([robot.entry("run").id], [])
    assert states(address) == {"whole": COUNT}
    with hl.open(address) as there:
        assert not there.entry("run").pins
        assert there.keep({"quota": "1kB"}).freed_bytes


def test_a_removed_mark_there_is_no_mark(robot: hl.Store, address: str) -> None:
    robot.copy(address, options=CopyOptions(only_fields=True))
    assert "fields only, not copied yet" in answer("info", "run", store=Path(address)).out
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


def test_pins_that_a_crash_left_go_with_the_next_copy(robot: hl.Store, address: str) -> None:
    """Those of a copy under way stay, and those of users."""
    held: list[list[str]] = []

    def pins() -> list[str]:
        files.mounted.clear()
        with hl.open(address) as there:
            return [pin["id"] for pin in there.entry("run").pins]

    def proved(*_: object) -> None:
        assert robot.copy(address).known == ["run"]
        held.append(pins())
        raise KeyboardInterrupt

    class Cut(BucketPlace):
        def leave(self) -> None:
            if not held:
                super().leave()

    robot.copy(address)
    with hl.open(address) as there:
        there.pin("run", reason="mine")
    mine = pins()
    target = RemoteDirectory.create_in(address)
    place = Cut(target, robot.directory, robot.catalog, robot.session.tables)
    with pytest.raises(KeyboardInterrupt):
        run(robot.directory, place, robot.summaries(), THEN, proved=proved)
    assert len(pins()) == len(held[0]) == 2
    place._held.close()  # as a power cut does
    files.mounted.clear()
    assert robot.copy(address).known == ["run"]
    assert pins() == mine
    asked = commands.run("rm", "run", store=Path(address), code=2).err
    assert "1 pin would go, too (mine)" in " ".join(asked.split())


def test_only_fields_name_a_damaged_copy(robot: hl.Store, address: str) -> None:
    """A whole copy mends it, with its fields, which the next answer reads."""
    robot.copy(address)
    lose(address, "000001.mcap")
    report = robot.copy(address, options=CopyOptions(only_fields=True))
    assert report.known == ["run"]
    assert "is damaged: `hybridlog copy` without --only-fields mends it" in report.problems[0]
    tables = [o.name for o in Bucket(address).objects("tables")]
    lose(address, "000002.mcap")
    Bucket(address).delete(tables)
    files.mounted.clear()
    assert robot.copy(address).copied == ["run"]
    files.mounted.clear()
    with hl.open(address) as there:
        assert not there.verify().findings
        assert there.topic("scan").where("n < 10").count() == 10
    Bucket(address).delete([o.name for o in Bucket(address).objects("tables")])
    files.mounted.clear()
    assert robot.copy(address).known == ["run"]  # messages answer, too
    expire(robot, "run", [0])
    shutil.rmtree(robot.directory.path / "tables")
    robot.verify(repair=True)  # now its tables say so, and those that are sent
    assert robot.copy(address, options=CopyOptions(check=True)).copied == ["run"]
    files.mounted.clear()
    with hl.open(address) as there:
        assert not there.verify().findings
        states = there.sql("select distinct state from scan").to_arrow()["state"]
        assert states.to_pylist() == ["whole"]


@pytest.mark.parametrize(("number", "proven"), [(0, {1, 2}), (1, set())])
def test_other_payloads_expired_there(
    robot: hl.Store, address: str, number: int, proven: set[int]
) -> None:
    """In a segment that has lost some here, too, or in another one."""
    told: set[int] = set()
    expire(robot, "run", [0])

    class Other(BucketPlace):
        def segments(self, recording: str) -> dict[int, CopiedSegment]:
            found = super().segments(recording)
            other = found[number]._replace(digest="of others", expired=("/scan",))
            return {**found, number: other}

    target = RemoteDirectory.create_in(address)
    place = Other(target, robot.directory, robot.catalog, robot.session.tables)
    report = run(
        robot.directory, place, robot.summaries(), THEN, proved=lambda _, n: told.update(n)
    )
    assert report.copied == ["run"]
    assert told == proven
    assert ["its copy in" in one for one in report.problems] == [True] * (not proven)
