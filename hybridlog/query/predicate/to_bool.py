"""Predicates on one message in memory: the reference semantics.

`to_mask` gives the same answer of columns. A message that lost its payload has a summary
(`n`, `min`, `max`, `mean`) in the place of a long array, for conditions on these numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import TypeAlias

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
from hybridlog.query.predicate.types import FieldTypes, Stat
from hybridlog.schema.text import repaired_text
from hybridlog_storage.errors import WhereError

Message: TypeAlias = Mapping[str, object]
"""A decoded message: dict, list, str, bytes, bool, int, float, None."""


def to_bool(node: Predicate | Node, types: FieldTypes | Mapping[str, str] | None = None) -> Test:
    """A predicate as a test of single messages.

    Args:
        node: The predicate.
        types: Types of the fields; None if each message decides.

    Raises:
        WhereError: it has a MongoDB filter.
    """
    return _node(root_of(node), FieldTypes.of(types))


def _leaves(types: FieldTypes, message: Message, target: Field) -> Iterator[object]:
    """Everything at a path: values, whole arrays, statistics of arrays."""
    parts = target.parts
    stat = types.statistic(parts)
    if stat is None or not types.known:
        yield from _reach(message, parts)
    if stat is None:
        return
    name = ".".join(part for part in parts[:-1] if isinstance(part, str))
    is_countable = stat == "n" or types.kind(name) != "other"
    for array in _reach(message, parts[:-1]):
        if not types.known:
            has = isinstance(array, list) and _has_statistic(array, stat)
        else:
            has = is_countable and isinstance(array, list | bytes)
        if has:
            yield statistic(stat, array)  # type: ignore[arg-type]
        elif types.known and isinstance(array, Mapping) and stat in array:
            yield array[stat]


def _reach(value: object, parts: Parts) -> Iterator[object]:
    """The values at a path; through an array, those of each element. A last array is whole."""
    if not parts:
        yield value
        return
    part, rest = parts[0], parts[1:]
    if isinstance(part, Slice):
        if isinstance(value, list):
            yield from _reach(part.of(value), rest)
    elif isinstance(value, Mapping):
        if str(part) in value:
            yield from _reach(value[str(part)], rest)
    elif isinstance(value, list):
        if isinstance(part, int) and part < len(value):
            yield from _reach(value[part], rest)
        # MongoDB also accepts a number as a name.
        for inner in _flat(value) if isinstance(part, str) else value:
            if isinstance(inner, Mapping):
                yield from _reach(inner, parts)


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


def _node(node: Node, types: FieldTypes) -> Test:
    match node:
        case Not(item):
            return partial(_negated, _node(item, types))
        case And(items):
            return partial(_joined, [_node(item, types) for item in items], False)
        case Or(items):
            return partial(_joined, [_node(item, types) for item in items], True)
        case MongoFilter() | Near():
            raise WhereError(f"{spelled(node)} is no predicate on the message itself.")
        case Exists(target, present):
            exists = partial(_exists, types, target)
            return exists if present else partial(_negated, exists)
        case Compare(order="!=") | Member(negated=True) | Match(negated=True):
            positive = partial(_negated, partial(_holds, types, node.field, _test_of(node)))
            return partial(_joined, [partial(_exists, types, node.field), positive], False)
        case Compare() | Member() | Match():
            return partial(_holds, types, node.field, _test_of(node))


def _negated(test: Test, message: Message) -> bool:
    return not test(message)


def _joined(tests: Sequence[Test], wanted: bool, message: Message) -> bool:  # noqa: FBT001
    """True if any test is true, or, if False is wanted, False if any is false."""
    return any(test(message) is wanted for test in tests) is wanted


def _exists(types: FieldTypes, target: Field, message: Message) -> bool:
    return any(True for _ in _leaves(types, message, target))


_Leaf: TypeAlias = Callable[[object, bool], bool]
"""Tests a value; the second argument is True for an element of an array."""


def _holds(types: FieldTypes, target: Field, test: _Leaf, message: Message) -> bool:
    """True if a test holds for any value at a path."""
    return any(
        test(value, isinstance(leaf, list))
        for leaf in _leaves(types, message, target)
        for value in (_flat(leaf) if isinstance(leaf, list) else (leaf,))
    )


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
    values = values if type(found) is int else (*integers, *values)
    if isinstance(found, str):
        found = repaired_text(found)
    return any(equal(found, value) for value in values)


def _is_ordered(order: str, value: Value, found: object, element: bool) -> bool:  # noqa: FBT001
    if isinstance(found, str):
        found = repaired_text(found)
    if element and isinstance(found, float) and math.isinf(found):
        return False
    return ordered(order, found, value)


def _matches(search: Callable[[str], object], found: object, _element: bool) -> bool:  # noqa: FBT001
    return isinstance(found, str) and search(repaired_text(found)) is not None
