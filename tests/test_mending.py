"""Questions repair nothing: who changes the store recovers first."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog_storage.cells import CATALOG
from tests.damage import flip
from tests.running.methods import LABEL, rows, sent
from tests.running.running import NO_MONGODB, Running, begun
from tests.running.sequence import Known
from tests.running.stores import copy_of, folder


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    with begun(tmp_path_factory.mktemp("mending") / "store", "many", 60) as found:
        yield found


@pytest.fixture(scope="module")
def known(running: Running) -> Known:
    return running.flushed()


@pytest.fixture
def died(running: Running, known: Known, tmp_path: Path) -> Iterator[hl.Store]:
    """A store that was opened and asked before its recorder died."""
    path = copy_of(running, tmp_path / "copy")
    fd = os.open(folder(path) / "writer.lock", os.O_RDWR)
    fcntl.flock(fd, fcntl.LOCK_EX)
    with hl.open(path, mongo=NO_MONGODB) as store:
        assert store.entry(LABEL).status == "open"
        check(store, known)
        os.close(fd)
        yield store


def check(store: hl.Store, known: Known) -> None:
    """Everything is there, by messages, columns and SQL."""
    for topic in known.counts:
        assert rows(store.topic(topic)) == sent(known.of(topic))
        if topic != "/opaque":
            assert store.topic(topic).to_arrow().num_rows == len(known.of(topic))
    assert store.all_topics().count() == len(known.sent)


def files_in(store: hl.Store) -> dict[str, tuple[int, int, int]]:
    """Number, size and time of everything in a store but locks and the catalog."""
    found = {}
    for place, folders, names in os.walk(store.directory.path):
        for name in [*folders, *names]:
            about = (Path(place) / name).lstat()
            if not name.endswith("lock") and name != CATALOG:
                found[f"{place}/{name}"] = about.st_ino, about.st_size, about.st_mtime_ns
    return found


def test_a_question_about_a_recorder_that_died_writes_nothing(died: hl.Store, known: Known) -> None:
    before = files_in(died)
    assert any(name.endswith(".mcap.open") for name in before)
    died.refresh()
    check(died, known)
    assert died.entry(LABEL).status == "unfinished"
    assert files_in(died) == before
    died.shared.recover()
    assert died.shared.repairs.recovered.keys() == {LABEL}
    assert died.entry(LABEL).status == "recovered"
    assert not died.shared._running
    assert not any(name.endswith(".mcap.open") for name in files_in(died))
    check(died, known)


def test_one_moment_outlasts_the_recovery(died: hl.Store, known: Known) -> None:
    then = died.snapshot()
    check(then, known)
    with hl.open(died.directory.path, mongo=NO_MONGODB) as other:
        assert other.edit(LABEL, tag={"a": "b"}).status == "recovered"
    check(then, known)
    check(died, known)


def test_a_question_that_misses_tables_writes_none(died: hl.Store, known: Known) -> None:
    died.verify(repair=True)
    for file in (died.directory.path / "tables").rglob("*.parquet"):
        flip(file, 1 / 2)
    died.refresh()
    before = files_in(died)
    where = died.topic("arm").where("n > 3")
    count = where.count()
    assert count == len(rows(where)) > 0
    assert files_in(died) == before
    died.verify(repair=True)
    assert files_in(died) != before
    assert where.count() == count
