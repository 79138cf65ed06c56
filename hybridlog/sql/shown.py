"""Rows of an answer as short texts, and the times that they are about."""

from __future__ import annotations

from typing import Any

import pyarrow as pa

from hybridlog.frames.cells import cells


def shown(table: pa.Table, most: int) -> dict[str, Any]:
    """A table for people, as plain values.

    Args:
        table: Rows of an answer.
        most: Greatest number of columns.

    Returns:
        `columns`, pairs of the name and whether it is a number; `columns_left_out`, their
        number; `rows`, texts; `times`, log time of each row, ns since 1970, and `recordings`,
        the label of its recording: both empty without such columns.
    """
    first = table.select(range(min(table.num_columns, most)))
    return {
        "columns": [[field.name, _is_number(field.type)] for field in first.schema],
        "columns_left_out": table.num_columns - first.num_columns,
        "rows": cells(first),
        "times": _times(table),
        "recordings": _texts(table, "recording"),
    }


def _is_number(kind: pa.DataType) -> bool:
    types = pa.types
    return bool(types.is_integer(kind) or types.is_floating(kind) or types.is_decimal(kind))


def _times(table: pa.Table) -> list[int | None]:
    for name, is_time in (("t", pa.types.is_int64), ("log_time", pa.types.is_timestamp)):
        place = table.schema.get_field_index(name)
        if place >= 0 and is_time(table.schema.field(place).type):
            column = table.column(place)
            if name == "log_time":
                column = column.cast(pa.timestamp("ns", column.type.tz)).cast(pa.int64())
            return list(column.to_pylist())
    return []


def _texts(table: pa.Table, name: str) -> list[str | None]:
    place = table.schema.get_field_index(name)
    if place < 0 or not pa.types.is_string(table.schema.field(place).type):
        return []
    return list(table.column(place).to_pylist())
