"""Rows of tables: messages by columns, and what is left of those without payload.

A recorder under pressure stores the row of a message in place of its payload, as an Arrow
stream. It has the columns of fields, `error`, and of `ref` size, SHA-256 and surplus. A file of
rows has those of messages whose payloads are gone.
"""

# Where stubs for pyarrow are installed, they are incomplete for its buffers.
# mypy: disable-error-code="no-any-return, arg-type, call-overload, return-value, assignment"

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import suppress
from hashlib import sha256
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from bson.int64 import Int64
from msgspec.structs import replace

from hybridlog.columns.fields import (
    as_columns,
    content_of,
    has_summaries,
    joined,
    original_name,
    records_of,
    side_by_side,
    without,
)
from hybridlog.columns.layout import OWN_COLUMNS
from hybridlog.schema.arrow_columns import objects_array, structs
from hybridlog.schema.arrow_types import (
    Array,
    bounds_of,
    converted,
    is_array,
    is_list,
    is_summary,
    plain_values,
    statistic,
)
from hybridlog.schema.codec import (
    Decoded,
    no_messages,
    payload_alone,
    stamp_array,
    unreadable,
)
from hybridlog.schema.column import Records, names_of, offsets
from hybridlog.schema.document import MAX_BYTES
from hybridlog.schema.objects import Objects, plain_cells
from hybridlog.schema.states import State
from hybridlog_storage.messages import EXPIRED_IDS, Batch, Left

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from hybridlog.schema.codec import Codec
    from hybridlog_storage.messages import Buffer
    from hybridlog_storage.segments.chunk import Placed


def rows_of(
    placed: Placed,
    decoded: Decoded | None,
    state: State,
    *,
    has_publish_time: bool,
    columns: Callable[[Decoded], Any],
) -> tuple[dict[str, Any], Any]:
    """Rows of decoded messages of one topic and state, which readable ones have.

    `columns` turns fields into columns. Without a definition nothing is decoded. First come the
    columns that every table has, by name; then the others, a struct array that is null where a
    message is unreadable.
    """
    batch = placed.batch
    count = len(batch)
    errors: list[str | None] = [None] * count
    fields = pa.nulls(count, pa.struct([]))
    if decoded is not None:
        for bad in decoded.unreadable:
            for row in bad.rows.tolist():
                errors[row] = bad.reason
        if len(decoded.rows):
            fields = without(columns(decoded), decoded.rows, count)
    stamps = stamp_array(fields)
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
        "ref": structs(ref, count),
    }
    return own, fields


def columns_from(decoded: Decoded, *, arrays: bool = False) -> Any:
    """The fields of decoded messages as columns; of those without payload, what is left."""
    if isinstance(decoded.records, LeftFields):
        return decoded.records.columns
    return as_columns(decoded.arrow(), arrays=arrays)


# Messages without payload: their fields, from a file of rows or a reduced message.


class LeftFields(Objects):
    """Fields of messages whose payloads are gone.

    Args:
        columns: Columns of tables, one row for each message.
        fields: Dotted paths of those wanted in `arrow`, each with all below it; None for all.
        empty: No messages, as the codec of the payloads decodes them.
    """

    def __init__(
        self, columns: pa.StructArray, fields: Collection[str] | None, empty: Decoded
    ) -> None:
        super().__init__([], fields)
        self.columns = columns
        """The messages as columns of tables."""
        self._empty = empty

    def __len__(self) -> int:
        """Number of messages."""
        return len(self.columns)

    @property
    def is_typed(self) -> bool:
        """True if a definition fixes the types of the fields."""
        return isinstance(self._empty.records, Records)

    def take(self, rows: NDArray[np.bool_]) -> LeftFields:
        """Select messages."""
        return LeftFields(self.columns.filter(rows), self.fields, self._empty)

    def plain(self) -> list[dict[str, object]]:
        """The messages as plain values, long arrays and bytes as summaries."""
        return _documents(self.columns, typed=self.is_typed)

    def arrow(self) -> pa.StructArray:
        """The messages as an Arrow array; arrays of which only a summary is left are null."""
        if not self.is_typed:
            found = _documents(self.columns, typed=False, summaries=False)
            return objects_array(found, self.wanted())
        return converted(records_of(self.columns), self._empty.arrow().type, drops=True)

    def statistics(self, paths: Iterable[str]) -> dict[str, pa.Array[Any]]:
        """`n`, `min`, `max` or `mean` of arrays by path (`ranges.min`), of those that have one."""
        made: dict[str, pa.Array[Any]] = {}
        for path in paths:
            *array, what = names_of(path)
            with suppress(pa.ArrowException):  # of such elements there are no numbers
                found = pc.struct_field(records_of(self.columns, (*array,).__eq__), array)
                is_whole = is_array(found.type)  # of a fixed length
                part = statistic(found, what) if is_whole else pc.struct_field(found, what)
                made |= {} if part is None else {path: part}
        return made

    def both(self) -> tuple[Array, Array]:
        """The messages without the arrays that are gone, and with summaries of all arrays."""
        return records_of(self.columns), records_of(self.columns, lambda _: True)

    def lacks(self, fields: Iterable[str] | None, but: Collection[str] = ()) -> NDArray[np.bool_]:
        """bool[n], True where of an array only the summary is left.

        It is an array of some fields, None for all, and none of `but`.
        """
        asked = [()] if fields is None else [names_of(path) for path in fields]
        found = np.zeros(len(self), np.bool_)
        for array, is_gone in _gone_in(self.columns):
            is_asked = any(path[: len(array)] == array[: len(path)] for path in asked)
            if is_asked and ".".join(array) not in but:
                found |= is_gone
        return found


