"""Gathers columns from a buffer, and reorders rows of columns."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, cast

import numpy as np

from hybridlog.schema.column import Arrays, Column, Scalars
from hybridlog.schema.definition import Instant, Primitive

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.schema.wire_program import Fixed
    from hybridlog_storage.messages import Buffer

# Bytes from which a single row is a view into the buffer: for fewer, a copy costs less
# than keeping the whole buffer alive.
_VIEW_BYTES = 4096
# Bytes from which rows are copied one by one into a reused buffer: numpy's gathering
# takes new memory from the system, which costs more than the copy.
_LONG_BLOCK = 1 << 12
# Rows of equal length are copied together if that is worth finding them.
_MAX_GROUPS = 32
_ROWS_A_GROUP = 16
# Rows from which a check for equal distances pays.
_EVEN_ROWS = 16


class Source:
    """Reads from a buffer at many positions at once.

    Each gather indexes a view of the buffer with an element at every byte: the elements
    overlap, and only the chosen ones are read. Callers have checked that all positions lie
    within the payloads.
    """

    def __init__(self, buffer: Buffer, order: Literal["<", ">"]) -> None:
        """Read numbers of one byte order (`<` little endian, `>` big endian)."""
        self.buffer = memoryview(buffer).cast("B")
        self.order = order
        self._length = len(self.buffer)
        self._base: NDArray[np.int64] | None = None
        self._stride = 0

    def _gather(
        self, dtype: str | np.dtype[np.generic], size: int, base: NDArray[np.int64], delta: int
    ) -> NDArray[np.generic]:
        if base is not self._base:
            # Many gathers use one base: its stride is computed once.
            self._base, self._stride = base, _even_stride(base)
        view: NDArray[np.generic]
        if self._stride:
            start = int(base[0]) + delta
            view = np.ndarray(
                base.shape, dtype, buffer=self.buffer, offset=start, strides=(self._stride,)
            )
            return view.copy()
        view = np.ndarray(
            (self._length - delta - size + 1,),
            dtype,
            buffer=self.buffer,
            offset=delta,
            strides=(1,),
        )
        return view[base]

    def u1(self, base: NDArray[np.int64], delta: int) -> NDArray[np.uint8]:
        """The byte at each `base + delta`."""
        return cast("NDArray[np.uint8]", self._gather("u1", 1, base, delta))

    def u4(self, base: NDArray[np.int64], delta: int) -> NDArray[np.int64]:
        """The 32-bit unsigned number at each `base + delta`."""
        return self._gather(f"{self.order}u4", 4, base, delta).astype(np.int64)

    def block(self, base: NDArray[np.int64], delta: int, size: int) -> NDArray[np.uint8]:
        """Gather `size` bytes from each `base + delta`, row by row: uint8[n * size]."""
        if size == 0:
            return np.empty(0, np.uint8)
        if len(base) == 1 and size >= _VIEW_BYTES:
            return np.frombuffer(self.buffer, np.uint8, size, int(base[0]) + delta)
        if size >= _LONG_BLOCK:
            return self._join_equal(base + delta, size)
        return cast("NDArray[np.uint8]", self._gather(f"V{size}", size, base, delta).view("u1"))

    def ragged(self, start: NDArray[np.int64], size: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Gather `size[i]` bytes from `start[i]`, row by row."""
        if len(start) >= 2 * _ROWS_A_GROUP and int(size.max()) < _LONG_BLOCK:
            sizes, group = np.unique(size, return_inverse=True)
            if len(sizes) <= _MAX_GROUPS and len(sizes) * _ROWS_A_GROUP <= len(start):
                return self._by_size(start, size, sizes, group)
        if len(size) and size[0] >= _LONG_BLOCK and bool((size == size[0]).all()):
            return self._join_equal(start, int(size[0]))
        return self._join(start.tolist(), size.tolist())

    def _join_equal(self, start: NDArray[np.int64], size: int) -> NDArray[np.uint8]:
        """Gather `size` bytes from each start, in one step if the starts are equally spaced."""
        rows = len(start)
        stride = _even_stride(start, least=2)
        if not stride:
            return self._join(start.tolist(), [size] * rows)
        joined = np.empty(rows * size, np.uint8)
        view: NDArray[np.uint8] = np.ndarray(
            (rows, size), np.uint8, buffer=self.buffer, offset=int(start[0]), strides=(stride, 1)
        )
        joined.reshape(rows, size)[:] = view
        return joined

    def _join(self, start: list[int], size: list[int]) -> NDArray[np.uint8]:
        total = sum(size)
        joined = np.empty(total, np.uint8)
        content = np.frombuffer(self.buffer, np.uint8)
        to = 0
        for at, count in zip(start, size, strict=True):
            joined[to : to + count] = content[at : at + count]
            to += count
        return joined

    def _by_size(
        self,
        start: NDArray[np.int64],
        size: NDArray[np.int64],
        sizes: NDArray[np.int64],
        group: NDArray[np.intp],
    ) -> NDArray[np.uint8]:
        offset = np.cumsum(size) - size
        target = np.empty(int(size.sum()), np.uint8)
        for number, count in enumerate(sizes.tolist()):
            if count == 0:
                continue
            rows = np.flatnonzero(group == number)
            view: NDArray[np.void] = np.ndarray(
                (len(target) - count + 1,), f"V{count}", buffer=target, strides=(1,)
            )
            view[offset[rows]] = self._gather(f"V{count}", count, start[rows], 0)
        return target

    def numbers(self, data: NDArray[np.uint8], kind: Primitive) -> NDArray[np.generic]:
        """Gathered bytes as aligned numbers of native byte order."""
        if kind.dtype.kind == "b":
            return data.astype(np.bool_)
        values = data.view(kind.dtype.newbyteorder(self.order))
        return values.astype(kind.dtype, copy=not values.flags.aligned)

    def instants(self, data: NDArray[np.uint8], kind: Instant) -> NDArray[np.int64]:
        """Gathered bytes as nanoseconds."""
        signed = data.view(f"{self.order}i4").reshape(-1, 2)
        unsigned = data.view(f"{self.order}u4").reshape(-1, 2)
        seconds = (signed if kind.signed_seconds else unsigned)[:, 0].astype(np.int64)
        seconds *= 1_000_000_000
        seconds += (signed if kind.signed_nanoseconds else unsigned)[:, 1]
        return seconds

    def fixed(self, item: Fixed, base: NDArray[np.int64], delta: int) -> Column:
        """The column of a field of fixed size at each `base + delta`."""
        kind = item.kind
        if isinstance(kind, Instant):
            times = self.instants(self.block(base, delta, item.size), kind)
            column = Scalars(times, kind.kind)
        else:
            assert kind is not None
            column = Scalars(self._primitive(item, kind, base, delta))
        if item.width is None:
            return column
        return Arrays(column, even_offsets(len(base), item.width), item.width)

    def _primitive(
        self, item: Fixed, kind: Primitive, base: NDArray[np.int64], delta: int
    ) -> NDArray[np.generic]:
        if item.width is not None:
            return self.numbers(self.block(base, delta, item.size), kind)
        if kind.dtype.kind == "b":
            return self.u1(base, delta).astype(np.bool_)
        values = self._gather(kind.dtype.newbyteorder(self.order), item.size, base, delta)
        return values.astype(kind.dtype, copy=False)


def empty_fixed(item: Fixed) -> Column:
    """The column of a field of fixed size for no rows."""
    if isinstance(item.kind, Instant):
        column = Scalars(np.empty(0, np.int64), item.kind.kind)
    else:
        assert item.kind is not None
        column = Scalars(np.empty(0, item.kind.dtype))
    if item.width is None:
        return column
    return Arrays(column, np.zeros(1, np.int64), item.width)


def even_offsets(rows: int, width: int) -> NDArray[np.int64]:
    """Offsets of rows of `width` elements each: int64[rows + 1]."""
    return np.arange(rows + 1, dtype=np.int64) * width


def _even_stride(base: NDArray[np.int64], least: int = _EVEN_ROWS) -> int:
    """The distance of equally spaced offsets, 0 for others and for few."""
    if len(base) < least:
        return 0
    stride = int(base[1] - base[0])
    return stride if stride > 0 and bool((base[1:] - base[:-1] == stride).all()) else 0
