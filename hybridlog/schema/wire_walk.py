"""Walks over many payloads at once and gathers their columns, or over one, value by value.

All rows take the same steps. Their positions are a vector (`base`) plus a number
(`delta`). The vector changes only behind fields of varying length, so most fields cost only
their gather. Bounds take one comparison for each run: `room` is the smallest distance from
`base` to the end of the payload over all rows.

A row that does not fit stops the walk. The reader then finds these rows with the walk over
one, and restarts without them.
"""

from __future__ import annotations

from struct import Struct
from typing import TYPE_CHECKING, Literal, cast

import numpy as np

from hybridlog.schema.column import Arrays, Column, Scalars, Strings, offsets, pick, ranges
from hybridlog.schema.definition import Instant, Primitive
from hybridlog.schema.wire_program import (
    ArrayStep,
    Fixed,
    NumbersStep,
    Program,
    Run,
    Step,
    TextStep,
    Wire,
    assemble,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog_storage.messages import Buffer

MAX_EMPTY_ELEMENTS = 1_000_000
"""Most elements of an array whose elements take no bytes."""
MAX_PADDING = {"ros1": 0, "cdr": 3}
"""Most bytes that fill up a payload; in CDR to a multiple of four."""
_MIN_VECTOR_ROWS = 12  # rows below which walking over elements is faster one row at a time
_FAR = 1 << 62  # room of no rows
# Bytes of a row from which a single one is a view into the buffer, and several are copied
# one by one: for fewer, a copy costs less than keeping the whole buffer alive.
_LONG = 4096
# Rows from which a check for equal distances pays.
_EVEN_ROWS = 16
_U4 = {"<": Struct("<I"), ">": Struct(">I")}


class MisfitError(Exception):
    """A payload does not fit its definition; the message names the place."""


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
        if kind.code == "?":
            return data.astype(np.bool_)
        values = data.view(self.order + kind.code)
        return values.astype(kind.code, copy=not values.flags.aligned)

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
        if kind.code == "?":
            return self.u1(base, delta).astype(np.bool_)
        values = self._gather(self.order + kind.code, item.size, base, delta)
        return values.astype(kind.code, copy=False)


def even_offsets(rows: int, width: int) -> NDArray[np.int64]:
    """Offsets of rows of `width` elements each: int64[rows + 1]."""
    return np.arange(rows + 1, dtype=np.int64) * width


def _even_stride(base: NDArray[np.int64]) -> int:
    """The distance of equally spaced offsets, 0 for others and for few."""
    if len(base) < _EVEN_ROWS:
        return 0
    stride = int(base[1] - base[0])
    return stride if stride > 0 and bool((base[1:] - base[:-1] == stride).all()) else 0


class Scanner:
    """Walks over one payload of a buffer at a time, to check or measure it.

    The slow counterpart of `Walker`. It allocates nothing, and accepts a claimed length only if
    that many bytes are left.
    """

    def __init__(self, source: Source, wire: Wire) -> None:
        self._buffer = source.buffer
        self._u4 = _U4[source.order].unpack_from
        self._cdr = wire == "cdr"
        self._mask = 7 if self._cdr else 0
        self._padding = MAX_PADDING[wire]

    def check(self, program: Program, start: int, end: int) -> None:
        """Walk over a whole message. Bytes may be left over, except of a type without fields.

        In CDR, `start` is behind the encapsulation header. A payload that does not fit raises
        MisfitError.
        """
        rest = end - self.walk(program, start, end, start)
        if program.empty and rest > self._padding:
            raise MisfitError(f"{rest} bytes left over: the definition has no fields")

    def walk(self, program: Program, at: int, end: int, origin: int) -> int:
        """The position behind a message or element at `at`; `origin` is that of the alignment."""
        for step in program.steps:
            if isinstance(step, Run):
                size = step.size((at - origin) & self._mask)
                if size > end - at:
                    path = step.cut((at - origin) & self._mask, end - at)
                    raise MisfitError(f"ends in the middle of field {path}")
                at += size
            elif isinstance(step, TextStep):
                at = self._text(step, at, end, origin)
            elif isinstance(step, NumbersStep):
                at = self._numbers(step, at, end, origin)
            else:
                at = self._array(step, at, end, origin)
        return at

    def _count(self, step: Step, at: int, end: int, origin: int) -> tuple[int, int]:
        """A length in 32 bits, and the position behind it."""
        assert not isinstance(step, Run)
        at += (origin - at) & self._mask & 3
        if end - at < 4:
            raise MisfitError(f"ends in the middle of field {step.path}")
        return self._u4(self._buffer, at)[0], at + 4

    def _text(self, step: TextStep, at: int, end: int, origin: int) -> int:
        size, at = self._count(step, at, end, origin)
        if size > end - at:
            raise MisfitError(f"{step.path} claims {size} bytes, {end - at} bytes remain")
        at += size
        if self._cdr and size and self._buffer[at - 1]:
            raise MisfitError(f"{step.path} does not end with NUL")
        return at

    def _numbers(self, step: NumbersStep, at: int, end: int, origin: int) -> int:
        count, at = self._count(step, at, end, origin)
        if count == 0:
            return at
        room = end - at
        at += (origin - at) & (step.align - 1)
        size = count * step.kind.size
        if size > end - at:
            raise MisfitError(f"{step.path} claims {count} elements, {room} bytes remain")
        return at + size

    def _array(self, step: ArrayStep, at: int, end: int, origin: int) -> int:
        count, element = step.width, step.element
        if count is None:
            count, at = self._count(step, at, end, origin)
        if element.least == 0:
            if count > MAX_EMPTY_ELEMENTS:
                raise MisfitError(f"{step.path} claims {count} elements that take no bytes")
            return at
        size = count * element.least
        if element.fixed and size <= end - at:
            size = element.span((at - origin) & self._mask, count)
        if size > end - at:
            raise MisfitError(f"{step.path} claims {count} elements, {end - at} bytes remain")
        if element.fixed:
            return at + size
        for _ in range(count):
            at = self.walk(element, at, end, origin)
        return at


class _Cursor:
    """The position of each row.

    Attributes:
        base: int64[n], absolute positions.
        delta: Distance of all rows from `base`.
        end: int64[n], ends of the payloads.
        origin: int64[n], origin of the alignment; unused in ROS 1.
        phase: `base - origin` modulo `modulus`, the same for all rows.
        modulus: 8 if the phase is fully known, down to 1 if it is unknown.
        room: Smallest `end - base`.
    """

    __slots__ = ("base", "delta", "end", "modulus", "origin", "phase", "room")

    def __init__(
        self,
        base: NDArray[np.int64],
        end: NDArray[np.int64],
        origin: NDArray[np.int64],
        phase: int = 0,
        modulus: int = 8,
    ) -> None:
        self.end = end
        self.origin = origin
        self.move(base, phase, modulus)

    def move(self, base: NDArray[np.int64], phase: int, modulus: int) -> None:
        """Move to new positions of known phase."""
        self.base = base
        self.delta = 0
        self.phase = phase
        self.modulus = modulus
        self.room = int((self.end - base).min(initial=_FAR))
        if self.room < 0:
            raise MisfitError

    def move_or_step(self, positions: NDArray[np.int64], modulus: int) -> None:
        """Move to new positions; the phase stays known if the step is equal for all rows.

        Otherwise the phase is 0 modulo `modulus`.
        """
        step = positions - self.base
        if len(step) and bool((step == step[0]).all()):
            self.delta = int(step[0])
            self.need(0)
        else:
            self.move(positions, 0, modulus)

    def need(self, size: int) -> None:
        """Raise if any row has less than `size` bytes left."""
        if self.delta + size > self.room:
            raise MisfitError

    def align(self, size: int) -> None:
        """Advance to the next multiple of `size` (1, 2, 4 or 8)."""
        if size <= self.modulus:
            self.delta += -(self.phase + self.delta) & (size - 1)
        else:
            base = self.base + self.delta
            base += (self.origin - base) & (size - 1)
            self.move(base, 0, size)


class Walker:
    """Reads columns from payloads of one buffer and one byte order."""

    def __init__(self, source: Source, wire: Wire) -> None:
        self._source = source
        self._scanner = Scanner(source, wire)
        self._cdr = wire == "cdr"
        # ROS 1: every phase counts as 0 and known.
        self._mask = 7 if self._cdr else 0
        self._least_known = 1 if self._cdr else 8  # modulus behind a field of varying length
        self._padding = MAX_PADDING[wire]

    def read(
        self, program: Program, start: NDArray[np.int64], end: NDArray[np.int64]
    ) -> tuple[Column | None, NDArray[np.bool_] | None]:
        """Read columns of whole messages from `start` to `end`, int64[n], all within the buffer.

        In CDR they start behind the encapsulation headers. The column is None if no field is
        requested; bool[n] is True where bytes are left over behind the message, None if there are
        none. MisfitError names no payload.
        """
        cursor = _Cursor(start, end, start)
        column = self._gather(program, cursor)
        rest = end - cursor.base - cursor.delta
        most = int(rest.max(initial=0))
        if program.empty and most > self._padding:
            raise MisfitError
        if most == 0:
            return column, None
        surplus = rest > self._padding
        if self._cdr:
            surplus |= (rest > 0) & ((end - start) & 3 > 0)
        return column, surplus

    def _gather(self, program: Program, cursor: _Cursor) -> Column | None:
        """Gather the columns of the requested fields of a program; None without any."""
        rows = len(cursor.base)
        slots: list[Column | None] = [None] * program.slots
        self._walk(program, cursor, slots)
        return None if program.root is None else assemble(program.root, slots, rows)

    def _walk(self, program: Program, cursor: _Cursor, slots: list[Column | None] | None) -> None:
        """Take all steps of a program; gather columns if it has slots."""
        for step in program.steps:
            if isinstance(step, Run):
                self._run(step, cursor, slots)
                continue
            slot = None if slots is None else step.slot
            column: Column | None
            if isinstance(step, TextStep):
                column = self._text(cursor, gather=slot is not None)
            elif isinstance(step, NumbersStep):
                column = self._numbers(step, cursor, gather=slot is not None)
            else:
                column = self._array(step, cursor, gather=slot is not None)
            if slots is not None and slot is not None:
                slots[slot] = column

    def _run(self, run: Run, cursor: _Cursor, slots: list[Column | None] | None) -> None:
        first = 0
        while True:
            modulus = cursor.modulus
            phase = (cursor.phase + cursor.delta) & (modulus - 1) & self._mask
            layout = run.layout(first, phase, modulus)
            cursor.need(layout.size)
            if slots is not None:
                for distance, item in layout.wanted:
                    assert item.slot is not None
                    at = cursor.delta + distance
                    slots[item.slot] = self._source.fixed(item, cursor.base, at)
            cursor.delta += layout.size
            first = layout.stop
            if first == len(run.fields):
                return
            cursor.align(run.fields[first].align)

    def _claims(self, cursor: _Cursor) -> int | NDArray[np.int64]:
        """Lengths in 32 bits: one number if they are equal, else int64[n]."""
        if self._cdr:
            cursor.align(4)
        cursor.need(4)
        claims = self._source.u4(cursor.base, cursor.delta)
        cursor.delta += 4
        first = int(claims[0]) if len(claims) else 0
        return first if bool((claims == first).all()) else claims

    def _text(self, cursor: _Cursor, *, gather: bool) -> Strings | None:
        claims, source = self._claims(cursor), self._source
        nul = 1 if self._cdr else 0
        if isinstance(claims, int):
            cursor.need(claims)
            base, delta = cursor.base, cursor.delta
            if nul and claims and bool(source.u1(base, delta + claims - 1).any()):
                raise MisfitError
            cursor.delta += claims
            size = max(claims - nul, 0)
            even = even_offsets(len(base), size)
            return Strings(source.block(base, delta, size), even) if gather else None
        start = cursor.base + cursor.delta
        ends = start + claims
        cursor.move(ends, 0, self._least_known)
        if nul and bool(source.u1(ends[claims > 0] - 1, 0).any()):
            raise MisfitError
        sizes = np.maximum(claims - nul, 0)
        return Strings(source.ragged(start, sizes), offsets(sizes)) if gather else None

    def _numbers(self, step: NumbersStep, cursor: _Cursor, *, gather: bool) -> Arrays | None:
        claims, source, item_size = self._claims(cursor), self._source, step.kind.size
        if isinstance(claims, int):
            if claims:
                cursor.align(step.align)
            size = claims * item_size
            cursor.need(size)
            base, delta = cursor.base, cursor.delta
            cursor.delta += size
            if not gather:
                return None
            data, offset = source.block(base, delta, size), even_offsets(len(base), claims)
        else:
            start = cursor.base + cursor.delta
            if step.align > 4:
                padding = (cursor.origin - start) & (step.align - 1)
                start = np.where(claims > 0, start + padding, start)
            sizes = claims * item_size
            # Rows without elements are aligned to 4 only: the count came last.
            cursor.move(start + sizes, 0, min(item_size, 4) if self._cdr else 8)
            if not gather:
                return None
            data, offset = source.ragged(start, sizes), offsets(claims)
        return Arrays(Scalars(source.numbers(data, step.kind)), offset)

    def _array(self, step: ArrayStep, cursor: _Cursor, *, gather: bool) -> Arrays | None:
        element, end, origin = step.element, cursor.end, cursor.origin
        claims = self._claims(cursor) if step.width is None else step.width
        counts = np.full(len(end), claims, np.int64)
        room = end - cursor.base - cursor.delta
        # Before memory is allocated: the payload cannot hold that many.
        if bool((counts > (room // element.least if element.least else MAX_EMPTY_ELEMENTS)).any()):
            raise MisfitError
        values: Column | None = None
        if element.fixed and element.least:
            starts, phase, modulus = self._fixed_elements(element, cursor, counts, gather=gather)
        elif element.least:
            starts, phase, modulus = self._varying_elements(element, cursor, counts)
        elif element.root is not None:
            values = assemble(element.root, [], int(counts.sum()))
        if gather and element.least:
            ends, origins = np.repeat(end, counts), np.repeat(origin, counts)
            values = self._gather(element, _Cursor(starts, ends, origins, phase, modulus))
        if not gather:
            return None
        assert values is not None
        return Arrays(values, offsets(counts), step.width)

    def _fixed_elements(
        self, element: Program, cursor: _Cursor, counts: NDArray[np.int64], *, gather: bool
    ) -> tuple[NDArray[np.int64], int, int]:
        """Advance over elements of fixed size; returns their starts, phase and modulus to `gather`.

        From the second element of a row on, all start at one phase modulo the alignment; the
        first one may differ, and then in size, too.
        """
        align = element.align
        later = element.size(0) & (align - 1)
        stride = element.size(later)
        start = cursor.base + cursor.delta
        if cursor.modulus >= align:
            phase = (cursor.phase + cursor.delta) & (align - 1) & self._mask
            firsts = np.full(len(start), element.size(phase), np.int64)
        else:  # Only CDR reaches this: in ROS 1 all phases are known.
            phase = -1
            sizes = np.array([element.size(one) for one in range(align)], np.int64)
            firsts = sizes[(start - cursor.origin) & (align - 1)]
        extra = firsts - stride
        ends = start + np.where(counts > 0, counts * stride + extra, 0)
        cursor.move_or_step(ends, self._least_known)
        if not gather:
            return start, 0, 1
        index = ranges(np.zeros_like(counts), counts)
        starts = np.repeat(start, counts) + index * stride
        starts += np.where(index > 0, np.repeat(extra, counts), 0)
        return (starts, phase, align if self._cdr else 8) if phase == later else (starts, 0, 1)

    def _varying_elements(
        self, element: Program, cursor: _Cursor, counts: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], int, int]:
        """Advance over other elements; returns as much."""
        at = cursor.base + cursor.delta
        offset = offsets(counts)
        starts = np.empty(int(offset[-1]), np.int64)
        active = np.flatnonzero(counts)
        index = 0
        while len(active) >= _MIN_VECTOR_ROWS:
            here = at[active]
            starts[offset[active] + index] = here
            inner = _Cursor(here, cursor.end[active], cursor.origin[active], 0, self._least_known)
            self._walk(element, inner, None)
            at[active] = inner.base + inner.delta
            index += 1
            active = active[counts[active] > index]
        for row in active.tolist():
            place, end, origin = int(at[row]), int(cursor.end[row]), int(cursor.origin[row])
            for number in range(int(offset[row]) + index, int(offset[row + 1])):
                starts[number] = place
                place = self._scanner.walk(element, place, end, origin)
            at[row] = place
        cursor.move_or_step(at, self._least_known)
        return starts, 0, self._least_known
