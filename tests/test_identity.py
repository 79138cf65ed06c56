"""A recording is its id: renamed, copied, moved and imported ones, and stores that were copied."""

from __future__ import annotations

import re
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog.maintenance.verify import become_another
from hybridlog_storage.errors import (
    StoreError,
    TimeError,
    TopicError,
)
from hybridlog_storage.manifest import replace
from hybridlog_storage.messages import Channel
from hybridlog_storage.mongo.database import Database
from hybridlog_storage.mongo.index_documents import IndexState
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests import places
from tests.independent import write_mcap
from tests.running.running import NO_MONGODB as NOWHERE
from tests.waiting import wait_for

COUNT = 60
SECOND = 10**9


def payload(n: int) -> bytes:
    return b'{"n": %d, "pad": "%s"}' % (n, b"x" * 300)


def make_log(path: Path, first: int = 0) -> Path:
    channel = Channel("/n", "json", None)
    said = [(channel, n * SECOND, payload(n)) for n in range(first, first + COUNT)]
    return write_mcap(path, said)


@pytest.fixture
def place(tmp_path: Path, mongo: str) -> Path:
    """A store with one recording of several segments."""
    log = make_log(tmp_path / "log.mcap", 100)
    with hl.open(tmp_path / "store", mongo=mongo, create=True) as store:
        settings = SegmentSettings(chunk_size=1024, segment_size=3000, compression="none")
        entry = store.record(log, name="one", tags={"a": "1"}, settings=settings).entry
        assert entry.segments > 2
    return tmp_path / "store"


def answers(store: hl.Store, recording: str | None = None) -> tuple[int, int, list[bytes]]:
    query = store.topic("/n")
    if recording is not None:
        query = query.in_recording(recording)
    return query.count(), query.where("n >= 130").count(), [bytes(m.raw) for m in query]


def right() -> tuple[int, int, list[bytes]]:
    return COUNT, 30, [payload(n) for n in range(100, 100 + COUNT)]


def test_a_folder_with_another_name_is_told_and_left_alone(place: Path) -> None:
    folder = places.folder(place, "one")
    folder.rename(folder.with_name("other"))
    with hl.open(place, mongo=NOWHERE) as store:
        assert [one.status for one in store.recordings()] == ["damaged"]
        assert "give it its name again" in store.shared.repairs.unreadable["other"]
        assert {one.recording for one in store.verify().findings} == {"one", "other"}
    folder.with_name("other").rename(folder)
    with hl.open(place, mongo=NOWHERE) as store:
        assert answers(store) == answers(store, "one") == right()
        assert not store.verify().findings


def test_a_copy_inside_a_store_is_told_and_left_alone(place: Path, mongo: str) -> None:
    copy = "a-copy"  # comes first
    path = places.new_folder(place, copy)
    shutil.copytree(places.folder(place, "one"), path)
    for _ in range(2):
        with hl.open(place, mongo=mongo) as store:
            assert [r.name for r in store.recordings()] == ["one"]
            assert "if it is a copy" in store.shared.repairs.unreadable[copy]
            assert answers(store) == right()
            assert [one.recording for one in store.verify().findings] == [copy]
            store.index.rebuild()
            assert answers(store) == right()
            done = store.verify(repair=True)
            assert not done.repaired
            assert {one.recording for one in done.findings} == {copy}
            with pytest.raises(TopicError):
                store.remove(copy)
    shutil.rmtree(path)
    with hl.open(place, mongo=mongo) as store:
        assert not store.shared.repairs.unreadable
        assert answers(store) == right()
        assert not store.verify().findings


def test_a_recording_that_was_copied_from_another_store_answers(
    place: Path, mongo: str, tmp_path: Path
) -> None:
    with hl.open(tmp_path / "mine", create=True):
        pass
    theirs = places.folder(place, "one")
    mine = places.new_folder(tmp_path / "mine", theirs.name)
    shutil.copytree(theirs, mine)
    shutil.copy(places.manifest_of(theirs), places.manifest_of(mine))
    with hl.open(tmp_path / "mine") as store:
        (entry,) = store.recordings()
        assert (entry.name, entry.status, entry.tags) == ("one", "complete", {"a": "1"})
        assert answers(store) == right()
        assert not store.verify().findings
    # The other one is untouched.
    with hl.open(place, mongo=mongo) as store:
        assert answers(store) == right()


def documents(mongo: str) -> dict[str, int]:
    with Database.connect(mongo) as database:
        return {c: database.count(c, {}) for c in database.list_collections()}


@pytest.mark.mongo("embedded")
def test_a_copied_store_with_a_uri_removes_nothing(place: Path, mongo: str, tmp_path: Path) -> None:
    copy, one = tmp_path / "copy", places.folder(place, "one")
    shutil.copytree(place, copy)
    before = documents(mongo)
    shutil.rmtree(places.folder(copy, "one"))
    places.manifest_of(places.root(copy) / one.name).unlink()
    for _ in range(2):
        with hl.open(copy, mongo=mongo, require_database=True) as store:
            assert not store.shared.repairs.removed
    assert documents(mongo) == before
    with hl.open(place, mongo=mongo) as store:
        assert answers(store) == right()
    # With an id and a database of its own it is a store like any other.
    shutil.copytree(one, places.new_folder(copy, one.name))
    shutil.copy(places.manifest_of(one), copy / "manifests")
    become_another(copy, "embedded")
    with hl.open(copy) as store:
        assert answers(store) == right()
        store.remove("one")
    assert documents(mongo) == before


