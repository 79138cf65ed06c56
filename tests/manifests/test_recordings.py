"""Recordings as manifests: begun, listed, ended, brought up to date, made again."""

from __future__ import annotations

import os
import random
import shutil
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from blake3 import blake3
from mcap.reader import NonSeekingReader

from hybridlog_storage.disk import files
from hybridlog_storage.errors import (
    DiskFullError,
    HybridlogError,
    ManifestError,
    RecordingGoneError,
    SegmentError,
    StoreError,
)
from hybridlog_storage.manifest import Manifest, Note, Source, free_name, is_id, replace
from hybridlog_storage.messages import Batch, Channel, Schema
from hybridlog_storage.recordings import Changes, Content, Recordings, ending, listing
from hybridlog_storage.segments.segment_file import Sealed
from hybridlog_storage.segments.segment_format import (
    END_METADATA,
    LOSSES_METADATA,
    json_metadata,
)
from hybridlog_storage.segments.segment_writer import RecordingWriter, SegmentSettings
from tests.power import PowerCut
from tests.storage.steps import Steps

SCHEMA = Schema("a/B", "ros2msg", b"uint8[] data")
CHANNELS = [Channel("/a", "cdr", SCHEMA, {"x": "y"}), Channel("/b", "json", None)]
SMALL = SegmentSettings(chunk_size=1 << 10, segment_size=1500, compression="none", sync="chunk")
MESSAGES = 11
LOST = {
    "cause": "queue", "count": 3, "file": None, "from": 5, "length": None, "offset": None,
    "reason": "slow", "to": 6, "topic": "/a",
}  # fmt: skip


def message(number: int) -> Batch:
    data = bytes([number]) * 300
    one = np.ones(1, np.int64)
    return Batch(
        data,
        np.zeros(1, np.int64),
        one * len(data),
        np.full(1, number % 2, np.int32),
        one * (100 + number),
        one * number,
        np.zeros(1, np.uint32),
    )


class Recorder:
    """Records messages as a recorder does; each that `flushed` has is in a file."""

    def __init__(self, store: Path, flushed: Callable[[int], object] = lambda _: None) -> None:
        self.recordings = Recordings(store)
        self.flushed = flushed
        self.manifest = self.recordings.begin("run", list, tags={"a": "b"})
        now = self.manifest
        said = {"id": now.id, "name": now.name, "tags": now.tags, "source": {}}
        self.changes = Changes(self.recordings.manifests, now.id)
        self.writer = RecordingWriter(
            self.recordings.folder(now.id),
            {**said, "created": now.created},
            lambda chunk, _: [flushed(one) for one in (chunk.batch.log_time - 100).tolist()],
            SMALL,
            on_sealed=self.sealed,
        )

    def sealed(self, sealed: Sealed) -> None:
        log = self.recordings.log(self.manifest.id, sealed.file, sealed.blake3)
        self.changes.submit(listing(log))

    def run(self) -> None:
        for number in range(MESSAGES):
            self.writer.append(message(number), CHANNELS)
            if number == 5:
                self.writer.add_extra(json_metadata(LOSSES_METADATA, {"rows": [LOST]}))
            self.writer.flush()
        self.writer.close(json_metadata(END_METADATA, {"status": "complete", "losses": []}))
        self.changes.submit(ending("complete"))
        self.changes.close()


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """An empty store."""
    store = tmp_path / "store"
    store.mkdir()
    (store / "hybridlog.toml").touch()
    return store


def only(store: Path) -> Manifest:
    recordings = Recordings(store)
    (one,) = recordings.manifests.ids()
    return recordings.manifests.read(one)


