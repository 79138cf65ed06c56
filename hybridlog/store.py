"""Opening a store: the one module that wires directory, database, segments and reader."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from hybridlog import field_indexes
from hybridlog.entries import channels_of, take_inventory, text
from hybridlog.field_indexes import FieldIndex
from hybridlog.losses import topics_of
from hybridlog.maintenance.opening import open_catalog, put_again, repair_on_open
from hybridlog.maintenance.report import Progress, RepairReport, being_written
from hybridlog.query.chunk_lists import ChunkLists, latest_first
from hybridlog.query.intervals import span_of
from hybridlog.query.plan import Lane
from hybridlog.query.predicate import Predicate
from hybridlog.query.recent_chunks import RecentChunks
from hybridlog.query.times import parse_time
from hybridlog.query.topics import resolve
from hybridlog.reader import Query
from hybridlog_storage import journal
from hybridlog_storage.catalog import ChunkEntry, RecordingEntry
from hybridlog_storage.directory import StoreDirectory
from hybridlog_storage.errors import (
    CatalogError,
    DatabaseError,
    DiskFullError,
    HybridlogError,
    StoreError,
    TopicError,
    UsageError,
)
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.segment_reader import SegmentReader
from hybridlog_storage.settings import EMBEDDED, NAME, with_password

if TYPE_CHECKING:
    from hybridlog.columns.kept import KeptColumns
    from hybridlog.columns.stored import FieldColumns
    from hybridlog.guarded import Belief, GuardedIndex
    from hybridlog.live import LiveOptions, LiveRecording
    from hybridlog.maintenance.imports import ImportReport
    from hybridlog.maintenance.repair import Repaired
    from hybridlog.maintenance.verify import Verification
    from hybridlog.query.times import TimeLike
    from hybridlog.recorder import RecordOptions, RecordReport
    from hybridlog.sources.base import Source
    from hybridlog_storage.database import Database
    from hybridlog_storage.mongod import EmbeddedMongod

DEFAULT_STORE = "hybridlog-store"
_MOST_OPEN = 256  # segments, and files of columns
_MOST_WORDS = 128  # topics and predicates whose meaning is remembered


def store_path(path: str | Path | None = None) -> Path:
    """Where the store is: the argument, else `HYBRIDLOG_STORE`, else `./hybridlog-store`."""
    return Path(path or os.environ.get("HYBRIDLOG_STORE") or DEFAULT_STORE)


def open_store(
    path: str | Path | None = None,
    *,
    mongo: str | None = None,
    create: bool = False,
    shared: bool = False,
    require_database: bool = False,
    progress: Progress | None = None,
) -> Store:
    """Open a store; what a crash has left is mended first.

    MongoDB is connected to when a question needs it.

    Args:
        path: Its directory; without, `HYBRIDLOG_STORE` or `./hybridlog-store`.
        mongo: URI of the MongoDB that holds the index, or `embedded`; without,
            `HYBRIDLOG_MONGO_URI`, the store's own setting, or the embedded MongoDB.
        create: Make the store if there is none.
        shared: Let the group write the store; when it is made.
        require_database: Connect to MongoDB now, and fail if it is unavailable.
        progress: Called while an index is brought up to date.

    Raises:
        StoreError: there is no store there, or it is of another format.
        DatabaseError: MongoDB does not answer and `require_database` is set.
    """
    where = store_path(path)
    wanted = mongo or os.environ.get("HYBRIDLOG_MONGO_URI")
    if create:
        own = None if mongo in {None, EMBEDDED} else mongo
        is_new = not os.path.lexists(where / NAME)
        directory = StoreDirectory.create(where, mongo=own, shared=shared)
        directory.check_writable()
        if is_new and own is not None:
            with suppress(StoreError):  # without a home, each command names it again
                from hybridlog import consent

                consent.remember(directory.settings.store_id, own)
    else:
        directory = StoreDirectory(where)
    store = Store(directory, mongo=wanted, progress=progress)
    try:
        if require_database:
            store.connect()
    except BaseException:
        store.close()
        raise
    return store


class Store:
    """A directory of recordings and the database that makes them answerable.

    Use `hybridlog.open`; a store is a context manager. One store may be used by several
    threads for reading.

    Args:
        directory: Where it lies.
        mongo: URI of the MongoDB that holds the index, or `embedded`; None for the one that
            the store names.
        progress: Called while an index is brought up to date.

    Attributes:
        directory: Where it lies.
        without_database: Why MongoDB is unavailable; None while it is not known to be.
        repairs: What had to be mended when it was opened.
        kept: Columns of what is asked for again and again.
        recent_chunks: Chunks that single messages were read from.
    """

    def __init__(
        self,
        directory: StoreDirectory,
        *,
        mongo: str | None = None,
        progress: Progress | None = None,
    ) -> None:
        self.directory = directory
        self.without_database: HybridlogError | None = None
        self.repairs = RepairReport()
        self._database: Database | None = None
        self._mongod: EmbeddedMongod | None = None
        self._wanted = mongo
        self._uri: str | None = None
        self._progress = progress
        self._connecting = threading.RLock()
        self._is_indexed = False  # the recordings that are known are in the index
        self._recordings: list[RecordingEntry] | None = None
        self._belief: Belief | None = None
        self._schemas: dict[str, Schema] = {}
        self._lanes: dict[str, list[Lane]] = {}
        self._segments: dict[tuple[str, int], SegmentReader] = {}
        self._columns: dict[str, FieldColumns | None] = {}
        self._chunk_lists = ChunkLists()
        self.recent_chunks = RecentChunks()
        self._lock = threading.Lock()
        self.catalog = open_catalog(directory)
        self._learn()
        try:
            self.recordings()
        except BaseException:
            self.catalog.close()
            raise

    def __enter__(self) -> Self:
        """The store itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()

    def __repr__(self) -> str:
        return f"<Store {self.directory.path}>"

    # Connection.

    @property
    def connected(self) -> Database | None:
        """The index, if a question has needed it already."""
        return self._database

    @property
    def database(self) -> Database | None:
        """The index; None if MongoDB is unavailable. It is connected to when first asked for."""
        if self.without_database is None and not (self._database and self._is_indexed):
            with suppress(HybridlogError):
                self.connect()
        return self._database

    def connect(self) -> Database:
        """Connect to the index, and bring it up to date.

        Raises:
            DatabaseError: MongoDB does not answer.
            StoreError: it holds the index of another store, or this store is a copy.
        """
        from hybridlog.maintenance import index

        with self._connecting:
            if self._database is not None and self._is_indexed:
                return self._database
            try:
                if self._database is None:
                    self._database = self._another_database()
                    self._claim(self._database)
                repairs = RepairReport()
                has_changed = index.bring_up_to_date(
                    self.directory,
                    self.catalog,
                    self._database,
                    self.recordings(),
                    report=repairs,
                    progress=self._progress,
                )
            except BaseException as error:
                self.disconnect()
                if isinstance(error, HybridlogError):
                    self.without_database = error
                raise
            self.without_database = None
            self.repairs.indexed.update(repairs.indexed)
            self.repairs.unreadable.update(repairs.unreadable)
            self.repairs.removed += repairs.removed
            if has_changed:
                self.refresh()
            self._is_indexed = True
            return self._database

    def _another_database(self) -> Database:
        """A connection; the embedded MongoDB is started if it is not there (any more).

        Raises:
            DatabaseError: it does not answer.
        """
        from hybridlog_storage.database import Database

        if self._uri is None:
            from hybridlog import consent

            self._uri = self._wanted or consent.trusted_uri(
                self.directory.settings, self.directory.path
            )
        uri = self._uri
        if uri == EMBEDDED:
            from hybridlog_storage.mongod import EmbeddedMongod

            self._mongod = self._mongod or EmbeddedMongod(self.directory.mongod)
            try:
                uri = self._mongod.start()
            except StoreError as error:
                # A store that cannot be written has no embedded MongoDB; its segments do.
                raise DatabaseError(str(error)) from error
        else:
            uri = with_password(uri)
        return Database.connect(uri)

    @property
    def index_place(self) -> str:
        """Where the index is, without asking it."""
        if self._database is not None:
            return f"database {self._database.name} at {self._database.address}"
        uri = self._wanted or self.directory.settings.mongo or EMBEDDED
        if uri == EMBEDDED:
            return "the MongoDB that comes with hybridlog"
        from hybridlog_storage.database import without_secrets

        return without_secrets(uri)

    def disconnect(self) -> None:
        """Leave the database; what remains is reading by time."""
        if self._database is not None:
            self._database.close()
        self._database = None
        self._belief = None
        if self._mongod is not None:
            self._mongod.stop()
        self._mongod = None

    def close(self) -> None:
        """Give everything back. May be called more than once."""
        with self._lock:
            for reader in self._segments.values():
                reader.close()
            self._segments.clear()
        self._columns.clear()
        self.recent_chunks.clear()
        self.disconnect()
        self.catalog.close()

    def database_for(self, purpose: str) -> Database:
        """The database.

        Raises:
            DatabaseError: it is unavailable; says what it was needed for, and why it is.
        """
        if self.database is None:
            raise DatabaseError(f"{purpose} needs MongoDB. {self.without_database or ''}".strip())
        return self.database

    def index_for(self, purpose: str, recordings: Sequence[RecordingEntry]) -> GuardedIndex:
        """The index, to ask about some recordings.

        Raises:
            DatabaseError: it is unavailable; says what it was needed for, and why it is.
            IndexChangedError: another process removes documents of these recordings.
        """
        from hybridlog.guarded import GuardedIndex

        return GuardedIndex(self, self.database_for(purpose), recordings)

    def belief(self, database: Database, keys: Collection[str], *, anew: bool = False) -> Belief:
        """What the index has said of some recordings, since the catalog was read.

        Args:
            database: The index.
            keys: Of the recordings.
            anew: Ask it now.
        """
        from hybridlog.guarded import Belief

        found = self._belief = Belief.of(database, keys, None if anew else self._belief)
        return found

    # What is in it.

    def recordings(self) -> list[RecordingEntry]:
        """All recordings, oldest first."""
        if self._recordings is None:
            try:
                self._recordings = repair_on_open(self.directory, self.catalog, self.repairs)
            except DiskFullError as error:
                # What is there can be read all the same, and removed.
                self.repairs.disk_full = error
                self.catalog.close()
                self.catalog = open_catalog(self.directory, in_memory=True)
                self._recordings = repair_on_open(self.directory, self.catalog, self.repairs)
        return self._recordings

    def entry(self, recording: str) -> RecordingEntry:
        """The entry of a recording, by its id or its label.

        Raises:
            TopicError: there is none.
        """
        for entry in self.recordings():
            if recording in {entry.id, entry.label}:
                return entry
        raise TopicError(f"Recording {recording!r} is not in the store any more.")

    def refresh(self) -> None:
        """Forget what was read of the catalog."""
        self._recordings = None
        self._is_indexed = False
        self._belief = None
        self._schemas = {}
        self._lanes.clear()
        with self._lock:
            self._columns.clear()  # closed by the last thread that reads from them
            self._segments.clear()
        self._chunk_lists.clear()
        if "kept" in self.__dict__:
            self.kept.clear()
        self.recent_chunks.clear()
        self._learn()

    def _learn(self) -> None:
        """Remember from now on what words of questions mean: to find out takes half of a count.

        Anew, not emptied: who looks something up at this moment looks into what was before.
        """
        self._resolved = lru_cache(_MOST_WORDS)(self._resolve)
        self._compiled = lru_cache(_MOST_WORDS)(self._compile)

    def select(self, names: Sequence[str]) -> list[RecordingEntry]:
        """Recordings by label, by name, by id, or by the beginning of one of these.

        Raises:
            TopicError: there is no such recording, or there are several.
        """
        everything = self.recordings()
        chosen: list[RecordingEntry] = []
        for given in names:
            name = self.repairs.copies.get(given, given)
            found = (
                [r for r in everything if name in {r.label, r.id}]
                or [r for r in everything if r.name == name]
                or [r for r in everything if r.label.startswith(name)]
                or [r for r in everything if len(name) >= 4 and r.id.startswith(name)]
            )
            if len(found) != 1:
                candidates = ", ".join(r.label for r in (found or everything)[:10]) or "none"
                problem = "is ambiguous" if found else "is not in the store"
                raise TopicError(f"Recording {name!r} {problem}. There are: {candidates}.")
            if found[0] not in chosen:
                chosen.append(found[0])
        return chosen

    def topics(self) -> list[str]:
        """Names of all topics, sorted; also of those of which all messages are lost."""
        return sorted({topic for r in self.recordings() for topic in topics_of(r)})

    def lanes(self, recording: RecordingEntry) -> list[Lane]:
        """The channels of a recording, with what reads them."""
        lanes = self._lanes.get(recording.id)
        if lanes is None:
            channels = self._channels(recording)
            lanes = [Lane(recording, i, c) for i, c in sorted(channels.items())]
            self._lanes[recording.id] = lanes
        return lanes

    def _channels(self, recording: RecordingEntry) -> dict[int, Channel]:
        """The channels of a recording, by id."""
        wanted = {c.schema for c in recording.channels if c.schema is not None}
        if not wanted <= self._schemas.keys():
            # Recordings have most of them in common.
            entries = (*self.recordings(), recording)
            used = {c.schema for r in entries for c in r.channels if c.schema is not None}
            with suppress(CatalogError):
                self._schemas = self.catalog.schemas(used)
        if not wanted <= self._schemas.keys():
            # The catalog has lost one.
            return channels_of(take_inventory(self.directory, recording.label).summaries.values())
        return {
            c.id: Channel(
                c.topic,
                c.message_encoding,
                self._schemas[c.schema] if c.schema is not None else None,
                c.metadata,
                has_publish_time=c.has_publish_time,
            )
            for c in recording.channels
        }

    # Asking.

    def topic(self, *names: str) -> Query:
        """A question about one topic or several.

        Args:
            names: Full names, short ones that are unambiguous (`scan`), globs, or
                `re:` and a regular expression.

        Raises:
            TopicError: a name fits nothing, or several topics; lists the candidates.
        """
        return self._resolved(names).again()

    def _resolve(self, names: tuple[str, ...]) -> Query:
        known = self.topics()
        if not names:
            raise TopicError("Which topic? " + _listed(known))
        return self.query(resolve(names, known))

    def all_topics(self) -> Query:
        """A question about everything."""
        return self.query(self.topics())

    def query(self, topics: Sequence[str], recordings: Sequence[str] | None = None) -> Query:
        """A question about topics by their full names, in some recordings or all."""
        wanted = set(topics)
        named = None if recordings is None else {r.id for r in self.select(recordings)}
        chosen = tuple(
            r.id
            for r in self.recordings()
            if (named is None or r.id in named) and not wanted.isdisjoint(topics_of(r))
        )
        if wanted and not chosen:
            raise TopicError(f"No recording chosen has {', '.join(sorted(wanted))}.")
        return Query(self, tuple(topics), chosen)

    def predicate(
        self, text: str, topics: tuple[str, ...], recordings: tuple[str, ...]
    ) -> Predicate:
        """A predicate on some topics of some recordings.

        Raises:
            WhereError: it cannot be understood, or does not fit the fields.
        """
        return self._compiled(text, topics, recordings)

    def _compile(
        self, text: str, topics: tuple[str, ...], recordings: tuple[str, ...]
    ) -> Predicate:
        from hybridlog.query.where import compile_filter

        types = Query(self, topics, recordings).field_types()
        return Predicate(compile_filter(text, field_types=types))

    def chunks(
        self,
        recording: RecordingEntry,
        channels: Sequence[int],
        bounds: tuple[int, int] | None,
        clock: str,
    ) -> list[ChunkEntry]:
        """Chunks that may hold messages of some channels in a time range."""
        if bounds is None or clock != "log" or recording.status == "open":
            return self._fetch_chunks(recording, channels, bounds, clock)
        fetch = partial(self._fetch_chunks, recording, channels)
        return self._chunk_lists.find(recording.id, channels, bounds, fetch)

    def chunks_before(
        self, recording: RecordingEntry, channels: Sequence[int], span: tuple[int, int]
    ) -> Iterator[tuple[ChunkEntry, int]]:
        """Chunks that may hold the last message of some channels by a time.

        Args:
            recording: Of which.
            channels: Channel ids.
            span: Log time of the recording's first message, and the time, ns.

        Yields:
            See `ChunkLists.before`.
        """
        fetch = partial(self._fetch_chunks, recording, channels)
        if recording.status == "open":
            return latest_first(frozenset(channels), span, fetch)
        return self._chunk_lists.before(recording.id, channels, span, fetch)

    def _fetch_chunks(
        self,
        recording: RecordingEntry,
        channels: Sequence[int],
        bounds: tuple[int, int] | None,
        clock: str = "log",
    ) -> list[ChunkEntry]:
        try:
            return self.catalog.chunks(recording, channels, bounds, clock)
        except CatalogError:
            put_again(self.directory, self.catalog, recording)
            return self.catalog.chunks(recording, channels, bounds, clock)

    def segment(self, recording: str, number: int) -> SegmentReader:
        """The reader of a sealed segment of a recording, by id or label, kept open. Thread safe."""
        key = (recording, number)
        with self._lock:
            reader = self._segments.get(key)
            if reader is None:
                _make_room(self._segments)
                path = self.directory.recording(self.entry(recording).label)
                reader = SegmentReader(path / f"{number:06d}.mcap", number)
                self._segments[key] = reader
            return reader

    def columns(self, recording: str) -> FieldColumns | None:
        """The columns that lie beside the segments of a recording; None without good ones."""
        from hybridlog.columns.stored import FieldColumns

        with self._lock:
            if recording not in self._columns:
                _make_room(self._columns)
                self._columns[recording] = None
                with suppress(FileNotFoundError, StoreError, TopicError):  # the index has the same
                    path = self.directory.recording(self.entry(recording).label)
                    found = FieldColumns(path)
                    self._columns[recording] = found
            return self._columns[recording]

    @cached_property
    def kept(self) -> KeptColumns:
        """Fields of messages in memory."""
        from hybridlog.columns.kept import KeptColumns

        return KeptColumns(self)

    # Changing.

    def record(
        self,
        log: str | Path | Source,
        options: RecordOptions | None = None,
        progress: Callable[[int, int], None] | None = None,
        **choices: Any,
    ) -> RecordReport:
        """Record a ROS 1 bag, a ROS 2 bag or an MCAP file.

        Args:
            log: Its path, or a source that was opened and not read yet.
            options: What and how.
            progress: Called with bytes read and messages stored.
            choices: Fields of `RecordOptions`, instead of `options`.

        Raises:
            SourceError: nothing could be read.
            AlreadyRecordedError: its content is in the store already.
        """
        from hybridlog.recorder import RecordOptions, record
        from hybridlog.sources.detect import open_source
        from hybridlog.sources.fingerprint import fingerprint

        with open_source(Path(log)) if isinstance(log, str | Path) else log as source:
            report = record(
                source,
                self.directory,
                self.catalog,
                self.database_for("Recording a log"),
                fingerprint=fingerprint(source.files),
                options=options or RecordOptions(**choices),
                progress=progress,
            )
        self._after(report)
        return report

    def start(self, name: str, options: LiveOptions | None = None, **choices: Any) -> LiveRecording:
        """Start a recording that messages are written to as they come.

        Until it is closed, the garbage collector passes over the objects that are there now.

        Args:
            name: Name of the recording.
            options: How.
            choices: Fields of `LiveOptions`, instead of `options`.
        """
        from hybridlog.live import LiveOptions, LiveRecording

        return LiveRecording(
            self.directory,
            self.catalog,
            self.database_for("Starting a recording"),
            name,
            options or LiveOptions(**choices),
            renew=self._another_database,
            on_close=self._after,
        )

    def _after(self, report: RecordReport) -> None:
        """A recording has ended."""
        self.refresh()
        if report.failure is None and (self._database is None or self._database.ping()):
            return
        # MongoDB has ended meanwhile. If it can be had again, the rest is indexed.
        self.disconnect()
        try:
            self.connect()
        except HybridlogError as error:
            if report.failure is not None:
                report.failure = error if isinstance(error, DatabaseError) else report.failure
            return
        if report.failure is not None:
            report.entry = self.entry(report.entry.id)
            report.indexed, report.missed, report.failure = report.entry.messages, 0, None

    def reindex(
        self,
        recordings: Sequence[str] | None = None,
        progress: Progress | None = None,
    ) -> list[RecordingEntry]:
        """Make the index again from the segments, recording by recording.

        Args:
            recordings: Which; None for all, and then what belongs to no recording is removed.
            progress: Called after each chunk.

        Returns:
            Those that were indexed.

        Raises:
            StoreError: one that was named is being written.
        """
        from hybridlog.maintenance import index

        database = self.database_for("reindex")
        if recordings is None:
            self.catalog.mend()
        self.refresh()
        chosen = self.recordings() if recordings is None else self.select(recordings)
        left = index.reindex(
            self.directory,
            self.catalog,
            database,
            [entry.label for entry in chosen],
            progress,
            everything=recordings is None,
        )
        if recordings is None:
            index.remove_rest(self.directory, self.catalog, database, self.recordings(), progress)
        elif left:
            raise being_written(left[0])
        self.refresh()
        done = {entry.id for entry in chosen if entry.label not in left}
        return [entry for entry in self.recordings() if entry.id in done]

    def add_index(self, topic: str, *fields: str) -> list[FieldIndex]:
        """Let MongoDB find messages by the values of fields without looking at all of them.

        Args:
            topic: Full name, short name, glob, or `re:` and a regular expression.
            fields: Of the messages, or `_meta.inserted_at` and its like; the first one
                should be asked for a value or a range, the others narrow that down.

        Returns:
            All indexes of the topics.

        Raises:
            TopicError: there is no such topic or field.
            DatabaseError: MongoDB cannot make it: two of the fields are arrays.
        """
        query = self.topic(topic)
        database = self.database_for("An index")
        query.fields(*(name for name in fields if name not in field_indexes.OWN_FIELDS))
        field_indexes.add(database, query.topics, fields)
        return field_indexes.of_topics(database, query.topics)

    def remove_index(self, topic: str, *fields: str) -> int:
        """Drop the index on just these fields; returns from how many topics.

        Raises:
            TopicError: there is no such topic.
        """
        query = self.topic(topic)
        database = self.database_for("An index")
        return field_indexes.remove(database, query.topics, fields)

    def indexes(self, *topics: str) -> list[FieldIndex]:
        """The indexes on fields, of these topics or of all."""
        database = self.database_for("Indexes")
        names = self.topic(*topics).topics if topics else self.topics()
        return field_indexes.of_topics(database, names)

    def verify(
        self, recordings: Sequence[str] | None = None, progress: Progress | None = None
    ) -> Verification:
        """Read everything, check checksums, compare catalog and index with the segments.

        Args:
            recordings: Which; None for all.
            progress: Called after each chunk.
        """
        from hybridlog.maintenance.verify import verify

        self.refresh()
        labels = None if recordings is None else [r.label for r in self.select(recordings)]
        return verify(
            self.directory,
            self.catalog,
            self.database,
            self.repairs,
            labels=labels,
            progress=progress,
        )

    def remove(self, recording: str) -> None:
        """Delete a recording: its intent is on the disk first, then everything goes.

        Args:
            recording: Label, name, or id. The label of a copy removes that copy alone.

        Raises:
            StoreError: it is being written.
        """
        from hybridlog.maintenance import removal

        self.refresh()
        self.recordings()
        try:
            if recording in self.repairs.copies:
                removal.remove_copy(self.directory, recording)
            else:
                (entry,) = self.select([recording])
                removal.remove(self.directory, self.catalog, self.database, entry)
        finally:
            self.refresh()

    def rename(self, recording: str, name: str) -> RecordingEntry:
        """Give a recording another name; its directory gets a label made from it."""
        return self._edit(recording, journal.event(journal.RENAMED, name=text(name)))

    def tag(self, recording: str, **tags: str) -> RecordingEntry:
        """Keep tags with a recording; those of the same keys are replaced."""
        lines = [journal.event(journal.TAGGED, key=text(k), value=text(v)) for k, v in tags.items()]
        return self._edit(recording, *lines)

    def untag(self, recording: str, *keys: str) -> RecordingEntry:
        """Remove tags of a recording.

        Raises:
            UsageError: it has no such tag.
        """
        (entry,) = self.select([recording])
        for key in keys:
            if key not in entry.tags:
                known = ", ".join(sorted(entry.tags)) or "none"
                raise UsageError(f"{entry.label} has no tag {key!r}. Its tags: {known}.")
        return self._edit(recording, *[journal.event(journal.UNTAGGED, key=key) for key in keys])

    def note(self, recording: str, note: str) -> RecordingEntry:
        """Write a note about a recording; `info` shows it."""
        return self._edit(recording, journal.event(journal.NOTED, text=text(note)))

    def _edit(self, recording: str, *lines: journal.Event) -> RecordingEntry:
        from hybridlog.maintenance import edit, index

        self.refresh()
        (entry,) = self.select([recording])
        edit.append(self.directory, self.catalog, entry, lines)
        if self.connected is not None:
            index.mirror(self.catalog, self.connected, entry.id)
        self.refresh()
        return self.entry(entry.id)

    def mark(
        self, recording: str, moment: TimeLike, note: str, tags: Mapping[str, str] | None = None
    ) -> RecordingEntry:
        """Set a mark at a time of a recording that has ended; questions find it like others.

        Args:
            recording: Label, name, or id.
            moment: Log time, as for `Query.between`.
            note: What happened.
            tags: Kept with it.

        Raises:
            TimeError: `moment` is no time.
            StoreError: the recording is being written: mark it while it runs.
        """
        from hybridlog.maintenance import edit

        self.refresh()
        (entry,) = self.select([recording])
        start, end = span_of(entry)
        time = parse_time(moment, start=start, end=end)
        edit.mark(self.directory, self.catalog, entry, time, text=text(note), tags=tags or {})
        self.refresh()
        return self.entry(entry.id)

    def import_from(
        self,
        other: str | Path,
        recordings: Sequence[str] | None = None,
        progress: Progress | None = None,
    ) -> ImportReport:
        """Copy recordings in from another store; what was copied before is not copied again.

        Args:
            other: The other store's directory.
            recordings: Which; None for all.
            progress: Called while files are copied and checked.

        Raises:
            StoreError: there is no store, or a recording of it is damaged or being written.
        """
        from hybridlog.maintenance import imports

        with Store(StoreDirectory(Path(other)), mongo=EMBEDDED) as source:
            chosen = source.recordings() if recordings is None else source.select(recordings)
            report = imports.run(source.directory, self.directory, chosen, progress)
        self.refresh()
        return report

    def repair(
        self, recordings: Sequence[str] | None = None, progress: Progress | None = None
    ) -> list[Repaired]:
        """Apply the cures that lose nothing; returns what was done.

        Args:
            recordings: Which; None for all.
            progress: Called after each chunk.
        """
        from hybridlog.maintenance.repair import repair, repair_index

        self.refresh()
        labels = None if recordings is None else [r.label for r in self.select(recordings)]
        done = repair(self.directory, self.catalog, self.repairs, labels)
        self.refresh()
        database = self.database
        if database is not None:
            done += repair_index(
                self.directory,
                self.catalog,
                database,
                self.recordings(),
                labels=labels,
                progress=progress,
            )
            self.refresh()
        return done

    def take_over(self) -> None:
        """Say that this store lies here now: it was moved, and its index comes along.

        Raises:
            DatabaseError: MongoDB does not answer.
            StoreError: the database holds the index of another store.
        """
        from hybridlog.maintenance import lease
        from hybridlog_storage.index_state import IndexState

        self.disconnect()
        with self._another_database() as database:
            state = IndexState(database)
            place = lease.place_of(self.directory)
            lease.check(state.mark(), place, database, embedded=True)
            state.claim(place)
        self.without_database = None

    def _claim(self, database: Database) -> None:
        """Make sure that the database is this store's, and nobody else's."""
        from hybridlog.maintenance import lease
        from hybridlog_storage.index_state import IndexState

        state = IndexState(database)
        place = lease.place_of(self.directory)
        if lease.check(state.mark(), place, database, embedded=self._uri == EMBEDDED):
            state.claim(place)


def _make_room(opened: dict[Any, Any]) -> None:
    """Let go of the file that was opened first, if there are many.

    It is closed when the last thread that reads from it lets go of it, too.
    """
    if len(opened) >= _MOST_OPEN:
        del opened[next(iter(opened))]


def _listed(names: Sequence[str]) -> str:
    return "There are: " + ", ".join(names[:20]) if names else "The store is empty."
