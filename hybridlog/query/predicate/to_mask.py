"""Predicates on decoded messages: on their columns, or on plain objects.

Columns have less information than messages: a null is a missing field or a null, and a
summary replaces a long array. Where that matters, columns cannot decide, and objects must.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from functools import reduce
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from hybridlog.query.predicate.numbers import (
    HIGH,
    LOW,
    for_doubles,
    for_integers,
    is_nan,
    is_number,
    nearest,
)
from hybridlog.query.predicate.tree import (
    And,
    Compare,
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
    Value,
    root_of,
)
from hybridlog.query.predicate.types import STATS, FieldTypes, Stat
from hybridlog.schema.arrow_types import (
    is_array,
    is_bytes,
    is_list,
    is_numeric,
    is_text,
    is_time,
    lengths_of,
    statistic,
)
from hybridlog.schema.summary import summary_of
from hybridlog.schema.text import repaired_text

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Mask = NDArray[np.bool_]
    Rows = NDArray[np.intp]

_ORDERS: dict[str, np.ufunc] = {
    "==": np.equal,
    "<": np.less,
    "<=": np.less_equal,
    ">": np.greater,
    ">=": np.greater_equal,
}
_SUMMARIES = (set(STATS), {"n"})


def to_mask(
    node: Predicate | Node, types: FieldTypes | Mapping[str, str] | None, records: pa.StructArray
) -> Mask | None:
    """Mask of the rows for which a predicate holds: bool[rows]; None if columns cannot decide.

    Args:
        node: The predicate.
        types: Types of the fields; None if each message decides.
        records: Decoded messages with at least the fields of the predicate. Arrays are
            complete, or structs of `n`, `min`, `max` and `mean`.
    """
    try:
        return _Columns(FieldTypes.of(types), records).node(root_of(node))
    except (_UnfitError, pa.ArrowNotImplementedError):
        return None  # Arrow has no functions for lists of JSON text either


def mask_of_objects(
    node: Predicate | Node,
    types: FieldTypes | Mapping[str, str] | None,
    messages: Sequence[Mapping[str, object]],
) -> Mask:
    """The same of messages as dict, list, str, bytes, bool, int, float and None: bool[messages].

    For conditions on its numbers, an array may be `{n, min, max, mean}`.
    """
    return _Objects(FieldTypes.of(types), messages).node(root_of(node))


class _UnfitError(Exception):
    """The columns cannot decide."""


class _Leaves(NamedTuple):
    """Values at a path, in any order.

    Attributes:
        values: One entry for each value; of integers beyond 64 bits, no Arrow array.
        rows: The row of each value.
        is_element: True for elements of an array: a null is then null, not missing.
        is_summary: True for summaries that replace the arrays themselves.
    """

    values: Any
    rows: Rows
    is_element: bool = False
    is_summary: bool = False


class _Messages(ABC):
    """Some messages, of which a predicate is asked."""

    def __init__(self, types: FieldTypes, count: int) -> None:
        self._types = types
        self._count = count

    @abstractmethod
    def exists(self, target: Field) -> Mask:
        """Mask of the messages that have a field."""

    @abstractmethod
    def elements(self, target: Field) -> Iterator[_Leaves]:
        """The values of a field that are no lists, the elements of lists, and nulls."""

    def node(self, node: Node) -> Mask:
        """Mask of the messages for which a predicate holds.

        Raises:
            _UnfitError: the columns cannot decide.
        """
        match node:
            case And(items):
                return reduce(np.logical_and, map(self.node, items), np.ones(self._count, np.bool_))
            case Or(items):
                return reduce(np.logical_or, map(self.node, items), np.zeros(self._count, np.bool_))
            case Not(item):
                return ~self.node(item)
            case Exists(target, present):
                found = self.exists(target)
                return found if present else ~found
            case MongoFilter() | Near():
                raise _UnfitError
            case Compare(order="!=") | Member(negated=True) | Match(negated=True):
                return self.exists(node.field) & ~self._holds(node)
            case _:
                return self._holds(node)

    def _holds(self, node: Compare | Member | Match) -> Mask:
        """Mask of the messages with a value that satisfies a condition, without its negation."""
        found = np.zeros(self._count, np.bool_)
        for each in self.elements(node.field):
            found[each.rows[_tested(node, each, self._types)]] = True
        return found


class _Objects(_Messages):
    """Messages as plain objects, which decide everything."""

    def __init__(self, types: FieldTypes, messages: Sequence[Mapping[str, object]]) -> None:
        super().__init__(types, len(messages))
        self._messages = messages

    def exists(self, target: Field) -> Mask:
        found = (any(True for _ in self._at(one, target)) for one in self._messages)
        return np.fromiter(found, np.bool_, self._count)

    def elements(self, target: Field) -> Iterator[_Leaves]:
        alike: dict[tuple[Any, bool], tuple[list[Any], list[int]]] = defaultdict(lambda: ([], []))
        for row, message in enumerate(self._messages):
            for found in self._at(message, target):
                is_array = isinstance(found, list)
                for value in _flat(found) if is_array else (found,):
                    if not isinstance(value, Mapping | bytes):  # which equal nothing
                        # A null is one here: what is missing is not there.
                        values, rows = alike[_kind(value), is_array or value is None]
                        values.append(repaired_text(value) if isinstance(value, str) else value)
                        rows.append(row)
        for (kind, is_element), (values, rows) in alike.items():
            array = np.array(values, object) if kind is None else pa.array(values, kind)
            yield _Leaves(array, np.array(rows, np.intp), is_element)

    def _at(self, message: object, target: Field) -> Iterator[object]:
        """Everything at a path: values, whole arrays, statistics of arrays."""
        parts, types = target.parts, self._types
        stat = types.statistic(parts)
        if stat is None or not types.known:
            yield from _reached(message, parts)
        if stat is None:
            return
        name = ".".join(part for part in parts[:-1] if isinstance(part, str))
        is_countable = stat == "n" or types.kind(name) != "other"
        for array in _reached(message, parts[:-1]):
            if not types.known:
                has = isinstance(array, list) and _has_statistic(array, stat)
            else:
                has = is_countable and isinstance(array, list | bytes)
            if has:
                yield statistic_of(array, stat)  # type: ignore[arg-type]
            elif types.known and isinstance(array, Mapping) and stat in array:
                yield array[stat]


def _reached(value: object, parts: Parts) -> Iterator[object]:
    """The values at a path; through an array, those of each element. A last array is whole."""
    if not parts:
        yield value
        return
    part, rest = parts[0], parts[1:]
    if isinstance(part, Slice):
        if isinstance(value, list):
            yield from _reached(value[part.begin : part.end], rest)
    elif isinstance(value, Mapping):
        if str(part) in value:
            yield from _reached(value[str(part)], rest)
    elif isinstance(value, list):
        if isinstance(part, int) and part < len(value):
            yield from _reached(value[part], rest)
        # MongoDB also accepts a number as a name.
        for inner in _flat(value) if isinstance(part, str) else value:
            if isinstance(inner, Mapping):
                yield from _reached(inner, parts)


def _flat(values: object) -> Iterator[object]:
    """The elements of a list, also those of the lists in it, in their order."""
    left = [values]
    while left:
        value = left.pop()
        if isinstance(value, list):
            left += reversed(value)
        else:
            yield value


def _kind(value: object) -> pa.DataType | None:
    """The Arrow type of a value; None of an integer that has none."""
    if value is None:
        return pa.null()
    if isinstance(value, bool):
        return pa.bool_()
    if isinstance(value, int):
        return pa.int64() if LOW <= value <= HIGH else None
    return pa.string() if isinstance(value, str) else pa.float64()


def _has_statistic(values: Sequence[object], stat: Stat) -> bool:
    """True if an array has a statistic, and its elements have no field of that name."""
    if stat == "n":
        return not any(isinstance(value, Mapping) and stat in value for value in values)
    return all(isinstance(value, int | float) for value in values)


def statistic_of(values: Sequence[object], stat: Stat) -> float | None:
    """A statistic of an array, equal to that in its summary in the index."""
    if stat == "n":
        return len(values)
    numbers = [value for value in values if isinstance(value, int | float)]
    # True counts as 1.
    finite = [value * 1 for value in numbers if isinstance(value, int) or math.isfinite(value)]
    if not finite:
        return None
    if stat == "mean":
        found = summary_of(numbers)
        return float(found.mean[0]) if found is not None and found.has[0] else None
    return min(finite) if stat == "min" else max(finite)


class _Columns(_Messages):
    """Messages as columns."""

    def __init__(self, types: FieldTypes, records: pa.StructArray) -> None:
        super().__init__(types, len(records))
        self._records = records

    def exists(self, target: Field) -> Mask:
        found = np.zeros(self._count, np.bool_)
        for leaves in self.leaves(target):
            if leaves.values.null_count and not leaves.is_element:
                raise _UnfitError  # null, or missing
            found[leaves.rows] = True
        return found

    def elements(self, target: Field) -> Iterator[_Leaves]:
        for leaves in self.leaves(target):
            yield from _elements(leaves)

    # Paths.

    def leaves(self, target: Field) -> list[_Leaves]:
        """The values at a path.

        Raises:
            _UnfitError: the columns cannot decide.
        """
        parts = target.parts
        top = self._records.type
        if top.get_field_index(str(parts[0])) < 0:
            raise _UnfitError
        start = _Leaves(self._records, np.arange(self._count))
        stat = self._types.statistic(parts)
        if stat is None:
            return list(self._reach(start, parts, ()))
        if not self._types.known:
            raise _UnfitError  # a message may have a field of that name
        return [_statistic(array, stat) for array in self._reach(start, parts[:-1], ())]

    def _reach(
        self,
        leaves: _Leaves,
        parts: Parts,
        names: tuple[str, ...],
    ) -> Iterator[_Leaves]:
        """The values at a path, from some values on; through an array, from each element."""
        values, rows = _plain(leaves.values), leaves.rows
        kind = values.type
        if pa.types.is_null(kind):
            if not parts:
                yield leaves
            return
        if names and self._is_summary(kind, names, is_element=leaves.is_element):
            if parts:
                raise _UnfitError
            yield _Leaves(values, rows, is_summary=True)
            return
        if not parts:
            yield leaves._replace(values=values)
            return
        part, rest = parts[0], parts[1:]
        if isinstance(part, Slice):
            if is_list(kind):
                yield from self._reach(_sliced(values, rows, part), rest, names)
        elif pa.types.is_struct(kind):
            if kind.get_field_index(str(part)) >= 0:
                values, rows = _some(values, rows, _valid(values))
                inner = _Leaves(pc.struct_field(values, str(part)), rows)
                yield from self._reach(inner, rest, (*names, str(part)))
        elif is_list(kind):
            yield from self._into_list(values, rows, parts, names)
        elif not _is_scalar(kind):
            raise _UnfitError

    def _into_list(
        self, values: pa.Array, rows: Rows, parts: Parts, names: tuple[str, ...]
    ) -> Iterator[_Leaves]:
        """The values at a path through lists."""
        part = parts[0]
        elements = _flattened(values, rows)
        while isinstance(part, str) and is_list(elements.values.type):
            elements = _flattened(elements.values, elements.rows)
        inside = elements.values.type
        named = pa.types.is_struct(inside) and inside.get_field_index(str(part)) >= 0
        if isinstance(part, int):
            if named:
                raise _UnfitError  # an index, or a field with a number as its name
            yield from self._reach(_at_place(values, rows, part), parts[1:], names)
        elif named:
            yield from self._reach(elements, parts, names)
        elif not (_is_scalar(inside) or pa.types.is_struct(inside) or is_list(inside)):
            raise _UnfitError

    def _is_summary(self, kind: pa.DataType, names: tuple[str, ...], *, is_element: bool) -> bool:
        if not pa.types.is_struct(kind):
            return False
        if self._types.known:
            return not is_element and ".".join(names) in self._types.arrays
        if set(_names(kind)) in _SUMMARIES:
            raise _UnfitError  # or a message with fields of these names
        return False


# Arrays.


def _plain(values: pa.Array) -> pa.Array:
    """Values without dictionary encoding.

    Raises:
        _UnfitError: they have another representation, such as JSON text.
    """
    if isinstance(values.type, pa.BaseExtensionType):
        raise _UnfitError
    return values.dictionary_decode() if pa.types.is_dictionary(values.type) else values


def _names(kind: pa.DataType) -> list[str]:
    return [kind.field(index).name for index in range(kind.num_fields)]


def _is_scalar(kind: pa.DataType) -> bool:
    if pa.types.is_dictionary(kind):
        return _is_scalar(kind.value_type)
    is_plain = is_numeric(kind) or is_text(kind) or is_bytes(kind) or is_time(kind)
    return is_plain or bool(pa.types.is_null(kind))


def _numpy(values: pa.Array) -> NDArray[Any]:
    found: NDArray[Any] = values.to_numpy(zero_copy_only=False)
    return found


def _valid(values: pa.Array) -> Mask:
    if not values.null_count:
        return np.ones(len(values), np.bool_)
    return _numpy(values.is_valid())


def _some(values: pa.Array, rows: Rows, chosen: Mask) -> tuple[pa.Array, Rows]:
    if chosen.all():
        return values, rows
    return values.filter(pa.array(chosen)), rows[chosen]


def _flattened(values: pa.Array, rows: Rows) -> _Leaves:
    """The elements of lists; a null list has none."""
    parents = _numpy(pc.list_parent_indices(values))
    return _Leaves(pc.list_flatten(values), rows[parents], is_element=True)


def _sliced(values: pa.Array, rows: Rows, part: Slice) -> _Leaves:
    """Some elements of each list; a null has none."""
    values, rows = _some(values, rows, _valid(values))
    return _Leaves(pc.list_slice(values, part.begin, part.end, return_fixed_size_list=False), rows)


def _at_place(values: pa.Array, rows: Rows, place: int) -> _Leaves:
    """The element at an index of each list that is long enough."""
    values, rows = _some(values, rows, lengths_of(values) > place)
    if not len(values):
        return _Leaves(pa.nulls(0, values.type.value_type), rows, is_element=True)
    return _Leaves(pc.list_element(values, place), rows, is_element=True)


def _statistic(leaves: _Leaves, stat: Stat) -> _Leaves:
    """A statistic of arrays whose types are known, equal to that in the index."""
    values, rows = _some(leaves.values, leaves.rows, _valid(leaves.values))
    if leaves.is_summary:
        has = values.type.get_field_index(stat) >= 0
        found = pc.struct_field(values, stat) if has else None
    else:
        found = statistic(values, stat) if is_array(values.type) else None
    if found is None:
        raise _UnfitError
    return _Leaves(found, rows, is_element=True)


# Conditions on values.


def _elements(leaves: _Leaves) -> Iterator[_Leaves]:
    """The values that are no lists, the elements of lists and of the lists in them, and nulls."""
    values, rows = leaves.values, leaves.rows
    is_element = False
    if leaves.is_summary:
        yield leaves
        return
    while True:
        if values.null_count:
            none = rows[~_valid(values)]
            yield _Leaves(pa.nulls(len(none)), none, is_element=leaves.is_element or is_element)
        if not is_list(values.type):
            break
        inner = _flattened(values, rows)
        values, rows, is_element = _plain(inner.values), inner.rows, True
    if is_element and pa.types.is_struct(values.type) and set(_names(values.type)) in _SUMMARIES:
        raise _UnfitError  # it may be the summary of an array in an array
    yield _Leaves(values, rows, is_element=is_element)


def _tested(node: Compare | Member | Match, leaves: _Leaves, types: FieldTypes) -> Mask:
    """Mask of the values that satisfy a condition, without its negation: bool[values]."""
    if isinstance(leaves.values, np.ndarray):
        return _of_large(node, leaves.values)
    if leaves.is_summary:
        return _of_summaries(node, leaves, types)
    match node:
        case Match(pattern=pattern):
            return _matching(leaves.values, pattern)
        case Compare(order="==" | "!=", value=value):
            return _equal_to(leaves, (value,))
        case Member(values=values):
            return _equal_to(leaves, values)
        case Compare(order=order, value=value):
            found = _compared(leaves.values, order, value)
            if leaves.is_element and pa.types.is_floating(leaves.values.type):
                found &= np.isfinite(_numpy(leaves.values).astype(np.float64))
            return found


def _of_large(node: Compare | Member | Match, values: NDArray[Any]) -> Mask:
    """The same of integers beyond 64 bits."""
    found = np.zeros(len(values), np.bool_)
    if isinstance(node, Compare | Member):
        order = node.order if isinstance(node, Compare) and node.order != "!=" else "=="
        for value in (node.value,) if isinstance(node, Compare) else node.values:
            if is_number(value):
                found |= _ORDERS[order](values, value).astype(np.bool_)
    return found


def _equal_to(leaves: _Leaves, values: Sequence[Value]) -> Mask:
    are_int64 = all(type(value) is int and LOW <= value <= HIGH for value in values)
    if len(values) > 1 and pa.types.is_int64(leaves.values.type) and are_int64:
        return _numpy(pc.is_in(leaves.values, pa.array(values, pa.int64())))
    found = np.zeros(len(leaves.values), np.bool_)
    for value in values:
        if value is not None:
            found |= _compared(leaves.values, "==", value)
    if None in values and len(found) and pa.types.is_null(leaves.values.type):
        if not leaves.is_element:
            raise _UnfitError  # null, or missing
        return ~found
    return found


def _matching(values: pa.Array, pattern: str) -> Mask:
    if not is_text(values.type):
        return np.zeros(len(values), np.bool_)
    try:
        found = pc.match_substring_regex(values, pattern)
    except pa.ArrowInvalid as error:
        raise _UnfitError from error
    return _filled(found)


def _filled(found: pa.Array) -> Mask:
    """A mask of Arrow as a numpy mask, False for null."""
    return _numpy(pc.fill_null(found, fill_value=False))


def _compared(values: pa.Array, order: str, value: Value) -> Mask:
    """Mask of the values that satisfy an order; False for values of another kind."""
    none = np.zeros(len(values), np.bool_)
    kind = values.type
    if isinstance(value, bool):
        return _filled(pc.equal(values, value)) if pa.types.is_boolean(kind) else none
    if isinstance(value, str):
        return _texts_compared(values, order, value) if is_text(kind) else none
    if not is_number(value):
        return none
    if pa.types.is_decimal(kind):
        raise _UnfitError
    if is_time(kind):
        if kind.unit != "ns":
            raise _UnfitError
        values = values.cast(pa.int64())
    kind = values.type
    if not (pa.types.is_integer(kind) or pa.types.is_floating(kind)):
        return none
    chosen = _valid(values)
    numbers = _numpy(values if chosen.all() else values.filter(pa.array(chosen)))
    compare = _integers_compared if pa.types.is_integer(kind) else _floats_compared
    none[chosen] = compare(numbers, order, value)
    return none


def _texts_compared(values: pa.Array, order: str, value: str) -> Mask:
    try:
        wanted = pa.scalar(value, values.type)
    except (pa.ArrowInvalid, UnicodeEncodeError):
        raise _UnfitError from None
    return _filled(getattr(pc, _ORDERS[order].__name__)(values, wanted))


def _integers_compared(numbers: NDArray[Any], order: str, value: float) -> Any:
    """Compare integers with any number, exactly."""
    bound = for_integers(order, value)
    if isinstance(bound, bool):
        return bound
    order, limit = bound
    info = np.iinfo(numbers.dtype)
    if limit > info.max:
        return order in {"<", "<="}
    if limit < info.min:
        return order in {">", ">="}
    return _ORDERS[order](numbers, numbers.dtype.type(limit))


def _floats_compared(numbers: NDArray[Any], order: str, value: float) -> Any:
    """Compare floats with any number, exactly."""
    wide = numbers.astype(np.float64, copy=False)
    if is_nan(value):
        return np.isnan(wide) if order == "==" else False
    if order == "==":
        near = nearest(value)
        return wide == near if near == value else False
    order, bound = for_doubles(order, value)
    return _ORDERS[order](wide, bound)


# Conditions on summaries.


def _of_summaries(node: Compare | Member | Match, leaves: _Leaves, types: FieldTypes) -> Mask:
    """Conditions on the elements of arrays that are present only as summaries.

    The ends decide what any element being greater or less is asked for; nothing else.
    """
    names, path = _names(leaves.values.type), node.field.names
    if not isinstance(node, Compare) or node.order in {"==", "!="} or "min" not in names:
        raise _UnfitError
    end = pc.struct_field(leaves.values, "min" if node.order in {"<", "<="} else "max")
    is_rounded = pa.types.is_floating(end.type) and not types.are_floats(path)
    is_large = is_number(node.value) and abs(nearest(node.value)) >= 2**53
    if types.kind(path) == "bool" or (is_rounded and is_large):
        raise _UnfitError
    return _compared(end, node.order, node.value)
