"""Rows of an answer as short texts, and the times that they are about."""

from __future__ import annotations

from typing import Any

import pyarrow as pa

from hybridlog.frames.cells import UNITS, cells
from hybridlog.schema.arrow_types import is_number


def shown(table: pa.Table, most: int) -> dict[str, Any]:
    """A table for people, as plain values.

    Args:
        table: Rows of an answer.
        most: Greatest number of columns.

    Returns:
        `columns`, pairs of the name and whether it is a number; `columns_left_out`, their
        number; `rows`, texts; `times`, the log times that each row may be of, ns since 1970
        (timestamps have microseconds), and `recordings`, the label of its recording: both empty
        without such columns.
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
        "recordings": _texts(table, "recording"),
    }


def _times(table: pa.Table) -> list[range | None]:
    found: list[range | None] = []
    for name in ("t", "log_time"):
        place = table.schema.get_field_index(name)
        kind = table.schema.field(place).type if place >= 0 else pa.null()
        if name == "log_time":
            unit = UNITS[kind.unit] if pa.types.is_timestamp(kind) else 0
        else:
            unit = int(pa.types.is_int64(kind))
        if unit:
            values = table.column(place).cast(pa.int64()).to_pylist()
            spans = [None if v is None else range(v * unit, (v + 1) * unit) for v in values]
            pairs = zip(found or spans, spans, strict=True)
            found = [None if a is None or b is None else _common(a, b) for a, b in pairs]
    return found


def _common(one: range, other: range) -> range:
    return range(max(one.start, other.start), min(one.stop, other.stop))


def _texts(table: pa.Table, name: str) -> list[str | None]:
    place = table.schema.get_field_index(name)
    if place < 0 or not pa.types.is_string(table.schema.field(place).type):
        return []
    return list(table.column(place).to_pylist())
