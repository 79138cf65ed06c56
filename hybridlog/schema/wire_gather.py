"""Gathers columns from a buffer."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, cast

import numpy as np

from hybridlog.schema.column import Arrays, Column, Scalars, pick
from hybridlog.schema.definition import Instant, Primitive

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.schema.wire_program import Fixed
    from hybridlog_storage.messages import Buffer

# Bytes of a row from which a single one is a view into the buffer, and several are copied
# one by one: for fewer, a copy costs less than keeping the whole buffer alive.
_LONG = 4096
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
        self._bytes: NDArray[np.uint8] = np.asarray(self.buffer)
        self._base: NDArray[np.int64] | None = None
        self._stride = 0

    def _gather(
        self, dtype: str | np.dtype[np.generic], size: int, base: NDArray[np.int64], delta: int
    ) -> NDArray[np.generic]:
        if not len(base):
            return np.empty(0, dtype)
        if base is not self._base:
            # Many gathers use one base: its stride is computed once.
            self._base, self._stride = base, _even_stride(base)
        if self._stride:
            start, shape, stride = int(base[0]) + delta, base.shape, self._stride
        else:
            start, shape, stride = delta, (len(self.buffer) - delta - size + 1,), 1
        view: NDArray[np.generic] = np.ndarray(shape, dtype, self.buffer, start, (stride,))
        return view.copy() if self._stride else view[base]

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
        if size >= _LONG and len(base) == 1:
            start = int(base[0]) + delta
            return self._bytes[start : start + size]
        if size >= _LONG:
            return self.ragged(base + delta, np.full(len(base), size))
        return cast("NDArray[np.uint8]", self._gather(f"V{size}", size, base, delta).view("u1"))

    def ragged(self, start: NDArray[np.int64], size: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Gather `size[i]` bytes from `start[i]`, row by row."""
        return pick(self._bytes, start, size)

    def numbers(self, data: NDArray[np.uint8], kind: Primitive) -> NDArray[np.generic]:
        """Gathered bytes as aligned numbers of native byte order."""
        if kind.dtype.kind == "b":
            return data.astype(np.bool_)
        values = data.view(kind.dtype.newbyteorder(self.order))
        return values.astype(kind.dtype, copy=not values.flags.aligned)

    def fixed(self, item: Fixed, base: NDArray[np.int64], delta: int) -> Column:
        """The column of a field of fixed size at each `base + delta`."""
        kind = item.kind
        assert kind is not None
        if isinstance(kind, Instant):
            times = self._instants(self.block(base, delta, item.size), kind)
            column = Scalars(times, kind.kind)
        else:
            column = Scalars(self._primitive(item, kind, base, delta))
        if item.width is None:
            return column
        return Arrays(column, even_offsets(len(base), item.width), item.width)

    def _instants(self, data: NDArray[np.uint8], kind: Instant) -> NDArray[np.int64]:
        """Gathered bytes as nanoseconds."""
        signed = data.view(f"{self.order}i4").reshape(-1, 2)
        unsigned = data.view(f"{self.order}u4").reshape(-1, 2)
        seconds = (signed if kind.signed_seconds else unsigned)[:, 0].astype(np.int64)
        seconds *= 1_000_000_000
        seconds += (signed if kind.signed_nanoseconds else unsigned)[:, 1]
        return seconds

    def _primitive(
        self, item: Fixed, kind: Primitive, base: NDArray[np.int64], delta: int
    ) -> NDArray[np.generic]:
        if item.width is not None:
            return self.numbers(self.block(base, delta, item.size), kind)
        if kind.dtype.kind == "b":
            return self.u1(base, delta).astype(np.bool_)
        values = self._gather(kind.dtype.newbyteorder(self.order), item.size, base, delta)
        return values.astype(kind.dtype, copy=False)


def even_offsets(rows: int, width: int) -> NDArray[np.int64]:
    """Offsets of rows of `width` elements each: int64[rows + 1]."""
    return np.arange(rows + 1, dtype=np.int64) * width


def _even_stride(base: NDArray[np.int64]) -> int:
    """The distance of equally spaced offsets, 0 for others and for few."""
    if len(base) < _EVEN_ROWS:
        return 0
    stride = int(base[1] - base[0])
    return stride if stride > 0 and bool((base[1:] - base[:-1] == stride).all()) else 0
