"""Rows of tables: messages by columns, and what is left of those without payload.

A recorder under pressure stores the row of a message in place of its payload, as an Arrow
stream. It has the columns of fields, `error`, and of `ref` size, SHA-256 and surplus. A file of
rows has those of messages whose payloads are gone.
"""

# Where stubs for pyarrow are installed, they are incomplete for its buffers.
# mypy: disable-error-code="no-any-return, arg-type, call-overload, return-value, assignment"

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import suppress
from hashlib import sha256
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from bson.int64 import Int64
from msgspec.structs import replace

from hybridlog.columns.column_file import ColumnFile, ColumnFileWriter
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
from hybridlog.columns.layout import OWN_COLUMNS, Section
from hybridlog.schema.arrow_types import (
    Array,
    bounds_of,
    converted,
    is_array,
    is_list,
    is_summary,
    objects_array,
    plain_values,
    statistic,
    structs,
)
from hybridlog.schema.codec import (
    Codec,
    Decoded,
    no_messages,
    payload_alone,
    stamp_array,
    unreadable,
)
from hybridlog.schema.column import Records, names_of, offsets
from hybridlog.schema.document import MAX_BYTES
from hybridlog.schema.objects import Objects, plain_cells
from hybridlog.schema.states import State, state_of
from hybridlog_storage.cache import Cache
from hybridlog_storage.errors import StoreError
from hybridlog_storage.manifest import File, Part, rows_line
from hybridlog_storage.messages import EXPIRED_IDS, Batch, Buffer, Channel, Left
from hybridlog_storage.segments.segment_file import rows_name

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

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


# Files of rows: what is left of the messages of a log that is gone.
#
# Such a file has the columns of a table, in the order of the chunks. Its `ref` also has the
# sender's sequence number, size and SHA-256 of the payload, and whether bytes were left over behind
# the message. Unlike a table it is never made again.

_GROUP_BYTES: Final = 4 << 20  # of a row group in memory
_LEVEL: Final = 3  # of zstd: 9 takes 1 to 5 % less, for much more time
_MAX_OPEN = 8  # files of different columns: each row group of them waits in memory


class RowsFile(ColumnFile):
    """One file of rows: messages of a topic. Thread safe."""

    def __init__(self, folder: Path, listed: File, cache: Cache | None = None) -> None:
        self._listed = listed
        try:
            super().__init__(folder / listed.name, cache)
        except FileNotFoundError as error:
            raise StoreError(f"The file of rows {folder / listed.name} is missing.") from error
        rows = sum(part.messages for part in listed.parts.values())
        if (self.size_bytes, self.rows) != (listed.bytes, rows):
            raise self._other()

    def check(self) -> str:
        """As of `ColumnFile`; it is the file that the manifest lists."""
        digest = super().check()
        if digest != self._listed.digest:
            raise self._other()
        return digest

    def _other(self) -> StoreError:
        return StoreError(f"The file of rows {self.path} is not the one that the manifest lists.")

    def of_chunk(self, chunk: int) -> list[pa.StructArray]:
        """The rows of a chunk, by row group; a struct has all columns."""
        found = []
        (leaf,) = self.numbers("ref.chunk")
        for group in range(len(self.groups)):
            first, last = self.bounds(group, leaf) or (chunk, chunk)
            if first <= chunk <= last:
                rows = self._group(group)
                numbers = rows.field("ref").field("chunk").to_numpy()
                begin, end = np.searchsorted(numbers, [chunk, chunk + 1]).tolist()
                found.append(rows.slice(begin, end - begin))
        return [one for one in found if len(one)]

    def _group(self, group: int) -> pa.StructArray:
        def read() -> pa.StructArray:
            return self.read(group, range(len(self.leaves))).to_struct_array().combine_chunks()

        size_of = attrgetter("nbytes")
        return self._cache.made("column", self.number, group, make=read, size_of=size_of)


