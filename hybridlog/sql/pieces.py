"""Rows of a topic in one recording: from its table, or from its chunks.

A topic of an ended recording has a table, which is made again if it is missing. Where it can
have none, and for what a running recording has flushed, chunks are decoded instead, into the
same columns.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from hybridlog.columns.clouds import NEEDED, PointColumns, is_cloud
from hybridlog.columns.column_file import FIRST
from hybridlog.columns.fields import without
from hybridlog.columns.layout import POINTS
from hybridlog.columns.rows import piece_of
from hybridlog.query.question import Counters, RecordedChannel
from hybridlog.record.losses import lost_spans
from hybridlog.schema.arrow_types import has_empty
from hybridlog.schema.left import LeftFields
from hybridlog.schema.states import GONE, State
from hybridlog.sql.columns import whole_message
from hybridlog_storage.errors import ChangedError, StoreError
from hybridlog_storage.lazy import lazy
from hybridlog_storage.messages import EXPIRED_IDS
from hybridlog_storage.segments.chunk import Placed

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.columns.column_file import TablePart
    from hybridlog.columns.topic_table import TopicTable
    from hybridlog.query.question import Span
    from hybridlog.schema.codec import Decoded
    from hybridlog.session import Session
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.segments.chunk import StoredChunk
    from hybridlog_storage.segments.segment_reader import ChunkPlace

_FIXED: Final = frozenset({"ros1", "cdr"})
"""Encodings whose definition fixes the fields."""

Paths = Collection[str] | None
"""Dotted paths of fields to read; None for all."""


class Rows(NamedTuple):
    """Some messages of a topic.

    Attributes:
        own: Columns of the table itself, by name; with `state` unless all are whole.
        records: Fields of the messages; arrays may be summaries.
    """

    own: Mapping[str, Any]
    records: Any
    size: int


class TopicOfRecording:
    """A topic of one recording."""

    def __init__(self, session: Session, entry: RecordingEntry, topic: str) -> None:
        self.session = session
        self.entry = entry
        self.topic = topic

    @lazy
    def channels(self) -> dict[int, RecordedChannel]:
        """Channels of the topic, by id."""
        return {
            channel.channel_id: channel
            for channel in self.session.channels_of(self.entry, [self.topic])
        }

    @property
    def is_fixed(self) -> bool:
        """True if definitions fix the fields of all messages."""
        return all(
            channel.codec.reason is not None or _is_fixed(channel)
            for channel in self.channels.values()
        )

    @property
    def has_reduced(self) -> bool:
        """True if it has messages that were dropped under pressure."""
        return any(channel.state is State.REDUCED for channel in self.channels.values())

    @lazy
    def kinds(self) -> list[Any]:
        """Types of its messages."""
        if not self.is_fixed:
            return [
                kind if source.is_whole else whole_message(kind)
                for source in self.sources
                for kind in source.kinds(None)
            ]
        return [channel.arrow_type() for channel in self.channels.values() if channel.codec.indexed]

    @lazy
    def table(self) -> TopicTable | None:
        """Its table; None if it can have none."""
        if any(True for _ in lost_spans(self.entry)):
            return None  # rows of lost messages must not answer
        return self.session.table(self.entry, self.topic)

    @lazy
    def sources(self) -> list[RowSource]:
        """Its rows, in parts, by log time."""
        if self.table is not None:
            return [_TableRows(self, self.table, part) for part in self.table.parts]
        found: list[RowSource] = []
        covered: frozenset[int] = frozenset()
        chunks = self.session.chunks(self.entry, list(self.channels), None, "log")
        if self.entry.flushed:
            messages: dict[int, int] = {}
            for chunk in chunks:
                messages[chunk.segment] = messages.get(chunk.segment, 0) + chunk.messages
            made = self.session.tables.of_sealed(self.entry, self.topic, messages)
            if made is not None:
                table, covered = made
                found += [_TableRows(self, table, part) for part in table.parts]
        for chunk in [one for one in chunks if one.segment not in covered]:
            span = chunk.first, chunk.last
            there = [self.channels[i] for i in chunk.place.channels if i in self.channels]
            for is_reduced in {one.is_reduced for one in there}:
                own = [one for one in there if one.is_reduced is is_reduced]
                found.append(_ChunkRows(self, chunk.segment, chunk.place, span, own))
        return sorted(found, key=lambda one: (one.span is not None, (one.span or (0, 0))[0]))

    @lazy
    def places(self) -> dict[tuple[int, int], ChunkPlace]:
        """Positions of its chunks, by segment and number."""
        chunks = self.session.chunks(self.entry, list(self.channels), None, "log")
        return {(chunk.segment, chunk.number): chunk.place for chunk in chunks}

    @lazy
    def expired(self) -> dict[State, set[int]]:
        """Segments whose payloads are gone, by state."""
        found: dict[State, set[int]] = {}
        for (segment, _), place in self.places.items():
            if place.is_expired:
                state = GONE[place.channels[0] // EXPIRED_IDS - 1]
                found.setdefault(state, set()).add(segment)
        return found

    def first_points(self) -> Any:
        """Type of the points of the first clouds that can be read; None of other messages."""
        if any(is_cloud(channel.channel) for channel in self.channels.values()):
            for source in (one for one in self.sources if one.has_points):
                with suppress(StoreError):
                    for rows in source.read((), {POINTS}, Counters()):
                        return rows.own[POINTS].type
        return None

    def chunk_rows(self, segment: int, number: int) -> _ChunkRows:
        """The messages in a chunk, with all arrays."""
        place = self.places[segment, number]
        whole = [
            one for i, one in self.channels.items() if i in place.channels and not one.is_reduced
        ]
        return _ChunkRows(self, segment, place, (place.first, place.last), whole)

    def chunk(self, segment: int, number: int, counters: Counters) -> StoredChunk:
        """A chunk; see `Session.chunk`."""
        return self.session.chunk(
            self.entry, segment, self.places[segment, number], counters.add_chunk
        )


def _with_expired(states: Any, segment: Any, expired: Mapping[State, set[int]]) -> Any:
    """States of rows, by their segments: payloads may have gone, or come, since they were made."""
    was_gone = pc.is_in(states, pa.array([*map(str, GONE)]))
    states = pc.if_else(was_gone, State.WHOLE.value, states)
    for state, gone in expired.items():
        is_gone = pc.is_in(segment, pa.array([*gone], segment.type))
        is_gone = pc.and_(is_gone, pc.equal(states, State.WHOLE.value))
        states = pc.if_else(is_gone, state.value, states)
    return states


def _is_fixed(channel: RecordedChannel) -> bool:
    """True if the definition of a channel fixes the fields of its messages."""
    encoding = channel.encoding
    # The keys of a map of protobuf are fields, which no definition knows.
    return encoding in _FIXED or (encoding == "protobuf" and not has_empty(channel.arrow_type()))


class _TableRows:
    """A row group of a table.

    Attributes:
        span: Least and greatest log time, ns; None if unknown.
        is_whole: True if it has all arrays; else some may be summaries.
        has_summaries: True if it has summaries of all arrays that it has in full.
        has_points: True if it has the points of clouds.
        groups: The row group, by file and number.
    """

    is_whole = False

    def __init__(self, source: TopicOfRecording, table: TopicTable, part: TablePart) -> None:
        self._source = source
        self._table = table
        self._part = part
        self.span = (part.first, part.last) if part.first > FIRST else None
        self.has_summaries = table.has_arrays
        self.has_points = table.points is not None
        self.groups = {(part.file.path, part.group)}

    def kinds(self, paths: Paths) -> Sequence[Any]:
        """Types of the fields that it holds, at least at some paths."""
        try:
            return [self._table.fields(paths)]
        except StoreError as error:
            raise self._damaged(error) from error

    def _damaged(self, error: StoreError) -> StoreError:
        self._source.session.reject_table(self._source.entry, self._source.topic)
        return ChangedError(f"{error} It is made again when you ask again.")

    def read(self, paths: Paths, own: Collection[str], counters: Counters) -> Iterator[Rows]:
        expired = self._source.expired
        is_whole = not (self._table.unreadable or expired or self._source.has_reduced)
        wanted = {*own} if is_whole else {*own, "state"}
        if "state" in wanted:
            wanted.add("ref")
        try:
            ours, records = self._table.read(self._part, paths, wanted)
        except StoreError as error:
            raise self._damaged(error) from error
        if "state" in wanted:
            ours["state"] = _with_expired(ours["state"], ours["ref"].field("seg"), expired)
        yield Rows(ours, records, self._part.rows)


class _ChunkRows:
    """The messages of a topic in a chunk; the attributes are those of `_TableRows`."""

    has_summaries = False
    groups: Final = frozenset[tuple[Path, int]]()

    def __init__(
        self,
        source: TopicOfRecording,
        segment: int,
        place: ChunkPlace,
        span: Span,
        channels: Sequence[RecordedChannel],
    ) -> None:
        self._channels = channels
        self.is_whole = self.has_points = not channels[0].is_reduced
        self._source = source
        self._segment = segment
        self._place = place
        self.span: Span | None = span

    def kinds(self, paths: Paths) -> Sequence[Any]:
        return self._kinds

    @lazy
    def _kinds(self) -> Sequence[Any]:
        return [rows.records.type for rows in self.read(None, (), Counters())]

    def read(
        self,
        paths: Paths,
        own: Collection[str],
        counters: Counters,
        offsets: NDArray[np.int64] | None = None,
    ) -> Iterator[Rows]:
        chunk = self._source.chunk(self._segment, self._place.number, counters)
        chosen = np.ones(len(chunk.batch), np.bool_)
        if offsets is not None:
            chosen = np.isin(chunk.batch.places[0], offsets)
        for channel in self._channels:
            rows = np.flatnonzero(chosen & (chunk.batch.channel == channel.channel_id))
            if len(rows):
                placed = Placed.of([chunk]).take(rows)
                if channel.codec.indexed and not channel.is_reduced:
                    counters.payload_bytes += placed.batch.payload_bytes
                yield self._rows(channel, placed, paths, own)

    def _rows(
        self,
        channel: RecordedChannel,
        placed: Placed,
        paths: Paths,
        own: Collection[str],
    ) -> Rows:
        has_points, points = POINTS in own, None

        def records_of(decoded: Decoded) -> pa.StructArray:
            nonlocal points
            if isinstance(decoded.records, LeftFields):
                return decoded.records.summarised()
            records = decoded.arrow()
            if has_points:
                points = without(PointColumns().points(records), decoded.rows, len(placed.seq))
            return records

        wanted = None if paths is None else {*paths, "header.stamp"}
        if wanted is not None and has_points:
            wanted.update(NEEDED)
        piece = piece_of(
            placed,
            channel.codec.columns_of(placed.batch, wanted) if channel.codec.indexed else None,
            channel.state,
            has_publish_time=channel.channel.has_publish_time,
            columns=records_of,
        )
        columns = piece.own if points is None else {**piece.own, POINTS: points}
        none = pa.nulls(piece.rows, pa.struct([]))
        return Rows(columns, none if piece.fields is None else piece.fields, piece.rows)


RowSource: TypeAlias = _TableRows | _ChunkRows
"""Some rows of a topic of a recording that are read together."""
