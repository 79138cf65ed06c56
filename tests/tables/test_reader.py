"""A table is believed only while the catalog confirms it, and answers as the messages do."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import hybridlog as hl
from hybridlog.columns import topic_table as reader
from hybridlog.columns.fields import FieldShape, UnfitError, alike, joined, records_of
from hybridlog.columns.parquet_file import ParquetFileReader
from hybridlog.columns.tables import Tables
from hybridlog.columns.topic_table import TopicTable, _merged
from hybridlog.maintenance import tables as making
from hybridlog_storage.cache import Cache
from hybridlog_storage.errors import StoreError
from tests.calls import Calls
from tests.limits import Limit
from tests.some import in_turn
from tests.tables import ask
from tests.tables.conftest import SMALL_CHUNKS
from tests.tables.logs import BASE, SECOND, decoded, varied, write_log
from tests.tables.test_writer import compare, topics_of


@pytest.fixture
def tables(recorded: hl.Store) -> Tables:
    return Tables(recorded.directory.path)


def table_of(store: hl.Store, topic: str = "/large") -> TopicTable:
    (entry,) = store.recordings()
    found = Tables(store.directory.path).of(entry, topic)
    assert found is not None
    return found


def file_of(store: hl.Store, topic: str = "/large") -> Path:
    (file,) = table_of(store, topic).files
    return file.path


def all_of(blocks: Iterator[reader.TableRows], path: str) -> list[Any]:
    found = []
    for block in blocks:
        column = block.records
        for name in path.split("."):
            column = column.field(name)
        found += column.to_pylist()
    return found


# --- scanning -------------------------------------------------------------------------


def test_only_what_is_wanted_is_read(recorded: hl.Store) -> None:
    table = table_of(recorded)
    (block,) = table.scan(["header.stamp", "points[].X", "Name", "covariance.max"], own=["pub"])
    kind = block.records.type
    assert [kind.field(n).name for n in range(kind.num_fields)] == [
        "header",
        "covariance",
        "points",
        "Name",
    ]
    assert kind.field("header").type.num_fields == 1
    assert kind.field("points").type.value_type.field(0).name == "X"
    assert kind.field("covariance").type.field(0).name == "max"
    assert set(block.own) == {"pub"}
    assert table.fields(["header.stamp", "points[].X", "Name", "covariance.max"]) == kind
    assert 0 < table.size(["i8"]) < table.size(["header", "i8"]) < table.size(None)
    assert table.has("header.stamp")
    assert table.has("t")
    assert table.has("points[].X")
    assert not table.has("seq")
    assert not table.has("header.stamp.sec")


def test_all_below_a_field(recorded: hl.Store) -> None:
    (block,) = table_of(recorded).scan(["header", "header.seq"])
    kind = block.records.type.field("header").type
    assert [kind.field(n).name for n in range(kind.num_fields)] == ["seq", "stamp", "frame_id"]


def test_a_field_that_is_not_there(recorded: hl.Store) -> None:
    (block,) = table_of(recorded).scan(["nowhere", "header.nowhere"])
    assert block.records.type.num_fields == 0
    assert len(block.records) == len(block) == 1200


times = st.integers(-5, 6700).map(lambda n: BASE + n)


@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(bounds=st.lists(times, max_size=8, unique=True).map(sorted))
@pytest.mark.parametrize("topic", ["/large", "/small/two"])
def test_ranges_of_time(recorded: hl.Store, topic: str, bounds: list[int]) -> None:
    spans = list(zip(bounds[::2], bounds[1::2], strict=False))
    messages = [m for m in decoded(recorded, "log", topic) if any(a <= m.t < b for a, b in spans)]
    found = list(table_of(recorded, topic).scan(["i8"], spans=spans))
    assert [t for block in found for t in block.t.tolist()] == [m.t for m in messages]
    assert all_of(iter(found), "i8") == [m.value.i8 for m in messages]


def test_row_groups_out_of_range_are_not_read(
    recorded: hl.Store, tmp_path: Path, calls: Calls, limit: Limit
) -> None:

    limit(table_group_rows=100, long_table_rows=1000)
    (entry,) = recorded.recordings()
    making.make(recorded.directory, entry, ["/large"])
    table = table_of(recorded)
    assert table.files[0].groups == 12
    read = calls(ParquetFileReader, "read")
    bounds = table.files[0].about.bounds
    assert sum(map(len, table.scan(spans=[(bounds[5][1], bounds[5][1] + 1)]))) >= 1
    assert {group for _, group, _ in read} <= {4, 5, None}
    for rows, *_, last, _ in bounds:  # the last one of a row group begins the range
        found = [block.t.tolist() for block in table.scan(spans=[(last, last + 10)])]
        assert rows
        assert last in found[0]
    read.clear()
    assert sum(map(len, table.scan(spans=[(0, 1)]))) == 0
    assert {group for _, group, _ in read} <= {None}
    assert sum(map(len, table.scan(spans=[]))) == 0


def rows_of(t: list[int], seq: list[int]) -> reader.TableRows:
    records = pa.array([{"n": n} for n in seq], pa.struct([("n", pa.int64())]))
    return reader.TableRows(np.array(t, np.int64), np.array(seq, np.int64), {}, records)


keys = st.lists(st.tuples(st.integers(0, 9), st.integers(0, 99)), max_size=20, unique=True)


@given(runs=st.lists(keys.map(sorted), max_size=4), size=st.integers(1, 5))
def test_sequences_are_merged(runs: list[list[tuple[int, int]]], size: int) -> None:
    seen: set[tuple[int, int]] = set()
    for run in runs:
        run[:] = [key for key in run if key not in seen]
        seen.update(run)
    streams = [
        iter(
            [
                rows_of(*map(list, zip(*run[at : at + size], strict=True)))
                for at in range(0, len(run), size)
            ]
        )
        for run in runs
    ]
    found = list(_merged(streams))
    have = [key for rows in found for key in zip(rows.t.tolist(), rows.seq.tolist(), strict=True)]
    assert have == sorted(seen)
    assert all_of(iter(found), "n") == [seq for _, seq in sorted(seen)]


# --- what is believed -----------------------------------------------------------------


def garble(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 1
    path.write_bytes(content)


def garble_footer(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[-300] ^= 1
    path.write_bytes(content)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1000])


def empty(path: Path) -> None:
    path.write_bytes(b"")


def delete(path: Path) -> None:
    path.unlink()


def be_a_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def be_a_pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def lead_elsewhere(path: Path) -> None:
    path.rename(path.with_suffix(".real"))
    path.symlink_to(path.with_suffix(".real"))


DAMAGE = [garble, garble_footer, cut, empty, delete, be_a_folder, be_a_pipe, lead_elsewhere]


def count(store: hl.Store, tables: Tables, topic: str) -> int | None:
    (entry,) = store.recordings()
    return ask.count(tables, entry, topic, mask=is_positive, fields=["i8"])


def is_positive(records: Any) -> Any:
    return pc.greater(records.field("i8"), 0).fill_null(False).to_numpy(zero_copy_only=False)


@pytest.mark.parametrize(("harm", "topic"), in_turn(DAMAGE, ["/large", "/small/one"]))
def test_damaged_tables_are_none_and_are_made_again(
    recorded: hl.Store, tables: Tables, harm: Callable[[Path], None], topic: str
) -> None:
    want = sum(m.value.i8 > 0 for m in decoded(recorded, "log", topic))
    assert count(recorded, tables, topic) == want
    (entry,) = recorded.recordings()
    path = file_of(recorded, topic)
    whole = path.read_bytes()
    harm(path)
    tables.invalidate()
    if harm is not garble:  # of that, only who reads the part is told
        assert count(recorded, tables, topic) is None
        assert tables.of(entry, topic) is None
    places = {f.place for f in recorded.verify().findings}
    if harm is not delete:
        assert f"table of {topic}" in places
        done = recorded.verify(repair=True)
        assert {f"table of {topic}"} <= {one.place for one in done if one.is_cured}
    else:
        assert not places
        assert making.make(recorded.directory, entry)
    tables.invalidate()
    assert count(recorded, tables, topic) == want
    assert recorded.topic(topic).where("i8 > 0").count() == want
    assert recorded.verify().findings == []
    assert path.read_bytes() == whole
    assert compare(recorded) == 1800


def test_damage_that_is_met_while_reading(recorded: hl.Store, tables: Tables) -> None:
    (entry,) = recorded.recordings()
    table = tables.of(entry, "/large")
    assert table is not None
    path = file_of(recorded)
    content = bytearray(path.read_bytes())
    content[: len(content) - 20_000] = bytes(len(content) - 20_000)
    path.write_bytes(content)
    assert ask.count(tables, entry, "/large", mask=is_positive, fields=["i8"]) is None
    assert tables.of(entry, "/large") is None  # from now on
    tables.invalidate()
    with pytest.raises(StoreError, match="damaged"):
        list(ask.rows(tables, entry, "/large", fields=None) or ())
    tables.reject(entry, "/large")
    assert tables.of(entry, "/large") is None


def test_all_tables_may_go_at_any_time(recorded: hl.Store, tables: Tables, mongo: str) -> None:
    want = recorded.topic("/large").where("i8 > 0").count()
    shutil.rmtree(recorded.directory.path / "tables")
    assert recorded.topic("/large").where("i8 > 0").count() == want
    recorded.refresh()
    assert recorded.topic("/large").where("i8 > 0").count() == want
    recorded.mend()
    assert recorded.verify().findings == []
    assert count(recorded, tables, "/large") == want
    with hl.open(recorded.directory.path, mongo=mongo) as indexed:
        indexed.index.rebuild()
        assert compare(indexed) == 1800


def test_tables_of_other_recordings_are_not_believed(
    recorded: hl.Store, recorded_once: Path
) -> None:
    log = recorded_once.parent / "log.mcap"
    recorded.record(log, name="other", again=True, settings=SMALL_CHUNKS)
    one, other = recorded.entry("log"), recorded.entry("other")
    making.remove(recorded.directory, one.id)
    tables = Tables(recorded.directory.path)
    assert all(tables.of(one, topic) is None for topic in topics_of(one))
    assert all(tables.of(other, topic) for topic in topics_of(other))
    forged = replace(one, id=other.id, digests=dict.fromkeys(one.digests, "0" * 64))
    for topic in topics_of(one):
        with pytest.raises(FileNotFoundError):
            tables.check(forged, topic)
    assert making.make(recorded.directory, one)
    assert compare(recorded) == 3600


def test_a_segment_more_or_less_is_noticed(recorded: hl.Store, tables: Tables) -> None:
    (entry,) = recorded.recordings()
    assert tables.of(entry, "/large")
    (entry,) = recorded.recordings()
    digest = entry.digests["0"]
    entry.digests["0"] = digest[:-1] + ("0" if digest[-1] != "0" else "1")
    tables.invalidate()
    assert tables.of(entry, "/large") is None
    entry.digests["0"] = digest
    tables.invalidate()
    assert tables.of(entry, "/large")
    entry.channels[0].stats.messages += 1
    tables.invalidate()
    assert tables.of(entry, entry.channels[0].topic) is None


def test_a_running_recording_has_no_answer_yet(store: hl.Store, tmp_path: Path) -> None:
    from tests.tables.logs import channel

    with store.start("live") as recording:
        recording.write(channel("/a"), varied(1))
        store.refresh()
        (entry,) = store.recordings()
        assert Tables(store.directory.path).of(entry, "/a") is None
        assert not making.make(store.directory, entry)
    store.refresh()
    assert table_of(store, "/a").rows == 1
    del recording


def test_what_is_found_is_remembered(recorded: hl.Store, tables: Tables, calls: Calls) -> None:
    (entry,) = recorded.recordings()
    table = tables.of(entry, "/large")
    assert table is not None
    assert tables.of(entry, "/large") is table
    before = list(table.scan(["i8"]))
    calls.fail(ParquetFileReader, "read", AssertionError)
    assert [b.records.equals(a.records) for a, b in zip(before, table.scan(["i8"]), strict=True)]
    tables.invalidate()
    assert tables.of(entry, "/large") is not table


def test_memory_of_columns_is_bounded(recorded: hl.Store) -> None:
    (entry,) = recorded.recordings()
    cache = Cache(30_000)
    tables = Tables(recorded.directory.path, cache)
    table = tables.of(entry, "/large")
    assert table is not None
    for name in ("i8", "f64", "t", "nine", "covariance", "many"):
        list(table.scan([name]))
        assert 0 < cache._size <= 30_000


def test_files_are_closed_when_they_are_forgotten(recorded: hl.Store, tables: Tables) -> None:
    root = recorded.directory.path  # other tests of this process may hold files of theirs

    def opened() -> int:
        links = (p.readlink() for p in Path("/proc/self/fd").iterdir() if p.is_symlink())
        return sum(root in link.parents and link.suffix == ".parquet" for link in links)

    (entry,) = recorded.recordings()
    for topic in topics_of(entry):
        assert tables.of(entry, topic)
    assert opened() == 1
    tables.invalidate()
    assert opened() == 0


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
            tables.invalidate()
        for one in asked:
            one.result()


# --- answers --------------------------------------------------------------------------


SPANS = [(BASE + 500, BASE + 900), (BASE + 3000, BASE + SECOND)]
MASKS: list[tuple[str, list[str], Callable[[Any], Any], Callable[[Any], bool]]] = [
    ("i8", ["i8"], lambda r: pc.greater(r.field("i8"), 0), lambda m: m.i8 > 0),
    ("f64", ["f64"], lambda r: pc.less(r.field("f64"), 1.0), lambda m: m.f64 < 1.0),
    ("name", ["name"], lambda r: pc.equal(r.field("name"), "ä"), lambda m: m.name == "ä"),
    (
        "u64",
        ["u64"],
        lambda r: pc.equal(r.field("u64"), pa.scalar(2**53 + 1, pa.uint64())),
        lambda m: m.u64 == 2**53 + 1,
    ),
    (
        "t",
        ["t", "state"],
        lambda r: pc.and_(pc.greater(r.field("t"), 90), pc.equal(r.field("state"), 1)),
        lambda m: m.t > 90 and m.state == 1,
    ),
    (
        "points",
        ["points"],
        lambda r: pc.equal(pc.list_value_length(r.field("points")), 2),
        lambda m: len(m.points) == 2,
    ),
]


@pytest.mark.parametrize("topic", ["/large", "/small/two"])
@pytest.mark.parametrize("spans", [None, SPANS])
@pytest.mark.parametrize(("_", "fields", "mask", "holds"), MASKS, ids=[m[0] for m in MASKS])
def test_answers(
    recorded: hl.Store,
    tables: Tables,
    topic: str,
    spans: Any,
    _: str,
    fields: list[str],
    mask: Callable[[Any], Any],
    holds: Callable[[Any], bool],
) -> None:
    (entry,) = recorded.recordings()

    def of(records: Any) -> Any:
        return mask(records).fill_null(False).to_numpy(zero_copy_only=False)

    want = [
        m
        for m in decoded(recorded, "log", topic)
        if holds(m.value) and (spans is None or any(a <= m.t < b for a, b in spans))
    ]
    found = ask.count(tables, entry, topic, mask=of, fields=fields, spans=spans)
    assert found == len(want)
    assert want or topic != "/large"
    rows = ask.rows(
        tables, entry, topic, mask=of, fields=[*fields, "header.seq"], own=["ref"], spans=spans
    )
    assert rows is not None
    blocks = list(rows)
    assert [seq for block in blocks for seq in block.seq.tolist()] == [m.seq for m in want]
    assert all_of(iter(blocks), "header.seq") == [m.value.header.seq for m in want]
    assert ask.count(tables, entry, topic, spans=spans) == sum(
        spans is None or any(a <= m.t < b for a, b in spans)
        for m in decoded(recorded, "log", topic)
    )


def test_what_a_predicate_cannot_tell(recorded: hl.Store, tables: Tables) -> None:
    (entry,) = recorded.recordings()
    assert ask.count(tables, entry, "/large", mask=lambda _: None, fields=["i8"]) is None
    assert ask.rows(tables, entry, "/large", mask=lambda _: None, fields=["i8"]) is None
    assert ask.count(tables, entry, "/nowhere") is None
    assert ask.rows(tables, entry, "/nowhere") is None


def test_no_predicate_holds_of_an_unreadable_message(store: hl.Store, tmp_path: Path) -> None:
    said = [(BASE + n, "/a", varied(n)[: len(varied(n)) - n % 2]) for n in range(50)]
    write_log(tmp_path / "log.mcap", said)
    store.record(tmp_path / "log.mcap", name="log")
    (entry,) = store.recordings()
    tables = Tables(store.directory.path)

    def everything(records: Any) -> Any:
        return np.ones(len(records), np.bool_)

    assert ask.count(tables, entry, "/a", mask=everything, fields=["i8"]) == 25
    assert ask.count(tables, entry, "/a") == 50


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
    columns = FieldShape().columns(array)
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


def struct(rows: list[Any], **fields: Any) -> Any:
    return pa.array(rows, pa.struct(list(fields.items())))


def test_arrays_over_the_limit_are_summaries() -> None:
    shape = FieldShape()
    short = struct([{"a": [1.0, None]}, {"a": None}], a=pa.list_(pa.float64()))
    found = shape.columns(short)
    assert found.field("a").to_pylist() == [[1.0, None], None]
    assert found.field("a_summary").null_count == 2
    long = struct(
        [{"a": [float("nan"), 2.0, *[1.0] * 38]}, {"a": []}, {"a": None}], a=pa.list_(pa.float64())
    )
    mixed = shape.columns(long)
    assert mixed.type == found.type == shape.columns(long.slice(0, 0)).type
    assert mixed.field("a").to_pylist() == [None, [], None]
    first, *others = mixed.field("a_summary").to_pylist()
    assert (first["n"], first["min"], first["max"]) == (40, 1.0, 2.0)
    assert others == [None, None]
    # Where one is too long, all are summaries for who asks about fields.
    assert records_of(found).to_pylist() == short.to_pylist()
    summaries = records_of(mixed, lambda path: path == ("a",)).field("a").to_pylist()
    assert summaries == [first, {"n": 0, "min": None, "max": None, "mean": None}, None]
    together = joined([records_of(found), records_of(mixed, lambda _: True)])
    assert together.field("a").to_pylist() == [
        {"n": 2, "min": 1.0, "max": 1.0, "mean": 1.0},
        None,
        *summaries,
    ]


def test_a_field_called_as_a_summary() -> None:
    array = struct([{"a": [1], "a_summary": "x"}], a=pa.list_(pa.int8()), a_summary=pa.string())
    columns = FieldShape().columns(array)
    assert [field.name for field in columns.type] == ["a", "a_summary", "a_summary_2"]
    assert records_of(columns).to_pylist() == array.to_pylist()


def test_an_array_in_an_array_may_be_too_long() -> None:
    kind = pa.list_(pa.list_(pa.int8()))
    array = struct([{"a": [[1], [2] * 40]}, {"a": [[3], None]}, {"a": None}], a=kind)
    columns = FieldShape().columns(array)
    assert columns.field("a").to_pylist() == [None, [[3], None], None]
    assert columns.field("a_summary").to_pylist() == [{"n": 2}, None, None]


@pytest.mark.parametrize(
    "kind", [pa.string(), pa.struct([("x", pa.int8())]), pa.list_(pa.int8()), pa.binary()]
)
def test_long_arrays_of_other_things_have_a_length(kind: Any) -> None:
    values = pa.nulls(40, kind)
    lists = pa.ListArray.from_arrays(pa.array([0, 40], pa.int32()), values)
    array = pa.StructArray.from_arrays([lists], names=["a"])
    assert FieldShape().columns(array).to_pylist() == [{"a": None, "a_summary": {"n": 40}}]


def test_bytes() -> None:
    array = struct([{"a": b"x" * 33}, {"a": None}, {"a": b""}, {"a": b"x" * 32}], a=pa.binary())
    assert FieldShape().columns(array).to_pylist() == [
        {"a": None, "a_summary": {"n": 33}},
        {"a": None, "a_summary": None},
        {"a": b"", "a_summary": None},
        {"a": b"x" * 32, "a_summary": None},
    ]


@pytest.mark.parametrize(
    ("kind", "most"),
    [
        (pa.uint64(), 2**64 - 1),
        (pa.int64(), 2**63 - 1),
        (pa.bool_(), True),
        (pa.timestamp("ns", "UTC"), 2**63 - 1),
    ],
)
def test_summaries_of_integers_are_exact(kind: Any, most: int) -> None:
    values = pa.array([type(most)(0), most] * 20, kind)
    lists = pa.ListArray.from_arrays(pa.array([0, 40], pa.int32()), values)
    array = pa.StructArray.from_arrays([lists], names=["a"])
    found = FieldShape().columns(array).field("a_summary")[0].as_py()
    assert (found["n"], found["min"], found["max"]) == (40, 0, int(most))


def test_columns_that_a_piece_lacks_are_null() -> None:
    one = struct([{"a": 1, "s": {"x": 1}}], a=pa.int64(), s=pa.struct([("x", pa.int64())]))
    two = struct([{"b": "x", "s": {"y": 2}}], b=pa.string(), s=pa.struct([("y", pa.int64())]))
    none = struct([{"a": None}], a=pa.null())
    assert joined([one, two, none]).to_pylist() == [
        {"a": 1, "s": {"x": 1, "y": None}, "b": None},
        {"a": None, "s": {"x": None, "y": 2}, "b": "x"},
        {"a": None, "s": None, "b": None},
    ]


@pytest.mark.parametrize("other", [pa.string(), pa.float64(), pa.uint64(), pa.list_(pa.int64())])
def test_types_without_a_common_one(other: Any) -> None:
    one = struct([{"a": 1}], a=pa.int64())
    two = pa.StructArray.from_arrays([pa.nulls(0, other)], names=["a"])
    with pytest.raises(UnfitError):
        alike([one, two], by_type=True)


def test_values_without_a_common_type_are_json() -> None:
    one = struct([{"a": 1}], a=pa.int64())
    two = struct([{"a": "x"}, {"a": None}], a=pa.string())
    found = joined([one, two]).field("a")
    assert found.type == pa.json_()
    assert found.storage.to_pylist() == ["1", '"x"', None]
    wide = joined([struct([{"a": 1}], a=pa.int8()), one])
    assert wide.type.field("a").type == pa.int64()
