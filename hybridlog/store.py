"""Opening a store: the one module that wires directory, database, segments and reader."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from hybridlog import field_indexes, maintenance
from hybridlog.columns.kept import KeptColumns
from hybridlog.columns.stored import FieldColumns
from hybridlog.field_indexes import FieldIndex
from hybridlog.query.chunk_lists import ChunkLists, latest_first
from hybridlog.query.plan import Lane
from hybridlog.query.predicate import Predicate
from hybridlog.query.recent_chunks import RecentChunks
from hybridlog.query.topics import resolve
from hybridlog.reader import Query
from hybridlog_storage.catalog import Catalog, ChunkEntry, RecordingEntry
from hybridlog_storage.collection_names import collection_of
from hybridlog_storage.directory import StoreDirectory
from hybridlog_storage.errors import (
    DatabaseError,
    HybridlogError,
    MissingDependencyError,
    StoreError,
    TopicError,
)
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.segment_reader import SegmentReader

if TYPE_CHECKING:
    from hybridlog.live import LiveOptions, LiveRecording
    from hybridlog.recorder import RecordOptions, RecordReport
    from hybridlog.segment_catalog import SegmentCatalog
    from hybridlog.sources.base import Source
    from hybridlog_storage.database import Database
    from hybridlog_storage.mongod import EmbeddedMongod

DEFAULT_STORE = "hybridlog-store"
EMBEDDED = "embedded"  # in place of a URI: the MongoDB that comes with hybridlog
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
    require_database: bool = False,
    progress: maintenance.Progress | None = None,
) -> Store:
    """Open a store; what a crash has left is mended first.

    Args:
        path: Its directory; without, `HYBRIDLOG_STORE` or `./hybridlog-store`.
        mongo: URI of the MongoDB that holds the index, or `embedded`; without,
            `HYBRIDLOG_MONGO_URI`, the store's own setting, or the embedded MongoDB.
        create: Make the store if there is none.
        require_database: Fail when MongoDB is away, rather than read by time only.
        progress: Called while an index is brought up to date.

    Raises:
        StoreError: there is no store there, or it is of a newer format.
        DatabaseError: MongoDB does not answer and `require_database` is set.
    """
    where = store_path(path)
    wanted = mongo or os.environ.get("HYBRIDLOG_MONGO_URI")
    if create:
        directory = StoreDirectory.create(where, mongo=None if mongo == EMBEDDED else mongo)
        directory.check_writable()
    else:
        directory = StoreDirectory(where)
    store = Store(directory)
    try:
        store.connect(wanted or directory.settings.mongo or EMBEDDED)
        # What is read of the catalog here, the first question need not ask for.
        database, recordings = store.database_for("This"), store.recordings()
        store.learn_schemas()
        store.tended = maintenance.tend(directory, database, recordings, progress)
        if store.tended != maintenance.Tended():
            store.refresh()
    except (DatabaseError, MissingDependencyError) as error:
        if require_database:
            store.close()
            raise
        store.disconnect()
        store.without_database = error
    except BaseException:
        store.close()
        raise
    return store


class Store:
    """A directory of recordings and the database that makes them answerable.

    Use `hybridlog.open`; a store is a context manager. One store may be used by several
    threads for reading.

    Attributes:
        directory: Where it lies.
        database: The index; None while MongoDB is away.
        without_database: Why it is away.
        tended: What had to be mended when it was opened.
        kept: Columns of what is asked for again and again.
        recent_chunks: Chunks that single messages were read from.
    """

    def __init__(self, directory: StoreDirectory) -> None:
        self.directory = directory
        self.database: Database | None = None
        self.without_database: HybridlogError | None = None
        self.tended = maintenance.Tended()
        self._mongod: EmbeddedMongod | None = None
        self._uri = EMBEDDED
        self._catalog: Catalog | SegmentCatalog | None = None
        self._recordings: list[RecordingEntry] | None = None
        self._schemas: dict[str, Schema] = {}
        self._lanes: dict[str, list[Lane]] = {}
        self._segments: dict[tuple[str, int], SegmentReader] = {}
        self._columns: dict[str, FieldColumns | None] = {}
        self._chunk_lists = ChunkLists()
        self.kept = KeptColumns(self)
        self.recent_chunks = RecentChunks()
        self._lock = threading.Lock()
        self._learn()

    def __enter__(self) -> Self:
        """The store itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()

    def __repr__(self) -> str:
        return f"<Store {self.directory.path}>"

    # Connection.

    def connect(self, uri: str) -> None:
        """Connect to the MongoDB at a URI, or to the embedded one (`embedded`).

        Raises:
            DatabaseError: it does not answer, or holds the index of another store.
        """
        self._uri = uri
        self.database = self._another_database()
        self._claim(self.database)
        catalog = Catalog(self.database)
        catalog.prepare()
        self._catalog = catalog

    def _another_database(self) -> Database:
        """A connection; the embedded MongoDB is started if it is not there (any more).

        Raises:
            DatabaseError: it does not answer.
        """
        from hybridlog_storage.database import Database

        uri = self._uri
        if uri == EMBEDDED:
            from hybridlog_storage.mongod import EmbeddedMongod

            self._mongod = self._mongod or EmbeddedMongod(self.directory.mongod)
            try:
                uri = self._mongod.start()
            except StoreError as error:
                # A store that cannot be written has no embedded MongoDB; its segments do.
                raise DatabaseError(str(error)) from error
        return Database.connect(uri)

    def disconnect(self) -> None:
        """Leave the database; what remains is reading by time."""
        if self.database is not None:
            self.database.close()
        self.database = None
        self._catalog = None
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

    def database_for(self, purpose: str) -> Database:
        """The database.

        Raises:
            DatabaseError: it is away; says what it was needed for and why it is away.
        """
        if self.database is None:
            raise DatabaseError(f"{purpose} needs MongoDB. {self.without_database or ''}".strip())
        return self.database

    @property
    def catalog(self) -> Catalog | SegmentCatalog:
        """The catalog, out of MongoDB, or out of the segments while that is away."""
        if self._catalog is None:
            from hybridlog.segment_catalog import SegmentCatalog

            self._catalog = SegmentCatalog(self.directory)
        return self._catalog

    # What is in it.

    def recordings(self) -> list[RecordingEntry]:
        """All recordings, oldest first."""
        if self._recordings is None:
            self._recordings = self.catalog.recordings()
        return self._recordings

    def refresh(self) -> None:
        """Forget what was read of the catalog."""
        self._recordings = None
        self._schemas = {}
        self._lanes.clear()
        with self._lock:
            self._columns.clear()  # closed by the last thread that reads from them
        self._chunk_lists.clear()
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
        """Recordings by id, by name, or by the beginning of an id when it is unambiguous.

        Raises:
            TopicError: there is no such recording, or there are several.
        """
        everything = self.recordings()
        chosen: list[RecordingEntry] = []
        for name in names:
            found = (
                [r for r in everything if r.id == name]
                or [r for r in everything if r.name == name]
                or [r for r in everything if r.id.startswith(name)]
            )
            if len(found) != 1:
                candidates = ", ".join(r.id for r in (found or everything)[:10]) or "none"
                problem = "is ambiguous" if found else "is not in the store"
                raise TopicError(f"Recording {name!r} {problem}. There are: {candidates}.")
            if found[0] not in chosen:
                chosen.append(found[0])
        return chosen

    def topics(self) -> list[str]:
        """Names of all topics, sorted."""
        return sorted({c.topic for r in self.recordings() for c in r.channels})

    def lanes(self, recording: RecordingEntry) -> list[Lane]:
        """The channels of a recording, with what reads them."""
        lanes = self._lanes.get(recording.id)
        if lanes is None:
            channels = self._channels(recording)
            lanes = [Lane(recording, i, c) for i, c in sorted(channels.items())]
            self._lanes[recording.id] = lanes
        return lanes

    def _channels(self, recording: RecordingEntry) -> dict[int, Channel]:
        """The channels of a recording, by id; out of its segments when MongoDB lacks a schema."""
        schemas = self._schemas_for(recording)
        if not all(c.schema is None or c.schema in schemas for c in recording.channels):
            from hybridlog.segment_catalog import channels_of_recording

            return channels_of_recording(self.directory, recording.id)
        return {
            c.id: Channel(
                c.topic,
                c.message_encoding,
                schemas[c.schema] if c.schema is not None else None,
                c.metadata,
                has_publish_time=c.has_publish_time,
            )
            for c in recording.channels
        }

    def _schemas_for(self, recording: RecordingEntry) -> dict[str, Schema]:
        """Schemas by hash: those of a recording, as far as MongoDB has them, and of others."""
        wanted = {c.schema for c in recording.channels if c.schema is not None}
        if self.database is not None and not wanted <= self._schemas.keys():
            self.learn_schemas(recording)
        return self._schemas

    def learn_schemas(self, *others: RecordingEntry) -> None:
        """Fetch the schemas of all recordings at once: they have most of them in common.

        Args:
            others: Recordings that may have come since the catalog was read.

        Raises:
            DatabaseError: MongoDB is away.
        """
        entries = (*self.recordings(), *others)
        used = {c.schema for r in entries for c in r.channels if c.schema is not None}
        if used:  # of a new store there is nothing to ask for
            self._schemas = Catalog(self.database_for("A schema")).schemas(used)

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
        chosen = tuple(
            r.id
            for r in self.recordings()
            if (recordings is None or r.id in recordings)
            and any(c.topic in wanted for c in r.channels)
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
        longest = None
        if recording.status != "open":
            wanted = set(channels)
            longest = max(
                (c.stats.longest for c in recording.channels if c.id in wanted), default=0
            )
        return self.catalog.chunks(recording.id, channels, bounds, clock, longest, brief=True)

    def segment(self, recording: str, number: int) -> SegmentReader:
        """The reader of a sealed segment, kept open. Thread safe."""
        key = (recording, number)
        with self._lock:
            reader = self._segments.get(key)
            if reader is None:
                _make_room(self._segments)
                path = self.directory.recording(recording) / f"{number:06d}.mcap"
                reader = self._segments[key] = SegmentReader(path, number)
            return reader

    def columns(self, recording: str) -> FieldColumns | None:
        """The columns that lie beside the segments of a recording; None without good ones."""
        with self._lock:
            if recording not in self._columns:
                _make_room(self._columns)
                self._columns[recording] = None
                with suppress(FileNotFoundError, StoreError):  # the index has the same
                    found = FieldColumns(self.directory.recording(recording))
                    self._columns[recording] = found
            return self._columns[recording]

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

        with (
            open_source(Path(log)) if isinstance(log, str | Path) else log as source,
            self.directory.using_index(),
        ):
            report = record(
                source,
                self.directory,
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
            self.database_for("Starting a recording"),
            name,
            options or LiveOptions(**choices),
            renew=self._another_database,
            on_close=self._after,
        )

    def _after(self, report: RecordReport) -> None:
        """A recording has ended."""
        if report.failure is not None:
            self._catch_up(report)
        elif self.database is not None and not self.database.ping():
            # It has ended meanwhile, and the recording has found another connection.
            self.disconnect()
            try:
                self.connect(self._uri)
            except DatabaseError as error:
                self.without_database = error
        self.refresh()

    def _catch_up(self, report: RecordReport) -> None:
        """MongoDB failed while a log was recorded: index the rest, if it can be had again."""
        try:
            self.disconnect()
            self.connect(self._uri)
            maintenance.catch_up(self.directory, self.database_for("The index"), report.entry.id)
            self.refresh()
            (report.entry,) = self.select([report.entry.id])
        except DatabaseError as error:
            report.failure = error
            self.disconnect()  # what it does not know of, the segments do
            self.without_database = error
            return
        report.indexed, report.missed, report.failure = report.entry.messages, 0, None

    def reindex(self, progress: maintenance.Progress | None = None) -> list[RecordingEntry]:
        """Drop the index and make it again from the segments."""
        database = self.database_for("reindex")
        with self.directory.using_index(rebuild=True):
            found = maintenance.reindex(self.directory, database, progress)
        self.refresh()
        return found

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
        with self.directory.using_index():
            field_indexes.add(database, query.topics, fields)
        return field_indexes.of_topics(database, query.topics)

    def remove_index(self, topic: str, *fields: str) -> int:
        """Drop the index on just these fields; returns from how many topics.

        Raises:
            TopicError: there is no such topic.
        """
        query = self.topic(topic)
        database = self.database_for("An index")
        with self.directory.using_index():
            return field_indexes.remove(database, query.topics, fields)

    def indexes(self, *topics: str) -> list[FieldIndex]:
        """The indexes on fields, of these topics or of all."""
        database = self.database_for("Indexes")
        names = self.topic(*topics).topics if topics else self.topics()
        return field_indexes.of_topics(database, names)

    def verify(
        self,
        recordings: Sequence[str] | None = None,
        progress: maintenance.Progress | None = None,
    ) -> maintenance.Verification:
        """Read everything, check checksums, compare the index with the segments."""
        database = self.database_for("verify")
        with self.directory.using_index():
            chosen = (
                self.directory.recording_ids()
                if recordings is None
                else [r.id for r in self.select(recordings)]
            )
            return maintenance.verify(self.directory, database, chosen, progress)

    def remove(self, recording: str) -> None:
        """Delete a recording: first from the catalog, then its files."""
        database = self.database_for("Removing a recording")
        with ExitStack() as held:
            held.enter_context(self.directory.using_index())
            self.refresh()
            entry = self.select([recording])[0]
            if not held.enter_context(self.directory.writing(entry.id)):
                raise maintenance.being_written(entry.id)
            Catalog(database).remove_recording(
                entry.id, {collection_of(c.topic) for c in entry.channels}
            )
            with self._lock:
                for key in [k for k in self._segments if k[0] == entry.id]:
                    self._segments.pop(key).close()
            self.directory.remove_recording(entry.id)
        self.refresh()

    def _claim(self, database: Database) -> None:
        """Make sure that the database is this store's, and nobody else's."""
        mine = self.directory.settings.store_id
        if not check_claim(database, mine):
            database.replace(maintenance.STORE_MARK, {"_id": "store"}, {"_id": "store", "id": mine})


def check_claim(database: Database, store_id: str | None = None) -> bool:
    """Check that a database holds no index but that of one store.

    Args:
        database: Connected.
        store_id: The store; None for one that is yet to be made.

    Returns:
        Whether it is that store's already.

    Raises:
        StoreError: it holds the index of another one.
    """
    mark = database.find_one(maintenance.STORE_MARK, {"_id": "store"})
    if mark is not None and mark.get("id") != store_id:
        raise StoreError(
            f"The database {database.name!r} at {database.address} holds the index of "
            "another store. Name a database of its own in the URI: mongodb://host/NAME."
        )
    return mark is not None


def _make_room(opened: dict[Any, Any]) -> None:
    """Let go of the file that was opened first, if there are many.

    It is closed when the last thread that reads from it lets go of it, too.
    """
    if len(opened) >= _MOST_OPEN:
        del opened[next(iter(opened))]


def _listed(names: Sequence[str]) -> str:
    return "There are: " + ", ".join(names[:20]) if names else "The store is empty."
