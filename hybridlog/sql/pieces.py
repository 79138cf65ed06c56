"""Rows of a topic in one recording: from its table, or from its chunks.

A topic of an ended recording has a table, which is made again if it is missing. Where it can
have none, and for what a running recording has flushed, chunks are decoded instead, into the
same columns.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from hybridlog.columns.clouds import NEEDED, PointColumns, is_cloud
from hybridlog.columns.fields import without
from hybridlog.columns.layout import POINTS
from hybridlog.columns.rows import Messages, Piece, own_columns
from hybridlog.query.question import RecordedChannel
from hybridlog.query.rows import places_of
from hybridlog.record.losses import lost_spans
from hybridlog.schema.arrow_types import has_empty
from hybridlog.schema.states import GONE, State
from hybridlog.sql.columns import whole_message
from hybridlog_storage.errors import StoreError
from hybridlog_storage.lazy import lazy
from hybridlog_storage.messages import EXPIRED_IDS

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from hybridlog.columns.column_file import TablePart
    from hybridlog.columns.topic_table import TopicTable
    from hybridlog.session import Session
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.segments.chunk import StoredChunk
    from hybridlog_storage.segments.segment_reader import ChunkPlace

_FIXED: Final = frozenset({"ros1", "cdr"})
"""Encodings whose definition fixes the fields."""

Paths = Collection[str] | None
"""Dotted paths of fields to read; None for all."""


@dataclass(slots=True)
class ScanCounts:
    """Counts of what was read for a query.

    Attributes:
        files: Paths of the files that were read.
        groups: Files and numbers of the row groups that were read.
        chunks: Chunks that were read.
        payload_bytes: Bytes of payloads that were decoded.
    """

    files: set[str] = field(default_factory=set)
    groups: set[tuple[str, int]] = field(default_factory=set)
    chunks: int = 0
    payload_bytes: int = 0

    @property
    def row_groups(self) -> int:
        """Number of row groups that were read."""
        return len(self.groups)

    def add_chunk(self, _: StoredChunk) -> None:
        """Count a chunk."""
        self.chunks += 1

    def add_group(self, path: Path, group: int) -> None:
        """Count a row group."""
        self.files.add(str(path))
        self.groups.add((str(path), group))


class Rows(NamedTuple):
    """Some messages of a topic.

    Attributes:
        own: Columns of the table itself, by name; with `state` unless all are whole.
        records: Fields of the messages; arrays may be summaries.
        size: Number of messages.
    """

    own: Mapping[str, Any]
    records: Any
    size: int


class DamagedTableError(StoreError):
    """A table turned out to be damaged while it was read."""

    def __init__(self, source: TopicOfRecording, problem: str) -> None:
        super().__init__(f"{problem} It is made again when you ask again.")
        self.source = source


class RowSource(Protocol):
    """Some rows of a topic of a recording that are read together."""

    @property
    def first(self) -> int | None:
        """Least log time, ns; None if unknown."""

    @property
    def last(self) -> int | None:
        """Greatest log time, ns; None if unknown."""

    @property
    def is_whole(self) -> bool:
        """True if it has all arrays; else some may be summaries."""

    @property
    def has_summaries(self) -> bool:
        """True if it has summaries of all arrays that it has in full."""

    @property
    def has_points(self) -> bool:
        """True if it has the points of clouds."""

    def kinds(self, paths: Paths) -> Sequence[Any]:
        """Types of the fields that it holds, at least at some paths."""

    def read(self, paths: Paths, own: Collection[str], counts: ScanCounts) -> Iterator[Rows]:
        """Read columns."""


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
            not channel.is_typed or channel.codec.reason is not None or _is_fixed(channel)
            for channel in self.channels.values()
        )

    @lazy
    def kinds(self) -> list[Any]:
        """Types of its messages."""
        if not self.is_fixed:
            return [
                kind if source.is_whole else whole_message(kind)
                for source in self.sources
                for kind in source.kinds(None)
            ]
        return [
            channel.arrow_type()
            for channel in self.channels.values()
            if channel.is_typed and channel.codec.indexed
        ]

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
        left = [chunk for chunk in chunks if chunk.segment not in covered]
        found += [
            _ChunkRows(self, chunk.segment, chunk.place, (chunk.first, chunk.last))
            for chunk in left
            if not chunk.place.is_expired
        ]
        gone = {(c.segment, c.number) for c in left if c.place.is_expired}
        if gone:
            fields = self.session.expired_fields(self.entry, self.topic, gone)
            found += [_FieldRows(self, fields, part) for part in fields.parts]
        return sorted(found, key=lambda one: (one.first is not None, one.first or 0))

    @lazy
    def places(self) -> dict[tuple[int, int], ChunkPlace]:
        """Positions of its chunks, by segment and number."""
        chunks = self.session.chunks(self.entry, list(self.channels), None, "log")
        return {(chunk.segment, chunk.number): chunk.place for chunk in chunks}

    @lazy
    def expired(self) -> dict[State, NDArray[np.int64]]:
        """Keys of its expired chunks by state, see `_keys`."""
        found = {}
        for kind, state in enumerate(GONE, 1):
            places = self.places.items()
            gone = [key for key, place in places if place.channels[0] // EXPIRED_IDS == kind]
            if gone:
                found[state] = _keys(*np.array(gone, np.int64).T)
        return found

    def first_points(self) -> Any:
        """Type of the points of the first clouds that can be read; None of other messages."""
        channels = {i: one for i, one in self.channels.items() if is_cloud(one.channel)}
        for (segment, number), place in self.places.items():
            if place.is_expired or channels.keys().isdisjoint(place.channels):
                continue
            with suppress(StoreError):
                batch = self.chunk(segment, number, ScanCounts()).batch
                index = next(one for one in place.channels if one in channels)
                own = batch.take(np.flatnonzero(batch.channel == index))
                codec = channels[index].codec
                decoded = codec.columns(own.buffer, own.offset, own.length, NEEDED)
                return PointColumns().points(decoded.arrow()).type
        return None

    def chunk_rows(self, segment: int, number: int) -> _ChunkRows:
        """The messages in a chunk, with all arrays."""
        return _ChunkRows(self, segment, self.places[segment, number], None)

    def chunk(self, segment: int, number: int, counts: ScanCounts) -> StoredChunk:
        """A chunk; see `Session.chunk`."""
        return self.session.chunk(
            self.entry, segment, self.places[segment, number], counts.add_chunk
        )


def _keys(segment: NDArray[np.int64], chunk: NDArray[np.int64]) -> NDArray[np.int64]:
    """A number for each chunk."""
    return (segment << 32) | chunk


def _with_expired(states: Any, ref: Any, expired: Mapping[State, NDArray[np.int64]]) -> Any:
    """States of rows, by their chunks: payloads may have gone, or come, since they were made."""
    keys = _keys(*places_of(ref)[:, :2].T)
    was_gone = pc.is_in(states, pa.array([*map(str, GONE)]))
    states = pc.if_else(was_gone, State.WHOLE.value, states)
    for state, gone in expired.items():
        is_gone = pa.array(np.isin(keys, gone))
        is_gone = pc.and_(is_gone, pc.equal(states, State.WHOLE.value))
        states = pc.if_else(is_gone, state.value, states)
    return states


def _is_fixed(channel: RecordedChannel) -> bool:
    """True if the definition of a channel fixes the fields of its messages."""
    encoding = channel.encoding
    # The keys of a map of protobuf are fields, which no definition knows.
    return encoding in _FIXED or (encoding == "protobuf" and not has_empty(channel.arrow_type()))


class _TableRows:
    """A row group of a table."""

    is_whole = False

    def __init__(self, source: TopicOfRecording, table: TopicTable, part: TablePart) -> None:
        self._source = source
        self._table = table
        self._part = part
        is_known = part.first[0] > -(1 << 63)
        self.has_summaries = table.has_arrays
        self.has_points = table.points is not None
        self.first = part.first[0] if is_known else None
        self.last = part.last[0] if is_known else None

    def kinds(self, paths: Paths) -> Sequence[Any]:
        try:
            return [self._table.fields(paths)]
        except StoreError as error:
            raise self._damaged(error) from error

    def _damaged(self, error: StoreError) -> StoreError:
        return DamagedTableError(self._source, str(error))

    def read(self, paths: Paths, own: Collection[str], counts: ScanCounts) -> Iterator[Rows]:
        counts.add_group(self._part.file.path, self._part.group)
        expired = self._source.expired
        is_whole = not (self._table.unreadable or self._table.reduced or expired)
        wanted = {*own} if is_whole else {*own, "state"}
        if "state" in wanted:
            wanted.add("ref")
        try:
            ours, records = self._table.read(self._part, paths, wanted)
        except StoreError as error:
            raise self._damaged(error) from error
        if "state" in wanted:
            ours["state"] = _with_expired(ours["state"], ours["ref"], expired)
        yield Rows(ours, records, self._part.rows)


class _FieldRows(_TableRows):
    """A row group of what is left of expired messages; it is never made again."""

    def _damaged(self, error: StoreError) -> StoreError:
        return StoreError(f"{error} Restore the file from a copy.")


class _ChunkRows:
    """The messages of a topic in a chunk."""

    is_whole = True
    has_summaries = False
    has_points = True

    def __init__(
        self,
        source: TopicOfRecording,
        segment: int,
        place: ChunkPlace,
        span: tuple[int, int] | None,
    ) -> None:
        self._source = source
        self._segment = segment
        self._place = place
        self.first, self.last = span or (place.first, place.last)

    def kinds(self, paths: Paths) -> Sequence[Any]:
        return self._kinds

    @lazy
    def _kinds(self) -> Sequence[Any]:
        return [rows.records.type for rows in self.read(None, (), ScanCounts())]

    def read(
        self,
        paths: Paths,
        own: Collection[str],
        counts: ScanCounts,
        offsets: NDArray[np.int64] | None = None,
    ) -> Iterator[Rows]:
        chunk = self._source.chunk(self._segment, self._place.number, counts)
        chosen = np.ones(len(chunk.batch), np.bool_)
        if offsets is not None:
            chosen = np.isin(chunk.batch.places[0], offsets)
        for number, channel in self._source.channels.items():
            rows = np.flatnonzero(chosen & (chunk.batch.channel == number))
            if len(rows):
                messages = Messages.of(chunk).take(rows)
                counts.payload_bytes += int(messages.length.sum()) * channel.codec.indexed
                yield self._rows(chunk, channel, messages, paths, own)

    def _rows(
        self,
        chunk: StoredChunk,
        channel: RecordedChannel,
        messages: Messages,
        paths: Paths,
        own: Collection[str],
    ) -> Rows:
        count = len(messages.seq)
        piece = Piece(self._segment, messages, None, state=channel.state)
        records, points = pa.nulls(count, pa.struct([])), None
        if channel.codec.indexed and not channel.is_reduced:
            wanted = None if paths is None else {*paths, "header.stamp"}
            if wanted is not None and POINTS in own:
                wanted.update(NEEDED)
            data = chunk.batch.buffer
            decoded = channel.codec.columns(data, messages.at, messages.length, wanted)
            piece.errors += [(bad.rows, bad.reason) for bad in decoded.unreadable]
            if len(decoded.rows):
                records = without(decoded.arrow(), decoded.rows, count)
                points = PointColumns().points(decoded.arrow()) if POINTS in own else None
        segment = np.full(count, self._segment, np.int32)
        publishes = {channel.channel_id: channel.channel.has_publish_time}
        fields = records if records.type.num_fields else None
        columns = dict(own_columns([piece], messages, segment, fields, publishes))
        if points is not None:
            columns[POINTS] = without(points, decoded.rows, count)
        return Rows(columns, records, count)
