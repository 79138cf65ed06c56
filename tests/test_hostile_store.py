"""Stores that came from somebody else, with symlinks in them: nothing outside is touched.

Each kind of file and each folder of a store is replaced by a symlink, to something that is
there and to something that is not. Whatever the commands then say, what lies outside is not
read, written, removed or made.
"""

from __future__ import annotations

import os
import re
import shutil
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

import hybridlog as hl
from benchmarks.simulator.write import write_bag
from hybridlog_storage.errors import HybridlogError, StoreError
from hybridlog_storage.mongo.mongod import EmbeddedMongod
from tests import places
from tests.some import in_turn
from tests.waiting import wait_for

OLD = 1_000_000_000  # a time of reading that any reading changes

FILES = {
    "hybridlog.toml": "hybridlog.toml",
    "catalog": "catalog.sqlite",
    "journal of the catalog": "catalog.sqlite-journal",
    "log of the catalog": "catalog.sqlite-wal",
    "manifest": "manifests/{id}.json",
    "lock of all manifests": "manifests/.lock",
    "manifest before": "{small}/manifest.old",
    "lock of the manifest": "{small}/manifest.lock",
    "lock": "{small}/writer.lock",
    "segment": "{small}/000000.mcap",
    "next segment": "{small}/000001.mcap",
    "open segment": "{small}/000001.mcap.open",
    "sign of a recorder": "recorders/live.json",
    "sign of another recorder": "recorders/other.json",
}
FOLDERS = {
    "recordings": "{root}",
    "recording": "{small}",
    "manifests": "manifests",
    "recorders": "recorders",
    "tables": "tables",
    "unfinished tables": "tables.part",
}
TABLES = ("tables/*", "tables/*/*", "tables.part/new")
MONGOD_FILES = (
    "users.lock",
    "keeper.lock",
    "mongod.log",
    "data/mongod.lock",
    "data/WiredTiger",
    "data/WiredTiger.wt",
    "data/storage.bson",
    "data/journal/WiredTigerLog.0000000001",
    "data/deep/down/x",
)
MONGOD_FOLDERS = ("", "data", "data/journal", "data/diagnostic.data")

# Other kinds of files, which mongod alone makes.
OF_MONGOD = re.compile(r"mongod(-\d+)?(/.*)?")
OF_TABLES = re.compile(r"tables/.*")


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("logs") / "small.bag"
    write_bag(path, duration_s=5, seed=2, topics=["/imu/data", "/joint_states"])
    return path


