"""Rows of a topic for SQL: from tables, from chunks where there are none, in the columns of a view.

Tables may have only summaries of long arrays. Arrays that are asked for then come from the
payloads of the rows that need them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from msgspec import Struct, field
from pyarrow import acero

from hybridlog.columns.column_file import FIRST
from hybridlog.columns.fields import records_of
from hybridlog.columns.layout import POINTS
from hybridlog.columns.left_rows import LeftFields
from hybridlog.columns.rows import NEEDED, PointColumns, is_cloud, rows_of
from hybridlog.query.question import Counters, RecordedChannel
from hybridlog.query.rows import offsets_by_chunk, places_of
from hybridlog.schema.arrow_types import has_empty, is_array
from hybridlog.schema.states import GONE, State
from hybridlog.sql.columns import OWN, ViewColumn, points_column
from hybridlog.sql.names import EVERYTHING, Usage
from hybridlog_storage.cache import lazy
from hybridlog_storage.errors import ChangedError, StoreError
from hybridlog_storage.messages import EXPIRED_IDS
from hybridlog_storage.segments.chunk import Placed
from hybridlog_storage.times import BEGIN, END

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from hybridlog.columns.column_file import TablePart
    from hybridlog.columns.tables import TopicTable
    from hybridlog.query.chunk_columns import Chunk
    from hybridlog.query.question import Span
    from hybridlog.schema.codec import Decoded
    from hybridlog.session import Session
    from hybridlog_storage.catalog import RecordingEntry

    Mask = NDArray[np.bool_]

_FIXED: Final = frozenset({"ros1", "cdr"})
"""Encodings whose definition fixes the fields."""
_TABLE_OWN: Final = frozenset({"log_time", "t", "seq", "pub", "stamp", "state", "error"})
Bounds: TypeAlias = "Mapping[str, tuple[NDArray[Any], NDArray[Any]]]"
"""Least and greatest values in parts of a view, by column."""


class Filter(NamedTuple):
    """The rows that a query asks for.

    Attributes:
        expression: Of pyarrow; None for all rows.
        paths: Names of columns, and of fields in them, that it tests.
        may_hold: Tells which of some parts may have such rows.
    """

    expression: Any
    paths: Collection[tuple[str, ...]]
    may_hold: Callable[[Bounds], Mask]


class Rows(NamedTuple):
    """Some messages of a topic.

    Attributes:
        own: Columns of the table itself, by name; with `state` unless all are whole.
        columns: Fields as tables have them, a struct each.
    """

    own: Mapping[str, Any]
    columns: Any

    def take(self, chosen: Mask) -> Rows:
        """The chosen rows."""
        if chosen.all():
            return self
        places = pa.array(np.flatnonzero(chosen))
        own = {name: column.take(places) for name, column in self.own.items()}
        return Rows(own, self.columns.take(places))


class Source(NamedTuple):
    """Rows that are read together: a row group of a table, or those of a chunk.

    Attributes:
        span: Least and greatest log time, ns; None if unknown.
    """

    span: Span | None
    part: TablePart | None = None
    chunk: Chunk | None = None


class TopicOfRecording:
    """A topic of one recording."""

    def __init__(self, session: Session, entry: RecordingEntry, topic: str) -> None:
        self.session = session
        self.entry = entry
        self.topic = topic

    @lazy
    def channels(self) -> dict[int, RecordedChannel]:
        """Channels of the topic, by id."""
        found = self.session.channels_of(self.entry, [self.topic])
        return {channel.channel_id: channel for channel in found}

    @property
    def messages(self) -> int:
        """Number of its messages."""
        return sum(channel.stats.messages for channel in self.channels.values())

    @property
    def is_fixed(self) -> bool:
        """True if definitions fix the fields of all messages."""
        return all(
            channel.codec.reason is not None
            or channel.encoding in _FIXED
            # The keys of a map of protobuf are fields, which no definition knows.
            or (channel.encoding == "protobuf" and not has_empty(channel.arrow_type()))
            for channel in self.channels.values()
        )

    @lazy
    def kinds(self) -> list[Any]:
        """Types of its messages."""
        if self.is_fixed:
            known = self.channels.values()
            return [channel.arrow_type() for channel in known if channel.codec.indexed]
        found = [] if self.table is None else self.table.whole_types()
        chunks = (source.chunk for source in self.sources)
        rows = (one for chunk in chunks if chunk for one in self.in_chunk(chunk, Asked()))
        return [*found, *(records_of(one.columns).type for one in rows)]

    @lazy
    def table(self) -> TopicTable | None:
        """Its table, of all segments or of some; None without one."""
        return self.session.table(self.entry, self.topic)

    @lazy
    def sources(self) -> list[Source]:
        """Its rows, in parts, by log time."""
        found, covered = [], frozenset[int]()
        if self.table is not None:
            covered = self.table.segments
            for part in self.table.parts:
                span = (part.first, part.last) if part.first > FIRST else None
                found.append(Source(span, part=part))
        if self.table is None or self.table.rows < self.messages:
            chunks = (one for one in self.chunks.values() if one.segment not in covered)
            found += [Source((one.first, one.last), chunk=one) for one in chunks]
        return sorted(found, key=lambda one: (one.span or (BEGIN, BEGIN))[0])

    @lazy
    def chunks(self) -> dict[tuple[int, int], Chunk]:
        """All of its chunks, by segment and number."""
        found = self.session.chunks(self.entry, [*self.channels], None, "log")
        return {(one.segment, one.number): one for one in found}

    @lazy
    def _expired(self) -> dict[State, set[int]]:
        """Segments whose payloads are gone, by state."""
        found: dict[State, set[int]] = {}
        for one in self.chunks.values():
            if one.place.is_expired:
                state = GONE[one.place.channels[0] // EXPIRED_IDS - 1]
                found.setdefault(state, set()).add(one.segment)
        return found

    def points(self) -> Any:
        """Type of the points of its clouds, of the first that can be read; None without any."""
        if self.table is not None and self.table.points is not None:
            return self.table.points
        if any(is_cloud(channel.channel) for channel in self.channels.values()):
            for chunk in self.chunks.values():
                with suppress(StoreError):
                    for rows in self.in_chunk(chunk, Asked([points_column(pa.null())])):
                        if POINTS in rows.columns.type.names:
                            return rows.columns.type.field(POINTS).type
        return None

    def lacks(self, asked: Asked) -> bool:
        """True if its table has only summaries of an array that is asked for, in some row."""
        table = self.table
        assert table is not None
        lacks_points = asked.has_points and table.points is None
        return lacks_points or any(table.is_cut(one.source) for one in asked.arrays)

    def in_table(self, part: TablePart, asked: Asked) -> Rows:
        """The rows of a row group."""
        table = self.table
        assert table is not None
        is_reduced = any(channel.state is State.REDUCED for channel in self.channels.values())
        has_states = bool(table.unreadable or self._expired or is_reduced)
        wanted = {*asked.own, *({"state", "ref"} if has_states else ())}
        wanted |= {"ref"} if asked.has_arrays else set()
        paths = paths_of(asked.leaves)
        try:
            own, columns = table.columns(part, paths, wanted | {*[POINTS] * asked.has_points})
        except StoreError as error:
            self.session.tables.reject(self.entry, self.topic)
            raise ChangedError(f"{error} Ask again: messages answer then.") from error
        if has_states:
            own["state"] = self._states(own["state"], own["ref"].field("seg"))
        points = own.pop(POINTS, None)
        if table.points is not None and points is not None:
            fields = [*columns.type, pa.field(POINTS, points.type)]
            columns = pa.StructArray.from_arrays([*columns.flatten(), points], fields=fields)
        return Rows(own, columns)

    def _states(self, states: Any, segment: Any) -> Any:
        """States as they are now: payloads may have gone, or come, since the rows were made."""
        was_gone = pc.is_in(states, pa.array([*map(str, GONE)]))
        states = pc.if_else(was_gone, State.WHOLE.value, states)
        for state, gone in self._expired.items():
            is_gone = pc.is_in(segment, pa.array([*gone], segment.type))
            is_gone = pc.and_(is_gone, pc.equal(states, State.WHOLE.value))
            states = pc.if_else(is_gone, state.value, states)
        return states

    def in_chunk(
        self, one: Chunk, asked: Asked, offsets: NDArray[np.int64] | None = None
    ) -> Iterator[Rows]:
        """The messages in a chunk, or those of them at some offsets."""
        counters = asked.counters
        chunk = self.session.chunk(self.entry, one.segment, one.place, counters.add_chunk)
        chosen = np.ones(len(chunk.batch), np.bool_)
        if offsets is not None:
            chosen = np.isin(chunk.batch.places[0], offsets)
        paths = paths_of(asked.leaves)
        if paths is not None:
            paths += ["header.stamp", *(NEEDED if asked.has_points else ())]

        def columns_of(decoded: Decoded) -> Any:
            if isinstance(decoded.records, LeftFields):
                return decoded.records.columns
            found = decoded.arrow()
            return PointColumns().with_points(found, found) if asked.has_points else found

        for number in one.place.channels:
            channel = self.channels.get(number)
            rows = np.flatnonzero(chosen & (chunk.batch.channel == number))
            if channel is None or not len(rows):
                continue
            placed = Placed.of([chunk]).take(rows)
            decoded = None
            if channel.codec.indexed:
                decoded = channel.codec.columns_of(placed.batch, paths)
                counters.payload_bytes += placed.batch.payload_bytes * (not channel.is_reduced)
            has_times = channel.channel.has_publish_time
            own, fields = rows_of(
                placed, decoded, channel.state, has_publish_time=has_times, columns=columns_of
            )
            yield Rows(own, fields)


class Asked:
    """The fields and the columns of our own that a query asks for.

    Without `leaves`, all fields.
    """

    def __init__(
        self,
        leaves: Sequence[ViewColumn] | None = None,
        own: Collection[str] = (),
        counters: Counters | None = None,
    ) -> None:
        self.leaves = leaves
        self.own = {*own}
        self.counters = counters or Counters()
        known = leaves or ()
        self.keys = {one.key for one in known}
        self.arrays = [one for one in known if is_array(one.kind) and not one.is_summary]
        self.has_points = any(one.is_points for one in known)
        self.has_arrays = self.has_points or bool(self.arrays)


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

    def add(self, recording: TopicOfRecording) -> None:
        """Note a topic of a recording that is read."""
        self.recordings[recording.entry.id] = recording.entry
        self.topics.add(recording.topic)
        for channel in recording.channels.values():
            if channel.codec.reason is not None:
                self.undefined[recording.topic] = channel.codec.reason

    def remark(self, topic: str, rows: Rows, *, is_cut: bool) -> None:
        """Count rows without fields, or, if any `is_cut`, without payload for their arrays."""
        states = rows.own.get("state")
        for found in () if states is None else pc.value_counts(states).to_pylist():
            state = State(found["values"])
            if state is State.UNREADABLE or (is_cut and state is not State.WHOLE):
                self.absent[topic, state] += found["counts"]


class Plan:
    """Reads some columns of a topic, of the rows for which a filter holds."""

    def __init__(
        self,
        schema: Any,
        fields: Mapping[str, ViewColumn],
        columns: Sequence[str],
        where: Filter,
        reading: Reading,
    ) -> None:
        self._schema = schema
        self._columns = columns
        self._tested = [*dict.fromkeys(path[0] for path in where.paths)]
        self._where = where.expression
        self._reading = reading
        read = dict.fromkeys([*columns, *self._tested])
        self._fields = {name: fields[name] for name in read if name in fields}
        leaves = (leaf for column in self._fields.values() for leaf in column.leaves())
        used = [(path, leaf) for path, leaf in leaves if reading.usage.uses(path)]
        own = {"t", *(name for name in read if name in _TABLE_OWN)}
        self._asked = Asked([leaf for _, leaf in used], own, reading.counters)
        self._tests_arrays = any(
            all(one == name.casefold() for one, name in zip(path, tested, strict=False))
            for path, leaf in used
            if leaf.is_points or leaf in self._asked.arrays
            for tested in where.paths
        )

    def read(
        self, recording: TopicOfRecording, source: Source, window: Span | None
    ) -> Iterator[pa.RecordBatch]:
        """The rows of a source in a range of log time, ns; None for all times."""
        asked, reading = self._asked, self._reading
        if source.chunk is not None:
            for rows in recording.in_chunk(source.chunk, asked):
                reading.remark(recording.topic, rows, is_cut=asked.has_arrays)
                yield from self._finished(recording, rows, self._holds(recording, rows, window))
        elif source.part is not None:
            reading.groups.add((source.part.file.path, source.part.group))
            rows, is_cut = recording.in_table(source.part, asked), recording.lacks(asked)
            reading.remark(recording.topic, rows, is_cut=is_cut)
            holds = self._holds(recording, rows, window)
            # Payloads are decoded only of rows for which all else holds.
            left = np.full(len(rows.columns), is_cut)
            if is_cut and "state" in rows.own:
                states = pc.equal(rows.own["state"], State.WHOLE.value)
                left = states.to_numpy(zero_copy_only=False)
            yield from self._finished(recording, rows, holds & ~left)
            left = left if self._tests_arrays else left & holds
            if left.any():
                yield from self._decoded(recording, places_of(rows.own["ref"])[left], window)

    def _decoded(
        self, recording: TopicOfRecording, places: NDArray[np.int64], window: Span | None
    ) -> Iterator[pa.RecordBatch]:
        """The rows at some places, from their payloads."""
        for (_, *chunk), offsets in offsets_by_chunk(recording.entry.id, places).items():
            one = recording.chunks[chunk[0], chunk[1]]
            for rows in recording.in_chunk(one, self._asked, offsets):
                yield from self._finished(recording, rows, self._holds(recording, rows, window))

    def _holds(self, recording: TopicOfRecording, rows: Rows, window: Span | None) -> Mask:
        """Mask of the rows in a range of log time for which the filter holds."""
        holds = np.ones(len(rows.columns), np.bool_)
        if window is not None:
            t = rows.own["t"].to_numpy()
            holds = (t >= window[0]) & ((t < window[1]) | (window[1] >= END))
        if self._where is not None and holds.any():
            holds &= _mask(self._batch(recording, rows, self._tested), self._where)
        return holds

    def _finished(
        self, recording: TopicOfRecording, rows: Rows, chosen: Mask
    ) -> Iterator[pa.RecordBatch]:
        """The chosen rows, with the columns to return."""
        if chosen.any():
            yield self._batch(recording, rows.take(chosen), self._columns)

    def _batch(
        self, recording: TopicOfRecording, rows: Rows, names: Sequence[str]
    ) -> pa.RecordBatch:
        """Columns of some rows; those of fields that are not used are null."""
        count, records = len(rows.columns), records_of(rows.columns)
        schema = pa.schema([self._schema.field(name) for name in names])
        arrays = []
        for name in names:
            if name in self._fields:
                values = self._fields[name].values(records, rows.columns, self._asked.keys)
            elif name in rows.own:
                values = rows.own[name].cast(schema.field(name).type)
            else:
                values = _constant(name, recording.entry, count)
            arrays.append(values)
        return pa.RecordBatch.from_arrays(arrays, schema=schema)


def _mask(batch: pa.RecordBatch, where: Any) -> Mask:
    """For each row, whether an expression holds; false where it is null."""
    options = acero.ProjectNodeOptions([where], ["holds"])
    source = acero.TableSourceNodeOptions(pa.Table.from_batches([batch]))
    plan = acero.Declaration.from_sequence(
        [acero.Declaration("table_source", source), acero.Declaration("project", options)]
    )
    found = plan.to_table(use_threads=False).column(0).fill_null(False)
    return found.to_numpy()  # type: ignore[no-any-return]


def paths_of(leaves: Iterable[ViewColumn] | None) -> list[str] | None:
    """Dotted paths of fields; None for all, for which a name with a dot of its own stands, too."""
    if leaves is None or any("." in n or "[" in n for leaf in leaves for n in leaf.source):
        return None
    return [*dict.fromkeys(".".join(leaf.source) for leaf in leaves if not leaf.is_points)]


def _constant(name: str, entry: RecordingEntry, rows: int) -> Any:
    """A column with the same value for all rows of a recording."""
    if name == "recording":
        return pa.repeat(pa.scalar(entry.name), rows)
    tags = pa.array([list(entry.tags.items())], OWN.field("tags").type)
    return tags.take(pa.array(np.zeros(rows, np.int64)))
