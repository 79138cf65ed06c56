"""What is left of messages without payload, by columns: rows of a file, or a reduced message.

A reduced message has its fields as in an index document. They become the columns that rows
files have, so whoever asks need not know where they come from.
"""

# Where stubs for pyarrow are installed, they are incomplete for its buffers.
# mypy: disable-error-code="no-any-return, arg-type, call-overload, return-value, assignment"

from __future__ import annotations

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
    records_of,
)
from hybridlog.columns.layout import EMPTY, OWN_COLUMNS
from hybridlog.schema.arrow_columns import lists, structs
from hybridlog.schema.arrow_objects import json_array, missing_rows, objects_array, offsets_of
from hybridlog.schema.arrow_types import (
    Array,
    has_empty,
    is_bytes,
    is_list,
    is_time,
    lengths_of,
    plain_values,
)
from hybridlog.schema.column import Records
from hybridlog_storage.messages import Batch, Left

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence

    from numpy.typing import NDArray

    from hybridlog.schema.codec import Decoded

_OWN: Final = frozenset(OWN_COLUMNS)
_LONG: Final = (pa.int64(), pa.uint32(), pa.uint64())
_MOST: Final = (1 << 64) - 1
_UNFIT: Final = (pa.ArrowException, AttributeError, OverflowError, TypeError, ValueError)
_NO_FIELDS: Final = "its payload did not fit its definition when it was dropped"
_SUMMARIES: Final = ({*SUMMARY_FIELDS[:1]}, {*SUMMARY_FIELDS})


class LeftRows:
    """Rows of messages of a topic; see `hybridlog.schema.left.Part`.

    Args:
        all_columns: Its rows; a struct has all columns.
    """

    def __init__(self, all_columns: pa.StructArray) -> None:
        self._all = all_columns
        names = [field.name for field in all_columns.type if field.name not in _OWN]
        fields = [all_columns.type.field(name) for name in names]
        self._columns = structs(
            {name: all_columns.field(name) for name in names}, len(all_columns), None, fields
        )

    def errors(self, rows: NDArray[np.int64]) -> list[tuple[NDArray[np.intp], str]]:
        """Rows that did not fit their definition, by reason."""
        error = self._all.field("error").take(pa.array(rows))
        found = []
        for reason in pc.unique(error.drop_null()).to_pylist():
            is_so = pc.equal(error, reason).fill_null(fill_value=False)
            found.append((np.flatnonzero(is_so.to_numpy(zero_copy_only=False)), reason))
        return found

    def surplus(self, rows: NDArray[np.int64]) -> NDArray[np.bool_]:
        """bool[n], True where bytes were left over behind the message."""
        return self._all.field("ref").field("surplus").to_numpy(zero_copy_only=False)[rows]

    def about(self, row: int) -> tuple[int, bytes]:
        """Bytes and SHA-256 of a payload."""
        ref = self._all.field("ref")
        return ref.field("size")[row].as_py(), ref.field("sha256")[row].as_py()

    def columns(self, rows: NDArray[np.int64]) -> pa.StructArray:
        """The columns of fields."""
        return self._columns.take(pa.array(rows))

    def documents(
        self, rows: NDArray[np.int64], *, typed: bool, summaries: bool = True
    ) -> list[dict[str, object]]:
        """The fields as in index documents.

        Args:
            rows: The rows.
            typed: True to tell int64 from int32.
            summaries: False to leave out arrays of which only a summary is left.
        """
        return _documents(self._columns.take(pa.array(rows)), typed=typed, summaries=summaries)

    def records(
        self, rows: NDArray[np.int64], summarised: Collection[str] | None = ()
    ) -> pa.StructArray:
        """The fields. Long arrays are null; those at some paths, or all (None), are summaries."""
        columns = self._columns.take(pa.array(rows))
        return records_of(columns, lambda path: summarised is None or ".".join(path) in summarised)

    def lacking(
        self, rows: NDArray[np.int64], fields: Collection[str] | None, but: Collection[str]
    ) -> NDArray[np.bool_]:
        """bool[n], True where a wanted array is not there."""
        wanted = None if fields is None else [names_of(path) for path in fields]
        found = np.zeros(len(rows), np.bool_)
        for path, summary in _summaries_in(self._columns.take(pa.array(rows))):
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
        Left([*map(LeftRows, parts)], part, row, *place),
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