@pytest.fixture(scope="module")
def template(bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("template") / "store"
    with hl.open(path, create=True, mongo="none") as store:
        store.record(bag, name="small")
    text = (path / "hybridlog.toml").read_text()
    (path / "hybridlog.toml").write_text(re.sub("(?m)^mongo = .*\n", "", text))
    return path


class Victims:
    """What lies outside of a store, and must stay as it is."""

    def __init__(self, place: Path) -> None:
        self.place = place
        place.mkdir()

    def file(self, content: bytes = b"precious") -> Path:
        path = self.place / "file"
        path.write_bytes(content)
        return path

    def folder(self, like: Path | None) -> Path:
        """A folder that looks as the store's own did."""
        path = self.place / "folder"
        if like is not None and like.is_dir():
            shutil.copytree(like, path)
        else:
            path.mkdir()
            (path / "file").write_bytes(b"precious")
        return path

    def watch(self) -> None:
        """From now on nobody may touch them."""
        for path in [self.place, *self.place.rglob("*")]:
            os.utime(path, ns=(OLD, OLD))
        self.before = self.state()

    def state(self) -> dict[str, tuple[object, ...]]:
        found: dict[str, tuple[object, ...]] = {}
        for path in [self.place, *sorted(self.place.rglob("*"))]:
            about = path.lstat()
            # The times of folders change by this look itself.
            read = about.st_atime_ns if path.is_file() else None
            found[str(path.relative_to(self.place))] = (
                about.st_mode, about.st_size, about.st_mtime_ns, about.st_ino, read
            )  # fmt: skip
        return found

    def check(self) -> None:
        assert self.state() == self.before


def test_reading_is_noticed(tmp_path: Path) -> None:
    victims = Victims(tmp_path / "victims")
    path = victims.file()
    victims.watch()
    victims.check()
    path.read_bytes()
    if path.stat().st_atime_ns == OLD:
        pytest.skip("this file system does not say when a file was read")
    with pytest.raises(AssertionError):
        victims.check()


def use(path: Path, bag: Path) -> None:
    """Do with a store whatever the commands do; some of it is refused."""

    def attempt(create: bool, *steps: Callable[[hl.Store], object]) -> None:
        with suppress(HybridlogError), hl.open(path, mongo="none", create=create) as store:
            for step in steps:
                with suppress(HybridlogError):
                    step(store)

    def look(store: hl.Store) -> None:
        assert {r.name for r in store.recordings()} <= {"small", "live", "again"}

    def fetch(store: hl.Store) -> None:
        list(store.all_topics())
        store.all_topics().count()

    def ask(store: hl.Store) -> None:
        store.topic("/imu/data").where("linear_acceleration.x > -1000").count()
        store.topic("/imu/data").fields("header.seq").to_pandas()

    def record_live(store: hl.Store) -> None:
        from hybridlog.live.recorder import Recorder, RecorderOptions
        from hybridlog.live.state import running

        running(store.directory)
        options = RecorderOptions(reserve_bytes=0)
        recorder = Recorder(store, [], options, lambda _: None)
        recorder.start()
        recorder.look()
        recorder.stop()
        store.start("live").close()

    def record(store: hl.Store) -> None:
        store.record(bag, name="again", again=True)

    attempt(False, look, fetch, ask, lambda store: store.verify())
    attempt(True, record_live, record, look, fetch)
    attempt(False, lambda store: store.remove("small"))
    attempt(False, look)


def name_of(store: Path, kind: str) -> str:
    """The path of a kind of file in a store."""
    if kind in TABLES:
        return str(next(iter(store.glob(kind)), store / kind).relative_to(store))
    found = {
        "root": places.root(store),
        "small": places.folder(store, "small"),
    }
    inside: dict[str, object] = {key: path.relative_to(store) for key, path in found.items()}
    inside["id"] = found["small"].name
    return {**FILES, **FOLDERS}[kind].format(**inside)


def planted(template: Path, tmp_path: Path, name: str, target: Path) -> Path:
    """A copy of a store with a symlink at a place."""
    store = tmp_path / "store"
    shutil.copytree(template, store, symlinks=True)
    place = store / name
    if place.is_dir():
        shutil.rmtree(place)
    place.unlink(missing_ok=True)
    place.parent.mkdir(parents=True, exist_ok=True)
    place.symlink_to(target)
    return store


KINDS = [*FILES, *FOLDERS, *TABLES]


@pytest.mark.parametrize(("kind", "leads"), in_turn(KINDS, ["out", "to nothing"]))
def test_a_place_that_leads_elsewhere(
    template: Path, tmp_path: Path, bag: Path, kind: str, leads: str
) -> None:
    victims = Victims(tmp_path / "victims")
    name = name_of(template, kind)
    original = template / name
    if leads == "to nothing":
        target = victims.place / "new"
    elif kind in FILES or original.is_file():
        target = victims.file(original.read_bytes() if original.is_file() else b"precious")
    else:
        target = victims.folder(
            places.folder(template, "small") if "recording" in kind[1:] else original
        )
    store = planted(template, tmp_path, name, target)
    victims.watch()
    use(store, bag)
    victims.check()


# --- the embedded MongoDB ---


def hostile_mongod(tmp_path: Path, name: str, target: Path) -> Path:
    (tmp_path / "hybridlog.toml").touch()
    directory = tmp_path / "mongod"
    place = directory / name if name else directory
    place.parent.mkdir(parents=True, exist_ok=True)
    place.symlink_to(target)
    return directory


def refuse(directory: Path) -> str:
    with pytest.raises(StoreError, match=f"Remove {directory}") as caught:
        EmbeddedMongod(directory, linger_s=0.2).start()
    return str(caught.value)


@pytest.mark.parametrize(
    ("name", "exists"), in_turn([*MONGOD_FILES, *MONGOD_FOLDERS], [True, False])
)
def test_a_place_of_mongods(tmp_path: Path, name: str, exists: bool) -> None:
    victims = Victims(tmp_path / "victims")
    target = victims.place / "new"
    if exists:
        target = victims.file(b"{}") if name in MONGOD_FILES else victims.folder(None)
    directory = hostile_mongod(tmp_path, name, target)
    victims.watch()
    assert Path(name).name in refuse(directory)
    victims.check()
    assert (directory / name).is_symlink()


@pytest.mark.parametrize("name", ["mongod.log", "data/x", "users.lock"])
def test_what_is_no_plain_file(tmp_path: Path, name: str) -> None:
    place = tmp_path / "mongod" / name
    place.parent.mkdir(parents=True)
    os.mkfifo(place)
    began = time.monotonic()
    refuse(tmp_path / "mongod")
    assert time.monotonic() - began < 10


@pytest.mark.mongo("embedded")
def test_the_cure_cures(tmp_path: Path, template: Path) -> None:
    victims = Victims(tmp_path / "victims")
    store = planted(template, tmp_path, "mongod", victims.folder(None))
    victims.watch()
    with hl.open(store) as away:
        assert away.shared.index.reached() is None
        assert "Remove" in str(away.shared.index.unavailable)
        assert away.topic("/imu/data").count() > 0
    (store / "mongod").unlink()
    with hl.open(store) as back:
        assert back.shared.index.reached() is not None
        assert back.topic("/imu/data").where("header.seq >= 0").count() > 0
    victims.check()


def test_symlinks_that_come_while_mongod_runs(tmp_path: Path) -> None:
    victims = Victims(tmp_path / "victims")
    directory = tmp_path / "mongod"
    target = victims.file()
    with EmbeddedMongod(directory, linger_s=0.2):
        (directory / "mongod.log").unlink()
        (directory / "mongod.log").symlink_to(target)
        victims.watch()
    wait_for(lambda: not (directory / "data/mongod.lock").read_bytes())
    victims.check()


def test_every_kind_of_file_is_tried(tmp_path: Path, bag: Path) -> None:
    """What a store really holds is on the lists above."""
    seen: set[str] = set()
    with hl.open(tmp_path / "store", create=True) as store:
        live = store.start("live")
        place = store.directory.path
        seen |= {str(p.relative_to(place)) for p in place.rglob("*")}
        begun = places.folder(place, "live").relative_to(place)
        live.close()
        store.record(bag, name="small")
        seen |= {str(p.relative_to(place)) for p in place.rglob("*")}
        small = places.folder(place, "small").relative_to(place)
    known = {name_of(place, kind) for kind in (*FILES, *FOLDERS)}
    alike = {name.replace(begun.name, small.name) for name in seen}
    alike = {re.sub(r"/\d+\.mcap", "/000001.mcap", name) for name in alike}
    # Tables, whose names are drawn, are tried by themselves.
    drawn = (OF_MONGOD, OF_TABLES)
    assert {n for n in alike if not any(p.fullmatch(n) for p in drawn)} <= known
