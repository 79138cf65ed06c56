"""Finished columns as a pandas frame."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from hybridlog.frames.accumulate import Lists, Text, Values
from hybridlog.frames.array_column import ArrayColumn
from hybridlog.frames.arrow import large_text
from hybridlog.frames.ragged import Ragged

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from hybridlog.frames.accumulate import Finished


def frame_of(log_time: NDArray[np.int64], columns: Iterable[tuple[str, Finished]]) -> pd.DataFrame:
    """A frame over finished columns, without copying numbers.

    Args:
        log_time: int64[n], nanoseconds since the epoch, for the index.
        columns: Names and columns of n rows.
    """
    data = {name: _array(column) for name, column in columns}
    index = pd.DatetimeIndex(log_time.view("M8[ns]"), name="log_time", copy=False)
    return pd.DataFrame(data, index=index.tz_localize("UTC"), copy=False)


def frame_of_intervals(
    names: Sequence[str],
    recording: NDArray[np.int32],
    begin: NDArray[np.int64],
    end: NDArray[np.int64],
    messages: NDArray[np.int64],
) -> pd.DataFrame:
    """A frame of intervals, one a row.

    Args:
        names: Ids of recordings.
        recording: int32[n], index into `names`.
        begin: int64[n], ns since the epoch.
        end: int64[n], ns since the epoch.
        messages: int64[n].
    """
    chosen = np.array(names, object)[recording] if len(names) else np.empty(0, object)
    data = {
        "recording": pd.array(chosen, dtype=_string_dtype()),
        "begin": pd.DatetimeIndex(begin.view("M8[ns]")).tz_localize("UTC").array,
        "end": pd.DatetimeIndex(end.view("M8[ns]")).tz_localize("UTC").array,
        "duration": (end - begin).view("m8[ns]"),
        "messages": messages,
    }
    return pd.DataFrame(data)


def _array(column: Finished) -> Any:
    if isinstance(column, Values):
        return _values(column)
    if isinstance(column, Text):
        return _string_dtype().__from_arrow__(large_text(column.rows))
    if isinstance(column, Lists):
        return ArrayColumn(_with_unit(column))
    return pd.arrays.ArrowExtensionArray(column.values)


def _values(column: Values) -> Any:
    values, missing = column.values, column.missing
    if column.kind == "number":
        return values if missing is None else _with_missing(values, missing)
    if missing is not None:
        values[missing] = np.iinfo(np.int64).min  # NaT
    if column.kind == "duration":
        return values.view("m8[ns]")
    return pd.DatetimeIndex(values.view("M8[ns]"), copy=False).tz_localize("UTC").array


def _with_missing(values: NDArray[Any], missing: NDArray[np.bool_]) -> Any:
    """Floats get NaN; integers and booleans pandas' nullable arrays, to stay exact."""
    if values.dtype.kind == "f":
        values[missing] = np.nan
        return values
    if values.dtype.kind == "b":
        return pd.arrays.BooleanArray(values, missing)
    return pd.arrays.IntegerArray(values, missing)


def _with_unit(column: Lists) -> Ragged:
    rows = column.rows
    if column.kind == "number":
        return rows
    unit = "M8[ns]" if column.kind == "time" else "m8[ns]"
    return Ragged(rows.values.view(unit), rows.start, rows.length)


def _string_dtype() -> Any:
    """The strings that pandas itself makes of str from version 3 on, held by Arrow."""
    if int(pd.__version__.split(".")[0]) >= 3:
        return pd.StringDtype(storage="pyarrow", na_value=np.nan)
    return pd.StringDtype("pyarrow_numpy")
