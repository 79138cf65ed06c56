"""Columns of a view: the fields of a topic's messages in types that SQL has.

Nested messages are structs. Arrays are lists, whole; one that tables may hold as a summary
has a twin of the name `<array>_summary` with `n`, `min`, `max` and `mean`. Times are
timestamps without a zone, in UTC, since DuckDB's timestamps with a zone have microseconds.
Durations are nanoseconds. Fields without a common exact type are JSON text.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from msgspec import Struct

from hybridlog.columns.fields import LIMIT
from hybridlog.columns.layout import OWN_COLUMNS, POINTS, column_names
from hybridlog.schema.arrow_columns import json_array, structs
from hybridlog.schema.arrow_types import (
    COMPUTED_AS,
    common_type,
    exact,
    is_array,
    is_bytes,
    is_list,
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
_RESERVED: Final = OWN_COLUMNS.union(OWN.names)
_types = pa.types
Path = tuple[str, ...]
Key = tuple[Path, bool]
"""The path of a field of messages; True for the summary of an array."""


class ViewColumn(Struct, frozen=True):
    """A column of a view, or a field inside one; `inner` are the fields of a struct.

    Its `source` is the path of a field of messages, of a `kind` as codecs give it, its `type` that
    in SQL. The twin of an array is a summary.
    """

    name: str
    source: Path
    kind: Any
    type: Any
    inner: tuple[ViewColumn, ...] = ()
    is_summary: bool = False
    is_points: bool = False

    def leaves(self, above: Path = ()) -> Iterator[tuple[Path, ViewColumn]]:
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

    def values(self, records: Any, summaries: Any, wanted: Collection[Key]) -> Any:
        """Its values in SQL's types, null where messages lack them; those of `wanted` fields only.

        `records` are fields of messages; `summaries` the same, with those of arrays that are gone.
        """
        here = field_of(summaries if self.is_summary else records, self.source[-1])
        if self.inner:
            here = pa.nulls(len(records), pa.struct([])) if here is None else here
            beside = field_of(summaries, self.source[-1])
            beside = here if beside is None else beside
            children = [one.values(here, beside, wanted) for one in self.inner]
            fields = list(self.type)
            return pa.StructArray.from_arrays(children, fields=fields, mask=here.is_null())
        if here is None or self.key not in wanted:
            return pa.nulls(len(records), self.type)
        return fitted(summary(here) if self.is_summary and is_array(here.type) else here, self.kind)

    @classmethod
    def of_points(cls, kind: Any) -> ViewColumn:
        """The column of the points of clouds, of a type."""
        return cls(POINTS, (POINTS,), kind, sql_type(kind), is_points=True)


def field_of(columns: Any, name: str) -> Any:
    """A field of structs, null where these are; None without it."""
    names = columns.type.names if _types.is_struct(columns.type) else ()
    return pc.struct_field(columns, [names.index(name)]) if name in names else None


def view_columns(kind: Any) -> list[ViewColumn]:
    """The columns for messages of one type."""
    return list(_columns(kind, (), _RESERVED))


def _columns(message: Any, path: Path, reserved: frozenset[str]) -> Iterator[ViewColumn]:
    fields: list[tuple[str, Any, bool]] = []
    for field in message:
        fields.append((field.name, field, False))
        if _may_be_summary(field.type):
            fields.append((f"{field.name}_summary", field, True))
    named = column_names([name for name, _, _ in fields], reserved)
    for (_, name), (_, field, is_twin) in zip(named, fields, strict=True):
        source = (*path, field.name)
        if is_twin:
            kind = summary(pa.nulls(0, field.type)).type
            yield ViewColumn(name, source, kind, sql_type(kind), is_summary=True)
        elif _types.is_struct(field.type) and field.type.num_fields:
            inner = tuple(_columns(field.type, source, frozenset()))
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
    """The type for values of several types; JSON text without a common one."""
    return common_type([pa.nulls(0, kind) for kind in kinds], _merged)


def _merged(kinds: Sequence[Any], arrays: Sequence[Any]) -> Any:
    is_large = pa.uint64() in kinds and any(map(_types.is_signed_integer, kinds))
    if is_large and all(map(_types.is_integer, kinds)):
        return pa.decimal128(20, 0)
    return exact(kinds, arrays)


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
    target, have = sql_type(kind), array.type
    if array.null_count == len(array):
        return pa.nulls(len(array), target)
    if kind == pa.json_():
        return (array if have == kind else json_array(plain_values(array))).storage
    return array if have == target else _fitted(array, kind, target)


def _fitted(array: Any, kind: Any, target: Any) -> Any:
    have = array.type
    if is_list(have) and is_list(target):
        made = with_values(array, fitted(array.flatten(), kind.value_type))
        return made if made.type == target else made.cast(target)
    if _types.is_struct(have) and _types.is_struct(target):
        found = [field_of(array, field.name) for field in kind]
        columns = {
            to.name: pa.nulls(len(array), to.type) if one is None else fitted(one, field.type)
            for one, field, to in zip(found, kind, target, strict=True)
        }
        return structs(columns, len(array), missing_of(array))
    if _types.is_struct(have) and _types.is_boolean(target):  # a message without fields
        return pa.array(np.ones(len(array), np.bool_), mask=missing_of(array))
    try:
        return array.cast(pa.int64()).cast(target) if is_time(have) else array.cast(target)
    except pa.ArrowException as error:
        raise UsageError(f"{have} is not {target}: {error}") from error