def without_lacking(decoded: Decoded, but: Collection[str] = ()) -> tuple[Decoded, int]:
    """Decoded messages but for those that lack a wanted value, and how many these are."""
    records = decoded.records
    if not isinstance(records, LeftFields):
        return decoded, 0
    there = ~records.lacks(records.fields, but)
    left = Decoded(decoded.rows[there], records.take(there), decoded.unreadable, decoded.surplus)
    return left, int((~there).sum())


def decoded_left(
    batch: Batch, original: Codec, fields: Collection[str] | None, *, reduced: bool
) -> Decoded:
    """What is left of messages whose payloads a codec decodes; as of `Codec.columns_of`."""
    if reduced and original.indexed:
        batch = with_rows(batch)
    empty = original.columns_of(no_messages(), fields)
    found = [] if batch.left is None else [*batch.left.by_part()]
    if not found:
        return empty
    order = np.argsort(np.concatenate([own for _, own, _ in found]))
    rows = joined([part.take(taken) for part, _, taken in found]).take(order)
    reasons, surplus = rows.field("error"), rows.field("ref").field("surplus")
    bad: dict[str, list[int]] = {}
    for row, reason in enumerate(reasons.to_pylist()):
        if reason is not None:
            bad.setdefault(reason, []).append(row)
    there = reasons.is_null()
    records = LeftFields(_fields_in(rows.filter(there)), fields, empty)
    good, more = (np.flatnonzero(one.to_numpy(zero_copy_only=False)) for one in (there, surplus))
    return Decoded(good, records, unreadable(bad), more)


def _fields_in(rows: pa.StructArray) -> pa.StructArray:
    """The columns of fields among all columns of rows."""
    fields = [field for field in rows.type if field.name not in OWN_COLUMNS]
    return structs({one.name: rows.field(one.name) for one in fields}, len(rows), None, fields)


def digest_in(left: Left, message: int) -> tuple[int, bytes]:
    """Bytes and SHA-256 of the payload that a message had."""
    row = left.parts[left.part[message]].field("ref")[int(left.row[message])].as_py()
    return row["size"], row["sha256"]


def messages_left(parts: Sequence[pa.StructArray]) -> tuple[Batch, NDArray[np.int64]]:
    """The rows that remain of a chunk, and their arrival numbers, in the order of arrival."""

    def numbers(name: str, kind: Any, *, of_ref: bool = False) -> NDArray[Any]:
        from_parts = [part.field("ref") if of_ref else part for part in parts]
        found = [one.field(name).to_numpy(zero_copy_only=False) for one in from_parts]
        return np.concatenate(found).astype(kind)[order]

    sizes = [len(part) for part in parts]
    order = np.arange(sum(sizes))
    order = np.argsort(numbers("off", np.int64, of_ref=True), kind="stable")
    part = np.repeat(np.arange(len(parts), dtype=np.int32), sizes)[order]
    row = np.concatenate([np.arange(size) for size in sizes])[order]
    none = np.zeros(len(order), np.int64)
    place = (numbers(name, np.int64, of_ref=True) for name in ("off", "len"))
    batch = Batch(
        b"",
        none,
        none,
        numbers("channel", np.int32),
        numbers("t", np.int64),
        numbers("pub", np.int64),
        numbers("sequence", np.uint32, of_ref=True),
        Left(parts, part, row, *place),
    )
    return batch, numbers("seq", np.int64)


