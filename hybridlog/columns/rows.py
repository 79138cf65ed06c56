"""Rows of tables: messages by columns, and the columns that every table has."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from hybridlog.schema.states import State
from hybridlog_storage.messages import EXPIRED_IDS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog_storage.segments.chunk import StoredChunk

_STATES: Final = list(State)
_ROW: Final = 64  # bytes of a row in addition to its fields


class Messages(NamedTuple):
    """Messages by columns: location of their payloads in memory, and values for the table.

    Attributes:
        at: int64[n], start of each payload in its current buffer.
        length: int64[n], bytes of each payload.
        channel: int32[n], ids of channels.
        log_time: int64[n], ns.
        seq: int64[n], arrival numbers.
        publish_time: int64[n], ns.
        chunk: int32[n], number of the chunk in its segment.
        offset: int64[n], start of each payload in the chunk.
    """

    at: NDArray[np.int64]
    length: NDArray[np.int64]
    channel: NDArray[np.int32]
    log_time: NDArray[np.int64]
    seq: NDArray[np.int64]
    publish_time: NDArray[np.int64]
    chunk: NDArray[np.int32]
    offset: NDArray[np.int64]

    @classmethod
    def of(cls, chunk: StoredChunk) -> Messages:
        """Messages of a chunk, over its buffer."""
        batch = chunk.batch
        number = np.full(len(batch), chunk.number, np.int32)
        return cls(
            batch.offset,
            batch.places[1].copy(),
            batch.channel.copy(),
            batch.log_time.copy(),
            chunk.seq.copy(),
            batch.publish_time.copy(),
            number,
            batch.places[0].copy(),
        )

    @classmethod
    def joined(cls, parts: Sequence[Messages]) -> Messages:
        """Several batches, one after the other."""
        if len(parts) == 1:
            return parts[0]
        return cls(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def take(self, rows: NDArray[np.intp]) -> Messages:
        """The selected rows, in the order given."""
        return Messages._make(column[rows] for column in self)


@dataclass(slots=True)
class Piece:
    """Rows of a topic in one segment, in the order of the file.

    Attributes:
        segment: Number of the segment.
        messages: The messages.
        fields: Their columns, a struct each; None without columns.
        errors: Unreadable rows, each with the reason.
        state: State of all other rows.
        has_arrays: True if they have arrays in full.
    """

    segment: int
    messages: Messages
    fields: Any
    errors: list[tuple[NDArray[np.intp], str]] = field(default_factory=list)
    state: State = State.WHOLE
    has_arrays: bool = False

    @property
    def rows(self) -> int:
        """Number of messages."""
        return len(self.messages.seq)

    @property
    def size(self) -> int:
        """Bytes in memory."""
        return self.rows * _ROW + (0 if self.fields is None else int(self.fields.nbytes))


def own_columns(
    pieces: Sequence[Piece],
    messages: Messages,
    segment: NDArray[np.int32],
    fields: Any,
    has_publish_time: Mapping[int, bool],
) -> dict[str, Any]:
    """The columns that every table has, by name.

    Args:
        pieces: The rows; `state` of unreadable ones is set.
        messages: Messages of all pieces.
        segment: int32[n], segment of each message.
        fields: Fields of the messages, for header stamps; None without.
        has_publish_time: Whether messages of a channel have a publish time, by channel id.
    """
    import pyarrow as pa

    states = np.concatenate(
        [np.full(piece.rows, _STATES.index(piece.state), np.int8) for piece in pieces]
    )
    errors = _errors(pieces, states)
    ids = np.flatnonzero(np.bincount(messages.channel)).tolist()
    silent = [number for number in ids if not has_publish_time[number]]
    no_publish = np.isin(messages.channel, silent) if silent else None
    micros = messages.log_time // 1000
    return {
        "log_time": pa.array(micros).view(pa.timestamp("us", "UTC")),
        "t": pa.array(messages.log_time),
        "seq": pa.array(messages.seq),
        "pub": pa.array(messages.publish_time, mask=no_publish),
        "stamp": _stamps(fields, len(segment)),
        "channel": pa.array(messages.channel % EXPIRED_IDS),
        "state": pa.array(_STATES, pa.string()).take(pa.array(states)),
        "error": errors,
        "ref": pa.StructArray.from_arrays(
            [
                pa.array(segment),
                pa.array(messages.chunk),
                pa.array(messages.offset),
                pa.array(messages.length.astype(np.int32)),
            ],
            names=["seg", "chunk", "off", "len"],
        ),
    }


def as_table(own: Mapping[str, Any], fields: Any) -> Any:
    """Columns of rows as a table; `fields` is a struct array, or None."""
    import pyarrow as pa

    schema = [pa.field(name, column.type) for name, column in own.items()]
    arrays = [*own.values()]
    if fields is not None:
        schema += list(fields.type)
        arrays += fields.flatten()
    return pa.Table.from_arrays(arrays, schema=pa.schema(schema))


def _errors(pieces: Sequence[Piece], states: NDArray[np.int8]) -> Any:
    """Reasons why messages are unreadable; sets their states."""
    import pyarrow as pa

    if not any(piece.errors for piece in pieces):
        return pa.nulls(len(states), pa.string())
    found: list[str | None] = [None] * len(states)
    before = 0
    for piece in pieces:
        for rows, reason in piece.errors:
            for row in rows.tolist():
                found[before + row] = reason
                states[before + row] = _STATES.index(State.UNREADABLE)
        before += piece.rows
    return pa.array(found, pa.string())


def _stamps(fields: Any, rows: int) -> Any:
    """Header stamps, ns."""
    import pyarrow as pa

    if fields is not None and fields.type.get_field_index("header") >= 0:
        header = fields.field("header")
        if pa.types.is_struct(header.type) and header.type.get_field_index("stamp") >= 0:
            (stamp,) = [
                part
                for part, inner in zip(header.flatten(), header.type, strict=True)
                if inner.name == "stamp"
            ]
            if pa.types.is_timestamp(stamp.type):
                return stamp.view(pa.int64())
    return pa.nulls(rows, pa.int64())
