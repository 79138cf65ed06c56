"""Messages as Arrow arrays: columns of the wire reader, without copying numbers, and objects.

Objects are the exact values of JSON messages. Missing values and null values are both null in
Arrow. A column with one kind of value has that type. A column without a common exact type is JSON
text (`pa.json_()`). Examples are values of different kinds, integers beyond 64 bits, and integers
that a double would round beside fractions.
"""

# Where stubs for pyarrow are installed, they are incomplete for its buffers.
# mypy: disable-error-code="no-any-return, arg-type, call-overload, return-value, assignment"

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np
import pyarrow as pa

from hybridlog.schema.column import Column, Records, Scalars, Strings, Wanted, below, offsets
from hybridlog.schema.text import MAX_DEPTH, json_text, repaired_text

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from numpy.typing import NDArray

TIME = pa.timestamp("ns", "UTC")
DURATION = pa.duration("ns")
OFFSET_LIMIT = 2**31 - 1
"""Largest offset of Arrow's plain strings and lists."""
EXACT = 1 << 53
"""A double represents every integer up to this one, and not the next."""
MAX_NAMES = 10_000
"""Objects within a message with more different names than this are JSON text."""


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


# Python objects.


def objects_array(objects: Sequence[Mapping[str, Any]], wanted: Wanted) -> pa.StructArray:
    """Messages, one a row, as a struct array of the wanted paths; None for all."""
    return cast("pa.StructArray", _structs(objects, wanted, 1))


def values_array(values: Sequence[Any], wanted: Wanted = None, depth: int = 1) -> pa.Array[Any]:
    """Values of any kind as one array, None as null; of objects the wanted paths, None for all.

    There are `depth` levels above these values.
    """
    kinds = {_kind(kind) for kind in set(map(type, values))} - {type(None)}
    array: pa.Array[Any] | None = None
    if not kinds:
        return pa.nulls(len(values))
    if kinds <= {int, float}:
        array = _numbers(values, kinds)
    elif len(kinds) == 1 and depth < MAX_DEPTH:
        kind = kinds.pop()
        if kind is dict:
            array = _structs(values, wanted, depth + 1)
        elif kind is list:
            array = _lists(values, wanted, depth + 1)
        elif kind is str:
            array = pa.array([v and repaired_text(v) for v in values], pa.string())
        elif kind is bool or kind is bytes:
            array = pa.array(values, pa.bool_() if kind is bool else pa.binary())
    return json_array(values) if array is None else array


def times_array(values: Sequence[int | None], kind: str) -> pa.Array[Any]:
    """Times or durations in nanoseconds; JSON text if they exceed 64 bits."""
    try:
        return pa.array(values, pa.int64()).cast(TIME if kind == "time" else DURATION)
    except OverflowError:
        return json_array(values)


def json_array(values: Sequence[Any]) -> pa.Array[Any]:
    """Values as JSON text, with None as null."""
    texts = [None if value is None else json_text(value) for value in values]
    return pa.ExtensionArray.from_storage(pa.json_(), pa.array(texts, pa.string()))


def missing_rows(values: Sequence[object]) -> NDArray[np.bool_] | None:
    """Mask of the rows that are None; None if there are none."""
    if None not in values:
        return None
    return np.fromiter((value is None for value in values), np.bool_, len(values))


def offsets_of(rows: Sequence[Sequence[object] | None]) -> NDArray[np.int64]:
    """Offsets of the elements of each row, int64[n + 1]."""
    return offsets(np.array([0 if row is None else len(row) for row in rows], np.int64))


def _kind(kind: type) -> type:
    """The JSON kind of a Python type: `Int64` of BSON is an integer."""
    for plain in (bool, int, float, str, dict, list, bytes):
        if issubclass(kind, plain):
            return plain
    return kind


def _numbers(values: Sequence[Any], kinds: set[type]) -> pa.Array[Any] | None:
    if float in kinds:
        if any(isinstance(value, int) and abs(value) > EXACT for value in values):
            return None
        return pa.array([None if v is None else float(v) for v in values], pa.float64())
    for kind in (pa.int64(), pa.uint64()):
        with suppress(OverflowError, pa.ArrowInvalid):
            return pa.array(values, kind)
    return None


def _lists(values: Sequence[list[Any] | None], wanted: Wanted, depth: int) -> pa.Array[Any]:
    elements = [element for row in values if row is not None for element in row]
    items = values_array(elements, wanted, depth)
    return lists(items, offsets_of(values), missing_rows(values))


def _structs(
    values: Sequence[Mapping[str, Any] | None], wanted: Wanted, depth: int
) -> pa.Array[Any] | None:
    columns: dict[str, list[Any]] = {}
    for row, value in enumerate(values):
        for name in value or ():
            column = columns.get(name)
            if column is None:
                if below(wanted, name) == []:
                    continue
                column = columns[name] = [None] * len(values)
                if len(columns) > MAX_NAMES and depth > 1:
                    return None
            column[row] = value[name]  # type: ignore[index]
    arrays: dict[str, pa.Array[Any]] = {}
    for name, column in columns.items():
        plain = repaired_text(name)
        while plain in arrays:
            plain += "_"
        arrays[plain] = values_array(column, below(wanted, name), depth)
    return structs(arrays, len(values), missing_rows(values))
