"""What a copy promises, from any place to any other one."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, NoReturn

import pytest

from hybridlog_storage.copy import Copied, CopyOptions, copy
from hybridlog_storage.copy_places import BucketStore, Directory, Place, RefusedError
from hybridlog_storage.errors import HybridlogError, StoreError, UsageError
from hybridlog_storage.manifest import Channel, Manifest, Mark, Note, Pin, replace
from hybridlog_storage.remote.bucket import Bucket
from hybridlog_storage.sftp import Server
from hybridlog_storage.stopping import at_safe_points, postpone
from tests.manifest_copies.conftest import (
    FIRST,
    MORE_PAIRS,
    RECORDING,
    SCHEMA,
    SIZES,
    Makes,
    Store,
    bytes_of,
    listed,
    recording,
)
from tests.manifest_copies.server import Sshd

Pair = tuple[Store, Store]
FILE = listed("000000.mcap")


@pytest.mark.parametrize("pair", MORE_PAIRS, indirect=True, ids="-".join)
def test_all_of_it_is_there_and_is_not_sent_again(pair: Pair) -> None:
    source, target = pair
    copied = copy(source.source, target.place, RECORDING)
    assert copied.is_new
    assert copied.sent == [*SIZES]
    assert copied.sent_bytes == sum(SIZES.values())
    assert target.check(recording()) == copied.manifest
    again = copy(source.source, target.place, RECORDING)
    assert (again.is_new, again.sent, again.sent_bytes) == (False, [], 0)
    assert target.check(recording()).changes == 0


def test_fields_first_and_the_rest_later(pair: Pair) -> None:
    source, target = pair
    options = CopyOptions(only_fields=True, address="s3://lab/store")
    assert copy(source.source, target.place, RECORDING, options).sent == [*FIRST]
    found = target.check()
    assert [file.name for file in found.files if file.is_here] == [*FIRST]
    others = [file for file in found.files if not file.is_here]
    assert {(file.gone, file.copy) for file in others} == {("elsewhere", "s3://lab/store")}
    assert copy(source.source, target.place, RECORDING, options).sent == []
    copy(source.source, target.place, RECORDING)
    target.check(recording())
    assert copy(source.source, target.place, RECORDING, options).sent == []
    target.check(recording())


def edited(now: Manifest) -> Manifest:
    """What people change of a recording."""
    return replace(
        now,
        name="kitchen",
        tags={**now.tags, "place": "lab"},
        notes=(*now.notes, Note(1, "it rained")),
        marks=(Mark("1" * 16, 5, "here"),),
        pins=(Pin("2" * 16),),
    )


def test_a_running_recording_brings_the_rest_later(pair: Pair) -> None:
    source, target = pair
    one = recording(3, "open")
    source.place.manifests.change(RECORDING, lambda now: replace(now, **as_of(one)))
    copy(source.source, target.place, RECORDING)
    target.check(one)
    target.manifests().change(RECORDING, edited)
    source.place.manifests.change(RECORDING, lambda now: replace(now, **as_of(recording())))
    assert copy(source.source, target.place, RECORDING).sent == [*SIZES][3:]
    target.check(edited(recording()))
    # An older copy of the source takes nothing back.
    source.place.manifests.change(RECORDING, lambda now: replace(now, **as_of(one)))
    assert copy(source.source, target.place, RECORDING).sent == []
    target.check(edited(recording()))


def as_of(one: Manifest) -> dict[str, Any]:
    names = ("status", "files", "channels", "losses")
    return {name: getattr(one, name) for name in names}


def test_edits_there_stay_that_are_made_meanwhile(pair: Pair) -> None:
    source, target = pair
    copy(source.source, target.place, RECORDING, CopyOptions(only_fields=True))
    edits: list[Manifest] = []

    def edit(done: int, total: int) -> None:
        if done > total // 2 and not edits:
            edits.append(target.manifests().change(RECORDING, edited))

    copy(source.source, target.place, RECORDING, progress=edit)
    assert edits
    target.check(edited(recording()))


def test_a_name_is_made_free_there(pair: Pair) -> None:
    source, target = pair
    for name in ("run-2", "run-3"):
        copied = copy(source.source, target.place, RECORDING, named=lambda _, name=name: name)
        assert copied.manifest.name == "run-2"


def test_progress_tells_all_bytes(pair: Pair) -> None:
    source, target = pair
    told: list[tuple[int, int]] = []
    copy(source.source, target.place, RECORDING, progress=lambda *now: told.append(now))
    assert told == sorted(told)
    assert told[-1] == (sum(SIZES.values()),) * 2
    assert {total for _, total in told} == {sum(SIZES.values())}


def test_a_damaged_file_is_refused_and_named(pair: Pair) -> None:
    source, target = pair
    name = "000001.large.mcap"
    path = f"recordings/{RECORDING}/{name}"
    whole = bytes_of(name)
    flipped = bytes([whole[0] ^ 1]) + whole[1:]
    for damaged in (flipped, whole[:-1], whole + b"x", None):
        source.delete(path)
        if damaged is not None:
            source.write(path, damaged)
        with pytest.raises(RefusedError, match=name):
            copy(source.source, target.place, RECORDING)
        assert not target.is_there()
        assert not any(path.endswith(name) for path in target.names())
    source.write(path, whole)
    copy(source.source, target.place, RECORDING)
    target.check(recording())


@pytest.mark.parametrize("damaged", [b"uint32 m\n", b"", None])
def test_a_damaged_definition_is_refused(make: Makes, damaged: bytes | None) -> None:
    source, target = make("directory"), make("directory")
    source.begin(recording())
    source.delete(f"schemas/{SCHEMA}")
    if damaged is not None:
        source.write(f"schemas/{SCHEMA}", damaged)
    with pytest.raises(RefusedError, match=SCHEMA):
        copy(source.source, target.place, RECORDING)
    assert not target.is_there()


@pytest.mark.parametrize("what", ["begin", "channel", "file"])
def test_another_recording_of_its_id_is_refused(pair: Pair, what: str) -> None:
    source, target = pair
    other = {
        "begin": Manifest(RECORDING, "other", 2),
        "channel": Manifest(RECORDING, "other", 1, channels={0: Channel("/other")}),
        "file": Manifest(RECORDING, "other", 1, files=(replace(FILE, digest="0" * 64, parts={}),)),
    }[what]
    with target.place.working(RECORDING):
        target.place.manifests.create(other)
    with pytest.raises(RefusedError, match="another recording, other, has its id"):
        copy(source.source, target.place, RECORDING)
    assert target.manifests().read(RECORDING) == other


def test_what_is_removed_meanwhile_does_not_come_back(pair: Pair) -> None:
    source, target = pair
    copy(source.source, target.place, RECORDING, CopyOptions(only_fields=True))
    removed: list[int] = []

    def remove(done: int, total: int) -> None:
        if done > total // 2 and not removed:
            target.manifests().remove(RECORDING)
            removed.append(done)

    with pytest.raises(HybridlogError):
        copy(source.source, target.place, RECORDING, progress=remove)
    assert not target.is_there()
    assert removed
    copy(source.source, target.place, RECORDING)
    target.check(recording())


def test_what_has_expired_there_is_not_sent_again(pair: Pair) -> None:
    source, target = pair
    copy(source.source, target.place, RECORDING)
    name = "000001.large.mcap"

    def expire(now: Manifest) -> Manifest:
        return replace(
            now,
            files=tuple(
                replace(one, gone="expired") if one.name == name else one for one in now.files
            ),
        )

    target.manifests().change(RECORDING, expire)
    target.delete(f"recordings/{RECORDING}/{name}")
    copied = copy(source.source, target.place, RECORDING)
    assert (copied.sent, copied.lacking) == ([], [name])
    target.check(expire(recording()))


def test_what_expires_here_meanwhile_is_no_damage(pair: Pair) -> None:
    source, target = pair
    expired: list[Manifest] = []

    def expire(now: Manifest) -> Manifest:
        files = (replace(one, gone="expired") if one.number == 4 else one for one in now.files)
        return replace(now, files=tuple(files))

    def meanwhile(done: int, _: int) -> None:
        if not expired:
            expired.append(source.place.manifests.change(RECORDING, expire))
            source.delete(f"recordings/{RECORDING}/000004.large.mcap")

    copy(source.source, target.place, RECORDING, progress=meanwhile)
    target.check(expired[0])


def test_files_that_are_gone_here_are_told_there(pair: Pair) -> None:
    """Also where their proven copy is."""
    source, target = pair
    files = list(recording().files)
    files[1] = replace(files[1], gone="elsewhere", copy="s3://lab/store")
    files[2] = replace(files[2], gone="expired")
    changed = source.place.manifests.change(RECORDING, lambda now: replace(now, files=(*files,)))
    copy(source.source, target.place, RECORDING)
    target.check(changed)


def test_what_was_lost_there_is_sent_again(pair: Pair) -> None:
    source, target = pair
    copy(source.source, target.place, RECORDING)
    for name in ("000000.mcap", "000004.large.mcap"):
        target.delete(f"recordings/{RECORDING}/{name}")
    assert copy(source.source, target.place, RECORDING).sent == [
        "000000.mcap",
        "000004.large.mcap",
    ]
    target.check(recording())


def test_what_is_wrong_there_is_sent_again_if_it_is_checked(pair: Pair) -> None:
    source, target = pair
    copy(source.source, target.place, RECORDING)
    path = f"recordings/{RECORDING}/000004.large.mcap"
    whole = target.read(path)
    target.write(path, whole[:-1] + b"?")
    assert copy(source.source, target.place, RECORDING).sent == []
    copied = copy(source.source, target.place, RECORDING, CopyOptions(check=True))
    assert copied.sent == ["000004.large.mcap"]
    target.check(recording())
    assert copy(source.source, target.place, RECORDING, CopyOptions(check=True)).sent == []


def test_files_expire_that_are_proved_there(pair: Pair) -> None:
    source, target = pair
    told: list[frozenset[int]] = []
    copy(source.source, target.place, RECORDING, then_expire=told.append)
    assert told == [{0, 1, 2, 3, 4}]
    path = f"recordings/{RECORDING}/000004.large.mcap"
    target.write(path, bytes_of("000004.large.mcap")[:-1] + b"?")
    files = list(recording().files)
    files[1] = replace(files[1], gone="elsewhere")
    source.place.manifests.change(RECORDING, lambda now: replace(now, files=(*files,)))
    copied = copy(source.source, target.place, RECORDING, then_expire=told.append)
    assert copied.sent == ["000004.large.mcap"]
    assert told[1:] == [{0, 2, 3, 4}]
    options = CopyOptions(only_fields=True)
    copy(source.source, target.place, RECORDING, options, then_expire=told.append)
    assert told[2:] == [{0, 3}]


def test_files_that_expire_there_meanwhile_are_not_told(pair: Pair) -> None:
    source, target = pair
    copy(source.source, target.place, RECORDING)
    told: list[frozenset[int]] = []
    expired: list[int] = []

    def expire(now: Manifest) -> Manifest:
        files = (replace(one, gone="expired") if one.number == 4 else one for one in now.files)
        return replace(now, files=tuple(files))

    def meanwhile(done: int, total: int) -> None:
        if done == total and not expired:
            expired.append(done)
            target.manifests().change(RECORDING, expire)

    copy(source.source, target.place, RECORDING, progress=meanwhile, then_expire=told.append)
    assert told == [{0, 1, 2, 3}]


@pytest.mark.parametrize("kind", ["directory", "bucket", "shell"])
def test_nothing_expires_for_a_copy_to_itself(
    make: Makes, kind: str, sshd: dict[str, Sshd], tmp_path: Path
) -> None:
    source = make("directory" if kind == "shell" else kind)
    source.begin(recording())
    told: list[frozenset[int]] = []
    with ExitStack() as held:
        if source.bucket is not None:
            target: Place = BucketStore(Bucket(source.bucket.address + "/"))
        elif kind == "shell":
            assert source.folder is not None
            server = sshd["shell"]
            target = held.enter_context(Server(server.url(source.folder), server.ssh))
        else:
            assert source.folder is not None
            (tmp_path / "other").symlink_to(source.folder)
            target = Directory(tmp_path / "other")
        with pytest.raises(UsageError, match="is this very store"):
            copy(source.source, target, RECORDING, then_expire=told.append)
    assert told == []
    source.check(recording())


def test_a_limited_rate_is_kept(pair: Pair) -> None:
    source, target = pair
    options = CopyOptions(limit_rate=500_000, only_fields=True)
    source.place.manifests.change(RECORDING, lambda now: replace(now, **as_of(recording(3))))
    copy(source.source, target.place, RECORDING, options)
    begun = time.monotonic()
    assert copy(source.source, target.place, RECORDING, CopyOptions(limit_rate=500_000)).sent
    assert time.monotonic() - begun >= (200_000 + 350_000) / 500_000 * 0.9
    target.check(recording(3))


def test_a_signal_stops_it_and_the_next_one_goes_on(pair: Pair) -> None:
    source, target = pair

    def stop() -> NoReturn:
        raise KeyboardInterrupt

    def ask(done: int, total: int) -> None:
        if done > total // 2:
            postpone(stop)

    with pytest.raises(KeyboardInterrupt), at_safe_points():
        copy(source.source, target.place, RECORDING, progress=ask)
    assert not target.is_there()
    copied = copy(source.source, target.place, RECORDING)
    assert 0 < copied.sent_bytes < sum(SIZES.values())
    target.check(recording())


@pytest.mark.parametrize("kind", ["directory", "bucket", "shell", "sftp"])
def test_ten_copies_at_once(make: Makes, sshd: dict[str, Sshd], kind: str) -> None:
    source, target = make("directory"), make(kind)
    source.begin(recording())

    def one(_: int) -> Copied:
        with ExitStack() as held:
            place: Place
            if target.bucket is not None:
                place = BucketStore(Bucket(target.bucket.address))
            elif kind == "directory":
                assert target.folder is not None
                place = Directory(target.folder)
            else:
                assert target.folder is not None
                url = sshd[kind].url(target.folder)
                place = held.enter_context(Server(url, sshd[kind].ssh))
            with suppress(StoreError if kind == "sftp" else ()):
                return copy(source.source, place, RECORDING)
            return Copied(recording(), is_new=False)

    with ThreadPoolExecutor(10) as pool:
        copied = list(pool.map(one, range(10)))
    if kind == "sftp":  # two that write one file are both refused
        copied.append(copy(source.source, target.place, RECORDING))
    target.check(recording())
    if kind in {"directory", "shell"}:
        assert sorted(len(one.sent) for one in copied) == [0] * 9 + [len(SIZES)]
