"""Topics as sources of DuckDB, with their numbers of rows where its package takes them.

DuckDB 2.0 lets a dataset say how many rows it has and which filters it applies through a
class that is no part of its documented interface. Without that class a topic is a plain
dataset: answers are the same, plans are worse.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

from hybridlog.sql.topic_view import Reading, TopicDataset, TopicView


def source_of(view: TopicView, reading: Callable[[], Reading]) -> TopicDataset:
    """A topic for `register`.

    Args:
        view: The topic.
        reading: Returns what the current execution reads.
    """
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
