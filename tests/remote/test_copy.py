"""Copies into a bucket: at the end of a chain of places, cut anywhere, fields first."""

from __future__ import annotations

import random
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog.maintenance.bucket_place import BucketPlace
from hybridlog.maintenance.copying import CopyOptions, run
from hybridlog.maintenance.places import Place
from hybridlog_storage.disk import files
from hybridlog_storage.errors import BucketError, StoreError, UsageError
from hybridlog_storage.remote.bucket import Bucket
from hybridlog_storage.remote.store import RemoteDirectory
from tests import places
from tests.copies import bring
from tests.copying.conftest import (
    STATES,
    Disturbed,
    all_answers,
    directory_at,
    expire,
    files_in,
    robots,  # noqa: F401 - a fixture
    server_at,
)
from tests.remote.server import Proxy

SEED = 20_261_128
CUTS = 10


@contextmanager
def bucket_at(path: Path, store: hl.Store) -> Iterator[Place]:
    target = RemoteDirectory.create_in(f"s3://{path.as_posix().removeprefix('s3:/')}")
    yield BucketPlace(target, store.directory, store.catalog, store.session.tables)


def place_at(path: Path, store: hl.Store) -> AbstractContextManager[Place]:
    """A place of each kind, by the name of its directory."""
    if path.name == "server":
        return server_at(path)
    return directory_at(path) if path.name == "disk" else bucket_at(path, store)


def test_from_the_robot_to_the_bucket(
    robots: Path,  # noqa: F811
    address: str,
    proxy: Proxy,
    tmp_path: Path,
) -> None:
    """Each hop is cut at ten bytes, and goes on; all places answer like the robot."""
    draw = random.Random(SEED)
    right = all_answers(robots)
    total = sum(path.stat().st_size for path in places.root(robots).glob("*/**/*.*"))
    here = robots
    for there in (tmp_path / "disk", tmp_path / "server", Path(address)):
        with hl.open(here, mongo="none") as store:
            for _ in range(CUTS):
                with suppress(StoreError), place_at(there, store) as place:
                    cut = Disturbed(place, bytes_taken=draw.randrange(1, total // 5))
                    run(store.directory, cut, store.summaries())  # type: ignore[arg-type]
            with place_at(there, store) as place:
                assert not run(store.directory, place, store.summaries()).refused
                proxy.requests.clear()
                again = run(store.directory, place, store.summaries())
        assert (again.copied, sorted(again.known)) == ([], sorted(STATES))
        assert len(proxy.requests) <= len(STATES) + 1
        for label in () if there == Path(address) else STATES:
            known = files_in(places.folder(robots, label))
            assert files_in(places.folder(there, label)) == known
        files.mounted.clear()
        assert all_answers(there) == right
        here = there
    with hl.open(here) as store:
        with pytest.raises(UsageError, match="this very store"):
            store.copy(f"{address}/")
        with hl.open(tmp_path / "back", mongo="none", create=True) as back:
            assert sorted(bring(back, address).copied) == sorted(STATES)
            assert not back.verify().findings
    objects = {one.name for one in Bucket(address).objects("recordings")}
    with hl.open(here) as store:
        assert isinstance(store.directory, RemoteDirectory)
        listed = [store.directory.files_of(store.entry(name).id).values() for name in STATES]
    assert objects == {one.name for files_ in listed for one in files_}  # none was sent twice


@pytest.mark.parametrize("step", [4, pytest.param(1, marks=pytest.mark.exhaustive)])
def test_a_copy_is_cut_after_each_request(
    robots: Path,  # noqa: F811
    address: str,
    proxy: Proxy,
    step: int,
) -> None:
    with hl.open(robots, mongo="none") as store:
        for allowed in range(1, 200, step):
            files.mounted.clear()
            proxy.requests.clear()
            proxy.spoil = lambda number, last=allowed: "403" if number > last else ""
            try:
                assert store.copy(address, ["driven"]).copied == ["driven"]
                break
            except BucketError:
                proxy.reset()
                files.mounted.clear()
                with suppress(StoreError), hl.open(address) as there:
                    assert there.directory.ids() == []
        else:
            pytest.fail("it never ends")
        assert allowed > 8
        read = [name for method, name, _ in proxy.requests if method == "GET"]
        assert not [name for name in read if "tables" in name]
        proxy.reset()
        assert store.copy(address, ["driven"]).known == ["driven"]
    files.mounted.clear()
    assert all_answers(Path(address), "driven") == all_answers(robots, "driven")


def test_fields_come_first_and_payloads_go_here(
    robots: Path,  # noqa: F811
    address: str,
    proxy: Proxy,
    tmp_path: Path,
) -> None:
    """And what was added to a copy stays."""
    here = tmp_path / "here"
    with hl.open(robots, mongo="none") as robot:
        robot.copy(here, ["recorded", "driven", "noted"])
    right = all_answers(here, "recorded", "driven")
    with hl.open(here, mongo="none") as store:
        how = CopyOptions(only_fields=True, limit_rate=1e6)
        assert sorted(store.copy(address, ["recorded", "noted"], how).copied) == [
            "noted",
            "recorded",
        ]
        fields = all_answers(Path(address), "recorded")["recorded"]
        assert len(fields) < len(right["recorded"])
        assert fields.items() <= right["recorded"].items()
        with hl.open(address) as there:
            there.edit("recorded", tag={"seen": "yes"})
            there.edit("noted", name="known")
            assert not there.verify().findings
        size = sum(path.stat().st_size for path in places.root(here).glob("*/**/*.*"))
        report = store.copy(address, options=CopyOptions(then_expire=True, limit_rate=2 * size))
        assert (sorted(report.copied), report.problems) == (["driven", "known", "recorded"], [])
        assert report.freed_bytes > 0
        with hl.open(robots, mongo="none") as robot:
            assert sorted(robot.copy(address, ["recorded", "noted"]).known) == ["known", "recorded"]
    files.mounted.clear()
    found = all_answers(Path(address), "recorded", "driven")
    assert found["recorded"]["entry"][4] == {"seen": "yes"}
    for label, known in right.items():
        assert {k: v for k, v in found[label].items() if k != "entry"} == {
            k: v for k, v in known.items() if k != "entry"
        }
        assert len(all_answers(here, label)[label]) < len(known)
    with hl.open(address) as there:
        assert not there.verify().findings


def test_damaged_recordings_are_refused(
    robots: Path,  # noqa: F811
    address: str,
    tmp_path: Path,
) -> None:
    """And those that lost payloads there keep them here."""
    here = tmp_path / "here"
    with hl.open(robots, mongo="none") as robot:
        robot.copy(here, ["recorded", "noted"])
    path = places.segment(here, "noted", 1)
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 1
    path.write_bytes(data)
    with hl.open(here, mongo="none") as store:
        report = store.copy(address)
        assert (report.copied, [*report.refused]) == (["recorded"], ["noted"])
        assert "does not match its checksums" in report.refused["noted"]
        expire(store, "recorded")
        with hl.open(robots, mongo="none") as robot:
            assert robot.copy(f"{address}2", ["recorded"]).copied == ["recorded"]
        assert store.copy(f"{address}2", ["recorded"]).known == ["recorded"]
