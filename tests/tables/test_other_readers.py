"""Other programs read the tables without hybridlog, and read what the messages say."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import duckdb
import pandas as pd
import polars as pl
import pyarrow.dataset as ds
import pytest

import hybridlog as hl
from tests.data import DATA, needs_data
from tests.tables.logs import BASE, SECOND, Decoded, decoded, varied, write_log

Row = tuple[Any, ...]
COLUMNS = ("t", "seq", "stamp", "i8", "u64", "f64", "name", "yes")


def glob_of(store: hl.Store) -> str:
    return str(store.directory.path / "tables/*/topic=large/*.parquet")


def with_duckdb(store: hl.Store) -> list[Row]:
    query = f"select {', '.join(COLUMNS)} from read_parquet(?) order by t, seq"
    return duckdb.connect().execute(query, [glob_of(store)]).fetchall()


def with_polars(store: hl.Store) -> list[Row]:
    frame = pl.scan_parquet(glob_of(store), hive_partitioning=True).select(COLUMNS)
    return frame.sort("t", "seq").collect().rows()


def with_pandas(store: hl.Store) -> list[Row]:
    (path,) = Path(store.directory.path).glob("tables/*/topic=large/*.parquet")
    frame = pd.read_parquet(path, columns=list(COLUMNS), dtype_backend="pyarrow")
    rows = frame.sort_values(["t", "seq"]).itertuples(index=False)
    return [tuple(None if value is pd.NA else value for value in row) for row in rows]


def with_pyarrow(store: hl.Store) -> list[Row]:
    found = ds.dataset(store.directory.path / "tables", partitioning="hive")
    table = found.to_table(list(COLUMNS), filter=ds.field("topic") == "large")
    columns = table.sort_by([("t", "ascending"), ("seq", "ascending")]).to_pydict()
    return list(zip(*columns.values(), strict=True))


READERS = [with_duckdb, with_polars, with_pandas, with_pyarrow]


def row_of(message: Decoded) -> Row:
    value = message.value
    stamp = value.header.stamp.sec * SECOND + value.header.stamp.nanosec
    fields = (value.i8, value.u64, value.f64, value.name, bool(value.yes))
    return message.t, message.seq, stamp, *fields


def equal(one: Row, other: Row) -> bool:
    return all(
        a == b or (isinstance(a, float) and math.isnan(a) and math.isnan(b))
        for a, b in zip(one, other, strict=True)
    )


@pytest.mark.parametrize("read", READERS)
def test_rows(recorded: hl.Store, read: Callable[[hl.Store], list[Row]]) -> None:
    want = [row_of(message) for message in decoded(recorded, "log", "/large")]
    have = read(recorded)
    assert len(have) == len(want) == 1200
    assert all(map(equal, have, want))


QUESTIONS: list[tuple[str, Callable[[Any], bool]]] = [
    ("f64 > 1.0", lambda m: m.f64 > 1.0),
    ("f64 <= 1.5", lambda m: m.f64 <= 1.5),
    ("f64 = 1.5", lambda m: m.f64 == 1.5),
    ("f64 between 0 and 100", lambda m: 0 <= m.f64 <= 100),
    ("f64 = 'inf'", lambda m: m.f64 == math.inf),
    ("isnan(f64)", lambda m: math.isnan(m.f64)),
    ("u64 = 18446744073709551615", lambda m: m.u64 == 2**64 - 1),
    ("u64 = 9007199254740993", lambda m: m.u64 == 2**53 + 1),
    ("i8 < 0 and name = 'ä'", lambda m: m.i8 < 0 and m.name == "ä"),
    ("t_ > 300", lambda m: m.t > 300),
    ("Name_2 < -1000", lambda m: m.Name < -1000),
    ("header.frame_id = 'map'", lambda _: True),
    ("nine[2] > 700", lambda m: m.nine[1] > 700),
    ("covariance.n = 36 and covariance.max = 0.25", lambda _: True),
    ("len(points) > 2", lambda m: len(m.points) > 2),
    ("points[1].X_2 = 0.5", lambda m: len(m.points) > 0),
    ("list_contains(words, 'x')", lambda m: "x" in m.words),
    ("nothing", lambda _: True),
]


@pytest.mark.parametrize(("where", "holds"), QUESTIONS)
def test_duckdb_finds_what_there_is(
    recorded: hl.Store, where: str, holds: Callable[[Any], bool]
) -> None:
    # NaN is greater than all numbers in DuckDB.
    where = where.replace("f64 > 1.0", "f64 > 1.0 and not isnan(f64)")
    query = f"select count(*) from read_parquet(?) where {where}"
    (count,) = duckdb.connect().execute(query, [glob_of(recorded)]).fetchone() or (None,)
    assert count == sum(holds(m.value) for m in decoded(recorded, "log", "/large"))


def test_polars_finds_what_there_is(recorded: hl.Store) -> None:
    frame = pl.scan_parquet(glob_of(recorded))
    found = frame.filter((pl.col("f64") > 1.0) & ~pl.col("f64").is_nan()).collect()
    want = [m for m in decoded(recorded, "log", "/large") if m.value.f64 > 1.0]
    assert found["seq"].to_list() == [m.seq for m in want]


def test_partitions(recorded: hl.Store) -> None:
    (entry,) = recorded.recordings()
    everything = str(recorded.directory.path / "tables/*/topic=*/*.parquet")
    query = "select distinct recording, topic from read_parquet(?, hive_partitioning = true)"
    assert duckdb.connect().execute(query, [everything]).fetchall() == [(f"r{entry.id}", "large")]
    frame = pl.scan_parquet(everything, hive_partitioning=True)
    assert frame.select("recording").unique().collect().rows() == [(f"r{entry.id}",)]


def test_ids_that_look_like_numbers_are_told_apart(recorded: hl.Store, tmp_path: Path) -> None:
    """`1e3` and `1000` would be one for readers that infer the type of a partition."""
    (path,) = Path(recorded.directory.path).glob("tables/*/topic=large/*.parquet")
    for recording in ("r1e3", "r1000", "r0x10"):
        place = tmp_path / f"hive/recording={recording}/topic=large"
        place.mkdir(parents=True)
        (place / "a.parquet").write_bytes(path.read_bytes())
    files = str(tmp_path / "hive/*/*/*.parquet")
    frame = pl.scan_parquet(files, hive_partitioning=True)
    assert frame.select("recording").unique().collect().height == 3
    query = "select count(distinct recording) from read_parquet(?, hive_partitioning = true)"
    assert duckdb.connect().execute(query, [files]).fetchone() == (3,)


def test_small_topics(recorded: hl.Store) -> None:
    path = str(recorded.directory.path / "tables/*/small/*.parquet")
    query = "select t, seq, u64 from read_parquet(?) where topic = '/small/two' order by t, seq"
    want = [(m.t, m.seq, m.value.u64) for m in decoded(recorded, "log", "/small/two")]
    assert duckdb.connect().execute(query, [path]).fetchall() == want
    frame = pl.scan_parquet(path).filter(pl.col("topic") == "/small/two")
    assert frame.select("t", "seq", "u64").collect().rows() == want


def test_several_recordings_are_one_table(recorded: hl.Store, tmp_path: Path) -> None:
    said = [(BASE + SECOND + n, "/large", varied(n)) for n in range(1000)]
    recorded.record(write_log(tmp_path / "more.mcap", said), name="more")
    query = "select count(*) from read_parquet(?) where i8 = 1"
    messages = [m for name in ("log", "more") for m in decoded(recorded, name, "/large")]
    want = sum(m.value.i8 == 1 for m in messages)
    assert duckdb.connect().execute(query, [glob_of(recorded)]).fetchone() == (want,)
    assert ds.dataset(recorded.directory.path / "tables").count_rows() == 2800


@needs_data
@pytest.mark.parametrize(
    ("log", "topic", "path"),
    [
        ("robot_localization_test1.bag", "/imu/data", "linear_acceleration.x"),
        ("auv_ros2.mcap", "/coug2/modem_status", "depth_local"),
        ("leg_tracker_stationary.bag", "/scan", "scan_time"),
    ],
)
def test_real_logs(store: hl.Store, log: str, topic: str, path: str) -> None:
    store.record(DATA / "real" / log, name="log")
    want = []
    for message in decoded(store, "log", topic):
        value = message.value
        for name in path.split("."):
            value = getattr(value, name)
        want.append((message.t, value))
    files = str(store.directory.path / f"tables/*/topic={topic[1:].replace('/', '__')}/*.parquet")
    query = f"select t, {path} from read_parquet(?) order by t, seq"
    assert duckdb.connect().execute(query, [files]).fetchall() == want
    column = pl.col(path.split(".", maxsplit=1)[0])
    for name in path.split(".")[1:]:
        column = column.struct.field(name)
    frame = pl.scan_parquet(files).sort("t", "seq").select("t", column.alias("value"))
    assert frame.collect().rows() == want


def test_no_reader_needs_hybridlog(recorded: hl.Store) -> None:
    script = (
        "import sys, pyarrow.parquet as pq\n"
        "table = pq.read_table(sys.argv[1])\n"
        "assert not any(name.startswith('hybridlog') for name in sys.modules)\n"
        "print(table.num_rows)\n"
    )
    (path,) = Path(recorded.directory.path).glob("tables/*/topic=large/*.parquet")
    done = subprocess.run(
        [sys.executable, "-c", script, str(path)], capture_output=True, text=True, check=True
    )
    assert done.stdout == "1200\n"
