"""The tree of a predicate.

Nodes are immutable, hashable and picklable. Two nodes are equal if they have the same
meaning: their places in the text are ignored, and NaN equals NaN.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, Literal, NamedTuple, TypeAlias

from msgspec import Struct

from hybridlog_storage.cache import lazy

Value: TypeAlias = bool | int | float | str
"""The operand of a comparison; times and durations are integer nanoseconds."""
Order = Literal["==", "!=", "<", "<=", ">", ">="]
Op: TypeAlias = Literal[Order, "in", "not in", "~", "!~", "exists", "missing"]
NEGATED: Final[dict[Op, Op]] = {"!=": "==", "not in": "in", "!~": "~"}
"""Operators that hold for a field that is there and does not satisfy another one."""


class _Node(Struct, frozen=True, eq=False):
    """Equality and hash of nodes, by what is shown of them: `1` is not `True`, NaN equals NaN."""

    def __repr__(self) -> str:
        names = [name for name in self.__struct_fields__ if name not in {"position", "text"}]
        shown = ", ".join(f"{name}={getattr(self, name)!r}" for name in names)
        return f"{type(self).__name__}({shown})"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Node) and repr(self) == repr(other)

    def __ne__(self, other: object) -> bool:
        return not self == other

    def __hash__(self) -> int:
        return hash(repr(self))


class Slice(NamedTuple):
    """Elements of an array; those that it does not have are left out.

    Attributes:
        begin: Number of the first element.
        end: Number of the element after the last one; None for all others.
    """

    begin: int
    end: int | None

    def __str__(self) -> str:
        return f"[{self.begin}:{'' if self.end is None else self.end}]"


Parts: TypeAlias = tuple[str | int | Slice, ...]
"""Names, numbers of elements, and slices."""


class Field(_Node, frozen=True, eq=False):
    """A field path.

    Attributes:
        parts: Names, ints for elements of arrays, slices.
        is_absolute: Without the signs of numbers, as `abs(x)`.
        position: Its place in the text.
    """

    parts: Parts
    is_absolute: bool = False
    position: int = 0

    @property
    def path(self) -> str:
        """The path as MongoDB writes it: `position.0`; it has no slices: `ranges.[0:9]`."""
        return ".".join(map(str, self.parts))

    @property
    def names(self) -> str:
        """The path without array indexes, as in the types of fields."""
        return ".".join(part for part in self.parts if isinstance(part, str))


class Condition(_Node, frozen=True, eq=False):
    """A condition on a field: `x < 5`, `x in [1, 2]`, `x ~ "^a"`, `x exists`.

    Attributes:
        operands: The value that it is compared with; of `in` several, of `exists` none; of `~` a
            pattern in RE2's syntax.
        other: The field that it is compared with, which must exist besides; None for operands.
        position: Place of the operands in the text.
    """

    field: Field
    op: Op
    operands: tuple[Value, ...] = ()
    other: Field | None = None
    position: int = 0


class And(_Node, frozen=True, eq=False):
    """All of the items hold; without items, always."""

    items: tuple[Node, ...]


class Or(_Node, frozen=True, eq=False):
    """One of the items holds."""

    items: tuple[Node, ...]


class Not(_Node, frozen=True, eq=False):
    """The item does not hold."""

    item: Node


class Near(_Node, frozen=True, eq=False):
    """A message of another topic near in time, as `Query.where` answers it.

    Attributes:
        topic: As written.
        item: What that message satisfies.
    """

    topic: str
    item: Node


class MongoFilter(_Node, frozen=True, eq=False):
    """A MongoDB filter, at the root of a predicate or in an `And` there.

    Attributes:
        filter: The filter in BSON.
        paths: The paths that it asks for, and whether for their values.
    """

    filter: bytes
    paths: tuple[tuple[str, bool], ...]

    def to_filter(self) -> dict[str, object]:
        """The filter as a new dictionary."""
        import bson

        return bson.decode(self.filter)

    @property
    def asks_fields(self) -> bool:
        """True if it is about fields of the message."""
        return not all(is_meta(path) or path.split(".")[0] == "_id" for path, _ in self.paths)


ALWAYS: Final = And(())
"""The condition that every message satisfies."""
Node: TypeAlias = Condition | And | Or | Not | Near | MongoFilter


class Predicate(_Node, frozen=True, eq=False, dict=True):
    """A predicate that was parsed and checked.

    Attributes:
        root: The tree.
        text: The text as written, to be shown.
    """

    root: Node
    text: str = ""

    def __bool__(self) -> bool:
        """True if it has any condition."""
        return self.root != ALWAYS

    def __and__(self, other: Predicate) -> Predicate:
        """Both predicates hold."""
        target = [each for each in (self, other) if each]
        if len(target) < 2:
            return target[0] if target else self
        items = [
            item
            for each in target
            for item in (each.root.items if isinstance(each.root, And) else (each.root,))
        ]
        return Predicate(And(tuple(items)), " and ".join(f"({each.text})" for each in target))

    def conditions(self) -> Iterator[Condition]:
        """Every single condition, from left to right."""
        return (node for node in nodes(self.root) if isinstance(node, Condition))

    def fields(self) -> list[str]:
        """The paths in the predicate, as MongoDB writes them, without duplicates."""
        return list(dict.fromkeys(condition.field.path for condition in self.conditions()))

    @lazy
    def asks_fields(self) -> bool:
        """True if it is about fields of the message, not only about `_meta`."""
        return not all(map(is_meta, self.fields())) or any(
            each.asks_fields for each in self.filters
        )

    @lazy
    def is_across(self) -> bool:
        """True if it has conditions on other topics."""
        return any(isinstance(node, Near) for node in nodes(self.root))

    @lazy
    def filters(self) -> tuple[MongoFilter, ...]:
        """The MongoDB filters in it."""
        return tuple(node for node in nodes(self.root) if isinstance(node, MongoFilter))


def is_meta(path: str) -> bool:
    """True if a path leads into `_meta`, which hybridlog adds to a message."""
    return path == "_meta" or path.startswith("_meta.")


def root_of(node: Predicate | Node) -> Node:
    """The tree of a predicate; a node is returned as it is."""
    return node.root if isinstance(node, Predicate) else node


def nodes(node: Node) -> Iterator[Node]:
    """All nodes of a tree but those of other topics, parents first, from left to right."""
    yield node
    match node:
        case And(items) | Or(items):
            for item in items:
                yield from nodes(item)
        case Not(item):
            yield from nodes(item)
        case _:
            pass
