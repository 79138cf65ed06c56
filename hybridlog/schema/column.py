"""Columns: the fields of many messages, one array a field.

The wire reader (`wire.py`) turns payloads into these; BSON documents, Arrow tables
and pandas frames are made from them. A column never holds a Python object a row.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, TypeVar, cast

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray


@dataclass(slots=True)
class Scalars:
    """Numbers, booleans or times.

    Attributes:
        values: shape (n,), native byte order, dtype as on the wire (bool, int8 to
            uint64, float32, float64). Times and durations are int64 nanoseconds.
        kind: What the numbers mean.
    """

    values: NDArray[Any]
    kind: Literal["number", "time", "duration"] = "number"

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.values)


@dataclass(slots=True)
class Strings:
    """Strings, as their bytes came (UTF-8 is not checked here), without terminating NUL.

    Attributes:
        data: uint8, all strings one after the other, from `offset[0]` to `offset[n]`.
        offset: int64[n + 1].
    """

    data: NDArray[np.uint8]
    offset: NDArray[np.int64]

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.offset) - 1


@dataclass(slots=True)
class Arrays:
    """Arrays and sequences: row i holds elements `offset[i]:offset[i + 1]` of `values`.

    Attributes:
        values: All elements one after the other.
        offset: int64[n + 1]; offset[0] is 0.
        width: Elements a row when the definition fixes that number, else None.
    """

    values: Column
    offset: NDArray[np.int64]
    width: int | None = None

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.offset) - 1


@dataclass(slots=True)
class Records:
    """Messages within messages, and the top level itself.

    Attributes:
        fields: Column of each field, in the order of the definition.
        rows: Number of rows (a message without fields has rows all the same).
    """

    fields: dict[str, Column]
    rows: int

    def __len__(self) -> int:
        """Number of rows."""
        return self.rows


Column: TypeAlias = Scalars | Strings | Arrays | Records
AnyColumn = TypeVar("AnyColumn", bound=Column)
_T = TypeVar("_T", bound=np.generic)

LONG = 64
"""Mean elements a row from which rows are copied one by one."""


def take(column: AnyColumn, rows: NDArray[np.intp] | NDArray[np.int64]) -> AnyColumn:
    """The chosen rows of a column, in the order chosen."""
    return cast("AnyColumn", _take(column, rows))


def _take(column: Column, rows: NDArray[np.intp] | NDArray[np.int64]) -> Column:
    if isinstance(column, Scalars):
        return Scalars(column.values[rows], column.kind)
    if isinstance(column, Records):
        return Records({name: take(c, rows) for name, c in column.fields.items()}, len(rows))
    counts = np.diff(column.offset)[rows]
    start, offset = column.offset[:-1][rows], offsets(counts)
    if isinstance(column, Strings):
        return Strings(_pick(column.data, start, counts), offset)
    values = column.values
    if isinstance(values, Scalars):
        picked = Scalars(_pick(values.values, start, counts), values.kind)
        return Arrays(picked, offset, column.width)
    return Arrays(_take(values, ranges(start, counts)), offset, column.width)


def _pick(data: NDArray[_T], start: NDArray[np.int64], count: NDArray[np.int64]) -> NDArray[_T]:
    """`data[start[i]:start[i] + count[i]]` of all i, one after the other."""
    if int(count.sum()) <= LONG * len(count):
        return data[ranges(start, count)]
    # An index of eight bytes an element would be larger than what it picks.
    ends = (start + count).tolist()
    return np.concatenate([data[a:b] for a, b in zip(start.tolist(), ends, strict=True)])


def concatenate(columns: Sequence[AnyColumn]) -> AnyColumn:
    """The rows of several columns of one type, one column after the other."""
    return cast("AnyColumn", _concatenate(columns))


def _concatenate(columns: Sequence[Any]) -> Column:
    first = columns[0]
    if isinstance(first, Scalars):
        return Scalars(np.concatenate([column.values for column in columns]), first.kind)
    if isinstance(first, Records):
        fields = {name: _concatenate([c.fields[name] for c in columns]) for name in first.fields}
        return Records(fields, sum(column.rows for column in columns))
    offset = offsets(np.concatenate([np.diff(column.offset) for column in columns]))
    if isinstance(first, Strings):
        data = [c.data[int(c.offset[0]) : int(c.offset[-1])] for c in columns]
        return Strings(np.concatenate(data), offset)
    return Arrays(_concatenate([column.values for column in columns]), offset, first.width)


def ranges(start: NDArray[np.int64], count: NDArray[np.int64]) -> NDArray[np.intp]:
    """All of `start[i]`, `start[i] + 1`, ... `start[i] + count[i] - 1`, one after the other."""
    done = np.cumsum(count) - count
    total = int(count.sum())
    return (np.repeat(start - done, count) + np.arange(total)).astype(np.intp, copy=False)


def offsets(counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Offsets of rows of so many elements each: int64[n + 1], starting with 0."""
    result = np.zeros(len(counts) + 1, np.int64)
    np.cumsum(counts, out=result[1:])
    return result


def flatten(records: Records) -> dict[str, Column]:
    """The leaves of records by dotted path, in the order of the definition.

    A path that exists already (only names with dots in them can do that) gets trailing
    underscores. Messages without fields have no leaf.
    """
    found: dict[str, Column] = {}
    pending: list[tuple[str, Column]] = list(reversed(records.fields.items()))
    while pending:
        path, column = pending.pop()
        if isinstance(column, Records):
            inner = [(f"{path}.{name}", value) for name, value in column.fields.items()]
            pending.extend(reversed(inner))
            continue
        while path in found:
            path += "_"
        found[path] = column
    return found


def header_stamps(records: Records) -> NDArray[np.int64] | None:
    """The header stamps of decoded messages, ns; None when they have no header."""
    header = records.fields.get("header")
    stamp = header.fields.get("stamp") if isinstance(header, Records) else None
    return stamp.values if isinstance(stamp, Scalars) and stamp.kind == "time" else None
