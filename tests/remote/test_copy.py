"""Copies into a bucket: at the end of a chain of places, cut anywhere, fields first."""

from __future__ import annotations

from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog.maintenance.copying import CopyOptions
from hybridlog_storage.disk import files
from hybridlog_storage.errors import UsageError
from hybridlog_storage.remote.bucket import Bucket
from tests import places
from tests.copies import bring
from tests.copying.conftest import (
    STATES,
    all_answers,
    robots,  # noqa: F401 - a fixture
    sshd,  # noqa: F401 - a fixture
)


def test_a_bucket_answers_like_the_robot(
    robots: Path,  # noqa: F811
    address: str,
    tmp_path: Path,
) -> None:
    """Recordings in all states, there and back again."""
    right = all_answers(robots)
    with hl.open(robots, mongo="none") as store:
        assert not store.copy(address).refused
        again = store.copy(address)
    assert (again.copied, sorted(again.known)) == ([], sorted(STATES))
    files.mounted.clear()
    assert all_answers(Path(address)) == right
    with hl.open(address) as store, pytest.raises(UsageError, match="this very store"):
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