def messages_of(store: Path, manifest: Manifest) -> list[int]:
    """The messages in the files of a manifest, by the official reader; checks what it lists."""
    folder, found = store / "recordings" / manifest.id, []
    totals: dict[str, int] = {}
    for file in manifest.files:
        data = (folder / file.name).read_bytes()
        assert (file.bytes, file.digest) == (len(data), blake3(data).hexdigest())
        if manifest.damage:  # other readers may show what is torn
            continue
        with (folder / file.name).open("rb") as stream:
            own = [(c.topic, m) for _, c, m in NonSeekingReader(stream).iter_messages()]
        for topic, one in own:
            assert one.data == bytes([one.log_time - 100]) * 300
            totals[topic] = totals.get(topic, 0) + 1
        times = [one.log_time for _, one in own]
        assert (file.first, file.last) == (min(times, default=None), max(times, default=None))
        assert sum(part.messages for part in file.parts.values()) == len(own)
        assert sum(part.bytes for part in file.parts.values()) == 300 * len(own)
        found += [time - 100 for time in times]
    listed = {c.topic: c.messages for c in manifest.channels.values() if c.messages}
    assert manifest.damage or listed == totals
    return sorted(found)


def test_a_recording_is_its_manifest(place: Path) -> None:
    Recorder(place).run()
    now = only(place)
    assert is_id(now.id)
    assert (now.name, now.status, now.tags) == ("run", "complete", {"a": "b"})
    assert messages_of(place, now) == list(range(MESSAGES))
    assert len(now.files) > 2
    a, b = now.channels.values()
    assert (a.topic, a.type, a.encoding, a.metadata) == ("/a", "a/B", "cdr", {"x": "y"})
    assert (a.first, a.last, a.bytes) == (100, 99 + MESSAGES, 300 * (MESSAGES // 2 + 1))
    assert Recordings(place).schemas.get(a.schema) == SCHEMA
    assert (b.type, b.schema) == ("", "")
    (loss,) = now.losses
    assert (loss.cause, loss.topic, loss.count, loss.first, loss.last) == ("queue", "/a", 3, 5, 6)
    found = Recordings(place).content(now)
    assert found == Content([], [], [], [])


def test_what_is_whole_is_brought_up(place: Path) -> None:
    """Without the manifest's changes, a recorder that was killed has lost nothing."""
    recorder = Recorder(place)
    recorder.sealed = lambda _: None  # type: ignore[method-assign]
    recorder.writer._on_sealed = lambda _: None
    for number in range(MESSAGES):
        recorder.writer.append(message(number), CHANNELS)
        recorder.writer.flush()
    recorder.writer.abort()
    recorder.changes.close()
    recordings, now = Recordings(place), only(place)
    found = recordings.content(now)
    assert not now.files
    assert len(found.unlisted) > 2
    assert len(found.open) == 1
    done = recordings.bring_up(now.id)
    assert done.sealed == sorted([*found.unlisted, found.open[0].removesuffix(".open")])
    now = only(place)
    assert now.status == "recovered"
    assert messages_of(place, now) == list(range(MESSAGES))
    before = now.changes
    assert not recordings.bring_up(now.id).sealed
    assert only(place).changes == before


def dies(work: Callable[[], object], system: files.System) -> bool:
    """Whether a process died at a call of the file system."""
    child = os.fork()
    if child == 0:
        try:
            files.system = system
            work()
            os._exit(0)
        finally:
            os._exit(1)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert code in {0, 7}
    return code == 7


class Dying(files.System):
    """Ends the process at its n-th call, before or after it is done."""

    def __init__(self, at: int, *, after: bool) -> None:
        self._left, self._after = at, after
        self._lock = threading.Lock()

    def __getattribute__(self, name: str) -> Any:
        found = super().__getattribute__(name)
        if name.startswith("_"):
            return found

        def step(*arguments: Any, **options: Any) -> Any:
            with self._lock:
                if self._left == 0 and not self._after:
                    os._exit(7)
                result = found(*arguments, **options)
                if self._left == 0:
                    os._exit(7)
                self._left -= 1
                return result

        return step


def bring_up(store: Path, recording: str) -> None:
    with suppress(RecordingGoneError):  # it was empty, and who died had removed it
        Recordings(store).bring_up(recording)


def flushed(path: Path) -> list[int]:
    return sorted({*path.read_bytes()}) if path.exists() else []


@pytest.mark.parametrize("after", [False, True])
def test_a_recorder_killed_at_each_system_call(place: Path, tmp_path: Path, after: bool) -> None:
    """What was flushed is there, also when who comes after is killed as well."""
    rng = random.Random(after)
    at, went_on = 0, True
    while went_on:
        store, told = tmp_path / f"{at}", tmp_path / f"{at} told"
        shutil.copytree(place, store)
        fd = os.open(told, os.O_WRONLY | os.O_CREAT | os.O_APPEND)

        def work(store: Path = store, fd: int = fd) -> None:
            Recorder(store, lambda one: os.write(fd, bytes([one]))).run()

        went_on = dies(work, Dying(at, after=after))
        for recording in Recordings(store).manifests.ids():
            again, left = 0, True
            while left:
                left = dies(partial(bring_up, store, recording), Dying(again, after=after))
                again += rng.randrange(1, 12)
        recordings = Recordings(store)
        for recording in recordings.manifests.ids():
            recordings.bring_up(recording)
        ids = recordings.manifests.ids()
        want = flushed(told)
        if ids:
            now = only(store)
            assert now.status in ({"complete", "recovered"} if went_on else {"complete"})
            got = messages_of(store, now)
            assert {*want} <= {*got}
            assert got == list(range(len(got)))
            content = recordings.content(now)
            assert content == Content([], [], [], [])
        else:
            assert not want
        os.close(fd)
        at += rng.randrange(1, 4)
    assert at > 60


@pytest.mark.parametrize("seed", range(2))
def test_a_power_cut_at_each_system_call(
    place: Path, tmp_path: Path, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was forced to the disk is there: chunks of `sync="chunk"`."""
    rng = random.Random(seed)
    at, is_done = 0, False
    while not is_done:
        store, found = tmp_path / f"{at}", tmp_path / f"{at} after"
        shutil.copytree(place, store)
        power, told = PowerCut(store, at), []
        with monkeypatch.context() as patch:
            patch.setattr(files, "system", power)
            try:
                Recorder(store, told.append).run()
                is_done = True
            except (HybridlogError, OSError):
                pass
        power.after_cut(found, rng)
        recordings = Recordings(found)
        for recording in recordings.manifests.ids():
            recordings.bring_up(recording)
        if recordings.manifests.ids():
            got = messages_of(found, only(found))
            assert not is_done or got == list(range(MESSAGES))
        else:
            assert not is_done
        at += 3
    assert at > 60


def test_a_lost_manifest_is_made_again(place: Path) -> None:
    Recorder(place).run()
    recordings, before = Recordings(place), only(place)
    recordings.manifests.change(before.id, lambda now: replace(now, notes=(Note(1, "kept"),)))
    before = recordings.manifests.change(before.id, lambda now: replace(now, name="named"))
    manifest = place / "manifests" / f"{before.id}.json"
    folder = recordings.folder(before.id)
    for break_it in (manifest.unlink, lambda: manifest.write_bytes(b"{")):
        break_it()
        with pytest.raises((RecordingGoneError, ManifestError)):
            recordings.manifests.read(before.id)
        made = recordings.restore(before.id)
        assert made.status == "unproven"
        assert (made.notes, made.files) == (before.notes, before.files)
        assert messages_of(place, made) == list(range(MESSAGES))
    manifest.unlink()
    (folder / "manifest.old").unlink()
    made = recordings.restore(before.id)
    assert (made.id, made.name, made.created) == (before.id, "run", before.created)
    assert made.tags == before.tags
    assert [file.digest for file in made.files] == [file.digest for file in before.files]
    assert made.channels == before.channels
    assert recordings.restore(before.id) == made
    manifest.unlink()
    for path in folder.glob("*.mcap"):
        path.unlink()
    with pytest.raises(StoreError, match="Nothing readable says which recording"):
        recordings.restore(before.id)


def test_what_is_missing_and_what_is_not_ours(place: Path) -> None:
    Recorder(place).run()
    recordings, now = Recordings(place), only(place)
    folder = recordings.folder(now.id)
    first, second, third = now.files[:3]
    (folder / first.name).unlink()
    os.truncate(folder / second.name, 10)
    (folder / ".000009.mcap.0123").touch()
    found = recordings.content(now)
    assert [file.name for file in found.missing] == [first.name, second.name]
    assert found.left_over == [".000009.mcap.0123"]
    shutil.copy(folder / third.name, folder / "000099.mcap")
    with pytest.raises(SegmentError, match="is file 2 of recording"):
        recordings.log(now.id, "000099.mcap")
    schema = next(iter(now.channels.values())).schema
    path = place / "schemas" / schema
    path.write_bytes(path.read_bytes() + b"x")
    with pytest.raises(StoreError, match="is damaged"):
        recordings.schemas.get(schema)
    path.unlink()
    with pytest.raises(StoreError, match="is missing"):
        recordings.schemas.get(schema)
    assert recordings.log(now.id, third.name).file.digest == third.digest  # puts it there again
    assert Recordings(place).schemas.digests() == {schema}


def test_an_empty_recording_goes_and_a_removal_is_finished(place: Path) -> None:
    recordings = Recordings(place)
    one = recordings.begin("empty", list)
    assert recordings.bring_up(one.id).is_removed
    with pytest.raises(RecordingGoneError):
        recordings.bring_up(one.id)
    Recorder(place).run()
    now = only(place)
    manifests = recordings.manifests
    manifests._change(now.id, lambda now: replace(now, status="removed"))
    assert recordings.bring_up(now.id).is_removed
    assert manifests.ids() == []
    assert not recordings.folder(now.id).exists()


def test_names_are_unique_and_plain(place: Path) -> None:
    recordings = Recordings(place)
    names: list[str] = []
    for _ in range(3):
        names.append(recordings.begin("a/b\n", lambda: names).name)
    assert names == ["a-b-", "a-b--2", "a-b--3"]
    assert free_name("", ()) == "recording"
    assert free_name("..x", ()) == "x"
    long = free_name("ä" * 300, ())
    assert len(long.encode()) <= 255
    assert free_name(long, {long}).endswith("-2")
    assert len(free_name(long, {long}).encode()) <= 255


def test_refused_by_who_looks_while_it_begins(place: Path) -> None:
    def refuse() -> Sequence[str]:
        raise StoreError("it is there")

    with pytest.raises(StoreError, match="it is there"):
        Recordings(place).begin("x", refuse)
    assert Recordings(place).manifests.ids() == []


def test_a_change_without_room_is_made_with_the_next(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recordings = Recordings(place)
    one = recordings.begin("run", list, source=Source("rosbag1", "/x"))
    changes = Changes(recordings.manifests, one.id)
    with monkeypatch.context() as patch:
        full = Steps(fail_from=0, only=frozenset({"write"}))
        patch.setattr(files, "system", full)
        changes.submit(lambda now: replace(now, notes=(*now.notes, Note(1, "a"))))
        while not full.failed:
            pass
    changes.submit(lambda now: replace(now, notes=(*now.notes, Note(2, "b"))))
    changes.close()
    assert [note.text for note in recordings.manifests.read(one.id).notes] == ["a", "b"]

    changes = Changes(recordings.manifests, one.id)
    with monkeypatch.context() as patch:
        patch.setattr(files, "system", Steps(fail_from=0, only=frozenset({"write"})))
        changes.submit(lambda now: replace(now, notes=()))
        with pytest.raises(DiskFullError):
            changes.close()
    changes = Changes(recordings.manifests, one.id)
    recordings.manifests.remove(one.id)
    changes.submit(lambda now: replace(now, notes=()))
    with pytest.raises(RecordingGoneError):
        changes.close()
