"""What is left of messages without payload: rows of a file, or of a reduced message.

A recorder under pressure stores the row of a message in place of its payload, as an Arrow
stream. It has the columns of fields, `error`, and of `ref` size, SHA-256 and surplus.
"""

# Where stubs for pyarrow are installed, they are incomplete for its buffers.
# mypy: disable-error-code="no-any-return, arg-type, call-overload, return-value, assignment"

from __future__ import annotations

from functools import partial
from hashlib import sha256
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa
from bson.int64 import Int64
from msgspec.structs import replace

from hybridlog.columns.fields import (
    SUMMARY_FIELDS,
    FieldShape,
    has_summaries,
    joined,
    names_of,
    original_name,
    records_of,
)
from hybridlog.columns.layout import OWN_COLUMNS
from hybridlog.schema.arrow_columns import structs
from hybridlog.schema.arrow_types import Array, is_summary, plain_values
from hybridlog.schema.codec import payload_alone
from hybridlog.schema.index_bodies import MAX_BYTES
from hybridlog.schema.objects import plain_cells
from hybridlog_storage.messages import Batch, Left

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence

    from numpy.typing import NDArray

    from hybridlog.schema.codec import Codec
    from hybridlog_storage.messages import Buffer

_OWN: Final = frozenset(OWN_COLUMNS)


def fields_in(rows: pa.StructArray) -> pa.StructArray:
    """The columns of fields among all columns of rows."""
    fields = [field for field in rows.type if field.name not in _OWN]
    return structs({one.name: rows.field(one.name) for one in fields}, len(rows), None, fields)


def digest_in(left: Left, message: int) -> tuple[int, bytes]:
    """Bytes and SHA-256 of the payload that a message had."""
    row = left.parts[left.part[message]].field("ref")[int(left.row[message])].as_py()
    return row["size"], row["sha256"]


def lacking(
    columns: pa.StructArray, fields: Collection[str] | None, but: Collection[str]
) -> NDArray[np.bool_]:
    """bool[n], True where a wanted array is not there."""
    wanted = None if fields is None else [names_of(path) for path in fields]
    found = np.zeros(len(columns), np.bool_)
    for path, summary in _summaries_in(columns):
        if ".".join(path) not in but and (wanted is None or _asks(wanted, path)):
            found |= summary.is_valid().to_numpy(zero_copy_only=False)
    return found


def _asks(wanted: Sequence[tuple[str, ...]], array: tuple[str, ...]) -> bool:
    """True if an array itself is among some fields, and not only its summary."""
    return any(
        path[: len(array)] == array[: len(path)]
        and not (len(path) == len(array) + 1 and path[-1] in SUMMARY_FIELDS)
        for path in wanted
    )


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


def _summaries_in(
    columns: Array, above: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], Array]]:
    """Columns of summaries, but for those inside lists, and the paths of their arrays."""
    for field, column in zip(columns.type, columns.flatten(), strict=True):
        path = (*above, original_name(field))
        if has_summaries(field):
            yield path, column
        elif pa.types.is_struct(field.type):
            yield from _summaries_in(column, path)


def documents(columns: Array, *, typed: bool, summaries: bool = True) -> list[dict[str, Any]]:
    """Columns as index documents: arrays, or summaries of long ones, and without what is null.

    They are the fields of a struct array. With `typed`, a definition fixes the width of integers.
    Without `summaries`, there are no arrays of which only a summary is left.
    """
    cells = partial(plain_cells, typed=typed)
    found = plain_values(records_of(columns), cells)
    if not summaries:
        return found
    also = plain_values(records_of(columns, lambda _: True), lambda a: _summaries(a) or cells(a))
    return [_merged(*both) for both in zip(found, also, strict=True)]


def _summaries(array: Array) -> list[Any] | None:
    """Summaries with integers of 64 bits; None of other values."""
    if not is_summary(array.type):
        return None
    found = [(one or {}).items() for one in array.to_pylist()]
    made = [{k: Int64(v) if isinstance(v, int) else v for k, v in one} for one in found]
    return [one or None for one in made]


def _merged(one: Any, other: Any) -> Any:
    """Values with what the other ones have besides, in their order."""
    if isinstance(one, dict) and isinstance(other, dict):
        return {name: _merged(one.get(name, value), value) for name, value in other.items()}
    if isinstance(one, list) and isinstance(other, list):
        return [_merged(*both) for both in zip(one, other, strict=True)]
    return one


def reduced(codec: Codec, payload: bytes) -> bytes:
    """What stays of a message under pressure: its row, as an Arrow stream."""
    fields, error, surplus = structs({}, 1), None, False
    if codec.indexed:
        decoded = codec.columns_of(payload_alone(payload))
        surplus = len(decoded.surplus) > 0
        if decoded.unreadable:
            error = decoded.unreadable[0].reason
        else:
            fields = FieldShape().columns(decoded.arrow())
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
    own = {"error": pa.array([error], pa.string()), "ref": structs(about, 1)}
    columns = dict(zip([field.name for field in fields.type], fields.flatten(), strict=True))
    kinds = [pa.field(name, array.type) for name, array in own.items()]
    return structs(own | columns, 1, None, [*kinds, *fields.type])


_EMPTY: Final = _row(structs({}, 1), None, 0, b"")
