"""Arrow columns as a pandas or polars frame, in pandas with types that every library supports.

| column | in pandas |
|---|---|
| integers, booleans | numpy; `Int64` and so on, `boolean`, if some are missing |
| floats | numpy; `Float64` or `Float32` if some are missing, so NaN is no missing value |
| times, durations | `datetime64[ns, UTC]`, `timedelta64[ns]`; NaT where missing |
| strings, JSON text | `str`; NaN where missing |
| bytes | `bytes` objects; None where missing |
| arrays of numbers and booleans | read-only numpy arrays; None where missing |
| other arrays | lists; None where missing |
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc

from hybridlog.schema.arrow_types import is_list, is_numeric, is_text, lengths_of, missing_of
from hybridlog_storage.errors import MissingDependencyError

if TYPE_CHECKING:
    from numpy.typing import NDArray


_types = pa.types


def frame_of(table: pa.Table) -> pd.DataFrame:
    """A frame of an Arrow table, with its column `log_time` as the index."""
    index = pd.DatetimeIndex(_times(table["log_time"]), name="log_time", copy=False)
    return frame_of_table(table.drop_columns("log_time"), index)


def frame_of_table(table: pa.Table, index: pd.Index | None = None) -> pd.DataFrame:
    """A frame of all columns of an Arrow table; the index is row numbers, if none is given."""
    data = {name: _array(table.column(place)) for place, name in enumerate(table.column_names)}
    index = pd.RangeIndex(table.num_rows) if index is None else index
    return pd.DataFrame(data, index=index, copy=False)


def _array(column: pa.ChunkedArray[Any]) -> Any:
    kind = column.type
    if is_numeric(kind):
        return _numbers(column)
    if _types.is_timestamp(kind):
        return _times(column)
    if _types.is_duration(kind):
        return column.to_numpy()
    if kind == pa.json_():
        column = pa.chunked_array([chunk.storage for chunk in column.chunks], pa.string())
        kind = column.type
    if is_text(kind):
        return _string_dtype().__from_arrow__(column.cast(pa.large_string()))
    cells = np.empty(len(column), object)
    place = 0
    for chunk in filter(len, column.chunks):
        rows = slice(place, place + len(chunk))
        place += len(chunk)
        if is_list(kind) and _is_plain(chunk):
            cells[rows] = _arrays(chunk)
        else:
            cells[rows] = _objects(chunk)
    return cells


def _numbers(column: pa.ChunkedArray[Any]) -> Any:
    """Numbers and booleans in numpy, or in the nullable type of the same width."""
    if not column.null_count:
        return column.to_numpy()
    missing = column.is_null().to_numpy()
    values = pc.fill_null(column, pa.scalar(0).cast(column.type)).to_numpy()
    if values.dtype.kind == "b":
        return pd.arrays.BooleanArray(values, missing)
    made = pd.arrays.FloatingArray if values.dtype.kind == "f" else pd.arrays.IntegerArray
    return made(values, missing)


def _times(column: pa.ChunkedArray[Any]) -> Any:
    return pd.DatetimeTZDtype("ns", "UTC").__from_arrow__(column)


def _is_plain(chunk: pa.Array[Any]) -> bool:
    """True if the elements of lists are numbers or booleans, without nulls."""
    return is_numeric(chunk.type.value_type) and not chunk.flatten().null_count


def _arrays(chunk: pa.Array[Any]) -> NDArray[Any]:
    """The lists of a chunk as arrays; None for null."""
    values = chunk.flatten().to_numpy(zero_copy_only=False)
    values.flags.writeable = False
    lengths, missing = lengths_of(chunk), missing_of(chunk)
    cells = np.empty(len(chunk), object)
    width = int(lengths[0])
    if width and missing is None and bool((lengths == width).all()):
        cells[:] = list(values.reshape(-1, width))
        return cells
    ends = np.cumsum(lengths).tolist()
    cells[:] = [values[begin:end] for begin, end in pairwise([0, *ends])]
    if missing is not None:
        cells[missing] = None
    return cells


def _objects(chunk: pa.Array[Any]) -> NDArray[Any]:
    """Values of any type as Python objects."""
    cells = np.empty(len(chunk), object)
    cells[:] = chunk.to_pylist()
    return cells


def _string_dtype() -> Any:
    """The string type that pandas from version 3 on uses for str, stored by Arrow."""
    if int(pd.__version__.split(".")[0]) >= 3:
        return pd.StringDtype(storage="pyarrow", na_value=np.nan)
    return pd.StringDtype("pyarrow_numpy")


def to_polars(table: pa.Table) -> Any:
    """A polars frame of a table."""
    try:
        import polars as pl
    except ImportError as error:
        raise MissingDependencyError(
            "A polars frame needs polars: pip install polars; to_arrow and to_pandas do not."
        ) from error
    return pl.from_arrow(table)
