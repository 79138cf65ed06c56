"""A power cut while a recording is compacted, stripped of payloads, imported or opened."""

from __future__ import annotations

import random
import shutil
import sys
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

import hybridlog as hl
from hybridlog.columns import payload_files
from hybridlog.entries import take_inventory
from hybridlog.maintenance.verify import verify
from hybridlog_storage import journal
from hybridlog_storage.disk import files
from hybridlog_storage.errors import HybridlogError
from tests.copies import bring
from tests.payloads.logs import SETTINGS, messages, recording_of, robot, write_log
from tests.power import PowerCut

NOWHERE = "mongodb://127.0.0.1:9/x?serverSelectionTimeoutMS=20&connectTimeoutMS=20"
Make = Callable[[Path, Path], object]
"""Makes a store, or works on it; gets its path and the folder of the whole stores."""


@dataclass(frozen=True)
class Way:
    """Work on a store while the power may fail."""

    prepare: Make
    work: Make


def compact(path: Path, _: Path, **how: Any) -> None:
    with hl.open(path, mongo=NOWHERE) as store:
        store.compact(topics=["scan", "cloud"], **how)


def drop(path: Path, stores: Path) -> None:
    compact(path, stores, drop_mcap=True)


def new_store(path: Path, _: Path) -> None:
    with hl.open(path, mongo=NOWHERE, create=True):
        pass


def import_from(path: Path, stores: Path) -> None:
    with hl.open(path, mongo=NOWHERE) as store:
        bring(store, stores / "thin")


def import_again(path: Path, stores: Path) -> None:
    """After an import that the disk has stopped."""
    real, failed = files.sync_folder, []

    def fail(folder: Path) -> None:
        if folder.name.startswith("topic=") and len(failed) < 2:
            failed.append(folder)
            raise OSError(5, "no sync")
        real(folder)

    with hl.open(path, mongo=NOWHERE) as store, pytest.MonkeyPatch.context() as patch:
        patch.setattr(files, "sync_folder", fail)
        for _ in range(2):
            with suppress(HybridlogError):
                bring(store, stores / "thin")
        bring(store, stores / "thin")


def reopen(path: Path, _: Path) -> None:
    with hl.open(path, mongo=NOWHERE) as store:
        store.recordings()


def copy_of(name: str) -> Make:
    return lambda path, stores: shutil.copytree(stores / name, path)


def interrupted(step: str) -> Make:
    """Compaction has ended before a step that its journal announces."""

    def prepare(path: Path, stores: Path) -> None:
        real = getattr(payload_files, step)

        def stop(recording: Path, names: Iterable[str], *rest: Any) -> object:
            if step == "publish" or any(name.endswith(".thinned") for name in names):
                raise KeyboardInterrupt
            return real(recording, names, *rest)

        shutil.copytree(stores / "plain", path)
        with pytest.MonkeyPatch.context() as patch, suppress(KeyboardInterrupt):
            patch.setattr(payload_files, step, stop)
            drop(path, stores)

    return prepare


def with_lines(name: str, change: Callable[[list[bytes]], list[bytes]]) -> Make:
    """The journal has other lines."""

    def prepare(path: Path, stores: Path) -> None:
        shutil.copytree(stores / name, path)
        log = recording_of(path) / journal.JOURNAL
        lines = change(log.read_bytes().splitlines(keepends=True))
        log.write_bytes(b"".join(lines)) if lines else log.unlink()

    return prepare


def unsealed(path: Path, stores: Path) -> None:
    """The recorder died while the last segment was written."""
    shutil.copytree(stores / "plain", path)
    log = recording_of(path) / journal.JOURNAL
    lines = log.read_bytes().splitlines(keepends=True)
    last = max(recording_of(path).glob("*.mcap"))
    number = f'"segment":{int(last.stem)},'.encode()
    log.write_bytes(b"".join(x for x in lines if number not in x and b'"ended"' not in x))
    last.with_name(f"{last.name}.open").write_bytes(last.read_bytes()[:-100])
    last.unlink()


def renaming(lines: list[bytes]) -> list[bytes]:
    moving = {"from": "log", "to": "other"}
    return [*lines, journal.encode(journal.event(journal.RENAMED, name="other", **moving))]


WAYS = {
    "compact": Way(copy_of("plain"), compact),
    "drop": Way(copy_of("plain"), drop),
    "drop later": Way(copy_of("columns"), drop),
    "import": Way(new_store, import_from),
    "import again": Way(new_store, import_again),
    "open with columns to publish": Way(interrupted("publish"), reopen),
    "open with a segment to replace": Way(interrupted("replace_segments"), reopen),
    "open without a journal": Way(with_lines("thin", lambda _: []), reopen),
    "open with lost lines": Way(with_lines("thin", lambda lines: lines[:-2]), reopen),
    "open with an open segment": Way(unsealed, reopen),
    "open while renaming": Way(with_lines("thin", renaming), reopen),
}


