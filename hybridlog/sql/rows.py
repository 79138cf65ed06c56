"""Rows of a topic in one recording for a query: from its table, or from its chunks.

A topic of an ended recording has a table. Where that is missing or damaged, or there can be none,
and for what a running recording has flushed, chunks are decoded instead, into the same columns.
Arrays that a table only summarises come from the chunks of the rows that need them.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import acero

from hybridlog.columns.clouds import NEEDED, PointColumns, is_cloud
from hybridlog.columns.column_file import FIRST
from hybridlog.columns.fields import without
from hybridlog.columns.layout import POINTS
from hybridlog.columns.rows import piece_of
from hybridlog.query.question import Counters, RecordedChannel
from hybridlog.query.rows import offsets_by_chunk, places_of
from hybridlog.record.losses import lost_spans
from hybridlog.schema.arrow_columns import structs
from hybridlog.schema.arrow_types import has_empty
from hybridlog.schema.left import LeftFields
from hybridlog.schema.states import GONE, State
from hybridlog.sql.columns import OWN, Key, ViewColumn, lacks, whole_message
from hybridlog.sql.usage import EVERYTHING, Usage
from hybridlog_storage.errors import ChangedError, StoreError
from hybridlog_storage.lazy import lazy
from hybridlog_storage.messages import EXPIRED_IDS
from hybridlog_storage.segments.chunk import Placed

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from hybridlog.columns.column_file import TablePart
    from hybridlog.columns.topic_table import TopicTable
    from hybridlog.query.question import Span
    from hybridlog.session import Session
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.segments.chunk_table import ChunkPlace

_FIXED: Final = frozenset({"ros1", "cdr"})
"""Encodings whose definition fixes the fields."""
_TABLE_OWN: Final = frozenset({"log_time", "t", "seq", "pub", "stamp", "state", "error"})
_WORD: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


class Rows(NamedTuple):
    """Some messages of a topic.

    Attributes:
        own: Columns of the table itself, by name; with `state` unless all are whole.
        records: Fields of the messages; of a table, arrays may be summaries.
        summaries: The same, of messages without payload with summaries of arrays.
    """

    own: Mapping[str, Any]
    records: Any
    summaries: Any
    size: int

    def where(self, chosen: NDArray[np.bool_]) -> Rows:
        """The rows that are chosen."""
        places = pa.array(np.flatnonzero(chosen))
        own = {name: column.take(places) for name, column in self.own.items()}
        records, summaries = self.records.take(places), self.summaries.take(places)
        return Rows(own, records, summaries, len(places))


class Source(NamedTuple):
    """Rows that are read together: a row group of a table, or those of a chunk.

    Attributes:
        span: Least and greatest log time, ns; None if unknown.
    """

    span: Span | None
    table: TopicTable | None = None
    part: TablePart | None = None
    chunk: tuple[int, int] = (0, 0)


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
        found: list[Any] = []
        for source in self.sources:
            if source.table is not None:
                found.append(whole_message(self._types(source.table, None)))
            else:
                rows = self.in_chunk(source.chunk, None, (), Counters())
                found += [one.records.type for one in rows]
        return found

    @lazy
    def table(self) -> TopicTable | None:
        """Its table; None if it can have none."""
        if any(True for _ in lost_spans(self.entry)):
            return None  # rows of lost messages must not answer
        return self.session.table(self.entry, self.topic)

    @lazy
    def sources(self) -> list[Source]:
        """Its rows, in parts, by log time."""
        table, covered = self.table, frozenset[int]()
        chunks = [] if table else self.session.chunks(self.entry, [*self.channels], None, "log")
        if table is None and self.entry.flushed:
            messages = Counter[int]()
            for chunk in chunks:
                messages[chunk.segment] += chunk.messages
            made = self.session.tables.of_sealed(self.entry, self.topic, messages)
            table, covered = made or (None, covered)
        found = [
            Source((one.first, one.last), chunk=(one.segment, one.number))
            for one in chunks
            if one.segment not in covered
        ]
        for part in table.parts if table is not None else ():
            span = (part.first, part.last) if part.first > FIRST else None
            found.append(Source(span, table, part))
        return sorted(found, key=lambda one: (one.span is not None, (one.span or (0, 0))[0]))

    @lazy
    def _places(self) -> dict[tuple[int, int], ChunkPlace]:
        """Positions of its chunks, by segment and number."""
        chunks = self.session.chunks(self.entry, [*self.channels], None, "log")
        return {(chunk.segment, chunk.number): chunk.place for chunk in chunks}

    @lazy
    def _expired(self) -> dict[State, set[int]]:
        """Segments whose payloads are gone, by state."""
        found: dict[State, set[int]] = {}
        for (segment, _), place in self._places.items():
            if place.is_expired:
                state = GONE[place.channels[0] // EXPIRED_IDS - 1]
                found.setdefault(state, set()).add(segment)
        return found

    def points(self) -> Any:
        """Type of the points of its clouds, of the first that can be read; None without any."""
        if self.table is not None and self.table.points is not None:
            return self.table.points
        if any(is_cloud(channel.channel) for channel in self.channels.values()):
            for chunk in self._places:
                with suppress(StoreError):
                    for rows in self.in_chunk(chunk, (), {POINTS}, Counters()):
                        if POINTS in rows.own:
                            return rows.own[POINTS].type
        return None

    def lacks(self, table: TopicTable, leaf: ViewColumn) -> bool:
        """True if a table has only summaries of an array."""
        if leaf.is_points:
            return table.points is None
        if leaf.is_summary:
            return False
        kind = self._types(table, paths_of([leaf]))
        for name in leaf.source:
            place = kind.get_field_index(name) if pa.types.is_struct(kind) else -1
            if place < 0:
                return False
            kind = kind.field(place).type
        return lacks(kind, leaf.kind)

    def _types(self, table: TopicTable, paths: Collection[str] | None) -> Any:
        try:
            return table.fields(paths)
        except StoreError as error:
            raise self._damaged(error) from error

    def _damaged(self, error: StoreError) -> StoreError:
        self.session.tables.reject(self.entry, self.topic)
        return ChangedError(f"{error} Ask again: messages answer then.")

    def in_table(
        self, table: TopicTable, part: TablePart, leaves: Sequence[ViewColumn], own: Collection[str]
    ) -> Rows:
        """The rows of a row group, with some fields."""
        is_reduced = any(channel.state is State.REDUCED for channel in self.channels.values())
        has_states = bool(table.unreadable or self._expired or is_reduced)
        wanted = {*own, *({"state", "ref"} if has_states else ())}
        wanted |= {POINTS for leaf in leaves if leaf.is_points}
        paths = paths_of(leaves, summaries=table.has_arrays)
        try:
            ours, records = table.read(part, paths, wanted)
        except StoreError as error:
            raise self._damaged(error) from error
        if has_states:
            states, segment = ours["state"], ours["ref"].field("seg")
            # Payloads may have gone, or come, since the rows were made.
            was_gone = pc.is_in(states, pa.array([*map(str, GONE)]))
            states = pc.if_else(was_gone, State.WHOLE.value, states)
            for state, gone in self._expired.items():
                is_gone = pc.is_in(segment, pa.array([*gone], segment.type))
                is_gone = pc.and_(is_gone, pc.equal(states, State.WHOLE.value))
                states = pc.if_else(is_gone, state.value, states)
            ours["state"] = states
        return Rows(ours, records, records, part.rows)

    def in_chunk(
        self,
        key: tuple[int, int],
        paths: Collection[str] | None,
        own: Collection[str],
        counters: Counters,
        offsets: NDArray[np.int64] | None = None,
    ) -> Iterator[Rows]:
        """The messages in a chunk, by segment and number; of those at some offsets."""
        place = self._places[key]
        chunk = self.session.chunk(self.entry, key[0], place, counters.add_chunk)
        chosen = np.ones(len(chunk.batch), np.bool_)
        if offsets is not None:
            chosen = np.isin(chunk.batch.places[0], offsets)
        wanted = None if paths is None else {*paths, "header.stamp"}
        if wanted is not None and POINTS in own:
            wanted.update(NEEDED)
        for number in place.channels:
            channel = self.channels.get(number)
            rows = np.flatnonzero(chosen & (chunk.batch.channel == number))
            if channel is None or not len(rows):
                continue
            placed = Placed.of([chunk]).take(rows)
            if channel.codec.indexed and not channel.is_reduced:
                counters.payload_bytes += placed.batch.payload_bytes
            decoded = None
            if channel.codec.indexed:
                decoded = channel.codec.columns_of(placed.batch, wanted)
            piece = piece_of(
                placed,
                decoded,
                channel.state,
                has_publish_time=channel.channel.has_publish_time,
                columns=lambda one: one.arrow(),
            )
            records = piece.fields_as(pa.struct([]))
            summaries, ours = records, dict(piece.own)
            if decoded is not None and isinstance(decoded.records, LeftFields):
                summaries = without(decoded.records.summarised(), decoded.rows, len(rows))
            elif decoded is not None and POINTS in own:
                points = PointColumns().points(decoded.arrow())
                ours[POINTS] = without(points, decoded.rows, len(rows))
            yield Rows(ours, records, summaries, len(rows))


@dataclass(slots=True)
class Reading:
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

    def remark(self, topic: str, rows: Rows, *, asks_arrays: bool) -> None:
        """Count rows without fields, or without arrays that are asked for."""
        for found in pc.value_counts(rows.own["state"]).to_pylist() if "state" in rows.own else ():
            state = State(found["values"])
            if state is State.UNREADABLE or (asks_arrays and state is not State.WHOLE):
                self.absent[topic, state] += found["counts"]


class Plan:
    """Reads some columns of a topic, where the expression `where` holds (None for all rows)."""

    def __init__(
        self,
        schema: Any,
        fields: Mapping[str, ViewColumn],
        columns: Sequence[str],
        where: Any,
        reading: Reading,
    ) -> None:
        self._where = where
        self._reading = reading
        self._columns = list(columns)
        self._schema = schema
        self._tested = [] if where is None else _named(str(where), schema.names)
        read = dict.fromkeys([*self._columns, *self._tested])
        self._fields = {name: fields[name] for name in read if name in fields}
        leaves = (leaf for column in self._fields.values() for leaf in column.leaves())
        self._leaves = [leaf for path, leaf in leaves if reading.usage.uses(path)]
        self._own = {name for name in read if name in _TABLE_OWN}

    def read(self, recording: TopicOfRecording, source: Source) -> Iterator[pa.RecordBatch]:
        """The rows of a source."""
        if source.table is None or source.part is None:
            yield from self._decoded(recording, source.chunk, self._where)
            return
        self._reading.groups.add((source.part.file.path, source.part.group))
        lacking = [one for one in self._leaves if recording.lacks(source.table, one)]
        absent = {one.key for one in lacking}
        # The summary of a nested array tells where the struct above it is missing.
        held = [one for one in self._leaves if one.key not in absent or len(one.source) > 1]
        own = self._own | ({"ref"} if absent else set())
        rows = recording.in_table(source.table, source.part, held, own)
        self._reading.remark(recording.topic, rows, asks_arrays=bool(absent))
        if not absent:
            yield from self._finished(recording, rows, self._where)
            return
        # Of payloads, as few as possible are decoded.
        where, chosen = self._where, np.ones(rows.size, np.bool_)
        if where is not None and not _named(str(where), [one.name for one in lacking]):
            chosen = _mask(self._batch(recording, rows, self._tested, absent), where)
            where = None
        is_whole = chosen
        if "state" in rows.own:
            states = pc.equal(rows.own["state"], State.WHOLE.value)
            is_whole = chosen & states.to_numpy(zero_copy_only=False)
            if (gone := chosen & ~is_whole).any():
                yield from self._finished(recording, rows.where(gone), where, absent)
        places = offsets_by_chunk(recording.entry.id, places_of(rows.own["ref"])[is_whole])
        for (_, segment, chunk), offsets in places.items():
            yield from self._decoded(recording, (segment, chunk), where, offsets)

    def _decoded(
        self,
        recording: TopicOfRecording,
        chunk: tuple[int, int],
        where: Any,
        offsets: NDArray[np.int64] | None = None,
    ) -> Iterator[pa.RecordBatch]:
        """The rows of a chunk, or those at some offsets of it, which are noted already."""
        own = {POINTS for leaf in self._leaves if leaf.is_points}
        paths, asks_arrays = paths_of(self._leaves), any(leaf.is_array for leaf in self._leaves)
        for rows in recording.in_chunk(chunk, paths, own, self._reading.counters, offsets):
            if offsets is None:
                self._reading.remark(recording.topic, rows, asks_arrays=asks_arrays)
            yield from self._finished(recording, rows, where)

    def _finished(
        self,
        recording: TopicOfRecording,
        rows: Rows,
        where: Any,
        absent: Collection[Key] = (),
    ) -> Iterator[pa.RecordBatch]:
        """Rows for which an expression holds, with the columns to return."""
        if where is not None:
            mask = _mask(self._batch(recording, rows, self._tested, absent), where)
            rows = rows if mask.all() else rows.where(mask)
        if rows.size:
            yield self._batch(recording, rows, self._columns, absent)

    def _batch(
        self,
        recording: TopicOfRecording,
        rows: Rows,
        names: Sequence[str],
        absent: Collection[Key],
    ) -> pa.RecordBatch:
        """Columns of some rows; those of absent fields are null."""
        known = {leaf.key for leaf in self._leaves}.difference(absent)
        arrays = []
        schema = pa.schema([self._schema.field(name) for name in names])
        for name in names:
            if name in self._fields:
                column = self._fields[name]
                records = rows.records
                if column.is_points:
                    records = structs({n: a for n, a in rows.own.items() if n == POINTS}, rows.size)
                arrays.append(column.values(records, rows.summaries, known, rows.size))
            elif name in rows.own:
                arrays.append(rows.own[name].cast(schema.field(name).type))
            else:
                arrays.append(_constant(name, recording.entry, rows.size))
        return pa.RecordBatch.from_arrays(arrays, schema=schema)


def _mask(batch: pa.RecordBatch, where: Any) -> NDArray[np.bool_]:
    """For each row, whether an expression holds; false where it is null."""
    options = acero.ProjectNodeOptions([where], ["holds"])
    source = acero.TableSourceNodeOptions(pa.Table.from_batches([batch]))
    plan = acero.Declaration.from_sequence(
        [acero.Declaration("table_source", source), acero.Declaration("project", options)]
    )
    found = plan.to_table(use_threads=False).column(0).fill_null(False)
    return found.to_numpy()  # type: ignore[no-any-return]


def _named(text: str, names: Sequence[str]) -> list[str]:
    """Names of columns that may be in the text of an expression; some of them are not."""
    words = set(_WORD.findall(text))
    return [name for name in names if name in words or not _WORD.fullmatch(name)]


def paths_of(leaves: Collection[ViewColumn], *, summaries: bool = False) -> list[str] | None:
    """Dotted paths of fields, or of numbers of their summaries; None if a name has a dot itself."""
    if any("." in name or "[" in name for leaf in leaves for name in leaf.source):
        return None
    found: dict[str, None] = {}
    for leaf in leaves:
        path = ".".join(leaf.source)
        if summaries and leaf.is_summary:
            found |= dict.fromkeys(f"{path}.{field.name}" for field in leaf.kind)
        elif not leaf.is_points:
            found[path] = None
    return list(found)


def _constant(name: str, entry: RecordingEntry, rows: int) -> Any:
    """A column with the same value for all rows of a recording."""
    if name == "recording":
        return pa.repeat(pa.scalar(entry.name), rows)
    tags = pa.array([list(entry.tags.items())], OWN.field("tags").type)
    return tags.take(pa.array(np.zeros(rows, np.int64)))
