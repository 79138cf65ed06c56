"""Compiles message types into the steps of a wire reader.

A program is a flat list of steps; nested messages are flattened. Neighbouring fields of
fixed size form one run. The layout of a run (offsets from its start, with alignment) is
computed once for each phase at which it can start. The column of each requested field goes
to a numbered slot; a tree of names assembles the slots.

Phases: CDR aligns numbers to their size, counted from the end of the encapsulation
header. The phase of a position is its distance from there modulo 8. ROS 1 does not
align; there every alignment is 1 and the phase is always 0.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, TypeAlias

from hybridlog.schema.column import Column, Records, Wanted, below, names_of
from hybridlog.schema.definition import ArrayOf, FieldType, Instant, MessageType, Primitive, Text
from hybridlog_storage.errors import DefinitionError

if TYPE_CHECKING:
    from collections.abc import Collection

Wire: TypeAlias = Literal["ros1", "cdr"]
Node: TypeAlias = "int | dict[str, Node]"
"""The slot of a requested field, or those of a message in the order of the definition."""


def assemble(node: Node, slots: list[Column | None], rows: int) -> Column:
    """Assemble the column of a tree of names from its filled slots, of `rows` rows each."""
    if isinstance(node, int):
        column = slots[node]
        assert column is not None
        return column
    return Records({name: assemble(inner, slots, rows) for name, inner in node.items()}, rows)


@dataclass(frozen=True, slots=True)
class Fixed:
    """A field of fixed size.

    Attributes:
        align: Alignment in bytes.
        size: Bytes.
        slot: Slot of its column, None if it is not requested.
        kind: Its type; None for padding.
        width: Number of elements of a fixed array, None for a single value.
    """

    path: str
    align: int
    size: int
    slot: int | None
    kind: Primitive | Instant | None
    width: int | None


@dataclass(frozen=True, slots=True)
class Layout:
    """Positions of the fields in a part of a run, from a start of known phase.

    Attributes:
        stop: Index of the first field behind it.
        size: Bytes from the start to the end of the last field.
        wanted: Distance from the start, and field, for the requested ones.
    """

    stop: int
    size: int
    wanted: tuple[tuple[int, Fixed], ...]


@dataclass(slots=True)
class Run:
    """Neighbouring fields of fixed size."""

    fields: tuple[Fixed, ...]
    _layouts: dict[tuple[int, int, int], Layout] = field(default_factory=dict)

    def layout(self, first: int, phase: int, modulus: int) -> Layout:
        """Layout from field `first` on, as far as the known phase allows.

        The start has `phase` modulo `modulus`: 1, 2, 4 or 8. Fields of larger alignment cannot be
        placed; if the first one is such a field, the layout is empty.
        """
        key = (first, phase, modulus)
        found = self._layouts.get(key)
        if found is None:
            found = self._layouts[key] = self._place(first, phase, modulus)
        return found

    def _place(self, first: int, phase: int, modulus: int) -> Layout:
        at = phase
        stop = first
        wanted = []
        for item in self.fields[first:]:
            if item.align > modulus:
                break
            at += -at & (item.align - 1)
            if item.slot is not None:
                wanted.append((at - phase, item))
            at += item.size
            stop += 1
        return Layout(stop, at - phase, tuple(wanted))

    def size(self, phase: int) -> int:
        """Bytes of the whole run from a start of that phase (0 to 7)."""
        return self.layout(0, phase, 8).size

    def cut(self, phase: int, room: int) -> str:
        """Path of the first field that does not fit into `room` bytes."""
        ends = []
        at = phase
        for item in self.fields:
            at += (-at & (item.align - 1)) + item.size
            ends.append(at - phase)
        return self.fields[bisect_right(ends, room)].path


@dataclass(frozen=True, slots=True)
class TextStep:
    """A string: its length in 32 bits, then its bytes (in CDR with a final NUL)."""

    path: str
    slot: int | None


@dataclass(frozen=True, slots=True)
class NumbersStep:
    """A sequence of numbers: their count in 32 bits, then the numbers."""

    path: str
    slot: int | None
    kind: Primitive
    align: int


@dataclass(frozen=True, slots=True)
class ArrayStep:
    """An array or a sequence of anything else; without `width`, the count is on the wire."""

    path: str
    slot: int | None
    width: int | None
    element: Program


Step: TypeAlias = Run | TextStep | NumbersStep | ArrayStep


@dataclass(slots=True)
class Program:
    """Steps that read one message, or one element of an array.

    Attributes:
        root: Assembles the slots; None if no field is requested.
        least: Its minimum size in bytes.
        align: Largest alignment of its fields of fixed size.
        fixed: True if its size depends only on the phase of its start.
    """

    steps: tuple[Step, ...]
    slots: int
    root: Node | None
    least: int = field(init=False)
    align: int = field(init=False)
    fixed: bool = field(init=False)
    empty: bool = field(init=False)
    _sizes: list[int | None] = field(init=False)

    def __post_init__(self) -> None:
        self._sizes = [None] * 8
        self.least = sum(_least(step) for step in self.steps)
        self.align = max((_align(step) for step in self.steps), default=1)
        self.fixed = all(_is_fixed(step) for step in self.steps)
        self.empty = all(
            isinstance(step, Run) and all(item.kind is None for item in step.fields)
            for step in self.steps
        )

    def size(self, phase: int) -> int:
        """Bytes from a start of that phase (0 to 7). Only for fixed programs."""
        size = self._sizes[phase]
        if size is None:
            at = phase
            for step in self.steps:
                if isinstance(step, Run):
                    at += step.size(at & 7)
                elif isinstance(step, ArrayStep) and step.width is not None:
                    at += step.element.span(at & 7, step.width)
            size = self._sizes[phase] = at - phase
        return size

    def span(self, phase: int, count: int) -> int:
        """Bytes of `count` consecutive elements. Only for fixed programs.

        From the second element on all start at the same phase modulo `align`: a member of that
        alignment precedes each of them at the same distance.
        """
        if count == 0:
            return 0
        first = self.size(phase)
        return first + (count - 1) * self.size((phase + first) & 7)


def _least(step: Step) -> int:
    if isinstance(step, Run):
        return sum(item.size for item in step.fields)
    if isinstance(step, ArrayStep) and step.width is not None:
        return step.width * step.element.least
    return 4


def _align(step: Step) -> int:
    if isinstance(step, Run):
        return max(item.align for item in step.fields)
    return step.element.align if isinstance(step, ArrayStep) else 1


def _is_fixed(step: Step) -> bool:
    if isinstance(step, ArrayStep):
        return step.width is not None and step.element.fixed
    return isinstance(step, Run)


class _Compiler:
    def __init__(self, wire: Wire) -> None:
        self._wire = wire
        self._steps: list[Step] = []
        self._run: list[Fixed] = []
        self._slots = 0

    def program(self, field_type: FieldType, path: str, wanted: Wanted) -> Program:
        root = self._add(field_type, path, wanted)
        self._flush()
        return Program(tuple(self._steps), self._slots, root)

    def _flush(self) -> None:
        if self._run:
            self._steps.append(Run(tuple(self._run)))
            self._run = []

    def _slot(self, wanted: Wanted) -> int | None:
        # A path below a field without fields does not exist.
        if wanted is not None:
            return None
        self._slots += 1
        return self._slots - 1

    def _align(self, size: int) -> int:
        return size if self._wire == "cdr" else 1

    def _add(self, field_type: FieldType, path: str, wanted: Wanted) -> Node | None:
        if isinstance(field_type, MessageType):
            return self._message(field_type, path, wanted)
        if isinstance(field_type, ArrayOf):
            return self._array(field_type, path, wanted)
        slot = self._slot(wanted)
        if isinstance(field_type, Text):
            self._flush()
            self._steps.append(TextStep(path, slot))
        else:
            self._fixed(field_type, path, slot, None)
        return slot

    def _fixed(
        self, kind: Primitive | Instant, path: str, slot: int | None, width: int | None
    ) -> None:
        size, align = (8, 4) if isinstance(kind, Instant) else (kind.size,) * 2
        total = size * (1 if width is None else width)
        self._run.append(Fixed(path, self._align(align), total, slot, kind, width))

    def _message(self, message: MessageType, path: str, wanted: Wanted) -> Node | None:
        if not message.fields and self._wire == "cdr":
            # IDL has no empty struct, so ROS 2 sends one byte instead.
            self._run.append(Fixed(path or message.name, 1, 1, None, None, None))
        found: dict[str, Node] = {}
        for name, field_type in message.fields:
            own = f"{path}.{name}" if path else name
            node = self._add(field_type, own, below(wanted, name))
            if node is not None:
                found[name] = node
        return found if found or wanted is None else None

    def _array(self, array: ArrayOf, path: str, wanted: Wanted) -> int | None:
        element = array.element
        if isinstance(element, Primitive | Instant) and array.width is not None:
            slot = self._slot(wanted)
            self._fixed(element, path, slot, array.width)
            return slot
        self._flush()
        if isinstance(element, Primitive):
            slot = self._slot(wanted)
            self._steps.append(NumbersStep(path, slot, element, self._align(element.size)))
            return slot
        inner = _Compiler(self._wire).program(element, f"{path}[]", wanted)
        if inner.least == 0 and inner.steps:
            raise DefinitionError(f"not indexed: {path} nests arrays of messages without fields")
        slot = self._slot([] if inner.root is None else None)
        self._steps.append(ArrayStep(path, slot, array.width, inner))
        return slot


def compile_type(message_type: MessageType, wire: Wire, fields: Collection[str] | None) -> Program:
    """Compile a message type to gather fields by dotted paths; None for all.

    Unknown ones are ignored. Elements that take no bytes and hold arrays raise DefinitionError.
    """
    wanted = None if fields is None else [*map(names_of, fields)]
    return _Compiler(wire).program(message_type, "", wanted)
