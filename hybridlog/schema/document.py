"""Converts columns to BSON: the bodies of index documents for many messages at once.

Columns are first converted to a tree of nodes with the element type and width of each row.
Parts with the same layout in all rows (in most topics the whole message) are a template
that is tiled; each value column is assigned with one strided copy. Parts whose length
differs by row (strings, lists) are scattered, also with a few array operations for all
rows. Elements of lists of messages are rows, too, and need no special case.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias

import numpy as np

from hybridlog.schema.column import (
    LONG,
    Arrays,
    Column,
    Records,
    Scalars,
    Strings,
    offsets,
    ranges,
    summarise,
    take,
    top_level_names,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray


_DOUBLE, _STRING, _DOCUMENT, _ARRAY, _BOOL, _NULL, _INT32, _INT64 = 1, 2, 3, 4, 8, 10, 16, 18

ARRAY_LIMIT: Final = 32
"""Arrays of more elements are summarised."""
MAX_BYTES: Final = 8 << 20
_SLAB = 32 << 20
"""Bytes of bodies made at once."""

_UNROLL = 16
"""Rows per list element from which each element is written with separate operations."""


class BodyGroup(NamedTuple):
    """Bodies of index documents of equal width.

    Attributes:
        rows: intp[k], rows of the input.
        body: uint8[k, width], the BSON elements of the top level, without the
            document's length in front and its final NUL.
        error: Reason why there are none; the width is then 0.
    """

    rows: NDArray[np.intp]
    body: NDArray[np.uint8]
    error: str | None = None


def without_fields(rows: NDArray[np.intp], error: str | None) -> BodyGroup:
    """Bodies of messages that have no fields, or that cannot be documents."""
    return BodyGroup(rows, np.empty((len(rows), 0), np.uint8), error)


def bodies(
    records: Records, *, array_limit: int = ARRAY_LIMIT, max_bytes: int = MAX_BYTES
) -> Iterator[BodyGroup]:
    """Make the body of each row; every row is in exactly one of the results.

    The bytes equal `bson.encode` of the row's dictionary and depend on that row alone. Memory does
    not grow with the number of rows. Arrays longer than `array_limit` are summarised.
    """
    if len(records) == 0:
        return
    top = _record(records, array_limit, top=True)
    width = _spread(top.width, len(records)) - 5
    large = width > max_bytes
    if large.any():
        reason = f"its fields take more than {max_bytes >> 20} MiB"
        yield without_fields(np.flatnonzero(large), reason)
    rows = np.flatnonzero(~large)
    slab = np.cumsum(width[rows]) // _SLAB
    for part in np.split(rows, np.flatnonzero(np.diff(slab)) + 1):
        if len(part) == len(records):
            yield from _made(top, part, width)
        elif len(part):
            sub = _record(take(records, part), array_limit, top=True)
            yield from _made(sub, part, width[part])


def _made(top: _Record, rows: NDArray[np.intp], width: NDArray[np.int64]) -> Iterator[BodyGroup]:
    """Make the bodies of all rows of `top`, which are the input's `rows`, with these widths."""
    template = _Piece()
    if all(_append(template, name, node, slice(None), len(rows)) for name, node in top.fields):
        yield BodyGroup(rows, template.tile(len(rows)))
        return
    # Sorted by width, so that bodies of equal width form one block of the output.
    order = np.argsort(width, kind="stable")
    at = np.empty(len(rows), np.int64)
    at[order] = np.cumsum(width[order]) - width[order]
    out = np.zeros(int(width.sum()), np.uint8)
    _put_fields(top, out, at)
    edges = np.flatnonzero(np.diff(width[order])) + 1
    begin = 0
    for part in np.split(order, edges):
        size = len(part) * int(width[part[0]])
        yield BodyGroup(rows[part], out[begin : begin + size].reshape(len(part), -1))
        begin += size


def _spread(value: _Each, rows: int) -> NDArray[np.int64]:
    """Expand to one number for each row."""
    if isinstance(value, int):
        return np.full(rows, value, np.int64)
    return value


# --- nodes: the output of each row ----------------------------------------------------

_Each: TypeAlias = "int | NDArray[np.int64]"
"""One number for all rows, or one for each."""


@dataclass(slots=True)
class _Number:
    """A value of fixed width, or null.

    Attributes:
        tag: BSON type, or one for each row (uint8[n]).
        values: shape (n,); assigned with a cast to `stored`.
        stored: Little-endian dtype in the document.
        has: bool[n], False for null; None if no row is null.
    """

    tag: int | NDArray[np.uint8]
    values: NDArray[Any]
    stored: np.dtype[Any]
    has: NDArray[np.bool_] | None = None
    width: _Each = field(init=False)

    def __post_init__(self) -> None:
        self.width = self.stored.itemsize
        if self.has is not None:
            self.width = np.where(self.has, self.stored.itemsize, 0)


