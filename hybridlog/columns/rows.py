"""Rows of tables: messages by columns, the columns that every table has, and points of clouds."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby
from operator import attrgetter
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from hybridlog.arrays.point_arrays import MAX_FIELDS, POINT_MAKERS
from hybridlog.columns.fields import as_columns, joined, without
from hybridlog.columns.layout import OWN, POINTS, column_names
from hybridlog.columns.left_rows import LeftFields
from hybridlog.schema.arrow_columns import lists, numbers, structs
from hybridlog.schema.codec import stamp_array
from hybridlog.schema.states import State
from hybridlog_storage.errors import PayloadError
from hybridlog_storage.messages import EXPIRED_IDS

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from hybridlog.schema.codec import Decoded
    from hybridlog_storage.messages import Channel
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


_CLOUDS: Final = frozenset({"sensor_msgs/PointCloud2", "sensor_msgs/msg/PointCloud2"})
_make = POINT_MAKERS["sensor_msgs/PointCloud2"]
_NUMBERS = ("height", "width", "point_step", "row_step", "is_bigendian")
NEEDED: Final = (*_NUMBERS, "fields", "data")
"""Fields of a cloud that its points are made from."""


def is_cloud(channel: Channel) -> bool:
    """True for a channel of clouds whose points become columns."""
    is_ros = channel.message_encoding in {"ros1", "cdr"}
    return is_ros and channel.schema is not None and channel.schema.name in _CLOUDS


class PointColumns:
    """Makes the column of points of one topic."""

    def __init__(self) -> None:
        self._names: set[str] = set()  # of fields of points

    def with_points(self, columns: pa.StructArray, clouds: pa.StructArray) -> pa.StructArray:
        """Columns of clouds, and one more with their points, null where they are malformed."""
        if POINTS in columns.type.names:  # another type of this name
            return columns
        found = self.points(clouds)
        added = pa.field(POINTS, found.type, metadata={OWN: b"1"})
        return pa.StructArray.from_arrays(
            [*columns.flatten(), found], fields=[*columns.type, added], mask=columns.is_null()
        )

    def points(self, clouds: pa.StructArray) -> pa.StructArray:
        """For each cloud a struct of lists; null if it is malformed.

        An element of a field with a `count` follows the one before it: points x count numbers.
        """
        try:
            arrays = [*enumerate(self._arrays(clouds))]
        except (KeyError, TypeError, AttributeError):  # another type of this name
            arrays = []
        readable = [(row, array) for row, array in arrays if array is not None]
        runs = groupby((array for _, array in readable), attrgetter("dtype"))
        pieces = [_columns([*run]) for _, run in runs]
        found = joined(pieces) if pieces else pa.nulls(0, pa.struct([]))
        return without(found, np.array([row for row, _ in readable], np.intp), len(clouds))

    def _arrays(self, clouds: pa.StructArray) -> Iterator[NDArray[Any] | None]:
        single = {name: clouds.field(name).to_pylist() for name in _NUMBERS}
        fields, data = clouds.field("fields"), clouds.field("data")
        for row in range(len(clouds)):
            about = {name: values[row] for name, values in single.items()}
            given = [SimpleNamespace(**one) for one in fields[row].as_py()]
            pixels = data[row].values.to_numpy(zero_copy_only=False)
            try:
                array = _make(SimpleNamespace(fields=given, data=pixels, **about))
            except PayloadError:
                yield None
                continue
            names = self._names | {*(array.dtype.names or ())}
            is_usual = len(names) <= MAX_FIELDS and bool(array.dtype.names)
            self._names = names if is_usual else self._names
            yield array.reshape(-1) if is_usual else None


def _columns(clouds: Sequence[NDArray[Any]]) -> pa.StructArray:
    """Points of clouds of one layout."""
    counts = np.array([len(cloud) for cloud in clouds], np.int64)
    names = clouds[0].dtype.names or ()
    spelled = [name.replace("\0", "_").replace(".", "_") for name in names]
    columns = {}
    for name, (_, column) in zip(names, column_names(spelled, ()), strict=True):
        values = np.concatenate([cloud[name].reshape(-1) for cloud in clouds])
        values = values.astype(values.dtype.newbyteorder("="), copy=False)
        each = int(np.prod(clouds[0].dtype[name].shape, dtype=np.int64))
        bounds = np.concatenate([[0], np.cumsum(counts)]) * each
        columns[column] = lists(numbers(values), bounds)
    return structs(columns, len(clouds))
