"""Evaluates predicates on columns of messages.

Null is missing. A condition holds for a message, fails, or is open: a summary in place of a long
array does not tell what is asked of its elements. JSON text is decoded where it is asked about.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from msgspec.structs import replace

from hybridlog.query.predicate.tree import (
    NEGATED,
    And,
    Condition,
    Field,
    FieldTypes,
    Node,
    Not,
    Or,
    Parts,
    Predicate,
    Slice,
    Stat,
    Value,
    is_meta,
)
from hybridlog.schema.arrow_types import (
    is_array,
    is_list,
    is_summary,
    is_text,
    is_time,
    json_array,
    lengths_of,
    lists,
    plain_values,
    statistic,
    structs,
    values_array,
)
from hybridlog.schema.column import offsets, ranges, summary_of
from hybridlog.schema.text import nearest

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.question import Part, RecordedChannel
    from hybridlog_storage.messages import Batch

    Mask = NDArray[np.bool_]
    Rows = NDArray[np.intp]
    Types = FieldTypes | Mapping[str, str] | None

_JSON: Final = pa.json_()
LOW, HIGH = -(2**63), 2**63 - 1
"""Smallest and greatest int64."""
_ORDERS: dict[str, np.ufunc] = {
    "==": np.equal,
    "<": np.less,
    "<=": np.less_equal,
    ">": np.greater,
    ">=": np.greater_equal,
}


class Verdict(NamedTuple):
    """The messages for which a predicate holds, and those for which it fails: bool[n] each."""

    holds: Mask
    fails: Mask

    @property
    def open(self) -> Mask:
        """Those of which neither is known."""
        return ~(self.holds | self.fails)


def on_columns(
    predicate: Predicate, types: Types, records: pa.StructArray, *, left: bool = False
) -> Verdict:
    """Evaluate a predicate on messages with at least its fields.

    Arrays may be structs of `n`, `min`, `max` and `mean`, or of `n`, if they are `left`.
    """
    return _Columns(FieldTypes.of(types), records, left=left).verdict(predicate.root)


class _Values(NamedTuple):
    """Values at a path, in any order.

    Attributes:
        values: One of each of the `rows`, in an Arrow array; integers beyond 64 bits in one of
            numpy. None if there may be any.
        is_element: True for elements of an array.
    """

    values: Any
    rows: Rows
    is_element: bool = False

    @property
    def kind(self) -> pa.DataType | None:
        """The type of an Arrow array."""
        return getattr(self.values, "type", None)

    def valid(self) -> _Values:
        """Those that are not null."""
        if self.kind is None or not self.values.null_count:
            return self
        return self.some(to_numpy(self.values.is_valid()))

    def some(self, chosen: Mask) -> _Values:
        """The chosen ones."""
        if chosen.all():
            return self
        values = self.values
        if values is not None:
            values = values[chosen] if self.kind is None else values.filter(pa.array(chosen))
        return self._replace(values=values, rows=self.rows[chosen])


class _Columns:
    """Messages as columns; `left` if arrays may be summaries."""

    def __init__(self, types: FieldTypes, records: pa.StructArray, *, left: bool = False) -> None:
        self._types = types
        self._records = records
        self._left = left

    def verdict(self, node: Node) -> Verdict:
        """The messages for which a predicate holds, and fails."""
        none = np.zeros(len(self._records), np.bool_)
        match node:
            case And(items):
                inner = [self.verdict(item) for item in items]
                holds = np.logical_and.reduce([~none, *(one.holds for one in inner)])
                return Verdict(holds, np.logical_or.reduce([none, *(one.fails for one in inner)]))
            case Or(items):
                return self.verdict(Not(And(tuple(map(Not, items)))))
            case Not(item):
                return Verdict(*reversed(self.verdict(item)))
            case Condition():
                return self.outcome(node)
        return Verdict(none, none)

    def outcome(self, node: Condition) -> Verdict:
        """The messages for which a condition holds, and fails."""
        exists = Condition(node.field, "exists")
        if node.op == "missing":
            return Verdict(*reversed(self.outcome(exists)))
        if node.op in NEGATED:
            there = self.outcome(exists)
            found = self.outcome(replace(node, op=NEGATED[node.op]))
            return Verdict(there.holds & found.fails, there.fails | found.holds)
        if self._types.are_singles(node.field.parts):
            # Decimal literals as float32 holds them, like the values.
            node = replace(node, operands=tuple(map(single, node.operands)))
        holds, is_known = (np.full(len(self._records), one) for one in (False, True))
        for rows in self._holding(node, is_known):
            holds[rows] = True
        return Verdict(holds, is_known & ~holds)

    def _holding(self, node: Condition, is_known: Mask) -> Iterator[Rows]:
        """Rows for which a condition holds; `is_known` becomes False where it may hold besides."""
        if node.op == "exists":
            yield from (found.rows for found in _known(self._at(node.field), is_known))
        elif node.other is None:
            for found in _known(self._elements(node), is_known):
                values = _absolute(found.values) if node.field.is_absolute else found.values
                yield found.rows[compared(values, node.op, node.operands)]
        else:
            both = (replace(node, field=one, other=None) for one in (node.field, node.other))
            sides = [[*map(_numbers, _known(self._elements(one), is_known))] for one in both]
            for (own, left), (others, right) in product(*sides):
                rows, one, two = np.intersect1d(own, others, return_indices=True)
                yield rows[compared_rows(left[one], node.op, right[two])]

    def _elements(self, node: Condition) -> Iterator[_Values]:
        """The values of a field that are no lists, and the elements of lists."""
        for found in self._at(node.field):
            yield from self._leaves(found, node)

    def _leaves(
        self, found: _Values, node: Condition, *, is_in_list: bool = False
    ) -> Iterator[_Values]:
        found = found.valid()
        kind = found.kind
        if kind is None:
            yield found
        elif is_list(kind):
            yield from self._leaves(_flattened(found), node, is_in_list=True)
        elif kind == _JSON:
            for one in _apart(found):
                yield from self._leaves(one, node, is_in_list=is_in_list)
        elif self._left and is_summary(kind):
            yield found._replace(values=None)
        elif is_in_list and node.op in {"<", "<=", ">", ">="} and pa.types.is_floating(kind):
            yield found.some(np.isfinite(to_numpy(found.values)))
        else:
            yield found

    def _at(self, target: Field) -> Iterator[_Values]:
        """The values at a path, whole arrays, statistics of arrays; none of them null."""
        parts, start = target.parts, _Values(self._records, np.arange(len(self._records)))
        stat = self._types.statistic(parts)
        if stat is None:
            yield from self._reach(start, parts)
            return
        is_named = np.zeros(len(self._records), np.bool_)
        if not self._types.known:
            for found in self._reach(start, parts):
                is_named[found.rows] = True
                yield found
        for array in self._reach(start, parts[:-1]):
            for found in _statistics(array, stat):
                yield found.some(~is_named[found.rows])

    def _reach(self, found: _Values, parts: Parts) -> Iterator[_Values]:
        """The values at a path, from some values on; through an array, from each element."""
        found = found.valid()
        kind = found.kind
        if not parts or found.values is None:
            yield found
            return
        name = str(parts[0])
        if kind == _JSON:
            for one in _apart(found, parts[0]):
                yield from self._reach(one, parts)
        elif kind is None:
            return  # integers
        elif self._left and is_summary(kind):
            has = len(parts) == 1 and kind.num_fields > 1 and kind.get_field_index(name) >= 0
            yield found._replace(values=pc.struct_field(found.values, name) if has else None)
        elif isinstance(parts[0], Slice):
            if is_list(kind):
                yield from self._reach(_sliced(found, *parts[0]), parts[1:])
        elif pa.types.is_struct(kind):
            if kind.get_field_index(name) >= 0:
                inner = found._replace(values=pc.struct_field(found.values, name))
                yield from self._reach(inner, parts[1:])
        elif is_list(kind) and isinstance(parts[0], int):
            place = _sliced(found, parts[0], parts[0] + 1)
            yield from self._reach(_flattened(place), parts[1:])
        elif is_list(kind):
            yield from self._reach(_flattened(found), parts)


def _known(found: Iterator[_Values], is_known: Mask) -> Iterator[_Values]:
    for one in found:
        if one.values is None:
            is_known[one.rows] = False
        else:
            yield one


def _numbers(found: _Values) -> tuple[Rows, NDArray[Any]]:
    """The rows of single numbers and times, and these."""
    if found.is_element or kind_of(found.values) not in {"i", "f", "O"}:
        return found.rows[:0], np.empty(0)
    return found.rows, _plain(found.values)


def _plain(values: Any) -> NDArray[Any]:
    """Numbers, and times in nanoseconds."""
    if isinstance(values, np.ndarray):
        return values
    return to_numpy(values.cast(pa.int64()) if is_time(values.type) else values)


def _absolute(values: Any) -> Any:
    """Numbers without their signs; other values as they are."""
    if kind_of(values) not in {"i", "f", "O"} or not len(values):
        return values
    numbers = np.abs(_plain(values))
    if numbers.dtype.kind == "i":  # of the least integer there is none
        numbers = numbers.view(f"u{numbers.itemsize}")
    return numbers if numbers.dtype.kind == "O" else pa.array(numbers)


def _apart(found: _Values, part: str | int | Slice | None = None) -> Iterator[_Values]:
    """Values in JSON text, apart by the types that they have; of objects a field that is wanted."""
    wanted = [(part,)] if isinstance(part, str) else None
    alike: dict[object, tuple[list[Any], list[int]]] = defaultdict(lambda: ([], []))
    for row, value in zip(found.rows.tolist(), plain_values(found.values), strict=True):
        kind: object = type(value)
        if kind in {list, dict} or (kind is int and not LOW <= value <= HIGH):
            kind = values_array([value], wanted).type
        values, rows = alike[kind]
        values.append(value)
        rows.append(row)
    for kind, (values, rows) in alike.items():
        made: Any = values_array(values, wanted)
        if kind == _JSON:  # an integer beyond 64 bits, or what is nested too deeply
            are_integers = all(isinstance(value, int) for value in values)
            made = np.array(values, object) if are_integers else None
        yield _Values(made, np.array(rows, np.intp), found.is_element)


def _flattened(found: _Values) -> _Values:
    """The elements of lists, none of which is null."""
    rows = np.repeat(found.rows, lengths_of(found.values))
    return _Values(found.values.flatten(), rows, is_element=True)


def _sliced(found: _Values, begin: int, end: int | None) -> _Values:
    """Some elements of each list, as far as it has them; none of the lists is null."""
    lengths = lengths_of(found.values)
    count = np.maximum((lengths if end is None else np.minimum(lengths, end)) - begin, 0)
    places = ranges(np.cumsum(lengths) - lengths + begin, count)
    values = found.values.flatten().take(pa.array(places))
    return found._replace(values=lists(values, offsets(count)))


def _statistics(found: _Values, stat: Stat) -> Iterator[_Values]:
    """A statistic of arrays, equal to that in the index; nothing of what is no array."""
    kind, values = found.kind, found.values
    made = None
    if values is None:
        yield found
    elif kind is None:
        return  # integers
    elif kind == _JSON:
        for one in _apart(found):
            yield from _statistics(one, stat)
    elif is_list(kind) and kind.value_type == _JSON:
        texts = json_array([statistic_of(one, stat) for one in plain_values(values)])
        yield from _apart(found._replace(values=texts, is_element=True).valid())
    elif is_array(kind):
        made = statistic(values, stat)
    elif is_summary(kind) and kind.get_field_index(stat) >= 0:
        made = pc.struct_field(values, stat)
    if made is not None:
        yield found._replace(values=made, is_element=True).valid()


def statistic_of(values: Sequence[object], stat: Stat) -> float | None:
    """A statistic of an array of any values; None without a finite number, or with other values."""
    if stat == "n":
        return len(values)
    known = [value for value in values if value is not None]
    found = summary_of(known)
    return getattr(found, stat)[0].item() if found is not None and found.has[0] else None


# Exact comparisons of numbers and strings of any types.


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
    wanted = {bool: "b", str: "U"}.get(type(value), "ifO")
    if not kind or kind not in wanted:
        return False
    if kind in "bU":
        assert isinstance(values, pa.Array)
        return to_numpy(getattr(pc, _ORDERS[order].__name__)(values, pa.scalar(value, values.type)))
    if kind == "O":
        return _ORDERS[order](values, value).astype(np.bool_)
    compare = _floats_compared if kind == "f" else _integers_compared
    return compare(_plain(values), order, value)  # type: ignore[arg-type]


def _integers_compared(numbers: NDArray[Any], order: str, value: float) -> Any:
    """Compare integers with any number, exactly."""
    if isinstance(value, float) and math.isinf(value):
        value = 2**64 if value > 0 else -(2**64)
    if isinstance(value, float):
        if math.isnan(value) or (order == "==" and not value.is_integer()):
            return False
        # Between two integers: x < 1.5 becomes x < 2, x <= 1.5 becomes x <= 1.
        value = (math.ceil if order in {"<", ">="} else math.floor)(value)
    return _ORDERS[order](numbers, value)


def _floats_compared(numbers: NDArray[Any], order: str, value: float) -> Any:
    """Compare floats with any number, exactly."""
    wide, near = numbers.astype(np.float64, copy=False), nearest(value)
    if order == "==":
        return np.isnan(wide) if math.isnan(near) else (wide == near) & (near == value)
    # No double lies between both, so it is on the other side or it is not.
    if near != value and not math.isnan(near):
        order = order[0] if (order[0] == "<") == (near > value) else f"{order[0]}="
    return _ORDERS[order](wide, near)


# Predicates of parts, on messages that were read.


def matches(
    part: Part, channel: RecordedChannel, batch: Batch, seq: NDArray[np.int64]
) -> tuple[Mask, int, int]:
    """Decide the predicate of a part on messages of one of its channels; `seq` as they arrived.

    Returns bool[n], true where it holds; the number of messages that could not be tested, since
    they do not fit their definition or lack arrays; and that of those that lack arrays.
    """
    from hybridlog.columns.rows import LeftFields

    predicate = part.predicate
    assert predicate is not None
    holds = np.zeros(len(batch), np.bool_)
    fields = {path.split(".")[0].split("[")[0] for path in predicate.fields()} - {"_meta"}
    times = batch.log_time, seq, batch.publish_time
    if not fields:  # what a message itself provides can be asked of any
        return verdict_of(part, channel, structs({}, len(batch)), *times).holds, 0, 0
    if not channel.codec.indexed:
        return holds, len(batch), 0
    decoded = channel.codec.columns_of(batch, fields)
    rows, records = decoded.rows, decoded.records
    times = batch.log_time[rows], seq[rows], batch.publish_time[rows]
    if isinstance(records, LeftFields):  # where an array is gone, its summary is asked
        whole, left = records.both()
        of_whole = verdict_of(part, channel, whole, *times)
        of_left = verdict_of(part, channel, left, *times, left=True)
        gone = records.lacks([one.field.names for one in predicate.conditions()])
        pairs = zip(of_left, of_whole, strict=True)
        found = Verdict(*(np.where(gone, *masks) for masks in pairs))
    else:
        found = verdict_of(part, channel, decoded.arrow(), *times)
    holds[rows] = found.holds
    lacking = int(found.open.sum())
    return holds, len(batch) - len(rows) + lacking, lacking


def verdict_of(
    part: Part,
    channel: RecordedChannel,
    records: pa.StructArray,
    *times: Any,
    left: bool = False,
) -> Verdict:
    """The outcome of a part's predicate on columns; `times` are as of `_with_meta`."""
    assert part.predicate is not None
    records = _with_meta(part, channel, records, *times)
    return on_columns(part.predicate, part.field_types, records, left=left)


def _with_meta(
    part: Part, channel: RecordedChannel, records: pa.StructArray, *times: Any
) -> pa.StructArray:
    """The records with what a predicate asks of a message: log, arrival and publish times."""
    if part.predicate is None or not any(map(is_meta, part.predicate.fields())):
        return records
    log_time, seq, publish_time = times
    rows = len(log_time)
    columns: dict[str, Any] = {
        "t": pa.array(log_time),
        "rec": pa.array([channel.recording.key] * rows, pa.string()),
        "topic": pa.array([channel.channel.topic] * rows, pa.string()),
        "seq": pa.array(seq),
    }
    if channel.channel.has_publish_time and publish_time is not None:
        columns["pub"] = pa.array(publish_time)
    meta = pa.StructArray.from_arrays(list(columns.values()), names=list(columns))
    names = [field.name for field in records.type]
    return pa.StructArray.from_arrays([*records.flatten(), meta], names=[*names, "_meta"])
