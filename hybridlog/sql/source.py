"""Topics as sources of DuckDB: columns and filters of a query reach `TopicView.rows`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial, reduce
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.dataset as ds
from duckdb._sources.nodes import Binary, Col, In, Lit, Node, Postfix, Unary, Untranslatable
from duckdb._sources.pyarrow import PyArrowDatasetSource
from duckdb._sources.to_arrow import to_arrow
from numpy.typing import NDArray

from hybridlog.sql.content import TopicView
from hybridlog.sql.rows import Bounds, Filter, Reading

_COMPARED: Final[Mapping[str, Callable[..., NDArray[np.bool_]]]] = {
    "=": lambda low, high, value: (low <= value) & (value <= high),
    "!=": lambda low, high, value: (low != value) | (high != value),
    "<": lambda low, _, value: low < value,
    "<=": lambda low, _, value: low <= value,
    ">": lambda _, high, value: high > value,
    ">=": lambda _, high, value: high >= value,
}
"""By operator, a test if a comparison may hold for values between a low and a high bound."""


class TopicDataset(ds.Dataset, PyArrowDatasetSource):  # type: ignore[misc] # without types
    """A topic as DuckDB reads it. DuckDB relies on the source for the filters that it hands over.

    DuckDB takes the number of rows, and asks which filters are applied, by a class that is no
    part of its documented interface; so the version of its package is bounded.
    """

    def __init__(self, view: TopicView, reading: Callable[[], Reading]) -> None:
        PyArrowDatasetSource.__init__(self, self)
        self.view = view
        self._reading = reading

    @property
    def schema(self) -> Any:
        """All columns."""
        return self.view.schema

    def rows(self) -> int:
        """Number of rows, nearly."""
        return self.view.size

    def accepts(self, predicate: Any) -> bool:
        """True for a filter that pyarrow evaluates as DuckDB does.

        No rows are left out by statistics of floats, so NaN does not matter.
        """
        try:
            to_arrow(predicate, self.schema)
        except Untranslatable:
            return False
        return True

    def stream(self, columns: Sequence[int] | None, filters: Sequence[Node]) -> tuple[object, bool]:
        """The rows for which the filters hold, as a stream of record batches."""
        schema, reading = self.schema, self._reading()
        if columns is not None:
            schema = pa.schema([schema.field(place) for place in columns])
        whole = reduce(partial(Binary, "AND"), filters) if filters else Node()
        expression = to_arrow(whole, self.schema) if filters else None
        where = Filter(expression, {*_paths(whole)}, partial(_may_hold, whole))
        rows = self.view.rows(schema.names, where, reading)
        reader = pa.RecordBatchReader.from_batches(schema, _told(rows, reading))
        return reader.__arrow_c_stream__(), columns is not None


def _may_hold(node: Node, bounds: Bounds) -> NDArray[np.bool_]:
    """Mask of the parts that may have rows for which a filter holds."""
    match node:
        case Binary(op="AND", left=left, right=right):
            return _may_hold(left, bounds) & _may_hold(right, bounds)
        case Binary(op="OR", left=left, right=right):
            return _may_hold(left, bounds) | _may_hold(right, bounds)
        case Binary(op=op, left=Col(parts=(name,)), right=Lit(value=value)) if (
            op in _COMPARED and name in bounds
        ):
            return _COMPARED[op](*bounds[name], value)
        case In(operand=Col() as column, values=values):
            each = (_may_hold(Binary("=", column, one), bounds) for one in values)
            return reduce(np.logical_or, each)
    return np.ones(len(bounds["t"][0]), np.bool_)


def _paths(node: Node) -> Iterator[tuple[str, ...]]:
    """The paths that a filter tests."""
    pending = [node]
    while pending:
        match pending.pop():
            case Col(parts=parts):
                yield parts
            case Binary(left=left, right=right):
                pending += [left, right]
            case Unary(operand=operand) | Postfix(operand=operand) | In(operand=operand):
                pending.append(operand)


def _told(batches: Iterator[pa.RecordBatch], reading: Reading) -> Iterator[pa.RecordBatch]:
    """The batches; their first error is noted."""
    try:
        yield from batches
    except Exception as error:
        reading.error = reading.error or error
        raise
