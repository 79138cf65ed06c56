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

from hybridlog.columns.clouds import CLOUD_TYPES, DATA, PointLayout, layout_of
from hybridlog.columns.fields import FieldShape, records_of
from hybridlog.columns.layout import (
    OWN,
    OWN_COLUMNS,
    PAYLOAD_RESERVED,
    POINTS,
    RECIPE,
    topic_folder,
)
from hybridlog.columns.rows import Messages, own_columns
from hybridlog.columns.rows import Piece as TablePiece
from hybridlog.columns.transposer import (
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
from hybridlog_storage.errors import DefinitionError
from hybridlog_storage.mcap.mcap_content import MESSAGE_HEAD

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from hybridlog_storage.messages import Batch, Channel
    from hybridlog_storage.segments.chunk import StoredChunk

NEEDED = ("t", "seq", "pub", "channel", "sequence", "ref", RECIPE, POINTS)
"""Our columns that messages are made from."""
_OWN_BYTES = 80  # about what the columns of a message take besides its payload


@dataclass(slots=True)
class Piece:
    """The messages of a topic in one chunk as rows.

    Attributes:
        table: The rows, in the order of the chunk.
        layout: Layout of the points of clouds; None where points are not unpacked. Of what is
            left of expired messages the schema. Those of one layout share a file.
        size: About the bytes of the rows.
    """

    table: pa.Table
    layout: PointLayout | pa.Schema | None
    size: int


class TopicColumns:
    """Turns messages of one type into rows.

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
        self.folder = topic_folder(channel.topic)

    def about(self, layout: PointLayout | None) -> dict[str, Any]:
        """Further metadata of a file."""
        return {
            "wire": self._wire,
            "order": [array.path for array in self.arrays],
            "layout": layout.to_json() if layout is not None else None,
        }

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
        self, chunk: StoredChunk, rows: NDArray[np.intp], has_publish_time: Mapping[int, bool]
    ) -> Piece | None:
        """Rows of messages; None if one does not fit its definition.

        Args:
            chunk: The chunk that holds them.
            rows: Their rows in it, ascending; one at least.
            has_publish_time: Whether messages of a channel have a publish time, by channel id.
        """
        batch = chunk.batch.take(rows)
        spans = self._locator.spans(batch.buffer, batch.offset, batch.length)
        decoded = self._reader.read(batch.buffer, batch.offset, batch.length)
        if spans is None or decoded.unreadable:
            return None
        records = decoded.records
        layout = layout_of(records) if self._is_cloud else None
        parts = split(batch.buffer, batch.offset, batch.length, spans)
        fields = self._shape.columns(self._struct(records, "", layout))
        messages = Messages.of(chunk, 0).take(rows)
        segment = np.full(len(rows), chunk.segment, np.int32)
        piece = TablePiece(chunk.segment, messages, None)
        own = own_columns([piece], messages, segment, fields, has_publish_time)
        has_none = own["pub"].is_null().to_numpy(zero_copy_only=False)
        same = batch.publish_time == batch.log_time
        own["pub"] = pa.array(batch.publish_time, mask=has_none & same)
        besides = {"sequence": pa.array(batch.sequence), **_recipe(layout, parts, records)}
        schema = [pa.field(name, column.type) for name, column in own.items()]
        schema += list(fields.type)
        schema += [pa.field(n, c.type, metadata={OWN: b"1"}) for n, c in besides.items()]
        schema = [field.with_type(_required(field.type)) for field in schema]
        columns = [*own.values(), *fields.flatten(), *besides.values()]
        arrays = [column.cast(field.type) for column, field in zip(columns, schema, strict=True)]
        table = pa.Table.from_arrays(arrays, schema=pa.schema(schema))
        return Piece(table, layout, batch.payload_bytes + _OWN_BYTES * len(rows))

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
                arrays[name] = _binary(*_data_of(column))
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


def _is_bytes(column: Column) -> bool:
    if not isinstance(column, Arrays) or not isinstance(column.values, Scalars):
        return False
    return bool(column.values.values.dtype == np.uint8)


def _data_of(column: Column) -> tuple[NDArray[Any], NDArray[np.int64]]:
    """Elements and bounds of arrays of numbers."""
    assert isinstance(column, Arrays)
    assert isinstance(column.values, Scalars)
    return column.values.values, column.offset


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


def _recipe(layout: PointLayout | None, parts: Split, records: Records) -> dict[str, pa.Array[Any]]:
    """Columns of the original bytes besides the arrays, and of the points of unpacked clouds."""
    rows, arrays = parts.at.shape
    bounds = np.arange(rows + 1, dtype=np.int64) * arrays
    columns = {
        "rest": _binary(parts.rest, parts.rest_offset),
        "at": lists(numbers(parts.at.ravel().astype(np.uint32)), bounds),
    }
    if layout is None:
        return {RECIPE: structs(columns, rows)}
    data, offset = _data_of(field_at(records, DATA))
    columns["padding"] = _padding(layout, data, offset)
    return {POINTS: _points(layout, data, offset), RECIPE: structs(columns, rows)}


@dataclass(frozen=True, slots=True)
class Rebuilt:
    """Messages of a chunk as they were.

    Attributes:
        data: uint8, whole message records, one after the other.
        offset: int64[n + 1], bounds of each record.
        place: int64[n], where each record starts in the content of its chunk.
        seq: int64[n], arrival numbers.
    """

    data: NDArray[np.uint8]
    offset: NDArray[np.int64]
    place: NDArray[np.int64]
    seq: NDArray[np.int64]


class Rebuilder:
    """Makes message records from rows.

    Args:
        wire: Encoding of the messages, `ros1` or `cdr`.
        order: Paths of all arrays in the order of the wire; the points of clouds as their `data`.
        layout: Layout of the points of clouds, where they are unpacked.
    """

    def __init__(self, wire: str, order: Sequence[str], layout: PointLayout | None) -> None:
        self._wire: Any = wire
        self._order = order
        self._layout = layout

    def records(self, own: Mapping[str, pa.Array[Any]], fields: pa.StructArray) -> Rebuilt:
        """The message records of some rows.

        Args:
            own: The columns `NEEDED`.
            fields: The arrays, as fields of messages.

        Raises:
            ValueError: The rows contradict each other.
        """
        payloads, bounds = join(self._parts(own, fields))
        length = np.diff(bounds)
        if (length != _numbers(own, "ref.len")).any():
            raise ValueError("rebuilt messages have another length")
        log_time = _numbers(own, "t")
        pub = own["pub"]
        publish = pub.fill_null(0).to_numpy(zero_copy_only=False)
        is_missing = pub.is_null().to_numpy(zero_copy_only=False)
        heads = np.zeros(len(length), MESSAGE_HEAD)
        heads["opcode"] = 5
        heads["length"] = MESSAGE_HEAD.itemsize - 9 + length
        heads["channel"] = _numbers(own, "channel")
        heads["sequence"] = _numbers(own, "sequence")
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
        place = _numbers(own, "ref.off") - size
        return Rebuilt(data, record_bounds, place, _numbers(own, "seq"))

    def _parts(self, own: Mapping[str, pa.Array[Any]], fields: pa.StructArray) -> Split:
        rest, rest_offset = bytes_of(_at(own, f"{RECIPE}.rest"))
        at, _ = values_of(_at(own, f"{RECIPE}.at"))
        rows = len(rest_offset) - 1
        starts = rest_offset[:-1]
        is_big = big_endian_rows(self._wire, rest.data, starts, np.diff(rest_offset))
        arrays, sizes = [], []
        for path in self._order:
            if path == DATA and self._layout is not None:
                data, size = _cloud(self._layout, own)
                arrays.append(data)
                sizes.append(size)
                continue
            values, bounds = values_of(field_of(fields, path))
            arrays.append(_wire_bytes(values, bounds, is_big))
            sizes.append(np.diff(bounds) * values.itemsize)
        places = at.astype(np.int64).reshape(rows, len(self._order))
        return Split(rest, rest_offset, places, arrays, np.column_stack(sizes))


def _cloud(
    layout: PointLayout, own: Mapping[str, pa.Array[Any]]
) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Data of clouds, and bytes of each."""
    columns = {
        field.column: values_of(field_of(own[POINTS], field.column)) for field in layout.fields
    }
    first = layout.fields[0]
    bounds = columns[first.column][1] // first.count
    padding, padding_offset = bytes_of(_at(own, f"{RECIPE}.padding"))
    whole = layout.pack({name: values for name, (values, _) in columns.items()}, int(bounds[-1]))
    for row in np.flatnonzero(np.diff(padding_offset)).tolist():
        begin, end = int(bounds[row]) * layout.step, int(bounds[row + 1]) * layout.step
        given = padding[int(padding_offset[row]) : int(padding_offset[row + 1])]
        layout.pad(whole[begin:end], given)
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


def rows_of(table: pa.Table) -> tuple[dict[str, pa.Array[Any]], pa.StructArray]:
    """Our columns by name, and the others as fields of messages."""
    own: dict[str, pa.Array[Any]] = {}
    fields, columns = [], []
    for field, column in zip(table.schema, table.columns, strict=True):
        array = column.chunk(0) if column.num_chunks == 1 else pa.concat_arrays(column.chunks)
        if field.name in OWN_COLUMNS or OWN in (field.metadata or {}):
            own[field.name] = array
        else:
            fields.append(field)
            columns.append(array)
    return own, records_of(pa.StructArray.from_arrays(columns, fields=fields))


def field_of(array: pa.StructArray, path: str) -> pa.Array[Any]:
    """A field of messages by its dotted path.

    Raises:
        ValueError: It is missing.
    """
    for name in path.split("."):
        if not pa.types.is_struct(array.type) or array.type.get_field_index(name) < 0:
            raise ValueError(f"the column {path} is missing")
        array = array.field(name)
    return array


def _at(own: Mapping[str, pa.Array[Any]], path: str) -> pa.Array[Any]:
    name, _, rest = path.partition(".")
    return field_of(own[name], rest) if rest else own[name]


def _numbers(own: Mapping[str, pa.Array[Any]], path: str) -> NDArray[Any]:
    array = _at(own, path)
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
