"""Turns messages of one type into columns of their arrays and a remainder, and back.

The arrays of numbers are cut out of each message. What is left is the *rest*: everything
else, byte for byte, including lengths, padding and the encapsulation header of CDR. `at`
says where in the rest each array belongs. So a message is its rest with its arrays put
back, whatever a writer did with the bytes in between.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hybridlog.schema.column import Arrays, Column, Records, Scalars, offsets, ranges
from hybridlog.schema.definition import ArrayOf, MessageType, Primitive
from hybridlog.schema.wire import WireReader
from hybridlog.schema.wire_gather import Source, even_offsets

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from typing import Any

    from numpy.typing import NDArray

    from hybridlog.schema.wire_program import Fixed, Wire
    from hybridlog_storage.messages import Buffer

_ENCAPSULATION = 4  # bytes of the header of CDR
_LONG = 256  # mean bytes of a piece from which pieces are copied one by one
_MIN_FIXED = 33  # elements of a fixed array from which it is cut out


@dataclass(frozen=True, slots=True)
class NumberArray:
    """An array of numbers that is cut out of messages.

    Attributes:
        path: Dotted path of its field.
        dtype: Type of its elements, in native byte order.
        width: Its elements if the definition fixes that number, else None.
    """

    path: str
    dtype: np.dtype[Any]
    width: int | None


@dataclass(slots=True)
class Split:
    """Messages without their arrays, which lie beside them.

    Attributes:
        rest: uint8, the rests of all messages, one after the other.
        rest_offset: int64[n + 1], bounds of each rest.
        at: int64[n, k], byte of the rest before which each of the k arrays belongs; ascending.
        arrays: k times the bytes of the arrays of all messages, one after the other.
        sizes: int64[n, k], bytes of each array.
    """

    rest: NDArray[np.uint8]
    rest_offset: NDArray[np.int64]
    at: NDArray[np.int64]
    arrays: list[NDArray[np.uint8]]
    sizes: NDArray[np.int64]

    def __len__(self) -> int:
        """Number of messages."""
        return len(self.rest_offset) - 1


@dataclass(slots=True)
class Spans:
    """Positions of the arrays of some messages.

    Attributes:
        start: int64[n, k], byte of the buffer where each array starts.
        size: int64[n, k], its bytes.
    """

    start: NDArray[np.int64]
    size: NDArray[np.int64]


def number_arrays(message_type: MessageType) -> list[NumberArray]:
    """The arrays that can be cut out of messages of a type, in the order of the wire.

    These are sequences and long fixed arrays of numbers, in the message itself or in messages
    inside it. Arrays inside arrays of messages, and arrays of booleans, stay in the rest.
    """
    return list(_arrays_in(message_type, ""))


def _arrays_in(message: MessageType, prefix: str) -> Iterator[NumberArray]:
    for name, kind in message.fields:
        path = f"{prefix}{name}"
        if isinstance(kind, MessageType):
            yield from _arrays_in(kind, f"{path}.")
        elif isinstance(kind, ArrayOf) and isinstance(kind.element, Primitive):
            is_long = kind.width is None or kind.width >= _MIN_FIXED
            if is_long and kind.element.dtype.kind != "b":
                yield NumberArray(path, kind.element.dtype, kind.width)


class Locator:
    """Finds the arrays in messages of one type.

    Args:
        message_type: The type.
        wire: Format of the messages.
        arrays: From `number_arrays`; at least one.
    """

    def __init__(
        self, message_type: MessageType, wire: Wire, arrays: Sequence[NumberArray]
    ) -> None:
        self._wire = wire
        self._arrays = arrays
        paths = [array.path for array in arrays]
        self._reader = WireReader(message_type, wire, paths, source=_Positions)

    def spans(
        self, buffer: Buffer, offset: NDArray[np.int64], length: NDArray[np.int64]
    ) -> Spans | None:
        """Positions of the arrays; None if a message does not fit its definition.

        Args:
            buffer: Holds the payloads.
            offset: int64[n], where each payload starts; n is at least 1.
            length: int64[n], bytes of each payload.
        """
        shape = len(offset), len(self._arrays)
        found = Spans(np.empty(shape, np.int64), np.empty(shape, np.int64))
        is_big = big_endian_rows(self._wire, buffer, offset, length)
        for rows in (np.flatnonzero(~is_big), np.flatnonzero(is_big)):
            decoded = self._reader.read(buffer, offset[rows], length[rows])
            if decoded.unreadable or not isinstance(decoded.records, Records):
                return None
            if len(rows):
                self._fill(found, rows, decoded.records)
        return found

    def _fill(self, found: Spans, rows: NDArray[np.intp], records: Records) -> None:
        for number, array in enumerate(self._arrays):
            column = field_at(records, array.path)
            assert isinstance(column, Arrays)
            assert isinstance(column.values, Scalars)
            found.start[rows, number] = column.values.values
            found.size[rows, number] = np.diff(column.offset) * array.dtype.itemsize


def big_endian_rows(
    wire: Wire, buffer: Buffer, offset: NDArray[np.int64], length: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """bool[n], True for messages with numbers of big endian byte order.

    Args:
        wire: Format of the messages; ROS 1 is little endian.
        buffer: Holds them.
        offset: int64[n], where each starts.
        length: int64[n], bytes of each.
    """
    is_big = np.zeros(len(offset), np.bool_)
    if wire == "cdr":
        rows = np.flatnonzero(length >= _ENCAPSULATION)
        content = np.frombuffer(buffer, np.uint8)
        is_big[rows] = (content[offset[rows]] == 0) & (content[offset[rows] + 1] == 0)
    return is_big


class _Positions(Source):
    """Gathers where arrays start instead of their elements: one number a row."""

    def block(self, base: NDArray[np.int64], delta: int, size: int) -> NDArray[np.uint8]:
        """Positions instead of bytes."""
        return (base + delta).view(np.uint8)

    def ragged(self, start: NDArray[np.int64], size: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Positions instead of bytes."""
        return np.ascontiguousarray(start).view(np.uint8)

    def numbers(self, data: NDArray[np.uint8], kind: Primitive) -> NDArray[np.generic]:
        """The positions."""
        return data.view(np.int64)

    def fixed(self, item: Fixed, base: NDArray[np.int64], delta: int) -> Column:
        """Positions of a fixed array."""
        assert item.width is not None
        return Arrays(Scalars(base + delta), even_offsets(len(base), item.width))


