"""Evaluates predicates on decoded messages: on their columns, or on plain objects.

A condition holds for a message, fails, or is open. Columns have less information than messages:
a null is a missing field or a null, JSON text hides what it holds, and a summary replaces a
long array. Of objects, only such summaries leave a condition open.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeGuard, cast

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from msgspec.structs import replace

from hybridlog.query.predicate.tree import (
    NEGATED,
    And,
    Condition,
    Field,
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
    Types = FieldTypes | Mapping[str, str] | None

LOW, HIGH = -(2**63), 2**63 - 1
"""Smallest and greatest int64."""
_ORDERS: dict[str, np.ufunc] = {
    "==": np.equal,
    "<": np.less,
    "<=": np.less_equal,
    ">": np.greater,
    ">=": np.greater_equal,
}
_ENDS: Final = {"<": "min", "<=": "min", ">": "max", ">=": "max"}
"""The end of an array that tells whether an order holds for any of its elements."""
_SUMMARY: Final = frozenset({"n", "min", "max", "mean"})
_HIDDEN: Final = object()
"""Stands for what a summary replaces."""


class Verdict(NamedTuple):
    """The messages for which a predicate holds, and those for which it fails: bool[n] each."""

    holds: Mask
    fails: Mask

    @property
    def open(self) -> Mask:
        """Those of which neither is known."""
        return ~(self.holds | self.fails)


def on_columns(node: Predicate | Node, types: Types, records: pa.StructArray) -> Verdict:
    """Evaluate a predicate on decoded messages.

    Args:
        node: The predicate.
        types: Types of the fields; None if each message decides.
        records: Messages with at least the fields of the predicate. Arrays are complete, or
            structs of `n`, `min`, `max` and `mean`.
    """
    return _verdict(root_of(node), _Columns(FieldTypes.of(types), records))


def on_objects(
    node: Predicate | Node,
    types: Types,
    messages: Sequence[Mapping[str, object]],
    *,
    left: bool = False,
) -> Verdict:
    """The same of messages as dict, list, str, bytes, bool, int, float and None.

    With `left`, arrays may be `{n, min, max, mean}`.
    """
    return _verdict(root_of(node), _Objects(FieldTypes.of(types), messages, left=left))


class _Values(NamedTuple):
    """Values at a path, in any order.

    Attributes:
        values: One of each of the `rows`, in an Arrow array; integers beyond 64 bits in one of
            numpy. None if there may be any.
        is_element: True for elements of an array: a null is then null, not missing.
    """

    values: Any
    rows: Rows
    is_element: bool = False

    def split(self) -> tuple[_Values, Rows]:
        """Those that are not null, and the rows of the others."""
        if isinstance(self.values, np.ndarray) or not self.values.null_count:
            return self, self.rows[:0]
        valid = to_numpy(self.values.is_valid())
        return self.some(valid), self.rows[~valid]

    def some(self, chosen: Mask) -> _Values:
        """The chosen ones."""
        if chosen.all():
            return self
        return self._replace(values=self.values.filter(pa.array(chosen)), rows=self.rows[chosen])


def _verdict(node: Node, source: _Objects | _Columns) -> Verdict:
    none = np.zeros(len(source), np.bool_)
    match node:
        case And(items):
            inner = [_verdict(item, source) for item in items]
            holds = np.logical_and.reduce([~none, *(one.holds for one in inner)])
            return Verdict(holds, np.logical_or.reduce([none, *(one.fails for one in inner)]))
        case Or(items):
            return _verdict(Not(And(tuple(map(Not, items)))), source)
        case Not(item):
            return Verdict(*reversed(_verdict(item, source)))
        case Condition():
            return _of_condition(node, source)
    return Verdict(none, none)


def _of_condition(node: Condition, source: _Objects | _Columns) -> Verdict:
    exists = Condition(node.field, "exists")
    if node.op == "missing":
        return Verdict(*reversed(_of_condition(exists, source)))
    if node.op in NEGATED:
        there = _of_condition(exists, source)
        found = _of_condition(replace(node, op=NEGATED[node.op]), source)
        return Verdict(there.holds & found.fails, there.fails | found.holds)
    if source.types.are_singles(node.field.parts):
        # Decimal literals as float32 holds them, like the values.
        node = replace(node, operands=tuple(map(single, node.operands)))
    holds, is_known = np.zeros(len(source), np.bool_), np.ones(len(source), np.bool_)
    for rows in _holding(node, source, is_known):
        holds[rows] = True
    return Verdict(holds, is_known & ~holds)


def _holding(node: Condition, source: _Objects | _Columns, is_known: Mask) -> Iterator[Rows]:
    """Rows for which a condition holds; `is_known` becomes False where it may hold besides."""
    if node.op == "exists":
        yield from (found.rows for found in _known(source.there(node.field), is_known))
    elif node.other is None:
        for found in _known(source.elements(node), is_known):
            try:
                yield found.rows[_tested(node, found)]
            except pa.ArrowInvalid:  # bytes that are no text
                is_known[found.rows] = False
    else:
        both = (replace(node, field=one, other=None) for one in (node.field, node.other))
        sides = [[*map(_numbers, _known(source.elements(one), is_known))] for one in both]
        for (own, left), (others, right) in product(*sides):
            rows, one, two = np.intersect1d(own, others, return_indices=True)
            yield rows[compared_rows(left[one], node.op, right[two])]


def _known(found: Iterator[_Values], is_known: Mask) -> Iterator[_Values]:
    try:
        for one in found:
            if one.values is None:
                is_known[one.rows] = False
            else:
                yield one
    except pa.ArrowNotImplementedError:  # Arrow has no functions for lists of JSON text
        is_known[:] = False


def _numbers(found: _Values) -> tuple[Rows, NDArray[Any]]:
    """The rows of single numbers and times, and these."""
    values, rows = found.values, found.rows
    if found.is_element or kind_of(values) not in {"i", "f", "O"}:
        return rows[:0], np.empty(0)
    if isinstance(values, np.ndarray):
        return rows, values
    return rows, to_numpy(values.cast(pa.int64()) if is_time(values.type) else values)


def _tested(node: Condition, found: _Values) -> Mask:
    """Mask of the values that satisfy a condition: bool[values]."""
    values, operands = found.values, node.operands
    if isinstance(values, pa.NullArray):
        return np.full(len(values), None in operands)
    if node.field.is_absolute:  # `abs(x) < 5` is `-5 < x < 5`, of the same element
        plain = replace(node, field=replace(node.field, is_absolute=False))
        turned = cast(Op, {"<": ">", "<=": ">=", ">": "<", ">=": "<="}.get(node.op, node.op))
        below = tuple(-value if is_number(value) else value for value in operands)
        join = np.logical_and if node.op in {"<", "<="} else np.logical_or
        return join(
            _tested(plain, found), _tested(replace(plain, op=turned, operands=below), found)
        )
    result = compared(values, node.op, operands)
    if found.is_element and node.op in _ENDS and kind_of(values) == "f":
        result &= np.isfinite(to_numpy(values).astype(np.float64))
    return result


class _Objects:
    """Messages as plain objects."""

    def __init__(
        self, types: FieldTypes, messages: Sequence[Mapping[str, object]], *, left: bool
    ) -> None:
        self.types = types
        self._messages = messages
        self._left = left

    def __len__(self) -> int:
        return len(self._messages)

    def there(self, target: Field) -> Iterator[_Values]:
        """The messages that have a field, or may have it."""
        rows: tuple[list[int], list[int]] = [], []
        for row, message in enumerate(self._messages):
            for found in self._at(message, target):
                rows[found is _HIDDEN].append(row)
        yield _Values((), np.array(rows[0], np.intp))
        yield _Values(None, np.array(rows[1], np.intp))

    def elements(self, node: Condition) -> Iterator[_Values]:
        """The values of a field that are no lists, the elements of lists, and nulls."""
        alike: dict[tuple[Any, bool], tuple[list[Any], list[int]]] = defaultdict(lambda: ([], []))
        hidden: list[int] = []
        for row, message in enumerate(self._messages):
            for found in self._at(message, node.field):
                if found is _HIDDEN or (self._left and self._is_left(found, node.field.names)):
                    hidden.append(row)
                    continue
                for value in _flat(found) if isinstance(found, list) else (found,):
                    if not isinstance(value, Mapping | bytes):  # which equal nothing
                        # A null is one here: what is missing is not there.
                        values, rows = alike[_type_of(value), isinstance(found, list)]
                        values.append(repaired_text(value) if isinstance(value, str) else value)
                        rows.append(row)
        yield _Values(None, np.array(hidden, np.intp))
        for (kind, is_element), (values, rows) in alike.items():
            array = np.array(values, object) if kind is None else pa.array(values, kind)
            yield _Values(array, np.array(rows, np.intp), is_element)

    def _at(self, message: object, target: Field) -> Iterator[object]:
        """Everything at a path: values, whole arrays, statistics of arrays."""
        parts, types = target.parts, self.types
        stat = types.statistic(parts)
        if stat is None or not types.known:
            yield from self._reached(message, parts)
        if stat is None:
            return
        for array in self._reached(message, parts[:-1]):
            if isinstance(array, list | bytes) and (types.known or _has_statistic(array, stat)):
                yield statistic_of(array, stat)
            elif array is _HIDDEN:
                yield array
            elif types.known and isinstance(array, Mapping) and stat in array:
                yield array[stat]

    def _reached(self, value: object, parts: Parts, path: str = "") -> Iterator[object]:
        """The values at a path; through an array, those of each element. A last array is whole."""
        if not parts:
            yield value
            return
        part, rest = parts[0], parts[1:]
        if self._left and self._is_left(value, path):
            inside = cast("Mapping[str, object]", value)
            yield _HIDDEN if rest else inside.get(str(part), _HIDDEN)
        elif isinstance(part, Slice):
            if isinstance(value, list):
                yield from self._reached(value[part.begin : part.end], rest, path)
        elif isinstance(value, Mapping):
            name = str(part)
            if name in value:
                yield from self._reached(value[name], rest, f"{path}.{name}" if path else name)
        elif isinstance(value, list) and isinstance(part, int):
            yield from self._reached(value[part], rest, path) if part < len(value) else ()
        elif isinstance(value, list):
            for inner in _flat(value):
                if isinstance(inner, Mapping):
                    yield from self._reached(inner, parts, path)

    def _is_left(self, value: object, path: str) -> bool:
        """True for the summary of an array that is gone."""
        if not isinstance(value, Mapping) or not path:
            return False
        return path in self.types.arrays if self.types.known else {"n"} <= value.keys() <= _SUMMARY


def _flat(value: object) -> Iterator[object]:
    """The elements of a list, also those of lists in it, in their order."""
    left = [value]
    while left:
        value = left.pop()
        if isinstance(value, list):
            left += reversed(value)
        else:
            yield value


def _type_of(value: object) -> pa.DataType | None:
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

    def there(self, target: Field) -> Iterator[_Values]:
        """As of `_Objects`."""
        for found in self._at(target):
            if found.values is None or found.is_element:
                yield found
            else:
                valid, nulls = found.split()
                yield valid
                yield _Values(None, nulls)  # null, or missing

    def elements(self, node: Condition) -> Iterator[_Values]:
        """As of `_Objects`; nothing else is null."""
        for one in self._at(node.field):
            found = one
            while found.values is not None:
                found, nulls = found.split()
                if found.is_element:
                    yield _Values(pa.nulls(len(nulls)), nulls, is_element=True)
                elif None in node.operands:
                    yield _Values(None, nulls)  # null, or missing
                if not is_list(found.values.type):
                    break
                found = _flattened(found)
            yield self._end(found, node) if self._may_be_left(found, node.field.names) else found

    def _may_be_left(self, found: _Values, path: str) -> bool:
        """True for summaries of arrays, and for what may be some."""
        if found.values is None or not pa.types.is_struct(found.values.type):
            return False
        if self.types.known and not found.is_element:
            return path in self.types.arrays
        return is_summary(found.values.type)

    def _end(self, found: _Values, node: Condition) -> _Values:
        """The ends of arrays, if these tell what is asked of the elements."""
        path, end = node.field.names, _ENDS.get(node.op, "")
        place = found.values.type.get_field_index(end)
        if place >= 0 and self.types.known and not (found.is_element or node.field.is_absolute):
            values = pc.struct_field(found.values, [place])
            if self.types.are_floats(path) or pa.types.is_integer(values.type):
                return found._replace(values=values, is_element=True).split()[0]
        return found._replace(values=None)

    def _at(self, target: Field) -> Iterator[_Values]:
        """The values at a path, whole arrays, statistics of arrays."""
        parts, start = target.parts, _Values(self._records, np.arange(len(self)))
        stat = self.types.statistic(parts)
        if self._records.type.get_field_index(str(parts[0])) < 0:
            yield start._replace(values=None)
        elif stat is None:
            yield from self._reach(start, parts)
        elif not self.types.known:
            yield start._replace(values=None)  # a message may have a field of that name
        else:
            for array in self._reach(start, parts[:-1]):
                yield array if array.values is None else _statistic(array, stat)

    def _reach(self, found: _Values, parts: Parts, path: str = "") -> Iterator[_Values]:
        """The values at a path, from some values on; through an array, from each element."""
        kind = None if found.values is None else found.values.type
        if kind is None or isinstance(kind, pa.BaseExtensionType):  # JSON text
            yield found._replace(values=None)
        elif not parts:
            yield found
        elif path and self._may_be_left(found, path):
            yield found._replace(values=None)
        elif isinstance(parts[0], Slice):
            if is_list(kind):
                yield from self._reach(_sliced(found, parts[0]), parts[1:], path)
        elif pa.types.is_struct(kind):
            name = str(parts[0])
            if kind.get_field_index(name) >= 0:
                valid, _ = found.split()
                inner = _Values(pc.struct_field(valid.values, name), valid.rows)
                yield from self._reach(inner, parts[1:], f"{path}.{name}" if path else name)
        elif is_list(kind) and isinstance(parts[0], int):
            yield from self._reach(_at_place(found, parts[0]), parts[1:], path)
        elif is_list(kind):
            yield from self._reach(_flattened(found), parts, path)


def _flattened(found: _Values) -> _Values:
    """The elements of lists; a null list has none."""
    values = pc.list_flatten(found.values)
    parents = to_numpy(pc.list_parent_indices(found.values))
    is_text = isinstance(values.type, pa.BaseExtensionType)
    return _Values(None if is_text else values, found.rows[parents], is_element=True)


def _sliced(found: _Values, part: Slice) -> _Values:
    """Some elements of each list; a null has none."""
    (values, rows, _), _ = found.split()
    made = pc.list_slice(values, part.begin, part.end, return_fixed_size_list=False)
    return _Values(made, rows)


def _at_place(found: _Values, place: int) -> _Values:
    """The element at an index of each list that is long enough."""
    values, rows, _ = found.some(lengths_of(found.values) > place)
    if not len(values):
        return _Values(pa.nulls(0, values.type.value_type), rows, is_element=True)
    return _Values(pc.list_element(values, place), rows, is_element=True)


def _statistic(found: _Values, stat: Stat) -> _Values:
    """A statistic of arrays whose types are known, equal to that in the index."""
    (values, rows, _), _ = found.split()
    made = None
    if pa.types.is_struct(values.type):
        has = values.type.get_field_index(stat) >= 0
        made = pc.struct_field(values, stat) if has else None
    elif is_array(values.type):
        made = statistic(values, stat)
    return _Values(made, rows, is_element=True)


# Exact comparisons of numbers and strings of any types.


def is_number(value: object) -> TypeGuard[float]:
    """True if a value is an integer or a float; booleans are neither."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def to_numpy(values: Any) -> NDArray[Any]:
    """An Arrow array as one of numpy."""
    found: NDArray[Any] = values.to_numpy(zero_copy_only=False)
    return found


