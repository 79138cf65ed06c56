"""Cells of tables in few characters, for people to read; long arrays are shortened."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    import pyarrow as pa

_MAX_CELL: Final = 40
_MAX_LINE: Final = 200
_MAX_ITEMS: Final = 4
UNITS: Final = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
"""Nanoseconds of the units of timestamps."""


def cells(table: pa.Table, *, exact: bool = False) -> list[list[str]]:
    """The rows of a table, a short text for each value; empty for a null.

    Args:
        table: The table.
        exact: Numbers with all digits that tell them apart, not with six.
    """
    columns = [[_cell(value, exact=exact) for value in column] for column in table.columns]
    return [list(row) for row in zip(*columns, strict=True)]


def _cell(value: pa.Scalar, *, exact: bool) -> str:
    """A value in few characters."""
    if not value.is_valid:
        return ""
    for applies, shown in _forms(exact=exact):
        if applies(value.type):
            return shown(value)
    try:
        return _cut(str(value.as_py()), _MAX_CELL)
    except OverflowError:  # DuckDB has infinite dates
        return f"{value.value} days"


@functools.cache
def _forms(
    *, exact: bool
) -> list[tuple[Callable[[pa.DataType], bool], Callable[[pa.Scalar], str]]]:
    """Tests of a column's type, and how its values are shown."""
    from pyarrow import types

    from hybridlog.query.times import format_duration
    from hybridlog.schema.arrow_types import is_bytes, is_list

    return [
        (types.is_floating, _exact if exact else lambda value: f"{value.as_py():.6g}"),
        (types.is_timestamp, _time),
        (types.is_duration, lambda value: format_duration(value.value)),
        (types.is_map, functools.partial(_map, exact=exact)),
        (is_list, functools.partial(_list, exact=exact)),
        (types.is_struct, functools.partial(_struct, exact=exact)),
        (is_bytes, lambda value: f"{len(value.as_py())} bytes"),
    ]


def _exact(value: pa.Scalar) -> str:
    """The shortest digits that give a number back in its type."""
    from hybridlog.schema.arrow_types import numpy_type

    return str(numpy_type(value.type).type(value.as_py())).removesuffix(".0")


def _time(value: pa.Scalar) -> str:
    from hybridlog.query.times import format_time

    ns = value.value * UNITS[value.type.unit]
    try:
        return format_time(ns)
    except OverflowError:  # DuckDB has later years than 9999
        return f"{ns} ns"


def _struct(value: pa.Scalar, *, exact: bool) -> str:
    inside = (f"{name}: {_cell(item, exact=exact)}" for name, item in value.items())
    return _cut("{" + ", ".join(inside) + "}", _MAX_LINE)


def _map(value: pa.Scalar, *, exact: bool) -> str:
    inside = (
        f"{_cell(item['key'], exact=exact)}: {_cell(item['value'], exact=exact)}"
        for item in value.values
    )
    return _cut("{" + ", ".join(inside) + "}", _MAX_LINE)


def _list(value: pa.Scalar, *, exact: bool) -> str:
    inner = value.values
    if inner is None or not len(inner):
        return "[]"
    if len(inner) <= _MAX_ITEMS:
        return _cut("[" + ", ".join(_cell(item, exact=exact) for item in inner) + "]", _MAX_LINE)
    first = ", ".join(_cell(inner[i], exact=exact) for i in range(2))
    return _cut(f"[{first}, … {len(inner)} in all]", _MAX_LINE)


def _cut(text: str, most: int) -> str:
    return text if len(text) <= most else text[: most - 1] + "…"
