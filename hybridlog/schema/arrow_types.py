"""Arrow arrays: of columns and objects, their kinds, common types, conversion, and summaries.

Columns of the wire reader become arrays without copying numbers. Objects are the exact values of
JSON messages; missing values and null values are both null in Arrow.

A conversion never rounds. Integers become the widest type among them, signed beside unsigned ones
int64. They become doubles only beside fractions and within 2^53. Times beside integers become
integers of nanoseconds. Structs get the fields of all. Values without a common exact type, also
integers beyond 64 bits, become JSON text (`pa.json_()`).
"""

# Where stubs for pyarrow are installed, they are incomplete for its buffers.
# mypy: disable-error-code="no-any-return, arg-type, call-overload, return-value, assignment"

from __future__ import annotations

import base64
import json
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Literal, TypeAlias, cast

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from hybridlog.schema.column import (
    Column,
    Records,
    Scalars,
    Strings,
    Summary,
    Wanted,
    below,
    offsets,
    summarise,
)
from hybridlog.schema.text import MAX_DEPTH, json_text, repaired_text

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from numpy.typing import NDArray

TIME = pa.timestamp("ns", "UTC")
DURATION = pa.duration("ns")
OFFSET_LIMIT = 2**31 - 1
"""Largest offset of Arrow's plain strings and lists."""
EXACT = 1 << 53
"""A double represents every integer up to this one, and not the next."""
MAX_NAMES = 10_000
"""Objects within a message with more different names than this are JSON text."""
_INT64_MAX = (1 << 63) - 1
_SUMMARIES: Final = (("n", "min", "max", "mean"), ("n",))
_types = pa.types
COMPUTED_AS: Final = {pa.float16(): pa.float32()}
"""Types that Arrow and DuckDB cannot compute with, and those that have all their values."""

Array = Any
"""An Arrow array. Its stubs differ too much between versions to be useful here."""
Kinds: TypeAlias = "Sequence[pa.DataType]"
Arrays: TypeAlias = "Sequence[Array]"
_Common: TypeAlias = "Callable[[Arrays], pa.DataType]"


# Columns.


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


# Kinds of types.


def is_list(kind: pa.DataType) -> bool:
    """True if a type is a list, of any length and offset type."""
    return bool(
        _types.is_list(kind) or _types.is_large_list(kind) or _types.is_fixed_size_list(kind)
    )


def is_text(kind: pa.DataType) -> bool:
    """True for strings of any offset type."""
    return bool(_types.is_string(kind) or _types.is_large_string(kind))


def is_bytes(kind: pa.DataType) -> bool:
    """True for bytes, of any length and offset type."""
    return bool(
        _types.is_binary(kind) or _types.is_large_binary(kind) or _types.is_fixed_size_binary(kind)
    )


def is_array(kind: pa.DataType) -> bool:
    """True for lists and bytes, which tables may hold as a summary."""
    return is_list(kind) or is_bytes(kind)


def is_time(kind: pa.DataType) -> bool:
    """True for times and durations."""
    return bool(_types.is_timestamp(kind) or _types.is_duration(kind))


def is_number(kind: pa.DataType) -> bool:
    """True for integers and floats."""
    return bool(_types.is_integer(kind) or _types.is_floating(kind))


def is_numeric(kind: pa.DataType) -> bool:
    """True for numbers and booleans."""
    return is_number(kind) or bool(_types.is_boolean(kind))


def numpy_type(kind: pa.DataType) -> np.dtype[Any]:
    """The type of its values in numpy; `to_pandas_dtype` would need pandas in older pyarrow."""
    return pa.array([], kind).to_numpy(zero_copy_only=False).dtype


def is_summary(kind: pa.DataType) -> bool:
    """True for the type of a summary of an array."""
    return bool(_types.is_struct(kind)) and tuple(f.name for f in kind) in _SUMMARIES


def has_empty(kind: pa.DataType) -> bool:
    """True if a type contains structs without fields."""
    if _types.is_struct(kind):
        return not kind.num_fields or any(has_empty(field.type) for field in kind)
    return is_list(kind) and has_empty(kind.value_type)


# Rows of arrays.


def missing_of(array: Array) -> NDArray[np.bool_] | None:
    """Mask of the null rows of an array; None if there are none."""
    if not array.null_count:
        return None
    return array.is_null().to_numpy(zero_copy_only=False)