def field_at(records: Records, path: str) -> Column:
    """The column of a field by its dotted path."""
    column: Column = records
    for name in path.split("."):
        assert isinstance(column, Records)
        column = column.fields[name]
    return column


def split(
    buffer: Buffer, offset: NDArray[np.int64], length: NDArray[np.int64], spans: Spans
) -> Split:
    """Cut the arrays out of messages.

    Args:
        buffer: Holds the payloads.
        offset: int64[n], where each payload starts.
        length: int64[n], bytes of each payload.
        spans: Where their arrays lie: apart, and in order.
    """
    content = np.frombuffer(buffer, np.uint8)
    ends = spans.start + spans.size
    starts = np.column_stack([offset, ends])
    sizes = np.column_stack([spans.start, offset + length]) - starts
    at = np.cumsum(sizes[:, :-1], axis=1)
    return Split(
        _gather(content, starts.ravel(), sizes.ravel()),
        offsets(sizes.sum(axis=1)),
        at,
        [_gather(content, s, n) for s, n in zip(spans.start.T, spans.size.T, strict=True)],
        spans.size,
    )


def join(parts: Split) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Put the arrays back into messages.

    Returns:
        uint8, all payloads one after the other; int64[n + 1], bounds of each.

    Raises:
        ValueError: The parts contradict each other.
    """
    rest_size = np.diff(parts.rest_offset)
    bounds = np.column_stack([np.zeros(len(parts), np.int64), parts.at, rest_size])
    pieces = np.diff(bounds, axis=1)
    given = [len(array) for array in parts.arrays]
    if (pieces < 0).any() or (parts.sizes < 0).any() or parts.sizes.sum(axis=0).tolist() != given:
        raise ValueError("arrays lie outside of their messages")
    if len(parts.rest) != int(parts.rest_offset[-1]) - int(parts.rest_offset[0]):
        raise ValueError("the rests have other sizes")
    # Pieces of the rest and arrays in turns.
    total = np.empty((len(parts), pieces.shape[1] + parts.sizes.shape[1]), np.int64)
    total[:, 0::2], total[:, 1::2] = pieces, parts.sizes
    result_offset = offsets(total.sum(axis=1))
    target = np.empty(int(result_offset[-1]), np.uint8)
    places = result_offset[:-1, None] + np.cumsum(total, axis=1) - total
    _scatter(target, places[:, 0::2].ravel(), pieces.ravel(), parts.rest)
    for number, array in enumerate(parts.arrays):
        _scatter(target, places[:, 2 * number + 1], parts.sizes[:, number], array)
    return target, result_offset


def _gather(
    content: NDArray[np.uint8], start: NDArray[np.int64], size: NDArray[np.int64]
) -> NDArray[np.uint8]:
    """`content[start[i]:start[i] + size[i]]` for all i, one after the other."""
    total = int(size.sum())
    if total <= _LONG * len(size):
        return content[ranges(start, size)]
    pieces = zip(start.tolist(), (start + size).tolist(), strict=True)
    return np.concatenate([content[begin:end] for begin, end in pieces])


def _scatter(
    target: NDArray[np.uint8],
    start: NDArray[np.int64],
    size: NDArray[np.int64],
    data: NDArray[np.uint8],
) -> None:
    """The opposite of `_gather`."""
    if len(data) <= _LONG * len(size):
        target[ranges(start, size)] = data
        return
    at = 0
    for begin, count in zip(start.tolist(), size.tolist(), strict=True):
        target[begin : begin + count] = data[at : at + count]
        at += count