def line_of(folder: Path, log: File, name: str) -> File:
    """The line of a manifest for a file of rows of a log."""
    file = ColumnFile(folder / name)
    rows = file.table(file.numbers("t", "channel", "ref.len"))
    rows = rows.append_column("size", pc.struct_field(rows["ref"], "len"))
    about = [("t", "count"), ("size", "sum"), ("t", "min"), ("t", "max")]
    found = rows.drop_columns(["ref"]).group_by("channel").aggregate(about).sort_by("channel")
    keys = [f"{column}_{what}" for column, what in about]
    parts = {row["channel"]: Part(*(row[key] for key in keys)) for row in found.to_pylist()}
    return rows_line(log, name, file.size_bytes, file.digest(), parts)


class RowsWriter:
    """Writes what is left of the messages of a log.

    Nobody else writes such files in `folder`, which is named by the id of the recording. `front`
    begins the first file (see `gone_log`), whose name has the number `version`; others follow.
    """

    def __init__(self, folder: Path, log: File, front: bytes, version: int = 0) -> None:
        self._folder = folder
        self._log = log
        self._front = front
        self._version = version
        self._open: dict[tuple[str, pa.Schema], tuple[ColumnFileWriter, list[pa.Table]]] = {}
        self.names: list[str] = []
        """Names of the files, the first one first."""

    def add(self, channel: Channel, placed: Placed, decoded: Decoded | None) -> None:
        """Add messages of a chunk, on channels that are alike."""
        table = _table(channel, placed, decoded)
        writer, tables = self._waiting(channel.topic, table.schema)
        tables.append(table)
        if sum(one.nbytes for one in tables) >= _GROUP_BYTES:
            _flush(writer, tables)

    def close(self) -> tuple[File, ...]:
        """Finish all files, force them to the disk, and return their lines of the manifest."""
        while self._open:
            self._finish(next(iter(self._open)))
        return tuple(line_of(self._folder, self._log, name) for name in self.names)

    def discard(self) -> None:
        """Remove the files that are not finished."""
        for writer, _ in self._open.values():
            writer.discard()

    def _waiting(self, topic: str, schema: pa.Schema) -> tuple[ColumnFileWriter, list[pa.Table]]:
        """The file of a topic with these columns, and rows that wait for a row group of it."""
        key = topic, schema
        if key not in self._open:
            if len(self._open) >= _MAX_OPEN:
                self._finish(next(iter(self._open)))
            name = rows_name(self._log.number, self._version + len(self.names))
            front = b"" if self.names else self._front
            self.names.append(name)
            writer = ColumnFileWriter(self._folder / name, schema, level=_LEVEL, front=front)
            self._open[key] = writer, []
        return self._open[key]

    def _finish(self, key: tuple[str, pa.Schema]) -> None:
        writer, tables = self._open.pop(key)
        if tables:
            _flush(writer, tables)
        digests = {str(self._log.number): self._log.digest}
        writer.close([Section(self._folder.name, key[0], digests, writer.rows)], sync=True)


def _flush(writer: ColumnFileWriter, tables: list[pa.Table]) -> None:
    writer.write(pa.concat_tables(tables).combine_chunks())
    tables.clear()


def _table(channel: Channel, placed: Placed, decoded: Decoded | None) -> pa.Table:
    """Rows of messages of one type in a chunk."""
    state, batch = State.EXPIRED, placed.batch
    if state_of(channel.message_encoding) is State.REDUCED:
        state, batch = State.REDUCED, with_rows(batch)
    own, fields = rows_of(
        placed,
        decoded,
        state,
        has_publish_time=True,  # channels that have none repeat log times
        columns=columns_from,
    )
    surplus = np.zeros(len(batch), np.bool_)
    if decoded is not None:
        surplus[decoded.surplus] = True
    if (left := batch.left) is None:
        about = [(len(p), sha256(p).digest()) for p in map(batch.payload, range(len(batch)))]
    else:
        about = [digest_in(left, row) for row in range(len(batch))]
    more = {
        "sequence": pa.array(batch.sequence),
        "size": pa.array([size for size, _ in about], pa.uint64()),
        "sha256": pa.array([digest for _, digest in about], pa.binary()),
        "surplus": pa.array(surplus),
    }
    ref = dict(zip(own["ref"].type.names, own["ref"].flatten(), strict=True))
    own["ref"] = structs(ref | more, len(batch))
    return pa.Table.from_struct_array(side_by_side(own, fields))
