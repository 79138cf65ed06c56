"""An open store at one moment, as a question sees it."""

from __future__ import annotations

from collections.abc import (
    Callable,
    Collection,
    Iterable,
    Iterator,
    Mapping,
    Sequence,
)
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Protocol, TypeVar

import numpy as np

from hybridlog.entries import put_entry, schemas_in, summary_of, topic_types
from hybridlog.query.chunk_columns import PARTS, Chunk, ChunkColumns
from hybridlog.query.question import Question, RecordedChannel, field_types
from hybridlog.query.topics import resolve
from hybridlog.record.marks import MARKS
from hybridlog.snapshot import UNFINISHED, Snapshot, differing
from hybridlog.wording import counted, listed
from hybridlog_storage.catalog import WHOLE, RecordingEntry, RecordingSummary, file_of
from hybridlog_storage.disk.directory import StoreDirectory, gone
from hybridlog_storage.errors import (
    ChangedError,
    SegmentError,
    StoreError,
    TopicError,
)
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.segments.chunk_table import ChunkPlace, ChunkTable, place_of
from hybridlog_storage.times import END, placed

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.columns.tables import Tables, TopicTable
    from hybridlog.query.predicate.tree import Predicate
    from hybridlog.shared import Shared
    from hybridlog_storage.segments.chunk import StoredChunk
    from hybridlog_storage.segments.segment_reader import SegmentReader

_ROW_BYTES = 44  # of a message's columns in a chunk

_T = TypeVar("_T")


class Asked(Protocol):
    """Takes questions: an open store as it is at each of them, or always as at one moment."""

    directory: StoreDirectory

    def now(self) -> Session:
        """The store at the moment that a question is about."""