def kind_of(values: Any) -> str:
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


def compared(values: Any, op: str, operands: Sequence[Value]) -> Mask:
    """Mask of the values, none of them null, that `==`, `in`, `~` or an order holds for."""
    if op == "~":
        if kind_of(values) != "U":
            return np.zeros(len(values), np.bool_)
        return to_numpy(pc.match_substring_regex(values, str(operands[0])))
    are_int64 = all(type(value) is int and LOW <= value <= HIGH for value in operands)
    if len(operands) > 1 and are_int64 and isinstance(values, pa.Int64Array):
        return to_numpy(pc.is_in(values, pa.array(operands, pa.int64())))
    found = np.zeros(len(values), np.bool_)
    for value in operands:
        found |= _compared(values, "==" if op == "in" else op, value)
    return found


def compared_rows(left: NDArray[Any], op: str, right: NDArray[Any]) -> Mask:
    """Compare numbers with others, exactly."""
    if left.dtype.kind != right.dtype.kind:
        left, right = left.astype(object), right.astype(object)
    with np.errstate(invalid="ignore"):  # NaN
        return _ORDERS[op](left, right).astype(np.bool_)  # type: ignore[no-any-return]


def single(value: Value) -> Value:
    """The float32 nearest to a decimal literal; integers, and what float32 cannot hold, stay."""
    if not isinstance(value, float):
        return value
    with np.errstate(over="ignore"):
        near = float(np.float32(value))
    return near if math.isfinite(near) else value


