"""Conversion of message fields to columns of a table, and back.

Arrays over the limit become `{n, min, max, mean}`, as in the index; arrays of strings,
bytes and messages become `{n}`. A message without fields becomes a boolean, because Parquet
has no column for it. A column renamed from its field has the field's name in its metadata.
"""

# Where stubs for pyarrow are installed, they are incomplete for its buffers.
# mypy: disable-error-code="no-any-return, arg-type, call-overload, return-value, assignment"

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Any, Final

import numpy as np
import pyarrow as pa

from hybridlog.schema.arrow_types import common_type, converted
from hybridlog.schema.column import Scalars
from hybridlog.schema.summary import summarise
from hybridlog.tables.layout import ORIGINAL, RESERVED, column_names

LIMIT: Final = 32
"""Maximum number of elements of an array stored in full."""
_N: Final = ("n",)
_SUMMARY: Final = ("n", "min", "max", "mean")

Array = Any
"""An Arrow array. Its stubs differ too much between versions to be useful here."""


class UnfitError(Exception):
    """Messages whose fields have no common type."""


class FieldShape:
    """Turns fields of one topic's messages into columns, consistently.

    Once an array was too long, all later ones become summaries.

    Args:
        limit: Most elements of an array that is kept in full; None for no limit.
        reserved: Names that no field may have.
    """

    def __init__(self, limit: int | None = LIMIT, reserved: Collection[str] = RESERVED) -> None:
        self._limit = limit
        self._reserved = reserved
        self._summarised: set[tuple[str, ...]] = set()
        self._plain: dict[tuple[str, ...], Any] = {}

    def columns(self, records: Array) -> Array:
        """Fields as columns.

        Args:
            records: Messages, a struct each.

        Returns:
            A struct array; its fields are the columns.
        """
        return self._struct(records, (), self._outer_names)

    def _outer_names(self, names: list[str]) -> Iterator[tuple[str, str]]:
        return column_names(names, self._reserved)

    def _column(self, array: Array, path: tuple[str, ...]) -> Array:
        kind = array.type
        if pa.types.is_struct(kind):
            if kind.num_fields == 0:
                present = np.ones(len(array), np.bool_)
                return pa.array(present, mask=array.is_null().to_numpy(zero_copy_only=False))
            return self._struct(array, path, _inner_names)
        if _is_list(kind):
            if self._is_long(array, path):
                return _summary(array)
            values = self._column(_elements(array), path)
            return _with_elements(array, values, plain=True)
        if pa.types.is_binary(kind) or pa.types.is_large_binary(kind):
            return _bytes_summary(array) if self._is_long(array, path) else array
        return array

    def _struct(
        self,
        array: Array,
        path: tuple[str, ...],
        naming: Callable[[list[str]], Iterator[tuple[str, str]]],
    ) -> Array:
        kind = array.type
        if self._plain.get(path) == kind:
            return array
        inner = _fields(kind)
        columns, fields = [], []
        for number, (name, column) in enumerate(naming([field.name for field in inner])):
            values = self._column(array.field(number), (*path, name))
            columns.append(values)
            fields.append(_named(column, name, values.type))
        if kind == pa.struct(fields) and not any(map(_may_change, fields)):
            self._plain[path] = kind
            return array
        return _struct_of(columns, fields, len(array), _missing(array))

    def _is_long(self, array: Array, path: tuple[str, ...]) -> bool:
        if self._limit is None:
            return False
        if path not in self._summarised:
            if not len(array) or int(_lengths(array).max()) <= self._limit:
                return False
            self._summarised.add(path)
        return True


def _may_change(field: Any) -> bool:
    """True if a column may change its type later, or is renamed."""
    kind = field.type
    if field.metadata:
        return True
    if pa.types.is_struct(kind):
        return any(map(_may_change, _fields(kind)))
    return _is_array(kind)


def _inner_names(names: list[str]) -> Iterator[tuple[str, str]]:
    return column_names(names, ())


def _named(column: str, name: str, kind: Any) -> Any:
    return pa.field(column, kind, metadata={ORIGINAL: name} if column != name else None)


def original_name(field: Any) -> str:
    """Name of the field of a column."""
    name = (field.metadata or {}).get(ORIGINAL)
    return field.name if name is None else name.decode()


def records_of(columns: Array) -> Array:
    """Columns as fields of messages, under the names of the fields.

    Summaries remain summaries.
    """
    kind = columns.type
    if pa.types.is_struct(kind):
        inner = [kind.field(number) for number in range(kind.num_fields)]
        if not any(map(_is_renamed, inner)):
            return columns
        values = [records_of(columns.field(number)) for number in range(kind.num_fields)]
        fields = [
            pa.field(original_name(field), value.type)
            for field, value in zip(inner, values, strict=True)
        ]
        return _struct_of(values, fields, len(columns), _missing(columns))
    if _is_list(kind) and _is_renamed(kind.value_field):
        return _with_elements(columns, records_of(_elements(columns)))
    return columns