@pytest.fixture(scope="module")
def stores(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Stores of one recording: as it was recorded, with columns, without payloads."""
    place = tmp_path_factory.mktemp("stores")
    log = write_log(place / "log.mcap", robot(40))
    with hl.open(place / "made", create=True) as store:
        store.record(log, name="log", settings=SETTINGS)
    without = shutil.ignore_patterns("mongod*", "catalog*", "tables*")
    for name, work in (("plain", reopen), ("columns", compact), ("thin", drop)):
        shutil.copytree(place / "made", place / f"{name}-made", ignore=without)
        work(place / f"{name}-made", place)
        shutil.copytree(place / f"{name}-made", place / name, ignore=without)
    return place


@pytest.fixture(scope="module")
def right(stores: Path) -> list[tuple[Any, ...]]:
    with hl.open(stores / "plain", mongo=NOWHERE) as store:
        return messages(store)


def run(way: Way, path: Path, stores: Path, calls: int | None, **model: Any) -> PowerCut:
    """Do some work until the power fails."""
    shutil.rmtree(path, ignore_errors=True)
    way.prepare(path, stores)
    for name in ("tables", "tables.part", "mongod", "catalog"):
        shutil.rmtree(path / name, ignore_errors=True)
        with suppress(OSError):
            (path / name).unlink()
    power = PowerCut(path, calls, **model)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(files, "system", power)
        with suppress(HybridlogError, OSError):
            way.work(path, stores)
    return power


def check(found: Path, way: Way, stores: Path, right: list[Any], *, is_done: bool) -> None:
    """What somebody finds after the cut."""
    with hl.open(found, mongo=NOWHERE) as store:
        assert not store.repairs.unreadable
        if way.work in {import_from, import_again} and not store.recordings():
            assert not is_done
            bring(store, stores / "thin")
        assert messages(store) == right
        (entry,) = store.recordings()
        is_rebuilt = entry.status == "unproven"
        assert entry.status in {"complete", "unproven"}
        if is_done:
            assert way.work is not drop or take_inventory(store.directory, "log").stored
            assert bool(entry.payloads) == (way.work is not reopen or way.prepare is not unsealed)
        store.refresh()
        result = verify(store.directory, store.catalog, None, store.repairs, labels=None)
        places = [one.place for one in result.findings if not one.place.startswith("table")]
        assert places == ["journal"] * is_rebuilt


def try_cuts(
    way: Way, place: Path, stores: Path, right: list[Any], *, step: int, fates: int, **model: Any
) -> None:
    calls = run(way, place / "store", stores, None, **model).calls
    assert calls > 1
    for cut in (None, *range(1, calls + 1, step)):
        power = run(way, place / "store", stores, cut, **model)
        for fate in range(fates if cut is not None else 2 * fates):
            found = place / "found"
            shutil.rmtree(found, ignore_errors=True)
            power.after_cut(found, random.Random(f"{cut} {fate}"))
            check(found, way, stores, right, is_done=not power.is_off)


@pytest.mark.parametrize("name", ["compact", "drop later", "import"])
def test_some_power_cuts(name: str, tmp_path: Path, stores: Path, right: list[Any]) -> None:
    try_cuts(WAYS[name], tmp_path, stores, right, step=13, fates=2, keeps_names=False)


@pytest.mark.exhaustive
@pytest.mark.parametrize("keeps_names", [True, False])
@pytest.mark.parametrize("name", WAYS)
def test_power_cuts_at_every_call(
    name: str, keeps_names: bool, tmp_path: Path, stores: Path, right: list[Any]
) -> None:
    way = WAYS[name]
    try_cuts(way, tmp_path, stores, right, step=1, fates=3, keeps_names=keeps_names)


_ON_THE_WAY = {"files", "contextlib", "test_power_cut", "power"}
_OF_RECORDERS = {"segment_file"}
"""Modules with syncs that a second opening does not need, but a recorder."""


def site() -> str:
    """The line of the product that asks for a sync."""
    frame: FrameType | None = sys._getframe(3)  # behind `PowerCut.sync`
    while frame is not None:
        path, code = Path(frame.f_code.co_filename), frame.f_code.co_name
        is_ours = path.parent.name != "payloads" or path.stem != "files"
        if not (is_ours and path.stem in _ON_THE_WAY) and code != "sync_file":
            return f"{path.parent.name}/{path.stem}:{frame.f_lineno}"
        frame = frame.f_back
    return ""


def sites_of(way: Way, place: Path, stores: Path) -> set[str]:
    found: set[str] = set()
    run(way, place, stores, None, forgets=lambda: found.add(site()) is not None)
    return found


@pytest.mark.exhaustive
def test_no_sync_can_be_left_out(tmp_path: Path, stores: Path, right: list[Any]) -> None:
    ways: dict[str, list[Way]] = {}
    for way in WAYS.values():
        for one in sites_of(way, tmp_path / "store", stores):
            ways.setdefault(one, []).append(way)
    assert len(ways) > 10
    unseen = {one for one, its in ways.items() if not _is_seen(one, its, tmp_path, stores, right)}
    assert {one for one in unseen if Path(one).stem.split(":")[0] not in _OF_RECORDERS} == set()


def _is_seen(one: str, ways: list[Way], place: Path, stores: Path, right: list[Any]) -> bool:
    def forgets() -> bool:
        return site() == one

    for way in ways:
        try:
            try_cuts(way, place, stores, right, step=1, fates=4, keeps_names=False, forgets=forgets)
        except (AssertionError, HybridlogError):
            return True
    return False
