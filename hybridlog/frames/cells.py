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


def cells(table: pa.Table) -> list[list[str]]:
    """The rows of a table, a short text for each value; empty for a null."""
    columns = [[_cell(value) for value in column] for column in table.columns]
    return [list(row) for row in zip(*columns, strict=True)]


def _cell(value: pa.Scalar) -> str:
    """A value in few characters."""
    if not value.is_valid:
        return ""
    for applies, shown in _forms():
        if applies(value.type):
            return shown(value)
    return _cut(str(value.as_py()), _MAX_CELL)


@functools.cache
def _forms() -> list[tuple[Callable[[pa.DataType], bool], Callable[[pa.Scalar], str]]]:
    """Tests of a column's type, and how its values are shown."""
    from pyarrow import types

    from hybridlog.query.times import format_duration, format_time

    def is_list(kind: pa.DataType) -> bool:
        return bool(
            types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind)
        )

    def is_binary(kind: pa.DataType) -> bool:
        return bool(types.is_binary(kind) or types.is_large_binary(kind))

    return [
        (types.is_floating, lambda value: f"{value.as_py():.6g}"),
        (types.is_timestamp, lambda value: format_time(_nanoseconds(value))),
        (types.is_duration, lambda value: format_duration(value.value)),
        (types.is_map, _map),
        (is_list, _list),
        (types.is_struct, _struct),
        (is_binary, lambda value: f"{len(value.as_py())} bytes"),
    ]


def _nanoseconds(value: pa.Scalar) -> int:
    import pyarrow as pa

    return int(value.cast(pa.timestamp("ns", value.type.tz)).value)


def _struct(value: pa.Scalar) -> str:
    inside = (f"{name}: {_cell(item)}" for name, item in value.items())
    return _cut("{" + ", ".join(inside) + "}", _MAX_LINE)


def _map(value: pa.Scalar) -> str:
    inside = (f"{_cell(item['key'])}: {_cell(item['value'])}" for item in value.values)
    return _cut("{" + ", ".join(inside) + "}", _MAX_LINE)


def _list(value: pa.Scalar) -> str:
    inner = value.values
    if inner is None or not len(inner):
        return "[]"
    if len(inner) <= _MAX_ITEMS:
        return _cut("[" + ", ".join(_cell(item) for item in inner) + "]", _MAX_LINE)
    first = ", ".join(_cell(inner[i]) for i in range(2))
    return _cut(f"[{first}, … {len(inner)} in all]", _MAX_LINE)


def _cut(text: str, most: int) -> str:
    return text if len(text) <= most else text[: most - 1] + "…"