@dataclass(slots=True)
class _Text:
    """Strings, valid UTF-8."""

    data: NDArray[np.uint8]
    start: NDArray[np.int64]
    length: NDArray[np.int64]
    tag: int = _STRING
    width: _Each = field(init=False)

    def __post_init__(self) -> None:
        same = _same(self.length)
        self.width = self.length + 5 if same is None else same + 5


@dataclass(slots=True)
class _Record:
    """Documents; `rows` is their number, also without fields."""

    fields: list[tuple[bytes, _Node]]
    rows: int
    tag: int = _DOCUMENT
    width: _Each = field(init=False)

    def __post_init__(self) -> None:
        width: _Each = 5
        for name, node in self.fields:
            width = width + (2 + len(name)) + node.width
        self.width = width


@dataclass(slots=True)
class _List:
    """Whole arrays: row i has the next `counts[i]` rows of `child`."""

    child: _Node
    counts: NDArray[np.int64]
    tag: int = _ARRAY
    width: _Each = field(init=False)
    count: int | None = field(init=False)

    def __post_init__(self) -> None:
        self.count = _same(self.counts)
        if self.count is not None and isinstance(self.child.width, int):
            self.width = (
                5
                + self.count * (2 + self.child.width)
                + sum(len(str(key)) for key in range(self.count))
            )
        else:
            self.width = 5 + np.diff(offsets(self.element_widths())[offsets(self.counts)])

    def index(self) -> NDArray[np.int64]:
        """Position of each element in its row."""
        return ranges(np.zeros_like(self.counts), self.counts)

    def element_widths(self) -> NDArray[np.int64]:
        """Bytes of each element with its type, key and NUL."""
        index = self.index()
        return 2 + _digits(index) + _spread(self.child.width, len(index))


@dataclass(slots=True)
class _Either:
    """Two alternatives: some rows are those of `yes`, in order, the others those of `no`."""

    which: NDArray[np.bool_]
    yes: _Node
    no: _Node
    tag: NDArray[np.uint8] = field(init=False)
    width: _Each = field(init=False)

    def __post_init__(self) -> None:
        self.tag = np.empty(len(self.which), np.uint8)
        self.tag[self.which] = self.yes.tag
        self.tag[~self.which] = self.no.tag
        width = np.empty(len(self.which), np.int64)
        width[self.which] = self.yes.width
        width[~self.which] = self.no.width
        self.width = width


_Node: TypeAlias = _Number | _Text | _Record | _List | _Either


def _same(numbers: NDArray[np.int64]) -> int | None:
    """The common number, None if they differ or there are none."""
    if len(numbers) and bool((numbers == numbers[0]).all()):
        return int(numbers[0])
    return None


def _digits(index: NDArray[np.int64]) -> NDArray[np.int64]:
    """Decimal digits of each array key."""
    longest = len(str(int(index.max(initial=0))))
    longer = (index >= 10**power for power in range(1, longest))
    return sum(longer, np.ones(len(index), np.int64))


def _node(column: Column, limit: int) -> _Node:
    if isinstance(column, Scalars):
        return _number(column.values)
    if isinstance(column, Strings):
        return _text(column)
    if isinstance(column, Records):
        return _record(column, limit)
    return _array(column, limit)


_STORED: dict[int, np.dtype[Any]] = {
    _BOOL: np.dtype("?"),
    _INT32: np.dtype("<i4"),
    _INT64: np.dtype("<i8"),
    _DOUBLE: np.dtype("<f8"),
}


def _number(values: NDArray[Any], has: NDArray[np.bool_] | None = None) -> _Number:
    kind, size = values.dtype.kind, values.dtype.itemsize
    if has is not None and has.all():
        has = None
    tag: int | NDArray[np.uint8]
    if kind == "f":
        tag = _DOUBLE
    elif kind == "b":
        tag = _BOOL
    else:
        tag = _INT32 if size < 4 or (size == 4 and kind == "i") else _INT64
    stored = _STORED[tag]
    if kind == "u" and size == 8:
        huge = values >= np.uint64(1 << 63)
        if huge.any():
            # Both take eight bytes: only type and bits differ.
            tag = np.where(huge, _DOUBLE, _INT64).astype(np.uint8)
            values = np.where(huge, values.astype(np.float64).view(np.uint64), values)
            values = values.view(np.int64)
    if has is not None:
        tag = np.where(has, tag, _NULL).astype(np.uint8)
    return _Number(tag, values, stored, has)


