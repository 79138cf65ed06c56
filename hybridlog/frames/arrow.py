"""Columns as Arrow arrays and tables."""

# Where stubs for pyarrow are installed, they know too little of its buffers.
# mypy: disable-error-code="no-any-return, arg-type, call-overload, return-value, assignment"

from __future__ import annotations

from operator import eq, ge, gt, le, lt
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from hybridlog.frames.accumulate import Lists, Nested, Text, Values, json_text
from hybridlog.frames.ragged import Ragged, row_blocks
from hybridlog.schema.column import Arrays, Column, Records, Scalars, Strings
from hybridlog.schema.utf8 import repaired

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from numpy.typing import NDArray

    from hybridlog.frames.accumulate import Finished, Kind

# Arrow's plain strings and lists have int32 offsets; larger columns come in pieces.
OFFSET_LIMIT = 2**31 - 1


def value_type(dtype: np.dtype[Any], kind: Kind) -> pa.DataType:
    """Arrow's type for numbers of a kind."""
    if kind == "time":
        return pa.timestamp("ns", "UTC")
    if kind == "duration":
        return pa.duration("ns")
    return pa.from_numpy_dtype(dtype)


def table_of(columns: Iterable[tuple[str, Finished]]) -> pa.Table:
    """A table of finished columns, each of which is released once it is converted."""
    names, arrays = [], []
    for name, column in columns:
        names.append(name)
        arrays.append(as_chunked(column))
    return pa.Table.from_arrays(arrays, names=names)


def as_chunked(column: Finished) -> pa.ChunkedArray[Any]:
    """A finished column as Arrow holds it; several pieces only past 2^31 elements."""
    if isinstance(column, Nested):
        return column.values
    if isinstance(column, Values):
        kind = value_type(column.values.dtype, column.kind)
        return pa.chunked_array([_numbers(column.values, kind, column.missing)], type=kind)
    if isinstance(column, Text):
        return pa.chunked_array(list(_text_pieces(column.rows)), type=pa.string())
    return lists(column)


def _numbers(
    values: NDArray[Any], kind: pa.DataType, missing: NDArray[np.bool_] | None = None
) -> pa.Array[Any]:
    """Numbers as Arrow, without a copy except for booleans."""
    if pa.types.is_boolean(kind):
        return pa.array(values, kind, mask=missing)
    values = np.ascontiguousarray(values)
    return pa.Array.from_buffers(kind, len(values), [_validity(missing), pa.py_buffer(values)])


def _validity(missing: NDArray[np.bool_] | None) -> pa.Buffer | None:
    """Arrow's bitmap of the rows that are there."""
    if missing is None or not missing.any():
        return None
    return pa.py_buffer(np.packbits(~missing, bitorder="little"))


def _pieces(
    rows: Ragged,
) -> Iterator[tuple[NDArray[Any], NDArray[np.int64], NDArray[np.bool_]]]:
    """Elements, offsets from 0 and missing rows of runs below Arrow's offset limit."""
    length = np.maximum(rows.length, 0)
    offset = np.zeros(len(rows) + 1, np.int64)
    np.cumsum(length, out=offset[1:])
    for begin, end in row_blocks(offset, OFFSET_LIMIT):
        part = rows.take(slice(begin, end))
        yield *part.compact(), part.missing


def _text_pieces(rows: Ragged) -> Iterator[pa.Array[Any]]:
    for data, offset, missing in _pieces(rows):
        yield pa.Array.from_buffers(
            pa.string(),
            len(missing),
            [_validity(missing), pa.py_buffer(offset.astype(np.int32)), _buffer(data)],
        )


def large_text(rows: Ragged) -> pa.ChunkedArray[Any]:
    """Strings with 64-bit offsets, in one piece."""
    data, offset = rows.compact()
    array = pa.Array.from_buffers(
        pa.large_string(),
        len(rows),
        [_validity(rows.missing), pa.py_buffer(offset), _buffer(data)],
    )
    return pa.chunked_array([array], type=pa.large_string())


def compared(column: Strings, order: Callable[[Any, Any], Any], value: str) -> Any:
    """Which strings stand in an order to a value, byte by byte.

    Args:
        column: Valid UTF-8.
        order: One of the five of the module `operator`, `ne` apart.
        value: What they are compared with.

    Returns:
        bool[n].
    """
    compare = {
        eq: pc.equal,
        lt: pc.less,
        le: pc.less_equal,
        gt: pc.greater,
        ge: pc.greater_equal,
    }[order]
    text = large_text(Ragged.from_offsets(column.data, column.offset))
    return compare(text, pa.scalar(value, pa.large_string())).to_numpy()


def _buffer(values: NDArray[Any]) -> pa.Buffer:
    return pa.py_buffer(np.ascontiguousarray(values))


def lists(column: Lists) -> pa.ChunkedArray[Any]:
    """Arrays of numbers: `fixed_size_list` when the definition fixes the width."""
    item = value_type(column.rows.values.dtype, column.kind)
    width = column.width
    kind = pa.list_(item) if width is None else pa.list_(item, width)
    pieces = []
    for values, offset, missing in _pieces(column.rows):
        if width is not None and missing.any():
            # Missing rows of a fixed-size list take their place all the same.
            full = np.zeros((len(missing), width), values.dtype)
            full[~missing] = values.reshape(-1, width)
            values = full.reshape(-1)  # noqa: PLW2901
        pieces.append(_list(kind, _numbers(values, item), offset, missing))
    return pa.chunked_array(pieces, type=kind)


