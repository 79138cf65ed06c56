"""Topics as sources of DuckDB: columns and filters of a query reach `TopicView.rows`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import pyarrow as pa
import pyarrow.dataset as ds
from duckdb._sources.nodes import Untranslatable
from duckdb._sources.pyarrow import PyArrowDatasetSource
from duckdb._sources.to_arrow import to_arrow

from hybridlog.sql.content import TopicView
from hybridlog.sql.plan import Reading


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

    def scanner(
        self,
        columns: Sequence[str] | None = None,
        filter: Any = None,  # noqa: A002
        **_: Any,
    ) -> _Scanner:
        """A scanner, whose reader DuckDB takes."""
        names = self.schema.names if columns is None else list(columns)
        schema = pa.schema([self.schema.field(name) for name in names])
        reading = self._reading()
        batches = _told(self.view.rows(names, filter, reading), reading)
        return _Scanner(pa.RecordBatchReader.from_batches(schema, batches))


@dataclass
class _Scanner:
    """Taken for a scanner by DuckDB."""

    reader: pa.RecordBatchReader

    def to_reader(self) -> pa.RecordBatchReader:
        """The rows as a stream of record batches."""
        return self.reader


def _told(batches: Iterator[pa.RecordBatch], reading: Reading) -> Iterator[pa.RecordBatch]:
    """The batches; their first error is noted."""
    try:
        yield from batches
    except Exception as error:
        reading.error = reading.error or error
        raise
