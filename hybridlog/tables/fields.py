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

from hybridlog.schema.arrow_columns import structs
from hybridlog.schema.arrow_types import (
    COLUMNS,
    WIDENED,
    Array,
    common_type,
    converted,
    is_array,
    is_list,
    lengths_of,
    missing_of,
    summary,
    with_values,
)
from hybridlog.tables.layout import ORIGINAL, RESERVED, column_names

LIMIT: Final = 32
"""Maximum number of elements of an array stored in full."""


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
                return pa.array(np.ones(len(array), np.bool_), mask=missing_of(array))
            return self._struct(array, path, _inner_names)
        if is_array(kind) and self._is_long(array, path):
            return summary(array)
        if is_list(kind):
            values = self._column(array.flatten(), path)
            is_same = pa.types.is_list(kind) and values.type == kind.value_type
            return array if is_same else with_values(array, values)
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
        columns, fields = {}, []
        for number, (name, column) in enumerate(naming([field.name for field in kind])):
            values = self._column(array.field(number), (*path, name))
            columns[column] = values
            fields.append(_named(column, name, values.type))
        if kind == pa.struct(fields) and not any(map(_may_change, fields)):
            self._plain[path] = kind
            return array
        return structs(columns, len(array), missing_of(array), fields)

    def _is_long(self, array: Array, path: tuple[str, ...]) -> bool:
        if self._limit is None:
            return False
        if path not in self._summarised:
            if not len(array) or int(lengths_of(array).max()) <= self._limit:
                return False
            self._summarised.add(path)
        return True


def _may_change(field: Any) -> bool:
    """True if a column may change its type later, or is renamed."""
    kind = field.type
    if field.metadata:
        return True
    if pa.types.is_struct(kind):
        return any(map(_may_change, kind))
    return is_array(kind)


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
        if not any(map(_is_renamed, kind)):
            return columns
        values = {
            original_name(field): records_of(columns.field(number))
            for number, field in enumerate(kind)
        }
        return structs(values, len(columns), missing_of(columns))
    if is_list(kind) and _is_renamed(kind.value_field):
        return with_values(columns, records_of(columns.flatten()))
    return columns


def _is_renamed(field: Any) -> bool:
    """True if the name of a column, or of one inside it, differs from its field's."""
    if original_name(field) != field.name:
        return True
    kind = field.type
    if pa.types.is_struct(kind):
        return any(map(_is_renamed, kind))
    return is_list(kind) and _is_renamed(kind.value_field)


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
    try:
        kind = common_type(pieces, WIDENED if by_type else COLUMNS)
        return [converted(piece, kind) for piece in pieces]
    except (pa.ArrowException, NotImplementedError) as error:
        raise UnfitError(str(error)) from error


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
