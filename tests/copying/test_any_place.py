"""What a copy promises, from any place to any other one."""

from __future__ import annotations

import time
from collections.abc import Collection
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from typing import Any, NoReturn

import pytest

from hybridlog_storage.copy import Copied, Directory, How, Place, RefusedError, copy
from hybridlog_storage.errors import HybridlogError, StoreError
from hybridlog_storage.manifest import Channel, Manifest, Mark, Note, Pin, replace, with_rows
from hybridlog_storage.remote.bucket import Bucket, Object
from hybridlog_storage.remote.store import BucketStore
from hybridlog_storage.server import Server
from hybridlog_storage.stopping import at_safe_points, postpone
from tests.copying.by_hand import (
    FIRST,
    NAMES,
    RECORDING,
    TOTAL,
    Makes,
    Store,
    bytes_of,
    listed,
    recording,
    without_payloads,
)
from tests.copying.server import Sshd
from tests.places import begin
from tests.remote.server import Proxy

Pair = tuple[Store, Store]
FILE = listed("000000.mcap")
CHECK = How(check=True)
FIELDS_FIRST = How(prepare=without_payloads)


def test_all_of_it_is_there_and_is_not_sent_again(pair: Pair) -> None:
    source, target = pair
    told: list[tuple[int, int]] = []
    how = How(progress=lambda *now: told.append(now))
    copied = copy(source.source, target.place, RECORDING, how)
    assert copied.is_new
    assert copied.sent == NAMES
    assert copied.sent_bytes == TOTAL
    assert told == sorted(told)
    assert told[-1] == (TOTAL,) * 2
    assert {total for _, total in told} == {TOTAL}
    assert target.check(recording()) == copied.manifest
    again = copy(source.source, target.place, RECORDING)
    assert (again.is_new, again.sent, again.sent_bytes) == (False, [], 0)
    assert target.check(recording()).changes == 0


def test_fields_first_and_the_rest_later(pair: Pair) -> None:
    source, target = pair
    assert copy(source.source, target.place, RECORDING, FIELDS_FIRST).sent == FIRST
    with without_payloads(recording(), list(recording().files)) as (sent, _):
        target.check(sent)
    assert [log.copy for log in sent.files].count("s3://lab/store") == 3
    assert copy(source.source, target.place, RECORDING, FIELDS_FIRST).sent == []
    copy(source.source, target.place, RECORDING)
    target.check(recording())
    assert copy(source.source, target.place, RECORDING, FIELDS_FIRST).sent == []
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
    assert copy(source.source, target.place, RECORDING).sent == NAMES[3:]
    target.check(edited(recording()))
    # An older copy of the source takes nothing back.
    source.place.manifests.change(RECORDING, lambda now: replace(now, **as_of(one)))
    assert copy(source.source, target.place, RECORDING).sent == []
    target.check(edited(recording()))


def as_of(one: Manifest) -> dict[str, Any]:
    names = ("status", "files", "channels", "losses")
    return {name: getattr(one, name) for name in names}


def test_a_damaged_file_is_refused_and_named(pair: Pair) -> None:
    source, target = pair
    name = "000001.mcap"
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


@pytest.mark.parametrize("what", ["begin", "channel", "file"])
def test_another_recording_of_its_id_is_refused(directories: Pair, what: str) -> None:
    source, target = directories
    other = {
        "begin": Manifest(RECORDING, "other", 2),
        "channel": Manifest(RECORDING, "other", 1, channels={0: Channel("/other")}),
        "file": Manifest(RECORDING, "other", 1, files=(replace(FILE, parts={}),)),
    }[what]
    with target.place.working(RECORDING):
        begin(target.place.manifests, other)
    with pytest.raises(RefusedError, match="another recording, other, has its id"):
        copy(source.source, target.place, RECORDING)
    assert target.manifests().read(RECORDING) == other


def test_what_is_removed_meanwhile_does_not_come_back(pair: Pair) -> None:
    source, target = pair
    copy(source.source, target.place, RECORDING, FIELDS_FIRST)
    removed: list[int] = []

    def remove(done: int, total: int) -> None:
        if done > total // 2 and not removed:
            target.manifests().remove(RECORDING)
            removed.append(done)

    with pytest.raises(HybridlogError):
        copy(source.source, target.place, RECORDING, How(progress=remove))
    assert not target.is_there()
    assert removed
    copy(source.source, target.place, RECORDING)
    target.check(recording())


