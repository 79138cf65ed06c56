from __future__ import annotations

import math
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybridlog.frames import answer
from hybridlog.frames.answer import Block, table_of
from hybridlog.frames.frame import frame_of
from hybridlog.schema.arrow_types import (
    common_type,
    converted,
    extremes,
    plain_values,
    records_array,
    values_array,
)
from hybridlog.schema.column import Arrays, Column, Records, Scalars, Strings


def strings(*cells: str | bytes) -> Strings:
    raw = [cell.encode() if isinstance(cell, str) else cell for cell in cells]
    # The first string need not start at the first byte.
    offset = np.cumsum([2, *map(len, raw)]).astype(np.int64)
    return Strings(np.frombuffer(b"??" + b"".join(raw), np.uint8), offset)


def arrays(dtype: str, *cells: list[Any], width: int | None = None) -> Arrays:
    flat = np.array([value for cell in cells for value in cell], dtype)
    return Arrays(Scalars(flat), offsets(cells), width)


def offsets(cells: Any) -> np.ndarray[Any, Any]:
    return np.cumsum([0, *map(len, cells)]).astype(np.int64)


def times(*values: int) -> np.ndarray[Any, Any]:
    return np.array(values, np.int64)


def block(time: Any, seq: Any, records: Records, topic: str = "/t") -> Block:
    return Block(topic, time, seq, {}, records_array(records), 0)


def built(*chunks: tuple[list[int], dict[str, Column]], topics: list[str] | None = None) -> Any:
    blocks, rows = [], 0
    for number, (time, fields) in enumerate(chunks):
        seq = np.arange(rows, rows + len(time))
        topic = "/t" if topics is None else topics[number]
        blocks.append(block(times(*time), seq, Records(fields, len(time)), topic))
        rows += len(time)
    return table_of(blocks)


def nanoseconds(table: pa.Table) -> pa.Table:
    columns = []
    for column in table.columns:
        kind = column.type
        if pa.types.is_timestamp(kind) or pa.types.is_duration(kind):
            kind = pa.int64()
        elif pa.types.is_list(kind) and pa.types.is_timestamp(kind.value_type):
            kind = pa.list_(pa.int64())
        columns.append(column.cast(kind))
    return pa.table(dict(zip(table.column_names, columns, strict=True)))


def test_types_of_columns() -> None:
    """What the values are, the tests of every output say."""
    table = built(
        (
            [1, 2],
            {
                "stamp": Scalars(times(1, 2), "time"),
                "wait": Scalars(times(1, 2), "duration"),
                "name": strings("a", "b"),
                "flag": Scalars(np.array([True, False])),
                "small": Scalars(np.array([1, 2], np.uint8)),
                "cov": arrays("f8", [1, 2], [3, 4], width=2),
                "ranges": arrays("f4", [1.0], []),
                "nothing": Records({}, 2),
            },
        )
    )
    table.validate(full=True)
    assert {name: str(table.schema.field(name).type) for name in table.column_names} == {
        **dict.fromkeys(["log_time", "stamp"], "timestamp[ns, tz=UTC]"),
        "wait": "duration[ns]",
        "name": "string",
        "flag": "bool",
        "small": "uint8",
        "cov": "fixed_size_list<item: double>[2]",
        "ranges": "list<item: float>",
    }
    frame = frame_of(table)
    assert (frame.index.name, str(frame.index.dtype)) == ("log_time", "datetime64[ns, UTC]")
    text = str(pd.Series(["a"]).dtype if pd.__version__ >= "3" else "string")
    assert {name: str(kind) for name, kind in frame.dtypes.items()} == {
        "stamp": "datetime64[ns, UTC]",
        "wait": "timedelta64[ns]",
        "name": text,
        "flag": "bool",
        "small": "uint8",
        "cov": "object",
        "ranges": "object",
    }
    assert all(not cell.flags.writeable for name in ("cov", "ranges") for cell in frame[name])


@given(
    st.lists(st.lists(st.tuples(st.integers(-3, 3), st.integers(0, 2)), max_size=5), max_size=5),
    st.sampled_from([1, 5, 1 << 31]),
)
def test_sorted_by_log_time_then_arrival(chunks: list[list[tuple[int, int]]], limit: int) -> None:
    def fill() -> pa.Table:
        blocks, rows = [], 0
        for chunk in chunks:
            time = times(*(t for t, _ in chunk))
            cells = [[t] * w for t, w in chunk]
            seq = np.arange(rows, rows + len(chunk))
            fields: dict[str, Column] = {
                "n": Scalars(seq),
                "s": strings(*(f"{t}{'x' * w}" for t, w in chunk)),
                "a": arrays("i2", *cells),
                "l": Arrays(strings(*(str(v) for c in cells for v in c)), offsets(cells)),
            }
            blocks.append(block(time, seq, Records(fields, len(chunk))))
            rows += len(chunk)
        return table_of(blocks)

    rows = [(t, n, w) for n, (t, w) in enumerate(pair for chunk in chunks for pair in chunk)]
    rows.sort()
    wanted = [
        {"log_time": t, "n": n, "s": f"{t}{'x' * w}", "a": [t] * w, "l": [str(t)] * w}
        for t, n, w in rows
    ]
    if not chunks:
        wanted = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(answer, "OFFSET_LIMIT", limit)
        table = fill()
        frame = frame_of(fill())
    table.validate(full=True)
    assert nanoseconds(table).to_pylist() == wanted
    assert len(frame) == len(wanted)
    if chunks:
        assert [cell.tolist() for cell in frame["a"]] == [row["a"] for row in wanted]
        assert frame["s"].tolist() == [row["s"] for row in wanted]
        assert [list(cell) for cell in frame["l"]] == [row["l"] for row in wanted]


