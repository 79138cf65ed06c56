"""Conversion of message fields to columns of a table, and back.

An array has two columns: the list, null where it has more than `LIMIT` elements, and its
summary, null where the list is there. In tables with arrays the list is always there, but for
arrays of bytes. Summaries are `{n, min, max, mean}`, as in the index;
of strings, bytes and messages `{n}`. A message without fields becomes a boolean, because
Parquet has no column for it. The columns follow from the types of the fields alone. A column
renamed from its field has the field's name in its metadata.

Points of clouds as a column: a list for each of their fields.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from itertools import groupby
from operator import attrgetter
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from hybridlog.arrays.message_arrays import MAX_FIELDS, POINT_MAKERS
from hybridlog.columns.layout import (
    EMPTY,
    ORIGINAL,
    OWN,
    OWN_COLUMNS,
    POINTS,
    SUMMARY,
    column_names,
)
from hybridlog.schema.arrow_types import (
    Array,
    common_type,
    converted,
    is_array,
    is_bytes,
    is_list,
    lengths_of,
    lists,
    missing_of,
    numbers,
    structs,
    summary,
    with_values,
)
from hybridlog_storage.errors import PayloadError, StoreError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog_storage.messages import Channel

# Where stubs for pyarrow are installed, they are incomplete for its buffers.
# mypy: disable-error-code="no-any-return, arg-type, call-overload, return-value, assignment"


LIMIT: Final = 32
"""Maximum number of elements of an array stored in full."""
SUMMARY_FIELDS: Final = ("n", "min", "max", "mean")
"""Fields of a summary of numbers."""


def as_columns(records: Array, *, arrays: bool = False) -> Array:
    """Fields of messages as columns: the fields of a struct array; `arrays` at any length."""
    return _struct_columns(records, OWN_COLUMNS, arrays=arrays)


def _as_column(array: Array, *, arrays: bool) -> Array:
    kind = array.type
    if pa.types.is_struct(kind):
        if kind.num_fields == 0:
            return pa.array(np.ones(len(array), np.bool_), mask=missing_of(array))
        return _struct_columns(array, (), arrays=arrays)
    if is_list(kind):
        values = _as_column(array.flatten(), arrays=arrays)
        is_same = pa.types.is_list(kind) and values.type == kind.value_type
        return array if is_same else with_values(array, values)
    return array


def _struct_columns(array: Array, reserved: Collection[str], *, arrays: bool) -> Array:
    kind = array.type
    columns: list[tuple[str, Array, dict[bytes, str]]] = []
    for number, field in enumerate(kind):
        name, values = field.name, array.field(number)
        about = {EMPTY: ""} if _is_empty(field.type) else {}
        width = field.type.list_size if pa.types.is_fixed_size_list(field.type) else LIMIT + 1
        if is_array(field.type) and width > LIMIT:
            values, summaries = _split(values, arrays=arrays)
            columns.append((name, values, about))
            columns.append((f"{name}_summary", summaries, {SUMMARY: name}))
        else:
            columns.append((name, _as_column(values, arrays=arrays), about))
    fields = []
    named = column_names([name for name, _, _ in columns], reserved)
    for (name, column), (_, values, about) in zip(named, columns, strict=True):
        if column != name and SUMMARY not in about:
            about[ORIGINAL] = name
        fields.append(pa.field(column, values.type, metadata=about or None))
    if kind == pa.struct(fields) and not any(field.metadata for field in fields):
        return array
    found = {field.name: values for field, (_, values, _) in zip(fields, columns, strict=True)}
    return structs(found, len(array), missing_of(array), fields)


def _split(array: Array, *, arrays: bool) -> tuple[Array, Array]:
    """Arrays within the limit, and summaries of the others."""
    is_long = np.zeros(len(array), np.bool_)
    if not arrays or _is_of_bytes(array.type):
        is_long = _over(array, LIMIT)
    if not is_long.any():
        none = pa.nulls(len(array), summary(array.slice(0, 0)).type)
        return _as_column(array, arrays=arrays), none
    rows = np.flatnonzero(is_long)
    short = array.take(pa.array(np.arange(len(array)), mask=is_long))
    long = array if len(rows) == len(array) else array.take(pa.array(rows))
    return _as_column(short, arrays=arrays), without(summary(long), rows, len(array))


def _is_of_bytes(kind: Any) -> bool:
    """True for bytes, and arrays of them: tables have these in full up to the limit only."""
    while is_list(kind):
        kind = kind.value_type
    return is_bytes(kind) or kind == pa.uint8()


def _over(array: Array, limit: int) -> Any:
    """bool[n], True for arrays with more elements, or with such an array among their elements."""
    lengths = lengths_of(array)
    found = lengths > limit
    if is_list(array.type) and is_array(array.type.value_type):
        inner = np.concatenate(([0], np.cumsum(_over(array.flatten(), limit), dtype=np.int64)))
        ends = np.cumsum(lengths)
        found |= inner[ends] > inner[ends - lengths]
    return found


def _is_empty(kind: Any) -> bool:
    """True for messages without fields, and arrays of them."""
    while is_list(kind):
        kind = kind.value_type
    return pa.types.is_struct(kind) and not kind.num_fields


def original_name(field: Any) -> str:
    """Name of the field of a column; of summaries, that of their array."""
    about = field.metadata or {}
    name = about.get(SUMMARY, about.get(ORIGINAL))
    return field.name if name is None else name.decode()


def has_summaries(field: Any) -> bool:
    """True for a column of summaries."""
    return SUMMARY in (field.metadata or {})


def records_of(
    columns: Array,
    is_summarised: Callable[[tuple[str, ...]], bool] = lambda _: False,
    above: tuple[str, ...] = (),
) -> Array:
    """Columns as fields of messages, under the names of the fields.

    `is_summarised` tells of the array at a path whether it becomes summaries; else lists, of which
    none is too long. The columns are the fields of a struct array at the path `above`.
    """
    kind = columns.type
    if pa.types.is_struct(kind):
        found: dict[str, Array] = {}
        for number, field in enumerate(kind):
            name = original_name(field)
            path = (*above, name)
            values = records_of(content_of(field, columns.field(number)), is_summarised, path)
            if has_summaries(field):
                if is_summarised(path):
                    found[name] = filled(values, found.get(name))
                else:
                    found.setdefault(name, values)
            else:
                found[name] = values
        is_same = not any(field.metadata for field in kind) and all(
            found[field.name].type == field.type for field in kind
        )
        return columns if is_same else structs(found, len(columns), missing_of(columns))
    if is_list(kind):
        elements = columns.flatten()
        values = records_of(elements, is_summarised, above)
        return columns if values is elements else with_values(columns, values)
    return columns


def content_of(field: Any, column: Array) -> Array:
    """A column with the messages that have no fields as such, and not as booleans."""
    return _emptied(column) if EMPTY in (field.metadata or {}) else column


def _emptied(array: Array) -> Array:
    """Messages without fields, which columns have as booleans."""
    if is_list(array.type):
        return with_values(array, _emptied(array.flatten()))
    return structs({}, len(array), missing_of(array))


def filled(summaries: Array, lists: Array | None) -> Array:
    """Summaries, worked out from the list where that is there."""
    if lists is None or lists.null_count == len(lists):
        return summaries
    whole = summary(lists)
    kind = summaries.type
    parts = [whole.field(whole.type.get_field_index(field.name)) for field in kind]
    columns = {field.name: part.cast(field.type) for part, field in zip(parts, kind, strict=True)}
    made = structs(columns, len(lists), missing_of(lists), list(kind))
    return pc.coalesce(summaries, made)


def joined(pieces: Sequence[Array]) -> Array:
    """Columns joined one after the other, with their common type.

    A column missing from a piece is null there. If one piece has summaries of an array, all
    get summaries. Values without a common exact type become JSON text. Columns of one name that
    stand for two fields raise StoreError.
    """
    try:
        kind = common_type(pieces, summaries=True)
        pieces = [converted(piece, kind) for piece in pieces]
    except (pa.ArrowException, NotImplementedError) as error:
        raise StoreError(f"The fields of messages have no common type: {error}.") from error
    return pa.concat_arrays(pieces) if len(pieces) > 1 else pieces[0]


def copied(array: Array) -> Array:
    """A copy of an array, which lets go the memory that it was read from."""
    half = len(array) // 2
    return pa.concat_arrays([array.slice(0, half), array.slice(half)])


def without(array: Array, rows: Any, total: int) -> Array:
    """Rows at ascending positions (intp[k]) in an array of `total` rows, null elsewhere."""
    if len(rows) == total:
        return array
    places = np.zeros(total, np.int64)
    places[rows] = np.arange(len(rows))
    missing = np.ones(total, np.bool_)
    missing[rows] = False
    return array.take(pa.array(places, mask=missing))


def side_by_side(own: Mapping[str, Array], others: Array) -> Array:
    """Columns by name, and behind them those of a struct array, as one struct array."""
    kinds = [pa.field(name, column.type) for name, column in own.items()]
    columns = {**own, **dict(zip(others.type.names, others.flatten(), strict=True))}
    return structs(columns, len(others), None, [*kinds, *others.type])


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
