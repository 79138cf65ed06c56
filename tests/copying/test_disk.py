"""Copies into a directory: kills, power cuts, a full disk; and stores that mean harm."""

from __future__ import annotations

import errno
import os
import random
import shutil
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

import pytest
from blake3 import blake3

from hybridlog_storage.copy import Directory, How, RefusedError, copy
from hybridlog_storage.disk import files
from hybridlog_storage.errors import (
    DiskFullError,
    HybridlogError,
    ManifestError,
    RecordingGoneError,
    StoreError,
)
from hybridlog_storage.manifest import encode, replace
from tests.calls import Calls
from tests.copying.by_hand import RECORDING, Makes, Store, recording, without_payloads
from tests.copying.test_any_place import as_of, edited
from tests.power import dies, each_cut
from tests.some import each, in_turn

SMALL = recording(3)
PART = f".{SMALL.files[0].digest[:32]}.part"


@pytest.fixture
def stores(make: Makes) -> tuple[Store, Store]:
    source, target = make("directory"), make("directory")
    source.begin(SMALL)
    return source, target


def copies(source: Store, folder: Path) -> None:
    copy(source.source, Directory(folder), RECORDING)


def check(source: Store, folder: Path) -> None:
    """What a store is after a copy that was interrupted; the next one ends it."""
    target = Store(Directory(folder), folder, None)
    if target.is_there():
        target.check(SMALL)
    copies(source, folder)
    target.check(SMALL)
    target.place.manifests.change(RECORDING, edited)


@pytest.mark.parametrize(("has_some", "after"), in_turn([False, True], [False, True]))
def test_killed_at_each_system_call(
    stores: tuple[Store, Store], tmp_path: Path, has_some: bool, after: bool
) -> None:
    source, target = stores
    assert target.folder is not None
    if has_some:
        source.place.manifests.change(RECORDING, lambda now: replace(now, **as_of(recording(1))))
        copies(source, target.folder)
        source.place.manifests.change(RECORDING, lambda now: replace(now, **as_of(SMALL)))
    at, went_on = 0, True
    while went_on:
        place = tmp_path / f"{at}"
        shutil.copytree(target.folder, place)
        went_on = dies(at, partial(copies, source, place), after=after)
        if has_some and went_on:
            Store(Directory(place), place, None).check()
        else:
            check(source, place)
        at += 1
    assert at > 15


