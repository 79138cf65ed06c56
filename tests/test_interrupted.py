"""Commands that are cut off at any call: what they began is finished, or as if it never was."""

from __future__ import annotations

import errno
import os
import random
import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from typing import Any

import pytest

import hybridlog as hl
from hybridlog_storage.disk import files
from hybridlog_storage.disk.directory import StoreDirectory
from hybridlog_storage.disk.files import System
from hybridlog_storage.errors import (
    DatabaseError,
    HybridlogError,
    TopicError,
)
from hybridlog_storage.manifest import replace
from hybridlog_storage.mongo.database import Database
from hybridlog_storage.mongo.index_documents import IndexState
from tests import logs, places
from tests.calls import Calls
from tests.copies import bring
from tests.damage import flip
from tests.indexed import misindexed
from tests.power import PowerCut
from tests.some import in_turn

CONTENT = {"a": logs.content(0, 40), "b": logs.content(15, 12), "c": logs.content(100, 24)}
WHERE = 20
State = Mapping[str, tuple[object, ...]]
"""What each recording is, by its name."""


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a store of the recordings `a`, of several segments, and `b`, and a log `c`."""
    path = tmp_path_factory.mktemp("interrupted")
    for name in ("a", "b"):
        log = logs.write(path / f"{name}.mcap", CONTENT[name])
        logs.record(path / "store", "none", log, name)
    logs.write(path / "c.mcap", CONTENT["c"])
    logs.record(path / "other", "none", path / "c.mcap", "c")
    return path


def forget_segment(store: Path) -> None:
    def how(now: Any) -> Any:
        return replace(now, files=tuple(one for one in now.files if one.number != 1))

    places.change_in(places.folder(store, "a"), how)


def die(store: Path) -> None:
    """As if the recorder of `a` had been killed while it wrote its last segment."""
    *_, (number, path) = places.segments(store, places.id_of(store, "a"))
    places.change_in(
        path.parent,
        lambda now: replace(
            now, status="open", files=tuple(one for one in now.files if one.number != number)
        ),
    )
    left = path.rename(path.with_name(f"{path.name}.open"))
    os.truncate(left, left.stat().st_size - 300)


def damage(store: Path) -> None:
    flip(places.segment(store, "a", 2), -60)
    places.manifest_of(places.folder(store, "b")).write_bytes(b"damaged")


def announce(store: Path) -> None:
    places.change_in(places.folder(store, "a"), lambda now: replace(now, status="removed"))


def nothing(_: Path) -> None: ...


Work = Callable[[hl.Store, Path], object]
COMMANDS: dict[str, tuple[Callable[[Path], None], Work]] = {
    "rm": (nothing, lambda store, _: store.remove("a")),
    "rename": (nothing, lambda store, _: store.edit("a", name="new")),
    "tag": (nothing, lambda store, _: store.edit("a", tag={"x": "y"})),
    "mark": (nothing, lambda store, _: store.mark("a", "+0.1s", "here")),
    "pin": (nothing, lambda store, _: store.pin("a")),
    "copy": (nothing, lambda store, base: bring(store, base / "other")),
    "record": (
        nothing,
        lambda store, base: store.record(base / "c.mcap", name="c", settings=logs.SETTINGS),
    ),
    "repair": (damage, lambda store, _: store.verify(repair=True)),
    "recover": (die, lambda store, _: store.shared.recover()),
    "adopt": (forget_segment, lambda store, _: store.shared.recover()),
    "finish a removal": (announce, lambda store, _: store.shared.recover()),
}


class FullDisk(PowerCut):
    """One call finds no room; all others are carried out."""

    def _step(self) -> None:
        self.calls += 1
        if self.calls - 1 == self._left:
            raise OSError(errno.ENOSPC, "full")


def look(path: Path) -> State:
    """What a store holds once it is repaired; its repair leaves nothing."""
    with closing(hl.open(path, mongo="none")) as store:
        findings = store.verify(repair=True).findings
        assert all("nothing else can prove it" in one.cure for one in findings), findings
        assert not store.verify(repair=True).repaired
        return {
            one.name: (
                one.tags,
                [mark.text for mark in one.manifest.marks],
                len(one.manifest.pins),
                said(store, one.id) if one.messages else {},
            )
            for one in store.recordings()
        }


def said(store: hl.Store, recording: str) -> dict[str, list[tuple[int, bytes]]]:
    found: dict[str, list[tuple[int, bytes]]] = {}
    query = store.recordings(recording).all_topics()
    for message in query:
        found.setdefault(message.topic, []).append((message.log_time_ns, bytes(message.raw)))
    assert query.count() == sum(map(len, found.values()))
    for topic, messages in found.items():
        if topic in logs.CHANNELS:
            own = store.recordings(recording).topic(topic).where(f"n >= {WHERE}")
            assert own.count() == len(list(own)) <= len(messages)
    return found


def is_part(found: State, before: State) -> bool:
    """True if `c` has the beginning of each topic, and all else is as it was."""
    (*_, messages) = found.get("c", ({},))
    assert isinstance(messages, dict)
    wanted = {t: [(o.time, o.payload) for o in part] for t, part in CONTENT["c"].items()}
    others = {name: one for name, one in found.items() if name != "c"}
    return others == before and all(wanted[t][: len(m)] == m for t, m in messages.items())


def interrupted(
    store: Path, system: PowerCut, work: Callable[[hl.Store], object], patch: pytest.MonkeyPatch
) -> None:
    with patch.context() as inside, suppress(HybridlogError, OSError):
        inside.setattr(files, "system", system)
        with closing(hl.open(store, mongo="none")) as opened:
            work(opened)


@pytest.mark.parametrize(("command", "system"), in_turn([*COMMANDS], [PowerCut, FullDisk]))
@pytest.mark.parametrize("most", [4, pytest.param(10**6, marks=pytest.mark.exhaustive)])
def test_what_is_interrupted_is_finished_or_taken_back(
    base: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    command: str,
    system: type[PowerCut],
    most: int,
) -> None:
    prepare, do = COMMANDS[command]
    work = partial(_with, do, base)

    def copy(name: str) -> Path:
        return Path(shutil.copytree(base / "store", tmp_path / name))

    def prepared(name: str) -> Path:
        path = copy(name)
        prepare(path)
        return path

    before = look(prepared("before"))
    whole = prepared("whole")
    power = PowerCut(whole)
    interrupted(whole, power, work, monkeypatch)
    after = look(whole)
    assert power.calls > 3
    for at in range(0, power.calls, max(power.calls // most, 1)):
        place, found = prepared(f"{at}"), tmp_path / f"{at} after"
        cut = system(place, at)
        interrupted(place, cut, work, monkeypatch)
        if system is PowerCut:
            cut.after_cut(found, random.Random(f"{command}{at}"))
        state = look(found if found.exists() else place)
        assert state in (before, after) or (command == "record" and is_part(state, before)), at


def _with(do: Work, base: Path, store: hl.Store) -> object:
    return do(store, base)


class NoRoom(System):
    """No byte more can be written; names can be changed, and files removed."""

    def writev(self, fd: int, parts: Sequence[memoryview], position: int = 0) -> int:
        raise OSError(errno.ENOSPC, "full")

    pwritev = writev


def test_a_full_disk_is_read_and_recordings_can_be_removed(
    base: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = Path(shutil.copytree(base / "store", tmp_path / "store"))
    die(path)
    with monkeypatch.context() as inside, closing(hl.open(path, mongo="none")) as store:
        inside.setattr(files, "system", NoRoom())
        assert {one.name: one.status for one in store.recordings()} == {
            "a": "unfinished",
            "b": "complete",
        }
        messages = store.entry("a").messages
        assert len([*store.all_topics()]) == messages + store.entry("b").messages
        store.remove("b")
        assert places.names(path) == ["a"]
    with closing(hl.open(path, mongo="none")) as store:
        entry = store.edit("a", tag={"a": "b"})
        assert (entry.status, entry.messages) == ("recovered", messages)


# The index.


@pytest.fixture
def store(base: Path, tmp_path: Path, mongo: str) -> hl.Store:
    return hl.open(shutil.copytree(base / "store", tmp_path / "store"), mongo=mongo)


@pytest.mark.parametrize(
    ("method", "chosen"), in_turn(["insert_raw", "update", "delete"], [None, ["a"]])
)
def test_an_index_whose_making_was_interrupted_is_completed(
    store: hl.Store, monkeypatch: pytest.MonkeyPatch, method: str, chosen: Sequence[str] | None
) -> None:
    with store:
        store.shared.index.connect()
        real, left = getattr(Database, method), [1]

        def failing(*words: Any, **options: Any) -> object:
            left[0] -= 1
            if left[0] < 0:
                raise DatabaseError("MongoDB refuses it.")
            return real(*words, **options)

        with monkeypatch.context() as patch, suppress(DatabaseError):
            patch.setattr(Database, method, failing)
            store.index.rebuild(chosen)
        assert left[0] < 0
    with hl.open(store.directory.path, mongo=store.shared.index.wanted) as again:
        again.shared.index.connect()
        assert misindexed(again) == {}


# What another process does between two looks at the store.


def test_a_recording_that_is_removed_is_no_unreadable_one(store: hl.Store, calls: Calls) -> None:
    path, done = store.directory.path, list[object]()

    def looked(found: object, *_: object) -> object:
        if not done:
            done.append(StoreDirectory(path).manifests.remove(places.id_of(path, "a")))
        return found

    calls.change(StoreDirectory, "looks", looked)
    store.refresh()
    with store:
        assert {entry.name for entry in store.recordings()} == {"b"}
        assert not store.shared.repairs.unreadable


def test_what_the_index_lacks_while_documents_go(store: hl.Store) -> None:
    with store:
        database = store.shared.index.connect()
        query = store.topic("/number").where("n >= 0")
        whole, entry = query.count(), store.entry("a")
        with store.directory.writing(entry.id):  # as the other process does
            IndexState(database).begin(entry)
            database.delete("number", {"_meta.rec": entry.key})
            own = store.topic("/number").where({"n": {"$gte": 0}})
            lacks = store.query(["/number"], ["a"]).count()
            assert (own.count(), own.counters.unindexed) == (whole - lacks, lacks)
            # The messages themselves tell.
            assert query.count() == len(list(query)) == whole
            assert query.counters.documents_read == 0
        store.index.rebuild(["a"])
        assert (own.count(), own.counters.unindexed) == (whole, 0)


def test_what_goes_while_it_is_counted_is_noticed(store: hl.Store, calls: Calls) -> None:
    with store, hl.open(store.directory.path, mongo=store.shared.index.wanted) as other:
        store.shared.index.connect()
        other.shared.index.connect()
        query = store.query(["/number"], ["a"]).where({"n": {"$gte": 0}})
        whole = query.count()
        asked: list[tuple[object, ...]] = calls(
            Database, "each", lambda *_: other.remove("a") if len(asked) == 1 else None
        )
        assert query.count() + query.counters.unindexed == whole
        assert query.counters.unindexed > 0
        with pytest.raises(TopicError, match="removed from the store"):
            query.count()
        with pytest.raises(TopicError):
            store.query(["/number"], ["a"])
