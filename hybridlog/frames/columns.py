"""Nested messages as flat columns: `pose.position.x`."""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from hybridlog.frames.names import is_part, summary_of
from hybridlog.schema.arrow_columns import OFFSET_LIMIT, structs
from hybridlog.schema.arrow_types import (
    has_empty,
    is_array,
    is_list,
    is_time,
    missing_of,
    statistic,
    with_values,
)

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping

    from numpy.typing import NDArray

_types = pa.types


def flat(records: pa.StructArray) -> dict[str, pa.Array[Any]]:
    """The leaves of messages by dotted path, in the order of the definition.

    Fields of a null message are null. A message without fields has no leaf. A duplicate path,
    which only names with dots can cause, gets underscores.
    """
    leaves: dict[str, pa.Array[Any]] = {}
    pending = _children("", records)
    while pending:
        path, array = pending.pop()
        if _types.is_struct(array.type):
            pending.extend(_children(f"{path}.", array))
            continue
        while path in leaves:
            path += "_"
        leaves[path] = _with_fields(array)
    return leaves


def _children(prefix: str, array: pa.StructArray) -> list[tuple[str, pa.Array[Any]]]:
    """The fields of a struct array, last first."""
    names = (prefix + field.name for field in array.type)
    return list(zip(names, array.flatten(), strict=True))[::-1]


def _with_fields(array: pa.Array[Any]) -> pa.Array[Any]:
    """The array with `true` for messages without fields, which few formats support."""
    if not has_empty(array.type):
        return array
    if is_list(array.type):
        return with_values(array, _with_fields(array.flatten()))
    missing = missing_of(array)
    if not array.type.num_fields:
        return pa.array(np.ones(len(array), np.bool_), mask=missing)
    children = zip(array.type, array.flatten(), strict=True)
    return structs({f.name: _with_fields(child) for f, child in children}, len(array), missing)


def leaves_of(
    records: pa.StructArray,
    requested: Collection[str] | None,
    known: Mapping[str, pa.Array[Any]] = MappingProxyType({}),
) -> dict[str, pa.Array[Any]]:
    """The requested leaves of messages, by dotted path, and summaries (`ranges.min`).

    None requests all fields. Fields that were decoded only for others are left out; `known` are
    summaries of arrays that are not there.
    """
    leaves = flat(records)
    if requested is None:
        return leaves
    wanted = [path.replace("[]", "") for path in requested]
    made: dict[str, pa.Array[Any]] = {}
    for path in wanted:
        summary = summary_of(path)
        array = None if summary is None or path in leaves else leaves.get(summary[0])
        if summary is not None and array is not None:
            found = known.get(path, summary_array(array, summary[1]))
            made |= {} if found is None else {path: found}
    asked = [one for one in wanted if one not in made]
    return {
        path: array
        for path, array in leaves.items()
        # A path that is there twice has an underscore.
        if any(is_part(path, one) or is_part(path.rstrip("_"), one) for one in asked)
    } | made


def summary_array(array: pa.Array[Any], what: str) -> pa.Array[Any] | None:
    """One summary of each row; None if the array has no such summary."""
    kind = array.type
    if not is_array(kind):
        return None
    if what != "n" and is_list(kind):
        if _types.is_null(kind.value_type):  # all arrays are empty
            return pa.nulls(len(array), pa.float64())
        if is_time(kind.value_type):
            return None
    return statistic(array, what)


def in_order(column: pa.ChunkedArray[Any], order: NDArray[np.intp]) -> pa.ChunkedArray[Any]:
    """The rows of a column in another order.

    Strings and lists with more elements than 32-bit offsets allow are returned in pieces.
    """
    kind = column.type
    size = _elements(column)
    if size <= OFFSET_LIMIT:
        return column.take(pa.array(order))
    wide = column.cast(_large(kind))
    count = max(1, len(order) * (OFFSET_LIMIT // 4) // size)
    pieces: list[pa.Array[Any]] = []
    for begin in range(0, len(order), count):
        part = wide.take(pa.array(order[begin : begin + count]))
        pieces.extend(part.cast(kind).chunks)
    return pa.chunked_array(pieces, type=kind)


def _elements(column: pa.ChunkedArray[Any]) -> int:
    """Maximum number of elements, or bytes, at one level of a column of strings or lists."""
    kind = column.type
    if _types.is_string(kind) or _types.is_binary(kind):
        return sum(pc.sum(pc.binary_length(chunk)).as_py() or 0 for chunk in column.chunks)
    if _types.is_list(kind) or _types.is_fixed_size_list(kind):
        return sum(len(chunk.flatten()) for chunk in column.chunks)
    return 0


def _large(kind: pa.DataType) -> pa.DataType:
    if is_list(kind):
        return pa.large_list(kind.value_type)
    return pa.large_binary() if _types.is_binary(kind) else pa.large_string()


def chunked(arrays: Iterable[pa.Array[Any]], kind: pa.DataType) -> pa.ChunkedArray[Any]:
    """Arrays of one type as one column, without empty pieces."""
    return pa.chunked_array([array for array in arrays if len(array)], type=kind)
