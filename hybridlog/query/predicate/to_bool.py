"""Predicates on one message in memory: the reference semantics.

Every other engine gives the same answer as `to_bool` on the decoded message. Arrays may
be summarised, as in index documents and reduced messages. A condition that a summary
cannot decide is neither true nor false, and a predicate holds when it is certainly true.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TypeAlias, TypeGuard, cast

from hybridlog.query.predicate.numbers import equal, is_number, nearest, ordered
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
    Node,
    Not,
    Or,
    Parts,
    Predicate,
    Slice,
    Test,
    Value,
    root_of,
)
from hybridlog.query.predicate.types import STATS, FieldTypes, Stat
from hybridlog.schema.text import repaired_text
from hybridlog_storage.errors import WhereError

Message: TypeAlias = Mapping[str, object]
"""A decoded message: dict, list, str, bytes, bool, int, float, None."""
Truth: TypeAlias = bool | None
"""None if a summary cannot decide."""
Decision: TypeAlias = Callable[[Message], Truth]

_Names: TypeAlias = tuple[str, ...]
_WITH_NUMBERS = frozenset(STATS)
_SUMMARIES = (_WITH_NUMBERS, frozenset({"n"}))


def to_bool(
    node: Predicate | Node,
    types: FieldTypes | Mapping[str, str] | None = None,
    *,
    summarised: bool = False,
) -> Test:
    """A predicate as a test of single messages.

    Args:
        node: The predicate.
        types: Types of the fields; None if each message decides.
        summarised: True if messages without types have summaries for long arrays.

    Raises:
        WhereError: it has a MongoDB filter.
    """
    decide = to_truth(node, types, summarised=summarised)
    return lambda message: decide(message) is True


def to_truth(
    node: Predicate | Node,
    types: FieldTypes | Mapping[str, str] | None = None,
    *,
    summarised: bool = False,
) -> Decision:
    """A predicate as a function that returns None when a summary cannot decide.

    Args:
        node: The predicate.
        types: As for `to_bool`.
        summarised: As for `to_bool`.

    Raises:
        WhereError: it has a MongoDB filter.
    """
    reader = _Reader(FieldTypes.of(types), summarised)
    return _node(root_of(node), reader)


@dataclass(frozen=True, slots=True)
class _Hidden:
    """Elements, or fields of elements, of an array that is present only as a summary.

    Attributes:
        least: The least finite element; None if unknown, or if there is none.
        greatest: The greatest finite element, or None.
        surely: True if the path certainly leads to a value.
        elements: True if the path leads to the array itself.
        numeric: True if the elements are numbers or booleans.
        booleans: True if they are booleans; None if unknown.
    """

    least: object
    greatest: object
    surely: bool
    elements: bool
    numeric: bool
    booleans: bool | None

    def may_equal(self, wanted: Value) -> bool:
        """True if an element may be equal to a value."""
        if not self.numeric:
            return True
        if isinstance(wanted, bool):
            return self.booleans is not False
        if not is_number(wanted) or self.booleans:
            return False
        if isinstance(wanted, float) and not math.isfinite(wanted):
            return True
        if not is_number(self.least) or not is_number(self.greatest):
            return False
        # Ends beyond int64 may be rounded to doubles.
        low, high = nearest(self.least), nearest(self.greatest)
        return low <= nearest(wanted) <= high

    def is_ordered(self, order: str, wanted: Value) -> Truth:
        """True if an element satisfies the order; None if the summary cannot decide."""
        if not self.numeric:
            return None
        if not self.elements:
            return None if is_number(wanted) and not self.booleans else False
        end = self.least if order in {"<", "<="} else self.greatest
        if not is_number(wanted) or self.booleans or not is_number(end):
            return False
        rounded = isinstance(end, float) and abs(end) >= 2**63
        if rounded and nearest(wanted) == end:
            return None
        found = ordered(order, end, wanted)
        # A summary counts true as 1 and false as 0.
        return None if found and self.booleans is None and end in {0, 1} else found


_UNKNOWN = _Hidden(None, None, surely=False, elements=False, numeric=False, booleans=None)
"""Result for a name in the summary of an element: nothing, if that is an array."""
_OF_SOME_ELEMENTS = dataclasses.replace(_UNKNOWN, surely=True)
"""A statistic of some elements of an array that is present only as a summary."""


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
        """Everything at a path: values, whole arrays, statistics of arrays, hidden elements."""
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
                yield from _hidden(value, (), None)
            else:
                yield value

    def _typed_statistic(self, stat: Stat, array: object, parts: Parts) -> Iterator[object]:
        if isinstance(array, list | bytes):
            kind = self.types.kind(".".join(part for part in parts if isinstance(part, str)))
            if stat == "n" or kind != "other":
                yield statistic(stat, array)
        elif isinstance(array, _Hidden):
            # What is known of all elements says nothing of the statistics of some.
            yield _OF_SOME_ELEMENTS if isinstance(parts[-1], Slice) else array
        elif isinstance(array, Mapping) and stat in array:
            yield array[stat]

    def _are_booleans(self, names: _Names) -> bool | None:
        return self.types.kind(".".join(names)) == "bool" if self.types.known else None

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
            if not self.types.known and len(parts) == 1 and parts[0] in value and "min" in value:
                yield value[str(parts[0])]
            else:
                yield from _hidden(value, parts, self._are_booleans(names))
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

    def _into_list(self, values: list[object], parts: Parts, names: _Names) -> Iterator[object]:
        """The values at a path through an array."""
        part = parts[0]
        if isinstance(part, int) and part < len(values):
            yield from self._reach(values[part], parts[1:], names, element=True)
        # MongoDB also accepts a number as a name.
        for inner in _flat(values) if isinstance(part, str) else values:
            if self._is_summary(inner, names, element=True):
                yield _UNKNOWN
            elif isinstance(inner, Mapping):
                yield from self._reach(inner, parts, names, element=True)

    def _values(
        self, value: object, parts: Parts, names: _Names, *, element: bool = False
    ) -> Iterator[object]:
        """The values at a path as a whole: a last array is not split into elements."""
        if not parts:
            yield value
            return
        if self._is_summary(value, names, element=element):
            yield from _hidden(value, parts, self._are_booleans(names))
            return
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


def _hidden(
    summary: Mapping[str, object],
    parts: Parts,
    booleans: bool | None,  # noqa: FBT001
) -> Iterator[_Hidden]:
    """The hidden values behind a summary when a path continues with these parts."""
    count = summary.get("n")
    first = parts[0] if parts else None
    if isinstance(first, int) and isinstance(count, int) and first >= count:
        return
    numeric = "min" in summary
    if isinstance(first, Slice) and len(parts) == 2 and parts[1] in STATS:
        yield _UNKNOWN  # or a field of that name
        return
    if numeric and parts and (isinstance(first, str) or len(parts) > 1):
        return  # numbers have no fields
    yield _Hidden(
        summary.get("min"),
        summary.get("max"),
        # Without types, it may also be a message that has a field `n`.
        surely=not parts
        or parts == ("n",)
        or (booleans is not None and len(parts) == 1 and isinstance(first, int | Slice)),
        elements=not parts,
        numeric=numeric,
        booleans=booleans,
    )


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


def _node(node: Node, reader: _Reader) -> Decision:
    match node:
        case Not(item):
            return partial(_negated, _node(item, reader))
        case And(items):
            return partial(_all, [_node(item, reader) for item in items])
        case Or(items):
            return partial(_any, [_node(item, reader) for item in items])
        case MongoFilter():
            raise WhereError(f"{node.to_filter()} is for MongoDB; write a predicate here.")
        case Exists(target, present):
            exists = partial(_exists, reader, target)
            return exists if present else partial(_negated, exists)
        case Compare(order="!=") | Member(negated=True) | Match(negated=True):
            positive = partial(_negated, partial(_holds, reader, node.field, _test_of(node)))
            return partial(_all, [partial(_exists, reader, node.field), positive])
        case Compare() | Member() | Match():
            return partial(_holds, reader, node.field, _test_of(node))


def _negated(inner: Decision, message: Message) -> Truth:
    found = inner(message)
    return None if found is None else not found


def _all(tests: Sequence[Decision], message: Message) -> Truth:
    unknown = False
    for test in tests:
        found = test(message)
        if found is False:
            return False
        unknown |= found is None
    return None if unknown else True


def _any(tests: Sequence[Decision], message: Message) -> Truth:
    unknown = False
    for test in tests:
        found = test(message)
        if found:
            return True
        unknown |= found is None
    return None if unknown else False


def _exists(reader: _Reader, target: Field, message: Message) -> Truth:
    found = reader.leaves(message, target)
    if any(not isinstance(leaf, _Hidden) or leaf.surely for leaf in found):
        return True
    return None if found else False


_Leaf: TypeAlias = Callable[[object, bool], Truth]
"""Tests a value; the second argument is True for an element of an array."""


def _holds(reader: _Reader, target: Field, test: _Leaf, message: Message) -> Truth:
    """True if a test holds for any value at a path."""
    unknown = False
    for leaf in reader.leaves(message, target):
        is_list = isinstance(leaf, list)
        for value in reader.elements(leaf) if isinstance(leaf, list) else (leaf,):
            found = test(value, is_list)
            if found:
                return True
            unknown |= found is None
    return None if unknown else False


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
) -> Truth:
    if type(found) is int and found in integers:
        return True
    values = values if type(found) is int else (*integers, *values)
    if isinstance(found, _Hidden):
        return None if any(map(found.may_equal, values)) else False
    if isinstance(found, str):
        found = repaired_text(found)
    return any(equal(found, value) for value in values)


def _is_ordered(order: str, value: Value, found: object, element: bool) -> Truth:  # noqa: FBT001
    if isinstance(found, _Hidden):
        return found.is_ordered(order, value)
    if isinstance(found, str):
        found = repaired_text(found)
    if element and isinstance(found, float) and math.isinf(found):
        return False
    return ordered(order, found, value)


def _matches(search: Callable[[str], object], found: object, _element: bool) -> Truth:  # noqa: FBT001
    if isinstance(found, _Hidden):
        return False if found.numeric else None
    return isinstance(found, str) and search(repaired_text(found)) is not None
