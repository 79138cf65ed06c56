"""Messages of one type as rows of a table of payloads, and back to bytes.

A row has the fields of its message, the arrays in full, and a recipe: the rest of the
message without the arrays (`transposer.py`). Points of clouds stand in a column for each of
their fields.
"""

# Where stubs for pyarrow are installed, they are incomplete for its buffers.
# mypy: disable-error-code="no-any-return, arg-type, call-overload, return-value, assignment"

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from hybridlog.payloads.clouds import CLOUD_TYPES, DATA, PointLayout, layout_of
from hybridlog.payloads.layout import PAYLOAD_RESERVED, POINTS, RECIPE
from hybridlog.payloads.transposer import (
    Locator,
    NumberArray,
    Split,
    big_endian_rows,
    field_at,
    join,
    number_arrays,
    split,
)
from hybridlog.schema.arrow_columns import array_of, lists, numbers, structs
from hybridlog.schema.column import Arrays, Column, Records, Scalars, offsets
from hybridlog.schema.definition import parse_definition
from hybridlog.schema.wire import WireReader
from hybridlog.tables.fields import FieldShape, original_name
from hybridlog_storage.errors import DefinitionError
from hybridlog_storage.mcap_content import MESSAGE_HEAD

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from hybridlog_storage.chunk import StoredChunk
    from hybridlog_storage.messages import Batch, Channel

_TIME = pa.timestamp("us", "UTC")
_OWN_BYTES = 80  # about what the columns of a message take besides its payload


@dataclass(slots=True)
class Piece:
    """The messages of a topic in one chunk as rows.

    Attributes:
        table: The rows, in the order of the chunk.
        layout: Layout of the points of clouds; None where points are not unpacked.
        size: About the bytes of the rows.
    """

    table: pa.Table
    layout: PointLayout | None
    size: int


@dataclass(frozen=True, slots=True)
class ArrayColumn:
    """A column that holds an array of the messages.

    Attributes:
        path: Dotted path of the field.
        column: Dotted path of the column.
        dtype: Type of the elements, as numpy spells it.
    """

    path: str
    column: str
    dtype: str

    def to_json(self) -> list[str]:
        """As values for JSON."""
        return [self.path, self.column, self.dtype]

    @classmethod
    def from_json(cls, value: Sequence[Any]) -> ArrayColumn:
        """The opposite of `to_json`.

        Raises:
            ValueError, TypeError: The value is invalid.
        """
        path, column, dtype = map(str, value)
        if np.dtype(dtype).kind not in "iuf":
            raise ValueError("an array has no numbers")
        return cls(path, column, dtype)