def lengths_of(array: Array) -> NDArray[np.int64]:
    """Number of elements, or bytes, of each row; 0 for null rows."""
    lengths = pc.binary_length(array) if is_bytes(array.type) else pc.list_value_length(array)
    if lengths.null_count:
        lengths = pc.fill_null(lengths, 0)
    counts: NDArray[np.int64] = lengths.to_numpy(zero_copy_only=False).astype(np.int64)
    return counts


def bounds_of(array: Array) -> NDArray[np.int64]:
    """int64[n + 1], where the elements of each row begin among those of `flatten()`."""
    return offsets(lengths_of(array))


def with_values(array: Array, values: Array) -> Array:
    """Lists as long as those of a list array, of as many values as its `flatten()` has."""
    return lists(values, bounds_of(array), missing_of(array))


# Common types.


def _exact(kinds: Kinds, arrays: Arrays) -> pa.DataType:
    """The type of values that are neither structs nor lists; JSON text where none is exact."""
    if all(is_number(kind) or is_time(kind) for kind in kinds):
        return _exact_number(kinds, arrays)
    if all(map(is_text, kinds)):
        return pa.large_string()
    return pa.large_binary() if all(map(is_bytes, kinds)) else pa.json_()


def common_type(arrays: Arrays, *, summaries: bool = False) -> pa.DataType:
    """The type that represents the values of all arrays exactly.

    With `summaries`, arrays become summaries beside summaries. A name that stands for two fields
    raises `pa.ArrowInvalid`.
    """
    inner = partial(common_type, summaries=summaries)
    kinds = list(dict.fromkeys(array.type for array in arrays))
    if len(kinds) > 1 and pa.null() in kinds:
        kinds.remove(pa.null())
        arrays = [array for array in arrays if array.type != pa.null()]
    if len(kinds) <= 1:
        return kinds[0] if kinds else pa.null()
    if summaries and _are_summaries(kinds):
        arrays = [array if is_summary(array.type) else summary(array) for array in arrays]
        found = _common_struct(arrays, inner)
    elif all(map(_types.is_struct, kinds)):
        found = _common_struct(arrays, inner)
    elif all(map(is_list, kinds)):
        found = _common_list(kinds, arrays, inner)
    else:
        found = _exact(kinds, arrays)
    if found != pa.json_():
        return found
    # The type of an array without values, such as the elements of empty lists, is irrelevant.
    valued = [array for array in arrays if array.null_count < len(array)]
    return inner(valued) if 0 < len(valued) < len(arrays) else found


def _are_summaries(kinds: Kinds) -> bool:
    """True for types of arrays and of their summaries."""
    return any(map(is_summary, kinds)) and all(is_summary(k) or is_array(k) for k in kinds)


def _common_list(kinds: Kinds, arrays: Arrays, inner: _Common) -> pa.DataType:
    item = inner([array.flatten() for array in arrays])
    sizes = {kind.list_size if _types.is_fixed_size_list(kind) else None for kind in kinds}
    if len(sizes) == 1 and None not in sizes:
        return pa.list_(item, sizes.pop())
    return pa.large_list(item) if any(map(_types.is_large_list, kinds)) else pa.list_(item)


def _common_struct(arrays: Arrays, inner: _Common) -> pa.DataType:
    fields: dict[str, pa.Field] = {}
    children: dict[str, list[Array]] = {}
    for array in arrays:
        for field, child in zip(array.type, array.flatten(), strict=True):
            known = fields.setdefault(field.name, field)
            if (known.metadata or {}) != (field.metadata or {}):  # of JSON text it is empty
                raise pa.ArrowInvalid(f"{field.name} stands for two fields")
            children.setdefault(field.name, []).append(child)
    return pa.struct([field.with_type(inner(children[name])) for name, field in fields.items()])


def _exact_number(kinds: Kinds, arrays: Arrays) -> pa.DataType:
    whole = [kind for kind in kinds if not _types.is_floating(kind)]
    if not whole:
        return pa.float64()
    has_times = any(map(is_time, kinds))
    if has_times and len(whole) == len(kinds):
        return pa.int64() if pa.uint64() not in kinds else pa.json_()
    low, high = _range(array for array in arrays if array.type in whole)
    if len(whole) < len(kinds):
        is_exact = not has_times and low >= -EXACT and high <= EXACT
        return pa.float64() if is_exact else pa.json_()
    if len({_types.is_signed_integer(kind) for kind in kinds}) == 1:
        return max(kinds, key=lambda kind: kind.bit_width)
    if high <= _INT64_MAX:
        return pa.int64()
    return pa.uint64() if low >= 0 else pa.json_()


