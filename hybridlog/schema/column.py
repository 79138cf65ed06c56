"""Columns: the fields of many messages, with one array for each field; summaries of arrays.

The wire reader (`wire.py`) makes them from payloads; BSON documents, Arrow tables and
pandas frames are made from them. No row of a column is a Python object.
"""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final, Literal, TypeAlias, TypeVar

import numpy as np
from msgspec import Struct

from hybridlog.schema.text import nearest

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


Wanted: TypeAlias = "Sequence[tuple[str, ...]] | None"
"""Paths of the fields that are wanted, each with all below it, by names; None for all."""


def names_of(path: str) -> tuple[str, ...]:
    """Names on a dotted path of a field, without brackets."""
    return tuple(path.replace("[]", "").split("."))


def below(wanted: Wanted, name: str) -> Wanted:
    """What is wanted of a field: nothing if it is empty."""
    if wanted is None:
        return None
    rest = [path[1:] for path in wanted if path[0] == name]
    return None if () in rest else rest


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


_LONG_ROW = 4096  # elements of rows that are summed one by one, as of images and clouds


class Summary(Struct):
    """Summaries of the rows of an array column.

    Attributes:
        n: int64[rows], elements, whether finite or not.
        min: shape (rows,), least finite element: int64 for integers and booleans,
            uint64 for uint64, float64 for floats; 0 where `has` is False.
        max: The greatest, in the same form.
        mean: float64[rows], mean of the finite elements; 0 where `has` is False.
        has: bool[rows], whether the row has a finite element at all.
    """

    n: NDArray[np.int64]
    min: NDArray[Any]
    max: NDArray[Any]
    mean: NDArray[np.float64]
    has: NDArray[np.bool_]


def summary_of(values: Sequence[object]) -> Summary | None:
    """The summary of one list of Python numbers and booleans; None of other values."""
    if not all(isinstance(value, int | float) for value in values):
        return None
    numbers: NDArray[Any] = np.array([nearest(value) for value in values], np.float64)  # type: ignore[arg-type]
    if values and not any(isinstance(value, float) for value in values):
        for kind in (np.uint64, np.int64) if min(values) >= 0 else (np.int64,):  # type: ignore[type-var, operator]
            with suppress(OverflowError):
                numbers = np.array(values, kind)
    return summarise(Scalars(numbers), np.array([0, len(numbers)], np.int64))


def summarise(values: Scalars, offset: NDArray[np.int64]) -> Summary:
    """Summarise every row of a ragged array; row i is `values[offset[i]:offset[i + 1]]`.

    The summary of a row depends on its elements alone, to the last bit. Sums of floats use one
    `reduceat`, which adds each segment separately and in the same order. A regular-grid reduction
    is never used, because its order may differ.
    """
    elements = values.values[int(offset[0]) : int(offset[-1])]
    offset = offset - offset[0]
    counts = np.diff(offset)
    if elements.dtype == np.bool_:
        elements = elements.view(np.uint8)
    with np.errstate(all="ignore"):
        if elements.dtype.kind == "f":
            return _floats(elements, offset, counts)
        return _integers(elements, offset[:-1], counts)


def _integers(
    elements: NDArray[Any], start: NDArray[np.int64], counts: NDArray[np.int64]
) -> Summary:
    has = counts > 0
    exact: type[np.generic] = np.uint64 if elements.dtype == np.uint64 else np.int64
    low, high = (np.zeros(len(counts), exact) for _ in range(2))
    mean = np.zeros(len(counts), np.float64)
    if has.any():
        # reduceat would return a neighbour's value for rows without elements.
        begin = start[has]
        low[has] = np.minimum.reduceat(elements, begin)
        high[has] = np.maximum.reduceat(elements, begin)
        if elements.dtype.itemsize == 8:
            # Sums of 64-bit integers could overflow.
            sums = np.add.reduceat(elements.astype(np.float64), begin)
        else:
            sums = _exact_sums(elements, begin, counts[has])
        mean[has] = sums / counts[has]
    return Summary(counts, low, high, mean, has)


def _exact_sums(
    elements: NDArray[Any], begin: NDArray[np.int64], counts: NDArray[np.int64]
) -> NDArray[Any]:
    """Exact sums of segments of integers of at most 32 bits."""
    if elements.dtype.itemsize == 4 or int(counts.mean()) < _LONG_ROW:
        return np.add.reduceat(elements, begin, dtype=np.int64)
    rows = zip(begin.tolist(), (begin + counts).tolist(), strict=True)
    return np.array([elements[first:end].sum() for first, end in rows])


def _floats(
    elements: NDArray[Any], offset: NDArray[np.int64], counts: NDArray[np.int64]
) -> Summary:
    finite = np.isfinite(elements)
    present = counts
    if not finite.all():
        seen = np.concatenate(([0], np.cumsum(finite, dtype=np.int64)))
        offset = seen[offset]
        present = np.diff(offset)
        elements = elements[finite]
    has = present > 0
    low, high, mean = (np.zeros(len(counts), np.float64) for _ in range(3))
    if has.any():
        begin = offset[:-1][has]
        # Adding 0.0 turns -0.0 into 0.0. Otherwise the zero that a reduction returns would
        # depend on the order of comparisons in the processor.
        low[has] = np.minimum.reduceat(elements, begin) + elements.dtype.type(0)
        high[has] = np.maximum.reduceat(elements, begin) + elements.dtype.type(0)
        wide = elements.astype(np.float64, copy=False)
        mean[has] = np.add.reduceat(wide, begin) / present[has] + 0.0
        if not np.isfinite(mean).all():  # no sum of doubles overflows a longer one
            longer = np.add.reduceat(wide, begin, dtype=np.longdouble)
            mean[has] = np.where(np.isfinite(mean[has]), mean[has], longer / present[has])
    return Summary(counts, low, high, mean, has)
