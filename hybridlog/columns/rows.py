"""Rows of tables: messages by columns, and the columns that every table has."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from msgspec import Struct, field

from hybridlog.columns.fields import without
from hybridlog.columns.left_rows import LeftFields
from hybridlog.schema.codec import no_rows, stamp_array
from hybridlog.schema.states import State
from hybridlog_storage.messages import EXPIRED_IDS, distinct

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from hybridlog.columns.fields import FieldShape
    from hybridlog.schema.codec import Decoded
    from hybridlog_storage.segments.chunk import Placed


class Piece(Struct):
    """Rows of a topic in some segments; so many are `unreadable`.

    Attributes:
        own: The columns that every table has, by name.
        fields: A struct array, null where a message is unreadable; None without any fields.
        surplus: Rows of messages with bytes left over behind them.
    """

    segments: set[int]
    own: Mapping[str, Any]
    fields: Any
    unreadable: int = 0
    surplus: NDArray[np.intp] = field(default_factory=no_rows)

    @property
    def rows(self) -> int:
        """Number of messages."""
        return len(self.own["t"])

    @property
    def size(self) -> int:
        """Bytes in memory."""
        arrays = [*self.own.values(), *([] if self.fields is None else [self.fields])]
        return sum(int(array.nbytes) for array in arrays)

    def fields_as(self, kind: Any) -> Any:
        """The fields; without any, nulls of a type."""
        return pa.nulls(self.rows, kind) if self.fields is None else self.fields


def piece_of(
    placed: Placed,
    decoded: Decoded | None,
    state: State,
    *,
    has_publish_time: bool,
    columns: Callable[[Decoded], Any],
) -> Piece:
    """Rows of decoded messages of one topic and state, which readable ones have.

    `columns` turns fields into columns. Without a definition nothing is decoded.
    """
    batch = placed.batch
    count = len(batch)
    errors: list[str | None] = [None] * count
    found, surplus = None, no_rows()
    if decoded is not None:
        surplus = decoded.surplus
        for bad in decoded.unreadable:
            for row in bad.rows.tolist():
                errors[row] = bad.reason
        if len(decoded.rows):
            found = without(columns(decoded), decoded.rows, count)
    stamps = None if found is None else stamp_array(found)
    error = pa.array(errors, pa.string())
    states = pa.repeat(pa.scalar(str(state)), count)
    if error.null_count < count:
        states = pc.if_else(error.is_null(), states, State.UNREADABLE.value)
    ref = {
        "seg": pa.array(placed.segment),
        "chunk": pa.array(placed.chunk.astype(np.int32)),
        "off": pa.array(placed.offset),
        "len": pa.array(placed.length.astype(np.int32)),
    }
    own = {
        "log_time": pa.array(batch.log_time // 1000).view(pa.timestamp("us", "UTC")),
        "t": pa.array(batch.log_time),
        "seq": pa.array(placed.seq),
        "pub": pa.array(batch.publish_time, mask=np.full(count, not has_publish_time)),
        "stamp": pa.nulls(count, pa.int64()) if stamps is None else stamps.view(pa.int64()),
        "channel": pa.array(batch.channel % EXPIRED_IDS),
        "state": states,
        "error": error,
        "ref": pa.StructArray.from_arrays([*ref.values()], names=[*ref]),
    }
    unreadable = count - error.null_count
    return Piece({*distinct(placed.segment).tolist()}, own, found, unreadable, surplus=surplus)


def columns_from(decoded: Decoded, shape: FieldShape) -> Any:
    """The fields of decoded messages as columns; of those without payload, what is left."""
    if isinstance(decoded.records, LeftFields):
        return decoded.records.columns
    return shape.columns(decoded.arrow())


def as_table(own: Mapping[str, Any], fields: Any) -> Any:
    """Columns of rows as a table; `fields` is a struct array, or None."""
    schema = [pa.field(name, column.type) for name, column in own.items()]
    arrays = [*own.values()]
    if fields is not None:
        schema += list(fields.type)
        arrays += fields.flatten()
    return pa.Table.from_arrays(arrays, schema=pa.schema(schema))
