"""Topics as sources of DuckDB: columns and limits of a query reach `TopicView.rows`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import reduce
from typing import Any, Final

import pyarrow as pa
import pyarrow.dataset as ds
from duckdb._sources.nodes import Binary, Col, In, Lit, Node
from duckdb._sources.pyarrow import PyArrowDatasetSource

from hybridlog.sql.content import TopicView
from hybridlog.sql.rows import Limits, Reading
from hybridlog_storage.times import BEGIN, END

_UNITS: Final = {"t": 1, "log_time": 1000}
"""Columns of log time, and the nanoseconds that a number in each stands for."""


class TopicDataset(ds.Dataset, PyArrowDatasetSource):  # type: ignore[misc] # without types
    """A topic as DuckDB reads it. It relies on the source for the filters that are accepted.

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
        """True for a filter that limits times or recordings alone; DuckDB applies the others."""
        return _limits(predicate) is not None

    def stream(self, columns: Sequence[int] | None, filters: Sequence[Node]) -> tuple[object, bool]:
        """The rows for which the filters hold, as a stream of record batches."""
        schema, reading = self.schema, self._reading()
        if columns is not None:
            schema = pa.schema([schema.field(place) for place in columns])
        limits = reduce(Limits.common, filter(None, map(_limits, filters)), Limits())
        rows = _told(self.view.rows(schema, limits, reading), reading)
        reader = pa.RecordBatchReader.from_batches(schema, rows)
        return reader.__arrow_c_stream__(), columns is not None


def _limits(node: Node) -> Limits | None:
    """The rows for which a filter holds; None of one about anything but times and recordings."""
    match node:
        case Binary(op="AND", left=left, right=right):
            one, other = _limits(left), _limits(right)
            return None if one is None or other is None else one.common(other)
        case Binary(op=op, left=Col(parts=(name,)), right=Lit(value=int(value))) if name in _UNITS:
            begin, end = (number * _UNITS[name] for number in (value, value + 1))
            if begin > BEGIN and end < END:
                spans = {"<": (BEGIN, begin), "<=": (BEGIN, end), "=": (begin, end)}
                spans |= {">=": (begin, END), ">": (end, END)}
                return Limits(spans[op]) if op in spans else None
        case Binary(op="=", left=Col(parts=("recording",)), right=Lit(value=str(value))):
            return Limits(recordings=[value])
        case In(operand=Col(parts=("recording",)), values=values):
            return Limits(recordings=[str(one.value) for one in values if isinstance(one, Lit)])
    return None


def _told(batches: Iterator[pa.RecordBatch], reading: Reading) -> Iterator[pa.RecordBatch]:
    """The batches; their first error is noted."""
    try:
        yield from batches
    except Exception as error:
        reading.error = reading.error or error
        raise