class TopicColumns:
    """Turns messages of one type into rows.

    Args:
        channel: A channel of the type.

    Raises:
        DefinitionError: The type has no arrays of numbers, or cannot be read.
    """

    def __init__(self, channel: Channel) -> None:
        if channel.message_encoding not in {"ros1", "cdr"} or channel.schema is None:
            raise DefinitionError("only ROS messages with a definition have columns")
        self._wire: Any = channel.message_encoding
        message_type = parse_definition(channel.schema)
        self.arrays: list[NumberArray] = number_arrays(message_type)
        if not self.arrays:
            raise DefinitionError(f"{channel.schema.name} has no array of numbers")
        self._locator = Locator(message_type, self._wire, self.arrays)
        self._reader = WireReader(message_type, self._wire)
        self._is_cloud = channel.schema.name in CLOUD_TYPES
        self._shape = FieldShape(None, PAYLOAD_RESERVED)
        self.columns: list[ArrayColumn] = []
        """The arrays with their columns; known once there are rows."""

    def share_of_sequences(self, batch: Batch) -> float:
        """Share of sequences of numbers in the bytes of some messages.

        Fixed arrays, such as covariances, do not count. 0 if a message does not fit its
        definition.
        """
        spans = self._locator.spans(batch.buffer, batch.offset, batch.length)
        if spans is None:
            return 0.0
        is_sequence = [array.width is None for array in self.arrays]
        return float(spans.size[:, is_sequence].sum() / max(batch.payload_bytes, 1))

    def piece(
        self, chunk: StoredChunk, rows: NDArray[np.intp], *, has_publish_time: NDArray[np.bool_]
    ) -> Piece | None:
        """Rows of messages; None if one does not fit its definition.

        Args:
            chunk: The chunk that holds them.
            rows: Their rows in it, ascending; one at least.
            has_publish_time: bool[n], True for messages whose channel has publish times.
        """
        batch = chunk.batch.take(rows)
        spans = self._locator.spans(batch.buffer, batch.offset, batch.length)
        decoded = self._reader.read(batch.buffer, batch.offset, batch.length)
        if spans is None or decoded.unreadable:
            return None
        records = decoded.records
        layout = layout_of(records) if self._is_cloud else None
        parts = split(batch.buffer, batch.offset, batch.length, spans)
        fields = self._fields(records, layout)
        own = _own_columns(chunk, rows, batch, has_publish_time)
        padding = None
        if layout is not None:
            data = field_at(records, DATA)
            assert isinstance(data, Arrays)
            assert isinstance(data.values, Scalars)
            padding = _padding(layout, data.values.values, data.offset)
        columns = {**own, **fields, RECIPE: _recipe(parts, padding)}
        schema = pa.schema(
            [
                *(pa.field(name, column.type) for name, column in own.items()),
                *self._schema_of(fields),
                pa.field(RECIPE, columns[RECIPE].type),
            ]
        )
        schema = pa.schema([field.with_type(_required(field.type)) for field in schema])
        arrays = [
            column.cast(kind) for column, kind in zip(columns.values(), schema.types, strict=True)
        ]
        table = pa.Table.from_arrays(arrays, schema=schema)
        return Piece(table, layout, batch.payload_bytes + _OWN_BYTES * len(rows))

    def _fields(self, records: Records, layout: PointLayout | None) -> dict[str, pa.Array[Any]]:
        """Columns of the fields, by their names; notes where the arrays are."""
        struct = self._struct(records, "", layout)
        shaped = self._shape.columns(struct)
        self._kind = shaped.type
        found = {
            shaped.type.field(number).name: shaped.field(number)
            for number in range(shaped.type.num_fields)
        }
        self.columns = [
            ArrayColumn(array.path, _column_path(shaped.type, array.path), array.dtype.str[1:])
            for array in self.arrays
            if layout is None or array.path != DATA
        ]
        if layout is not None:
            data = field_at(records, DATA)
            assert isinstance(data, Arrays)
            assert isinstance(data.values, Scalars)
            found[POINTS] = _points(layout, data.values.values, data.offset)
        return found

    def _schema_of(self, fields: Mapping[str, pa.Array[Any]]) -> Iterator[pa.Field[Any]]:
        own = {self._kind.field(n).name: self._kind.field(n) for n in range(self._kind.num_fields)}
        for name, column in fields.items():
            yield own[name] if name in own else pa.field(name, column.type)

    def _struct(self, records: Records, prefix: str, layout: PointLayout | None) -> pa.StructArray:
        cut = {array.path for array in self.arrays}
        arrays: dict[str, pa.Array[Any]] = {}
        for name, column in records.fields.items():
            path = f"{prefix}{name}"
            if layout is not None and path == DATA:
                continue
            if isinstance(column, Records):
                arrays[name] = self._struct(column, f"{path}.", layout)
            elif path in cut and _is_bytes(column):
                assert isinstance(column, Arrays)
                assert isinstance(column.values, Scalars)
                arrays[name] = _binary(column.values.values, column.offset)
            else:
                arrays[name] = array_of(column)
        return structs(arrays, records.rows)


def _required(kind: Any) -> Any:
    """The same type with elements of arrays that are never null, which are read faster."""
    if pa.types.is_struct(kind):
        inner = [kind.field(number) for number in range(kind.num_fields)]
        return pa.struct([field.with_type(_required(field.type)) for field in inner])
    if pa.types.is_list(kind) and pa.types.is_primitive(kind.value_type):
        return pa.list_(pa.field("element", kind.value_type, nullable=False))
    return kind


def _column_path(kind: Any, path: str) -> str:
    """The dotted path of the column of a field."""
    names = []
    for name in path.split("."):
        inner = [kind.field(number) for number in range(kind.num_fields)]
        (found,) = [field for field in inner if original_name(field) == name]
        names.append(found.name)
        kind = found.type
    return ".".join(names)


def _is_bytes(column: Column) -> bool:
    if not isinstance(column, Arrays) or not isinstance(column.values, Scalars):
        return False
    return bool(column.values.values.dtype == np.uint8)


def _binary(data: NDArray[np.uint8], offset: NDArray[np.int64]) -> pa.Array[Any]:
    places = pa.py_buffer(offset.astype(np.int32))
    buffers = [None, places, pa.py_buffer(np.ascontiguousarray(data))]
    return pa.Array.from_buffers(pa.binary(), len(offset) - 1, buffers)


def _points(
    layout: PointLayout, data: NDArray[np.uint8], offset: NDArray[np.int64]
) -> pa.StructArray:
    points = offset // layout.step
    counts = {field.column: field.count for field in layout.fields}
    columns = {
        name: lists(numbers(values), points * counts[name])
        for name, values in layout.unpack(data).items()
    }
    return structs(columns, len(offset) - 1)


