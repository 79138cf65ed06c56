"""Predicates on one message in memory: the reference semantics.

`to_mask` gives the same answer of columns. Arrays may be summarised, as in what is left of
messages without payload; what a summary cannot decide raises `UndecidedError`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, TypeAlias, TypeGuard, cast

from hybridlog.query.predicate.numbers import equal, ordered
from hybridlog.query.predicate.regex import compile_regex
from hybridlog.query.predicate.tree import (
    And,
    Compare,
    Condition,
    Exists,
    Field,
    Match,
    Member,
    MongoFilter,
    Near,
    Node,
    Not,
    Or,
    Parts,
    Predicate,
    Slice,
    Test,
    Value,
    root_of,
    spelled,
)
from hybridlog.query.predicate.types import STATS, FieldTypes, Stat
from hybridlog.schema.text import repaired_text
from hybridlog_storage.errors import WhereError

Message: TypeAlias = Mapping[str, object]
"""A decoded message: dict, list, str, bytes, bool, int, float, None."""

_Names: TypeAlias = tuple[str, ...]
_WITH_NUMBERS = frozenset(STATS)
_SUMMARIES = (_WITH_NUMBERS, frozenset({"n"}))


class UndecidedError(Exception):
    """Only a summary of an array is there, which cannot decide."""


def to_bool(
    node: Predicate | Node,
    types: FieldTypes | Mapping[str, str] | None = None,
    *,
    summarised: bool = False,
) -> Test:
    """A predicate as a test of single messages; it may raise `UndecidedError`.

    Args:
        node: The predicate.
        types: Types of the fields; None if each message decides.
        summarised: True if messages without types have summaries for long arrays.

    Raises:
        WhereError: it has a MongoDB filter.
    """
    return _node(root_of(node), _Reader(FieldTypes.of(types), summarised))


class _Summary(NamedTuple):
    """A summary in place of an array.

    Attributes:
        numbers: The summary, with `min` and `max` of numbers.
        booleans: True if the elements may be booleans.
    """

    numbers: Mapping[str, object]
    booleans: bool


@dataclass(frozen=True, slots=True)
class _Reader:
    """Follows paths into messages.

    Attributes:
        types: Types of the fields.
        summarised: True if arrays without types may be summaries.
    """

    types: FieldTypes
    summarised: bool

    def leaves(self, message: Message, target: Field) -> list[object]:
        """Everything at a path: values, whole arrays, statistics of arrays, summaries."""
        parts = target.parts
        stat = self.types.statistic(parts)
        if stat is None:
            return list(self._reach(message, parts, ()))
        arrays = list(self._values(message, parts[:-1], ()))
        found: list[object] = []
        if self.types.known:
            for array in arrays:
                found.extend(self._typed_statistic(stat, array, parts[:-1]))
            return found
        found.extend(self._reach(message, parts, ()))
        found.extend(
            statistic(stat, array)
            for array in arrays
            if isinstance(array, list) and _has_statistic(array, stat)
        )
        return found

    def elements(self, values: list[object]) -> Iterator[object]:
        """The elements of an array, also those of the arrays in it."""
        for value in _flat(values):
            if not self.types.known and self._is_summary(value, (), element=True):
                raise UndecidedError
            yield value

    def _typed_statistic(self, stat: Stat, array: object, parts: Parts) -> Iterator[object]:
        if isinstance(array, list | bytes):
            kind = self.types.kind(".".join(part for part in parts if isinstance(part, str)))
            if stat == "n" or kind != "other":
                yield statistic(stat, array)
        elif isinstance(array, Mapping) and stat in array:
            yield array[stat]

    def _is_summary(
        self, value: object, names: _Names, *, element: bool
    ) -> TypeGuard[Mapping[str, object]]:
        if not isinstance(value, Mapping):
            return False
        if self.types.known:
            # The types list the array, not its elements.
            return not element and ".".join(names) in self.types.arrays
        counts = isinstance(value.get("n"), int)
        return self.summarised and counts and value.keys() in _SUMMARIES

    def _reach(
        self, value: object, parts: Parts, names: _Names, *, element: bool = False
    ) -> Iterator[object]:
        """The values at a path; through an array, those of each element."""
        if self._is_summary(value, names, element=element):
            yield self._of_summary(value, parts, names)
            return
        if not parts:
            yield value
            return
        part, rest = parts[0], parts[1:]
        if isinstance(part, Slice):
            if isinstance(value, list):
                yield from self._reach(part.of(value), rest, names)
        elif isinstance(value, Mapping):
            if str(part) in value:
                yield from self._reach(value[str(part)], rest, (*names, str(part)))
        elif isinstance(value, list):
            yield from self._into_list(value, parts, names)

    def _of_summary(self, value: Mapping[str, object], parts: Parts, names: _Names) -> object:
        """The summary at a path, or one of its numbers where it may also be a message."""
        if "min" in value and not self.types.known and len(parts) == 1 and parts[0] in value:
            return value[str(parts[0])]
        if parts:
            raise UndecidedError
        booleans = not self.types.known or self.types.kind(".".join(names)) == "bool"
        return _Summary(value, booleans)

    def _into_list(self, values: list[object], parts: Parts, names: _Names) -> Iterator[object]:
        """The values at a path through an array."""
        part = parts[0]
        if isinstance(part, int) and part < len(values):
            yield from self._reach(values[part], parts[1:], names, element=True)
        # MongoDB also accepts a number as a name.
        for inner in _flat(values) if isinstance(part, str) else values:
            if self._is_summary(inner, names, element=True):
                raise UndecidedError
            if isinstance(inner, Mapping):
                yield from self._reach(inner, parts, names, element=True)

    def _values(
        self, value: object, parts: Parts, names: _Names, *, element: bool = False
    ) -> Iterator[object]:
        """The values at a path as a whole: a last array is not split into elements."""
        if not parts:
            yield value
            return
        if self._is_summary(value, names, element=element):
            raise UndecidedError
        part, rest = parts[0], parts[1:]
        if isinstance(part, Slice):
            if isinstance(value, list):
                yield from self._values(part.of(value), rest, names)
            return
        if isinstance(part, int) and isinstance(value, list) and part < len(value):
            yield from self._values(value[part], rest, names, element=True)
        # MongoDB also accepts a number as a name.
        inside = value if isinstance(part, int) and isinstance(value, list) else _flat(value)
        for inner in inside:
            if isinstance(inner, Mapping) and str(part) in inner:
                yield from self._values(inner[str(part)], rest, (*names, str(part)))


def _flat(values: object) -> Iterator[object]:
    """The elements of a list, also those of the lists in it, in their order."""
    left = [values]
    while left:
        value = left.pop()
        if isinstance(value, list):
            left += reversed(value)
        else:
            yield value


def _has_statistic(values: Sequence[object], stat: Stat) -> bool:
    """True if an array has a statistic, and its elements have no field of that name."""
    if stat == "n":
        return not any(isinstance(value, Mapping) and stat in value for value in values)
    return all(isinstance(value, int | float) for value in values)


def statistic(stat: Stat, values: Sequence[object]) -> float | None:
    """A statistic of an array, equal to that in its summary in the index."""
    if stat == "n":
        return len(values)
    from hybridlog.schema.summary import summary_of

    numbers = [value for value in values if isinstance(value, int | float)]
    finite = [
        value * 1  # True counts as 1
        for value in numbers
        if isinstance(value, int) or math.isfinite(value)
    ]
    if not finite:
        return None
    if stat == "mean":
        found = summary_of(numbers)
        return float(found.mean[0]) if found is not None and found.has[0] else None
    return min(finite) if stat == "min" else max(finite)


def with_statistics(message: Message, paths: Iterable[str]) -> Message:
    """A message with statistics of its arrays as fields of their paths (`ranges.min`)."""
    found = dict(message)
    for path in paths:
        *names, stat = path.split(".")
        array: object = message
        for name in names:
            array = array.get(name) if isinstance(array, Mapping) else None
        if isinstance(array, list | bytes):
            found[path] = statistic(cast("Stat", stat), array)
    return found


def _node(node: Node, reader: _Reader) -> Test:
    match node:
        case Not(item):
            return partial(_negated, _node(item, reader))
        case And(items):
            return partial(_joined, [_node(item, reader) for item in items], False)
        case Or(items):
            return partial(_joined, [_node(item, reader) for item in items], True)
        case MongoFilter() | Near():
            raise WhereError(f"{spelled(node)} is no predicate on the message itself.")
        case Exists(target, present):
            exists = partial(_exists, reader, target)
            return exists if present else partial(_negated, exists)
        case Compare(order="!=") | Member(negated=True) | Match(negated=True):
            positive = partial(_negated, partial(_holds, reader, node.field, _test_of(node)))
            return partial(_joined, [partial(_exists, reader, node.field), positive], False)
        case Compare() | Member() | Match():
            return partial(_holds, reader, node.field, _test_of(node))


def _negated(test: Test, message: Message) -> bool:
    return not test(message)


def _joined(tests: Sequence[Test], wanted: bool, message: Message) -> bool:  # noqa: FBT001
    """True if any test is true, or, if False is wanted, False if any is false."""
    undecided: UndecidedError | None = None
    for test in tests:
        try:
            if test(message) is wanted:
                return wanted
        except UndecidedError as error:
            undecided = error
    if undecided is not None:
        raise undecided
    return not wanted


def _exists(reader: _Reader, target: Field, message: Message) -> bool:
    return bool(reader.leaves(message, target))


_Leaf: TypeAlias = Callable[[object, bool], bool]
"""Tests a value; the second argument is True for an element of an array."""


def _holds(reader: _Reader, target: Field, test: _Leaf, message: Message) -> bool:
    """True if a test holds for any value at a path."""
    undecided: UndecidedError | None = None
    for leaf in reader.leaves(message, target):
        is_list = isinstance(leaf, list)
        try:
            for value in reader.elements(leaf) if isinstance(leaf, list) else (leaf,):
                if test(value, is_list):
                    return True
        except UndecidedError as error:
            undecided = error
    if undecided is not None:
        raise undecided
    return False


def _test_of(node: Condition) -> _Leaf:
    """The test of a condition; of a negated one, the test that must fail."""
    match node:
        case Compare(order="==" | "!=", value=value):
            return partial(_is_one_of, frozenset(), (value,))
        case Compare(order=order, value=value):
            return partial(_is_ordered, order, value)
        case Member(values=values):
            integers = frozenset(value for value in values if type(value) is int)
            others = tuple(value for value in values if type(value) is not int)
            return partial(_is_one_of, integers, others)
        case Match(pattern=pattern):
            return partial(_matches, compile_regex(pattern).search)
        case Exists():
            raise AssertionError(node)


def _is_one_of(
    integers: frozenset[int],
    values: tuple[Value, ...],
    found: object,
    _element: bool,  # noqa: FBT001
) -> bool:
    if type(found) is int and found in integers:
        return True
    if isinstance(found, _Summary):
        raise UndecidedError
    values = values if type(found) is int else (*integers, *values)
    if isinstance(found, str):
        found = repaired_text(found)
    return any(equal(found, value) for value in values)


def _is_ordered(order: str, value: Value, found: object, element: bool) -> bool:  # noqa: FBT001
    if isinstance(found, _Summary):
        end = found.numbers.get("min" if order in {"<", "<="} else "max", 0)
        is_rounded = isinstance(end, float) and abs(end) >= 2**63
        # A summary counts true as 1 and false as 0.
        is_boolean = found.booleans and end in {0, 1}
        if is_rounded or is_boolean or "min" not in found.numbers:
            raise UndecidedError
        return ordered(order, end, value)
    if isinstance(found, str):
        found = repaired_text(found)
    if element and isinstance(found, float) and math.isinf(found):
        return False
    return ordered(order, found, value)


def _matches(search: Callable[[str], object], found: object, _element: bool) -> bool:  # noqa: FBT001
    if isinstance(found, _Summary):
        raise UndecidedError
    return isinstance(found, str) and search(repaired_text(found)) is not None
