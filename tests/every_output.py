"""Compares what every output says of a topic with other people's decoding, value by value."""

from __future__ import annotations

import csv
import io
import json
import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from mcap.reader import make_reader
from numpy.typing import NDArray
from rosbags.rosbag1 import Reader

from hybridlog.cli.answers import write_answer
from hybridlog.query.query import Query
from tests.ros_values import Duration, Time

OURS = {"log_time", "topic", "log_time_ns"}


def compare_every_output(query: Query, wanted: list[Any], raw: list[bytes], folder: Path) -> None:
    """Ask a query for a topic in all forms.

    Args:
        query: One topic in one recording.
        wanted: Its messages as `plain_of` gives them.
        raw: Their payloads.
        folder: An empty directory for outputs that are files.
    """
    flat = [flattened(message) for message in wanted]
    for table in (query.to_arrow(), parquet(query), arrow_file(query)):
        compare_rows(rows_of(table), flat)
    for count in (1, 3) if flat[0] else ():
        names = sorted(flat[0])[::count]
        chosen = query.fields(*names).to_arrow()
        compare_rows(rows_of(chosen), [{name: row[name] for name in names} for row in flat])
    frame = query.to_pandas()
    assert len(frame) == len(flat)
    if flat[0]:
        cells = frame.itertuples(index=False)
        compare_rows([dict(zip(frame.columns, row, strict=True)) for row in cells], flat)
    lines = [json.loads(line) for line in written(query, "jsonl").decode().splitlines()]
    compare_rows(lines, flat)
    csv.field_size_limit(1 << 30)
    rows = list(csv.DictReader(io.StringIO(written(query, "csv").decode(), newline="")))
    texts = [
        {name: of_cell(cell, want.get(name)) for name, cell in row.items()}
        for row, want in zip(rows, flat, strict=True)
    ]
    compare_rows(texts, flat)
    compare_rows(of_npz(query), flat)
    objects = [message.decode() for message in query]
    assert len(objects) == len(wanted)
    assert [message.raw for message in query] == raw
    compare_exact(query, raw, folder)


def compare_exact(query: Query, raw: list[bytes], folder: Path) -> None:
    """The outputs with whole payloads."""
    mcap = io.BytesIO(written(query, "mcap"))
    found = list(make_reader(mcap).iter_messages())
    assert [message.data for _, _, message in found] == raw
    if found[0][1].message_encoding == "ros1":
        write_answer(query, "bag", folder / "out.bag")
        with Reader(folder / "out.bag") as reader:
            assert [bytes(data) for _, _, data in reader.messages()] == raw
    write_answer(query, "raw", folder / "raw")
    lines = map(json.loads, (folder / "raw" / "index.jsonl").read_text().splitlines())
    assert [(folder / "raw" / line["file"]).read_bytes() for line in lines] == raw


def written(query: Query, form: str) -> bytes:
    """What an output writes."""
    stream = io.BytesIO()
    write_answer(query, form, stream)
    return stream.getvalue()


def parquet(query: Query) -> pa.Table:
    """The Parquet output, read by pyarrow."""
    return pq.read_table(io.BytesIO(written(query, "parquet")))


def arrow_file(query: Query) -> pa.Table:
    """The Arrow output."""
    return pa.ipc.open_file(io.BytesIO(written(query, "arrow"))).read_all()


