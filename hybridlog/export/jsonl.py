"""Writes JSON lines: one object for each message, in UTF-8.

JSON has no NaN and no infinities: they become null. Integers keep all their digits, also
those past 2**53, which some readers round. Binary values are their length: `{"n": 1024}`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from datetime import date, timedelta
from typing import TYPE_CHECKING, Any

import numpy as np

from hybridlog.export.base import FileWriter, Sink, Target
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    import pyarrow as pa

_MAX_DEPTH = 200
_BLOCK = 1 << 20
_ROWS = 4096


def message_row(log_time: int, topic: str, fields: Mapping[str, object]) -> dict[str, object]:
    """The object of one message: `log_time_ns`, `topic`, then its fields.

    Args:
        log_time: Nanoseconds since the epoch.
        topic: Name of the topic.
        fields: Message fields; one with the name of one of these two gets a trailing
            underscore.
    """
    row: dict[str, object] = {"log_time_ns": log_time, "topic": topic}
    for name, value in fields.items():
        row[f"{name}_" if name in {"log_time_ns", "topic"} else name] = value
    return row


class JsonlWriter(FileWriter):
    """Writes JSON lines.

    Args:
        target: Path or binary stream.
    """

    def __init__(self, target: Target) -> None:
        super().__init__()
        self._sink = Sink(target)

    def write(self, rows: Iterable[Mapping[str, object]]) -> None:
        """Append objects. Values may be numpy scalars and arrays, times, bytes.

        Raises:
            UsageError: A value that has no JSON form.
            DiskFullError: No space left.
        """
        block: list[bytes] = []
        size = 0
        for row in rows:
            # A lone surrogate becomes its JSON escape.
            line = _line(row).encode("utf-8", "backslashreplace")
            block.append(line)
            size += len(line)
            if size >= _BLOCK:
                self._sink.write(b"".join(block))
                block, size = [], 0
        self._sink.write(b"".join(block))

    def write_table(self, table: pa.Table) -> None:
        """Append the rows of an Arrow table, which is faster than objects.

        Raises:
            UsageError: A column that has no JSON form.
            DiskFullError: No space left.
        """
        import pyarrow as pa
        import pyarrow.compute as pc

        from hybridlog.export.json_text import json_column

        for batch in table.to_batches(max_chunksize=rows_within(table)):
            try:
                lines = json_column(batch.to_struct_array())
            except pa.ArrowException as error:
                raise UsageError(f"the table cannot be written as JSON: {error}") from error
            ended = pc.binary_join_element_wise(lines, "\n", "")
            self._sink.write(b"".join(value.as_buffer() for value in ended))

    def _finish(self) -> None:
        self._sink.commit()

    def _discard(self) -> None:
        self._sink.abort()


def rows_within(table: pa.Table, *, limit: int = 16 << 20) -> int:
    """Number of rows of a table with about `limit` bytes, from 1 to 4096."""
    per_row = max(1, table.nbytes // max(1, table.num_rows))
    return int(min(_ROWS, max(1, limit // per_row)))


def _line(row: Mapping[str, object]) -> str:
    try:
        return json.dumps(row, ensure_ascii=False, allow_nan=False, default=_plain) + "\n"
    except ValueError:  # NaN or an infinity; rare, so searched only here
        return json.dumps(_clean(row, 0), ensure_ascii=False, default=_plain) + "\n"
    except RecursionError:
        raise UsageError("a message is nested too deep for JSON") from None


def _plain(value: object) -> object:
    """Convert a value of a type unknown to `json`."""
    for kind, make in _KINDS:
        if isinstance(value, kind):
            return make(value)
    raise UsageError(f"a value of type {type(value).__name__} has no JSON form")


def _numbers(value: np.ndarray[tuple[int, ...], np.dtype[np.generic]] | np.generic) -> object:
    if value.dtype.kind in "mM":
        unit = "datetime64[ns]" if value.dtype.kind == "M" else "timedelta64[ns]"
        value = value.astype(unit).astype(np.int64)
    plain: object = value.tolist()
    return plain


_KINDS: tuple[tuple[type, Callable[[Any], object]], ...] = (
    (np.ndarray, _numbers),
    (np.generic, _numbers),
    (bytes, lambda value: {"n": len(value)}),
    (bytearray, lambda value: {"n": len(value)}),
    (memoryview, lambda value: {"n": value.nbytes}),
    (date, lambda value: value.isoformat()),
    (timedelta, timedelta.total_seconds),
    (Mapping, dict),
    (Sequence, list),
    (AbstractSet, list),
)


def _clean(value: object, depth: int) -> object:
    """A copy with null for each number without a JSON form."""
    if depth > _MAX_DEPTH:
        raise UsageError("a message is nested too deep for JSON")
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, str | int):
        return value
    if isinstance(value, Mapping):
        return {key: _clean(item, depth + 1) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_clean(item, depth + 1) for item in value]
    return _clean(_plain(value), depth + 1)