def _text(column: Strings) -> _Text:
    begin, end = int(column.offset[0]), int(column.offset[-1])
    data, bounds = np.ascontiguousarray(column.data[begin:end]), column.offset - begin
    if bool((data >= 0x80).any()):
        # The validity of a string must not depend on its neighbours.
        raw = data.tobytes()
        cells = [raw[a:b].decode(errors="replace").encode() for a, b in pairwise(bounds.tolist())]
        data = np.frombuffer(b"".join(cells), np.uint8)
        bounds = offsets(np.array([*map(len, cells)], np.int64))
    return _Text(data, bounds[:-1], np.diff(bounds))


def _record(column: Records, limit: int, *, top: bool = False) -> _Record:
    names = top_level_names(column.fields) if top else column.fields
    nodes = (_node(c, limit) for c in column.fields.values())
    fields = [(name.encode(), node) for name, node in zip(names, nodes, strict=True)]
    return _Record(fields, len(column))


def _array(column: Arrays, limit: int) -> _Node:
    counts = np.diff(column.offset)
    short = counts <= limit
    if short.all():
        return _List(_node(column.values, limit), counts)
    if not short.any():
        return _summary(column, counts)
    some = np.flatnonzero(short)
    lists = _List(_node(take(column, some).values, limit), counts[short])
    long = take(column, np.flatnonzero(~short))
    return _Either(short, lists, _summary(long, counts[~short]))


def _summary(column: Arrays, counts: NDArray[np.int64]) -> _Record:
    fields: list[tuple[bytes, _Node]] = [(b"n", _number(counts))]
    if isinstance(column.values, Scalars):
        found = summarise(column.values, column.offset)
        fields.append((b"min", _number(found.min, found.has)))
        fields.append((b"max", _number(found.max, found.has)))
        fields.append((b"mean", _number(found.mean, found.has)))
    return _Record(fields, len(counts))


# --- bytes: one layout for all rows ---------------------------------------------------


@dataclass(slots=True)
class _Piece:
    """A byte template shared by all rows, and the values that are written into it.

    Attributes:
        template: The bytes of a row.
        writes: Position in the row, distance of further values in it, and the values, shape
            (n,) or (n, values per row), with their stored dtype.
    """

    template: bytearray = field(default_factory=bytearray)
    writes: list[tuple[int, int, NDArray[Any], np.dtype[Any]]] = field(default_factory=list)

    def header(self, tag: int | NDArray[np.uint8], name: bytes) -> None:
        """Append type and key of an element; `tag` for the rows of the piece."""
        if isinstance(tag, np.ndarray):
            if (tag == tag[0]).all():
                tag = int(tag[0])
            else:
                self.writes.append((len(self.template), 0, tag, tag.dtype))
                tag = 0
        self.template += b"%c%b\0" % (tag, name)

    def values(self, values: NDArray[Any], stored: np.dtype[Any]) -> None:
        """Append one value for each row."""
        self.writes.append((len(self.template), 0, values, stored))
        self.template += bytes(stored.itemsize)

    def tile(self, rows: int) -> NDArray[np.uint8]:
        """uint8[rows, width]: all rows."""
        width = len(self.template)
        out = np.empty((rows, width), np.uint8)
        out[:] = np.frombuffer(self.template, np.uint8)
        with np.errstate(invalid="ignore"):  # a signalling NaN becomes a quiet one
            for at, step, values, stored in self.writes:
                strides = (width, step)[: values.ndim]
                np.ndarray(values.shape, stored, out.data, at, strides)[...] = values
        return out


def _append(piece: _Piece, name: bytes, node: _Node, rows: slice, count: int) -> bool:
    """Append an element; return False and append nothing if rows differ in layout.

    `rows` of the node, at least one, are for the rows of the piece.
    """
    template, writes = len(piece.template), len(piece.writes)
    piece.header(node.tag if isinstance(node.tag, int) else node.tag[rows], name)
    if _append_value(piece, node, rows, count):
        return True
    del piece.template[template:]
    del piece.writes[writes:]
    return False


def _append_value(piece: _Piece, node: _Node, rows: slice, count: int) -> bool:
    if isinstance(node, _Number):
        return _append_number(piece, node, rows)
    if isinstance(node, _Text):
        return _append_text(piece, node, rows)
    if isinstance(node, _Either):
        return False
    begin = len(piece.template)
    piece.template += bytes(4)
    if isinstance(node, _Record):
        fits = all(_append(piece, name, child, rows, count) for name, child in node.fields)
    else:
        fits = _append_list(piece, node, rows, count)
    if fits:
        piece.template += b"\0"
        struct.pack_into("<i", piece.template, begin, len(piece.template) - begin)
    return fits


def _append_number(piece: _Piece, node: _Number, rows: slice) -> bool:
    has = None if node.has is None else node.has[rows]
    if has is None or has.all():
        piece.values(node.values[rows], node.stored)
        return True
    return not has.any()