def test_types_that_change() -> None:
    table = built(
        (
            [1],
            {
                "n": Scalars(np.array([1], "i4")),
                "x": Scalars(np.array([2.5])),
                "a": arrays("i2", [1], width=1),
                "l": arrays("i8", [3, 4]),
                "r": Arrays(Records({"p": Scalars(times(1))}, 1), times(0, 1)),
            },
        ),
        (
            [2, 3],
            {
                "n": Scalars(np.array([1.5, 2.5], "f4")),
                "x": strings("hello", "you"),
                "a": arrays("f4", [1.5], [2.5, 3.5]),
                "l": Arrays(strings("s", "t"), times(0, 1, 2)),
                "r": Arrays(
                    Records({"p": Scalars(times(1, 2)), "q": strings("u", "v")}, 2), times(0, 1, 2)
                ),
            },
        ),
        ([4], {"x": Scalars(np.array([True])), "l": arrays("i8", [9])}),
    )
    table.validate(full=True)
    got = table.drop_columns("log_time").to_pydict()
    assert table.schema.field("n").type == pa.float64()
    assert table.schema.field("a").type == pa.list_(pa.float64())
    assert got["n"] == [1.0, 1.5, 2.5, None]
    assert got["x"] == ["2.5", '"hello"', '"you"', "true"]
    assert table.schema.field("x").type == pa.json_()
    assert got["a"] == [[1.0], [1.5], [2.5, 3.5], None]
    assert got["l"] == [["3", "4"], ['"s"'], ['"t"'], ["9"]]
    assert got["r"] == [
        [{"p": 1, "q": None}],
        [{"p": 1, "q": "u"}],
        [{"p": 2, "q": "v"}],
        None,
    ]


def test_text_is_repaired_and_nul_kept() -> None:
    cells = [b"ok", b"\xff\xfe", b"a\xc3", b"\xa9b", "é\0".encode(), b""]
    table = built(([1] * 6, {"s": strings(*cells)}))
    table.validate(full=True)
    assert table["s"].to_pylist() == [cell.decode("utf-8", "replace") for cell in cells]


def test_names_that_clash() -> None:
    inner = Records({"b": Scalars(times(2))}, 1)
    table = built(([1], {"a.b": Scalars(times(1)), "a": inner, "log_time": Scalars(times(3))}))
    assert table.drop_columns("log_time").to_pydict() == {"a.b": [1], "a.b_": [2], "log_time_": [3]}
    assert table.schema.field("log_time_").metadata == {b"hybridlog.field": b"log_time"}


def test_topics_of_different_types_have_columns_of_their_own() -> None:
    inner = Records({"x": Scalars(np.array([1.5]))}, 1)
    chunks: tuple[tuple[list[int], dict[str, Column]], ...] = (
        ([1], {"pose": inner, "n": Scalars(np.array([1]))}),
        ([2], {"pose": Scalars(np.array([7])), "n": Scalars(np.array([(1 << 64) - 1], "u8"))}),
    )
    table = built(*chunks, topics=["/a", "/b"])
    assert table.drop_columns("log_time").to_pydict() == {
        "pose.x": [1.5, None],
        "n": [1, (1 << 64) - 1],
        "pose": [None, 7],
    }
    assert table.schema.field("n").type == pa.uint64()
    table = built(*chunks)
    assert table["pose"].to_pylist() == ['{"x":1.5}', "7"]


@pytest.mark.parametrize(
    ("one", "other", "kind"),
    [
        ("i1", "u1", pa.int64()),
        ("u4", "i2", pa.int64()),
        ("u2", "u8", pa.uint64()),
        ("i8", "u8", pa.int64()),
        ("f4", "i2", pa.float64()),
        ("f4", "i4", pa.float64()),
        ("f4", "f8", pa.float64()),
        ("?", "u1", pa.json_()),
    ],
)
def test_the_common_type_of_numbers(one: str, other: str, kind: pa.DataType) -> None:
    chunks = [([n], {"v": Scalars(np.array([n], dtype))}) for n, dtype in enumerate([one, other])]
    table = built(*chunks)
    assert table.schema.field("v").type == kind


INTEGERS = st.integers(-(1 << 63), (1 << 64) - 1)


@given(st.lists(st.lists(INTEGERS | st.floats(allow_nan=False), min_size=1), min_size=1))
def test_no_number_is_rounded(parts: list[list[float]]) -> None:
    arrays = [values_array(part) for part in parts]
    kind = common_type(arrays)
    found = [value for array in arrays for value in plain_values(converted(array, kind))]
    wanted = [value for part in parts for value in part]
    words = {math.inf: "Infinity", -math.inf: "-Infinity"} if kind == pa.json_() else {}
    assert found == [words.get(value, value) for value in wanted]
    if all(isinstance(value, int) for value in wanted):
        assert not pa.types.is_floating(kind)
    extreme = common_type([extremes(array) for array in arrays])
    assert extreme == kind


def test_extremes_of_nested_arrays() -> None:
    big = pa.array([[{"a": [1, 1 << 60]}], [], None, [{"a": None}]])
    small = pa.array([[{"a": [0.5]}]])
    fixed = pa.array([[1, 1 << 60]], pa.list_(pa.int64(), 2))
    for one, other in ((big, small), (fixed, pa.array([[0.5, 1.5]], pa.list_(pa.float64(), 2)))):
        assert common_type([extremes(one), extremes(other)]) == common_type([one, other])
        assert extremes(one).type == one.type