def _list(
    kind: pa.DataType,
    values: pa.Array[Any],
    offset: NDArray[np.int64],
    missing: NDArray[np.bool_] | None = None,
) -> pa.Array[Any]:
    buffers = [_validity(missing)]
    if not pa.types.is_fixed_size_list(kind):
        if pa.types.is_list(kind):
            offset = offset.astype(np.int32)
        buffers.append(pa.py_buffer(offset))
    return pa.Array.from_buffers(kind, len(offset) - 1, buffers, children=[values])


def array_of(column: Column) -> pa.Array[Any]:
    """One chunk's column as an Arrow array, nested as it is.

    A chunk holds less than 2^31 elements, or the list gets 64-bit offsets.
    """
    if isinstance(column, Scalars):
        return _numbers(column.values, value_type(column.values.dtype, column.kind))
    if isinstance(column, Strings):
        strings = repaired(column)
        text = as_chunked(Text(Ragged.from_offsets(strings.data, strings.offset)))
        whole: pa.Array[Any] = pa.concat_arrays(text.chunks)
        return whole
    if isinstance(column, Records):
        fields = {name: array_of(inner) for name, inner in column.fields.items()}
        kind = pa.struct([pa.field(name, inner.type) for name, inner in fields.items()])
        return pa.Array.from_buffers(kind, column.rows, [None], children=list(fields.values()))
    return _arrays(column)


def _arrays(column: Arrays) -> pa.Array[Any]:
    values = array_of(column.values)
    if column.width is not None and isinstance(column.values, Scalars):
        return _list(pa.list_(values.type, column.width), values, column.offset)
    large = int(column.offset[-1]) > OFFSET_LIMIT
    kind = pa.large_list(values.type) if large else pa.list_(values.type)
    return _list(kind, values, column.offset)


def unified(pieces: list[pa.Array[Any]]) -> pa.ChunkedArray[Any] | None:
    """Arrays as one column of the narrowest type that holds them all.

    Returns:
        None when there is no such type.
    """
    if not pieces:
        return pa.chunked_array([pa.nulls(0)])
    together = _cast_alike(pieces)
    if together is None:
        together = _cast_alike([_without_empty_type(piece) for piece in pieces])
    return together


def _cast_alike(pieces: list[pa.Array[Any]]) -> pa.ChunkedArray[Any] | None:
    kinds: list[pa.DataType] = []
    for piece in pieces:
        if piece.type not in kinds:
            kinds.append(piece.type)
    try:
        kind = kinds[0]
        if len(kinds) > 1:
            schemas = [pa.schema([pa.field("v", each)]) for each in kinds]
            kind = pa.unify_schemas(schemas, promote_options="permissive").field("v").type
        return pa.chunked_array([piece.cast(kind) for piece in pieces], type=kind)
    except (pa.ArrowInvalid, pa.ArrowTypeError, pa.ArrowNotImplementedError):
        return None


def _without_empty_type(piece: pa.Array[Any]) -> pa.Array[Any]:
    """Lists that are all empty as lists of nothing: their type was an accident."""
    if not pa.types.is_list(piece.type) or len(piece.flatten()):
        return piece
    missing = piece.is_null().to_numpy(zero_copy_only=False)
    return _list(pa.list_(pa.null()), pa.nulls(0), np.zeros(len(piece) + 1, np.int64), missing)


def as_text(
    values: pa.Array[Any] | pa.ChunkedArray[Any],
) -> tuple[Strings, NDArray[np.bool_]]:
    """Any Arrow column as strings: numbers as Arrow writes them, nested values as JSON.

    Returns:
        The strings, and which rows are absent (their strings are empty).
    """
    if pa.types.is_nested(values.type):
        cells = [None if value is None else json_text(value) for value in values.to_pylist()]
        text = pa.array(cells, pa.large_string())
    else:
        text = values.cast(pa.large_string())
    if isinstance(text, pa.ChunkedArray):
        text = text.combine_chunks()
    if isinstance(text, pa.ChunkedArray):
        text = text.chunk(0) if text.num_chunks else pa.array([], pa.large_string())
    absent = np.asarray(pc.is_null(text).to_numpy(zero_copy_only=False), np.bool_)
    _, bounds, data = text.buffers()
    offset = np.frombuffer(bounds, np.int64, len(text) + 1, text.offset * 8).copy()
    raw = np.frombuffer(data, np.uint8) if data is not None else np.empty(0, np.uint8)
    return Strings(raw, offset), absent


def take(column: Finished, order: NDArray[np.intp]) -> Finished:
    """A finished column in another order."""
    if isinstance(column, Values):
        missing = None if column.missing is None else column.missing[order]
        return Values(column.values[order], column.kind, missing)
    if isinstance(column, Nested):
        return Nested(column.values.take(pa.array(order)))
    rows = column.rows.take(order)
    if rows.start.strides != (0,):
        values, offset = rows.compact()
        rows = Ragged(values, offset[:-1], rows.length)
    if isinstance(column, Text):
        return Text(rows)
    return Lists(rows, column.kind, column.width)