@pytest.mark.parametrize("seed", [0, *each(1, 2)])
def test_power_cut_at_each_system_call(
    stores: tuple[Store, Store], tmp_path: Path, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, target = stores
    assert target.folder is not None
    rng = random.Random(seed)
    at = 0

    def work(place: Path) -> None:
        copies(source, place)

    for found, is_done in each_cut(target.folder, tmp_path, rng, monkeypatch, work):
        if is_done:
            Store(Directory(found), found, None).check(SMALL)
        check(source, found)
        at += 1
    assert at > 15


class Full(files.System):
    """A disk with room for some bytes."""

    def __init__(self, room: int) -> None:
        self.room = room

    def writev(self, fd: int, parts: Sequence[memoryview]) -> int:
        if not self.room:
            raise OSError(errno.ENOSPC, "No space left on device")
        done = os.write(fd, parts[0][: self.room])
        self.room -= done
        return done


@pytest.mark.parametrize("room", [0, 10, 5000, 553_500])
def test_a_full_disk_keeps_what_has_arrived(
    stores: tuple[Store, Store], room: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, target = stores
    assert target.folder is not None
    with monkeypatch.context() as patch:
        patch.setattr(files, "system", Full(room))
        with pytest.raises(DiskFullError, match="Free some space"):
            copies(source, target.folder)
    assert not target.is_there()
    copied = copy(source.source, target.place, RECORDING)
    assert copied.sent_bytes <= 553_000 - max(room - 1000, 0)
    target.check(SMALL)


@pytest.mark.parametrize("what", ["recordings", "recording", "file", "part", "manifests"])
def test_links_there_are_not_followed(
    stores: tuple[Store, Store], tmp_path: Path, what: str
) -> None:
    source, target = stores
    assert target.folder is not None
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "precious").write_bytes(b"x" * 3000)
    recording_folder = target.folder / "recordings" / RECORDING
    place = {
        "recordings": target.folder / "recordings",
        "recording": recording_folder,
        "file": recording_folder / "000000.mcap",
        "part": recording_folder / PART,
        "manifests": target.folder / "manifests",
    }[what]
    place.parent.mkdir(parents=True, exist_ok=True)
    if place.is_dir():
        place.rmdir()
    place.symlink_to(outside / "precious" if what in {"file", "part"} else outside)
    with suppress(HybridlogError):
        copy(source.source, target.place, RECORDING)
        assert what == "file"  # it was replaced
        target.check(SMALL)
    assert [path.name for path in outside.rglob("*")] == ["precious"]
    assert (outside / "precious").read_bytes() == b"x" * 3000


@pytest.mark.parametrize("what", ["file", "folder", "recordings", "pipe"])
def test_links_of_the_source_are_not_followed(
    stores: tuple[Store, Store], tmp_path: Path, what: str
) -> None:
    source, target = stores
    assert source.folder is not None
    folder = source.folder / "recordings" / RECORDING
    place = {"folder": folder, "recordings": folder.parent}.get(what, folder / "000000.mcap")
    place.rename(tmp_path / "outside")
    if what == "pipe":
        os.mkfifo(place)
    else:
        place.symlink_to(tmp_path / "outside")
    with pytest.raises(StoreError):
        copy(source.source, target.place, RECORDING)
    assert not target.is_there()


@pytest.mark.parametrize("kind", ["directory", "bucket", "shell"])
def test_hostile_manifests(make: Makes, kind: str) -> None:
    source, target = make("directory"), make(kind)
    source.begin(SMALL)
    assert source.folder is not None
    text = encode(SMALL).split(b"\n")[0]
    hostile = [
        text.replace(b"000000.mcap", b"../../a.mcap"),
        text.replace(b'"bytes":3000', b'"bytes":-1'),
        text.replace(RECORDING.encode(), b"../../../etc-0123456789abcdef"),
        b"[" * 100_000,
        b"\0" * 100,
    ]
    for one in hostile:
        data = b"%b\n%b\n" % (one, blake3(one).hexdigest().encode())
        source.write(f"manifests/{RECORDING}.json", data)
        with pytest.raises(ManifestError):
            copy(source.source, target.place, RECORDING)
    source.write(f"manifests/{RECORDING}.json", encode(SMALL))
    for one in hostile:
        data = b"%b\n%b\n" % (one, blake3(one).hexdigest().encode())
        target.write(f"manifests/{RECORDING}.json", data)
        with pytest.raises(ManifestError, match=r"verify --repair|If it is deleted, .*copy"):
            copy(source.source, target.place, RECORDING)
        assert target.read(f"manifests/{RECORDING}.json") == data
    for recording_id in ("../x", "", "a b", "; touch /tmp/x"):
        with pytest.raises(RecordingGoneError):
            copy(source.source, target.place, recording_id)


@pytest.mark.parametrize("kind", ["directory", "shell"])
def test_a_manifest_without_end_is_not_read_to_its_end(make: Makes, kind: str) -> None:
    target, name = make(kind), f"manifests/{RECORDING}.json"
    assert target.folder is not None
    target.write(name, b"")
    os.truncate(target.folder / name, 70 << 20)
    with pytest.raises(ManifestError):
        target.place.manifests.read(RECORDING)


@pytest.mark.parametrize("kind", ["directory", "shell"])
def test_what_is_left_of_a_file_that_no_longer_comes_goes(make: Makes, kind: str) -> None:
    source, target = make("directory"), make(kind)
    source.begin(SMALL)
    target.write(f"recordings/{RECORDING}/.0.part", b"x")
    copy(source.source, target.place, RECORDING, How(prepare=without_payloads))
    assert not any(name.endswith(".part") for name in target.names())
    copy(source.source, target.place, RECORDING)
    target.check(SMALL)


def test_a_disk_that_cannot_be_read(stores: tuple[Store, Store], calls: Calls) -> None:
    source, target = stores

    def fail(*_: object) -> None:
        raise OSError(errno.EIO, "Input/output error")

    reads = calls(os, "pread", fail)
    with pytest.raises(RefusedError, match=r"cannot be copied: Input/output error"):
        copy(source.source, target.place, RECORDING)
    assert reads


def test_a_size_that_no_disk_has(stores: tuple[Store, Store]) -> None:
    source, target = stores
    files_ = tuple(replace(one, bytes=(1 << 63) - 1) for one in SMALL.files)
    source.place.manifests.change(RECORDING, lambda now: replace(now, files=files_))
    with pytest.raises(StoreError, match="is damaged"):
        copy(source.source, target.place, RECORDING)
    assert not target.is_there()


def test_a_part_that_is_not_of_this_file(stores: tuple[Store, Store]) -> None:
    """Such as one that a power cut has torn."""
    source, target = stores
    assert target.folder is not None
    folder = target.folder / "recordings" / RECORDING
    folder.mkdir(parents=True)
    for size in (1, 2999, 3000, 3001, 1_000_000):
        part = folder / PART
        part.write_bytes(bytes(size))
        copied = copy(source.source, target.place, RECORDING)
        assert "000000.mcap" in copied.sent
        target.check(SMALL)
        target.delete(f"recordings/{RECORDING}/000000.mcap")
