"""Manifests on a disk: processes, kills, power cuts, full disks, links, locks."""

from __future__ import annotations

import errno
import fcntl
import os
import random
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import pytest

from hybridlog_storage.disk import files
from hybridlog_storage.errors import (
    DiskFullError,
    HeldError,
    StoreError,
)
from hybridlog_storage.manifest import Manifest, encode, new_id, replace
from hybridlog_storage.manifests import DiskManifests
from tests.calls import Calls
from tests.limits import Limit
from tests.places import begin
from tests.power import dies, each_cut
from tests.some import each, in_turn

ONE = Manifest(new_id("run"), "run", 1)


def tagged(now: Manifest) -> Manifest:
    return replace(now, tags={"a": "b"})


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """A store with a recording that was changed once, and has a file."""
    place = tmp_path / "store"
    place.mkdir()
    (place / "hybridlog.toml").touch()
    manifests = DiskManifests(place)
    begin(manifests, ONE)
    manifests.change(ONE.id, lambda now: replace(now, name="first"))
    (place / "recordings" / ONE.id / "000000.mcap").write_bytes(b"x" * 5000)
    return place


def names(store: Path) -> list[str]:
    return sorted(str(path.relative_to(store)) for path in store.rglob("*") if path.is_file())


_ADDS = """
import sys
from pathlib import Path
from hybridlog_storage.errors import RecordingGoneError
from hybridlog_storage.manifest import Note, replace
from hybridlog_storage.manifests import DiskManifests
manifests, recording = DiskManifests(Path(sys.argv[1])), sys.argv[2]
for at in range(int(sys.argv[3]), int(sys.argv[3]) + 100):
    try:
        manifests.change(recording, lambda now: replace(now, notes=(*now.notes, Note(at, ""))))
    except RecordingGoneError:
        sys.exit(9)
"""


def adding(store: Path) -> list[subprocess.Popen[bytes]]:
    """Processes that add many notes each."""
    return [
        subprocess.Popen([sys.executable, "-c", _ADDS, str(store), ONE.id, str(first)])
        for first in range(0, 400, 100)
    ]


def test_no_edit_of_several_processes_is_lost(store: Path) -> None:
    manifests, last = DiskManifests(store), 0
    processes = adding(store)
    while any(process.poll() is None for process in processes):
        now = manifests.read(ONE.id)  # never missing, never damaged, never older
        assert now.changes >= last
        last = now.changes
    assert {process.returncode for process in processes} == {0}
    noted = sorted(note.at for note in manifests.read(ONE.id).notes)
    assert noted == [*range(400)]


def test_nothing_comes_back_after_a_removal(store: Path) -> None:
    manifests = DiskManifests(store)
    processes = adding(store)
    while manifests.read(ONE.id).changes < 30:
        time.sleep(0.001)
    manifests.remove(ONE.id)
    assert manifests.ids() == []
    assert {process.wait() for process in processes} <= {0, 9}
    assert names(store) == ["hybridlog.toml", "manifests/.lock"]
    assert list((store / "recordings").iterdir()) == []


OTHER = Manifest(new_id("other"), "other", 2)
WORKS: dict[str, Callable[[DiskManifests], object]] = {
    "change": lambda m: m.change(ONE.id, tagged),
    "create": lambda m: begin(m, OTHER),
    "remove": lambda m: m.remove(ONE.id),
}


def check(place: Path, what: str) -> None:
    """What a store is after work that was interrupted, and that the work can be done again."""
    manifests = DiskManifests(place)
    ids = manifests.ids()
    if what == "change":
        assert manifests.read(ONE.id).tags in ({}, {"a": "b"})
        assert manifests.change(ONE.id, tagged).tags == {"a": "b"}
    elif what == "create":
        if OTHER.id not in ids:
            begin(manifests, OTHER)
        assert manifests.read(OTHER.id) == OTHER
        assert manifests.read(ONE.id).name == "first"
        manifests.change(OTHER.id, tagged)
    elif ONE.id in ids:
        manifests.remove(ONE.id)
        assert manifests.ids() == []
    hidden = [name for name in names(place) if Path(name).name.startswith(".")]
    assert set(hidden) <= {"manifests/.lock"}


@pytest.mark.parametrize(("what", "after"), in_turn([*WORKS], [False, True]))
def test_killed_at_each_system_call(store: Path, tmp_path: Path, what: str, after: bool) -> None:
    at, went_on = 0, True
    while went_on:
        place = tmp_path / f"{at}"
        shutil.copytree(store, place)
        went_on = dies(at, partial(WORKS[what], DiskManifests(place)), after=after)
        check(place, what)
        at += 1
    assert at > 6