def test_files_that_go_meanwhile_are_not_listed(pair: Pair) -> None:
    """A removal that another process finishes takes them along."""
    source, target = pair
    removed: list[str] = []

    def remove(done: int, total: int) -> None:
        if done == total and not removed:
            removed.append(f"recordings/{RECORDING}/{FILE.name}")
            target.delete(removed[0])

    with pytest.raises(StoreError, match=r"have gone .* Copy again"):
        copy(source.source, target.place, RECORDING, How(progress=remove))
    assert removed
    copy(source.source, target.place, RECORDING)
    target.check(recording())


def expire(store: Store, number: int = 1) -> Manifest:
    """Let the payloads of a log go."""
    rows = f"{number:06d}.rows.parquet"
    store.write(f"recordings/{RECORDING}/{rows}", bytes_of(rows))

    def how(now: Manifest) -> Manifest:
        return with_rows(now, replace(now.logs[number], gone="expired"), [listed(rows)])

    found = store.manifests().change(RECORDING, how)
    store.delete(f"recordings/{RECORDING}/{number:06d}.mcap")
    return found


def test_what_has_expired_there_is_not_sent_again(directories: Pair) -> None:
    source, target = directories
    copy(source.source, target.place, RECORDING)
    expired = expire(target)
    for how in (How(), CHECK, FIELDS_FIRST):
        copied = copy(source.source, target.place, RECORDING, how)
        assert (copied.sent, copied.lacking, copied.lost) == ([], [1], [])
        target.check(expired)


def test_what_has_expired_here_stays_there(directories: Pair) -> None:
    source, target = directories
    copy(source.source, target.place, RECORDING)
    expire(source)
    copied = copy(source.source, target.place, RECORDING, CHECK)
    assert (copied.sent, copied.lacking, copied.lost) == ([], [], [])
    target.check(recording())
    expired = expire(target, 4)  # others than here
    told: list[Collection[int]] = []
    assert copy(source.source, target.place, RECORDING, How(proved=told.append)).lacking == [4]
    target.check(expired)
    assert told == [{0, 2}]
    target.delete(f"recordings/{RECORDING}/000001.mcap")
    copied = copy(source.source, target.place, RECORDING, CHECK)
    assert (copied.sent, copied.lost) == ([], ["000001.mcap"])


def test_what_expires_here_meanwhile_is_no_damage(pair: Pair) -> None:
    source, target = pair
    expired: list[Manifest] = []

    def meanwhile(done: int, _: int) -> None:
        if not expired:
            expired.append(expire(source, 4))

    copy(source.source, target.place, RECORDING, How(progress=meanwhile))
    target.check(expired[0])


def test_what_expired_here_replaces_what_was_to_come(directories: Pair) -> None:
    source, target = directories
    copy(source.source, target.place, RECORDING, FIELDS_FIRST)
    expired = expire(source)
    assert copy(source.source, target.place, RECORDING).lacking == []
    assert sorted(target.check().files, key=str) == sorted(expired.files, key=str)


@pytest.mark.parametrize("has_digests", [True, False])
def test_what_does_not_arrive_as_it_was_sent_is_refused(
    make: Makes, proxy: Proxy, monkeypatch: pytest.MonkeyPatch, has_digests: bool
) -> None:
    """By a bucket; also if the tags of the server are no digests of what it got."""
    source, target = make("directory"), make("bucket")
    source.begin(recording())
    if not has_digests:
        monkeypatch.setattr(Object, "has_md5_of", lambda *_: False)

    def spoil(number: int) -> str:
        method, path, _ = proxy.requests[number - 1]
        return "flip" if method == "PUT" and "000001.mcap" in path else ""

    proxy.spoil = spoil
    with pytest.raises(RefusedError, match=r"000001\.mcap did not arrive"):
        copy(source.source, target.place, RECORDING)
    assert not target.is_there()
    proxy.reset()
    copy(source.source, target.place, RECORDING)
    read = [path for method, path, _ in proxy.requests if method == "GET" and ".mcap" in path]
    assert has_digests or read
    target.check(recording())


def test_what_was_lost_there_is_sent_again(pair: Pair) -> None:
    source, target = pair
    copy(source.source, target.place, RECORDING)
    lost = ["000000.mcap", "000004.mcap"]
    for name in lost:
        target.delete(f"recordings/{RECORDING}/{name}")
    assert copy(source.source, target.place, RECORDING).sent == lost
    target.check(recording())