def _is_renamed(field: Any) -> bool:
    """True if the name of a column, or of one inside it, differs from its field's."""
    if original_name(field) != field.name:
        return True
    kind = field.type
    if pa.types.is_struct(kind):
        return any(_is_renamed(kind.field(number)) for number in range(kind.num_fields))
    return _is_list(kind) and _is_renamed(kind.value_field)


def joined(pieces: Sequence[Array]) -> Array:
    """Columns joined one after the other, with their common type.

    A column missing from a piece is null there. If one piece has summaries of an array, all
    get summaries. Values without a common exact type become JSON text.

    Raises:
        UnfitError: no common type exists.
    """
    pieces = alike(pieces)
    return pa.concat_arrays(pieces) if len(pieces) > 1 else pieces[0]


def alike(pieces: Sequence[Array], *, by_type: bool = False) -> list[Array]:
    """Columns converted to their common type.

    Args:
        pieces: The columns.
        by_type: True if all values of their types must fit, not only these.

    Raises:
        UnfitError: no common type exists.
    """
    kind = pieces[0].type if pieces else None
    if all(piece.type == kind for piece in pieces):
        return list(pieces)
    kind = _common(pieces, by_type=by_type)
    try:
        return [_as(piece, kind) for piece in pieces]
    except (pa.ArrowException, NotImplementedError) as error:
        raise UnfitError(str(error)) from error


def _common(arrays: Sequence[Array], *, by_type: bool) -> Any:
    """The common type of several arrays."""
    arrays = [array for array in arrays if not pa.types.is_null(array.type)] or [arrays[0]]
    first = arrays[0].type
    if all(array.type == first for array in arrays):
        return first
    kinds = [array.type for array in arrays]
    summaries = [array for array in arrays if is_summary(array.type)]
    if summaries and all(is_summary(kind) or _is_array(kind) for kind in kinds):
        if len(summaries) == len(arrays):
            return _common_struct(arrays, by_type=by_type)
        return _common(
            [array if is_summary(array.type) else summary(array) for array in arrays],
            by_type=by_type,
        )
    if all(map(pa.types.is_struct, kinds)):
        return _common_struct(arrays, by_type=by_type)
    if all(map(_is_list, kinds)):
        return pa.list_(_common([_elements(array) for array in arrays], by_type=by_type))
    if by_type and not _widens(kinds):
        raise UnfitError(f"{', '.join(map(str, kinds))} have no common type")
    return common_type(arrays)


def _common_struct(arrays: Sequence[Array], *, by_type: bool) -> Any:
    fields: dict[str, Any] = {}
    found: dict[str, list[Array]] = {}
    for array in arrays:
        for number, field in enumerate(_fields(array.type)):
            known = fields.setdefault(field.name, field)
            if known.metadata != field.metadata:
                raise UnfitError(f"{field.name} stands for two fields")
            found.setdefault(field.name, []).append(array.field(number))
    return pa.struct(
        [field.with_type(_common(found[name], by_type=by_type)) for name, field in fields.items()]
    )


def _widens(kinds: Sequence[Any]) -> bool:
    """True if all values of some types fit into one of them, or into a wider type."""
    if all(map(pa.types.is_integer, kinds)):
        signed = any(map(pa.types.is_signed_integer, kinds))
        return not (signed and pa.uint64() in kinds)
    texts = (pa.types.is_string, pa.types.is_large_string)
    return all(map(pa.types.is_floating, kinds)) or all(
        any(is_text(kind) for is_text in texts) for kind in kinds
    )


def _as(array: Array, kind: Any) -> Array:
    """Values converted to a type from `_common`."""
    if array.type == kind:
        return array
    if pa.types.is_null(array.type):
        return pa.nulls(len(array), kind)
    if is_summary(kind) and _is_array(array.type):
        return _as(summary(array), kind)
    if pa.types.is_struct(kind) and pa.types.is_struct(array.type):
        names = [field.name for field in _fields(array.type)]
        columns = [
            _as(array.field(names.index(field.name)), field.type)
            if field.name in names
            else pa.nulls(len(array), field.type)
            for field in _fields(kind)
        ]
        return _struct_of(columns, _fields(kind), len(array), _missing(array))
    if _is_list(kind) and _is_list(array.type):
        return _with_elements(array, _as(_elements(array), kind.value_type), plain=True)
    return converted(array, kind)


def summary(array: Array) -> Array:
    """Each array as the summary that tables and the index have of a long one.

    Args:
        array: Lists or bytes.

    Returns:
        `{n, min, max, mean}` of the finite numbers; `{n}` of other elements and of bytes.
    """
    return _summary(array) if _is_list(array.type) else _bytes_summary(array)


def _fields(kind: Any) -> list[Any]:
    return [kind.field(number) for number in range(kind.num_fields)]


def is_summary(kind: Any) -> bool:
    """True for the type of a summary."""
    if not pa.types.is_struct(kind):
        return False
    return tuple(field.name for field in _fields(kind)) in {_N, _SUMMARY}


