"""Columns: the fields of many messages, with one array for each field.

The wire reader (`wire.py`) makes them from payloads; BSON documents, Arrow tables and
pandas frames are made from them. No row of a column is a Python object.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, Literal, TypeAlias, TypeVar

import numpy as np
from msgspec import Struct

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from numpy.typing import NDArray


class Scalars(Struct):
    """Numbers, booleans or times.

    Attributes:
        values: shape (n,), native byte order, dtype as on the wire (bool, int8 to
            uint64, float32, float64). Times and durations are int64 nanoseconds.
        kind: Meaning of the numbers.
    """

    values: NDArray[Any]
    kind: Literal["number", "time", "duration"] = "number"

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.values)


class Strings(Struct):
    """Strings as unchanged bytes (UTF-8 is not checked here), without terminating NUL.

    Attributes:
        data: uint8, all strings one after the other, from `offset[0]` to `offset[n]`.
        offset: int64[n + 1].
    """

    data: NDArray[np.uint8]
    offset: NDArray[np.int64]

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.offset) - 1


class Arrays(Struct):
    """Arrays and sequences: row i holds elements `offset[i]:offset[i + 1]` of `values`.

    Attributes:
        values: All elements one after the other.
        offset: int64[n + 1]; offset[0] is 0.
        width: Elements of each row if the definition fixes that number, else None.
    """

    values: Column
    offset: NDArray[np.int64]
    width: int | None = None

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.offset) - 1


class Records(Struct):
    """Nested messages, and the top level itself; columns are in the order of the definition."""

    fields: dict[str, Column]
    rows: int

    def __len__(self) -> int:
        """Number of rows."""
        return self.rows


Column: TypeAlias = Scalars | Strings | Arrays | Records
_T = TypeVar("_T", bound="np.generic")

LONG = 64
"""Mean number of elements from which rows are copied one by one."""


def take(column: Any, rows: NDArray[np.intp] | NDArray[np.int64]) -> Any:
    """Select rows of a column, in the given order."""
    if isinstance(column, Scalars):
        return Scalars(column.values[rows], column.kind)
    if isinstance(column, Records):
        return Records({name: take(c, rows) for name, c in column.fields.items()}, len(rows))
    counts = np.diff(column.offset)[rows]
    start, offset = column.offset[:-1][rows], offsets(counts)
    if isinstance(column, Strings):
        return Strings(pick(column.data, start, counts), offset)
    values = column.values
    if isinstance(values, Scalars):
        picked = Scalars(pick(values.values, start, counts), values.kind)
        return Arrays(picked, offset, column.width)
    return Arrays(take(values, ranges(start, counts)), offset, column.width)


def pick(data: NDArray[_T], start: NDArray[np.int64], count: NDArray[np.int64]) -> NDArray[_T]:
    """Concatenate `data[start[i]:start[i] + count[i]]` for all i: a copy."""
    if int(count.sum()) <= LONG * len(count):
        return data[ranges(start, count)]
    # An index of eight bytes per element would be larger than the elements.
    ends = (start + count).tolist()
    return np.concatenate([data[a:b] for a, b in zip(start.tolist(), ends, strict=True)])


def concatenate(columns: Sequence[Any]) -> Any:
    """Concatenate columns of one type."""
    first = columns[0]
    if isinstance(first, Scalars):
        return Scalars(np.concatenate([column.values for column in columns]), first.kind)
    if isinstance(first, Records):
        fields = {name: concatenate([c.fields[name] for c in columns]) for name in first.fields}
        return Records(fields, sum(column.rows for column in columns))
    offset = offsets(np.concatenate([np.diff(column.offset) for column in columns]))
    if isinstance(first, Strings):
        data = [c.data[int(c.offset[0]) : int(c.offset[-1])] for c in columns]
        return Strings(np.concatenate(data), offset)
    return Arrays(concatenate([column.values for column in columns]), offset, first.width)


def ranges(start: NDArray[np.int64], count: NDArray[np.int64]) -> NDArray[np.intp]:
    """Concatenate the ranges `start[i]` to `start[i] + count[i] - 1`."""
    done = np.cumsum(count) - count
    total = int(count.sum())
    return (np.repeat(start - done, count) + np.arange(total)).astype(np.intp, copy=False)


def offsets(counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Offsets of rows with these numbers of elements: int64[n + 1], starting with 0."""
    result = np.zeros(len(counts) + 1, np.int64)
    np.cumsum(counts, out=result[1:])
    return result


STAMP: Final = "header.stamp"
"""Path of the header stamp in messages that have one."""


def header_stamps(records: Records) -> NDArray[np.int64] | None:
    """The header stamps of decoded messages, ns; None without a header."""
    header = records.fields.get("header")
    stamp = header.fields.get("stamp") if isinstance(header, Records) else None
    return stamp.values if isinstance(stamp, Scalars) and stamp.kind == "time" else None


RESERVED: Final = ("_id", "_meta")
"""Names that no field has in an index document."""


def top_level_names(names: Collection[str]) -> list[str]:
    """Names of the fields in the index document, where `_id` and `_meta` are reserved.

    A field with such a name gets as many trailing underscores as make it unique.
    """
    spelled = []
    for name in names:
        if name in RESERVED:
            while name in names:
                name += "_"  # noqa: PLW2901
        spelled.append(name)
    return spelled