def _gone_in(
    columns: Array, above: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], NDArray[np.bool_]]]:
    """Arrays of which a summary may be left, and in which rows."""
    if is_list(columns.type):
        for path, is_gone in _gone_in(columns.flatten(), above):
            before = offsets(is_gone)
            yield path, np.diff(before[bounds_of(columns)]) > 0
    fields = columns.flatten() if pa.types.is_struct(columns.type) else ()
    for field, column in zip(columns.type if fields else (), fields, strict=True):
        path = (*above, original_name(field))
        if has_summaries(field):
            yield path, column.is_valid().to_numpy(zero_copy_only=False)
        else:
            yield from _gone_in(column, path)


def _documents(columns: Array, *, typed: bool, summaries: bool = True) -> list[dict[str, Any]]:
    """Columns as index documents: arrays, or summaries of long ones, and without what is null.

    They are the fields of a struct array. With `typed`, a definition fixes the width of integers.
    Without `summaries`, there are no arrays of which only a summary is left.
    """

    def fields(array: Array) -> list[tuple[str, Array]]:
        pairs = zip(array.type, array.flatten(), strict=True)
        chosen = [pair for pair in pairs if summaries or not has_summaries(pair[0])]
        return [(original_name(field), content_of(field, column)) for field, column in chosen]

    def cells(array: Array) -> list[Any] | None:
        if not is_summary(array.type):
            return plain_cells(array, typed=typed)
        found = [(one or {}).items() for one in array.to_pylist()]
        made = [{k: Int64(v) if isinstance(v, int) else v for k, v in one} for one in found]
        return [one or None for one in made]

    return plain_values(columns, cells, fields)


def reduced(codec: Codec, payload: bytes) -> bytes:
    """What stays of a message under pressure: its row, as an Arrow stream."""
    fields, error, surplus = structs({}, 1), None, False
    if codec.indexed:
        decoded = codec.columns_of(payload_alone(payload))
        surplus = len(decoded.surplus) > 0
        if decoded.unreadable:
            error = decoded.unreadable[0].reason
        else:
            fields = as_columns(decoded.arrow())
    if fields.nbytes > MAX_BYTES:
        fields, error = structs({}, 1), f"its fields take more than {MAX_BYTES >> 20} MiB"
    row = _row(fields, error, len(payload), sha256(payload).digest(), surplus=surplus)
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, pa.schema([*row.type])) as stream:
        stream.write_batch(pa.RecordBatch.from_struct_array(row))
    return sink.getvalue().to_pybytes()


def _row_in(payload: Buffer) -> pa.StructArray:
    """The row in the payload of a reduced message; a struct has all columns."""
    problem: object = "its columns are others"
    try:
        row = pa.ipc.open_stream(bytes(payload)).read_next_batch().to_struct_array()
        row.validate(full=True)
        kinds = {field.name: field.type for field in row.type}
        if len(row) == 1 and all(kinds.get(field.name) == field.type for field in _EMPTY.type):
            return row
    except (pa.ArrowException, OSError, StopIteration) as error:
        problem = error
    return _row(structs({}, 1), f"the payload is not a reduced message: {problem}", 0, b"")


def with_rows(batch: Batch) -> Batch:
    """Reduced messages of a topic with their rows."""
    if not len(batch) or (batch.left is not None and batch.left.part[0] >= 0):
        return batch
    rows = joined([_row_in(batch.payload(at)) for at in range(len(batch))])
    part, row = np.zeros(len(batch), np.int32), np.arange(len(batch))
    return replace(batch, left=Left([rows], part, row, *batch.places))


def _row(
    fields: pa.StructArray, error: str | None, size: int, digest: bytes, *, surplus: bool = False
) -> pa.StructArray:
    about = {
        "size": pa.array([size], pa.uint64()),
        "sha256": pa.array([digest], pa.binary()),
        "surplus": pa.array([surplus]),
    }
    return side_by_side({"error": pa.array([error], pa.string()), "ref": structs(about, 1)}, fields)


_EMPTY: Final = _row(structs({}, 1), None, 0, b"")
