"""Predicates as MongoDB filters.

Index documents have less information than messages: long arrays are summaries, integers
beyond int64 are doubles, and MongoDB silently stops on expensive patterns. A predicate
therefore becomes two filters: one finds at least the messages for which it holds, one finds
only such messages. Negation exchanges them. If both are the same, MongoDB's answer is
exact.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeAlias

from hybridlog.query.predicate.numbers import HIGH, LOW, for_doubles, is_nan, is_number, nearest
from hybridlog.query.predicate.regex import is_literal
from hybridlog.query.predicate.tree import (
    And,
    Compare,
    Exists,
    Field,
    Match,
    Member,
    Node,
    Not,
    Opaque,
    Or,
    Parts,
    Predicate,
    Slice,
    Value,
    root_of,
)
from hybridlog.query.predicate.types import FieldTypes, Stat

Filter: TypeAlias = dict[str, object]

_NOTHING: Filter = {"$nor": [{}]}
_OPERATORS = {"<": "$lt", "<=": "$lte", ">": "$gt", ">=": "$gte"}
_NULL: Filter = {"$type": "null"}
_INF = math.inf
_NUMBER_TYPES = ["int", "long", "double", "bool"]  # booleans count as 0 and 1
_BOOLEANS = [
    {"case": {"$eq": ["$$b", True]}, "then": 1},
    {"case": {"$eq": ["$$b", False]}, "then": 0},
]


@dataclass(frozen=True, slots=True)
class MongoFilter:
    """A predicate for the documents of the index.

    Attributes:
        filter: Finds at least all messages for which the predicate holds.
        certain: Finds only messages for which it holds.
        is_exact: True if both find the same messages. If not, the messages that only `filter`
            finds must be decided on their payloads.
    """

    filter: Filter
    certain: Filter
    is_exact: bool


def to_mongo(
    node: Predicate | Node, types: FieldTypes | Mapping[str, str] | None = None
) -> MongoFilter:
    """A predicate as a MongoDB filter.

    Args:
        node: The predicate; fields that the types do not list may have any type.
        types: Types of the fields; None if each message decides.
    """
    found = _Compiler(FieldTypes.of(types)).node(root_of(node))
    return MongoFilter(found.possible, found.certain, found.is_exact)


class _Pair(NamedTuple):
    """Filters for possible and for certain results."""

    possible: Filter
    certain: Filter

    @property
    def is_exact(self) -> bool:
        return self.possible is self.certain


def _exact(found: Filter) -> _Pair:
    return _Pair(found, found)


def _not(pair: _Pair) -> _Pair:
    if pair.is_exact:
        return _exact({"$nor": [pair.possible]})
    return _Pair({"$nor": [pair.certain]}, {"$nor": [pair.possible]})


def _joined(operator: str, pairs: Sequence[_Pair]) -> _Pair:
    if len(pairs) == 1:
        return pairs[0]
    possible: Filter = {operator: [pair.possible for pair in pairs]}
    if all(pair.is_exact for pair in pairs):
        return _exact(possible)
    return _Pair(possible, {operator: [pair.certain for pair in pairs]})


def _all_of(pairs: Sequence[_Pair]) -> _Pair:
    return _joined("$and", pairs) if pairs else _exact({})


def _any_of(pairs: Sequence[_Pair]) -> _Pair:
    kept = [pair for pair in pairs if pair.possible != _NOTHING]
    return _joined("$or", kept) if kept else _exact(_NOTHING)


def _has(asked: Field) -> Filter:
    """Finds all documents that may have a value at a path."""
    return {str(asked.parts[0]): {"$exists": True}}


def _perhaps(found: Filter) -> _Pair:
    """Documents that cannot decide."""
    return _Pair(found, _NOTHING)


class _Bounds(NamedTuple):
    """A comparison of stored numbers with a value: operators for possible and certain results."""

    possible: Filter
    certain: Filter | None


class _Compiler:
    def __init__(self, types: FieldTypes) -> None:
        self._types = types

    def node(self, node: Node) -> _Pair:
        match node:
            case And(items):
                return _all_of([self.node(item) for item in items])
            case Or(items):
                return _any_of([self.node(item) for item in items])
            case Not(item):
                return _not(self.node(item))
            case Opaque():
                return _exact(node.to_filter())
            case Exists(asked, present):
                return self._exists(asked) if present else self._missing(asked)
            case _:
                return self._condition(node)

    def _condition(self, node: Compare | Member | Match) -> _Pair:
        match node:
            case Compare(order="!=") | Member(negated=True) | Match(negated=True):
                return self._negated(node)
            case _:
                return self._positive(node)

    def _negated(self, node: Compare | Member | Match) -> _Pair:
        """`!=`, `not in` and `!~`: the field exists, and the opposite does not hold."""
        asked = node.field
        if not isinstance(node, Match) and self._is_single(asked):
            values = (node.value,) if isinstance(node, Compare) else node.values
            if all(self._is_plain(value, asked) for value in values):
                return _exact({asked.path: _none_of(values)})
        return _all_of([self._exists(asked), _not(self._positive(node))])

    def _positive(self, node: Compare | Member | Match) -> _Pair:
        """A condition without its negation."""
        if node.field.is_sliced:
            return self._of_slice(node)
        match node:
            case Compare(asked, "==" | "!=", value):
                return self._of_values(asked, "==", (value,))
            case Compare(asked, order, value):
                return self._of_values(asked, order, (value,))
            case Member(asked, values):
                return self._of_values(asked, "==", values)
            case Match(asked, pattern):
                return self._of_pattern(asked, pattern)

    # Slices. The index does not tell which elements of an array are which.

    def _of_slice(self, node: Compare | Member | Match) -> _Pair:
        """Finds at least the documents with the condition: those in which any element has it."""
        asked = node.field
        if self._stat(asked) is None or not asked.is_of_slice:
            return _perhaps(self._positive(replace(node, field=asked.without_slices())).possible)
        array = Field(asked.parts[:-1]).without_slices()
        is_element = asked.parts[-1] in {"min", "max"} and self._types.kind(array.names) == "number"
        if is_element and isinstance(node, Compare) and is_number(node.value):
            return _perhaps(self._positive(replace(node, field=array)).possible)
        return _perhaps(_has(asked))

    def _slice_exists(self, asked: Field) -> _Pair:
        """A slice of an array exists if the array does, even if it has no such element."""
        whole = asked.without_slices()
        place = len(asked.parts) - (2 if asked.is_of_slice and self._stat(asked) else 1)
        is_only = sum(isinstance(part, Slice) for part in asked.parts) == 1
        is_last = is_only and isinstance(asked.parts[place], Slice)
        array = Field(asked.parts[:place])
        if is_last and self._may_be_array(array) and not self._types.is_open(array):
            return self._exists(whole)
        return _perhaps(_has(asked))

    # The structure of the documents.

    def _stat(self, asked: Field) -> Stat | None:
        return self._types.statistic(asked.parts)

    def _arrays(self, asked: Field) -> list[Field]:
        """The arrays above a path, without itself, whose summaries may hide it."""
        parts = asked.parts
        if parts[0] == "_meta":
            return []
        is_open = self._types.is_open(asked)
        found = []
        for end in range(1, len(parts)):
            above = Field(parts[:end])
            named = isinstance(parts[end - 1], str) and above.names in self._types.arrays
            if is_open or named or isinstance(parts[end], int):
                found.append(above)
        return found

    def _may_be_array(self, asked: Field) -> bool:
        """True if an array may be at a path."""
        if asked.parts[0] == "_meta":
            return False
        if self._types.is_open(asked):
            return True
        return isinstance(asked.parts[-1], str) and asked.names in self._types.arrays

    def _is_single(self, asked: Field) -> bool:
        """True if a path leads to at most one value."""
        return not asked.is_sliced and not (
            self._may_be_array(asked) or self._arrays(asked) or self._stat(asked) is not None
        )

    def _summary(self, array: Field) -> Filter:
        """Finds at least all documents in which an array is a summary."""
        if f"{array.names}.n" in self._types.types and not self._arrays(array):
            # Its elements have a field `n`, which therefore does not identify a summary.
            return {array.path: {"$exists": True, "$not": {"$type": "array"}}}
        return {f"{array.path}.n": {"$exists": True}}

    def _summary_of_others(self, array: Field) -> Filter:
        """The same for arrays that do not consist of numbers only."""
        found = self._summary(array)
        if len(array.parts) > 1 or f"{array.names}.min" in self._types.types:
            return found
        return {**found, f"{array.path}.min": {"$exists": False}}

    def _behind_summaries(self, asked: Field) -> list[_Pair]:
        """Documents in which a summary above a path hides the values at the path."""
        parts = asked.parts
        arrays = self._arrays(asked)
        summaries = [
            _perhaps(
                self._summary(array)
                if isinstance(parts[len(array.parts)], int)
                else self._summary_of_others(array)
            )
            for array in arrays
        ]
        return [*summaries, *self._in_nested(arrays)]

    def _in_nested(self, arrays: Sequence[Field]) -> list[_Pair]:
        """Documents in which an array has arrays in it, which MongoDB does not look into."""
        lists: Filter = {"$elemMatch": {"$type": "array"}}
        summaries: Filter = {"$elemMatch": {"n": {"$exists": True}}}
        return [
            _perhaps({array.path: test})
            for array in arrays
            if self._types.is_open(array)
            for test in (lists, summaries)
        ]

    def _exists(self, asked: Field) -> _Pair:
        if asked.is_sliced:
            return self._slice_exists(asked)
        found = [_exact({asked.path: {"$exists": True}})]
        stat = self._stat(asked)
        if stat is not None:
            array = Field(asked.parts[:-1])
            if self._types.known:
                is_list: Filter = {array.path: {"$type": "array"}}
                return _any_of([*found, _exact(is_list), *self._behind_summaries(array)])
            there: Filter = {"$and": [found[0].certain, self._unambiguous(array, stat)]}
            found = [
                _Pair(found[0].possible, there),
                _exact({"$expr": _anywhere(array.parts, _Counted(stat, {}))}),
                *self._named_by_numbers(array),
            ]
        return _any_of([*found, *self._behind_summaries(asked)])

    def _named_by_numbers(self, array: Field) -> list[_Pair]:
        """Lists that a path may reach because a number in it is the name of a field."""
        if all(isinstance(part, str) for part in array.parts):
            return []
        return [_perhaps({array.path: {"$type": "array"}})]

    def _unambiguous(self, array: Field, stat: Stat) -> Filter:
        """Finds documents in which a field named like a statistic is that field.

        An element of a list may be the summary of an inner list. If there is an `n` and
        no `min`, hidden elements may have a field `n` of their own.
        """
        found: Filter = {array.path: {"$not": {"$type": "array"}}}
        if stat == "n":
            found[f"{array.path}.min"] = {"$exists": True}
        return found

    def _missing(self, asked: Field) -> _Pair:
        if self._is_single(asked):
            return _exact({asked.path: {"$exists": False}})
        return _not(self._exists(asked))

    # Values.

    def _of_values(self, asked: Field, order: str, values: Sequence[Value]) -> _Pair:
        """The condition that any value or element equals one of some values, or is in order."""
        stat = self._stat(asked)
        if stat is not None and self._types.known:
            return self._of_statistic(Field(asked.parts[:-1]), stat, order, values)
        if order == "==":
            found = _any_of(self._equals(asked, values))
        else:
            found = _any_of(self._in_order(asked, order, values[0]))
        if stat is None:
            nested = self._in_nested([asked])
            return _any_of([found, *nested, *self._behind_summaries(asked)])
        array = Field(asked.parts[:-1])
        found = _Pair(found.possible, {"$and": [found.certain, self._unambiguous(array, stat)]})
        lists = [self._of_open_lists(array, stat, order, value) for value in values]
        lists += self._named_by_numbers(array)
        if stat == "n":
            # A list in a list may be a summary, which has an `n` and is not a message with one.
            summaries: Filter = {array.path: {"$type": "array"}, asked.path: {"$exists": True}}
            lists.append(_perhaps(summaries))
        return _any_of([found, *lists, *self._behind_summaries(asked)])

    def _of_open_lists(self, array: Field, stat: Stat, order: str, value: Value) -> _Pair:
        """A condition on a statistic of lists in the index, where types are unknown."""
        if value is None:
            return _exact({"$expr": _anywhere(array.parts, _Counted(stat, None))})
        if not is_number(value) or is_nan(value):
            return _exact(_NOTHING)
        if stat == "mean":
            return _perhaps({array.path: {"$type": "array"}})
        return self._pair(
            lambda test: {"$expr": _anywhere(array.parts, _Counted(stat, test))},
            self._statistic_bounds(array, stat, order, value),
        )

    def _equals(self, asked: Field, values: Sequence[Value]) -> list[_Pair]:
        plain = [v for v in values if v is not None and self._is_plain(v, asked)]
        found: list[_Pair] = []
        if plain:
            test: Filter = {"$eq": plain[0]} if len(values) == 1 else {"$in": plain}
            found.append(_exact(self._at_element(asked, test)))
        if None in values:
            found.append(_exact(self._at_element(asked, _NULL)))
        found += [
            self._pair(lambda test: self._at_element(asked, test), self._bounds("==", v, asked))
            for v in values
            if is_number(v) and not self._is_plain(v, asked)
        ]
        if self._may_be_array(asked):
            for value in values:
                found += map(_perhaps, self._summaries_with(asked, value))
        return found

    def _at_element(self, asked: Field, test: Filter) -> Filter:
        """A condition on a value, or on any of its elements.

        MongoDB searches the elements of an array at a path, but not those of an array within
        an array.
        """
        found: Filter = {asked.path: test}
        if isinstance(asked.parts[-1], str) or not self._types.is_open(asked):
            return found
        return {"$or": [found, {asked.path: {"$elemMatch": test}}]}

    def _summaries_with(self, asked: Field, value: Value) -> list[Filter]:
        """Find at least the summaries of arrays that may have an element with a value."""
        if not is_number(value) or (isinstance(value, float) and not math.isfinite(value)):
            return [self._summary(asked)]
        if self._types.kind(asked.names) == "bool":
            return []
        between: Filter = {
            f"{asked.path}.min": self._bounds("<=", value, asked).possible,
            f"{asked.path}.max": self._bounds(">=", value, asked).possible,
        }
        return [between, *self._others(asked)]

    def _others(self, asked: Field) -> list[Filter]:
        """Find the summaries of arrays with elements that are no numbers, if there are any."""
        return [self._summary_of_others(asked)] if self._types.is_open(asked) else []

    def _in_order(self, asked: Field, order: str, value: Value) -> list[_Pair]:
        if not is_number(value):
            found = [_exact(self._at_element(asked, {_OPERATORS[order]: value}))]
            if self._may_be_array(asked):
                found.append(_perhaps(self._summary(asked)))
            return found
        if self._types.kind(asked.names) == "bool":
            return []
        bounds = self._bounds(order, value, asked)
        if not self._may_be_array(asked):
            return [self._pair(lambda test: {asked.path: test}, bounds)]
        return [
            self._of_elements(asked, order, bounds),
            self._of_extremes(asked, order, bounds),
            *map(_perhaps, self._others(asked)),
        ]

    def _of_elements(self, asked: Field, order: str, bounds: _Bounds) -> _Pair:
        """An order for a value, or for the finite elements of a list."""
        path = asked.path
        if self._types.are_int64(asked.names):
            return _exact({path: bounds.possible})
        finite = {"$gt": -_INF} if order in {"<", "<="} else {"$lt": _INF}

        def in_list(test: Filter) -> Filter:
            return {path: {"$elemMatch": {**test, **finite}}}

        if not self._types.is_open(asked):
            return self._pair(in_list, bounds)
        single: Filter = {"$not": {"$type": "array"}}
        certain = bounds.certain or {}
        return _Pair(
            self._at_element(asked, bounds.possible),
            {"$or": [{path: {**certain, **single}}, in_list(certain)]} if certain else _NOTHING,
        )

    def _of_extremes(self, asked: Field, order: str, bounds: _Bounds) -> _Pair:
        """An order for the finite elements of a list that is a summary."""
        end = f"{asked.path}.{'min' if order in {'<', '<='} else 'max'}"
        if self._types.is_open(asked):
            return _perhaps({end: bounds.possible})
        return self._pair(lambda test: {end: test}, bounds)

    def _pair(self, make: Callable[[Filter], Filter], bounds: _Bounds) -> _Pair:
        possible = make(bounds.possible)
        if bounds.certain is bounds.possible:
            return _exact(possible)
        return _Pair(possible, _NOTHING if bounds.certain is None else make(bounds.certain))

    def _of_pattern(self, asked: Field, pattern: str) -> _Pair:
        if is_literal(pattern):
            found = [_exact(self._at_element(asked, {"$regex": pattern}))]
        else:
            found = [_perhaps(self._at_element(asked, {"$type": "string"}))]
        if self._may_be_array(asked):
            found.append(_perhaps(self._summary(asked)))
        if self._stat(asked) is not None:
            found.append(_perhaps({Field(asked.parts[:-1]).path: {"$type": "array"}}))
        return _any_of([*found, *self._in_nested([asked]), *self._behind_summaries(asked)])

    # Numbers.

    def _is_plain(self, value: Value, asked: Field) -> bool:
        """True if equality in the index is equality of the values in messages."""
        if not is_number(value) or is_nan(value):
            return True
        names = asked.names
        if self._types.are_floats(names) or self._types.are_int64(names):
            return isinstance(value, float) or LOW <= value <= HIGH
        return LOW < value < 2**63

    def _bounds(self, order: str, value: float, asked: Field) -> _Bounds:
        names = asked.names
        if self._types.are_floats(names):
            exact = _of_doubles(order, value)
        elif self._types.are_int64(names):
            exact = {_operator(order): _limited(value)}
        elif is_nan(value) or LOW < value < 2**63:
            exact = {_operator(order): value}
        else:
            return _rounded(order, value)
        return _Bounds(exact, exact)

    # Statistics, where the types are known.

    def _of_statistic(self, array: Field, stat: Stat, order: str, values: Sequence[Value]) -> _Pair:
        """A condition on the summary of an array, or on the equivalent for a short one."""
        tests = [
            self._statistic_test(array, stat, order, value)
            for value in values
            if value is None or is_number(value)
        ]
        return _any_of([*tests, *self._behind_summaries(array)])

    def _statistic_test(self, array: Field, stat: Stat, order: str, value: float | None) -> _Pair:
        path = f"{array.path}.{stat}"
        if value is None:
            lists = _exact(self._of_lists(array, stat, None))
            return _any_of([_exact({path: _NULL}), lists])
        bounds = self._statistic_bounds(array, stat, order, value)
        stored = self._pair(lambda test: {path: test}, bounds)
        if is_nan(value):
            return stored  # a statistic is finite
        if stat == "mean":
            # MongoDB adds in another order, so the last digit may differ.
            return _any_of([stored, _perhaps({array.path: {"$type": "array"}})])
        lists = self._pair(lambda test: self._of_lists(array, stat, test), bounds)
        return _any_of([stored, lists])

    def _statistic_bounds(self, array: Field, stat: Stat, order: str, value: float) -> _Bounds:
        if stat == "n":
            exact: Filter = {_operator(order): _limited(value)}
        elif stat == "mean":
            exact = _of_doubles(order, value)
        else:
            return self._bounds(order, value, array)
        return _Bounds(exact, exact)

    def _of_lists(self, array: Field, stat: Stat, test: Filter | None) -> Filter:
        """A condition on a statistic of arrays that the index holds in full."""
        each = _Test(stat, self._types.kind(array.names), test)
        return {"$expr": self._step("", array.parts, (), each)}

    def _step(self, here: str, parts: Parts, seen: tuple[str, ...], test: _Test) -> object:
        """An aggregation expression that is true if the test holds for any value at the path."""
        # `here` is "", "$a.b" or "$$v.b"; `seen` are the names passed so far.
        for index, part in enumerate(parts):
            rest = parts[index + 1 :]
            if isinstance(part, int):
                variable = f"e{len(seen)}x{index}"
                element = {"$cond": [{"$isArray": [here]}, {"$arrayElemAt": [here, part]}, None]}
                inner = self._step(f"$${variable}", rest, seen, test)
                return {"$let": {"vars": {variable: element}, "in": inner}}
            name = str(part)
            here = f"{here}.{name}" if here else f"${name}"
            seen = (*seen, name)
            is_array = ".".join(seen) in self._types.arrays
            if rest and is_array and not isinstance(rest[0], int):
                variable = f"m{len(seen)}"
                mapped = {
                    "$map": {
                        "input": {"$cond": [{"$isArray": [here]}, here, []]},
                        "as": variable,
                        "in": self._step(f"$${variable}", rest, seen, test),
                    }
                }
                return {"$anyElementTrue": [mapped]}
        return test.on(here)


@dataclass(frozen=True, slots=True)
class _Test:
    """A comparison of a statistic of a short array.

    Attributes:
        stat: The statistic.
        base: Kind of the elements; `any` if unknown.
        test: One operator and its value; None if the statistic must be null.
    """

    stat: Stat
    base: str
    test: Filter | None

    def on(self, here: str) -> object:
        """The aggregation expression for the value at `here`; false if it is no list."""
        compared: object = {"$eq": ["$$s", None]}
        if self.test is not None:
            ((operator, value),) = self.test.items()
            # In aggregation null is less than every number.
            compared = {"$and": [{"$ne": ["$$s", None]}, {operator: ["$$s", {"$literal": value}]}]}
        statistic = {"$let": {"vars": {"s": self._statistic(here)}, "in": compared}}
        return {"$cond": [{"$isArray": [here]}, statistic, False]}

    def _statistic(self, here: str) -> object:
        if self.stat == "n":
            return {"$size": here}
        numbers: object = here
        if self.base in {"bool", "any"}:
            number = {"$switch": {"branches": _BOOLEANS, "default": "$$b"}}
            numbers = {"$map": {"input": here, "as": "b", "in": number}}
        finite = {
            "$filter": {
                "input": numbers,
                "as": "v",
                # NaN sorts before -inf, and every value that is no number sorts after inf.
                "cond": {"$and": [{"$gt": ["$$v", -_INF]}, {"$lt": ["$$v", _INF]}]},
            }
        }
        operator = {"min": "$min", "max": "$max", "mean": "$avg"}[self.stat]
        return {operator: finite}


@dataclass(frozen=True, slots=True)
class _Counted:
    """Tests for a list that has a statistic, and no field of that name.

    Attributes:
        stat: The statistic.
        test: One operator and its value; None if the statistic must be null, empty if
            any value is accepted.
    """

    stat: Stat
    test: Filter | None

    def on(self, here: str) -> object:
        """The aggregation expression for the value at `here`."""
        each: object = {"$in": [{"$type": "$$e"}, _NUMBER_TYPES]}
        if self.stat == "n":
            named = {"$ne": [{"$type": f"$$e.{self.stat}"}, "missing"]}
            each = {"$not": [{"$and": [{"$eq": [{"$type": "$$e"}, "object"]}, named]}]}
        fits = {"$allElementsTrue": [{"$map": {"input": here, "as": "e", "in": each}}]}
        found: object = fits
        if self.test != {}:
            found = {"$and": [fits, _Test(self.stat, "any", self.test).on(here)]}
        return {"$cond": [{"$isArray": [here]}, found, False]}


def _anywhere(parts: Parts, test: _Counted) -> object:
    """An aggregation expression that is true if a test holds for any value at a path.

    Any value above it may be an array.
    """
    return _further(f"${parts[0]}", parts[1:], test, 0)


def _further(here: str, parts: Parts, test: _Counted, depth: int) -> object:
    if not parts:
        return test.on(here)
    part, rest, variable = parts[0], parts[1:], f"v{depth}"
    if isinstance(part, int):
        element = {"$cond": [{"$isArray": [here]}, {"$arrayElemAt": [here, part]}, None]}
        inner = _further(f"$${variable}", rest, test, depth + 1)
        return {"$let": {"vars": {variable: element}, "in": inner}}
    inner = _further(f"$${variable}.{part}", rest, test, depth + 1)
    is_object = {"$eq": [{"$type": f"$${variable}"}, "object"]}
    values = {"$cond": [{"$isArray": [here]}, here, [here]]}
    each = {"$cond": [is_object, inner, False]}
    return {"$anyElementTrue": [{"$map": {"input": values, "as": variable, "in": each}}]}


def _none_of(values: Sequence[Value]) -> Filter:
    """The condition that a path has a value, and none of these."""
    others = [value for value in values if value is not None]
    test: Filter = {"$exists": True}
    if others:
        test.update({"$ne": others[0]} if len(values) == 1 else {"$nin": others})
    if None in values:
        test["$not"] = _NULL
    return test


def _operator(order: str) -> str:
    return "$eq" if order == "==" else _OPERATORS[order]


def _limited(value: float) -> float:
    """The value, or an infinity for an int beyond int64."""
    if isinstance(value, int) and not LOW <= value <= HIGH:
        return _INF if value > 0 else -_INF
    return value


def _of_doubles(order: str, value: float) -> Filter:
    """The operator that compares stored doubles with a value exactly."""
    if isinstance(value, float) or LOW <= value <= HIGH:
        return {_operator(order): value}  # MongoDB compares both exactly
    if order == "==":
        near = nearest(value)
        return {"$eq": near} if near == value else {"$in": []}
    order, bound = for_doubles(order, value)
    return {_OPERATORS[order]: bound}


def _rounded(order: str, value: float) -> _Bounds:
    """Operators for numbers that are rounded to doubles beyond int64."""
    near = nearest(value)
    if order == "==":
        return _Bounds({"$eq": near}, None)
    if order in {"<", "<="}:
        return _Bounds({"$lte": near}, {"$lt": near})
    return _Bounds({"$gte": near}, {"$gt": near})
