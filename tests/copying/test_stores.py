"""Copies of stores with recordings in all states, to directories, servers and buckets."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest

import hybridlog as hl
from hybridlog.maintenance.copying import CopyOptions, CopyReport
from hybridlog_storage import copy
from hybridlog_storage.disk import files
from hybridlog_storage.errors import HeldError, UsageError
from tests import places
from tests.cli.within import answer
from tests.copying.conftest import STATES, all_answers, answers, expire, files_in
from tests.copying.server import Sshd
from tests.damage import flip


def copied(source: Path, to: Path | str, *names: str, **options: Any) -> CopyReport:
    """Copy recordings of a store; all without names."""
    with hl.open(source, mongo="none") as store:
        return store.copy(to, [*names] or None, CopyOptions(**options))


def names_in(path: Path) -> list[str]:
    with hl.open(path, mongo="none") as store:
        return sorted(one.name for one in store.session.look().summaries)


@pytest.mark.parametrize("kind", ["directory", "bucket"])
def test_all_of_it_is_there(
    robots: Path, tmp_path: Path, request: pytest.FixtureRequest, kind: str
) -> None:
    """What came into a bucket comes back, too."""
    lab = tmp_path / "lab" if kind == "directory" else Path(request.getfixturevalue("address"))
    assert sorted(copied(robots, lab).copied) == sorted(STATES)
    again = copied(robots, lab)
    assert (again.copied, sorted(again.known), again.bytes_copied) == ([], sorted(STATES), 0)
    files.mounted.clear()
    assert all_answers(lab) == all_answers(robots)
    back = tmp_path / "back"
    assert sorted(copied(lab, back).copied) == sorted(STATES)
    for label in STATES:
        assert files_in(places.folder(back, label)) == files_in(places.folder(robots, label))
    with hl.open(back, mongo="none") as store:
        assert not store.verify().findings


@pytest.mark.parametrize(("kind", "expires"), [("directory", False), ("shell", True)])
def test_a_store_is_no_copy_of_itself(
    robots: Path, tmp_path: Path, sshd: Sshd, kind: str, expires: bool
) -> None:
    store = tmp_path / "store"
    shutil.copytree(robots, store)
    (tmp_path / "link").symlink_to(store)

    def copied_to(path: Path) -> CopyReport:
        to = path if kind == "directory" else sshd.url(path)
        return copied(store, to, "calm", then_expire=expires, ssh=sshd.ssh)

    before = {path: path.read_bytes() for path in places.root(store).rglob("*.mcap")}
    for spelled in (store, tmp_path / "link", tmp_path / "link" / ".." / "store"):
        with pytest.raises(UsageError, match="this very store"):
            copied_to(spelled)
    assert {path: path.read_bytes() for path in places.root(store).rglob("*.mcap")} == before
    assert places.names(store) == sorted(STATES)
    # A backup has the same id, and is another store.
    shutil.copytree(robots, tmp_path / "backup")
    assert copied_to(tmp_path / "backup").known == ["calm"]


def test_damaged_recordings_are_refused_and_others_are_copied(robots: Path, tmp_path: Path) -> None:
    source = tmp_path / "damaged"
    shutil.copytree(robots, source)
    flip(places.segment(source, "recorded", 1), 1 / 3)
    flip(next(places.folder(source, "expired").glob("*.rows.parquet")), 1 / 3)
    places.segment(source, "noted").unlink()
    for name in ("secret", "000000.mcap.old", "000077.rows.parquet"):
        (places.folder(source, "calm") / name).write_bytes(b"not listed")
    report = copied(source, tmp_path / "lab")
    assert sorted(report.copied) == ["calm", "damaged", "driven"]
    for name in ("recorded", "expired"):
        assert "is damaged: its bytes do not have the digest" in report.refused[name]
    assert "cannot be copied: No such file" in report.refused["noted"]
    assert names_in(tmp_path / "lab") == ["calm", "damaged", "driven"]
    there = places.folder(tmp_path / "lab", "calm")
    assert files_in(there) == files_in(places.folder(robots, "calm"))


def test_payloads_expire_here_when_they_are_proved_there(robots: Path, tmp_path: Path) -> None:
    """A damaged copy is mended first."""
    robot, lab = tmp_path / "robot", tmp_path / "lab"
    shutil.copytree(robots, robot)
    right = all_answers(robot)
    with hl.open(robot, mongo="none") as store:
        store.copy(lab, ["calm"])
        flip(places.segment(lab, "calm"), 1 / 3)
        report = store.copy(lab, None, CopyOptions(then_expire=True))
        assert report.problems == []
        assert report.freed_bytes
        with pytest.raises(UsageError, match="cannot expire"):
            store.copy(lab, None, CopyOptions(then_expire=True, only_fields=True))
    here = all_answers(robot)
    assert all_answers(lab) == right
    for label in STATES:
        is_gone = label in {"recorded", "damaged", "driven", "calm"}  # a pin keeps the noted one
        found = here[label]
        assert (found != right[label]) == is_gone, label
        assert found == {key: value for key, value in right[label].items() if key in found}
    told = f"{lab} has more payloads of recorded; ask there"
    assert told in " ".join(answer("info", "recorded", store=robot).out.split())
    said = answer("fetch", "-t", "/cloud", "-r", "recorded", "--count", "--where", "data[0] > 0",
                  store=robot).err  # fmt: skip
    assert f"{told}." in " ".join(said.split())


def test_what_the_copy_has_lost_stays(robots: Path, tmp_path: Path) -> None:
    robot, lab = tmp_path / "robot", tmp_path / "lab"
    shutil.copytree(robots, robot)
    copied(robot, lab, "recorded")
    with hl.open(lab, mongo="none") as store:
        expire(store, "recorded", [0])
    before = answers(robot, "recorded")
    report = copied(robot, lab, "recorded", then_expire=True)
    assert (report.known, report.lacking) == (["recorded"], ["recorded"])
    assert "Payloads of 1 segment of recorded stay" in report.problems[0]
    assert report.freed_bytes
    with hl.open(robot, mongo="none") as store:
        logs = places.manifest(robot, "recorded").logs
        assert [n for n, log in logs.items() if log.is_here and log.number != log.group] == [1]
        assert answers(robot, "recorded").items() <= before.items()


def test_recordings_that_are_held_or_gone_keep_no_others_waiting(
    robots: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = tmp_path / "robot"
    shutil.copytree(robots, robot)
    with hl.open(robot, mongo="none") as store:
        held, gone = store.entry("noted").id, store.entry("driven").id
    real = copy.copy

    def busy(source: Any, target: Any, recording: str, how: Any) -> Any:
        if recording == held:
            raise HeldError("another process copies it")
        if recording == gone:
            source.manifests.remove(recording)
        return real(source, target, recording, how)

    monkeypatch.setattr(copy, "copy", busy)
    report = copied(robot, tmp_path / "lab", "noted", "driven", "recorded")
    assert report.copied == ["recorded"]
    assert report.held == [held]
    assert "is not copied: another process copies it" in report.refused["noted"]
    assert "'driven' is no longer in the store" in report.refused["driven"]
    assert places.names(tmp_path / "lab") == ["recorded"]


def test_a_name_that_another_recording_has_there_gets_a_number(
    robots: Path, tmp_path: Path
) -> None:
    robot, lab = tmp_path / "robot", tmp_path / "lab"
    shutil.copytree(robots, robot)
    assert copied(robot, lab, "calm", "noted").copied == ["calm", "noted"]
    with hl.open(robot, mongo="none") as store:
        store.edit("recorded", name="driven by hand")
        store.edit("calm", name="hall")
        store.edit("driven", name="calm")
    report = copied(robot, lab, "driven by hand", "calm", "hall")
    assert (sorted(report.copied), report.known) == (["calm-2", "driven by hand"], ["calm"])
    assert names_in(lab) == ["calm", "calm-2", "driven by hand", "noted"]


def test_what_a_copy_has_lost_and_is_not_here_is_told(robots: Path, tmp_path: Path) -> None:
    robot, lab = tmp_path / "robot", tmp_path / "lab"
    shutil.copytree(robots, robot)
    copied(robot, lab, "recorded")
    with hl.open(robot, mongo="none") as store:
        expire(store, "recorded", [0])
    places.segment(lab, "recorded", 1).unlink()
    before = files_in(places.folder(lab, "recorded"))
    said = copied(robot, lab, "recorded").refused["recorded"]
    assert "has lost 000001.mcap, which this store does not have either" in said
    assert files_in(places.folder(lab, "recorded")) == before


def test_what_a_stopped_copy_has_left_is_out_of_sight(robots: Path, tmp_path: Path) -> None:
    """Also when it was whole but for its manifest; what lost its manifest is not."""
    lab = tmp_path / "lab"

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(copy._Copy, "_publish", stop)
        with pytest.raises(KeyboardInterrupt):
            copied(robots, lab, "recorded")
    with hl.open(lab, mongo="none") as store:
        assert (store.session.look().summaries, store.shared.repairs.unreadable) == ([], {})
        assert not store.verify(repair=True).repaired
    report = copied(robots, lab, "recorded")
    assert (report.copied, report.bytes_copied) == (["recorded"], 0)
    recording = places.id_of(lab, "recorded")
    (lab / "manifests" / f"{recording}.json").unlink()
    with hl.open(lab, mongo="none") as store:
        assert [*store.shared.repairs.unreadable] == [recording]
