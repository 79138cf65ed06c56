"""Tables follow their recording: through crashes, marks, new names, copies and its end."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from msgspec.structs import replace

import hybridlog as hl
from hybridlog.columns.column_file import ColumnFile
from hybridlog.columns.layout import PARTS, TABLES
from hybridlog.columns.table_writer import TableFolders
from hybridlog.columns.tables import Tables
from hybridlog.follow.follower import make_tables
from hybridlog.maintenance import opening as making
from hybridlog.maintenance.verify import RESTORE, TableChecker
from hybridlog.record.marks import MARKS
from tests import places
from tests.damage import flip
from tests.limits import Limit
from tests.tables.logs import BASE, varied, write_log
from tests.tables.test_writer import compare, topics_of

FEW = [(BASE + n, "/a" if n % 3 else "/b", varied(n)) for n in range(90)]


@pytest.fixture
def few(store: hl.Store, tmp_path: Path) -> hl.Store:
    """A recording of a few messages."""
    store.record(write_log(tmp_path / "few.mcap", FEW), name="few")
    return store


def contents(store: hl.Store) -> dict[str, str]:
    """What each file has."""
    root = store.directory.path / TABLES
    found = {}
    for path in root.glob("*/*.parquet"):
        reader = ColumnFile(path)
        found[str(path.relative_to(root))] = f"{reader.sections} {reader.table().to_pylist()}"
    return found


def test_a_mark_changes_no_table(few: hl.Store) -> None:
    before = contents(few)
    few.mark("few", BASE + 5, "here")
    few.mark("few", BASE + 6, "and here")
    assert len(few.topic(MARKS).to_arrow()) == 2
    assert contents(few) == before
    assert few.verify().findings == []
    (entry,) = few.recordings()
    tables = Tables(few.directory.path)
    assert all(tables.of(entry, topic) for topic in topics_of(entry) if topic != MARKS)


def test_what_is_left_of_recordings_that_are_gone(few: hl.Store, tmp_path: Path) -> None:
    root = few.directory.path
    before = contents(few)
    few.record(write_log(tmp_path / "more.mcap", FEW), name="more", again=True)
    gone = few.entry("more").id
    assert contents(few) != before
    places.lose(root, "more")
    with hl.open(root, mongo="none") as again:
        again.shared.recover()
    assert contents(few) == before
    # What was not finished.
    (root / PARTS / f"r{gone}").mkdir(parents=True)
    with hl.open(root, mongo="none") as again:
        again.shared.recover()
    assert not list((root / PARTS).glob("*"))
    few.refresh()
    assert compare(few) == 90


def test_only_what_is_missing_is_made(few: hl.Store, tmp_path: Path, limit: Limit) -> None:
    limit(long_table_rows=1000)
    said = [(BASE + n, f"/{n % 2}", varied(n)) for n in range(2400)]
    entry = few.record(write_log(tmp_path / "two.mcap", said), name="two").entry
    assert making.missing(few.directory, entry) == set()
    one, other = sorted((few.directory.path / TABLES).glob(f"*/{entry.id}-*"))
    kept = other.stat().st_mtime_ns
    one.unlink()
    assert len(making.missing(few.directory, entry)) == 1
    assert not make_tables(few.directory, few.shared.catalog, entry)
    assert other.stat().st_mtime_ns == kept
    assert compare(few) == 2490


def test_a_damaged_chunk_costs_no_table(indexed: hl.Store, tmp_path: Path) -> None:
    """It may be the only copy of these fields, and documents of its messages are no surplus."""
    few = indexed
    few.record(write_log(tmp_path / "few.mcap", FEW), name="few")
    before = contents(few)
    (entry,) = few.recordings()
    (path,) = places.folder(few.directory.path, "few").glob("*.mcap")
    flip(path, 2000)
    make_tables(few.directory, few.shared.catalog, entry, topics=["/a"])
    assert contents(few) == before
    (finding,) = few.verify().findings
    assert finding.cure == RESTORE
    few.index.rebuild()
    assert contents(few) == before
    flip(path, 2000)
    few.index.rebuild()
    assert compare(few) == 90


def test_repair_makes_missing_tables(few: hl.Store, limit: Limit) -> None:
    before = contents(few)
    for path in (few.directory.path / TABLES).glob("*/*.parquet"):
        path.unlink()
    done = few.verify(repair=True)
    assert [one.place for one in done.repaired] == ["table of /a", "table of /b"]
    assert not done.findings
    assert contents(few) == before
    assert not few.verify(repair=True).repaired
    path = next((few.directory.path / TABLES).glob("*/*.parquet"))
    flip(path, *range(1000, 1400), bits=0xFF)
    topics = [one.place for one in few.verify().findings]
    limit(table_reserve_bytes=1 << 60)
    done = few.verify(repair=True)
    assert [one.place for one in done.findings] == topics
    assert topics
    assert all("MiB free; make room" in one.problem for one in done.findings)
    limit(table_reserve_bytes=0)
    done = few.verify(repair=True)
    assert ([one.place for one in done.repaired], done.findings) == (topics, [])
    assert contents(few) == before


def test_rows_of_another_segment_are_not_kept(few: hl.Store) -> None:
    """Stale rows are no damage, and are made again."""
    (entry,) = few.recordings()
    stale = dict.fromkeys(entry.digests, "0" * 64)
    path = next((few.directory.path / TABLES).glob("*/*.parquet"))
    reader = ColumnFile(path)
    sections = reader.sections
    folders = TableFolders(few.directory.path, entry.id, entry.created)
    table, before, pieces = reader.table(), 0, []
    for section in sections:
        pieces.append((replace(section, segments=stale), table.slice(before, section.rows)))
        before += section.rows
    folders._write(path, pieces)
    assert not TableChecker(few.directory).damage(entry)
    assert making.missing(few.directory, entry) == {"/a", "/b"}
    assert not make_tables(few.directory, few.shared.catalog, entry, topics=["/a"])
    assert making.missing(few.directory, entry) == set()


def test_what_may_not_be_written_gets_none(few: hl.Store, limit: Limit) -> None:
    (entry,) = few.recordings()
    shutil.rmtree(few.directory.path / TABLES)
    with few.directory.writing(few.entry("few").id):
        assert make_tables(few.directory, few.shared.catalog, entry)
    limit(directory_is_writable=False)
    assert make_tables(few.directory, few.shared.catalog, entry)
    assert not [*(few.directory.path / TABLES).glob("*")]
