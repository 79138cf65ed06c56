"""Rows of different lengths over one flat array, and arrays that grow at the end."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

# An expected number of rows is a hint from the catalog; memory beyond this is taken as
# rows arrive.
_MOST_RESERVED = 1 << 24
_BLOCK = 1 << 20  # elements gathered at a time: bounds the index array


class Growing:
    """A one-dimensional array that grows at the end."""

    def __init__(self, dtype: np.dtype[Any], expected: int = 0) -> None:
        self._array = np.empty(min(expected, _MOST_RESERVED), dtype)
        self._used = 0

    def __len__(self) -> int:
        return self._used

    @property
    def dtype(self) -> np.dtype[Any]:
        """Of the elements."""
        dtype: np.dtype[Any] = self._array.dtype
        return dtype

    def reserve(self, count: int) -> NDArray[Any]:
        """Lengthen by `count` elements and return them, to be filled at once."""
        need = self._used + count
        if need > len(self._array):
            # In place: large blocks are remapped by the allocator, not copied.
            self._array.resize(max(need, len(self._array) * 3 // 2, 1024), refcheck=False)
        room = self._array[self._used : need]
        self._used = need
        return room

    def append(self, values: NDArray[Any]) -> None:
        """Add values, converted to the element type."""
        self.reserve(len(values))[...] = values

    def promote(self, dtype: np.dtype[Any]) -> None:
        """Change the element type."""
        if dtype != self._array.dtype:
            self._array = self._array[: self._used].astype(dtype)

    def finish(self) -> NDArray[Any]:
        """The array, which this object then no longer owns."""
        array, used = self._array, self._used
        self._array, self._used = np.empty(0, array.dtype), 0
        if len(array) != used:
            array.resize(used, refcheck=False)
        return array


@dataclass(frozen=True, slots=True, eq=False)
class Ragged:
    """Rows of elements: row i is `values[start[i] : start[i] + length[i]]`.

    Rows may lie in any order and may share elements; `start` and `length` may be
    broadcast. Equal rows therefore cost nothing.

    Attributes:
        values: Elements, shape (m,).
        start: int64[n].
        length: int64[n], -1 for a missing row.
    """

    values: NDArray[Any]
    start: NDArray[np.int64]
    length: NDArray[np.int64]

    @classmethod
    def repeated(cls, row: NDArray[Any], rows: int) -> Ragged:
        """The same row many times, held once."""
        return cls(
            row,
            np.broadcast_to(np.int64(0), (rows,)),
            np.broadcast_to(np.int64(len(row)), (rows,)),
        )

    @classmethod
    def regular(cls, values: NDArray[Any], width: int, rows: int) -> Ragged:
        """Rows of one width one after the other."""
        start = np.arange(rows, dtype=np.int64) * width
        return cls(values, start, np.broadcast_to(np.int64(width), (rows,)))

    @classmethod
    def from_offsets(cls, values: NDArray[Any], offset: NDArray[np.int64]) -> Ragged:
        """Rows one after the other; `offset` has n + 1 entries."""
        return cls(values, offset[:-1], np.diff(offset))

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.start)

    def __iter__(self) -> Iterator[NDArray[Any] | None]:
        """Each row as a view, None for a missing one."""
        values = self.values
        for start, length in zip(self.start.tolist(), self.length.tolist(), strict=True):
            yield None if length < 0 else values[start : start + length]

    @property
    def missing(self) -> NDArray[np.bool_]:
        """Which rows are missing, shape (n,)."""
        missing: NDArray[np.bool_] = self.length < 0
        return missing

    @property
    def nbytes(self) -> int:
        """Bytes held; broadcast parts count once."""
        parts = (self.start, self.length)
        rows = sum(part.nbytes if part.strides != (0,) else part.itemsize for part in parts)
        return self.values.nbytes + rows

    def row(self, index: int) -> NDArray[Any] | None:
        """One row as a view, None when it is missing."""
        length = int(self.length[index])
        if length < 0:
            return None
        start = int(self.start[index])
        return self.values[start : start + length]

    def take(self, rows: NDArray[Any] | slice) -> Ragged:
        """The chosen rows, over the same elements."""
        start, length = self.start, self.length
        if len(start) and start.strides == (0,) and length.strides == (0,):
            count = len(np.broadcast_to(np.True_, (len(self),))[rows])
            if count:
                return Ragged(
                    self.values,
                    np.broadcast_to(start[0], (count,)),
                    np.broadcast_to(length[0], (count,)),
                )
        return Ragged(self.values, start[rows], length[rows])

    def without(self, rows: NDArray[np.bool_]) -> Ragged:
        """The same with some rows missing."""
        if not rows.any():
            return self
        return Ragged(self.values, np.where(rows, 0, self.start), np.where(rows, -1, self.length))

    def width(self) -> int | None:
        """Elements a row when all rows have as many (0 without rows), else None."""
        if not len(self):
            return 0
        first = int(self.length[0])
        same = self.length.strides == (0,) or bool((self.length == first).all())
        return first if same and first >= 0 else None

    def stacked(self) -> NDArray[Any] | None:
        """The rows as one array of shape (n, width); a view when they lie evenly spaced.

        Returns:
            None when the rows differ in length or some are missing.
        """
        width = self.width()
        if width is None:
            return None
        rows = len(self)
        if not rows or not width:
            return self.values[:0].reshape(rows, width)
        first = int(self.start[0])
        step = int(self.start[1]) - first if rows > 1 else width
        if rows < 3 or self.start.strides == (0,) or bool((np.diff(self.start) == step).all()):
            size = self.values.itemsize
            stride = self.values.strides[0]
            if stride == size:
                return np.lib.stride_tricks.as_strided(
                    self.values[first:], (rows, width), (step * size, size), writeable=False
                )
        return self.compact()[0].reshape(rows, width)

    def compact(self) -> tuple[NDArray[Any], NDArray[np.int64]]:
        """The rows one after the other; missing rows are empty.

        Returns:
            Elements (a view when they lie so already) and int64[n + 1] offsets from 0.
        """
        length = np.maximum(self.length, 0)
        offset = np.zeros(len(self) + 1, np.int64)
        np.cumsum(length, out=offset[1:])
        total = int(offset[-1])
        if not total:
            return self.values[:0], offset
        first = int(self.start[int(np.argmax(length > 0))])
        if bool(((self.start - offset[:-1] == first) | (length == 0)).all()):
            return self.values[first : first + total], offset
        values = np.empty(total, self.values.dtype)
        width = self.width()
        if width:
            rows = np.lib.stride_tricks.sliding_window_view(self.values, width)
            values.reshape(len(self), width)[...] = rows[self.start]
        else:
            for begin, end in row_blocks(offset, _BLOCK):
                low, high = int(offset[begin]), int(offset[end])
                shift = self.start[begin:end] - offset[begin:end]
                index = np.repeat(shift, length[begin:end]) + np.arange(low, high)
                values[low:high] = self.values[index]
        return values, offset


def row_blocks(offset: NDArray[np.int64], most: int) -> Iterator[tuple[int, int]]:
    """Cut rows into runs of at most `most` elements (a longer row stands alone).

    Args:
        offset: int64[n + 1], ascending.
        most: Elements a run.

    Yields:
        Half-open ranges of rows, in order; one empty range when there are no rows.
    """
    rows = len(offset) - 1
    begin = 0
    while True:
        end = int(np.searchsorted(offset, offset[begin] + most, side="right")) - 1
        end = min(max(end, begin + 1), rows)
        yield begin, end
        begin = end
        if begin >= rows:
            return


class RaggedBuilder:
    """Collects rows chunk by chunk in the cheapest form that holds them.

    As long as all rows are equal, one is kept; as long as they are equally long, no
    offsets are.
    """

    def __init__(self, dtype: np.dtype[Any], expected: int = 0) -> None:
        self._dtype = dtype
        self._expected = expected
        self._rows = 0
        self._one: NDArray[Any] | None = None  # the row that all rows equal
        self._values: Growing | None = None
        self._width = 0
        self._length: Growing | None = None  # None while all rows have `_width` elements

    def __len__(self) -> int:
        return self._rows

    @property
    def dtype(self) -> np.dtype[Any]:
        """Of the elements."""
        return self._dtype

    @property
    def elements(self) -> int:
        """Number of elements so far."""
        if self._values is None:
            return 0 if self._one is None else len(self._one) * self._rows
        return len(self._values)

    def promote(self, dtype: np.dtype[Any]) -> None:
        """Change the element type."""
        self._dtype = dtype
        if self._one is not None:
            self._one = self._one.astype(dtype)
        if self._values is not None:
            self._values.promote(dtype)

    def append(self, values: NDArray[Any], offset: NDArray[np.int64]) -> None:
        """Add rows.

        Args:
            values: Elements.
            offset: int64[n + 1], places of the rows in `values`.
        """
        rows = len(offset) - 1
        if not rows:
            return
        low, high = int(offset[0]), int(offset[-1])
        values = values[low:high]
        if values.dtype != self._dtype:
            values = values.astype(self._dtype)
        width, odd = divmod(high - low, rows)
        # Checked without an array of lengths, since nearly every chunk is even.
        even = not odd and bool(
            (offset == np.arange(low, high + 1, width)).all() if width else low == high
        )
        if self._stays_one(values, rows, width, even=even):
            self._rows += rows
            return
        self._spread(width)
        if self._length is None and not (even and width == self._width):
            self._length = Growing(np.dtype(np.int64), max(self._expected, self._rows))
            self._length.reserve(self._rows)[...] = self._width
        assert self._values is not None
        self._values.append(values)
        if self._length is not None:
            self._length.append(np.diff(offset))
        self._rows += rows

    def skip(self, rows: int) -> None:
        """Add empty rows."""
        self.append(np.empty(0, self._dtype), np.zeros(rows + 1, np.int64))

    def finish(self) -> Ragged:
        """The rows, which this object then no longer owns."""
        if self._values is None:
            one = np.empty(0, self._dtype) if self._one is None else self._one
            return Ragged.repeated(one, self._rows)
        values = self._values.finish()
        if self._length is None:
            return Ragged.regular(values, self._width, self._rows)
        length = self._length.finish()
        return Ragged(values, np.cumsum(length) - length, length)

    def _stays_one(self, values: NDArray[Any], rows: int, width: int, *, even: bool) -> bool:
        if self._values is not None or not even:
            return False
        if self._one is None:
            first = values[:width]
        elif width == len(self._one):
            first = self._one
        else:
            return False
        # By their bits: NaN equals NaN, and -0.0 is not 0.0. Each row is compared with
        # the next, flat, which is several times faster than with one row broadcast.
        bits = np.ascontiguousarray(values).view(f"u{self._dtype.itemsize}")
        if not np.array_equal(bits[:width], first.view(bits.dtype)):
            return False
        if not np.array_equal(bits[width:], bits[: len(bits) - width]):
            return False
        if self._one is None:
            self._one = first.copy()
        return True

    def _spread(self, width: int) -> None:
        """Write out the rows that were one so far."""
        if self._values is not None:
            return
        one, self._one = self._one, None
        self._width = width if one is None else len(one)
        expected = max(self._expected, self._rows) * self._width
        self._values = Growing(self._dtype, expected)
        if one is not None and self._width:
            self._values.reserve(self._rows * self._width).reshape(-1, self._width)[...] = one
