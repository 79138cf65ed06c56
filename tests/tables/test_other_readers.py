"""Other programs read the tables without hybridlog, and read what the messages say."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from shutil import copytree
from typing import Any

import duckdb
import polars as pl
import pyarrow.dataset as ds
import pyarrow.parquet as pq
import pytest

import hybridlog as hl
from hybridlog_storage.messages import Schema
from tests.cli.within import answer
from tests.limits import limits
from tests.tables.logs import (
    BASE,
    SECOND,
    STATE,
    Decoded,
    decoded,
    payload,
    varied,
    write_log,
)

Row = tuple[Any, ...]
COLUMNS = ("t", "seq", "stamp", "i8", "u64", "f64", "name", "yes")


def with_duckdb(files: str, columns: tuple[str, ...], topic: str) -> list[Row]:
    query = f"select {', '.join(columns)} from read_parquet(?) where topic = ? order by t, seq"
    return duckdb.connect().execute(query, [files, topic]).fetchall()


def with_polars(files: str, columns: tuple[str, ...], topic: str) -> list[Row]:
    frame = pl.scan_parquet(files).filter(pl.col("topic") == topic)
    return frame.sort("t", "seq").select(columns).collect().rows()


def with_pyarrow(files: str, columns: tuple[str, ...], topic: str) -> list[Row]:
    (folder,) = {path.parent for path in Path("/").glob(files[1:])}
    table = ds.dataset(folder).to_table(list(columns), filter=ds.field("topic") == topic)
    found = table.sort_by([("t", "ascending"), ("seq", "ascending")]).to_pydict()
    return list(zip(*found.values(), strict=True))


READERS = [with_duckdb, with_polars, with_pyarrow]
Reader = Callable[[str, tuple[str, ...], str], list[Row]]


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
def test_rows(kept: hl.Store, read: Reader) -> None:
    want = [row_of(message) for message in decoded(kept, "log", "/large")]
    have = read(str(kept.directory.path / "tables/test_State~*/*.parquet"), COLUMNS, "/large")
    assert len(have) == len(want) > 0
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
    ("covariance_summary.n = 36 and covariance_summary.max = 0.25", lambda _: True),
    ("covariance is null and many_summary is null", lambda _: True),
    ("len(points) > 2", lambda m: len(m.points) > 2),
    ("points[1].X_2 = 0.5", lambda m: len(m.points) > 0),
    ("list_contains(words, 'x')", lambda m: "x" in m.words),
    ("nothing", lambda _: True),
]


def test_duckdb_finds_what_there_is(kept: hl.Store) -> None:
    (entry,) = kept.recordings()
    messages = decoded(kept, "log", "/large")
    connection, files = duckdb.connect(), str(kept.directory.path / "tables/*/*.parquet")
    for where, holds in QUESTIONS:
        # NaN is greater than all numbers in DuckDB.
        asked = where.replace("f64 > 1.0", "f64 > 1.0 and not isnan(f64)")
        query = (
            "select count(*) from read_parquet(?) "
            f"where topic = '/large' and recording = ? and {asked}"
        )
        (count,) = connection.execute(query, [files, entry.id]).fetchone() or (None,)
        assert count == sum(holds(message.value) for message in messages), where


@pytest.fixture(scope="module")
def many(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    """Recordings with large and small topics, changed types, odd messages."""
    place = tmp_path_factory.mktemp("many")
    with (
        limits(long_table_rows=500),
        hl.open(place / "store", create=True, mongo="none") as store,
    ):
        for number in range(4):
            log = write_log(place / f"{number}.mcap", *_said(number))
            store.record(log, name=str(number), again=True)
        yield store


def _said(number: int) -> tuple[list[tuple[int, str, bytes]], dict[str, tuple[str, Schema]]]:
    other = Schema("x/Other", "ros1msg", b"float32 x\n")
    definitions = (b"float64 a\n", b"float64 a\nint32 b\n")
    said = [(BASE + n, "/large", varied(n)) for n in range(600 if number % 2 else 50)]
    said += [(BASE + n, "/mixed", payload(n, many=[n] * (n % 50))) for n in range(60)]
    said += [(BASE + n, "/small", varied(n)[: -1 if n % 4 == 0 else None]) for n in range(40)]
    changed = [b"\0\0\0?" if number == 2 else payload(n) for n in range(30)]
    said += [(BASE + n, "/changed", data) for n, data in enumerate(changed)]
    said += [(BASE + n, "/two", bytes([0] * [8, 12][number % 2])) for n in range(20)]
    said += [(BASE + n, "/json", json.dumps({"n": n}).encode()) for n in range(10)]
    schemas = {
        "/changed": ("ros1", other if number == 2 else STATE),
        "/two": ("ros1", Schema("x/Two", "ros1msg", definitions[number % 2])),
        "/json": ("json", Schema("", "jsonschema", b"{}")),
    }
    return sorted(said, key=lambda one: one[0]), schemas


def folders_of(store: hl.Store) -> list[Path]:
    return sorted(path for path in (store.directory.path / "tables").iterdir() if path.is_dir())


KEYS = ("t", "seq", "recording")


@pytest.mark.parametrize("read", READERS)
def test_readers_count_as_hybridlog_does(many: hl.Store, read: Reader) -> None:
    found = Counter[tuple[str, str]]()
    right = {
        (entry.id, topic): many.query([topic], [entry.id]).count()
        for entry in many.recordings()
        for topic in {channel.topic for channel in entry.channels}
    }
    for folder in folders_of(many):
        for topic in {topic for _, topic in right}:
            rows = read(str(folder / "*.parquet"), KEYS, topic)
            found.update((recording, topic) for _, _, recording in rows)
    assert found == right


def test_each_folder_has_one_schema(many: hl.Store) -> None:
    folders = folders_of(many)
    types = [folder.name.split("~")[0] for folder in folders]
    assert types == ["test_State", "untyped", "x_Other", "x_Two", "x_Two"]  # of two definitions
    for folder in folders:
        schemas = {str(pq.read_schema(path)) for path in folder.iterdir()}
        assert len(schemas) == 1
    assert any(len(list(folder.iterdir())) > 2 for folder in folders)


READ_ON = """
import json, sys
sys.path.insert(0, sys.argv[2])
from tests.tables.test_other_readers import KEYS, READERS
print("ready", flush=True)
for number, _ in enumerate(sys.stdin):
    for again in range(9):
        try:
            rows = READERS[number % 3](sys.argv[1] + "/*.parquet", KEYS, "/a")
            break
        except Exception:  # a file was replaced meanwhile
            continue
    print(json.dumps([recording for _, _, recording in rows]), flush=True)
