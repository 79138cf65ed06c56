"""MongoDB filters on columns in memory, with the meaning that MongoDB gives them.

Only what compares single values is answered here: numbers, booleans, times and strings.
Arrays, their summaries, patterns and expressions are left to MongoDB.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from operator import eq, ge, gt, le, lt
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from hybridlog.schema.column import Scalars, Strings

if TYPE_CHECKING:
    from numpy.typing import NDArray

Single = Scalars | Strings
"""A column of which every row has one value."""

_Kind = Literal["integer", "float", "bool", "string"]
_Test = Callable[[Single], Any]
_Filter = Callable[[Mapping[str, Single], int], Any]

_KINDS: dict[str, _Kind] = {
    "bool": "bool",
    "string": "string",
    "float32": "float",
    "float64": "float",
    "time": "integer",
    "duration": "integer",
    "byte": "integer",
    "char": "integer",
    # uint64 is none of them: beyond int64 the index holds it as a float.
    **dict.fromkeys(("int8", "int16", "int32", "int64", "uint8", "uint16", "uint32"), "integer"),
}
_ORDERS: dict[str, Callable[[Any, Any], Any]] = {
    "$eq": eq,
    "$lt": lt,
    "$lte": le,
    "$gt": gt,
    "$gte": ge,
}
_EXACT = 1 << 53  # integers up to it are floats without a loss
_MOST_VALUES = 16  # of a list, each of which is compared with the whole column
_INT64 = np.iinfo(np.int64)


@dataclass(frozen=True, slots=True)
class ColumnFilter:
    """A filter that columns can answer.

    Attributes:
        fields: Paths that it looks at.
    """

    fields: frozenset[str]
    _filter: _Filter

    def mask(self, columns: Mapping[str, Single], rows: int) -> NDArray[np.bool_]:
        """Which rows satisfy it.

        Args:
            columns: At least those of `fields`, each of so many rows.
            rows: Number of rows.

        Returns:
            bool[rows].
        """
        found: NDArray[np.bool_] = self._filter(columns, rows)
        return found


def is_single(kind: str) -> bool:
    """Whether a type, as a definition writes it, can be kept as a column and asked here."""
    return kind in _KINDS


def column_filter(query: Mapping[str, object], types: Mapping[str, str]) -> ColumnFilter | None:
    """Make a filter that columns can answer; None if only MongoDB can.

    Args:
        query: A MongoDB filter that was checked.
        types: Type of each path that has one value in every message.
    """
    compiler = _Compiler(types)
    try:
        found = compiler.all_of(query)
    except _UnfitError:
        return None
    return ColumnFilter(frozenset(compiler.fields), found)


class _UnfitError(Exception):
    """The filter asks for what columns do not tell."""


class _Compiler:
    def __init__(self, types: Mapping[str, str]) -> None:
        self._types = types
        self.fields: set[str] = set()

    def all_of(self, query: object) -> _Filter:
        if not isinstance(query, Mapping):
            raise _UnfitError
        if not query:
            return lambda _, rows: np.ones(rows, np.bool_)
        return _joined(np.logical_and, [self._clause(*item) for item in query.items()])

    def _clause(self, key: str, value: Any) -> _Filter:
        if key == "$and":
            return _joined(np.logical_and, [self.all_of(item) for item in value])
        if key in {"$or", "$nor"}:
            found = _joined(np.logical_or, [self.all_of(item) for item in value])
            return _negated(found) if key == "$nor" else found
        kind = _KINDS.get(self._types.get(key, ""))
        if kind is None:
            raise _UnfitError
        self.fields.add(key)
        test = _condition(kind, value)
        return lambda columns, _: test(columns[key])


def _joined(join: np.ufunc, parts: Sequence[Callable[..., Any]]) -> Callable[..., Any]:
    """All or any of some filters, or of some tests; at least one."""

    def found(*asked: object) -> Any:
        mask = parts[0](*asked)
        for part in parts[1:]:
            mask = join(mask, part(*asked))
        return mask

    return found


def _negated(inner: _Filter) -> _Filter:
    return lambda columns, rows: ~inner(columns, rows)


def _condition(kind: _Kind, value: object) -> _Test:
    """What stands behind a path: a value, or operators of which all must hold."""
    if not isinstance(value, Mapping):
        return _operation(kind, "$eq", value)
    if not value:
        raise _UnfitError
    tests = [_operation(kind, operator, operand) for operator, operand in value.items()]
    return _joined(np.logical_and, tests)


def _operation(kind: _Kind, operator: str, operand: Any) -> _Test:
    if operator in {"$ne", "$nin", "$not"}:
        positive = {"$ne": "$eq", "$nin": "$in"}.get(operator)
        if positive is None and not isinstance(operand, Mapping):
            raise _UnfitError  # a pattern
        inner = (
            _condition(kind, operand) if positive is None else _operation(kind, positive, operand)
        )
        return lambda column: ~inner(column)
    if operator == "$in":
        if not operand:
            return _always(False)
        if len(operand) > _MOST_VALUES:
            raise _UnfitError
        return _joined(np.logical_or, [_operation(kind, "$eq", item) for item in operand])
    if operator == "$exists" and isinstance(operand, bool):
        return _always(operand)
    if operator == "$type" and operand == "null":
        return _always(False)
    if operator not in _ORDERS:
        raise _UnfitError
    return _comparison(kind, operator, operand)


def _comparison(kind: _Kind, operator: str, operand: object) -> _Test:
    """A comparison with a value; of values of another kind none holds."""
    if isinstance(operand, bool):
        return _ordered(operator, np.bool_(operand)) if kind == "bool" else _always(False)
    if isinstance(operand, int | float):
        if kind == "integer":
            return _of_integers(operator, operand)
        return _of_floats(operator, operand) if kind == "float" else _always(False)
    if isinstance(operand, str):
        return _of_strings(operator, operand) if kind == "string" else _always(False)
    if operand is None:
        return _always(False)  # every row has a value
    raise _UnfitError


def _always(answer: bool) -> _Test:  # noqa: FBT001
    return lambda column: np.full(len(column), answer)


def _ordered(operator: str, operand: object) -> _Test:
    order = _ORDERS[operator]

    def found(column: Single) -> Any:
        assert isinstance(column, Scalars)
        return order(column.values, operand)

    return found


def _of_integers(operator: str, operand: float) -> _Test:
    """Integers with any number, exactly: floats would round those above 2^53."""
    if isinstance(operand, float):
        if math.isnan(operand):
            return _always(False)
        if math.isinf(operand):
            return _always(operator in ({"$lt", "$lte"} if operand > 0 else {"$gt", "$gte"}))
        if operator == "$eq" and not operand.is_integer():
            return _always(False)
        # Between two integers: x < 1.5 is x < 2, x <= 1.5 is x <= 1.
        operand = (math.ceil if operator in {"$lt", "$gte"} else math.floor)(operand)
    if operand > _INT64.max:
        return _always(operator in {"$lt", "$lte"})
    if operand < _INT64.min:
        return _always(operator in {"$gt", "$gte"})
    return _ordered(operator, np.int64(operand))


def _of_floats(operator: str, operand: float) -> _Test:
    if isinstance(operand, int) and abs(operand) > _EXACT:
        raise _UnfitError
    if math.isnan(operand) and operator not in {"$eq", "$lte", "$gte"}:
        return _always(False)
    order = _ORDERS[operator]

    def found(column: Single) -> Any:
        assert isinstance(column, Scalars)
        if math.isnan(operand):
            return np.isnan(column.values)
        # As the index holds them; float32 would be compared with a float32 otherwise.
        return order(column.values.astype(np.float64, copy=False), operand)

    return found


def _of_strings(operator: str, operand: str) -> _Test:
    """Strings by their bytes, which is how MongoDB puts them in order."""
    try:
        operand.encode()
    except UnicodeEncodeError:
        raise _UnfitError from None  # the driver says what is wrong
    order = _ORDERS[operator]

    def found(column: Single) -> Any:
        from hybridlog.frames.arrow import compared

        assert isinstance(column, Strings)
        return compared(column, order, operand)

    return found