def _padding(
    layout: PointLayout, data: NDArray[np.uint8], offset: NDArray[np.int64]
) -> pa.Array[Any]:
    """The padding of each cloud; empty where it is zero."""
    found = [
        layout.padding(data[begin:end])
        for begin, end in zip(offset[:-1].tolist(), offset[1:].tolist(), strict=True)
    ]
    sizes = np.array([len(padding) for padding in found], np.int64)
    return _binary(np.concatenate(found), offsets(sizes))


def _recipe(parts: Split, padding: pa.Array[Any] | None) -> pa.StructArray:
    rows, arrays = parts.at.shape
    bounds = np.arange(rows + 1, dtype=np.int64) * arrays
    columns = {
        "rest": _binary(parts.rest, parts.rest_offset),
        "at": lists(numbers(parts.at.ravel().astype(np.uint32)), bounds),
    }
    if padding is not None:
        columns["padding"] = padding
    return structs(columns, rows)


def _own_columns(
    chunk: StoredChunk,
    rows: NDArray[np.intp],
    batch: Batch,
    has_publish_time: NDArray[np.bool_],
) -> dict[str, pa.Array[Any]]:
    count = len(rows)
    reference = {
        "seg": numbers(np.full(count, chunk.segment, np.int32)),
        "chunk": numbers(np.full(count, chunk.number, np.int64)),
        "off": numbers(batch.offset.astype(np.int64)),
        "len": numbers(batch.length.astype(np.int64)),
    }
    has_none = ~has_publish_time & (batch.publish_time == batch.log_time)
    return {
        "log_time": pa.array(batch.log_time // 1000).cast(_TIME),
        "t": pa.array(batch.log_time),
        "seq": pa.array(chunk.seq[rows]),
        "pub": pa.array(batch.publish_time, mask=has_none),
        "channel": pa.array(batch.channel.astype(np.int32)),
        "sequence": pa.array(batch.sequence),
        "ref": structs(reference, count),
    }


@dataclass(frozen=True, slots=True)
class Rebuilt:
    """Messages of a chunk as they were.

    Attributes:
        data: uint8, whole message records, one after the other.
        offset: int64[n + 1], bounds of each record.
        place: int64[n], where each record starts in the content of its chunk.
    """

    data: NDArray[np.uint8]
    offset: NDArray[np.int64]
    place: NDArray[np.int64]


class Rebuilder:
    """Makes message records from rows.

    Args:
        wire: Encoding of the messages, `ros1` or `cdr`.
        arrays: All arrays in the order of the wire; the points of clouds as their `data`.
        columns: Column of each array, by the path of its field.
        layout: Layout of the points of clouds, where they are unpacked.
    """

    def __init__(
        self,
        wire: str,
        columns: Sequence[ArrayColumn],
        order: Sequence[str],
        layout: PointLayout | None,
    ) -> None:
        self._wire: Any = wire
        self._columns = {column.path: column for column in columns}
        self._order = order
        self._layout = layout

    @property
    def needed(self) -> list[str]:
        """Dotted paths of the columns that it reads."""
        own = ["t", "pub", "channel", "sequence", "ref.off", "ref.len"]
        arrays = [column.column for column in self._columns.values()]
        points = [] if self._layout is None else [POINTS]
        return [*own, *arrays, *points, RECIPE]

    def records(self, table: pa.Table) -> Rebuilt:
        """The message records of some rows.

        Args:
            table: Has the columns `needed`.

        Raises:
            ValueError: The rows contradict each other.
        """
        payloads, bounds = join(self._parts(table))
        length = np.diff(bounds)
        if (length != _numbers(table, "ref.len")).any():
            raise ValueError("rebuilt messages have another length")
        log_time = _numbers(table, "t")
        pub = column_at(table, "pub")
        publish = pub.fill_null(0).to_numpy(zero_copy_only=False)
        is_missing = pub.is_null().to_numpy(zero_copy_only=False)
        heads = np.zeros(len(length), MESSAGE_HEAD)
        heads["opcode"] = 5
        heads["length"] = MESSAGE_HEAD.itemsize - 9 + length
        heads["channel"] = _numbers(table, "channel")
        heads["sequence"] = _numbers(table, "sequence")
        heads["log_time"] = log_time
        heads["publish_time"] = np.where(is_missing, log_time, publish)
        size = MESSAGE_HEAD.itemsize
        whole = Split(
            payloads,
            bounds,
            np.zeros((len(length), 1), np.int64),
            [heads.view(np.uint8)],
            np.full((len(length), 1), size, np.int64),
        )
        data, record_bounds = join(whole)
        return Rebuilt(data, record_bounds, _numbers(table, "ref.off") - size)

    def _parts(self, table: pa.Table) -> Split:
        rest, rest_offset = bytes_of(column_at(table, f"{RECIPE}.rest"))
        at, _ = values_of(column_at(table, f"{RECIPE}.at"))
        rows = len(rest_offset) - 1
        starts = rest_offset[:-1]
        is_big = big_endian_rows(self._wire, rest.data, starts, np.diff(rest_offset))
        arrays, sizes = [], []
        for path in self._order:
            if path in self._columns:
                values, bounds = values_of(column_at(table, self._columns[path].column))
                kind = np.dtype(self._columns[path].dtype)
                if values.dtype != kind:
                    raise ValueError("a column has another type")
                arrays.append(_wire_bytes(values, bounds, is_big))
                sizes.append(np.diff(bounds) * kind.itemsize)
            else:
                data, size = self._cloud(table)
                arrays.append(data)
                sizes.append(size)
        places = at.astype(np.int64).reshape(rows, len(self._order))
        return Split(rest, rest_offset, places, arrays, np.column_stack(sizes))

    def _cloud(self, table: pa.Table) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
        """Data of the clouds, and bytes of each."""
        layout = self._layout
        if layout is None:
            raise ValueError("an array has no column")
        columns = {
            field.column: values_of(column_at(table, f"{POINTS}.{field.column}"))
            for field in layout.fields
        }
        first = layout.fields[0]
        bounds = columns[first.column][1] // first.count
        padding, padding_offset = bytes_of(column_at(table, f"{RECIPE}.padding"))
        values = {name: column for name, (column, _) in columns.items()}
        whole = layout.pack(values, int(bounds[-1]))
        for row in np.flatnonzero(np.diff(padding_offset)).tolist():
            begin, end = int(bounds[row]) * layout.step, int(bounds[row + 1]) * layout.step
            own = padding[int(padding_offset[row]) : int(padding_offset[row + 1])]
            layout.pad(whole[begin:end], own)
        return whole, np.diff(bounds) * layout.step


def _wire_bytes(
    values: NDArray[Any], bounds: NDArray[np.int64], is_big: NDArray[np.bool_]
) -> NDArray[np.uint8]:
    """Numbers as bytes: little endian, and big endian in some rows."""
    little = values.astype(values.dtype.newbyteorder("<"), copy=False)
    if is_big.any():
        swapped = np.repeat(is_big, np.diff(bounds))
        little = np.where(swapped, little.byteswap(), little)
    return np.ascontiguousarray(little).view(np.uint8)


def column_at(table: pa.Table, path: str) -> pa.Array[Any]:
    """A column by its dotted path, in one piece.

    Raises:
        ValueError: It is missing.
    """
    name, *inner = path.split(".")
    try:
        column = table.column(name)
    except KeyError as error:
        raise ValueError(f"the column {path} is missing") from error
    array = column.chunk(0) if column.num_chunks == 1 else pa.concat_arrays(column.chunks)
    for name in inner:
        index = array.type.get_field_index(name) if pa.types.is_struct(array.type) else -1
        if index < 0:
            raise ValueError(f"the column {path} is missing")
        array = array.field(index)
    return array


def _numbers(table: pa.Table, path: str) -> NDArray[Any]:
    array = column_at(table, path)
    if array.null_count:
        raise ValueError(f"the column {path} has nulls")
    return array.to_numpy(zero_copy_only=False)


def values_of(array: pa.Array[Any]) -> tuple[NDArray[Any], NDArray[np.int64]]:
    """Elements of lists of numbers, or the bytes of binary values, without a copy.

    Returns:
        All elements one after the other; int64[n + 1], bounds of each row, from 0 on.

    Raises:
        ValueError: Some are null.
    """
    if pa.types.is_binary(array.type):
        return bytes_of(array)
    if not pa.types.is_list(array.type) or array.null_count:
        raise ValueError("a column of arrays has nulls, or another type")
    bounds = array.offsets.to_numpy().astype(np.int64)
    values = array.values.slice(int(bounds[0]), int(bounds[-1] - bounds[0]))
    if values.null_count:
        raise ValueError("an array has nulls")
    return values.to_numpy(zero_copy_only=False), bounds - bounds[0]


def bytes_of(array: pa.Array[Any]) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Binary values without a copy: all bytes, and bounds of each row, from 0 on.

    Raises:
        ValueError: Some are null.
    """
    if not pa.types.is_binary(array.type) or array.null_count:
        raise ValueError("a column of bytes has nulls, or another type")
    _, places, data = array.buffers()
    if places is None or not len(array):
        return np.empty(0, np.uint8), np.zeros(len(array) + 1, np.int64)
    bounds = np.frombuffer(places, np.int32, len(array) + 1, array.offset * 4).astype(np.int64)
    content = np.frombuffer(data, np.uint8) if data is not None else np.empty(0, np.uint8)
    return content[int(bounds[0]) : int(bounds[-1])], bounds - bounds[0]