def flattened(message: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Columns of a message: nested fields joined by dots. A message without fields has none."""
    found: dict[str, Any] = {}
    for name, value in message.items():
        if isinstance(value, dict):
            found |= flattened(value, f"{prefix}{name}.")
        else:
            found[prefix + name] = value
    return found


def rows_of(table: pa.Table) -> list[dict[str, Any]]:
    """The rows of a table."""
    rows: list[dict[str, Any]] = table.to_pylist()
    return rows


def compare_rows(found: list[dict[str, Any]], wanted: list[dict[str, Any]]) -> None:
    """Compare rows by columns, without the columns of ours."""
    assert len(found) == len(wanted)
    for row, want in zip(found, wanted, strict=True):
        own = {name: value for name, value in row.items() if name not in OURS}
        assert own.keys() == want.keys()
        for name, value in want.items():
            assert same(own[name], value), f"{name}: {own[name]!r} instead of {value!r}"


def same(found: Any, wanted: Any) -> bool:
    """True for the same value; texts of numbers that JSON lacks are these numbers."""
    if isinstance(wanted, np.ndarray):
        return same_numbers(found, wanted)
    if isinstance(wanted, list):
        items = list(found)
        return len(items) == len(wanted) and all(map(same, items, wanted))
    if isinstance(wanted, dict):
        return found.keys() == wanted.keys() and all(same(found[k], wanted[k]) for k in wanted)
    if isinstance(wanted, (Time, Duration)):
        if isinstance(found, (pd.Timestamp, pd.Timedelta)):
            return found.value == wanted
        return int(found) == wanted  # also numpy's times, by their nanoseconds
    if isinstance(wanted, (float, np.float32)):
        number = type(wanted)(found)
        if math.isnan(wanted):
            return math.isnan(number)
        return bool(number == wanted) and math.copysign(1, number) == math.copysign(1, wanted)
    if isinstance(wanted, (bool, int)):
        return isinstance(found, (bool, np.bool_)) == isinstance(wanted, bool) and found == wanted
    return bool(found == wanted)


def same_numbers(found: Any, wanted: NDArray[Any]) -> bool:
    """True for the same numbers; a list may have texts in place of what JSON lacks."""
    if len(found) != len(wanted):
        return False
    if not isinstance(found, np.ndarray):
        if wanted.dtype.kind == "f":
            found = np.array([float(value) for value in found], wanted.dtype)
        elif len(found):
            found = np.array(found)
    if len(found) and (found.dtype.kind == "b") != (wanted.dtype.kind == "b"):
        return False
    if len(found) and found.dtype.kind == "f" and wanted.dtype.kind != "f":
        return False
    equal = np.array_equal(found, wanted, equal_nan=wanted.dtype.kind == "f")
    return equal and (wanted.dtype.kind != "f" or same_signs(found, wanted))


def same_signs(found: NDArray[Any], wanted: NDArray[Any]) -> bool:
    """True if also zeros have the same signs."""
    is_number = ~np.isnan(wanted)
    return np.array_equal(np.signbit(found[is_number]), np.signbit(wanted[is_number]))


def of_cell(text: str, wanted: Any) -> Any:
    """A cell of CSV as a value of the type that is expected."""
    if isinstance(wanted, Time):
        return np.datetime64(text.removesuffix("Z").replace(" ", "T"), "ns").astype(np.int64)
    if isinstance(wanted, bool):
        return {"true": True, "false": False}[text]
    if isinstance(wanted, int):
        return int(text)
    if isinstance(wanted, (list, np.ndarray)):
        return json.loads(text)
    return text


def of_npz(query: Query) -> list[dict[str, Any]]:
    """Rows from numpy arrays: lists are values and offsets."""
    arrays = dict(np.load(io.BytesIO(written(query, "npz"))))
    rows = len(arrays["log_time"])
    return _npz_rows({name: a for name, a in arrays.items() if name not in OURS}, rows)


def _npz_rows(arrays: dict[str, Any], rows: int) -> list[dict[str, Any]]:
    columns: dict[str, list[Any]] = {}
    for name, array in arrays.items():
        if ".values" in name:
            continue  # below another one
        if name.endswith(".offsets"):
            own = name.removesuffix(".offsets")
            inner = f"{own}.values"
            total = int(array[-1])
            if inner in arrays:
                values = _numbers(arrays[inner])
            else:
                parts = {k[len(inner) + 1 :]: a for k, a in arrays.items() if k.startswith(inner)}
                values = [_nested(row) for row in _npz_rows(parts, total)]
            at = array.tolist()
            columns[own] = [values[a:b] for a, b in pairwise(at)]
        else:
            columns[name] = list(_numbers(array))
    return [{name: column[row] for name, column in columns.items()} for row in range(rows)]


def _nested(row: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for path, value in row.items():
        *parents, name = path.split(".")
        node = found
        for parent in parents:
            node = node.setdefault(parent, {})
        node[name] = value
    return found


def _numbers(array: NDArray[Any]) -> NDArray[Any]:
    return array.astype(np.int64) if array.dtype.kind in "mM" else array