def _append_text(piece: _Piece, node: _Text, rows: slice) -> bool:
    length = _same(node.length[rows])
    if length is None:
        return False
    piece.template += struct.pack("<i", length + 1)
    if length:
        text = np.dtype(("V", length))
        piece.values(_overlay(node.data, text)[node.start[rows]], text)
    piece.template += b"\0"
    return True


def _append_list(piece: _Piece, node: _List, rows: slice, count: int) -> bool:
    size, child = node.count, node.child
    if size is None:
        return False
    if isinstance(child, _Number) and child.has is None and isinstance(child.tag, int):
        grid = child.values.reshape(-1, size)[rows] if size else child.values
        value = bytes(child.stored.itemsize)
        begin = 0
        while begin < size:
            digits = len(str(begin))
            end = min(size, 10**digits)
            at = len(piece.template) + 2 + digits
            step = 2 + digits + len(value)
            piece.writes.append((at, step, grid[:, begin:end], child.stored))
            for key in range(begin, end):
                piece.template += b"%c%d\0%b" % (child.tag, key, value)
            begin = end
        return True
    if size > max(1, count // _UNROLL):
        return False
    first, step = rows.start or 0, rows.step or 1
    return all(
        _append(piece, b"%d" % key, child, slice(first * size + key, None, step * size), count)
        for key in range(size)
    )


# --- bytes: a separate layout for each row --------------------------------------------


def _overlay(data: NDArray[np.uint8], dtype: np.dtype[Any]) -> NDArray[Any]:
    """An array whose item i starts at byte i of `data`; the items overlap."""
    return np.ndarray((len(data) - dtype.itemsize + 1,), dtype, data, 0, (1,))


def _put_fields(record: _Record, out: NDArray[np.uint8], at: NDArray[np.int64]) -> None:
    """Write the elements of each row from byte `at` of the zeroed `out`.

    Neighbouring fields of equal layout are tiled and copied together.
    """
    run = _Piece()
    for name, node in record.fields:
        if _append(run, name, node, slice(None), record.rows):
            continue
        run.header(node.tag, name)
        at = _put_run(run, out, at)
        _put(node, out, at)
        at = at + node.width
        run = _Piece()
    _put_run(run, out, at)


def _put_run(run: _Piece, out: NDArray[np.uint8], at: NDArray[np.int64]) -> NDArray[np.int64]:
    width = len(run.template)
    if width:
        block = np.dtype(("V", width))
        _overlay(out, block)[at] = run.tile(len(at)).view(block)[:, 0]
    return at + width


def _put(node: _Node, out: NDArray[np.uint8], at: NDArray[np.int64]) -> None:
    """Write the value of each row at byte `at` of `out`."""
    if len(at) == 0:
        return
    if isinstance(node, _Number):
        has = slice(None) if node.has is None else node.has
        with np.errstate(invalid="ignore"):
            _overlay(out, node.stored)[at[has]] = node.values[has]
        return
    if isinstance(node, _Either):
        _put(node.yes, out, at[node.which])
        _put(node.no, out, at[~node.which])
        return
    size = _overlay(out, np.dtype("<i4"))
    if isinstance(node, _Text):
        size[at] = node.length + 1
        _put_text(node, out, at + 4)
        return
    size[at] = node.width
    if isinstance(node, _Record):
        _put_fields(node, out, at + 4)
    else:
        _put_elements(node, out, at + 4)


def _put_text(node: _Text, out: NDArray[np.uint8], at: NDArray[np.int64]) -> None:
    if int(node.length.sum()) <= LONG * len(at):
        out[ranges(at, node.length)] = node.data[ranges(node.start, node.length)]
        return
    places = zip(at.tolist(), node.start.tolist(), node.length.tolist(), strict=True)
    for to, begin, length in places:
        out[to : to + length] = node.data[begin : begin + length]


def _put_elements(node: _List, out: NDArray[np.uint8], at: NDArray[np.int64]) -> None:
    index = node.index()
    if len(index) == 0:
        return
    begin = offsets(node.element_widths())
    first = offsets(node.counts)[:-1]
    places = begin[:-1] + np.repeat(at - begin[first], node.counts)
    digits = _digits(index)
    tags = node.child.tag
    for length in range(1, int(digits.max()) + 1):
        chosen = digits == length
        keys = index[chosen]
        head = np.zeros((len(keys), length + 2), np.uint8)
        head[:, 0] = tags if isinstance(tags, int) else tags[chosen]
        for place in range(length):
            head[:, length - place] = ord("0") + keys // 10**place % 10
        block = np.dtype(("V", length + 2))
        _overlay(out, block)[places[chosen]] = head.view(block)[:, 0]
    _put(node.child, out, places + 2 + digits)