class Session:
    """An open store at one moment. Thread safe.

    A question takes one at its beginning, and hands it to all that it calls. What running
    recordings have flushed by then is read when it first asks about them. Where a file is gone or
    was replaced, later questions see the newer state of its recording.
    """

    def __init__(self, shared: Shared, recordings: Snapshot) -> None:
        self.shared = shared
        self.directory = shared.directory
        self.catalog = shared.catalog
        self.cache = shared.cache
        self._recordings = recordings
        self._entries: dict[str, RecordingEntry] = {}  # that were asked about, by id

    def now(self) -> Session:
        """This moment; refuses processes that were forked since."""
        self.shared.check_process()
        return self

    @property
    def tables(self) -> Tables:
        """Parquet tables of topics."""
        return self.shared.tables

    # Recordings.

    def snapshot(self) -> Snapshot:
        """All recordings in short; running ones as this question has seen them so far."""
        return self._recordings

    def look(self, recordings: Collection[str] | None = None) -> Snapshot:
        """See what running recordings, some or all, have flushed; returns all recordings."""
        for summary in self._recordings.unfinished:
            if recordings is None or summary.id in recordings:
                self.find(summary.id)
        return self._recordings

    def find(self, recording: str) -> RecordingEntry | None:
        """The entry of a recording, by its id, compared with its files once; None if it is gone.

        That of a running one has what is flushed when it is first asked for.
        """
        summary = self._recordings.by_id.get(recording)
        if recording in self._entries or summary is None:
            return self._entries.get(recording)
        if summary.status in UNFINISHED:
            return self._followed(summary)
        found = self.shared.entry(summary)
        if found is not None:
            self._entries[recording] = found
        return found

    def _followed(self, summary: RecordingSummary) -> RecordingEntry | None:
        with self.shared.following:
            if summary.id in self._entries:
                return self._entries[summary.id]
            found = self.shared.followed(summary)
            if found is not None:
                self._entries[summary.id] = found
                before, now = self._recordings, summary_of(found, summary.look)
                if now != summary:
                    topics = {now.topics: topic_types(found)}
                    self._recordings = before.with_changes([now], topics)
                    if self.shared.latest is before:  # later questions begin with it
                        self.shared.latest = self._recordings
            return found

    def entries(self, summaries: Iterable[RecordingSummary]) -> Iterator[RecordingEntry]:
        """The entries of some recordings, without those that were removed meanwhile."""
        return (found for one in summaries if (found := self.find(one.id)) is not None)

    def entry_of(self, summary: RecordingSummary) -> RecordingEntry:
        """The entry of a recording; a `TopicError` if it was removed meanwhile."""
        found = self.find(summary.id)
        if found is None:
            raise gone(summary.name)
        return found

    def show(self, entry: RecordingEntry) -> None:
        """Let an entry stand for its recording at this moment."""
        self._entries[entry.id] = entry

    def entry(self, recording: str) -> RecordingEntry:
        """The entry of a recording, by its id, its name, or the beginning of one of these."""
        (found,) = self.select([recording])
        return found

    def some(self, recordings: Collection[str] | None) -> list[RecordingSummary]:
        """Recordings by id (None: all), oldest first; a `TopicError` if one was removed."""
        snapshot = self.look(recordings)
        if recordings is None:
            return snapshot.summaries
        gone = sum(one not in snapshot.by_id for one in recordings)
        if gone:
            raise TopicError(
                f"{gone} of the recordings asked about were removed from the store. Make the "
                "query again."
            )
        return snapshot.some(recordings)

    def summaries_of(self, question: Question) -> list[RecordingSummary]:
        """The recordings of a question in short, oldest first."""
        known = self.some(question.recordings)
        if question.recordings is not None:
            return known
        return self._recordings.having(question.topics)

    def doubtful(self, question: Question) -> list[RecordingEntry]:
        """The recordings of a question that may lack messages, oldest first."""
        return [
            entry
            for one in self.summaries_of(question)
            if one.has_losses or one.status != "complete" or one.id in self._entries
            if (entry := self.entry_of(one)).status != "complete" or entry.losses
        ]

    @property
    def when_empty(self) -> str:
        """The sentence for a store without recordings that can be read."""
        number = len(self.shared.repairs.unreadable)
        if number:
            return f"{counted(number, 'recording')} cannot be read: `hybridlog verify` says why."
        return self.directory.when_empty

    def select(self, names: Iterable[str | RecordingEntry] | None) -> list[RecordingEntry]:
        """Recordings by name, id, or the beginning of one of these; None for all."""
        if names is None:
            return [*self.entries(self._recordings.summaries)]
        return [self.entry_of(one) for one in self.named(names)]

    def named(self, names: Iterable[str | RecordingEntry]) -> list[RecordingSummary]:
        """Summaries of the named recordings, each once, in the order of the names."""
        chosen: dict[str, RecordingSummary] = {}
        for given in names:
            name = given if isinstance(given, str) else given.id
            found = self._recordings.named(name)
            if len(found) != 1:
                known = [one.name for one in found or self._recordings.summaries]
                if len({*known}) < len(found):  # copied by hand
                    known = [one.id for one in found]
                problem = "is ambiguous" if found else "is not in the store"
                raise TopicError(f"Recording {name!r} {problem}. There are: {listed(known)}.")
            chosen[found[0].id] = found[0]
        return [*chosen.values()]

    # Topics.

    def topics_of(self, recordings: Collection[str] | None = None) -> list[str]:
        """Names of all topics of the recordings with some ids, or of all, sorted.

        They include those whose messages are all lost.
        """
        found = self.some(recordings)
        return self._recordings.topics_of(found)

    def resolve_in(self, names: Sequence[str], recordings: Collection[str] | None) -> list[str]:
        """The topics of some recordings that patterns match."""
        return resolve(names, self.topics_of(recordings))

    def question(self, names: Sequence[str], recordings: Collection[str] | None = None) -> Question:
        """The question about the topics that patterns match, in recordings by their ids, or all."""
        if not names:
            known = self.topics_of(recordings)
            there = f"There are: {listed(known)}." if known else self.when_empty
            raise TopicError(f"Name a topic. {there}")
        return self.about(self.resolve_in(names, recordings), recordings)

    def about(self, topics: Sequence[str], recordings: Collection[str] | None = None) -> Question:
        """The question about topics, in the recordings (ids; None: all) that have any of them.

        A `TopicError` if none has.
        """
        self.some(recordings)
        having = self._recordings.having(topics, recordings)
        if topics and not having:
            raise TopicError(f"No recording chosen has {', '.join(sorted(set(topics)))}.")
        ids = None if recordings is None else tuple(one.id for one in having)
        return Question(tuple(topics), ids)

    def channels_of(
        self, recording: RecordingEntry, topics: Collection[str]
    ) -> list[RecordedChannel]:
        """The channels of some topics in a recording, with their codecs.

        Where a topic has messages, its channels without any are left out: they must not change
        the columns of an answer.
        """
        known = self.shared.channels.get(recording.id)
        if known is None or known[0] is not recording:
            known = self.shared.channels[recording.id] = recording, {}
        if new := {*topics} - known[1].keys():
            definitions = self.definitions(recording, new)
            added: dict[str, list[RecordedChannel]] = {topic: [] for topic in new}
            own = [one for one in recording.channels if one.topic in new]
            has_messages = {one.topic for one in own if one.stats.messages}
            for one in own:
                if one.stats.messages or one.topic not in has_messages:
                    channel = RecordedChannel(recording, one.id, definitions[one.id], one.stats)
                    added[one.topic].append(channel)
            known[1].update(added)
        found = [channel for topic in topics for channel in known[1][topic]]
        return sorted(found, key=lambda channel: channel.channel_id)

    def field_types(
        self, topics: Collection[str], recordings: Collection[str] | None
    ) -> dict[str, str] | None:
        """Types of the fields of some topics, by path; None where no definition fixes them.

        Recordings are ids; None for all.
        """
        # Recordings with equal topics and types have equal fields.
        return field_types(
            tuple(
                channel
                for summary in differing(self.look(recordings).having(topics, recordings))
                for channel in self.channels_of(self.entry_of(summary), set(topics))
            )
        )

    def predicate(
        self,
        given: str | Mapping[str, object],
        topics: tuple[str, ...],
        recordings: tuple[str, ...] | None,
    ) -> Predicate:
        """A predicate, or a MongoDB filter, on some topics of some recordings."""
        from hybridlog.query.predicate.mongo_filter import mongo_filter
        from hybridlog.query.predicate.parser import is_filter, parse
        from hybridlog.query.predicate.tree import check

        types = self.field_types(topics, recordings)
        if not isinstance(given, str) or is_filter(given):
            return mongo_filter(given, types)
        found = parse(given)
        check(found, types)
        return found

    def definitions(
        self, recording: RecordingEntry, topics: Collection[str] | None = None
    ) -> Mapping[int, Channel]:
        """Channels of some topics of a recording, or all, by id, also those without messages."""
        known = self.shared.schemas
        own = [one for one in recording.channels if topics is None or one.topic in topics]
        defined = [one for one in own if one.schema is not None]
        wanted = {one.schema for one in defined if one.schema is not None} - known.keys()
        known |= self.catalog.schemas(wanted)
        if wanted - known.keys():
            found = schemas_in(self.directory, recording, defined)
            known |= found
            self.catalog.put_schemas(found.values())
        if any(one.schema not in known and one.stats.messages for one in defined):
            for number in recording.logs:
                with suppress(ChangedError):  # it is noted as lost, and who asks for chunks hears
                    self.chunk_table(recording, number)
        return {
            c.id: Channel(
                c.topic,
                c.message_encoding,
                None if c.schema is None else known.get(c.schema, Schema(c.type, "", b"")),
                c.metadata,
                has_publish_time=c.has_publish_time,
                is_indexed=c.is_indexed,
            )
            for c in own
        }

    def chunks(
        self,
        recording: RecordingEntry,
        channels: Sequence[int],
        span: tuple[int, int] | None = None,
    ) -> list[Chunk]:
        """Chunks that may hold messages of some channels in a range of log time, ns; None: any."""
        found: list[Chunk] = []
        for columns in self._chunk_columns(recording, channels, span):
            found += columns.chunks(columns.within(span))
        return found

    def _chunk_columns(
        self, recording: RecordingEntry, channels: Collection[int], span: tuple[int, int] | None
    ) -> Iterator[ChunkColumns]:
        """The chunks with some channels, by segment, of those that may reach into a log time."""
        for number, first, last in recording.spans_with(channels):
            if span is None or (min(first, END - 1) < span[1] and last >= span[0]):
                table = self.chunk_table(recording, number)
                yield self.cache.made(
                    "chunks",
                    table,
                    number,
                    frozenset(channels),
                    make=partial(ChunkColumns, number, table, channels),
                    size_of=lambda made: made.nbytes,
                )

    def chunk_table(self, recording: RecordingEntry, number: int) -> ChunkTable:
        """The chunks of a recording's segment; a `ChangedError` if its file is another one."""
        try:
            return self.catalog.table(recording, number)
        except SegmentError as error:
            self._check_same(recording, number, str(error))
            raise StoreError(f"{error} Ask again.") from error

    def parts(
        self, recording: RecordingEntry, channels: Collection[int], span: tuple[int, int]
    ) -> NDArray[np.void]:
        """The `ChunkColumns.parts` that may lie in a range `[begin, end)` of log time, ns."""
        found = [np.empty(0, np.dtype(PARTS))]
        for columns in self._chunk_columns(recording, channels, span):
            rows = columns.parts
            found.append(rows[(placed(rows["first"]) < span[1]) & (rows["last"] >= span[0])])
        return np.concatenate(found)

    def times(
        self, recording: RecordingEntry, segment: int, chunk: int
    ) -> dict[int, NDArray[np.int64]]:
        """Log times of a chunk's messages by channel, ascending; reads no payload."""
        place = place_of(self.chunk_table(recording, segment), chunk)

        def read() -> dict[int, NDArray[np.int64]]:
            found = self._read(recording, segment, lambda reader: reader.read_times(place))
            if not found.keys() >= {*place.channels}:
                raise StoreError(
                    f"Payloads of {recording.name!r} were deleted meanwhile. Ask again."
                )
            return found

        key = recording.id, segment, chunk, place.offset, file_of(recording, segment)
        return self.cache.made(
            "times",
            *key,
            make=read,
            size_of=lambda own: sum(one.nbytes for one in own.values()),
        )

    def chunk(
        self,
        recording: RecordingEntry,
        segment: int,
        place: ChunkPlace,
        count: Callable[[StoredChunk], None],
    ) -> StoredChunk:
        """A chunk, from the cache if it is there, else counted. Its buffer is read-only."""

        def read() -> StoredChunk:
            chunk = self.read_chunk(recording, segment, place)
            # Arrays of messages share the buffer: changes to them must not change the cache.
            chunk.batch.buffer = memoryview(chunk.batch.buffer).toreadonly()
            count(chunk)
            return chunk

        key = recording.id, segment, place.number, place.offset, file_of(recording, segment)
        return self.cache.made(
            "chunk",
            *key,
            make=read,
            size_of=lambda one: len(one.batch.buffer) + _ROW_BYTES * len(one.batch),
        )

    def segment(self, recording: RecordingEntry, number: int) -> SegmentReader:
        """The reader of a segment. Thread safe.

        A `ChangedError` says that it has been let go, or is another file by now.
        """
        if number in recording.flushed:
            return recording.flushed[number].reader
        try:
            return self.shared.segment(recording, number)
        except SegmentError:
            self._check_same(recording, number)
            raise

    def hold(self, recording: RecordingEntry, segments: Iterable[int]) -> None:
        """Open segments that will be read, if a ring may let them go meanwhile.

        A `ChangedError` says that one has been let go.
        """
        has_let_go = len(recording.logs) <= max(recording.logs, default=-1)
        if recording.status in UNFINISHED and has_let_go:
            for number in segments:
                self.segment(recording, number)

    def read_chunk(self, recording: RecordingEntry, number: int, place: ChunkPlace) -> StoredChunk:
        """Read a chunk of a segment of a recording."""
        return self._read(recording, number, lambda reader: reader.read_chunk(place))

    def _read(
        self, recording: RecordingEntry, number: int, read: Callable[[SegmentReader], _T]
    ) -> _T:
        try:
            return read(self.segment(recording, number))
        except SegmentError:
            self._check_same(recording, number)
            raise

    def _check_same(self, entry: RecordingEntry, number: int, problem: str = "") -> None:
        """Raise a `ChangedError` if a segment that cannot be read is another file by now.

        Later questions to this moment are about the newer files. With a problem of its summary it
        is noted as lost, which counts as another file, too.
        """
        summary = self._recordings.by_id.get(entry.id)
        look = None if summary is None else summary.look
        if problem and look in {"", self.directory.looks([entry.id]).get(entry.id)}:
            known = self.catalog.damage(entry.id)
            self.catalog.put_damage(entry.id, {**known, (number, WHOLE): problem})
            put_entry(self.directory, self.catalog, entry.id)
        self.shared.catch_up(entry.id)
        now = self.shared.now().find(entry.id)
        if now is None:
            raise gone(entry.name)
        was_flushed = number in entry.flushed
        if now.logs.get(number) != entry.logs.get(number) or was_flushed != (number in now.flushed):
            self._entries[entry.id] = now
            raise ChangedError(
                f"Files of recording {entry.name!r} were replaced while it was read. Ask again."
            )

    def table(self, recording: RecordingEntry, topic: str) -> TopicTable | None:
        """The table of a topic of an ended recording; None without one.

        Where messages are lost there is none, since rows of these must not answer.
        """
        has_marks = topic == MARKS and recording.manifest.marks
        if recording.status in UNFINISHED or has_marks or recording.lost_spans:
            return None
        return self.tables.of(recording, topic)
