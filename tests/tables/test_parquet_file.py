"""Files of tables: damage is found, and others read them."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import hybridlog as hl
from hybridlog.columns.column_file import ColumnFile, ColumnFileWriter
from hybridlog.columns.layout import Section, column_names, shape_folder
from hybridlog_storage.errors import StoreError
from tests.damage import flip

ROWS = 20_000


@pytest.fixture(scope="module")
def table() -> pa.Table:
    dice = np.random.default_rng(3)
    point = pa.StructArray.from_arrays(
        [pa.array(dice.random(ROWS)), pa.array([[n % 7, 2] for n in range(ROWS)])],
        names=["x", "list"],
    )
    return pa.table(
        {
            "t": np.arange(ROWS),
            "x": dice.random(ROWS),
            "point": point,
            "text": ["a"] * ROWS,
            "seq": np.arange(ROWS),
        }
    )


def write(path: Path, table: pa.Table, groups: int = 2) -> Section:
    rows = table.num_rows
    writer = ColumnFileWriter(path, table.schema)
    for _ in range(groups):
        writer.write(table)
    section = Section("id", "/a", {"0": "d"}, rows * groups)
    writer.close([section])
    return section


@pytest.fixture
def path(tmp_path: Path) -> Path:
    place = tmp_path / "1" / "2" / "3"
    place.mkdir(parents=True)
    return place / "a.parquet"


def test_a_flipped_bit_is_found_or_changes_nothing(path: Path, table: pa.Table) -> None:
    """Headers of pages have parts that nobody reads."""
    write(path, table.slice(0, 3000))
    good, right = path.read_bytes(), ColumnFile(path).table()
    footer = len(good) - int.from_bytes(good[-8:-4], "little") - 8
    columns = map(pq.read_metadata(path).row_group(0).column, range(6))
    dice = random.Random(4)
    places = [dice.randrange(footer) for _ in range(150)]
    places += [column.data_page_offset + at for column in columns for at in range(30)]
    found = 0
    for place in places:
        bad = bytearray(good)
        bad[place] ^= 1 << dice.randrange(8)
        path.write_bytes(bad)
        try:
            assert ColumnFile(path).table().equals(right)
        except StoreError:
            found += 1
    assert found > 250
    for place in [footer, *range(footer, len(good), 20), len(good) - 1, len(good) - 5]:
        bad = bytearray(good)
        bad[place] ^= 1 << dice.randrange(8)
        path.write_bytes(bad)
        with pytest.raises(StoreError, match="damaged"):
            ColumnFile(path).check()


def test_a_file_that_is_cut_while_it_is_open(path: Path, table: pa.Table) -> None:
    write(path, table)
    reader = ColumnFile(path)
    with path.open("r+b") as file:
        file.truncate(1000)
    with pytest.raises(StoreError, match="it was replaced"):
        reader.read(1, [1])


def test_parts_of_a_damaged_file_that_are_whole_are_read(path: Path, table: pa.Table) -> None:
    write(path, table)
    flip(path, 2 / 3)
    reader = ColumnFile(path)
    assert reader.read(0, [0]).equals(table.select(["t"]))
    with pytest.raises(StoreError):
        reader.check()


def test_a_foreign_file_is_no_table(path: Path, table: pa.Table) -> None:
    pq.write_table(table, path)
    with pytest.raises(StoreError, match="checksum of its footer differs"):
        ColumnFile(path)
    with pytest.raises(FileNotFoundError):
        ColumnFile(path.with_name("other.parquet"))
    path.unlink()
    path.mkdir()
    with pytest.raises(StoreError):
        ColumnFile(path)


def test_encodings(recorded: hl.Store) -> None:
    (path,) = (recorded.directory.path / "tables").glob("*/*.parquet")
    group = pq.read_metadata(path).row_group(0)
    found = {c.path_in_schema: c for c in map(group.column, range(group.num_columns))}
    for name in ("t", "log_time", "seq", "pub", "stamp", "header.seq", "header.stamp", "ref.off"):
        assert "DELTA_BINARY_PACKED" in found[name].encodings, name
    for name in ("state", "channel", "header.frame_id", "i8"):
        assert "RLE_DICTIONARY" in found[name].encodings, name
    assert {column.compression for column in found.values()} == {"ZSTD"}
    # DuckDB 2.0 answers `b > 2.0` wrongly from those of floats with NaN.
    assert found["i8"].statistics.has_min_max
    assert found["f64"].statistics is None


@pytest.mark.parametrize(
    ("names", "columns"),
    [
        (["a", "b"], ["a", "b"]),
        (["a", "A", "a_2"], ["a", "A_3", "a_2"]),
        (["t", "T", "t_"], ["t_2", "T_3", "t_"]),
        (["Seq", "topic", "recording", "error"], ["Seq_", "topic_", "recording_", "error_"]),
        (["log_time", "LOG_TIME"], ["log_time_", "LOG_TIME_2"]),
        (["straße", "STRASSE"], ["straße", "STRASSE_2"]),
    ],
)
def test_names_of_columns(names: list[str], columns: list[str]) -> None:
    assert [column for _, column in column_names(names)] == columns
    assert [name for name, _ in column_names(names)] == names


def test_a_folder_is_named_by_its_exact_schema() -> None:
    inner = pa.struct([("x", pa.float64()), ("y", pa.list_(pa.int8()))])
    columns = [("a", pa.int64()), ("s", inner), ("f", pa.list_(pa.int8(), 3))]
    name = shape_folder("T", pa.schema(columns))
    assert name.startswith("T~")
    assert len(name) == 10
    others = [
        [("b", pa.int64()), *columns[1:]],
        [("a", pa.int32()), *columns[1:]],
        columns[:2],
        [*columns[:2], ("f", pa.list_(pa.int8(), 4))],
        [*columns[:2], ("f", pa.list_(pa.int8()))],
        [columns[0], ("s", pa.struct([("x", pa.float64()), ("y", pa.list_(pa.int16()))]))],
        [pa.field("a", pa.int64(), metadata={b"hybridlog.name": b"A"}), *columns[1:]],
    ]
    names = {shape_folder("T", pa.schema(other)) for other in [columns, *others]}
    assert len(names) == 8
