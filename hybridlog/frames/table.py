"""Builds one table from the columns of many chunks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hybridlog.frames.accumulate import Values, accommodate, accumulator_for, flatten
from hybridlog.frames.ragged import Growing

if TYPE_CHECKING:
    from collections.abc import Iterator

    import pandas as pd
    import pyarrow as pa
    from numpy.typing import NDArray

    from hybridlog.frames.accumulate import Accumulator, Finished
    from hybridlog.schema.column import Records


class TableBuilder:
    """Collects columns chunk by chunk and hands them over as one table.

    Nested messages become dotted columns (`pose.position.x`). A column that is absent
    from a chunk is missing there; one whose type changes gets the common type, times
    that meet other numbers become nanoseconds, and what has no common type becomes
    text. Rows that are all equal, as covariances often are, are kept once.

    `to_arrow` and `to_pandas` hand over the columns one by one, so that no more than
    the table and one column is in memory; the builder is spent afterwards.

    Args:
        expected_rows: Rows that will come, if known; saves copying.
    """

    def __init__(self, *, expected_rows: int | None = None) -> None:
        self._expected = max(expected_rows or 0, 0)
        self._time = Growing(np.dtype(np.int64), self._expected)
        self._seq = Growing(np.dtype(np.int64), self._expected)
        self._columns: dict[str, Accumulator] = {}
        self._spent = False

    def __len__(self) -> int:
        """Rows so far."""
        return len(self._time)

    def append(self, log_time: NDArray[np.int64], seq: NDArray[np.int64], records: Records) -> None:
        """Add the rows of one chunk; nothing of them is kept by reference.

        Args:
            log_time: int64[n], nanoseconds since the epoch.
            seq: int64[n], arrival numbers: they order rows of the same log time.
            records: n rows.

        Raises:
            ValueError: The lengths differ.
            RuntimeError: The table was handed over already.
        """
        self._open()
        rows = len(log_time)
        leaves = flatten(records)
        lengths = {rows, len(seq), len(records), *map(len, leaves.values())}
        if len(lengths) != 1:
            raise ValueError(f"the columns of one chunk have different lengths: {lengths}")
        before = len(self)
        for path, column in leaves.items():
            current = self._columns.get(path)
            if current is None:
                expected = max(self._expected, before + rows)
                current = accumulator_for(column, expected)
                if before:
                    current.skip(before)
            elif not current.accepts(column):
                current = accommodate(current, column)
            current.append(column)
            self._columns[path] = current
        if len(leaves) != len(self._columns):
            for path, current in self._columns.items():
                if path not in leaves:
                    current.skip(rows)
        self._time.append(log_time)
        self._seq.append(seq)

    def to_arrow(self, *, time_column: str = "log_time") -> pa.Table:
        """The table, sorted by log time and arrival.

        Args:
            time_column: Name of the first column, timestamp[ns, UTC]. A field of that
                name gets trailing underscores.

        Returns:
            Numbers keep their wire type; times are timestamp[ns, UTC], durations
            duration[ns], strings string, arrays fixed_size_list when the definition
            fixes their length and list otherwise.

        Raises:
            RuntimeError: The table was handed over already.
        """
        from hybridlog.frames.arrow import table_of

        time, order = self._sorted()

        def named() -> Iterator[tuple[str, Finished]]:
            taken = {time_column, *self._columns}
            yield time_column, Values(time, "time", None)
            for path, column in self._finish(order):
                name = path
                if path == time_column:
                    while name in taken:
                        name += "_"
                yield name, column

        return table_of(named())

    def to_pandas(self) -> pd.DataFrame:
        """The frame, sorted by log time and arrival.

        Returns:
            Index `log_time` (datetime64[ns, UTC]). Numbers keep their wire type;
            integers and booleans that are missing somewhere become the nullable type
            of the same width, floats NaN. Times are datetime64[ns, UTC], durations
            timedelta64[ns], strings `str`, arrays of numbers an `ArrayColumn` whose
            cells are numpy arrays, arrays of strings or messages Arrow lists.

        Raises:
            RuntimeError: The table was handed over already.
        """
        from hybridlog.frames.frame import frame_of

        time, order = self._sorted()
        return frame_of(time, self._finish(order))

    def _open(self) -> None:
        if self._spent:
            raise RuntimeError("this table was handed over already; build a new one")

    def _sorted(self) -> tuple[NDArray[np.int64], NDArray[np.intp] | None]:
        """Log times in order, and the order of the rows if they do not lie in it."""
        self._open()
        self._spent = True
        time: NDArray[np.int64] = self._time.finish()
        seq: NDArray[np.int64] = self._seq.finish()
        later = time[1:] > time[:-1]
        if bool((later | ((time[1:] == time[:-1]) & (seq[1:] >= seq[:-1]))).all()):
            return time, None
        order = np.lexsort((seq, time))
        return time[order], order

    def _finish(self, order: NDArray[np.intp] | None) -> Iterator[tuple[str, Finished]]:
        from hybridlog.frames.arrow import take

        for path in list(self._columns):
            column = self._columns.pop(path).finish()
            yield path, column if order is None else take(column, order)