@pytest.mark.parametrize("seed", [0, *each(1, 2)])
@pytest.mark.parametrize("what", WORKS)
def test_power_cut_at_each_system_call(
    store: Path, tmp_path: Path, what: str, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = random.Random(f"{what} {seed}")
    at = 0

    def work(place: Path) -> None:
        WORKS[what](DiskManifests(place))

    for found, is_done in each_cut(store, tmp_path, rng, monkeypatch, work):
        if is_done:
            ids = DiskManifests(found).ids()
            assert (ONE.id in ids, OTHER.id in ids) == (what != "remove", what == "create")
            assert what != "create" or (found / "recordings" / OTHER.id).is_dir()
            assert what != "change" or DiskManifests(found).read(ONE.id).tags == {"a": "b"}
        check(found, what)
        at += 1
    assert at > 6


class Full(files.System):
    """A full disk: half of what is written has room, then nothing."""

    def writev(self, fd: int, parts: Sequence[memoryview]) -> int:
        if len(parts[0]) < 30:
            raise OSError(errno.ENOSPC, "No space left on device")
        return os.write(fd, parts[0][: len(parts[0]) // 2])


def test_a_full_disk_refuses_the_change_and_nothing_else(
    store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    manifests = DiskManifests(store)
    before, had = manifests.read(ONE.id), names(store)
    with monkeypatch.context() as patch:
        patch.setattr(files, "system", Full())
        with pytest.raises(DiskFullError, match="Free some space"):
            manifests.change(ONE.id, tagged)
        with pytest.raises(DiskFullError):
            begin(manifests, OTHER)
        assert manifests.read(ONE.id) == before
        assert manifests.ids() == [ONE.id]
        assert {*names(store)} - {*had} <= {f"recordings/{OTHER.id}/manifest.lock"}
    assert manifests.change(ONE.id, tagged).changes == before.changes + 1
    begin(manifests, OTHER)


def test_without_locks_it_can_only_be_read(store: Path, calls: Calls) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    calls(fcntl, "flock", refuse)
    manifests = DiskManifests(store)
    assert manifests.read(ONE.id).name == "first"
    for work in WORKS.values():
        with pytest.raises(StoreError, match=r"no locks .*can only be read"):
            work(manifests)
    assert manifests.read(ONE.id).name == "first"


def test_without_hard_links_there_is_no_older_one(store: Path, calls: Calls) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.EPERM, "Operation not permitted")

    manifests = DiskManifests(store)
    old = store / "recordings" / ONE.id / "manifest.old"
    assert old.read_bytes() == encode(ONE)
    calls(files.System, "link", refuse)
    manifests.change(ONE.id, tagged)
    assert manifests.read(ONE.id).tags == {"a": "b"}


def test_folders_without_a_manifest_are_told_unless_they_hold_nothing(store: Path) -> None:
    manifests = DiskManifests(store)
    lost, copied, bare = (new_id(name) for name in ("lost", "copied", "bare"))
    for path in (f"{lost}/manifest.lock", f"{lost}/000000.mcap", f"{copied}/000000.mcap",
                 f"{bare}/manifest.lock", "by-hand/000000.mcap"):  # fmt: skip
        (store / "recordings" / path).parent.mkdir(exist_ok=True)
        (store / "recordings" / path).touch()
    (store / "recordings" / "file").touch()
    (store / "recordings" / "link").symlink_to(store)
    assert manifests.without() == [lost, "by-hand"]
    assert manifests.ids() == [ONE.id]


def test_who_stands_still_is_not_waited_for_without_end(store: Path, limit: Limit) -> None:
    limit(manifest_wait_s=0.2)
    with (store / "recordings" / ONE.id / "manifest.lock").open("r+") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(HeldError, match="Another process has held"):
            DiskManifests(store).change(ONE.id, tagged)
    assert DiskManifests(store).change(ONE.id, tagged).tags == {"a": "b"}


def test_a_lock_that_was_replaced_while_it_was_waited_for_is_taken_anew(
    store: Path, calls: Calls
) -> None:
    lock = store / "recordings" / ONE.id / "manifest.lock"
    replaced: list[int] = []

    def replace_once(fd: int, _: int) -> None:
        if not replaced and os.path.samestat(os.fstat(fd), lock.stat()):
            replaced.append(lock.stat().st_ino)
            other = lock.with_name("other")  # exists before the first is gone: another inode
            other.touch()
            other.rename(lock)

    locked = calls(fcntl, "flock", replace_once)
    DiskManifests(store).change(ONE.id, tagged)
    assert replaced
    assert len(locked) == 2


def test_an_empty_folder_that_a_copy_left_out_is_made(store: Path) -> None:
    shutil.rmtree(store / "recordings")
    (store / "recordings").mkdir()
    assert DiskManifests(store).change(ONE.id, tagged).tags == {"a": "b"}


def test_no_two_manifests_look_alike(store: Path) -> None:
    """However fast they follow each other; sizes and inodes come again."""
    manifests = DiskManifests(store)
    seen = set()
    for number in range(100):
        how = lambda now, n=number: replace(now, tags={"a": f"{n:03d}"})  # noqa: E731
        manifests.change(ONE.id, how)
        seen.add(manifests.path(ONE.id).stat().st_mtime_ns)
    assert len(seen) == 100


def test_on_a_full_disk_a_removal_needs_no_room(
    store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files, "system", Full())
    DiskManifests(store).remove(ONE.id)
    assert names(store) == ["hybridlog.toml", "manifests/.lock"]


def test_who_keeps_a_recording_is_asked_first_and_not_again(store: Path) -> None:
    manifests = DiskManifests(store)

    def pinned(_: Manifest) -> None:
        raise StoreError("A pin was set meanwhile.")

    with pytest.raises(StoreError, match="pin"):
        manifests.remove(ONE.id, pinned)
    assert manifests.read(ONE.id).status == "open"
    manifests.change(ONE.id, lambda now: replace(now, status="removed"))
    manifests.remove(ONE.id, pinned)
    assert manifests.ids() == []


@pytest.mark.parametrize(
    ("place", "what"),
    [("manifest", "link"), ("manifest", "folder"), ("manifest", "pipe"),
     ("lock", "link"), ("lock", "folder")],  # a pipe is a lock like any file
)  # fmt: skip
def test_odd_things_are_told_by_a_plain_sentence(store: Path, what: str, place: str) -> None:
    manifests = DiskManifests(store)
    lock = store / "recordings" / ONE.id / "manifest.lock"
    path = manifests.path(ONE.id) if place == "manifest" else lock
    path.unlink()
    make = {
        "link": lambda: path.symlink_to("x"),
        "folder": path.mkdir,
        "pipe": lambda: os.mkfifo(path),
    }
    make[what]()
    with pytest.raises(StoreError, match=f"^{path} is a link, or of another kind .*: move it out"):
        manifests.change(ONE.id, tagged)
