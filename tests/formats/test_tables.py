from __future__ import annotations

import csv
import io
import json
import math
import zipfile
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.feather
import pyarrow.ipc
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybridlog.formats.jsonl import json_column, json_line, write_jsonl
from hybridlog.formats.tables import write_arrow, write_csv, write_npz, write_parquet
from hybridlog.formats.writing import Answer
from hybridlog_storage.errors import UsageError
from tests.limits import Limit

T = 1_425_407_313_123_456_789


def table(rows: int = 3, *, first: int = 0) -> pa.Table:
    """A table of every kind of column; of no rows too, with all types."""
    return _table(max(rows, 3), first=first).slice(0, rows)


def _table(rows: int, *, first: int) -> pa.Table:
    numbers = np.arange(first, first + rows)
    return pa.table(
        {
            "log_time": pa.array(T + numbers, pa.timestamp("ns", "UTC")),
            "x": numbers / 4,
            "f": pa.array(numbers.astype(np.float32)),
            "u": pa.array(numbers.astype(np.uint64) + np.uint64(2**63)),
            "b": numbers % 2 == 0,
            "s": [f'a"b,{number}\né' for number in numbers],
            "v": [[0.5] * (number % 3) for number in numbers.tolist()],
            "m": pa.array([[i, i + 1] for i in numbers.tolist()], pa.list_(pa.int32(), 2)),
            "names": [["p", "q\0r"][: number % 3] for number in numbers.tolist()],
            "o": [{"y": number, "w": {"z": [1]}} for number in numbers.tolist()],
            "d": pa.array(numbers, pa.duration("ns")),
            "raw": [bytes([number % 256]) * 3 for number in numbers.tolist()],
        }
    )


def read_parquet(data: bytes) -> pa.Table:
    return pq.read_table(io.BytesIO(data))


def read_arrow(data: bytes) -> pa.Table:
    return pa.feather.read_table(io.BytesIO(data))


WRITERS = [(write_parquet, read_parquet), (write_arrow, read_arrow)]


def written(writer: object, *pieces: pa.Table, is_fixed: bool = False) -> bytes:
    stream = io.BytesIO()
    writer(Answer(tables=pieces, is_fixed=is_fixed), stream)  # type: ignore[operator]
    return stream.getvalue()


@pytest.mark.parametrize(("writer", "read"), WRITERS)
def test_a_table_comes_back(writer: object, read: object) -> None:
    pieces = [table(100), table(1, first=100), table(0), table(50, first=101)]
    back = read(written(writer, *pieces))  # type: ignore[operator]
    assert back.equals(pa.concat_tables(pieces))


def test_parquet_is_zstd_and_gathers_pieces(tmp_path: Path) -> None:
    path = tmp_path / "out.parquet"
    write_parquet(Answer(tables=(table(10, first=n) for n in range(0, 1000, 10))), path)
    file = pq.ParquetFile(path)
    assert file.metadata.num_rows == 1000
    assert file.metadata.num_row_groups == 1
    assert file.metadata.row_group(0).column(0).compression == "ZSTD"


@pytest.mark.parametrize("held", [1 << 20, 1])
@pytest.mark.parametrize(("writer", "read"), WRITERS)
def test_columns_that_appear_late(writer: object, read: object, held: int, limit: Limit) -> None:
    limit(output_held_bytes=held)
    empty = pa.table({"a": pa.nulls(1)})
    late = pa.table({"a": [0.5], "c": [1]})
    back = read(written(writer, empty, late))  # type: ignore[operator]
    assert back.to_pylist() == [{"a": None, "c": None}, {"a": 0.5, "c": 1}]
    with pytest.raises(UsageError, match="'c' first appears after 2 rows"):
        written(writer, pa.table({"a": [1.0, 2.0]}), late, is_fixed=True)


@pytest.mark.parametrize("writer", [write_parquet, write_arrow, write_csv])
@pytest.mark.parametrize("held", [1 << 20, 1])
def test_types_that_change(writer: object, held: int, limit: Limit) -> None:
    limit(output_held_bytes=held)
    read = dict(zip([write_parquet, write_arrow, write_csv], READS, strict=True))[writer]
    for values in (["x", 1.5], [1.5, (1 << 53) + 1], [-1, (1 << 64) - 1], [True, 1]):
        parts = [
            pa.table({"a": pa.array([v], pa.uint64() if v == (1 << 64) - 1 else None)})
            for v in values
        ]
        assert [json.loads(text) for text in read(written(writer, *parts))] == values


def test_parquet_has_no_statistics_of_floats() -> None:
    import pyarrow.parquet as pq

    data = written(
        write_parquet,
        pa.table(
            {
                "a.b": [1.5, math.nan],
                "i": [1, 2],
                "l": [[1.5], [math.nan]],
                "o": [{"f": 1.5, "s": "x"}, {"f": math.nan, "s": "y"}],
            }
        ),
    )
    group = pq.ParquetFile(io.BytesIO(data)).metadata.row_group(0)
    columns = [group.column(i) for i in range(group.num_columns)]
    assert {c.path_in_schema: c.is_stats_set for c in columns} == {
        "a.b": False,
        "i": True,
        "l.list.element": False,
        "o.f": False,
        "o.s": True,
    }


READS = (
    lambda data: read_parquet(data)["a"].to_pylist(),
    lambda data: read_arrow(data)["a"].to_pylist(),
    lambda data: [row["a"] for row in csv.DictReader(io.StringIO(data.decode(), newline=""))],
)


