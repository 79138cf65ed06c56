"""Rows of tables as short texts for people to read, and the times that they are about.

Long arrays are shortened.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, Final

import pyarrow as pa
from pyarrow import types

from hybridlog.query.times import format_duration, format_time
from hybridlog.schema.arrow_types import is_bytes, is_list, is_number, numpy_type, time_of_day

MAX_CELL: Final = 40
"""Characters of a text in a table."""
MAX_LINE: Final = 200
"""Characters of a value on lines of its own."""
_MAX_ITEMS: Final = 4
UNITS: Final = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
"""Nanoseconds of the units of timestamps."""


def cells(table: pa.Table, *, exact: bool = False, most: int = MAX_CELL) -> list[list[str]]:
    """The rows of a table, a text for each value, of `most` characters; empty for a null.

    `exact` numbers have all digits that tell them apart, not six.
    """
    columns = [[_cell(value, exact=exact, most=most) for value in each] for each in table.columns]
    return [list(row) for row in zip(*columns, strict=True)]


def _cell(value: pa.Scalar, *, exact: bool, most: int = MAX_CELL) -> str:
    """A value in few characters."""
    if not value.is_valid:
        return ""
    for applies, shown in _forms(exact=exact):
        if applies(value.type):
            return shown(value)
    try:
        return _cut(str(value.as_py()), most)
    except OverflowError:  # DuckDB has infinite dates
        return f"{value.value} days"


@functools.cache
def _forms(
    *, exact: bool
) -> list[tuple[Callable[[pa.DataType], bool], Callable[[pa.Scalar], str]]]:
    """Tests of a column's type, and how its values are shown."""
    return [
        (types.is_floating, _exact if exact else lambda value: f"{value.as_py():.6g}"),
        (types.is_timestamp, _time),
        (types.is_time, time_of_day),
        (types.is_duration, lambda value: format_duration(value.value)),
        (types.is_map, functools.partial(_map, exact=exact)),
        (is_list, functools.partial(_list, exact=exact)),
        (types.is_struct, functools.partial(_struct, exact=exact)),
        (is_bytes, lambda value: f"{len(value.as_py())} bytes"),
    ]


def _exact(value: pa.Scalar) -> str:
    """The shortest digits that give a number back in its type."""
    return str(numpy_type(value.type).type(value.as_py())).removesuffix(".0")


def _time(value: pa.Scalar) -> str:
    ns = value.value * UNITS[value.type.unit]
    try:
        return format_time(ns)
    except OverflowError:  # DuckDB has later years than 9999
        return f"{ns} ns"


def _struct(value: pa.Scalar, *, exact: bool) -> str:
    inside = (f"{name}: {_cell(item, exact=exact)}" for name, item in value.items())
    return _cut("{" + ", ".join(inside) + "}", MAX_LINE)


def _map(value: pa.Scalar, *, exact: bool) -> str:
    inside = (
        f"{_cell(item['key'], exact=exact)}: {_cell(item['value'], exact=exact)}"
        for item in value.values
    )
    return _cut("{" + ", ".join(inside) + "}", MAX_LINE)


def _list(value: pa.Scalar, *, exact: bool) -> str:
    inner = value.values
    if inner is None or not len(inner):
        return "[]"
    if len(inner) <= _MAX_ITEMS:
        return _cut("[" + ", ".join(_cell(item, exact=exact) for item in inner) + "]", MAX_LINE)
    first = ", ".join(_cell(inner[i], exact=exact) for i in range(2))
    return _cut(f"[{first}, … {len(inner)} in all]", MAX_LINE)


def _cut(text: str, most: int) -> str:
    return text if len(text) <= most else text[: most - 1] + "…"


def shown(table: pa.Table, most: int) -> dict[str, Any]:
    """A table for people, as plain values by name.

    `columns` are pairs of the name and whether it is a number, `columns_left_out` their number;
    `rows`, texts; `times`, the log time of each row, ns since 1970, the last one of its microsecond
    where only a timestamp tells it, and `recordings`, the name of its recording: both empty without
    such columns.
    """
    first = table.select(range(min(table.num_columns, most)))
    return {
        "columns": [
            [field.name, is_number(field.type) or pa.types.is_decimal(field.type)]
            for field in first.schema
        ],
        "columns_left_out": table.num_columns - first.num_columns,
        "rows": cells(first, exact=True),
        "times": _times(table),
        "recordings": _values(table, "recording", pa.types.is_string),
    }


def _times(table: pa.Table) -> list[int | None]:
    if found := _values(table, "t", pa.types.is_int64):
        return found
    if not (column := _values(table, "log_time", pa.types.is_timestamp)):
        return []
    unit = UNITS[table.schema.field("log_time").type.unit]
    return [None if value is None else value * unit + unit - 1 for value in column]


def _values(table: pa.Table, name: str, fits: Callable[[pa.DataType], bool]) -> list[Any]:
    """The values of a column, times as integers; none without it, or if its type is another."""
    place = table.schema.get_field_index(name)
    if place < 0 or not fits(table.schema.field(place).type):
        return []
    column = table.column(place)
    if pa.types.is_timestamp(column.type):
        column = column.cast(pa.int64())
    return list(column.to_pylist())
