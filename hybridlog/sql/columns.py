"""Columns of a view: the fields of a topic's messages in types that SQL has.

Nested messages are structs. Arrays are lists, whole; one that tables may hold as a summary
has a twin of the name `<array>_summary` with `n`, `min`, `max` and `mean`. Times are
timestamps without a zone, in UTC, since DuckDB's timestamps with a zone have microseconds.
Durations are nanoseconds. Fields without a common exact type are JSON text.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from hybridlog.columns.fields import LIMIT
from hybridlog.columns.layout import OWN_COLUMNS, column_names
from hybridlog.schema.arrow_columns import json_array, structs
from hybridlog.schema.arrow_types import (
    COMPUTED_AS,
    common_type,
    is_array,
    is_bytes,
    is_list,
    is_number,
    is_summary,
    is_text,
    is_time,
    missing_of,
    plain_values,
    summary,
    with_values,
)
from hybridlog_storage.errors import UsageError

OWN: Final = pa.schema(
    [
        ("log_time", pa.timestamp("us", "UTC")),
        ("t", pa.int64()),
        ("recording", pa.string()),
        ("tags", pa.map_(pa.string(), pa.string())),
        ("seq", pa.int64()),
        ("pub", pa.int64()),
        ("stamp", pa.int64()),
        ("state", pa.string()),
        ("error", pa.string()),
    ]
)
"""Columns of every view in addition to the fields."""
_RESERVED: Final = frozenset({*OWN_COLUMNS, *OWN.names})
_types = pa.types
Key = tuple[tuple[str, ...], bool]
"""The path of the field of a column that is no struct; True if it is a summary."""


@dataclass(frozen=True, slots=True)
class ViewColumn:
    """A column of a view, or a field inside one.

    Attributes:
        source: Path of the field in the messages.
        kind: Type of the field, as codecs give it.
        type: Its type in SQL.
        inner: Fields of a struct.
        is_summary: True for the twin of an array.
        is_points: True for the points of clouds.
    """

    name: str
    source: tuple[str, ...]
    kind: Any
    type: Any
    inner: tuple[ViewColumn, ...] = ()
    is_summary: bool = False
    is_points: bool = False

    def leaves(self, above: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], ViewColumn]]:
        """Its fields that are no structs, each with the names on the way in SQL, folded."""
        path = (*above, self.name.casefold())
        if not self.inner:
            yield path, self
        for column in self.inner:
            yield from column.leaves(path)

    @property
    def key(self) -> Key:
        """Tells it from the others of a view."""
        return self.source, self.is_summary

    @property
    def is_array(self) -> bool:
        """True for an array that tables may hold as a summary."""
        return not (self.is_summary or self.is_points) and _may_be_summary(self.kind)

    def values(self, records: Any, summaries: Any, known: Collection[Key], rows: int) -> Any:
        """Its values in their SQL types, from messages, and these with summaries of arrays.

        They are null but for the `known` fields, and where the messages lack them.
        """
        here = _field(records, self.source[-1])
        if self.inner:
            beside = _field(summaries, self.source[-1])
            children = [one.values(here, beside, known, rows) for one in self.inner]
            missing = None if here is not None else pa.array(np.ones(rows, np.bool_))
            if here is not None and here.null_count:
                missing = here.is_null()
            return pa.StructArray.from_arrays(children, fields=list(self.type), mask=missing)
        if self.is_summary:
            here = _field(summaries, self.source[-1])
        if here is None or self.key not in known:
            return pa.nulls(rows, self.type)
        if self.is_summary and not is_summary(here.type):
            here = summary(here)
        return fitted(here, self.kind)


def _field(records: Any, name: str) -> Any:
    """A field of structs, null where these are; None without it."""
    if records is None or not _types.is_struct(records.type):
        return None
    there = records.type.get_field_index(name) >= 0
    return pc.struct_field(records, [name]) if there else None


def view_columns(kind: Any) -> list[ViewColumn]:
    """The columns for messages of one type."""
    return list(_columns(kind, (), _RESERVED))


def _columns(message: Any, path: tuple[str, ...], reserved: Iterable[str]) -> Iterator[ViewColumn]:
    fields: list[tuple[str, Any, bool]] = []
    for field in message:
        fields.append((field.name, field, False))
        if _may_be_summary(field.type):
            fields.append((f"{field.name}_summary", field, True))
    named = column_names([name for name, _, _ in fields], frozenset(reserved))
    for (_, name), (_, field, is_twin) in zip(named, fields, strict=True):
        source = (*path, field.name)
        if is_twin:
            kind = summary(pa.nulls(0, field.type)).type
            yield ViewColumn(name, source, kind, sql_type(kind), is_summary=True)
        elif _types.is_struct(field.type) and field.type.num_fields:
            inner = tuple(_columns(field.type, source, ()))
            made = pa.struct([pa.field(column.name, column.type) for column in inner])
            yield ViewColumn(name, source, field.type, made, inner)
        else:
            yield ViewColumn(name, source, field.type, sql_type(field.type))


def _may_be_summary(kind: Any) -> bool:
    """True if tables may hold an array as a summary."""
    if _types.is_fixed_size_list(kind):
        return bool(kind.list_size > LIMIT)
    return is_array(kind)


def merged(kinds: Sequence[Any]) -> Any:
    """The type for values of several types.

    Integers beside floats become doubles. Values that no type represents become JSON text.
    """
    return common_type([pa.nulls(0, kind) for kind in kinds], _merged_leaves)


def _merged_leaves(kinds: Sequence[Any], _: Sequence[Any]) -> Any:
    if all(map(is_number, kinds)):
        return _merged_numbers(kinds)
    if all(map(is_text, kinds)):
        return pa.string()
    return pa.binary() if all(map(is_bytes, kinds)) else pa.json_()


def _merged_numbers(kinds: Sequence[Any]) -> Any:
    if any(map(_types.is_floating, kinds)):
        return pa.float64()
    signed = [kind.bit_width for kind in kinds if _types.is_signed_integer(kind)]
    unsigned = [kind.bit_width for kind in kinds if _types.is_unsigned_integer(kind)]
    if not signed:
        return pa.type_for_alias(f"uint{max(unsigned)}")
    bits = max([*signed, *(2 * width for width in unsigned)])
    return pa.type_for_alias(f"int{bits}") if bits <= 64 else pa.decimal128(20, 0)


def whole_message(kind: Any) -> Any:
    """The type of messages of which a table holds some arrays as summaries.

    Such an array is a list of numbers, or JSON text where its elements are no numbers.
    """
    return pa.struct([field.with_type(whole_type(field.type)) for field in kind])


def whole_type(kind: Any) -> Any:
    """The same for the type of a field."""
    if is_summary(kind):
        if kind.num_fields == 1:
            return pa.json_()
        return pa.list_(kind.field("min").type)
    if _types.is_struct(kind):
        return pa.struct([field.with_type(whole_type(field.type)) for field in kind])
    if is_list(kind):
        return pa.list_(whole_type(kind.value_type))
    return kind


def lacks(have: Any, want: Any) -> bool:
    """True if a table holds a summary where a view has the array."""
    if is_summary(have) and not _types.is_struct(want):
        return True
    if is_list(have) and is_list(want):
        return lacks(have.value_type, want.value_type)
    if _types.is_struct(have) and _types.is_struct(want):
        inner = {field.name: field.type for field in want}
        return any(f.name in inner and lacks(f.type, inner[f.name]) for f in have)
    return False


def sql_type(kind: Any) -> Any:
    """The type in SQL of values of a type."""
    for applies, made in _SQL_TYPES:
        if applies(kind):
            return made(kind)
    return kind


def _sql_struct(kind: Any) -> Any:
    if not kind.num_fields:
        return pa.bool_()
    named = column_names([field.name for field in kind], frozenset())
    pairs = zip(named, kind, strict=True)
    return pa.struct([pa.field(name, sql_type(field.type)) for (_, name), field in pairs])


_SQL_TYPES: Final[Sequence[tuple[Callable[[Any], bool], Callable[[Any], Any]]]] = (
    (_types.is_timestamp, lambda _: pa.timestamp("ns")),
    (_types.is_duration, lambda _: pa.int64()),
    (lambda kind: kind == pa.json_() or is_text(kind), lambda _: pa.string()),
    (is_bytes, lambda _: pa.binary()),
    (_types.is_null, lambda _: pa.int32()),  # as DuckDB has it
    (is_list, lambda kind: pa.list_(sql_type(kind.value_type))),
    (_types.is_struct, _sql_struct),
    (COMPUTED_AS.__contains__, COMPUTED_AS.__getitem__),
)


def fitted(array: Any, kind: Any) -> Any:
    """Values of a field, as a codec or a table gives them, in the type that SQL has for it.

    A `UsageError` says that the type does not represent one.
    """
    target = sql_type(kind)
    if array.type == target and kind != pa.json_():
        return array
    if array.null_count == len(array):
        return pa.nulls(len(array), target)
    return _converted(array, kind, target)


def _converted(array: Any, kind: Any, target: Any) -> Any:
    have = array.type
    if kind == pa.json_():
        return (array if have == kind else json_array(plain_values(array))).storage
    if is_list(have) and is_list(target):
        made = with_values(array, fitted(array.flatten(), kind.value_type))
        return made if made.type == target else made.cast(target)
    if _types.is_struct(have) and _types.is_struct(target):
        return _fitted_struct(array, kind)
    if _types.is_struct(have) and _types.is_boolean(target):  # a message without fields
        there = np.ones(len(array), np.bool_)
        return pa.array(there, mask=missing_of(array))
    if is_time(have):
        return array.view(pa.int64()).view(target)
    try:
        return array.cast(target)
    except pa.ArrowException as error:
        raise UsageError(f"{have} is not {target}: {error}") from error


def _fitted_struct(array: Any, kind: Any) -> Any:
    have = dict(zip([field.name for field in array.type], array.flatten(), strict=True))
    columns = {
        name: fitted(have[field.name], field.type)
        if field.name in have
        else pa.nulls(len(array), sql_type(field.type))
        for (_, name), field in zip(
            column_names([field.name for field in kind], frozenset()), kind, strict=True
        )
    }
    return structs(columns, len(array), missing_of(array))
