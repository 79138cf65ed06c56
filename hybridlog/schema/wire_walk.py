"""Walks over many payloads at once and gathers their columns.

All rows take the same steps. Their positions are a vector (`base`) plus a number
(`delta`). The vector changes only behind fields of varying length, so most fields cost only
their gather. Bounds take one comparison for each run: `room` is the smallest distance from
`base` to the end of the payload over all rows.

A row that does not fit stops the walk. The reader then finds these rows and restarts
without them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hybridlog.schema.column import Arrays, Column, Scalars, Strings, offsets, ranges
from hybridlog.schema.wire_gather import (
    Source,
    empty_fixed,
    even_offsets,
)
from hybridlog.schema.wire_program import (
    ArrayStep,
    NumbersStep,
    Program,
    Run,
    TextStep,
    Wire,
    assemble,
)
from hybridlog.schema.wire_scan import (
    MAX_EMPTY_ELEMENTS,
    MAX_PADDING,
    MisfitError,
    Scanner,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

# Rows below which walking over elements is faster one row at a time.
_MIN_VECTOR_ROWS = 12


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
        self.room = int((self.end - base).min())
        if self.room < 0:
            raise MisfitError

    def move_or_step(self, positions: NDArray[np.int64], modulus: int) -> None:
        """Move to new positions; the phase stays known if the step is equal for all rows.

        Otherwise the phase is 0 modulo `modulus`.
        """
        step = positions - self.base
        first = int(step[0])
        if len(step) == 1 or bool((step == first).all()):
            self.delta = first
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
        self._count_align = 4 if self._cdr else 1
        self._padding = MAX_PADDING[wire]

    def read(
        self, program: Program, start: NDArray[np.int64], end: NDArray[np.int64]
    ) -> tuple[Column | None, NDArray[np.bool_] | None]:
        """Read columns of whole messages from `start` to `end`, int64[n], all within the buffer.

        In CDR they start behind the encapsulation headers. The column is None if no field is
        requested; bool[n] is True where bytes are left over behind the message, None if there are
        none. MisfitError names no payload.
        """
        slots: list[Column | None] = [None] * program.slots
        if len(start) == 0:
            return self._empty(program), None
        cursor = _Cursor(start, end, start)
        self._walk(program, cursor, slots)
        surplus = None
        rest = end - cursor.base - cursor.delta
        most = int(rest.max())
        if program.empty and most > self._padding:
            raise MisfitError
        if most > 0:
            surplus = rest > self._padding
            if self._cdr:
                surplus |= (rest > 0) & ((end - start) & 3 > 0)
        column = None if program.root is None else assemble(program.root, slots, len(start))
        return column, surplus

    def _walk(self, program: Program, cursor: _Cursor, slots: list[Column | None] | None) -> None:
        """Take all steps of a program; gather columns if it has slots."""
        for step in program.steps:
            if isinstance(step, Run):
                self._run(step, cursor, slots)
            elif isinstance(step, TextStep):
                self._text(step, cursor, slots)
            elif isinstance(step, NumbersStep):
                self._numbers(step, cursor, slots)
            else:
                self._array(step, cursor, slots)

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
                    slots[item.slot] = self._source.fixed(
                        item, cursor.base, cursor.delta + distance
                    )
            cursor.delta += layout.size
            first = layout.stop
            if first == len(run.fields):
                return
            cursor.align(run.fields[first].align)

    def _claims(self, cursor: _Cursor) -> int | NDArray[np.int64]:
        """Lengths in 32 bits: one number if they are equal, else int64[n]."""
        if self._count_align > 1:
            cursor.align(self._count_align)
        cursor.need(4)
        claims = self._source.u4(cursor.base, cursor.delta)
        cursor.delta += 4
        first = int(claims[0])
        if len(claims) == 1 or bool((claims == first).all()):
            return first
        return claims

    def _text(self, step: TextStep, cursor: _Cursor, slots: list[Column | None] | None) -> None:
        claims = self._claims(cursor)
        source = self._source
        gather = slots is not None and step.slot is not None
        nul = 1 if self._cdr else 0
        column: Column | None = None
        if isinstance(claims, int):
            cursor.need(claims)
            base, delta = cursor.base, cursor.delta
            if nul and claims and bool(source.u1(base, delta + claims - 1).any()):
                raise MisfitError
            if gather:
                size = max(claims - nul, 0)
                column = Strings(source.block(base, delta, size), even_offsets(len(base), size))
            cursor.delta += claims
        else:
            start = cursor.base + cursor.delta
            ends = start + claims
            cursor.move(ends, 0, 1 if self._cdr else 8)
            if nul:
                filled = ends if bool(claims.all()) else ends[claims > 0]
                if bool(source.u1(filled - 1, 0).any()):
                    raise MisfitError
            if gather:
                sizes = np.maximum(claims - nul, 0)
                column = Strings(source.ragged(start, sizes), offsets(sizes))
        if slots is not None and step.slot is not None:
            slots[step.slot] = column

    def _numbers(
        self, step: NumbersStep, cursor: _Cursor, slots: list[Column | None] | None
    ) -> None:
        claims = self._claims(cursor)
        source = self._source
        gather = slots is not None and step.slot is not None
        item_size = step.kind.size
        data: NDArray[np.uint8] | None = None
        if isinstance(claims, int):
            if claims:
                cursor.align(step.align)
            cursor.need(claims * item_size)
            if gather:
                data = source.block(cursor.base, cursor.delta, claims * item_size)
                offset = even_offsets(len(cursor.base), claims)
            cursor.delta += claims * item_size
        else:
            start = cursor.base + cursor.delta
            if step.align > 4:
                padding = (cursor.origin - start) & (step.align - 1)
                start = np.where(claims > 0, start + padding, start)
            sizes = claims * item_size
            # Rows without elements are aligned to 4 only: the count came last.
            cursor.move(start + sizes, 0, min(item_size, 4) if self._cdr else 8)
            if gather:
                data = source.ragged(start, sizes)
                offset = offsets(claims)
        if data is not None and slots is not None and step.slot is not None:
            slots[step.slot] = Arrays(Scalars(source.numbers(data, step.kind)), offset)

    def _array(self, step: ArrayStep, cursor: _Cursor, slots: list[Column | None] | None) -> None:
        counts = self._claims(cursor) if step.width is None else step.width
        if slots is None or step.slot is None:
            self._elements(step.element, cursor, counts)
            return
        rows = len(cursor.base)
        end, origin = cursor.end, cursor.origin
        found = self._elements(step.element, cursor, counts)
        offset = even_offsets(rows, counts) if isinstance(counts, int) else offsets(counts)
        total = int(offset[-1])
        if found is None or total == 0:
            values = self._valueless(step.element, total)
        else:
            starts, phase, modulus = found
            each_end, each_origin = np.repeat(end, counts), np.repeat(origin, counts)
            inner = _Cursor(starts, each_end, each_origin, phase, modulus)
            values = self._gather(step.element, inner)
        slots[step.slot] = Arrays(values, offset, step.width)

    def _gather(self, program: Program, cursor: _Cursor) -> Column:
        """Gather the columns of a program with requested fields."""
        assert program.root is not None
        slots: list[Column | None] = [None] * program.slots
        rows = len(cursor.base)
        self._walk(program, cursor, slots)
        return assemble(program.root, slots, rows)

    def _valueless(self, element: Program, total: int) -> Column:
        """Columns of no elements, or of elements without bytes."""
        if total == 0:
            column = self._empty(element)
            assert column is not None
            return column
        assert element.root is not None
        return assemble(element.root, [], total)

    def _elements(
        self, element: Program, cursor: _Cursor, counts: int | NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], int, int] | None:
        """Advance over all elements; returns their starts, and phase and modulus as far as known.

        Returns None if elements take no bytes.
        """
        most = counts if isinstance(counts, int) else int(counts.max())
        if element.least == 0:
            if most > MAX_EMPTY_ELEMENTS:
                raise MisfitError
            return None
        # Before memory is allocated: the payload cannot hold that many.
        if isinstance(counts, int):
            cursor.need(counts * element.least)
        elif bool((counts > (cursor.end - cursor.base - cursor.delta) // element.least).any()):
            raise MisfitError
        if element.fixed:
            return self._fixed_elements(element, cursor, counts)
        return self._varying_elements(element, cursor, counts), 0, 1 if self._cdr else 8

    def _fixed_elements(
        self, element: Program, cursor: _Cursor, counts: int | NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], int, int]:
        align = element.align
        # From the second element on, all start at this phase (modulo `align`).
        later = element.size(0) & (align - 1)
        stride = element.size(later)
        start = cursor.base + cursor.delta
        if cursor.modulus >= align:
            phase = (cursor.phase + cursor.delta) & (align - 1) & self._mask
            first = element.size(phase)
            if isinstance(counts, int):
                span = element.span(phase, counts)
                cursor.need(span)
                cursor.delta += span
                distance = np.arange(counts, dtype=np.int64) * stride
                distance[1:] += first - stride
                starts = (start[:, None] + distance).ravel()
            else:
                firsts = np.full(len(start), first, np.int64)
                starts = self._spread(cursor, start, counts, firsts, stride)
            if phase == later:
                return starts, phase, align if self._cdr else 8
            return starts, 0, 1
        # Only CDR reaches this: in ROS 1 all phases are known.
        sizes = np.array([element.size(phase) for phase in range(align)], np.int64)
        firsts = sizes[(start - cursor.origin) & (align - 1)]
        if isinstance(counts, int):
            counts = np.full(len(start), counts, np.int64)
        return self._spread(cursor, start, counts, firsts, stride), 0, 1

    def _spread(
        self,
        cursor: _Cursor,
        start: NDArray[np.int64],
        counts: NDArray[np.int64],
        firsts: NDArray[np.int64],
        stride: int,
    ) -> NDArray[np.int64]:
        """Starts of elements of fixed size; the first of a row may differ in size."""
        extra = firsts - stride
        ends = start + np.where(counts > 0, counts * stride + extra, 0)
        cursor.move_or_step(ends, self._least_known())
        index = ranges(np.zeros_like(counts), counts)
        starts = np.repeat(start, counts)
        starts += index * stride
        starts += np.where(index > 0, np.repeat(extra, counts), 0)
        return starts

    def _varying_elements(
        self, element: Program, cursor: _Cursor, counts: int | NDArray[np.int64]
    ) -> NDArray[np.int64]:
        at = cursor.base + cursor.delta
        rows = len(at)
        each = np.full(rows, counts, np.int64) if isinstance(counts, int) else counts
        offset = offsets(each)
        starts = np.empty(int(offset[-1]), np.int64)
        active = np.flatnonzero(each)
        index = 0
        while len(active) >= _MIN_VECTOR_ROWS:
            here = at[active]
            starts[offset[active] + index] = here
            inner = _Cursor(here, cursor.end[active], cursor.origin[active], 0, self._least_known())
            self._walk(element, inner, None)
            at[active] = inner.base + inner.delta
            index += 1
            active = active[each[active] > index]
        for row in active.tolist():
            found, after = self._scanner.elements(
                element,
                int(at[row]),
                int(cursor.end[row]),
                int(cursor.origin[row]),
                int(each[row]) - index,
            )
            starts[int(offset[row]) + index : int(offset[row + 1])] = found
            at[row] = after
        cursor.move_or_step(at, self._least_known())
        return starts

    def _least_known(self) -> int:
        """The known modulus of a phase behind a field of varying length."""
        return 1 if self._cdr else 8

    def _empty(self, program: Program) -> Column | None:
        """Columns of a program for no rows."""
        if program.root is None:
            return None
        slots: list[Column | None] = [None] * program.slots
        none = np.zeros(1, np.int64)
        for step in program.steps:
            if isinstance(step, Run):
                for item in step.fields:
                    if item.slot is not None:
                        slots[item.slot] = empty_fixed(item)
            elif step.slot is None:
                continue
            elif isinstance(step, TextStep):
                slots[step.slot] = Strings(np.empty(0, np.uint8), none)
            elif isinstance(step, NumbersStep):
                slots[step.slot] = Arrays(Scalars(np.empty(0, step.kind.dtype)), none)
            else:
                values = self._empty(step.element)
                assert values is not None
                slots[step.slot] = Arrays(values, none, step.width)
        return assemble(program.root, slots, 0)