def _is_array(kind: Any) -> bool:
    return _is_list(kind) or pa.types.is_binary(kind) or pa.types.is_large_binary(kind)


def _is_list(kind: Any) -> bool:
    return (
        pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)
    )


def _missing(array: Array) -> Any:
    """Mask of the null rows, for Arrow; None if no row is null."""
    return array.is_null() if array.null_count else None


def _struct_of(columns: list[Array], fields: list[Any], rows: int, missing: Any) -> Array:
    if not columns:
        return pa.array([{}] * rows, pa.struct([]))
    return pa.StructArray.from_arrays(columns, fields=fields, mask=missing)


def _lengths(array: Array) -> Any:
    """int64[n], number of elements of each row, 0 for null."""
    if pa.types.is_fixed_size_list(array.type):
        lengths = np.full(len(array), array.type.list_size, np.int64)
    else:
        lengths = np.diff(_offsets(array))
    if array.null_count:
        lengths[array.is_null().to_numpy(zero_copy_only=False)] = 0
    return lengths


def _offsets(array: Array) -> Any:
    """int64[n + 1], start of the elements of each row."""
    wide = pa.types.is_large_list(array.type) or pa.types.is_large_binary(array.type)
    dtype = np.dtype(np.int64 if wide else np.int32)
    buffer = array.buffers()[1]
    if buffer is None:
        return np.zeros(len(array) + 1, np.int64)
    found = np.frombuffer(buffer, dtype, len(array) + 1, array.offset * dtype.itemsize)
    return found.astype(np.int64)


def _elements(array: Array) -> Array:
    """Elements of all rows that are not null, one after the other."""
    return array.flatten()


def _with_elements(array: Array, values: Array, *, plain: bool = False) -> Array:
    """Lists of the same lengths with other elements.

    Args:
        array: The lists.
        values: Elements of all rows that are not null.
        plain: True to turn lists of a fixed size into lists of any size.
    """
    is_plain = pa.types.is_list(array.type)
    if values.type == array.type.value_type and (is_plain or not plain):
        return array
    offsets = np.zeros(len(array) + 1, np.int64)
    np.cumsum(_lengths(array), out=offsets[1:])
    large = pa.types.is_large_list(array.type) and not plain
    kind = pa.LargeListArray if large else pa.ListArray
    bounds = pa.array(offsets if large else offsets.astype(np.int32))
    return kind.from_arrays(bounds, values, mask=_missing(array))


def _summary(array: Array) -> Array:
    """Each list as the summary that the index has of a long list."""
    offsets = np.zeros(len(array) + 1, np.int64)
    np.cumsum(_lengths(array), out=offsets[1:])
    numbers = _numbers(_elements(array))
    missing = _missing(array)
    if numbers is None:
        count = pa.array(np.diff(offsets))
        return pa.StructArray.from_arrays([count], names=list(_N), mask=missing)
    values, is_there = numbers
    lengths = np.diff(offsets)
    if is_there is not None:
        seen = np.concatenate(([0], np.cumsum(is_there, dtype=np.int64)))
        values, offsets = values[is_there], seen[offsets]
    found = summarise(Scalars(values), offsets)
    return pa.StructArray.from_arrays(
        [
            pa.array(lengths),
            *(pa.array(part, mask=~found.has) for part in (found.min, found.max, found.mean)),
        ],
        names=list(_SUMMARY),
        mask=missing,
    )


def _numbers(values: Array) -> tuple[Any, Any] | None:
    """Numbers as a numpy array, and the mask of valid ones; None for other types."""
    kind = values.type
    if pa.types.is_timestamp(kind) or pa.types.is_duration(kind):
        values = values.view(pa.int64())
    elif not (pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind)):
        return None
    if not values.null_count:
        return values.to_numpy(zero_copy_only=False), None
    is_there = values.is_valid().to_numpy(zero_copy_only=False)
    return values.fill_null(0).to_numpy(zero_copy_only=False), is_there


def _bytes_summary(array: Array) -> Array:
    count = pa.array(_lengths(array))
    return pa.StructArray.from_arrays([count], names=list(_N), mask=_missing(array))


def detached(array: Array, begin: int, end: int) -> Array:
    """An array that shares no memory with a range of addresses.

    Args:
        array: The array.
        begin: First address of memory that will be reused.
        end: The address after its end.
    """
    if any(b is not None and begin <= b.address < end for b in array.buffers()):
        half = len(array) // 2
        return pa.concat_arrays([array.slice(0, half), array.slice(half)])
    return array


def without(array: Array, rows: Any, total: int) -> Array:
    """Rows at their positions in an array that is null elsewhere.

    Args:
        array: k rows.
        rows: intp[k], their positions, ascending.
        total: Number of rows of the result.
    """
    if len(rows) == total:
        return array
    places = np.zeros(total, np.int64)
    places[rows] = np.arange(len(rows))
    missing = np.ones(total, np.bool_)
    missing[rows] = False
    return array.take(pa.array(places, mask=missing))
