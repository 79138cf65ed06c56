"""Columns collected chunk by chunk, whatever becomes of their types on the way.

Each leaf of a message has one accumulator. It takes the columns of each chunk, widens
its type when they ask for it, and counts rows in which the leaf was absent. An
accumulator that cannot take a column is replaced by one that can.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeAlias

import numpy as np

from hybridlog.frames.ragged import Growing, Ragged, RaggedBuilder
from hybridlog.schema.column import Arrays, Column, Records, Scalars, Strings
from hybridlog.schema.utf8 import repaired

if TYPE_CHECKING:
    import pyarrow as pa
    from numpy.typing import NDArray

Kind: TypeAlias = Literal["number", "time", "duration"]


@dataclass(slots=True)
class Values:
    """A finished column of numbers, booleans or times.

    Attributes:
        values: shape (n,); times and durations int64 ns.
        kind: What the numbers mean.
        missing: bool[n], rows without a value; None when there are none.
    """

    values: NDArray[Any]
    kind: Kind
    missing: NDArray[np.bool_] | None


@dataclass(slots=True)
class Text:
    """A finished column of strings: the UTF-8 bytes of each."""

    rows: Ragged


@dataclass(slots=True)
class Lists:
    """A finished column of arrays of numbers.

    Attributes:
        rows: Elements of each row; times and durations int64 ns.
        kind: What the numbers mean.
        width: Elements a row when the definition fixes that number.
    """

    rows: Ragged
    kind: Kind
    width: int | None


@dataclass(slots=True)
class Nested:
    """A finished column of arrays of strings or of messages, held by Arrow."""

    values: pa.ChunkedArray[Any]


Finished: TypeAlias = Values | Text | Lists | Nested


class Accumulator(Protocol):
    """One leaf of a table that is being built."""

    def accepts(self, column: Column) -> bool:
        """Whether `append` can take this column."""
        ...

    def append(self, column: Column) -> None:
        """Add the rows of one chunk."""
        ...

    def skip(self, rows: int) -> None:
        """Add rows in which the leaf is absent."""
        ...

    def finish(self) -> Finished:
        """The column; the accumulator is empty afterwards."""
        ...


def accumulator_for(column: Column, expected: int) -> Accumulator:
    """An empty accumulator that takes a column.

    Args:
        column: Not `Records`, which have leaves of their own.
        expected: Rows that may come, a hint.
    """
    if isinstance(column, Scalars):
        return _Scalars(column, expected)
    if isinstance(column, Strings):
        return _Strings(expected)
    if isinstance(column, Arrays) and isinstance(column.values, Scalars):
        return _Lists(column.values, column.width, expected)
    return _Nested()


def accommodate(current: Accumulator, column: Column) -> Accumulator:
    """An accumulator that holds what `current` held and takes `column`.

    Arrays of different things become arrays of the wider thing if there is one;
    everything else becomes text. `current` is empty afterwards.
    """
    # Text conversion and unification are Arrow's; it is loaded only when they happen.
    from hybridlog.frames.arrow import as_chunked, as_text

    held = as_chunked(current.finish())
    if isinstance(column, Arrays) and _is_list(held):
        return _Nested(held)
    text = _Strings(0)
    text.append_text(as_text(held))
    text.foreign = True
    return text


def _is_list(values: pa.ChunkedArray[Any]) -> bool:
    import pyarrow as pa

    kind = values.type
    return bool(pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind))


class _Absent:
    """Ranges of rows without a value."""

    def __init__(self) -> None:
        self._ranges: list[tuple[int, int]] = []

    def add(self, begin: int, rows: int) -> None:
        end = begin + rows
        if self._ranges and self._ranges[-1][1] == begin:
            begin = self._ranges.pop()[0]
        self._ranges.append((begin, end))

    def mask(self, rows: int) -> NDArray[np.bool_] | None:
        if not self._ranges:
            return None
        mask = np.zeros(rows, np.bool_)
        for begin, end in self._ranges:
            mask[begin:end] = True
        return mask


def _kind(one: Kind, other: Kind) -> Kind:
    """A number of nanoseconds when times meet something else."""
    return one if one == other else "number"


class _Scalars:
    def __init__(self, column: Scalars, expected: int) -> None:
        self._kind: Kind = column.kind
        self._values = Growing(column.values.dtype.newbyteorder("="), expected)
        self._absent = _Absent()

    def accepts(self, column: Column) -> bool:
        return isinstance(column, Scalars)

    def append(self, column: Column) -> None:
        assert isinstance(column, Scalars)
        self._kind = _kind(self._kind, column.kind)
        self._values.promote(np.promote_types(self._values.dtype, column.values.dtype))
        self._values.append(column.values)

    def skip(self, rows: int) -> None:
        self._absent.add(len(self._values), rows)
        self._values.reserve(rows)[...] = 0

    def finish(self) -> Values:
        values = self._values.finish()
        return Values(values, self._kind, self._absent.mask(len(values)))


class _Strings:
    """Strings; after a change of type also the text of whatever else comes."""

    def __init__(self, expected: int) -> None:
        self._rows = RaggedBuilder(np.dtype(np.uint8), expected)
        self._absent = _Absent()
        self.foreign = False

    def accepts(self, column: Column) -> bool:
        return self.foreign or isinstance(column, Strings)

    def append(self, column: Column) -> None:
        if isinstance(column, Strings):
            strings = repaired(column)
            self._rows.append(strings.data, strings.offset)
            return
        from hybridlog.frames.arrow import array_of, as_text

        self.append_text(as_text(array_of(column)))

    def append_text(self, text: tuple[Strings, NDArray[np.bool_]]) -> None:
        """Add strings of which some are absent."""
        strings, absent = text
        for row in np.flatnonzero(absent).tolist():
            self._absent.add(len(self._rows) + row, 1)
        self._rows.append(strings.data, strings.offset)

    def skip(self, rows: int) -> None:
        self._absent.add(len(self._rows), rows)
        self._rows.skip(rows)

    def finish(self) -> Text:
        return Text(_finish(self._rows, self._absent))


class _Lists:
    def __init__(self, values: Scalars, width: int | None, expected: int) -> None:
        self._kind: Kind = values.kind
        self._width = width
        self._rows = RaggedBuilder(values.values.dtype.newbyteorder("="), expected)
        self._absent = _Absent()

    def accepts(self, column: Column) -> bool:
        return isinstance(column, Arrays) and isinstance(column.values, Scalars)

    def append(self, column: Column) -> None:
        assert isinstance(column, Arrays)
        assert isinstance(column.values, Scalars)
        values = column.values.values
        # An empty list of JSON has a type by accident.
        if len(values) or not len(self._rows):
            if self._rows.elements:
                self._kind = _kind(self._kind, column.values.kind)
                self._rows.promote(np.promote_types(self._rows.dtype, values.dtype))
            else:
                self._kind = column.values.kind
                self._rows.promote(values.dtype.newbyteorder("="))
        if column.width != self._width:
            self._width = None
        self._rows.append(values, column.offset)

    def skip(self, rows: int) -> None:
        self._absent.add(len(self._rows), rows)
        self._rows.skip(rows)

    def finish(self) -> Lists:
        return Lists(_finish(self._rows, self._absent), self._kind, self._width)


def _finish(rows: RaggedBuilder, absent: _Absent) -> Ragged:
    mask = absent.mask(len(rows))
    finished = rows.finish()
    return finished if mask is None else finished.without(mask)


class _Nested:
    def __init__(self, held: pa.ChunkedArray[Any] | None = None) -> None:
        self._pieces: list[pa.Array[Any]] = [] if held is None else list(held.chunks)

    def accepts(self, column: Column) -> bool:
        return isinstance(column, Arrays)

    def append(self, column: Column) -> None:
        from hybridlog.frames.arrow import array_of

        self._pieces.append(array_of(column))

    def skip(self, rows: int) -> None:
        import pyarrow as pa

        self._pieces.append(pa.nulls(rows))

    def finish(self) -> Nested | Text:
        from hybridlog.frames.arrow import as_text, unified

        pieces, self._pieces = self._pieces, []
        together = unified(pieces)
        if together is not None:
            return Nested(together)
        text = _Strings(0)
        while pieces:
            text.append_text(as_text(pieces.pop(0)))
        return text.finish()


def flatten(records: Records) -> dict[str, Column]:
    """The leaves of records by dotted path, in the order of the definition.

    A path that exists already (only names with dots in them can do that) gets trailing
    underscores. Messages without fields have no leaf.
    """
    leaves: dict[str, Column] = {}
    pending: list[tuple[str, Column]] = list(reversed(records.fields.items()))
    while pending:
        path, column = pending.pop()
        if isinstance(column, Records):
            inner = [(f"{path}.{name}", value) for name, value in column.fields.items()]
            pending.extend(reversed(inner))
            continue
        while path in leaves:
            path += "_"
        leaves[path] = column
    return leaves


def json_text(value: object) -> str:
    """A nested value as compact JSON, for columns that change their type midway."""
    return json.dumps(value, ensure_ascii=False, separators=(",", ":"), default=str)
