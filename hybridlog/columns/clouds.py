"""Points of a PointCloud2 as one column for each of its fields, and back.

A point is `step` bytes; its fields say which of them are numbers. Bytes that no field
covers are *padding*; it is kept where it is not zero.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from hybridlog.arrays.point_arrays import MAX_FIELDS, POINT_TYPES
from hybridlog.columns.layout import column_names
from hybridlog.schema.column import Arrays, Records, Scalars, Strings

if TYPE_CHECKING:
    from numpy.typing import NDArray

CLOUD_TYPES: Final = frozenset({"sensor_msgs/PointCloud2", "sensor_msgs/msg/PointCloud2"})
DATA: Final = "data"
"""Field of a cloud that holds its points."""
_MAX_STEP = 1 << 16


@dataclass(frozen=True, slots=True)
class PointField:
    """A field of a point.

    Attributes:
        column: Name of its column.
        offset: Byte of the point where it starts.
        dtype: Type of its elements on the wire, with byte order, as numpy spells it.
        count: Its elements.
    """

    column: str
    offset: int
    dtype: str
    count: int

    @property
    def end(self) -> int:
        """Byte of the point behind it."""
        return self.offset + self.count * np.dtype(self.dtype).itemsize


@dataclass(frozen=True, slots=True)
class PointLayout:
    """The layout of the points of a cloud.

    Attributes:
        step: Bytes of a point.
        fields: By offset, apart.
    """

    step: int
    fields: tuple[PointField, ...]

    @property
    def gaps(self) -> list[tuple[int, int]]:
        """Begin and end of the bytes of a point that no field covers."""
        edges = [0, *(edge for f in self.fields for edge in (f.offset, f.end)), self.step]
        pairs = zip(edges[::2], edges[1::2], strict=True)
        return [(begin, end) for begin, end in pairs if begin < end]

    def to_json(self) -> dict[str, Any]:
        """As values for JSON."""
        fields = [[f.column, f.offset, f.dtype, f.count] for f in self.fields]
        return {"step": self.step, "fields": fields}

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> PointLayout:
        """The opposite of `to_json`.

        Raises:
            KeyError, TypeError, ValueError: The value is invalid.
        """
        fields = [PointField(str(n), int(o), str(d), int(c)) for n, o, d, c in value["fields"]]
        found = cls(int(value["step"]), tuple(fields))
        known = {order + name for order in "<>" for name in POINT_TYPES.values()}
        if not {f.dtype for f in fields} <= known or not found.is_sound():
            raise ValueError("the layout of points contradicts itself")
        return found

    def is_sound(self) -> bool:
        """True if all fields lie within the point, in order and apart."""
        if not (0 < self.step <= _MAX_STEP and 0 < len(self.fields) <= MAX_FIELDS):
            return False
        if any(f.offset < 0 or f.count < 1 or f.end > self.step for f in self.fields):
            return False
        return all(a.end <= b.offset for a, b in pairwise(self.fields))

    @property
    def dtype(self) -> np.dtype[Any]:
        """A point, as numpy describes it."""
        fields = self.fields
        return np.dtype(
            {
                "names": [f.column for f in fields],
                "formats": [(f.dtype, (f.count,)) for f in fields],
                "offsets": [f.offset for f in fields],
                "itemsize": self.step,
            }
        )

    def unpack(self, data: NDArray[np.uint8]) -> dict[str, NDArray[Any]]:
        """Points as columns.

        Args:
            data: uint8[points * step].

        Returns:
            For each field its elements in native byte order, `count` for each point.
        """
        points = np.ascontiguousarray(data).view(self.dtype)
        columns = {field.column: points[field.column] for field in self.fields}
        return {
            name: values.astype(values.dtype.newbyteorder("=")).ravel()
            for name, values in columns.items()
        }

    def padding(self, data: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The bytes that no field covers, point by point; empty if all are zero."""
        table = data.reshape(-1, self.step)
        parts = [table[:, begin:end] for begin, end in self.gaps]
        if not any(part.any() for part in parts):
            return np.empty(0, np.uint8)
        return np.concatenate(parts, axis=1).ravel()

    def pack(self, columns: Mapping[str, NDArray[Any]], points: int) -> NDArray[np.uint8]:
        """The opposite of `unpack`: uint8[points * step]; padding is zero.

        Raises:
            ValueError: Columns have another length.
        """
        packed = np.zeros(points, self.dtype)
        for field in self.fields:
            packed[field.column] = columns[field.column].reshape(points, field.count)
        return packed.view(np.uint8)

    def pad(self, data: NDArray[np.uint8], padding: NDArray[np.uint8]) -> None:
        """Put the padding back into points.

        Raises:
            ValueError: It has another size.
        """
        table, at = data.reshape(-1, self.step), 0
        given = padding.reshape(len(table), -1)
        if given.shape[1] != sum(end - begin for begin, end in self.gaps):
            raise ValueError("the padding has another size")
        for begin, end in self.gaps:
            table[:, begin:end] = given[:, at : at + end - begin]
            at += end - begin


