"""Rows of topics for SQL, where `query/rows.py` finds them, in the columns of a view."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from msgspec import Struct, field

from hybridlog.columns.fields import records_of, without
from hybridlog.columns.layout import POINTS
from hybridlog.columns.left_rows import LeftFields
from hybridlog.columns.rows import NEEDED, PointColumns
from hybridlog.index.indexing import rows_by_channel
from hybridlog.query.chunk_scan import ChunkScan
from hybridlog.query.question import Counters
from hybridlog.query.rows import Rows
from hybridlog.schema.arrow_types import is_array
from hybridlog.schema.codec import stamp_array
from hybridlog.schema.column import STAMP
from hybridlog.schema.states import State
from hybridlog.sql.columns import OWN, ViewColumn
from hybridlog.sql.names import EVERYTHING, Usage
from hybridlog_storage.errors import ChangedError, StoreError
from hybridlog_storage.times import BEGIN, END, inside, touches

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from hybridlog.columns.column_file import TablePart
    from hybridlog.columns.tables import TopicTable
    from hybridlog.query.question import Part, RecordedChannel, Span
    from hybridlog.session import Session
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.messages import Batch


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
        usage: Fields that the query names.
        counters: Chunks and payloads that were read.
        groups: Row groups that were read, by file and number.
        recordings: Recordings that were read, by id.
        topics: Topics that were read.
        absent: Messages without fields, by topic and state.
        undefined: Topics without fields, with the reason.
    """

    usage: Usage = EVERYTHING
    counters: Counters = field(default_factory=Counters)
    groups: set[tuple[Path, int]] = field(default_factory=set)
    recordings: dict[str, RecordingEntry] = field(default_factory=dict)
    topics: set[str] = field(default_factory=set)
    absent: Counter[tuple[str, State]] = field(default_factory=Counter)
    undefined: dict[str, str] = field(default_factory=dict)
    error: Exception | None = None


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
        used = [leaf for path, leaf in leaves if reading.usage.uses(path)]
        self._keys = {leaf.key for leaf in used}
        self._paths = _paths_of(used)
        self._has_points = any(leaf.is_points for leaf in used)
        self._arrays = [leaf.source for leaf in used if is_array(leaf.kind) and not leaf.is_summary]

    def read(self, part: Part) -> Iterator[pa.RecordBatch]:
        """The rows of a topic of a recording."""
        found = self.tabled(part)
        if found is not None and self._has_all(found.table, part):
            for group in found.table.parts:
                if touches(part.log_windows, group.first, group.last):
                    yield from self._in_group(part, found.table, group)
            return
        for run in ChunkScan(self.chunk_plan([part]), self.session).runs():
            for number, rows in rows_by_channel(run.batch.channel):
                yield self._decoded(run.channels[number], run.batch.take(rows), run.seq[rows])

    def _has_all(self, table: TopicTable, part: Part) -> bool:
        """True if a table has what is asked for: whole arrays, points, and the states of now."""
        asks_states = not {"state", "error"}.isdisjoint(self._schema.names)
        return not (
            any(map(table.is_cut, self._arrays))
            or (self._has_points and table.points is None)
            or (asks_states and any(channel.is_reduced for channel in part.channels))
        )

    def _in_group(
        self, part: Part, table: TopicTable, group: TablePart
    ) -> Iterator[pa.RecordBatch]:
        """The rows of a row group, which are whole as far as they are asked for."""
        self._reading.groups.add((group.file.path, group.group))
        names = {"t", *_TABLE_OWN.intersection(self._schema.names), *[POINTS] * self._has_points}
        try:
            own, columns = table.columns(group, self._paths, names)
        except StoreError as error:
            self.session.tables.reject(part.recording, part.topic)
            raise ChangedError(f"{error} Ask again: messages answer then.") from error
        if self._has_points:
            fields = [*columns.type, pa.field(POINTS, own[POINTS].type)]
            columns = pa.StructArray.from_arrays([*columns.flatten(), own[POINTS]], fields=fields)
        if not part.is_unbounded:
            rows = pa.array(np.flatnonzero(inside(own["t"].to_numpy(), part.log_windows)))
            own = {name: column.take(rows) for name, column in own.items()}
            columns = columns.take(rows)
        own["state"] = pa.repeat(pa.scalar(str(State.WHOLE)), len(columns))
        own["error"] = pa.nulls(len(columns), pa.string())
        if len(columns):
            yield self._batch(part.recording, own, columns)

    def _decoded(
        self, channel: RecordedChannel, batch: Batch, seq: NDArray[np.int64]
    ) -> pa.RecordBatch:
        """The rows of messages of one channel."""
        count, errors = len(batch), np.full(len(batch), None, object)
        columns, paths = pa.nulls(count, pa.struct([])), self._paths
        if channel.codec.indexed:
            if paths is not None:
                paths = [*paths, STAMP, *(NEEDED if self._has_points else ())]
            decoded = channel.codec.columns_of(batch, paths)
            self.counters.payload_bytes += batch.payload_bytes * (not channel.is_reduced)
            for bad in decoded.unreadable:
                errors[bad.rows] = bad.reason
            if len(decoded.rows):
                found = columns_in(decoded, has_points=self._has_points)
                columns = without(found, decoded.rows, count)
        stamp, error = stamp_array(columns), pa.array(errors, pa.string())
        has_no_time = np.full(count, not channel.channel.has_publish_time)
        topic, unreadable = channel.channel.topic, count - error.null_count
        if unreadable:
            self._reading.absent[topic, State.UNREADABLE] += unreadable
        if channel.is_reduced and (self._arrays or self._has_points):
            self._reading.absent[topic, channel.state] += count - unreadable
        own = {
            "t": pa.array(batch.log_time),
            "seq": pa.array(seq),
            "pub": pa.array(batch.publish_time, mask=has_no_time),
            "stamp": pa.nulls(count, pa.int64()) if stamp is None else stamp.view(pa.int64()),
            "state": pc.if_else(error.is_null(), str(channel.state), State.UNREADABLE.value),
            "error": error,
        }
        return self._batch(channel.recording, own, columns)

    def _batch(
        self, recording: RecordingEntry, own: Mapping[str, Any], columns: Any
    ) -> pa.RecordBatch:
        """The columns of some rows; those of fields that are not used are null."""
        records, arrays, rows = records_of(columns), [], len(columns)
        for name, kind in zip(self._schema.names, self._schema.types, strict=True):
            if name in self._fields:
                arrays.append(self._fields[name].values(records, columns, self._keys))
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


_TABLE_OWN: Final = frozenset({"seq", "pub", "stamp"})


def columns_in(decoded: Any, *, has_points: bool = False) -> Any:
    """The fields of decoded messages, perhaps with points; of those without payload, columns."""
    if isinstance(decoded.records, LeftFields):
        return decoded.records.columns
    found = decoded.arrow()
    return PointColumns().with_points(found, found) if has_points else found


def _paths_of(leaves: Sequence[ViewColumn]) -> list[str] | None:
    """Dotted paths of fields; None for all, for which a name with a dot of its own stands, too."""
    known = [leaf for leaf in leaves if not leaf.is_points]
    if any("." in name or "[" in name for leaf in known for name in leaf.source):
        return None
    return [*dict.fromkeys(".".join(leaf.source) for leaf in known)]