@pytest.mark.parametrize(("writer", "read"), WRITERS)
def test_no_rows_and_no_pieces(writer: object, read: object) -> None:
    assert read(written(writer, table(0))).schema.equals(table(0).schema)  # type: ignore[operator]
    assert read(written(writer)).num_rows == 0  # type: ignore[operator]


leaf = st.none() | st.integers(-(2**63), 2**63 - 1)
words = st.text(st.characters(exclude_categories=["Cs"]), max_size=5)
nested = st.fixed_dictionaries(
    {
        "i": leaf,
        "f": st.none() | st.floats(),
        "s": st.none() | words,
        "b": st.none() | st.booleans(),
        "v": st.none() | st.lists(st.none() | st.floats(width=32), max_size=3),
        "o": st.none()
        | st.fixed_dictionaries(
            {'k"': leaf, "l": st.lists(st.lists(words, max_size=2), max_size=2)}
        ),
    }
)
SCHEMA = pa.struct(
    {
        "i": pa.int64(),
        "f": pa.float64(),
        "s": pa.string(),
        "b": pa.bool_(),
        "v": pa.list_(pa.float32()),
        "o": pa.struct({'k"': pa.int64(), "l": pa.list_(pa.list_(pa.string()))}),
    }
)


def without_nan(value: object) -> object:
    if isinstance(value, float):
        words = {math.inf: "Infinity", -math.inf: "-Infinity"}
        return "NaN" if math.isnan(value) else words.get(value, value)
    if isinstance(value, dict):
        return {key: without_nan(item) for key, item in value.items()}
    return [without_nan(item) for item in value] if isinstance(value, list) else value


@given(st.lists(nested, max_size=6), st.integers(0, 3))
def test_json_text_is_what_json_reads(rows: list[dict[str, object]], cut: int) -> None:
    array = pa.array(rows, SCHEMA).slice(cut)
    expected = [without_nan(row) for row in rows[cut:]]
    texts = json_column(array).to_pylist()
    for text, want in zip(texts, expected, strict=True):
        assert text is not None
        read = json.loads(text)
        # Single precision is spelled with its own shortest digits.
        for found, wanted in ((read, want),):
            assert isinstance(wanted, dict)
            for got, value in zip(found.pop("v") or [], wanted.pop("v") or [], strict=True):
                if isinstance(value, float):
                    assert np.float32(got) == np.float32(value)
                else:
                    assert got == value
        assert read == want


def test_jsonl() -> None:
    stream = io.BytesIO()
    rows = [
        {"nan": math.nan, "deep": [{"inf": -math.inf, "ok": 1}], "b": True},
        {"big": 2**64 - 1, "bytes": b"abc", "s": "é\ud800\n", "none": None},
    ]
    write_jsonl(Answer(lines=[map(json_line, rows)]), stream)
    lines = stream.getvalue().decode().splitlines()
    assert [json.loads(line, parse_constant=pytest.fail) for line in lines] == [
        {"nan": "NaN", "deep": [{"inf": "-Infinity", "ok": 1}], "b": True},
        {"big": 2**64 - 1, "bytes": "YWJj", "s": "é\ud800\n", "none": None},
    ]
    deep: object = 1
    for _ in range(100_000):
        deep = [deep]
    for value in (deep, [math.nan, deep]):
        with pytest.raises(UsageError):
            json_line({"a": value})


def load(data: bytes) -> dict[str, np.ndarray]:
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        return dict(archive)


def test_npz_nulls_and_late_columns() -> None:
    arrays = load(
        written(
            write_npz,
            pa.table({"a": [1, None], "z": pa.nulls(2)}),
            pa.table(
                {
                    "late": [0.5],
                    "z": ["x"],
                    "m": pa.array([[1.0, None]], pa.list_(pa.float64(), 2)),
                    "t": pa.array([5], pa.timestamp("us")),
                    "o": [{"y": [1]}],
                }
            ),
            pa.table(
                {
                    "a": [3],
                    "m": pa.array([None], pa.list_(pa.float64(), 2)),
                    "o": pa.array([None], pa.struct({"y": pa.list_(pa.int64())})),
                }
            ),
        )
    )
    assert arrays["a"].tolist() == [1, 0, 0, 3]
    assert arrays["a.valid"].tolist() == [True, False, False, True]
    assert arrays["z"].tolist() == ["", "", "x", ""]
    assert arrays["late"].tolist()[2] == 0.5
    assert np.isnan(arrays["late"][[0, 1, 3]]).all()
    assert arrays["m"].shape == (4, 2)
    assert arrays["m"][2, 0] == 1.0
    assert np.isnan(arrays["m"]).sum() == 7
    assert np.isnat(arrays["t"]).tolist() == [True, True, False, True]
    assert arrays["t"][2] == np.datetime64(5, "us")
    assert arrays["o.y.offsets"].tolist() == [0, 0, 0, 1, 1]


def test_npz_names_stay_in_their_place() -> None:
    names = ["../../x", "..\\y", "a/b", "a_b", "v", "v.values", "n\0", ""]
    columns = [pa.array([[1]]) if name == "v" else pa.array([1]) for name in names]
    data = written(write_npz, pa.Table.from_arrays(columns, names=names))
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries = archive.namelist()
    assert len(set(entries)) == len(entries) == len(names) + 1
    assert not any("/" in entry or "\\" in entry for entry in entries)
