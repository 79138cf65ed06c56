"""Walks over one payload, value by value, to check or measure it.

The slow counterpart of the column reader. It locates problems in a payload, and finds the
elements of arrays if there are too few rows for column arithmetic. It allocates nothing,
and accepts a claimed length only if that many bytes are left.
"""

from __future__ import annotations

from struct import Struct
from typing import TYPE_CHECKING

from hybridlog.schema.wire_program import ArrayStep, NumbersStep, Run, TextStep

if TYPE_CHECKING:
    from hybridlog.schema.wire_gather import Source
    from hybridlog.schema.wire_program import Program, Step, Wire

MAX_EMPTY_ELEMENTS = 1_000_000
"""Most elements of an array whose elements take no bytes."""
MAX_PADDING = {"ros1": 0, "cdr": 3}
"""Most bytes that fill up a payload; in CDR to a multiple of four."""

_U4 = {"<": Struct("<I"), ">": Struct(">I")}


class MisfitError(Exception):
    """A payload does not fit its definition; the message names the place."""


class Scanner:
    """Walks over payloads of one buffer."""

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
        count = step.width
        if count is None:
            count, at = self._count(step, at, end, origin)
        element = step.element
        if element.least == 0:
            if count > MAX_EMPTY_ELEMENTS:
                raise MisfitError(f"{step.path} claims {count} elements that take no bytes")
            return at
        if count * element.least > end - at:
            raise MisfitError(f"{step.path} claims {count} elements, {end - at} bytes remain")
        if element.fixed:
            size = element.span((at - origin) & self._mask, count)
            if size > end - at:
                raise MisfitError(f"{step.path} claims {count} elements, {end - at} bytes remain")
            return at + size
        for _ in range(count):
            at = self.walk(element, at, end, origin)
        return at

    def elements(
        self, program: Program, at: int, end: int, origin: int, count: int
    ) -> tuple[list[int], int]:
        """Start of each of `count` elements, and the position behind the last."""
        starts = []
        for _ in range(count):
            starts.append(at)
            at = self.walk(program, at, end, origin)
        return starts, at