def _range(arrays: Any) -> tuple[int, int]:
    """Least and greatest integer of some arrays, including zero."""
    ends = [end.as_py() for array in arrays for end in pc.min_max(array).values()]
    known = [0, *(end for end in ends if end is not None)]
    return min(known), max(known)


def common_schema(tables: Iterable[pa.Table]) -> pa.Schema:
    """One schema that represents the values of all tables exactly, columns in first-seen order.

    Each table is released before the next one is taken.
    """
    fields: dict[str, pa.Field] = {}
    seen: dict[str, dict[pa.DataType, Array]] = {}
    for table in tables:
        for field, column in zip(table.schema, table.columns, strict=True):
            fields.setdefault(field.name, field)
            kinds = seen.setdefault(field.name, {field.type: pa.nulls(0, field.type)})
            for chunk in column.chunks:
                before = kinds.get(chunk.type)
                parts = [extremes(chunk), *([] if before is None else [before])]
                kinds[chunk.type] = extremes(pa.concat_arrays(parts))
    return pa.schema(
        [field.with_type(common_type(list(seen[name].values()))) for name, field in fields.items()]
    )


def column_of(table: pa.Table, field: pa.Field) -> pa.ChunkedArray:
    """The values of a table for a field, in its type; null where the table lacks it."""
    place = table.schema.get_field_index(field.name)
    if place < 0:
        return pa.chunked_array([pa.nulls(table.num_rows, field.type)])
    chunks = [converted(chunk, field.type) for chunk in table.column(place).chunks]
    return pa.chunked_array(chunks, field.type)


def extremes(array: Array) -> Array:
    """Two rows that determine the same common type as all rows."""
    kind = array.type
    if _types.is_integer(kind) and len(array):
        found = pc.min_max(array)
        return pa.array([found["min"].as_py(), found["max"].as_py()], kind)
    if _types.is_struct(kind):
        return structs({name: extremes(child) for name, child in fields_in(array)}, 2)
    if _types.is_fixed_size_list(kind):
        inner = extremes(array.flatten()).take(pa.array(np.arange(2 * kind.list_size) % 2))
        return pa.Array.from_buffers(kind, 2, [None], children=[inner])
    if is_list(kind):
        return lists(extremes(array.flatten()), np.array([0, 2, 2])).cast(kind)
    return _example(array)


def _example(array: Array) -> Array:
    """Two rows of the type of an array, one with a value where the array has one."""
    if array.null_count == len(array):
        return pa.nulls(2, array.type)
    valid = int(np.argmax(array.is_valid().to_numpy(zero_copy_only=False)))
    return pa.concat_arrays([array.slice(valid, 1), pa.nulls(1, array.type)])


# Conversion.


def converted(array: Array, kind: pa.DataType, *, drops: bool = False) -> Array:
    """The values of an array in another type that represents them, else `pa.ArrowInvalid`.

    Arrays become summaries where the type is that of summaries. With `drops`, fields of structs
    that the type lacks are left out.
    """
    if array.type == kind:
        return array
    if array.null_count == len(array):
        return pa.nulls(len(array), kind)
    if kind == pa.json_():
        return json_array(plain_values(array))
    if _types.is_struct(kind):
        return _converted_struct(array, kind, drops=drops)
    if is_list(kind) and is_list(array.type):
        made = with_values(array, converted(array.flatten(), kind.value_type, drops=drops))
        return made if made.type == kind else made.cast(kind)
    numeric = all(is_number(one) or is_time(one) for one in (kind, array.type))
    if numeric or any(same(kind) and same(array.type) for same in (is_text, is_bytes)):
        return array.cast(kind)
    raise pa.ArrowInvalid(f"{array.type} is not {kind}")


