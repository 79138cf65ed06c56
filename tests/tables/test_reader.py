"""A table is believed only while the catalog confirms it, and answers as the messages do."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

import hybridlog as hl
from hybridlog.columns.column_file import ColumnFile, ColumnFileWriter, TablePart
from hybridlog.columns.fields import as_columns, joined, records_of
from hybridlog.columns.layout import Section
from hybridlog.columns.tables import Tables, TopicTable
from hybridlog.follow.follower import make_tables
from hybridlog_storage.errors import StoreError
from tests.damage import flip
from tests.some import in_turn
from tests.tables.logs import decoded, table_of
from tests.tables.test_writer import compare, topics_of


@pytest.fixture
def tables(recorded: hl.Store) -> Tables:
    return Tables(recorded.directory.path)


def file_of(store: hl.Store, topic: str = "/large") -> Path:
    (file,) = table_of(store, topic).files
    return file.path


# --- scanning -------------------------------------------------------------------------


INTEGERS = pa.schema([(name, pa.int64()) for name in ("t", "seq", "n")])
keys = st.lists(st.tuples(st.integers(0, 9), st.integers(0, 99)), max_size=20, unique=True)


@given(runs=st.lists(keys.map(sorted), max_size=4), size=st.integers(1, 5))
def test_parts_are_merged(runs: list[list[tuple[int, int]]], size: int) -> None:
    """Those of several files, in the order of the log, whatever their times are."""
    seen: set[tuple[int, int]] = set()
    with TemporaryDirectory() as folder:
        parts: list[TablePart] = []
        for number, run in enumerate(runs):
            own = [key for key in run if key not in seen]
            seen.update(own)
            table = pa.table({"t": [t for t, _ in own], "seq": [seq for _, seq in own]})
            table = table.append_column("n", table["seq"]).cast(INTEGERS)
            writer = ColumnFileWriter(Path(folder) / f"{number}.parquet", table.schema)
            for begin in range(0, len(own), size):
                writer.write(table.slice(begin, size))
            writer.close([Section("r", "t", {}, len(own))])
            parts += ColumnFile(writer.path).parts(0, len(own))
        if not parts:
            return
        table_of = TopicTable(parts)
        for spans in (None, [(2, 4), (7, 8)]):
            want = [
                k for k in sorted(seen) if spans is None or any(a <= k[0] < b for a, b in spans)
            ]
            found = list(table_of.scan(["n"], spans=spans))
            have = [
                (t, seq, record["n"])
                for rows in found
                for t, seq, record in zip(rows.t, rows.seq, rows.records.to_pylist(), strict=True)
            ]
            assert have == [(t, seq, seq) for t, seq in want]


# --- what is believed -----------------------------------------------------------------


DAMAGE: dict[str, Callable[[Path], object]] = {
    "garbled": lambda path: flip(path, 1 / 3),
    "its footer garbled": lambda path: flip(path, -300),
    "cut": lambda path: os.truncate(path, path.stat().st_size - 1000),
    "empty": lambda path: path.write_bytes(b""),
    "deleted": Path.unlink,
    "a folder": lambda path: (path.unlink(), path.mkdir()),
    "a pipe": lambda path: (path.unlink(), os.mkfifo(path)),
    "a link": lambda path: path.symlink_to(path.rename(path.with_suffix(".real"))),
}


@pytest.mark.parametrize(("harm", "topic"), in_turn(DAMAGE, ["/large", "/small/one"]))
def test_damaged_tables_are_none_and_are_made_again(
    recorded: hl.Store, tables: Tables, harm: str, topic: str
) -> None:
    want = sum(m.value.i8 > 0 for m in decoded(recorded, "log", topic))
    (entry,) = recorded.recordings()
    path = file_of(recorded, topic)
    whole = path.read_bytes()
    DAMAGE[harm](path)
    tables.look_again()
    if harm != "garbled":  # of that, only who reads the part is told
        assert tables.of(entry, topic) is None
    places = {f.place for f in recorded.verify().findings}
    if harm != "deleted":
        assert f"table of {topic}" in places
        done = recorded.verify(repair=True)
        assert {f"table of {topic}"} <= {one.place for one in done.repaired}
    else:
        assert not places
        assert not make_tables(recorded.directory, recorded.shared.catalog, entry)
    assert recorded.topic(topic).where("i8 > 0").count() == want
    assert recorded.verify().findings == []
    assert path.read_bytes() == whole
    assert compare(recorded) == 1800


def test_a_segment_more_or_less_is_noticed(recorded: hl.Store, tables: Tables) -> None:
    (entry,) = recorded.recordings()
    assert tables.of(entry, "/large")
    (entry,) = recorded.recordings()
    digest = entry.digests["0"]
    entry.digests["0"] = digest[:-1] + ("0" if digest[-1] != "0" else "1")
    tables.look_again()
    assert tables.of(entry, "/large") is None
    entry.digests["0"] = digest
    tables.look_again()
    assert tables.of(entry, "/large")
    entry.channels[0].stats.messages += 1
    tables.look_again()
    assert tables.of(entry, entry.channels[0].topic) is None


def test_files_are_open_while_they_are_read(recorded: hl.Store) -> None:
    root = recorded.directory.path  # other tests of this process may hold files of theirs

    def opened() -> int:
        links = (p.readlink() for p in Path("/proc/self/fd").iterdir() if p.is_symlink())
        return sum(root in link.parents and link.suffix == ".parquet" for link in links)

    (entry,) = recorded.recordings()
    tables = Tables(root)
    for topic in topics_of(entry):
        table = tables.of(entry, topic)
        assert table is not None
        assert sum(map(len, table.scan(None))) == table.rows
    assert opened() == 0


def test_a_file_that_is_replaced_is_looked_for_again(recorded: hl.Store, tables: Tables) -> None:
    (entry,) = recorded.recordings()
    table = tables.of(entry, "/large")
    assert table is not None
    path = file_of(recorded)
    path.with_suffix(".new").write_bytes(path.read_bytes())
    path.with_suffix(".new").rename(path)
    with pytest.raises(StoreError, match="replaced"):
        list(table.scan(None))
    tables.reject(entry, "/large")
    again = tables.of(entry, "/large")
    assert again is not None
    assert sum(map(len, again.scan(None))) == 1200


def test_several_threads_may_ask_while_all_is_forgotten(recorded: hl.Store, tables: Tables) -> None:
    (entry,) = recorded.recordings()

    def ask() -> None:
        for _ in range(40):
            table = tables.of(entry, "/large")
            assert table is not None
            assert sum(map(len, table.scan(["name", "i8"]))) == 1200

    with ThreadPoolExecutor(3) as pool:
        asked = [pool.submit(ask) for _ in range(3)]
        while not all(one.done() for one in asked):
            tables.look_again()
        for one in asked:
            one.result()


# --- fields ---------------------------------------------------------------------------

scalars = st.one_of(st.integers(-5, 5), st.none())
structs = st.fixed_dictionaries(
    {
        "a": scalars,
        "A": scalars,
        "list": st.one_of(st.none(), st.lists(scalars, max_size=3)),
        "inner": st.one_of(
            st.none(),
            st.fixed_dictionaries({"x": scalars, "X": st.lists(st.booleans(), max_size=2)}),
        ),
        "many": st.lists(
            st.fixed_dictionaries({"t": scalars, "T": scalars, "data": st.binary(max_size=3)}),
            max_size=3,
        ),
    }
)
KIND = pa.struct(
    [
        ("a", pa.int64()),
        ("A", pa.int32()),
        ("list", pa.list_(pa.float64())),
        ("inner", pa.struct([("x", pa.uint8()), ("X", pa.list_(pa.bool_()))])),
        ("many", pa.list_(pa.struct([("t", pa.int8()), ("T", pa.int8()), ("data", pa.binary())]))),
    ]
)


@given(rows=st.lists(st.one_of(structs, st.none()), max_size=8), start=st.integers(0, 3))
def test_fields_become_columns_and_fields_again(rows: list[Any], start: int) -> None:
    for row in rows:
        if row and row["inner"] and row["inner"]["x"]:
            row["inner"]["x"] = abs(row["inner"]["x"])
    array = pa.array(rows, KIND).slice(start)
    columns = as_columns(array)
    columns.validate(full=True)
    names = [columns.type.field(n).name for n in range(7)]
    assert names == ["a", "A_2", "list", "list_summary", "inner", "many", "many_summary"]
    again = records_of(columns)
    again.validate(full=True)
    assert again.to_pylist() == array.to_pylist()
    assert joined([columns.slice(1), columns]).to_pylist() == [
        *columns.slice(1).to_pylist(),
        *columns.to_pylist(),
    ]