def _documents(columns: Array, *, typed: bool, summaries: bool = True) -> list[dict[str, Any]]:
    """Columns as index documents: arrays, or summaries of long ones, and without what is null.

    Args:
        columns: A struct array; its fields are the columns.
        typed: True if a definition fixes the width of integers.
        summaries: False to leave out summaries.
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
        made = _documents(array, typed=typed, summaries=summaries)
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


def rows_of_documents(
    empty: Decoded | None, left: Sequence[tuple[int, bytes, dict[str, Any] | str]]
) -> LeftRows:
    """Rows of reduced messages.

    Args:
        empty: No messages, as the codec of their payloads decodes them; None if it cannot.
        left: Bytes and SHA-256 of each payload; its document, or why there is none.
    """
    none = structs({}, 0) if empty is None else empty.arrow()
    kind = FieldShape().columns(none).type
    is_typed = empty is None or isinstance(empty.records, Records) or not has_empty(none.type)
    errors = [one if isinstance(one, str) else None for _, _, one in left]
    documents = [{} if isinstance(one, str) else one for _, _, one in left]
    if kind.num_fields:
        errors = [e or (None if d else _NO_FIELDS) for e, d in zip(errors, documents, strict=True)]
    if not is_typed:
        kind = FieldShape().columns(objects_array([*map(_example, documents)], None)).type
    made: Array
    try:
        made = _filled(documents, pa.field("", kind))
    except _UNFIT:
        for row, document in enumerate(documents):
            try:
                _filled([document], pa.field("", kind))
            except _UNFIT as error:
                errors[row], documents[row] = f"the payload is no reduced message: {error}", {}
        made = _filled(documents, pa.field("", kind))
    sizes, digests = pa.array([one[0] for one in left], pa.uint64()), [one[1] for one in left]
    about = {
        "size": sizes,
        "sha256": pa.array(digests, pa.binary()),
        "surplus": pa.array(np.zeros(len(left), np.bool_)),
    }
    own = {"error": pa.array(errors, pa.string()), "ref": structs(about, len(left))}
    fields = [pa.field(name, array.type) for name, array in own.items()]
    columns = dict(zip([field.name for field in kind], made.flatten(), strict=True))
    return LeftRows(structs(own | columns, len(left), None, [*fields, *kind]))


def _is_summary(value: Any) -> bool:
    """True for the summary of an array: integers of messages are as short as they can be."""
    if not isinstance(value, dict) or value.keys() not in _SUMMARIES:
        return False
    return isinstance(value["n"], Int64) and value["n"] < 1 << 31


def _example(value: Any) -> Any:
    """A value of the same type with a short array in place of each summary."""
    if _is_summary(value):
        ends = [value.get(name, "") for name in ("min", "max")]
        return [0.0 if end is None else end for end in ends]
    if isinstance(value, dict):
        return {name: _example(inner) for name, inner in value.items()}
    return [*map(_example, value)] if isinstance(value, list) else value


def _filled(values: Sequence[Any], field: Any) -> Array:
    """A column of values of documents."""
    kind = field.type
    if EMPTY in (field.metadata or {}) and not is_list(kind):
        return pa.array([None if value is None else True for value in values], kind)
    if pa.types.is_struct(kind):
        columns = {}
        for number, inner in enumerate(kind):
            name = original_name(inner)
            own = [None if value is None else value.get(name) for value in values]
            after = kind.field(number + 1) if number + 1 < kind.num_fields else None
            if has_summaries(inner):
                own = [_summary_in(one, kind.field(number - 1).type) for one in own]
            elif after is not None and has_summaries(after):
                own = [None if _summary_in(one, inner.type) else one for one in own]
            columns[inner.name] = _filled(own, inner)
        return structs(columns, len(values), missing_rows(values), kind)
    if is_list(kind):
        inner = kind.value_field
        if EMPTY in (field.metadata or {}):
            inner = inner.with_metadata(field.metadata)
        items = _filled([item for value in values if value is not None for item in value], inner)
        made = lists(items, offsets_of(values), missing_rows(values))
        return made if made.type == kind else made.cast(kind)
    if kind == pa.json_():
        return json_array(values)
    if pa.types.is_integer(kind):
        values = [min(int(one), _MOST) if isinstance(one, float) else one for one in values]
    return pa.array(values, kind)


def _summary_in(value: Any, kind: Any) -> dict[str, Any] | None:
    """The summary of an array, if it or an array among its elements was too long."""
    if isinstance(value, dict):
        return value
    is_nested = isinstance(value, list) and is_list(kind) and is_list(kind.value_type)
    if is_nested and any(_summary_in(one, kind.value_type) for one in value):
        return {"n": len(value)}
    return None
