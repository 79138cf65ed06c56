"""Points of clouds as a column: a list for each of their fields."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby
from operator import attrgetter
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa

from hybridlog.arrays.message_arrays import MAX_FIELDS, POINT_MAKERS
from hybridlog.columns.fields import joined, without
from hybridlog.columns.layout import OWN, POINTS, column_names
from hybridlog.schema.arrow_columns import lists, numbers, structs
from hybridlog_storage.errors import PayloadError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog_storage.messages import Channel

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