def test_what_is_wrong_there_is_sent_again_if_it_is_checked(pair: Pair) -> None:
    """So it is before payloads expire here: files are told that are proved there."""
    source, target = pair
    told: list[Collection[int]] = []
    copy(source.source, target.place, RECORDING, How(proved=told.append))
    path = f"recordings/{RECORDING}/000004.mcap"
    whole = target.read(path)
    for how in (CHECK, How(proved=told.append)):
        target.write(path, whole[:-1] + b"?")
        assert copy(source.source, target.place, RECORDING).sent == []
        assert copy(source.source, target.place, RECORDING, how).sent == ["000004.mcap"]
        target.check(recording())
        assert copy(source.source, target.place, RECORDING, CHECK).sent == []
    assert told == [{n for n, log in recording().logs.items() if log.is_here}] * 2


def test_files_that_expire_there_meanwhile_are_not_told(directories: Pair) -> None:
    source, target = directories
    copy(source.source, target.place, RECORDING)
    told: list[Collection[int]] = []
    expired: list[int] = []

    def meanwhile(done: int, total: int) -> None:
        if done == total and not expired:
            expired.append(done)
            expire(target, 4)

    how = How(progress=meanwhile, proved=told.append)
    copy(source.source, target.place, RECORDING, how)
    assert told == [{0, 1, 2}]


def test_a_lost_manifest_is_made_again_there_first(make: Makes) -> None:
    """It may have said more than is known here."""
    source, target = make("directory"), make("directory")
    source.begin(recording())
    copy(source.source, target.place, RECORDING)
    target.manifests().change(RECORDING, edited)
    target.delete(f"manifests/{RECORDING}.json")
    before = target.names()
    with pytest.raises(RefusedError, match="verify --repair"):
        copy(source.source, target.place, RECORDING)
    assert target.names() == before


def test_payloads_that_are_only_there_are_not_replaced(make: Makes) -> None:
    source, target = make("directory"), make("bucket")
    source.begin(recording())
    copy(source.source, target.place, RECORDING)
    target.delete(f"manifests/{RECORDING}.json")
    assert copy(source.source, target.place, RECORDING).sent == []
    target.check(recording())
    expire(source)
    target.delete(f"manifests/{RECORDING}.json")
    before = target.names()
    with pytest.raises(RefusedError, match=r"is not here, in 000001\.mcap"):
        copy(source.source, target.place, RECORDING)
    assert {*before} - {*target.names()} == set()


def test_one_that_was_made_again_is_made_whole(directories: Pair) -> None:
    source, target = directories
    copy(source.source, target.place, RECORDING)
    changed = recording(3, "unproven")
    target.manifests().change(RECORDING, lambda now: replace(edited(now), **as_of(changed)))
    copy(source.source, target.place, RECORDING)
    target.check(edited(recording()))
    source.place.manifests.change(RECORDING, lambda now: replace(now, status="unproven"))
    with pytest.raises(RefusedError, match="its manifest was lost and made again"):
        copy(source.source, target.place, RECORDING, CHECK)


def test_a_limited_rate_is_kept(directories: Pair) -> None:
    source, target = directories
    source.place.manifests.change(RECORDING, lambda now: replace(now, **as_of(recording(3))))
    begun = time.monotonic()
    assert copy(source.source, target.place, RECORDING, How(limit_rate=5_000_000)).sent
    assert time.monotonic() - begun >= (200_000 + 350_000) / 5_000_000 * 0.9
    target.check(recording(3))


def test_a_signal_stops_it_and_the_next_one_goes_on(pair: Pair) -> None:
    source, target = pair

    def stop() -> NoReturn:
        raise KeyboardInterrupt

    def ask(done: int, total: int) -> None:
        if done > total // 2:
            postpone(stop)

    with pytest.raises(KeyboardInterrupt), at_safe_points():
        copy(source.source, target.place, RECORDING, How(progress=ask))
    assert not target.is_there()
    copied = copy(source.source, target.place, RECORDING)
    assert 0 < copied.sent_bytes < TOTAL
    target.check(recording())


@pytest.mark.parametrize("kind", ["directory", "bucket", "shell"])
def test_copies_at_once(make: Makes, sshd: Sshd, kind: str) -> None:
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
                url = sshd.url(target.folder)
                place = held.enter_context(Server(url, sshd.ssh))
            return copy(source.source, place, RECORDING)

    with ThreadPoolExecutor(4) as pool:
        copied = list(pool.map(one, range(4)))
    target.check(recording())
    if kind in {"directory", "shell"}:
        assert sorted(len(one.sent) for one in copied) == [0] * 3 + [len(NAMES)]
