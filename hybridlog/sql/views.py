"""Topics as DuckDB reads them: views with the rows that `query/rows.py` finds, in SQL's columns.

Nested messages are structs. Arrays are lists, whole; one that tables may hold as a summary
has a twin of the name `<array>_summary` with `n`, `min`, `max` and `mean`. Times are
timestamps without a zone, in UTC, since DuckDB's timestamps with a zone have microseconds.
Durations are nanoseconds. Fields without a common exact type are JSON text.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import reduce
from itertools import islice
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds
from msgspec import Struct, field
from msgspec.structs import replace

from hybridlog.columns.fields import LIMIT, NEEDED, PointColumns, is_cloud, without
from hybridlog.columns.layout import OWN_COLUMNS, POINTS, column_names
from hybridlog.columns.rows import LeftFields, rows_of
from hybridlog.frames.answer import FIXED, with_fields
from hybridlog.query.planner import Planner
from hybridlog.query.question import Counters, Question, windows_in
from hybridlog.query.rows import RowBatch, Rows
from hybridlog.schema.arrow_types import (
    COMPUTED_AS,
    common_type,
    converted,
    has_empty,
    is_array,
    is_bytes,
    is_list,
    is_text,
    summary,
)
from hybridlog.schema.column import STAMP
from hybridlog.schema.states import State
from hybridlog_storage.errors import UsageError, extra
from hybridlog_storage.segments.chunk import Placed
from hybridlog_storage.times import BEGIN, END, touches

with extra("sql", "SQL needs DuckDB"):
    from duckdb._sources.nodes import Binary, Col, In, Lit, Node
    from duckdb._sources.pyarrow import PyArrowDatasetSource

from hybridlog.query.planner import Resolved
from hybridlog.query.question import Part, RecordedChannel, Span

if TYPE_CHECKING:
    from pathlib import Path

    from hybridlog.columns.tables import TopicTable
    from hybridlog.query.chunk_scan import MessageRun
    from hybridlog.schema.codec import Decoded
    from hybridlog.session import Session
    from hybridlog_storage.catalog import RecordingEntry

_types = pa.types
_SAMPLED: Final = 20  # recordings that tell how many messages a topic has
_UNITS: Final = {"t": 1, "log_time": 1000}
"""Columns of log time, and the nanoseconds that a number in each stands for."""
_TABLE_OWN: Final = frozenset({"pub", "stamp"})
Names = frozenset[tuple[str, ...]] | None
"""Names on the way to fields that a query names, folded, from wherever each begins; None: any."""


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
FieldPath = tuple[str, ...]
Key = tuple[FieldPath, bool]
"""The path of a field of messages; True for the summary of an array."""


class ViewColumn(Struct, frozen=True):
    """A column of a view, or a field inside one; `inner` are the fields of a struct.

    Its `source` is the path of a field of messages, of a `kind` as codecs give it, its `type` that
    in SQL. The twin of an array is a summary.
    """

    name: str
    source: FieldPath
    kind: Any
    type: Any
    inner: tuple[ViewColumn, ...] = ()
    is_summary: bool = False
    is_points: bool = False

    def leaves(self, above: FieldPath = ()) -> Iterator[tuple[FieldPath, ViewColumn]]:
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


def field_of(columns: Any, name: str) -> Any:
    """A field of structs, null where these are; None without it."""
    names = columns.type.names if _types.is_struct(columns.type) else ()
    return pc.struct_field(columns, [names.index(name)]) if name in names else None


def view_columns(kind: Any) -> list[ViewColumn]:
    """The columns for messages of one type."""
    return list(_columns(kind, (), _RESERVED))


def _columns(message: Any, path: FieldPath, reserved: frozenset[str]) -> Iterator[ViewColumn]:
    fields: list[tuple[str, Any, bool]] = []
    for one in message:
        fields.append((one.name, one, False))
        if _may_be_summary(one.type):
            fields.append((f"{one.name}_summary", one, True))
    named = column_names([name for name, _, _ in fields], reserved)
    for (_, name), (_, one, is_twin) in zip(named, fields, strict=True):
        source = (*path, one.name)
        if is_twin:
            kind = summary(pa.nulls(0, one.type)).type
            yield ViewColumn(name, source, kind, sql_type(kind), is_summary=True)
        elif _types.is_struct(one.type) and one.type.num_fields:
            inner = tuple(_columns(one.type, source, frozenset()))
            made = pa.struct([pa.field(column.name, column.type) for column in inner])
            yield ViewColumn(name, source, one.type, made, inner)
        else:
            yield ViewColumn(name, source, one.type, sql_type(one.type))


def _may_be_summary(kind: Any) -> bool:
    """True if tables may hold an array as a summary."""
    return is_array(kind) and (not _types.is_fixed_size_list(kind) or kind.list_size > LIMIT)


def merged(kinds: Sequence[Any]) -> Any:
    """The type for values of several types; JSON text without a common one."""
    return common_type([pa.nulls(0, kind) for kind in kinds])


def sql_type(kind: Any) -> Any:
    """The type in SQL of values of a type."""
    for applies, made in _SQL_TYPES:
        if applies(kind):
            return made(kind)
    return kind


def _sql_struct(kind: Any) -> Any:
    fields = [field.with_type(sql_type(field.type)) for field in kind]
    return pa.struct(fields) if fields else pa.bool_()


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
    try:
        return with_fields(converted(array, kind, drops=True)).cast(sql_type(kind))
    except pa.ArrowException as error:
        raise UsageError(f"{array.type} is not {sql_type(kind)}: {error}") from error


class Limits(NamedTuple):
    """The log time `[begin, end)`, ns, of the rows that a query asks for, and their recordings."""

    span: Span = (BEGIN, END)
    recordings: Collection[str] | None = None

    def common(self, other: Limits) -> Limits:
        """Both limits."""
        (begin, end), (first, behind) = self.span, other.span
        names = [{*one} for one in (self.recordings, other.recordings) if one is not None]
        span = max(begin, first), min(end, behind)
        return Limits(span, set.intersection(*names) if names else None)


class Reading(Struct):
    """One execution of a query: what it reads, what it may lack, and the first error in that.

    Attributes:
        named: Fields that the query names.
        counters: Chunks and payloads that were read.
        groups: Row groups that rows came from, by file and number.
        recordings: Recordings that were read, by id.
        topics: Topics that were read.
        absent: Messages without fields, by topic and state.
        undefined: Topics without fields, with the reason.
    """

    named: Names = None
    counters: Counters = field(default_factory=Counters)
    groups: set[tuple[Path, int]] = field(default_factory=set)
    recordings: dict[str, RecordingEntry] = field(default_factory=dict)
    topics: set[str] = field(default_factory=set)
    absent: Counter[tuple[str, State]] = field(default_factory=Counter)
    undefined: dict[str, str] = field(default_factory=dict)
    error: Exception | None = None

    def names(self, path: tuple[str, ...]) -> bool:
        """True if the query may use a field: its column, and fields in it, folded."""
        if self.named is None:
            return True
        ends = (chain[start:] for chain in self.named for start in range(len(chain)))
        # As far as both go, so above it and below it, too.
        return any(end[: len(path)] == path[: len(end)] for end in ends)


class TopicView:
    """The view of a topic: its columns, and rows for a query; `size` is nearly their number.

    `resolved` are the recordings and times that it shows, by id.
    """

    def __init__(
        self, session: Session, topic: str, ids: Sequence[str], resolved: Mapping[str, Resolved]
    ) -> None:
        self.topic = topic
        self._session = session
        self._planner = Planner(session, Question((topic,), tuple(ids)))
        self._reason = next(filter(None, (c.codec.reason for c in self._planner.examples)), None)
        kinds = self._kinds()
        columns = view_columns(merged(kinds) if kinds else pa.struct([]))
        self._columns = {column.name: column for column in columns}
        if POINTS not in self._columns and (points := self._points()):
            kind = merged(points)
            made = ViewColumn(POINTS, (POINTS,), kind, sql_type(kind), is_points=True)
            self._columns[POINTS] = made
        fields = [pa.field(column.name, column.type) for column in self._columns.values()]
        self.schema = pa.schema([*OWN, *fields])
        self._chosen = [resolved[one] for one in ids if one in resolved]
        some = self._chosen[:_SAMPLED]
        messages = sum(part.messages for part in map(self._part, some) if part is not None)
        self.size = messages * len(self._chosen) // max(len(some), 1)

    def _part(self, one: Resolved) -> Part | None:
        """The topic in a recording, as asked; None without messages."""
        return next(self._planner.parts_in(*one), None)

    def _kinds(self) -> list[Any]:
        """Types of the messages; recordings with equal definitions have equal ones."""
        channels = self._planner.examples
        if all(map(_is_fixed, channels)):
            return [channel.arrow_type() for channel in channels if channel.codec.indexed]
        found = []
        for part in self._planner.split():
            table = self._planner.tabled(part)
            if table is not None:
                found += table.whole_types()
            else:
                found += (one.type for one in self._decoded(part))
        return found

    def _points(self) -> list[Any]:
        """Types of the points of clouds, of a topic whose tables have them."""
        if self.topic not in self._session.directory.settings.arrays:
            return []
        found = []
        for part in self._planner.split():
            table = self._planner.tabled(part)
            if table is not None and table.points is not None:
                found.append(table.points)
            elif any(is_cloud(channel.channel) for channel in part.channels):
                clouds = (one.type for one in self._decoded(part, _with_points))
                found += islice(
                    (one.field(POINTS).type for one in clouds if POINTS in one.names), 1
                )
        return found

    def _decoded(self, part: Part, fields: Callable[[Decoded], Any] | None = None) -> Iterator[Any]:
        """The fields of messages in chunks."""
        read = ViewRows(self._session, pa.schema([]), {}, Reading())
        return map(fields or _fields_of, read.decoded(part))

    def rows(self, schema: pa.Schema, limits: Limits, reading: Reading) -> Iterator[pa.RecordBatch]:
        """Rows for a query, with those columns; their first error is noted."""
        try:
            yield from self._rows(schema, limits, reading)
        except Exception as error:
            reading.error = reading.error or error
            raise

    def _rows(
        self, schema: pa.Schema, limits: Limits, reading: Reading
    ) -> Iterator[pa.RecordBatch]:
        if self._reason is not None:
            reading.undefined[self.topic] = self._reason
        read = ViewRows(self._session, schema, self._columns, reading)
        low, high = limits.span
        for one in self._chosen:
            summary, (begin, end) = one.summary, one.summary.extent
            is_beside = begin < end and (begin >= high or end <= low)
            names = limits.recordings
            if is_beside or (names is not None and summary.name not in names):
                continue
            reading.recordings[summary.id] = self._session.entry_of(summary)
            reading.topics.add(self.topic)
            part = self._part(one)
            if part is not None:
                if limits.span != (BEGIN, END):
                    part = replace(part, windows=windows_in(part.windows, limits.span))
                yield from read.read(part)


def _is_fixed(channel: RecordedChannel) -> bool:
    """True if a definition fixes the fields of all messages."""
    return (
        channel.codec.reason is not None
        or channel.encoding in FIXED
        # The keys of a map of protobuf are fields, which no definition knows.
        or (channel.encoding == "protobuf" and not has_empty(channel.arrow_type()))
    )


class TopicDataset(ds.Dataset, PyArrowDatasetSource):  # type: ignore[misc] # without types
    """A topic as DuckDB reads it. It relies on the source for the filters that are accepted.

    DuckDB takes the number of rows, and asks which filters are applied, by a class that is no
    part of its documented interface; so the version of its package is bounded.
    """

    def __init__(self, view: TopicView, reading: Callable[[], Reading]) -> None:
        PyArrowDatasetSource.__init__(self, self)
        self._view = view
        self._reading = reading

    @property
    def schema(self) -> Any:
        """All columns."""
        return self._view.schema

    def rows(self) -> int:
        """Number of rows, nearly."""
        return self._view.size

    def accepts(self, predicate: Any) -> bool:
        """True for a filter that limits times or recordings alone; DuckDB applies the others."""
        return _limits(predicate) is not None

    def stream(self, columns: Sequence[int] | None, filters: Sequence[Node]) -> tuple[object, bool]:
        """The rows for which the filters hold, as a stream of record batches."""
        schema, reading = self.schema, self._reading()
        if columns is not None:
            schema = pa.schema([schema.field(place) for place in columns])
        limits = reduce(Limits.common, filter(None, map(_limits, filters)), Limits())
        rows = self._view.rows(schema, limits, reading)
        reader = pa.RecordBatchReader.from_batches(schema, rows)
        return reader.__arrow_c_stream__(), columns is not None


def _limits(node: Node) -> Limits | None:
    """The rows for which a filter holds; None of one about anything but times and recordings."""
    match node:
        case Binary(op="AND", left=left, right=right):
            one, other = _limits(left), _limits(right)
            return None if one is None or other is None else one.common(other)
        case Binary(op=op, left=Col(parts=(name,)), right=Lit(value=int(value))) if name in _UNITS:
            begin, end = (number * _UNITS[name] for number in (value, value + 1))
            if begin > BEGIN and end < END:
                spans = {"<": (BEGIN, begin), "<=": (BEGIN, end), "=": (begin, end)}
                spans |= {">=": (begin, END), ">": (end, END)}
                return Limits(spans[op]) if op in spans else None
        case Binary(op="=", left=Col(parts=("recording",)), right=Lit(value=str(value))):
            return Limits(recordings=[value])
        case In(operand=Col(parts=("recording",)), values=values):
            return Limits(recordings=[str(one.value) for one in values if isinstance(one, Lit)])
    return None


class ViewRows(Rows):
    """Reads some columns of a view."""

    def __init__(
        self,
        session: Session,
        schema: pa.Schema,
        fields: Mapping[str, ViewColumn],
        reading: Reading,
    ) -> None:
        super().__init__(session, reading.counters)
        self._schema = schema
        self._reading = reading
        self._fields = {name: fields[name] for name in schema.names if name in fields}
        leaves = (leaf for column in self._fields.values() for leaf in column.leaves())
        used = [leaf for path, leaf in leaves if reading.names(path)]
        self._keys = {leaf.key for leaf in used}
        known = [leaf.source for leaf in used if not leaf.is_points]
        # A name with a dot of its own is read with all others.
        is_odd = any("." in name or "[" in name for source in known for name in source)
        self._paths = None if is_odd else [*dict.fromkeys(map(".".join, known))]
        self._has_points = any(leaf.is_points for leaf in used)
        self._arrays = [leaf.source for leaf in used if is_array(leaf.kind) and not leaf.is_summary]

    def read(self, part: Part) -> Iterator[pa.RecordBatch]:
        """The rows of a topic of a recording, in order."""
        return (found.records for found in self._lasting(part, self._rows))

    def decoded(self, part: Part) -> Iterator[Decoded]:
        """The messages of a part in chunks, with all fields."""
        for channel, run in self._by_channel(part):
            if channel.codec.indexed:
                yield channel.codec.columns_of(run.batch, None)

    def _rows(self, part: Part) -> Iterator[RowBatch]:
        table = self.tabled(part)
        if table is not None and not self._has_all(table, part):
            table = None
        groups = [] if table is None else table.parts
        own = {*_TABLE_OWN.intersection(self._schema.names), *[POINTS] * self._has_points}
        for rows, holds in self._in_table(part, table, self._paths, own):
            span = np.array([[int(rows.t[0]), int(rows.t[-1]) + 1]])
            self._reading.groups |= {
                (one.file.path, one.group) for one in groups if touches(span, one.first, one.last)
            }
            columns = {"t": pa.array(rows.t), "seq": pa.array(rows.seq), **rows.own}
            columns["state"] = pa.repeat(pa.scalar(str(State.WHOLE)), len(rows))
            columns["error"] = pa.nulls(len(rows), pa.string())
            records = rows.records
            if self._has_points:
                fields = [*records.type, pa.field(POINTS, columns[POINTS].type)]
                arrays = [*records.flatten(), columns[POINTS]]
                records = pa.StructArray.from_arrays(arrays, fields=fields)
            made = self._batch(part.recording, columns, records, records)
            yield RowBatch(rows.t, rows.seq, holds, made)
        for channel, run in self._by_channel(part) if table is None else ():
            made = self._decoded(channel, run)
            yield RowBatch(run.batch.log_time, run.seq, np.ones(len(run.seq), np.bool_), made)

    def _has_all(self, table: TopicTable, part: Part) -> bool:
        """True if a table has what is asked for: whole arrays, points, and the states of now."""
        asks_states = not {"state", "error"}.isdisjoint(self._schema.names)
        return not (
            any(map(table.is_cut, self._arrays))
            or (self._has_points and table.points is None)
            or (asks_states and any(channel.is_reduced for channel in part.channels))
        )

    def _decoded(self, channel: RecordedChannel, run: MessageRun) -> pa.RecordBatch:
        """The rows of messages of one channel."""
        count, paths, decoded = len(run.batch), self._paths, None
        if channel.codec.indexed:
            if paths is not None:
                paths = [*paths, STAMP, *(NEEDED if self._has_points else ())]
            decoded = channel.codec.columns_of(run.batch, paths)
            self.counters.payload_bytes += run.batch.payload_bytes * (not channel.is_reduced)
        none = np.zeros(count, np.int64)
        own, whole = rows_of(
            Placed(run.batch, run.seq, none.astype(np.int32), none, none, none),
            decoded,
            channel.state,
            has_publish_time=channel.channel.has_publish_time,
            columns=_with_points if self._has_points else _fields_of,
        )
        summaries = whole
        if decoded is not None and isinstance(decoded.records, LeftFields):
            summaries = without(decoded.records.both()[1], decoded.rows, count)
        topic, unreadable = channel.channel.topic, count - own["error"].null_count
        if unreadable:
            self._reading.absent[topic, State.UNREADABLE] += unreadable
        if channel.is_reduced and (self._arrays or self._has_points):
            self._reading.absent[topic, channel.state] += count - unreadable
        return self._batch(channel.recording, own, whole, summaries)

    def _batch(
        self, recording: RecordingEntry, own: Mapping[str, Any], records: Any, summaries: Any
    ) -> pa.RecordBatch:
        """The columns of some rows; those of fields that are not used are null."""
        arrays, rows = [], len(records)
        for name, kind in zip(self._schema.names, self._schema.types, strict=True):
            if name in self._fields:
                arrays.append(self._fields[name].values(records, summaries, self._keys))
            elif name == "log_time":
                arrays.append(pa.array(own["t"].to_numpy() // 1000).view(kind))
            elif name == "tags":
                tags = pa.array([list(recording.tags.items())], OWN.field("tags").type)
                arrays.append(tags.take(pa.array(np.zeros(rows, np.int64))))
            elif name == "recording":
                arrays.append(pa.repeat(pa.scalar(recording.name), rows))
            else:
                arrays.append(own[name].cast(kind))
        return pa.RecordBatch.from_arrays(arrays, schema=self._schema)


def _fields_of(decoded: Decoded) -> Any:
    """The fields of decoded messages; arrays that are gone are null."""
    records = decoded.records
    return records.both()[0] if isinstance(records, LeftFields) else decoded.arrow()


def _with_points(decoded: Decoded) -> Any:
    """The fields, and the points of clouds."""
    fields = _fields_of(decoded)
    return PointColumns().with_points(fields, fields)
