"""What manifests promise, wherever they lie."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pytest

from hybridlog_storage.errors import ManifestError, RecordingGoneError, StoreError
from hybridlog_storage.manifest import Manifest, Note, encode, new_id, replace
from hybridlog_storage.manifests import DiskManifests, Manifests
from hybridlog_storage.remote.bucket import Bucket
from hybridlog_storage.remote.store import BucketManifests, BucketStore
from tests.calls import Calls
from tests.places import begin
from tests.remote.server import Proxy


def begun(name: str = "run") -> Manifest:
    return Manifest(new_id(name), name, 1_700_000_000_000_000_000)


def spoil(manifests: Manifests, one: Manifest, data: bytes | None) -> None:
    """Damage a manifest, or delete it."""
    if isinstance(manifests, DiskManifests):
        path = manifests.path(one.id)
        path.unlink()
        if data is not None:
            path.write_bytes(data)
        return
    assert isinstance(manifests, BucketManifests)
    manifests._bucket.delete([f"manifests/{one.id}.json"])
    if data is not None:
        manifests._bucket.create(f"manifests/{one.id}.json", data)
    manifests.look(now=True)


def test_a_recording_begins_once(manifests: Manifests) -> None:
    one, other = begun(), begun("other")
    begin(manifests, one)
    begin(manifests, other)
    assert manifests.ids() == sorted([one.id, other.id])
    assert manifests.read(one.id) == one
    with pytest.raises(StoreError, match="already"):
        begin(manifests, replace(one, name="another"))
    assert manifests.read(one.id) == one


def test_a_change_is_there_when_it_returns(manifests: Manifests) -> None:
    one = begun()
    begin(manifests, one)
    changed = manifests.change(one.id, lambda now: replace(now, tags={"a": "b"}))
    assert changed == replace(one, tags={"a": "b"}, changes=1)
    assert manifests.read(one.id) == changed


def test_what_changes_nothing_writes_nothing(manifests: Manifests) -> None:
    one = begun()
    begin(manifests, one)
    assert manifests.change(one.id, lambda now: now) == one
    assert manifests.change(one.id, lambda now: replace(now, name="run")) == one
    assert manifests.read(one.id).changes == 0


def test_who_it_is_never_changes(manifests: Manifests) -> None:
    one = begun()
    begin(manifests, one)
    manifests.change(one.id, lambda now: replace(begun("other"), created=2, changes=7))
    assert manifests.read(one.id) == replace(one, name="other", changes=1)


def test_what_a_change_raises_ends_it(manifests: Manifests) -> None:
    one = begun()
    begin(manifests, one)

    def refuse(now: Manifest) -> Manifest:
        raise FileNotFoundError(now.name)

    with pytest.raises(FileNotFoundError):
        manifests.change(one.id, refuse)
    with pytest.raises(StoreError, match="cannot be changed like this"):
        manifests.change(one.id, lambda now: replace(now, name="a/b"))
    assert manifests.read(one.id) == one
    manifests.change(one.id, lambda now: replace(now, name="next"))


def test_nothing_is_created_by_a_change(manifests: Manifests) -> None:
    for recording in (begun().id, "run", "../run", "..", ""):
        with pytest.raises(RecordingGoneError):
            manifests.read(recording)
        with pytest.raises(RecordingGoneError):
            manifests.change(recording, lambda now: now)
        with pytest.raises(RecordingGoneError):
            manifests.remove(recording)
    begin(manifests, begun())
    assert len(manifests.ids()) == 1


def test_what_is_removed_is_gone_and_can_be_copied_here_again(manifests: Manifests) -> None:
    one, other = begun(), begun("other")
    begin(manifests, one)
    begin(manifests, other)
    manifests.remove(one.id)
    assert manifests.ids() == [other.id]
    for ask in (manifests.read, manifests.remove):
        with pytest.raises(RecordingGoneError):
            ask(one.id)
    with pytest.raises(RecordingGoneError):
        manifests.change(one.id, lambda now: replace(now, name="back"))
    begin(manifests, one)
    assert manifests.read(one.id) == one


def test_a_removal_that_was_interrupted_can_be_finished(
    manifests: Manifests, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = begun()
    begin(manifests, one)
    with monkeypatch.context() as patch:
        patch.setattr(type(manifests), "_delete_files", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            manifests.remove(one.id)
    with pytest.raises(RecordingGoneError, match="removed"):
        manifests.read(one.id)
    with pytest.raises(RecordingGoneError, match="removed"):
        manifests.change(one.id, lambda now: replace(now, status="open"))
    assert manifests.ids() == [one.id]
    manifests.remove(one.id)
    assert manifests.ids() == []


def test_a_removal_spares_what_was_copied_here_meanwhile(
    manifests: Manifests, calls: Calls
) -> None:
    one = begun()
    begin(manifests, one)
    others: list[str] = []

    def meanwhile(recording: str, **_: object) -> None:
        if not others:
            others.append(recording)
            manifests.remove(recording)
            begin(manifests, one)

    calls(manifests, "_forget", meanwhile)
    manifests.remove(one.id)
    assert others
    assert manifests.read(one.id) == one
    assert manifests.change(one.id, lambda now: replace(now, name="next")).changes == 1


@pytest.mark.parametrize("what", ["cut", "flipped", "of another", "lost"])
def test_a_damaged_one_is_named_and_made_again(manifests: Manifests, what: str) -> None:
    one = begun()
    begin(manifests, one)
    manifests.change(one.id, lambda now: replace(now, tags={"a": "b"}))
    manifests.change(one.id, lambda now: replace(now, tags={"a": "c"}))
    data = encode(manifests.read(one.id))
    spoil(
        manifests,
        one,
        {
            "cut": data[:-9],
            "flipped": data.replace(b'"c"', b'"d"'),
            "of another": encode(begun()),
            "lost": None,
        }[what],
    )
    is_lost = what == "lost"
    kind = RecordingGoneError if is_lost else ManifestError
    words = "no rec" if is_lost else "--repair|hybridlog copy"
    with pytest.raises(kind, match=words):
        manifests.read(one.id)
    with pytest.raises(kind):
        manifests.change(one.id, lambda now: replace(now, name="x"))
    if not isinstance(manifests, DiskManifests):
        return
    older: list[Manifest | None] = []

    def make(old: Manifest | None) -> Manifest:
        older.append(old)
        return old or one

    made = manifests.restore(one.id, make)
    assert manifests.read(one.id) == made
    assert made.status == "unproven"
    assert older == [replace(one, tags={"a": "b"}, changes=1)]
    assert manifests.restore(one.id, make) == made
    assert len(older) == 1


def test_of_changes_at_once_none_is_lost(manifests: Manifests) -> None:
    one = begun()
    begin(manifests, one)

    def add(first: int) -> None:
        for at in range(first, first + 6):
            manifests.change(
                one.id, lambda now, at=at: replace(now, notes=(*now.notes, Note(at, "x")))
            )

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(add, range(0, 400, 100)))
    now = manifests.read(one.id)
    wanted = [first + n for first in range(0, 400, 100) for n in range(6)]
    assert sorted(note.at for note in now.notes) == wanted
    assert now.changes == 24


def test_an_edit_in_a_bucket_takes_two_requests(address: str, proxy: Proxy) -> None:
    manifests = BucketStore(Bucket(address)).manifests
    one = begun()
    begin(manifests, one)
    manifests.change(one.id, lambda now: replace(now, name="first"))  # tries the server once
    proxy.reset()
    manifests.change(one.id, lambda now: replace(now, name="next"))
    assert [method for method, *_ in proxy.requests] == ["GET", "PUT"]
    proxy.reset()
    assert manifests.ids() == [one.id]
    assert len(proxy.requests) == 1


def test_a_change_whose_answer_is_lost_is_made_once(address: str, proxy: Proxy) -> None:
    manifests = BucketStore(Bucket(address)).manifests
    one = begun()
    begin(manifests, one)
    for number in range(1, 4):
        proxy.reset()
        proxy.spoil = lambda n, at=number: "lost" if n == at else ""
        note = Note(number, "x")
        manifests.change(
            one.id,
            lambda now, note=note: (
                now if note in now.notes else replace(now, notes=(*now.notes, note))
            ),
        )
    proxy.reset()
    assert [note.at for note in manifests.read(one.id).notes] == [1, 2, 3]