def _compared(values: Any, order: str, value: Value) -> Any:
    """Mask of the values that an order holds for; False for values of another kind."""
    kind = kind_of(values)
    wanted = {bool: "b", str: "U"}.get(type(value), "ifO" if is_number(value) else "")
    if not kind or kind not in wanted:
        return False
    if kind == "O":
        return _ORDERS[order](values, value).astype(np.bool_)
    if kind in "bU":
        return to_numpy(getattr(pc, _ORDERS[order].__name__)(values, pa.scalar(value, values.type)))
    numbers = to_numpy(values.cast(pa.int64()) if is_time(values.type) else values)
    compare = _integers_compared if kind == "i" else _floats_compared
    return compare(numbers, order, value)  # type: ignore[arg-type]


def _integers_compared(numbers: NDArray[Any], order: str, value: float) -> Any:
    """Compare integers with any number, exactly."""
    limit: int
    if isinstance(value, int):
        limit = value
    elif math.isnan(value):
        return False
    elif math.isinf(value):
        return order in ({"<", "<="} if value > 0 else {">", ">="})
    elif value.is_integer():
        limit = int(value)
    elif order == "==":
        return False
    else:  # between two integers: x < 1.5 becomes x < 2, x <= 1.5 becomes x <= 1
        limit = (math.ceil if order in {"<", ">="} else math.floor)(value)
    info = np.iinfo(numbers.dtype)
    if limit > info.max:
        return order in {"<", "<="}
    if limit < info.min:
        return order in {">", ">="}
    return _ORDERS[order](numbers, numbers.dtype.type(limit))


def _floats_compared(numbers: NDArray[Any], order: str, value: float) -> Any:
    """Compare floats with any number, exactly."""
    wide = numbers.astype(np.float64, copy=False)
    near = nearest(value)
    if math.isnan(near):
        return np.isnan(wide) if order == "==" else False
    if near == value:
        return _ORDERS[order](wide, near)
    if order == "==":
        return False
    # No double lies between both, so it is on the other side or it is not.
    order = order[0] if (order[0] == "<") == (near > value) else f"{order[0]}="
    return _ORDERS[order](wide, near)