def test_a_moved_store_takes_its_index_along(place: Path, mongo: str, tmp_path: Path) -> None:
    moved = place.rename(tmp_path / "moved")
    with hl.open(moved, mongo=mongo) as store:
        assert answers(store) == right()
        store.shared.index.connect()
        assert not store.shared.repairs.indexed
        store.index.rebuild()
        with Database.connect(mongo) as database:
            owner = IndexState(database).owner()
            assert owner is not None
            assert owner.place.endswith(f":{moved.resolve()}")


def test_a_running_recording_is_marked_while_it_runs(tmp_path: Path) -> None:
    channel = Channel("/n", "json", None)
    with hl.open(tmp_path / "store", create=True) as store:
        with store.start("live") as recording:
            recording.write(channel, b"{}", log_time=SECOND)
            wait_for(lambda: "/n" in store.topics() and store.entry("live").messages == 1)
            with hl.open(tmp_path / "store") as other:
                other.mark("live", "+0s", "begun", {"by": "lab"}, until="3")
                other.mark(recording.id, SECOND, "wrong")
                other.unmark("live", "wrong")
                with pytest.raises(TimeError, match="begins at"):
                    other.mark("live", SECOND - 1, "before")
                with pytest.raises(TimeError, match="ends at"):
                    other.mark("live", "2199-01-01", "in the future")
            marks = store.topic("/hybridlog/marks")
            assert [(m.log_time_ns, m.fields["text"]) for m in marks] == [(SECOND, "begun")]
            # It is on the disk: a recorder that is killed now costs nothing of it.
            shutil.copytree(tmp_path / "store", tmp_path / "killed")
            with pytest.raises(StoreError, match="being written"):
                store.remove(recording.id)
            recording.write(channel, b"{}", log_time=2 * SECOND)
        entry = store.entry("live")
        assert (entry.status, entry.messages, entry.span) == ("complete", 3, (SECOND, 2 * SECOND))
        assert [m.fields["text"] for m in store.topic("/hybridlog/marks")] == ["begun"]
        assert not store.verify().findings
    with hl.open(tmp_path / "killed", mongo="none") as store:
        assert store.entry("live").status == "unfinished"
        assert [m.fields["text"] for m in store.topic("/hybridlog/marks")] == ["begun"]


def test_a_removal_that_was_announced_is_finished(place: Path, mongo: str) -> None:
    places.change_in(places.folder(place, "one"), lambda now: replace(now, status="removed"))
    with hl.open(place, mongo=mongo) as store:
        store.shared.index.connect()
        assert "one" in store.shared.repairs.removed
        assert not store.recordings()
        assert places.folders(place) == []
        database = store.shared.index.database_for("This")
        assert database.count("n", {}) == 0
        assert IndexState(database).of() == {}


def test_names_are_unique_when_recordings_begin_and_are_renamed(tmp_path: Path) -> None:
    log = make_log(tmp_path / "a.mcap", 500)
    path = tmp_path / "store"
    hl.open(path, create=True, mongo=NOWHERE).close()

    def record(_: int) -> str:
        with hl.open(path, mongo=NOWHERE) as store:
            return store.record(log, name="my run/1", again=True).entry.name

    with ThreadPoolExecutor(4) as pool:
        names = sorted(pool.map(record, range(4)))
    assert names == ["my run-1", "my run-1-2", "my run-1-3", "my run-1-4"]
    with hl.open(path, mongo=NOWHERE) as store:
        before = places.folders(path)
        ids = {one.name: one.id for one in store.session.look().summaries}
        assert ids.keys() == {*names}
        assert all(re.fullmatch(r"[0-9]{8}-my-run-1-[0-9a-f]{16}", one) for one in ids.values())
        assert store.edit(ids["my run-1-3"], name="my run/1").name == "my run-1-3"
        assert store.edit(ids["my run-1-3"], name="other").name == "other"
        assert store.edit(ids["my run-1-4"], name="other").name == "other-2"
        assert store.edit(ids["my run-1"], name="my run/1").name == "my run-1"
        assert store.record(log, name="my run/1", again=True).entry.name == "my run-1-3"
        assert {*before} < {*places.folders(path)}  # nothing moves


def test_an_id_comes_before_a_name(place: Path, mongo: str, tmp_path: Path) -> None:
    with hl.open(place, mongo=mongo) as store:
        one = store.entry("one").id
        other = store.record(make_log(tmp_path / "b.mcap", 500), name=one).entry
        assert (other.name, store.entry(one).name) == (one, "one")
        store.remove(one)
        assert [entry.id for entry in store.recordings()] == [other.id]
