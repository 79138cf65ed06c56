"""Copies into a bucket: at the end of a chain of places, cut anywhere, fields first."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog.maintenance.copying import CopyOptions
from hybridlog_storage import copy_places
from hybridlog_storage.disk import files
from hybridlog_storage.errors import BucketError, StoreError, UsageError
from hybridlog_storage.remote.bucket import Bucket
from tests import places
from tests.copies import bring
from tests.copying.conftest import (
    STATES,
    all_answers,
    files_in,
    robots,  # noqa: F401 - a fixture
    sshd,  # noqa: F401 - a fixture
)
from tests.copying.server import Sshd
from tests.remote.server import Proxy

SEED = 20_261_128
CUTS = 4


def test_from_the_robot_to_the_bucket(
    robots: Path,  # noqa: F811
    address: str,
    proxy: Proxy,
    tmp_path: Path,
    sshd: dict[str, Sshd],  # noqa: F811
) -> None:
    """Each hop is cut at some bytes, and goes on; all places answer like the robot."""
    draw = random.Random(SEED)
    right = all_answers(robots)
    total = sum(path.stat().st_size for path in places.root(robots).glob("*/**/*.*"))
    server, here = sshd["shell"], robots
    server.reset()
    for there in (tmp_path / "disk", tmp_path / "server", Path(address)):
        is_server = there.name == "server"
        to = server.url(there) if is_server else address if there == Path(address) else there
        how = CopyOptions(ssh=server.ssh)
        with hl.open(here, mongo="none") as store:
            for _ in range(CUTS):
                number = draw.randrange(1, total // 5)
                server.left = number if is_server else None
                proxy.spoil = lambda asked, last=10 + number % 30: "403" if asked > last else ""
                proxy.requests.clear()
                with suppress(StoreError, BucketError), pytest.MonkeyPatch.context() as patch:
                    if there.name == "disk":
                        patch.setattr(copy_places.Sending, "pieces", _cut(number))
                    store.copy(to, options=how)
                proxy.reset()
            server.reset()
            assert not store.copy(to, options=how).refused
            proxy.requests.clear()
            again = store.copy(to, options=how)
        assert (again.copied, sorted(again.known)) == ([], sorted(STATES))
        assert len(proxy.requests) <= len(STATES) + 4
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
    listed = {
        f"recordings/{one.id}/{name}"
        for one in (places.manifest(robots, label) for label in STATES)
        for name in (file.name for file in one.files if file.is_here)
    }
    assert objects == listed  # none was sent twice


def _cut(most: int) -> Callable[..., Iterator[bytes]]:
    """The bytes of files, up to so many."""
    real, left = copy_places.Sending.pieces, [most]

    def pieces(self: copy_places.Sending, at: int = 0) -> Iterator[bytes]:
        for piece in real(self, at):
            left[0] -= len(piece)
            if left[0] < 0:
                raise StoreError("cut")
            yield piece

    return pieces


def test_fields_come_first_and_payloads_go_here(
    robots: Path,  # noqa: F811
    address: str,
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
        files.mounted.clear()
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
        assert report.freed_bytes
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
    with hl.open(here, mongo="none") as store:
        said = " ".join(store.recordings("recorded").topic("/cloud").completeness().sentences)
        assert f"{address} has more payloads of recorded." in said