def layout_of(records: Records) -> PointLayout | None:
    """The layout that all clouds of a batch share.

    Args:
        records: Their fields; one cloud at least.

    Returns:
        None if they differ, if fields overlap or lie outside of the points, or if the data
        are not exactly the points, row after row.
    """
    try:
        width, height, step, row_step, is_big = (
            _numbers(records, name)
            for name in ("width", "height", "point_step", "row_step", "is_bigendian")
        )
        fields, data = records.fields["fields"], records.fields[DATA]
    except KeyError:
        return None
    if not isinstance(fields, Arrays) or not isinstance(data, Arrays):
        return None
    sizes, first = np.diff(data.offset), int(step[0])
    is_even = (
        bool((step == first).all())
        and bool((is_big == is_big[0]).all())
        # In floating point, since products of untrusted numbers overflow.
        and bool((width.astype(float) * height * first == sizes).all())
        and bool(((height <= 1) | (row_step == width * first)).all())
    )
    if not is_even:
        return None
    described = _described(fields)
    if described is None:
        return None
    return _layout(first, ">" if is_big[0] else "<", described)


def _numbers(records: Records, name: str) -> NDArray[Any]:
    column = records.fields[name]
    if not isinstance(column, Scalars):
        raise KeyError(name)
    return column.values.astype(np.int64)


def _described(fields: Arrays) -> list[tuple[str, int, int, int]] | None:
    """Name, offset, type and count of each field; None if the clouds differ."""
    inner, rows = fields.values, len(fields)
    count, rest = divmod(int(fields.offset[-1]), rows)
    is_even = rest == 0 and bool((np.diff(fields.offset) == count).all())
    if not is_even or not isinstance(inner, Records) or not 0 < count <= MAX_FIELDS:
        return None
    columns = []
    for name in ("offset", "datatype", "count"):
        table = _numbers(inner, name).reshape(rows, count)
        if (table != table[0]).any():
            return None
        columns.append(table[0].tolist())
    names = inner.fields["name"]
    assert isinstance(names, Strings)
    spelled = [_text(names, place) for place in range(count)]
    lengths = np.diff(names.offset).reshape(rows, count)
    data = names.data[int(names.offset[0]) : int(names.offset[-1])]
    is_same = (
        bool((lengths == lengths[0]).all())
        and not ((table := data.reshape(rows, -1)) != table[0]).any()
    )
    return list(zip(spelled, *columns, strict=True)) if is_same else None


def _text(names: Strings, place: int) -> str:
    raw = names.data[int(names.offset[place]) : int(names.offset[place + 1])]
    return raw.tobytes().decode("utf-8", "replace")


def _layout(
    step: int, order: str, described: Sequence[tuple[str, int, int, int]]
) -> PointLayout | None:
    known = [one for one in described if one[2] in POINT_TYPES]
    if len(known) < len(described):
        return None
    ordered = sorted(known, key=lambda one: one[1])
    names: list[str] = []
    for name, *_ in ordered:
        label = name.replace("\0", "_").replace(".", "_") or "field"
        while label in names:
            label += "_"
        names.append(label)
    columns = [column for _, column in column_names(names, ())]
    fields = tuple(
        PointField(column, offset, order + POINT_TYPES[kind], count or 1)
        for column, (_, offset, kind, count) in zip(columns, ordered, strict=True)
    )
    found = PointLayout(step, fields)
    return found if found.is_sound() else None
