"""Copies to places: cut anywhere and resumed, in all states of a recording."""

from __future__ import annotations

import errno
import io
import os
import random
import shutil
import threading
import time
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from msgspec import structs

import hybridlog as hl
from hybridlog.maintenance import copying, ssh
from hybridlog.maintenance.copying import CopyOptions, CopyReport, run
from hybridlog.maintenance.places import CopiedFile, Place, RefusedError, merged
from hybridlog_storage import manifest
from hybridlog_storage.disk import files
from hybridlog_storage.disk.directory import StoreDirectory
from hybridlog_storage.errors import DiskFullError, HeldError, StoreError, UsageError
from tests import places
from tests.calls import Calls
from tests.copying.conftest import (
    STATES,
    Disturbed,
    PlaceAt,
    answers,
    directory_at,
    expire,
    files_in,
    server_at,
)
from tests.limits import Limit

PLACES: dict[str, PlaceAt] = {"directory": directory_at, "server": server_at}
ROUNDS = 10
SEED = 20_261_128


def _flip_a_bit(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 1
    path.write_bytes(data)


def _frame(request: dict[str, object]) -> bytes:
    stream = io.BytesIO()
    ssh._write(stream, request)
    return stream.getvalue()


@pytest.fixture(params=PLACES)
def place_at(request: pytest.FixtureRequest) -> PlaceAt:
    return PLACES[request.param]


def copied(source: Path, place: Any, *names: str, **options: Any) -> CopyReport:
    """Copy recordings of a store; all without names."""
    with hl.open(source, mongo="none") as store:
        chosen = [one for one in store.summaries() if not names or one.name in names]
        return run(store.directory, place, chosen, CopyOptions(**options))


def names_in(path: Path) -> list[str]:
    with hl.open(path, mongo="none") as store:
        return sorted(one.name for one in store.summaries())


@pytest.mark.parametrize("step", [4, pytest.param(1, marks=pytest.mark.exhaustive)])
def test_a_copy_that_was_cut_goes_on(
    robots: Path, tmp_path: Path, place_at: PlaceAt, step: int
) -> None:
    label = "driven"  # segments, and files of columns
    with place_at(tmp_path / "whole") as place:
        whole = Disturbed(place)
        total = copied(robots, whole, label).bytes_copied
    right = files_in(places.folder(robots, label))
    for number in range(1, len(whole.asked), step):
        target = tmp_path / str(number)
        with suppress(StoreError), place_at(target) as place:
            cut = Disturbed(place, number)
            copied(robots, cut, label)
        # Nothing is believed before all of it is there.
        assert not [*places.root(target).glob("[!.]*")]
        with place_at(target) as place:
            report = copied(robots, place, label)
            assert report.copied == [label]
            assert report.bytes_copied == total - cut.taken
            counted = Disturbed(place)
            assert copied(robots, counted, label).known == [label]
        assert counted.asked == ["sees", "have"]  # of all that are there already
        assert files_in(places.folder(target, label)) == right
        assert places.names(target) == [label]
        shutil.rmtree(target)


def test_a_connection_is_cut_at_any_byte(robots: Path, tmp_path: Path) -> None:
    draw = random.Random(SEED)
    arrived = 0
    for number in range(ROUNDS):
        with suppress(StoreError), server_at(tmp_path / "lab", draw.randrange(20_000)) as place:
            copied(robots, place, "noted", piece=1000)
        hidden = [*places.root(tmp_path / "lab").glob(".importing-*/*.mcap")]
        before, arrived = arrived, sum(path.stat().st_size for path in hidden)
        assert arrived >= before, number
    with server_at(tmp_path / "lab") as place:
        assert copied(robots, place, "noted").copied == ["noted"]
    assert answers(tmp_path / "lab", "noted") == answers(robots, "noted")


@pytest.mark.parametrize("expires", [False, True])
def test_a_store_is_no_copy_of_itself(
    robots: Path, tmp_path: Path, place_at: PlaceAt, expires: bool
) -> None:
    store = tmp_path / "store"
    shutil.copytree(robots, store)
    (tmp_path / "link").symlink_to(store)
    before = {path: path.read_bytes() for path in places.root(store).rglob("*.mcap")}
    for spelled in (store, tmp_path / "link", tmp_path / "link" / ".." / "store"):
        with place_at(spelled) as place, pytest.raises(UsageError, match="this very store"):
            copied(store, place, then_expire=expires)
    assert {path: path.read_bytes() for path in places.root(store).rglob("*.mcap")} == before
    assert places.names(store) == sorted(STATES)
    # A backup has the same id, and is another store.
    with place_at(robots) as place:
        assert sorted(copied(store, place, then_expire=expires).known) == sorted(STATES)


def test_a_mark_that_another_process_removes_is_made_again(robots: Path, tmp_path: Path) -> None:
    class Swept(Disturbed):
        def sees(self, mark: str) -> bool:
            if not self.asked:
                (places.root(robots) / mark).unlink()
            return bool(self.__getattr__("sees")(mark))

    for spelled, is_same in ((robots, True), (tmp_path / "lab", False)):
        with directory_at(spelled) as place, suppress(UsageError):
            swept = Swept(place)
            copied(robots, swept, "noted")
            assert not is_same
        assert swept.asked[:2] == ["sees", "sees"]


def test_what_is_there_is_proved_before_it_is_believed(
    robots: Path, tmp_path: Path, place_at: PlaceAt
) -> None:
    """Bytes that a cut copy has left, and that changed since, are copied again."""
    with suppress(StoreError), place_at(tmp_path / "lab") as place:
        copied(robots, Disturbed(place, bytes_taken=30_000), "recorded")
    hidden = sorted(places.root(tmp_path / "lab").glob(".importing-*/*.mcap"))
    assert len(hidden) == 2
    for path in hidden:
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 1
        path.write_bytes(data)
    with place_at(tmp_path / "lab") as place:
        assert copied(robots, place, "recorded").copied == ["recorded"]
    there, here = (places.folder(at, "recorded") for at in (tmp_path / "lab", robots))
    assert files_in(there) == files_in(here)


def test_damaged_recordings_are_refused_and_others_are_copied(
    robots: Path, tmp_path: Path, place_at: PlaceAt
) -> None:
    source = tmp_path / "damaged"
    shutil.copytree(robots, source)
    path = places.segment(source, "recorded", 1)
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 1
    path.write_bytes(data)
    places.segment(source, "noted").unlink()
    with place_at(tmp_path / "lab") as place:
        report = copied(source, place)
    assert sorted(report.copied) == ["calm", "damaged", "driven", "expired"]
    assert "does not match its checksums" in report.refused["recorded"]
    assert "is incomplete" in report.refused["noted"]
    assert names_in(tmp_path / "lab") == ["calm", "damaged", "driven", "expired"]


DIGEST = "0" * 64
NONE = "other-" + "0" * 16
"""Id of no recording."""


def test_a_place_believes_nothing(robots: Path, tmp_path: Path, place_at: PlaceAt) -> None:
    found = places.read_in(places.folder(robots, "recorded"))
    assert found is not None
    recording, whole = found.id, manifest.encode(found)
    other = manifest.encode(manifest.replace(found, id=NONE))
    open_ = manifest.encode(manifest.replace(found, status="open"))
    rows = manifest.replace(
        found, files=tuple(structs.replace(one, kind="rows") for one in found.files)
    )
    refused = "damaged, or of another"
    file = CopiedFile("000000.mcap", 4, DIGEST)
    with place_at(tmp_path / "lab") as place:
        place.begin(recording, wants_payloads=True)
        for data, why in (
            (whole, "was not copied"),
            (manifest.encode(rows), "was not copied"),
            (other, refused),
            (open_, refused),
            (whole[:-100], refused),
            (whole.replace(b'"complete"', b'"recovered"'), refused),
            (b"", refused),
        ):
            with pytest.raises(StoreError, match=why):
                place.publish(data)
        place.append(file, 0, b"abcd")
        assert not place.prove(file)
        for at, data, why in ((9, b"abcd", "does not have 9 bytes"), (0, b"abcde", "more came")):
            with pytest.raises(StoreError, match=why):
                _append(place, file, at, data)
    assert names_in(tmp_path / "lab") == []


def _append(place: Place, file: CopiedFile, at: int, data: bytes) -> None:
    place.append(file, at, data)
    place.prove(file)  # a server says only now that it failed


@pytest.mark.parametrize(
    "name",
    ["../../x", "../000000.mcap", "manifest.json", "/etc/x", "a/../b", "a/..", "..", "a/b/c"],
)
def test_a_server_writes_only_its_store(robots: Path, tmp_path: Path, name: str) -> None:
    with server_at(tmp_path / "lab") as place:
        place.begin(NONE, wants_payloads=True)
        with pytest.raises(StoreError, match="has ended"):
            _append(place, CopiedFile(name, 4, DIGEST), 0, b"abcd")
    assert {path.name for path in tmp_path.iterdir()} == {"lab"}
    assert [*places.root(tmp_path / "lab").glob("*/*")] == [
        places.root(tmp_path / "lab") / f".importing-{NONE}" / "writer.lock"
    ]


def test_fields_come_first_and_payloads_later(
    robots: Path, tmp_path: Path, place_at: PlaceAt
) -> None:
    lab = tmp_path / "lab"
    before = sorted(path.name for path in robots.iterdir())
    with place_at(lab) as place:
        report = copied(robots, place, "recorded", "driven", "noted", only_fields=True)
        assert len(report.copied) == 3
        rest = copied(robots, place, only_fields=True)
        assert rest.copied == ["damaged", "calm", "expired"]
    assert sorted(path.name for path in robots.iterdir()) == before
    right = answers(robots, "noted")
    fields = answers(lab, "noted")
    assert fields == {key: value for key, value in right.items() if key in fields}
    assert len(fields) < len(right), "payloads are not there"
    with hl.open(lab, mongo="none") as store:
        assert not store.verify().findings
        store.edit("noted", tag={"place": "lab"})
        store.edit("noted", note="seen")
        store.mark("noted", "end", "there")
        store.edit("recorded", name="drive")
    # What was added there stays, and the robot's own later tags do not come.
    with place_at(lab) as place:
        report = copied(robots, place)
    assert sorted(report.copied) == ["calm", "damaged", "drive", "driven", "noted"]
    assert report.known == ["expired"]
    for there, here in (("driven", "driven"), ("drive", "recorded"), ("noted", "noted")):
        found, right = answers(lab, there), answers(robots, here)
        own = {"entry", "notes", "marks"} if there == "noted" else set()
        assert {k: v for k, v in found.items() if k not in own} == {
            k: v for k, v in right.items() if k not in own
        }
    with hl.open(lab, mongo="none") as store:
        entry = store.entry("noted")
        assert entry.tags == {"place": "lab"}
        assert [note["text"] for note in entry.notes] == ["it rained", "seen"]
        assert [mark["text"] for mark in entry.marks] == ["here", "there"]
        assert not store.verify().findings


def test_payloads_expire_here_when_they_are_proved_there(robots: Path, tmp_path: Path) -> None:
    robot, lab = tmp_path / "robot", tmp_path / "lab"
    shutil.copytree(robots, robot)
    right = {label: answers(robot, label) for label in STATES}
    with hl.open(robot, mongo="none") as store:
        store.copy(lab, ["calm"])
        _flip_a_bit(places.segment(lab, "calm"))
        report = store.copy(lab, None, CopyOptions(then_expire=True))
        assert len(report.problems) == 1
        assert "calm stay" in report.problems[0]
        assert report.freed_bytes > 0
        with pytest.raises(UsageError, match="cannot expire"):
            store.copy(lab, None, CopyOptions(then_expire=True, only_fields=True))
    for label in STATES:
        is_gone = label in {"recorded", "damaged", "driven"}  # a pin keeps the noted one
        found = answers(robot, label)
        assert (found != right[label]) == is_gone, label
        assert found == {key: value for key, value in right[label].items() if key in found}
        if label != "calm":
            assert answers(lab, label) == right[label]


def test_what_expired_before_keeps_no_other_payloads(robots: Path, tmp_path: Path) -> None:
    robot, lab = tmp_path / "robot", tmp_path / "lab"
    shutil.copytree(robots, robot)
    with hl.open(robot, mongo="none") as store:
        expire(store, "recorded", [1])
        store.copy(lab, ["recorded"])
        for frees in (True, False):
            report = store.copy(lab, ["recorded"], CopyOptions(then_expire=True))
            assert (report.known, report.problems) == (["recorded"], [])
            assert bool(report.freed_bytes) == frees


def test_only_what_has_a_copy_expires(robots: Path, tmp_path: Path, place_at: PlaceAt) -> None:
    robot, lab, told = tmp_path / "robot", tmp_path / "lab", dict[str, Any]()
    shutil.copytree(robots, robot)
    with hl.open(robot, mongo="none") as store:
        store.copy(lab, ["recorded", "noted"])
        store.mark("recorded", "end", "later")
        marked = store.entry("recorded")
        sealed = {
            label: {*store.directory.listing(store.entry(label).id).sealed} for label in STATES
        }
    # One of the copies was made by hand before the end of the recording.
    cut = tmp_path / "cut"
    shutil.copytree(lab, cut)
    found = places.read_in(places.folder(cut, "noted"))
    assert found is not None
    left = tuple(one for one in found.files if one.number != 1)
    places.write_in(places.folder(cut, "noted"), manifest.replace(found, files=left))
    places.segment(cut, "noted", 1).unlink()

    def run_to(path: Path, change: Any = None) -> CopyReport:
        class Changed(Disturbed):
            def hold(self, recordings: Sequence[str]) -> bool:
                if change is not None:
                    change()
                return bool(self.__getattr__("hold")(recordings))

        told.clear()
        with hl.open(robot, mongo="none") as store, place_at(path) as place:
            chosen = [one for one in store.summaries() if one.name in {"recorded", "noted"}]
            options = CopyOptions(then_expire=True)
            return run(store.directory, Changed(place), chosen, options, proved=told.__setitem__)

    assert not run_to(lab).problems
    assert {*told[marked.id]} == sealed["recorded"] - {marked.marks[0]["segment"]}
    report = run_to(cut)
    assert "lacks 1 segment" in report.refused["noted"]
    assert [*told] == [marked.id]
    # It is not deleted there at the same time.
    with StoreDirectory(lab).retaining():
        report = run_to(lab)
    assert "another process makes room" in report.problems[0]
    assert len(report.held) == 2
    assert not told
    report = run_to(lab, lambda: expire_in(lab, "recorded"))
    assert ["recorded stay" in one for one in report.problems] == [True]
    assert len(told) == 1


def expire_in(path: Path, label: str) -> None:
    with hl.open(path, mongo="none") as store:
        expire(store, label)


def test_marks_of_both_sides(robots: Path, tmp_path: Path, place_at: PlaceAt) -> None:
    """What the lab removed again goes; one that both have set keeps no other recording waiting."""
    robot, lab = tmp_path / "robot", tmp_path / "lab"
    shutil.copytree(robots, robot)
    names = ["recorded", "noted", "driven"]
    with place_at(lab) as place:
        assert len(copied(robot, place, *names, only_fields=True).copied) == 3
    with hl.open(lab, mongo="none") as store:
        for name in names[:2]:
            store.mark(name, "end", "there")
        store.unmark("recorded", "there")
    with hl.open(robot, mongo="none") as store:
        for name in names[:2]:
            store.mark(name, "end", "robot's")
    with place_at(lab) as place:
        report = copied(robot, place, *names)
    assert sorted(report.copied) == ["driven", "recorded"]
    assert "was marked here and in" in report.refused["noted"]
    assert answers(lab, "recorded") == answers(robot, "recorded")
    with hl.open(lab, mongo="none") as store:
        assert [mark["text"] for mark in store.entry("recorded").marks] == ["robot's"]
        assert not store.verify(["recorded"]).findings


def test_an_edit_at_the_moment_of_a_copy_stays(robots: Path, tmp_path: Path, calls: Calls) -> None:
    """It waits until the copy has taken its place, and changes that one."""
    lab = tmp_path / "lab"
    with directory_at(lab) as place:
        copied(robots, place, "recorded", only_fields=True)
    with hl.open(lab, mongo="none") as store, ThreadPoolExecutor(1) as pool:
        edits: list[Future[Any]] = []

        def meanwhile(*_: object) -> None:
            edits.append(pool.submit(store.edit, "recorded", tag={"who": "me"}))
            with pytest.raises(TimeoutError):
                edits[0].result(1)

        calls(StoreDirectory, "put_in_place", meanwhile)
        with directory_at(lab) as place:
            assert copied(robots, place, "recorded").copied == ["recorded"]
        assert edits[0].result().tags == {"who": "me"}
    with hl.open(lab, mongo="none") as store:
        assert store.entry("recorded").tags == {"who": "me"}
        assert not store.verify().findings
    found, right = answers(lab, "recorded"), answers(robots, "recorded")
    assert {**found, "entry": None} == {**right, "entry": None}


def test_what_was_said_of_a_copy_stays() -> None:
    def log(number: int, digit: str) -> manifest.File:
        name, part = f"{number:06d}.mcap", manifest.Part(1, 8)
        return manifest.File(number, number, name, "log", 9, digit * 64, 0, parts={number: part})

    mark = manifest.Mark("0" * 16, 5, "came along", segment=1)
    sent = manifest.Manifest(
        NONE,
        "sent",
        1,
        changes=7,
        status="complete",
        tags={"place": "field"},
        marks=(mark,),
        channels={0: manifest.Channel("/scan"), 1: manifest.Channel("/marks")},
        files=(log(0, "a"), log(1, "b")),
        unmarked=(2,),
    )
    there = manifest.replace(
        sent,
        name="there",
        tags={},
        notes=(manifest.Note(3, "seen"),),
        pins=(manifest.Pin("a", topics=("/scan",)),),
        marks=(mark, manifest.Mark("1" * 16, 6, "of there", segment=2)),
        channels={**sent.channels, 2: manifest.Channel("/marks")},
        files=(*sent.files, log(2, "c")),
        changes=20,
        unmarked=(),
        lacks_payloads=True,
    )
    made = merged(there, sent)
    assert made == manifest.replace(there, changes=21, lacks_payloads=False)
    assert merged(made, sent).files == made.files
    other = manifest.replace(
        sent,
        marks=(mark, manifest.Mark("2" * 16, 6, "of here", segment=2)),
        channels=there.channels,
        files=(*sent.files, log(2, "d")),
        unmarked=(),
    )
    with pytest.raises(RefusedError, match="marked here and in its copy"):
        merged(there, other)


def test_recordings_that_are_held_or_gone_keep_no_others_waiting(
    robots: Path, tmp_path: Path, place_at: PlaceAt
) -> None:
    robot, lab = tmp_path / "robot", tmp_path / "lab"
    shutil.copytree(robots, robot)
    with hl.open(robot, mongo="none") as store:
        held, gone = store.entry("noted").id, store.entry("driven").id

    class Busy(Disturbed):
        def begin(self, recording: str, **options: Any) -> Any:
            if recording == held:
                raise HeldError("another process copies it", is_recording=False)
            # Fields are ready: a server does not wait for them.
            assert any(path.name.startswith(".copying-") for path in robot.iterdir())
            begun = self.__getattr__("begin")(recording, **options)
            if recording == gone:
                shutil.rmtree(places.folder(robot, "driven"))
                raise StoreError("a file is gone")
            return begun

    with place_at(lab) as place:
        report = copied(robot, Busy(place), "noted", "driven", "recorded", only_fields=True)
    assert report.copied == ["recorded"]
    assert report.held == [held]
    assert report.refused == {
        "noted": "Recording 'noted' is not copied: another process copies it",
        "driven": "Recording 'driven' is no longer in the store.",
    }
    assert places.names(lab) == ["recorded"]


def test_a_full_disk_there_keeps_what_arrived(
    robots: Path, tmp_path: Path, place_at: PlaceAt, monkeypatch: pytest.MonkeyPatch, calls: Calls
) -> None:
    class Full(files.System):
        left = 20_000

        def writev(self, fd: int, parts: Sequence[memoryview]) -> int:
            if len(parts[0]) == 1000:  # a piece of a file
                self.left -= 1000
            if self.left < 0:
                raise OSError(errno.ENOSPC, "full")
            return super().writev(fd, parts)

    calls.system(Full())
    with place_at(tmp_path / "lab") as place, pytest.raises(DiskFullError):
        copied(robots, place, "recorded", piece=1000)
    monkeypatch.undo()
    arrived, size = (
        sum(path.stat().st_size for path in store.glob("*.mcap"))
        for store in (*places.folders(tmp_path / "lab"), places.folder(robots, "recorded"))
    )
    with place_at(tmp_path / "lab") as place:
        report = copied(robots, place, "recorded")
    assert arrived >= 20_000
    assert report.bytes_copied == size - arrived
    assert answers(tmp_path / "lab", "recorded") == answers(robots, "recorded")


def test_two_copies_at_once_end_with_one(robots: Path, tmp_path: Path, place_at: PlaceAt) -> None:
    """And who reads there meanwhile sees it."""
    lab = tmp_path / "lab"
    with hl.open(lab, mongo="none", create=True) as reader:
        barrier = threading.Barrier(2)

        def copy(_: int) -> CopyReport:
            with place_at(lab) as place:
                barrier.wait()
                return copied(robots, place, "driven", piece=1000)

        with ThreadPoolExecutor(2) as pool:
            found = [*pool.map(copy, range(2))]
        assert sorted([*one.copied, *one.known] for one in found) == [["driven"]] * 2
        assert [one.name for one in reader.summaries()] == ["driven"]
        assert reader.topic("/number").count() > 20
    assert answers(lab, "driven") == answers(robots, "driven")


def test_the_rate_is_limited(robots: Path, tmp_path: Path) -> None:
    sizes = []

    class Counted(Disturbed):
        def append(self, file: CopiedFile, at: int, data: bytes) -> None:
            sizes.append(len(data))
            self._place.append(file, at, data)

    with directory_at(tmp_path / "lab") as place:
        copied(robots, Counted(place), "recorded", limit_rate=100_000)
    assert max(sizes) <= 25_000


def test_a_side_that_reads_for_long_is_not_silent(
    robots: Path, tmp_path: Path, limit: Limit, calls: Calls
) -> None:
    lab = tmp_path / "lab"
    with suppress(StoreError), server_at(lab, 9_000) as place:
        copied(robots, place, "recorded", piece=1000)
    limit(copy_beat_s=0.05, copy_idle_s=0.5)
    slow = calls(copying, "digest_like", lambda *_: time.sleep(1))
    with server_at(lab) as place:
        assert copied(robots, place, "recorded").copied == ["recorded"]
    assert slow


@pytest.mark.parametrize("said", [_frame({"do": "hold", "recordings": []}), b"\0\0\0\7"])
def test_a_silent_side_holds_nothing(tmp_path: Path, limit: Limit, said: bytes) -> None:
    """Also one that goes amid a request."""
    limit(copy_idle_s=0.1)
    to_read, to_write = os.pipe()
    os.write(to_write, said)
    with (
        directory_at(tmp_path / "lab") as place,
        os.fdopen(to_read, "rb", 0) as requests,
        pytest.raises(StoreError, match="is silent"),
    ):
        ssh.serve(place, requests, io.BytesIO())  # type: ignore[arg-type]
    os.close(to_write)
    with StoreDirectory(tmp_path / "lab").retaining() as is_free:
        assert is_free


def test_names_that_others_change_are_seen(robots: Path, tmp_path: Path) -> None:
    lab = tmp_path / "lab"
    with directory_at(lab) as place:
        copied(robots, place, "recorded", "noted")
        with hl.open(lab, mongo="none") as store:
            ids = {name: store.entry(name).id for name in ("recorded", "noted")}
            store.edit("recorded", name="other")
            store.edit("noted", name="recorded")
        found = place.have([*ids.values()])
    assert {name: found[one].name for name, one in ids.items()} == {
        "recorded": "other",
        "noted": "recorded",
    }


def test_a_name_that_another_recording_has_there_gets_a_number(
    robots: Path, tmp_path: Path, place_at: PlaceAt
) -> None:
    robot, lab = tmp_path / "robot", tmp_path / "lab"
    shutil.copytree(robots, robot)
    with place_at(lab) as place:
        assert copied(robot, place, "calm", "noted").copied == ["calm", "noted"]
    with hl.open(robot, mongo="none") as store:
        store.edit("recorded", name="driven by hand")
        store.edit("calm", name="hall")
        store.edit("driven", name="calm")
    with place_at(lab) as place:
        report = copied(robot, place, "driven by hand", "calm", "hall")
        assert (report.copied, report.known) == (["driven by hand", "calm-2"], ["calm"])
    assert names_in(lab) == ["calm", "calm-2", "driven by hand", "noted"]


def test_a_cure_deletes_nothing_that_is_not_here(robots: Path, tmp_path: Path) -> None:
    robot, lab = tmp_path / "robot", tmp_path / "lab"
    shutil.copytree(robots, robot)
    with hl.open(robot, mongo="none") as store:
        store.copy(lab, ["recorded"])
        _flip_a_bit(places.segment(lab, "recorded", 1))
        (said,) = store.copy(lab, ["recorded"], CopyOptions(check=True)).problems
        assert "`hybridlog rm recorded`" in said
        expire(store, "recorded", [0])
        (said,) = store.copy(lab, ["recorded"], CopyOptions(check=True)).problems
        assert "`hybridlog rm" not in said
        assert "from another copy" in said


@pytest.mark.parametrize("step", [0, 1])
def test_a_crash_before_the_copy_of_fields_goes(
    step: int, robots: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next opening puts the whole copy in its place, with what was said of the other one."""
    lab = tmp_path / "lab"
    with directory_at(lab) as place:
        copied(robots, place, "recorded", only_fields=True)
    with hl.open(lab, mongo="none") as store:
        store.edit("recorded", name="renamed", tag={"who": "me"})
    rename, left = files.rename, [step]

    def interrupted(old: Path, new: Path) -> None:
        if old.parent == places.root(lab):
            left[0] -= 1
            if left[0] < 0:
                raise KeyboardInterrupt
        rename(old, new)

    with monkeypatch.context() as patch:
        patch.setattr(files, "rename", interrupted)
        with suppress(KeyboardInterrupt), directory_at(lab) as place:
            copied(robots, place, "recorded")
    with hl.open(lab, mongo="none") as store:
        assert store.entry("renamed").tags["who"] == "me"
    assert places.names(lab) == ["renamed"]
    with directory_at(lab) as place:
        assert copied(robots, place, "recorded").known == ["renamed"]
    with hl.open(lab, mongo="none") as store:
        assert store.entry("renamed").status == "complete"
        assert [store.topic(one).count() for one in store.topics()]


def test_what_a_stopped_copy_left_goes_when_the_store_is_opened(
    robots: Path, tmp_path: Path
) -> None:
    robot = tmp_path / "robot"
    shutil.copytree(robots, robot)
    (robot / ".copying-0" / "store").mkdir(parents=True)
    (robot / ".copying-0" / "store" / "000000.mcap").write_bytes(b"second name")
    with copying.at_work(StoreDirectory(robot)) as folder:
        (robot / ".copying-1").mkdir()
        with hl.open(robot, mongo="none"):
            assert [*robot.glob(".copying-*")] == [folder]
    assert [*robot.glob(".copying-*")] == []
