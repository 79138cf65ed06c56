"""Predicates on decoded messages: on their columns, or on plain objects.

Columns have less information than messages: a null is a missing field or a null, and a
summary replaces a long array. Where that matters, columns cannot decide, and objects must.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING, Any, NamedTuple, cast

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
    single,
)
from hybridlog.query.predicate.tree import (
    NEGATED,
    And,
    Condition,
    Field,
    MongoFilter,
    Near,
    Node,
    Not,
    Op,
    Or,
    Parts,
    Predicate,
    Slice,
    Value,
    root_of,
)
from hybridlog.query.predicate.types import FieldTypes, Stat
from hybridlog.schema.arrow_types import (
    is_array,
    is_list,
    is_summary,
    is_text,
    is_time,
    lengths_of,
    statistic,
)
from hybridlog.schema.summary import summary_of
from hybridlog.schema.text import nearest, repaired_text

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
        return _mask(root_of(node), _Columns(FieldTypes.of(types), records))
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
    return _mask(root_of(node), _Objects(FieldTypes.of(types), messages))


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


def _mask(node: Node, source: _Objects | _Columns) -> Mask:
    """Mask of the messages for which a predicate holds; _UnfitError if that cannot be told."""
    found = np.zeros(len(source), np.bool_)
    match node:
        case And(items) | Or(items):
            masks = [_mask(item, source) for item in items]
            is_and = isinstance(node, And)
            join = np.logical_and if is_and else np.logical_or
            joined: Mask = join.reduce([~found if is_and else found, *masks])
            return joined
        case Not(item):
            return ~_mask(item, source)
        case MongoFilter() | Near():
            raise _UnfitError
        case Condition(target, "exists" | "missing" as op):
            for rows in source.there(target):
                found[rows] = True
            return found if op == "exists" else ~found
    if node.other is not None:
        sides = [map(_numbers, source.elements(one)) for one in (node.field, node.other)]
        for (own, left), (others, right) in product(*sides):
            rows, one, two = np.intersect1d(own, others, return_indices=True)
            found[rows] |= _compared_rows(left[one], NEGATED.get(node.op, node.op), right[two])
    else:
        for each in source.elements(node.field):
            found[each.rows[_tested(node, each, source.types)]] = True
    if node.op in NEGATED:
        return _mask(Condition(node.field, "exists"), source) & ~found
    return found


class _Objects:
    """Messages as plain objects, which decide everything."""

    def __init__(self, types: FieldTypes, messages: Sequence[Mapping[str, object]]) -> None:
        self.types = types
        self._messages = messages

    def __len__(self) -> int:
        return len(self._messages)

    def there(self, target: Field) -> Iterator[Rows]:
        """The messages that have a field, in some parts."""
        found = (any(True for _ in self._at(one, target)) for one in self._messages)
        yield np.flatnonzero([*found])

    def elements(self, target: Field) -> Iterator[_Leaves]:
        """The values of a field that are no lists, the elements of lists, and nulls."""
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
        parts, types = target.parts, self.types
        stat = types.statistic(parts)
        if stat is None or not types.known:
            yield from _reached(message, parts)
        if stat is None:
            return
        for array in _reached(message, parts[:-1]):
            if isinstance(array, list | bytes) and (types.known or _has_statistic(array, stat)):
                yield statistic_of(array, stat)
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
    elif isinstance(value, list) and isinstance(part, int):
        yield from _reached(value[part], rest) if part < len(value) else ()
    elif isinstance(value, list):
        for inner in _flat(value):
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
    found = summary_of(values)
    return getattr(found, stat)[0].item() if found is not None and found.has[0] else None


class _Columns:
    """Messages as columns."""

    def __init__(self, types: FieldTypes, records: pa.StructArray) -> None:
        self.types = types
        self._records = records

    def __len__(self) -> int:
        return len(self._records)

    def there(self, target: Field) -> Iterator[Rows]:
        """As of `_Objects`."""
        for leaves in self._leaves(target):
            if leaves.values.null_count and not leaves.is_element:
                raise _UnfitError  # null, or missing
            yield leaves.rows

    def elements(self, target: Field) -> Iterator[_Leaves]:
        """As of `_Objects`."""
        for leaves in self._leaves(target):
            yield from _elements(leaves)

    def _leaves(self, target: Field) -> Iterator[_Leaves]:
        """The values at a path."""
        parts = target.parts
        if self._records.type.get_field_index(str(parts[0])) < 0:
            raise _UnfitError
        start = _Leaves(self._records, np.arange(len(self)))
        stat = self.types.statistic(parts)
        if stat is None:
            return self._reach(start, parts, ())
        if not self.types.known:
            raise _UnfitError  # a message may have a field of that name
        return (_statistic(array, stat) for array in self._reach(start, parts[:-1], ()))

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
            if isinstance(part, int):
                yield from self._reach(_at_place(values, rows, part), rest, names)
            else:
                yield from self._reach(_flattened(values, rows), parts, names)

    def _is_summary(self, kind: pa.DataType, names: tuple[str, ...], *, is_element: bool) -> bool:
        if self.types.known:
            is_array = not is_element and ".".join(names) in self.types.arrays
            return is_array and bool(pa.types.is_struct(kind))
        if is_summary(kind):
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
    if is_element and is_summary(values.type):
        raise _UnfitError  # it may be the summary of an array in an array
    yield _Leaves(values, rows, is_element=is_element)


def _tested(node: Condition, leaves: _Leaves, types: FieldTypes) -> Mask:
    """Mask of the values that satisfy a condition, without its negation: bool[values]."""
    if types.are_singles(node.field.parts):
        # Decimal literals as float32 holds them, like the values.
        node = replace(node, operands=tuple(map(single, node.operands)))
    if node.field.is_absolute:
        return _of_absolute(node, leaves, types)
    if leaves.is_summary:
        return _of_summaries(node, leaves, types)
    op = NEGATED.get(node.op, node.op)
    if op in {"==", "in"}:
        return _equal_to(leaves, node.operands)
    if op == "~":
        return _matching(leaves.values, str(node.operands[0]))
    found = _compared(leaves.values, op, node.operands[0])
    if leaves.is_element and _kind_of(leaves.values) == "f":
        found &= np.isfinite(_numpy(leaves.values).astype(np.float64))
    return found


def _of_absolute(node: Condition, leaves: _Leaves, types: FieldTypes) -> Mask:
    """`abs(x) < 5` is `-5 < x < 5`, of the same element of an array."""
    is_between = node.op in {"<", "<="}
    if is_between and leaves.is_summary:
        raise _UnfitError
    plain = replace(node, field=replace(node.field, is_absolute=False))
    turned = cast(Op, {"<": ">", "<=": ">=", ">": "<", ">=": "<="}.get(node.op, node.op))
    values = tuple(-value if is_number(value) else value for value in node.operands)
    below = replace(plain, op=turned, operands=values)
    join = np.logical_and if is_between else np.logical_or
    return join(_tested(plain, leaves, types), _tested(below, leaves, types))


def _numbers(leaves: _Leaves) -> tuple[Rows, NDArray[Any]]:
    """The rows of single numbers and times, and these."""
    values, rows = leaves.values, leaves.rows
    if leaves.is_element or _kind_of(values) not in {"i", "f", "O"}:
        return rows[:0], np.empty(0)
    if isinstance(values, np.ndarray):
        return rows, values
    values, rows = _some(values, rows, _valid(values))
    return rows, _numpy(values.cast(pa.int64()) if is_time(values.type) else values)


def _compared_rows(left: NDArray[Any], op: str, right: NDArray[Any]) -> Mask:
    """Compare numbers with others, exactly."""
    if left.dtype.kind != right.dtype.kind:
        left, right = left.astype(object), right.astype(object)
    with np.errstate(invalid="ignore"):  # NaN
        return _ORDERS[op](left, right).astype(np.bool_)  # type: ignore[no-any-return]


def _equal_to(leaves: _Leaves, values: Sequence[Value]) -> Mask:
    given = leaves.values
    are_int64 = all(type(value) is int and LOW <= value <= HIGH for value in values)
    if len(values) > 1 and are_int64 and isinstance(given, pa.Int64Array):
        return _numpy(pc.is_in(given, pa.array(values, pa.int64())))
    found = np.zeros(len(given), np.bool_)
    for value in values:
        if value is not None:
            found |= _compared(given, "==", value)
    if None in values and len(found) and isinstance(given, pa.NullArray):
        if not leaves.is_element:
            raise _UnfitError  # null, or missing
        return ~found
    return found


def _kind_of(values: Any) -> str:
    """The kind of values, as numpy names it: b, i, f, U; O of large integers, empty of others."""
    if isinstance(values, np.ndarray):
        return "O"
    kind = values.type
    if is_text(kind):
        return "U"
    if pa.types.is_boolean(kind):
        return "b"
    if pa.types.is_floating(kind):
        return "f"
    return "i" if pa.types.is_integer(kind) or is_time(kind) else ""


def _matching(values: Any, pattern: str) -> Mask:
    if _kind_of(values) != "U":
        return np.zeros(len(values), np.bool_)
    try:
        return _filled(pc.match_substring_regex(values, pattern))
    except pa.ArrowInvalid as error:
        raise _UnfitError from error


def _filled(found: pa.Array) -> Mask:
    """A mask of Arrow as a numpy mask, False for null."""
    return _numpy(pc.fill_null(found, fill_value=False))


def _compared(values: Any, order: str, value: Value) -> Mask:
    """Mask of the values that satisfy a comparison; False for values of another kind."""
    kind, found = _kind_of(values), np.zeros(len(values), np.bool_)
    wanted = {bool: "b", str: "U"}.get(type(value), "ifO" if is_number(value) else "")
    if not kind or kind not in wanted:
        return found
    if kind == "O":
        return _ORDERS[order](values, value).astype(np.bool_)  # type: ignore[no-any-return]
    if kind in "bU":
        try:
            scalar = pa.scalar(value, values.type)
        except (pa.ArrowInvalid, UnicodeEncodeError):
            raise _UnfitError from None
        return _filled(getattr(pc, _ORDERS[order].__name__)(values, scalar))
    if is_time(values.type):
        values = values.cast(pa.int64())
    chosen = _valid(values)
    numbers = _numpy(values if chosen.all() else values.filter(pa.array(chosen)))
    compare = _integers_compared if kind == "i" else _floats_compared
    found[chosen] = compare(numbers, order, value)  # type: ignore[arg-type]
    return found


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


def _of_summaries(node: Condition, leaves: _Leaves, types: FieldTypes) -> Mask:
    """Conditions on the elements of arrays that are present only as summaries.

    The ends decide what any element being greater or less is asked for; nothing else.
    """
    path, has_ends = node.field.names, leaves.values.type.get_field_index("min") >= 0
    if not has_ends or node.op not in {"<", "<=", ">", ">="}:
        raise _UnfitError
    value = node.operands[0]
    end = pc.struct_field(leaves.values, "min" if node.op in {"<", "<="} else "max")
    is_rounded = pa.types.is_floating(end.type) and not types.are_floats(path)
    is_large = is_number(value) and abs(nearest(value)) >= 2**53
    if types.kind(path) == "bool" or (is_rounded and is_large):
        raise _UnfitError
    return _compared(end, node.op, value)
