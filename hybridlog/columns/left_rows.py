"""What is left of messages without payload: rows of a file, or of a reduced message.

A recorder under pressure stores the row of a message in place of its payload, as an Arrow
stream. It has the columns of fields, `error`, and of `ref` size, SHA-256 and surplus.
"""

# Where stubs for pyarrow are installed, they are incomplete for its buffers.
# mypy: disable-error-code="no-any-return, arg-type, call-overload, return-value, assignment"

from __future__ import annotations

from dataclasses import replace
from hashlib import sha256
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from bson.int64 import Int64

from hybridlog.columns.fields import (
    SUMMARY_FIELDS,
    FieldShape,
    has_summaries,
    names_of,
    original_name,
)
from hybridlog.columns.layout import EMPTY, OWN_COLUMNS
from hybridlog.schema.arrow_columns import structs
from hybridlog.schema.arrow_types import (
    Array,
    is_bytes,
    is_list,
    is_time,
    lengths_of,
    plain_values,
)
from hybridlog.schema.index_bodies import MAX_BYTES
from hybridlog_storage.messages import Batch, Left

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence

    from numpy.typing import NDArray

    from hybridlog.schema.codec import Codec
    from hybridlog_storage.messages import Buffer

_OWN: Final = frozenset(OWN_COLUMNS)
_LONG: Final = (pa.int64(), pa.uint32(), pa.uint64())


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
    """The rows that remain of a chunk, and their arrival numbers, in the order of arrival.

    Args:
        parts: Rows of each file; a struct has all columns.
    """

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

    Args:
        columns: A struct array; its fields are the columns.
        typed: True if a definition fixes the width of integers.
        summaries: False to leave out arrays of which only a summary is left.
    """
    kept = [
        (original_name(field), _cells(column, field, typed=typed, summaries=summaries))
        for field, column in zip(columns.type, columns.flatten(), strict=True)
        if summaries or not has_summaries(field)
    ]
    rows = zip(*(cells for _, cells in kept), strict=True) if kept else [()] * len(columns)
    names = [name for name, _ in kept]
    return [{n: v for n, v in zip(names, row, strict=True) if v is not None} for row in rows]


def _cells(array: Array, field: Any, *, typed: bool, summaries: bool) -> list[Any]:
    kind, is_empty = array.type, EMPTY in (field.metadata or {})
    if has_summaries(field):
        found = array.to_pylist()
        return [None if one is None else {k: _whole(v) for k, v in one.items()} for one in found]
    if pa.types.is_struct(kind):
        made = documents(array, typed=typed, summaries=summaries)
        return [d if v else None for d, v in zip(made, array.is_valid().to_pylist(), strict=True)]
    if is_list(kind):
        inner = field if is_empty else kind.value_field
        lengths = lengths_of(array)
        items = array.flatten() if pa.types.is_fixed_size_list(kind) else _items(array, lengths)
        values = iter(_cells(items, inner, typed=typed, summaries=summaries))
        counted = zip(lengths.tolist(), array.is_valid().to_pylist(), strict=True)
        return [[next(values) for _ in range(n)] if there else None for n, there in counted]
    if is_bytes(kind):
        sizes = pc.binary_length(array).to_pylist()
        own = [None if n is None else {"n": Int64(n)} for n in sizes]
        return own if summaries else array.to_pylist()
    values = plain_values(array)
    if is_empty:
        return [None if there is None else {} for there in values]
    return [*map(_whole, values)] if is_time(kind) or (typed and kind in _LONG) else values


def _items(array: Array, lengths: NDArray[np.int64]) -> Array:
    """The elements of lists; pyarrow cannot flatten those of JSON text where one is null."""
    begin, total = array.offsets[0].as_py(), int(lengths.sum())
    is_dense = array.offsets[-1].as_py() - begin == total
    return array.values.slice(begin, total) if is_dense else array.flatten()


def _whole(value: Any) -> Any:
    """An integer as int64 of BSON, whatever its value."""
    return Int64(value) if isinstance(value, int) else value


def reduced(codec: Codec, payload: bytes) -> bytes:
    """What stays of a message under pressure: its row, as an Arrow stream."""
    fields, error, surplus = structs({}, 1), None, False
    if codec.indexed:
        start = np.zeros(1, np.int64)
        decoded = codec.columns(payload, start, start + len(payload))
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
    found: dict[bytes, tuple[int, list[pa.StructArray]]] = {}  # by their columns
    places = np.empty((2, len(batch)), np.int64)
    for at in range(len(batch)):
        row = _row_in(batch.payload(at))
        columns = pa.schema([*row.type]).serialize().to_pybytes()
        number, same = found.setdefault(columns, (len(found), []))
        places[:, at] = number, len(same)
        same.append(row)
    parts = [pa.concat_arrays(same) for _, same in found.values()]
    left = Left(parts, places[0].astype(np.int32), places[1], *batch.places)
    return replace(batch, left=left)


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