def _converted_struct(array: Array, kind: pa.DataType, *, drops: bool) -> Array:
    if is_summary(kind) and is_array(array.type):
        array = summary(array)
    if not _types.is_struct(array.type):
        raise pa.ArrowInvalid(f"{array.type} is not {kind}")
    have = dict(fields_in(array))
    if not drops and not {field.name for field in kind} >= have.keys():
        raise pa.ArrowInvalid(f"{array.type} has fields that {kind} lacks")
    children = {
        field.name: converted(have[field.name], field.type, drops=drops)
        if field.name in have
        else pa.nulls(len(array), field.type)
        for field in kind
    }
    return structs(children, len(array), missing_of(array), kind)


def fields_in(array: Array) -> Iterable[tuple[str, Array]]:
    """The fields of structs, each with its name."""
    return zip([field.name for field in array.type], array.flatten(), strict=True)


def plain_values(
    array: Array,
    cells: Callable[[Array], list[Any] | None] = lambda _: None,
    fields: Callable[[Array], Iterable[tuple[str, Array]]] = fields_in,
) -> list[Any]:
    """Values as in JSON, except NaN: times in nanoseconds, bytes in base64.

    Null fields of structs are left out. `cells` returns other cells of an array, or None for these;
    `fields` those of structs, of which two may have one name if only one of them is not null.
    """
    made = cells(array)
    if made is not None:
        return made
    kind = array.type
    if kind == pa.json_():
        texts = array.storage.to_pylist()
        return [None if text is None else json.loads(text) for text in texts]
    if _types.is_struct(kind):
        columns = [(name, plain_values(child, cells, fields)) for name, child in fields(array)]
        names = [name for name, _ in columns]
        values = zip(*(own for _, own in columns), strict=True) if names else [()] * len(array)
        rows = [
            {name: one for name, one in zip(names, row, strict=True) if one is not None}
            for row in values
        ]
        there = array.is_valid().to_pylist()
        return [row if one else None for row, one in zip(rows, there, strict=True)]
    if is_list(kind):
        lengths = lengths_of(array)
        elements = iter(plain_values(_elements(array, int(lengths.sum())), cells, fields))
        counted = zip(lengths.tolist(), array.is_valid().to_pylist(), strict=True)
        return [[next(elements) for _ in range(n)] if there else None for n, there in counted]
    if is_time(kind):
        array = array.cast(pa.int64())
    elif is_bytes(kind):
        found = array.to_pylist()
        return [None if v is None else base64.b64encode(v).decode() for v in found]
    plain: list[Any] = array.to_pylist()
    return plain


def _elements(array: Array, total: int) -> Array:
    """The elements of lists; older pyarrow cannot flatten those of JSON text where one is null."""
    if not _types.is_fixed_size_list(array.type):
        begin, end = array.offsets[0].as_py(), array.offsets[-1].as_py()
        if end - begin == total:
            return array.values.slice(begin, total)
    return array.flatten()


# Summaries.


def summary(array: Array) -> pa.StructArray:
    """Each list, or bytes, as the summary that the index has of a long one.

    It is `{n, min, max, mean}` of the finite numbers; `{n}` of other elements and of bytes.
    """
    found = _summarised(array)
    parts = {"n": pa.array(lengths_of(array))}
    if found is not None:
        values = {"min": found.min, "max": found.max, "mean": found.mean}
        parts |= {name: pa.array(value, mask=~found.has) for name, value in values.items()}
    return structs(parts, len(array), missing_of(array))


def statistic(array: Array, name: str) -> Array | None:
    """`n`, `min`, `max` or `mean` of each summary; None if summaries of such elements lack it."""
    if name == "n":
        return pa.array(lengths_of(array), mask=missing_of(array))
    found = _summarised(array)
    return None if found is None else pa.array(getattr(found, name), mask=~found.has)


def _summarised(array: Array) -> Summary | None:
    """Summaries of numbers, booleans and times, without nulls; None of other elements."""
    if not is_list(array.type):
        return None
    values, bounds = array.flatten(), bounds_of(array)
    if is_time(values.type):
        values = values.view(pa.int64())
    elif not is_numeric(values.type):
        return None
    if values.null_count:
        there = values.is_valid().to_numpy(zero_copy_only=False)
        bounds = np.concatenate(([0], np.cumsum(there, dtype=np.int64)))[bounds]
        values = values.drop_null()
    return summarise(Scalars(values.to_numpy(zero_copy_only=False)), bounds)
