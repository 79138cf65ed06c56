"""Columns of the wire reader as Arrow arrays, without copying numbers."""

# Where stubs for pyarrow are installed, they are incomplete for its buffers.
# mypy: disable-error-code="no-any-return, arg-type, call-overload, return-value, assignment"

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pyarrow as pa

from hybridlog.schema.column import Column, Records, Scalars, Strings

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from numpy.typing import NDArray

TIME = pa.timestamp("ns", "UTC")
DURATION = pa.duration("ns")
OFFSET_LIMIT = 2**31 - 1
"""Largest offset of Arrow's plain strings and lists."""


def array_of(column: Column) -> pa.Array[Any]:
    """One chunk's column as an Arrow array of the same nesting.

    Strings and lists of more than 2^31 elements get 64-bit offsets.
    """
    if isinstance(column, Scalars):
        return numbers(column.values, column.kind)
    if isinstance(column, Strings):
        return _strings(column)
    if isinstance(column, Records):
        return records_array(column)
    values = array_of(column.values)
    # Parquet cannot hold lists of a fixed length of 0.
    if column.width and isinstance(column.values, Scalars):
        return pa.FixedSizeListArray.from_arrays(values, column.width)
    return lists(values, column.offset)


def records_array(records: Records) -> pa.StructArray:
    """Records as a struct array, one row for each message."""
    return structs({name: array_of(c) for name, c in records.fields.items()}, records.rows)


def numbers(
    values: NDArray[Any], kind: Literal["number", "time", "duration"] = "number"
) -> pa.Array[Any]:
    """Numbers, booleans or times without nulls."""
    if not (values.flags.c_contiguous and values.flags.aligned):
        values = values.copy()
    array = pa.array(values)
    return array if kind == "number" else array.view({"time": TIME, "duration": DURATION}[kind])


def structs(
    fields: Mapping[str, pa.Array[Any]],
    rows: int,
    missing: NDArray[np.bool_] | None = None,
    kind: Iterable[pa.Field] | None = None,
) -> pa.StructArray:
    """Fields side by side, possibly none; rows are null where `missing` (bool[rows]) is True.

    `kind` has the fields with their metadata; None for plain ones.
    """
    if kind is None:
        kind = [pa.field(name, array.type) for name, array in fields.items()]
    kind = pa.struct(list(kind))
    return pa.Array.from_buffers(kind, rows, [_validity(missing)], children=list(fields.values()))


def lists(
    values: pa.Array[Any], offset: NDArray[np.int64], missing: NDArray[np.bool_] | None = None
) -> pa.Array[Any]:
    """Lists: row i has the values `offset[i]:offset[i + 1]`."""
    if int(offset[-1]) > OFFSET_LIMIT:
        kind, places = pa.large_list(values.type), offset
    else:
        kind, places = pa.list_(values.type), offset.astype(np.int32)
    buffers = [_validity(missing), pa.py_buffer(places)]
    return pa.Array.from_buffers(kind, len(offset) - 1, buffers, children=[values])


def _strings(strings: Strings) -> pa.Array[Any]:
    """Strings, with U+FFFD for what is no UTF-8."""
    low, high = int(strings.offset[0]), int(strings.offset[-1])
    if high - low > OFFSET_LIMIT:
        kind, places = pa.large_binary(), strings.offset - low
    else:
        kind, places = pa.binary(), (strings.offset - low).astype(np.int32)
    data = np.ascontiguousarray(strings.data[low:high])
    buffers = [None, pa.py_buffer(places), pa.py_buffer(data)]
    cells = pa.Array.from_buffers(kind, len(strings), buffers)
    text = pa.string() if kind == pa.binary() else pa.large_string()
    try:
        return cells.cast(text)
    except pa.ArrowInvalid:
        return pa.array([cell.decode(errors="replace") for cell in cells.to_pylist()], text)


def _validity(missing: NDArray[np.bool_] | None) -> pa.Buffer | None:
    """Arrow's bitmap of the valid rows."""
    if missing is None or not missing.any():
        return None
    return pa.py_buffer(np.packbits(~missing, bitorder="little"))
