"""Topics as sources of DuckDB, with their numbers of rows where its package takes them.

DuckDB 2.0 lets a dataset say how many rows it has and which filters it applies through a
class that is no part of its documented interface. Without that class a topic is a plain
dataset: answers are the same, plans are worse.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from importlib import import_module
from typing import Any

import pyarrow as pa
import pyarrow.dataset as ds

from hybridlog.sql.topic_view import Reading, TopicView


class TopicDataset(ds.Dataset):  # type: ignore[misc] # pyarrow has no types
    """A topic as DuckDB reads it: columns and filters reach `TopicView.rows`.

    DuckDB relies on the source for the filters that it hands over.
    """

    def __init__(self, view: TopicView, reading: Callable[[], Reading]) -> None:
        self.view = view
        self._reading = reading

    @property
    def schema(self) -> Any:
        """All columns."""
        return self.view.schema

    def scanner(
        self,
        columns: Sequence[str] | None = None,
        filter: Any = None,  # noqa: A002
        **_: Any,
    ) -> _Scanner:
        """A scanner, whose reader DuckDB takes."""
        names = self.schema.names if columns is None else list(columns)
        return _Scanner(self.view, names, filter, self._reading())


class _Scanner:
    def __init__(
        self, view: TopicView, columns: Sequence[str], where: Any, reading: Reading
    ) -> None:
        self._view = view
        self._columns = columns
        self._where = where
        self._reading = reading

    def to_reader(self) -> Any:
        """The rows as a stream of record batches."""
        schema = pa.schema([self._view.schema.field(name) for name in self._columns])
        return pa.RecordBatchReader.from_batches(schema, self._batches())

    def _batches(self) -> Iterator[pa.RecordBatch]:
        try:
            yield from self._view.rows(self._columns, self._where, self._reading)
        except Exception as error:
            self._reading.error = self._reading.error or error
            raise


def source_of(view: TopicView, reading: Callable[[], Reading]) -> TopicDataset:
    """A topic for `register`."""
    try:
        base = import_module("duckdb._sources.pyarrow").PyArrowDatasetSource
        translated = import_module("duckdb._sources.to_arrow").to_arrow
        refused = import_module("duckdb._sources.nodes").Untranslatable
        made: TopicDataset = _kind(base, translated, refused)(view, reading)
    except (ImportError, AttributeError, TypeError):
        return TopicDataset(view, reading)
    return made


def _kind(base: Any, translated: Callable[..., Any], refused: Any) -> Any:
    class Source(TopicDataset, base):  # type: ignore[misc] # of a package without types
        """A topic that tells DuckDB more than a dataset can."""

        def __init__(self, view: TopicView, reading: Callable[[], Reading]) -> None:
            TopicDataset.__init__(self, view, reading)
            base.__init__(self, self)

        def rows(self) -> int:
            """Number of rows, nearly."""
            return self.view.size

        def accepts(self, predicate: Any) -> bool:
            """True for a filter that pyarrow evaluates as DuckDB does.

            No rows are left out by statistics of floats, so NaN does not matter.
            """
            try:
                translated(predicate, self.schema)
            except refused:
                return False
            return True

    return Source