"""


def test_readings_beside_merges(store: hl.Store, tmp_path: Path) -> None:
    """50 readings while recordings come and go: each has all rows of each recording, or none.

    One that is told of a damaged file asks again.
    """
    said = [(BASE + n, "/a", varied(n)) for n in range(40)]
    log = write_log(tmp_path / "log.mcap", said)
    store.record(log, name="first")
    (folder,) = folders_of(store)
    root = str(Path(__file__).parents[2])
    with subprocess.Popen(
        [sys.executable, "-c", READ_ON, str(folder), root],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as reader:
        assert reader.stdin is not None
        assert reader.stdout is not None
        assert reader.stdout.readline() == "ready\n"
        asked = 0
        for number in range(5):
            reader.stdin.write("\n" * 10)  # it reads while this goes on
            reader.stdin.flush()
            asked += 10
            store.record(log, name=f"more{number}", again=True)
            if number % 3 == 2:
                store.remove(f"more{number - 1}")
        reader.stdin.close()
        found = [json.loads(line) for line in reader.stdout]
    assert len(found) == asked == 50
    first = store.entry("first").id
    seen = set()
    for recordings in found:
        rows = Counter(recordings)
        assert {*rows.values()} == {40}
        assert first in rows
        seen.add(len(rows))
    assert len(seen) > 1


def test_the_command_prints_statements_to_paste(many: hl.Store, tmp_path: Path) -> None:
    """A statement for each type of the topic; together they have all of its rows."""

    def shown(*arguments: str) -> str:
        return answer("info", "--tables", "-t", *arguments, store=many.directory.path).out

    for topic in ("/large", "/small", "/changed", "/two"):
        items = json.loads(shown(topic, "--json"))["tables"]
        assert len(items) == (2 if topic in {"/changed", "/two"} else 1)
        rows = 0
        for item in items:
            found = duckdb.sql(item["statement"])
            assert len(found) == item["rows"]
            rows += len(found)
        assert rows == many.topic(topic).count()
    lines = shown("small").splitlines()
    (statement,) = (line for line in lines if line.startswith("select"))
    assert len(duckdb.sql(statement)) == 160
    one = json.loads(shown("/large", "-r", "1", "--json"))["tables"]
    assert [item["rows"] for item in one] == [600]
    assert [len(duckdb.sql(item["statement"])) for item in one] == [600]
    assert "recording" not in shown("/large")
    place = tmp_path / "it's [1]*?"
    copytree(many.directory.path, place)
    asked = ("info", "--tables", "-t", "/small", "--json")
    (item,) = json.loads(answer(*asked, store=place).out)["tables"]
    assert len(duckdb.sql(item["statement"])) == 160
