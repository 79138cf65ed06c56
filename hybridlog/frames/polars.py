"""Arrow tables as polars frames, if polars is installed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from hybridlog_storage.errors import MissingDependencyError

if TYPE_CHECKING:
    import pyarrow as pa


def to_polars(table: pa.Table) -> Any:
    """A polars frame of a table.

    Raises:
        MissingDependencyError: polars is not installed.
    """
    try:
        import polars as pl
    except ImportError as error:
        raise MissingDependencyError(
            "A polars frame needs polars: pip install polars; to_arrow and to_pandas do not."
        ) from error
    return pl.from_arrow(table)
