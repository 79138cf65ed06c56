"""The state of an open store: the catalog's snapshot, open files, the index, caches."""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import (
    Callable,
    Collection,
    Generator,
    Iterable,
    Iterator,
    Mapping,
    Sequence,
)
from contextlib import closing, contextmanager, suppress
from functools import lru_cache, partial, wraps
from itertools import accumulate
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, Protocol, TypeVar

import numpy as np

from hybridlog.columns.payload_files import RecordingPayloads, open_segment
from hybridlog.entries import channels_of, read_again, summary_of, take_inventory
from hybridlog.index.connection import Connection
from hybridlog.maintenance.opening import StoreFiles, open_catalog
from hybridlog.maintenance.report import Progress, RepairReport
from hybridlog.query.chunk_columns import ChunkColumns
from hybridlog.query.chunk_counts import Parts, part_rows
from hybridlog.query.question import RecordedChannel, field_types
from hybridlog.query.topics import resolve
from hybridlog.snapshot import UNFINISHED
from hybridlog.wording import listed
from hybridlog_storage.cache import Cache
from hybridlog_storage.catalog import ChannelStats
from hybridlog_storage.disk import files
from hybridlog_storage.errors import (
    CatalogError,
    ConnectionBrokenError,
    ConnectionLostError,
    DatabaseError,
    DiskFullError,
    HybridlogError,
    MissingDependencyError,
    ResourceError,
    SegmentError,
    StoreError,
    TopicError,
    UsageError,
)
from hybridlog_storage.lazy import lazy
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.segments.segment_reader import SegmentReader, place_of
from hybridlog_storage.times import BEGIN, END, placed

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from hybridlog.columns.tables import Tables
    from hybridlog.columns.topic_table import TopicTable
    from hybridlog.index.index_writer import IndexTarget
    from hybridlog.query.chunk_columns import Chunk
    from hybridlog.query.predicate.tree import Predicate
    from hybridlog.query.question import Question
    from hybridlog.record.running import RunningRecording
    from hybridlog.snapshot import Snapshot
    from hybridlog_storage.catalog import Catalog, RecordingEntry
    from hybridlog_storage.disk.directory import StoreDirectory
    from hybridlog_storage.mongo.database import Database
    from hybridlog_storage.mongo.topic_places import TopicPlaces
    from hybridlog_storage.segments.chunk import StoredChunk
    from hybridlog_storage.segments.chunk_table import ChunkTable
    from hybridlog_storage.segments.segment_reader import ChunkPlace
    from hybridlog_storage.summary import RecordingSummary

_MAX_NAMES = 5  # recordings in a message
_MAX_OPEN_SEGMENTS = 256
_ROW_BYTES = 44  # of a message's columns in a chunk
_MAX_COLUMNS = 4096  # sets of chunks that are at hand
_MAX_MEANINGS = 128  # topic patterns and predicates that are cached
_TRIES = 5  # to connect, while the connection breaks; to find a recording, while it is renamed
_PAUSE_S = 0.1  # before the second try; doubles each time
_LONG_LOOK_S = 0.05  # a look for new recordings that takes longer is not made all the time,
_LOOK_SHARE = 0.1  # but for this share of it,
_MAX_BETWEEN_LOOKS_S = 1.0  # and at least so often
_REST_S = 10.0
"""Seconds after a failure in which questions do not try to connect again."""


_P = ParamSpec("_P")
_T = TypeVar("_T")
_Owner = TypeVar("_Owner", bound="HasSession")


class HasSession(Protocol):
    """Something that asks an open store."""

    @property
    def session(self) -> Session:
        """The open store."""


def of_one_moment(
    work: Callable[Concatenate[_Owner, _P], _T],
) -> Callable[Concatenate[_Owner, _P], _T]:
    """Let a method see the recordings of one moment, see `Session.at_one_moment`.

    Files that were sealed, rewritten or removed meanwhile are looked for once more.
    """

    @wraps(work)
    def pinned(self: _Owner, /, *args: _P.args, **options: _P.kwargs) -> _T:
        session = self.session
        with session.at_one_moment():
            before = session.invalidations
            try:
                return work(self, *args, **options)
            except StoreError:
                if session.invalidations == before:  # no stream within it noticed it
                    if not session.has_changed():
                        raise
                    session.invalidate()
                return work(self, *args, **options)

    return pinned


class _Moment:
    """The recordings of a store at one moment.

    Args:
        snapshot: All recordings; running ones as they were at the last look. None if they are
            not read yet.

    Attributes:
        snapshot: As above.
        entries: Entries of recordings that were looked at in this moment, by id.
    """

    def __init__(self, snapshot: Snapshot | None = None) -> None:
        self.snapshot = snapshot
        self.entries: dict[str, RecordingEntry] = {}


class Session:
    """The state of one open store. Thread safe for reading.

    Questions see the recordings of one moment, see `at_one_moment`. What running recordings have
    flushed by then is read when a question is about them.

    Args:
        directory: The store's directory.
        mongo: URI of the MongoDB that holds the index, `embedded`, or `none`; None for the one
            in the store's settings.
        progress: Called while an index is brought up to date.
        cache_mb: Size of the embedded MongoDB's cache in MiB; None for the one in the store's
            settings.
        recover: False to leave what a crash has cut, and what the index lacks of it, to another
            opening.

    Attributes:
        directory: The store's directory.
        connection: The connection to MongoDB.
        repairs: Repairs made when the store was opened.
        unavailable: The reason why MongoDB is unavailable; None while that is unknown.
        cache: What was read or worked out; chunks of single messages are a kind of it.
        invalidations: How often everything that was read was dropped.
    """

    def __init__(
        self,
        directory: StoreDirectory,
        mongo: str | None,
        progress: Progress | None,
        cache_mb: int | None = None,
        *,
        recover: bool = True,
    ) -> None:
        self._process = os.getpid()
        self.directory = directory
        self._progress = progress
        self.connection = Connection(directory, mongo, cache_mb)
        self.repairs = RepairReport()
        self.cache = Cache()
        self.unavailable: HybridlogError | None = None
        self._rests_until = 0.0
        self._connecting = threading.RLock()
        self._is_indexed = False  # the index has all recordings of the snapshot
        self._stale: set[str] = set()  # recordings that the index may lack
        self._recovers = recover
        self._is_opened = False  # what a crash left was repaired, unless it is left to another
        self._latest = _Moment()
        self._pinned = threading.local()  # the moment that this thread asks about
        self._changed = 0, False  # as of the snapshot, see `StoreDirectory.changed`
        self._names: list[str] = []  # in `recordings`
        self._looks_at = 0.0  # when the next look for new recordings is due, by `monotonic`
        self._running: dict[str, RunningRecording] = {}
        self.invalidations = 0
        self._following = threading.RLock()
        self._mending = threading.Lock()
        self._entries: dict[str, RecordingEntry] = {}  # compared with their files, by id
        self._places: TopicPlaces | None = None
        self._schemas: dict[str, Schema] = {}
        self._channels: dict[str, tuple[RecordingEntry, list[RecordedChannel]]] = {}
        self._by_topic: dict[str, tuple[RecordingEntry, dict[str, list[RecordedChannel]]]] = {}
        self._segments: dict[tuple[str, int, str], SegmentReader] = {}
        self._contents: dict[tuple[Path, frozenset[tuple[str, str]]], RecordingPayloads] = {}
        self._columns: dict[tuple[str, int, frozenset[int]], tuple[ChunkTable, ChunkColumns]] = {}
        self._tables_tried: set[tuple[str, str]] = set()  # looked for, and noted if missing
        self._lock = threading.Lock()
        self._reset_meanings()

    @property
    def is_inherited(self) -> bool:
        """True in a child of the process that opened the store."""
        return os.getpid() != self._process

    def here(self) -> Session:
        """This session, in the process that opened the store.

        Raises:
            UsageError: This is a forked process.
        """
        if self.is_inherited:
            raise UsageError(
                f"The store {self.directory.place} was opened before this process was forked: open "
                "it here, in the child."
            )
        return self

    # The index.

    @property
    def connected(self) -> Database | None:
        """The index, if it is connected already."""
        return self.connection.database

    @property
    def database(self) -> Database | None:
        """The index, connected when it is needed; None if MongoDB is unavailable.

        A failure is remembered for some seconds.
        """
        return self._reached(brings=True)

    def _reached(self, *, brings: bool) -> Database | None:
        """The index, connected when it is needed; `brings` it up to date first."""
        is_ready = self._is_indexed or not brings
        if (self.connected is None or not is_ready) and time.monotonic() >= self._rests_until:
            with suppress(HybridlogError):
                self.connect(brings=brings)
        return self.connected

    def index_as_it_is(self) -> Database:
        """The index, for a MongoDB filter; it may lack recordings.

        Raises:
            DatabaseError: it is unavailable; has the reason.
        """
        database = self._reached(brings=False)
        if database is None:
            raise self._missing_database("A MongoDB filter (a predicate needs none)")
        return database

    def connect(self, *, brings: bool = True) -> Database:
        """Connect to the index and bring it up to date; try again if the connection breaks.

        Args:
            brings: False to leave it as it is.

        Raises:
            DatabaseError: MongoDB does not answer.
            StoreError: it holds the index of another store, or this store is a copy.
        """
        with self._connecting:
            if self.connected is not None and (self._is_indexed or not brings):
                return self.connected
            try:
                if self.connected is not None:  # it may have been lost: a new one follows
                    with suppress(ConnectionLostError):
                        return self._connect(brings=brings)
                for tried in range(1, _TRIES):
                    with suppress(ConnectionBrokenError):
                        return self._connect(brings=brings)
                    time.sleep(_PAUSE_S * 2 ** (tried - 1))
                return self._connect(brings=brings)
            except BaseException as error:
                self.disconnect()
                if isinstance(error, HybridlogError):
                    self.unavailable = error
                    self._rests_until = time.monotonic() + _REST_S
                raise

    def _connect(self, *, brings: bool) -> Database:
        from hybridlog.maintenance import index

        if self.connected is None:
            self._places = None
            self._is_indexed = False
        repairs = RepairReport()
        has_changed = False
        try:
            database = self.connection.open()
            if brings and self.connection.may_write:
                store = index.StoreIndex(self.directory, self.catalog, database, self._progress)
                has_changed = store.bring_up_to_date(
                    self.snapshot(),
                    self.entry_of,
                    index=self.connection.index,
                    stale=self._stale,
                    report=repairs,
                )
        finally:
            self.repairs.damage += self.connection.damage
            self.connection.damage.clear()
            self.repairs.indexed.update(repairs.indexed)
            self.repairs.unreadable.update(repairs.unreadable)
            self.repairs.removed += repairs.removed
        self.unavailable = None
        self._rests_until = 0.0
        if brings:
            self._stale = set()
            if has_changed:
                self.invalidate()
            self._is_indexed = True
        return database

    def disconnect(self) -> None:
        """Disconnect from MongoDB; questions are then answered from the files."""
        self.connection.close()
        self._places = None

    def take_over(self) -> None:
        """Record in the index that the store is at this location."""
        self.connection.take_over()
        self.unavailable = None
        self._rests_until = 0.0

    def database_for(self, purpose: str, *, writes: bool = False) -> Database:
        """The index.

        Args:
            purpose: The activity, for messages.
            writes: True if it changes the index.

        Raises:
            DatabaseError: it is unavailable, or may not be changed; has the purpose and the
                reason.
        """
        return self._checked(self.database, purpose, writes=writes)

    def _checked(self, database: Database | None, purpose: str, *, writes: bool) -> Database:
        """The index, if there is one that may be used; raises as `database_for` does."""
        if database is None:
            raise self._missing_database(purpose)
        if writes and not self.connection.may_write:
            raise DatabaseError(
                f"{purpose} needs a MongoDB user who may write. This one may only read: grant "
                f"the role readWrite on the database {database.name!r}."
            )
        return database

    def _missing_database(self, purpose: str) -> DatabaseError:
        return DatabaseError(f"{purpose} needs MongoDB. {self.unavailable or ''}".strip())

    @property
    def writable_database(self) -> Database | None:
        """The index; None if it is unavailable, or if its user may only read."""
        database = self.database
        return database if self.connection.may_write else None

    def index_to_record(self, purpose: str) -> IndexTarget:
        """The index, for a new recording; it may lack other recordings, or be unavailable.

        Raises:
            DatabaseError: as for `database_for`, if it was reached.
            StoreError: it holds the index of another store, or this store is a copy.
        """
        from hybridlog.index.index_writer import IndexTarget

        if self.connected is not None and self.connection.may_write:
            if self.connected.ping():
                return IndexTarget(self.connected, renew=self._another_database)
            self.disconnect()
        # Those that a crash has cut are brought into the index by another opening.
        database = self._reached(brings=self._recovers)
        if database is None and self.unavailable is not None:
            if isinstance(self.unavailable, ConnectionLostError):
                return IndexTarget(failure=self.unavailable, renew=self._another_database)
            if self.connection.has_none:
                return IndexTarget()
            if isinstance(self.unavailable, StoreError):
                raise self.unavailable
        database = self._checked(database, purpose, writes=True)
        return IndexTarget(database, renew=self._another_database)

    def _another_database(self) -> Database:
        """An additional connection to the index.

        Raises:
            DatabaseError: It does not answer, or belongs to another store.
        """
        try:
            if not self.connection.index:
                with self._connecting:
                    self.connection.open()
            return self.connection.another()
        except (StoreError, ResourceError, MissingDependencyError) as error:
            raise DatabaseError(str(error)) from error

    def places(self, purpose: str) -> TopicPlaces:
        """The places of topics in the index.

        Raises:
            DatabaseError: it is unavailable; has the purpose and the reason.
        """
        from hybridlog_storage.mongo.topic_places import TopicPlaces

        database = self.connected or self.database_for(purpose)
        if self._places is None:
            self._places = TopicPlaces(database)
        return self._places

    # The moment.

    @contextmanager
    def at_one_moment(self) -> Iterator[None]:
        """Let all questions of this thread see the recordings of one moment.

        It begins now, or with the block around it. A running recording is as it was when the
        first question looked at it.
        """
        if getattr(self._pinned, "moment", None) is not None:
            yield
            return
        self._pinned.moment = self.renew()
        try:
            yield
        finally:
            self._pinned.moment = None

    @contextmanager
    def noticing_changes(self) -> Iterator[None]:
        """Let the next question read the store again if an answer meets changed files."""
        try:
            yield
        except StoreError:
            if self.has_changed():
                self.invalidate()
            raise

    def all_at_one_moment(self, steps: Generator[_T, None, None]) -> Generator[_T, None, None]:
        """Let a generator see the recordings of one moment, whichever threads its steps run on.

        The moment begins with the first step, or with the block around it.
        """
        moment = self.renew()
        with closing(steps):
            while True:
                before = getattr(self._pinned, "moment", None)
                self._pinned.moment = moment
                try:
                    step = next(steps)
                except StopIteration:
                    return
                finally:
                    moment, self._pinned.moment = self._pinned.moment, before
                yield step

    @property
    def is_at_one_moment(self) -> bool:
        """True within `at_one_moment`, in this thread."""
        return getattr(self._pinned, "moment", None) is not None

    def renew(self) -> _Moment:
        """Begin a new moment, unless this thread asks about an earlier one."""
        pinned: _Moment | None = getattr(self._pinned, "moment", None)
        if pinned is not None:
            return pinned
        snapshot = self._latest.snapshot
        if snapshot is None:
            return self._latest
        if self._has_names_changed() and time.monotonic() >= self._looks_at:
            self.catch_up()
        elif snapshot.unfinished:
            self._latest = _Moment(snapshot)
        return self._latest

    def _has_names_changed(self) -> bool:
        """True if recordings may have come, gone, or got other names since the snapshot."""
        now, before = self.directory.changed(), self._changed
        if now[0] == before[0] and not before[1] and self.directory.names() == self._names:
            self._changed = now
        return self._changed != now

    def has_changed(self) -> bool:
        """True if files of recordings that were read look different by now."""
        if self._has_names_changed():
            return True
        for recording, entry in [*self._moment.entries.items()]:
            running = self._running.get(recording)
            if running is None:
                if entry.flushed:
                    return True
            elif running.entry is not entry or running.is_cut():  # another thread has looked
                return True
        read = self._entries.keys() | self._moment.entries.keys()
        summaries = [one for one in self.snapshot().summaries if one.id in read]
        looks = self.directory.looks([one.label for one in summaries])
        return any(looks.get(one.label) != one.look for one in summaries)

    @property
    def _moment(self) -> _Moment:
        return getattr(self._pinned, "moment", None) or self._latest

    def look(self, recordings: Collection[str] | None = None) -> Snapshot:
        """See what running recordings have flushed.

        Args:
            recordings: Their ids; None for all.

        Returns:
            All recordings of the moment.
        """
        moment = self._moment
        snapshot = self._snapshot_of(moment)
        for place in snapshot.unfinished:
            recording = snapshot.summaries[place].id
            if recordings is None or recording in recordings:
                self._follow(moment, recording)
        return self._snapshot_of(moment)

    def _follow(self, moment: _Moment, recording: str) -> RecordingEntry | None:
        """The entry of a running recording with what is flushed; None if it is gone."""
        with self._following:
            if recording in moment.entries:
                return moment.entries[recording]
            snapshot = self._snapshot_of(moment)
            place = snapshot.by_id.get(recording)
            if place is None:
                return None
            summary = snapshot.summaries[place]
            running = self._running.get(recording)
            if running is None:
                from hybridlog.record.running import RunningRecording

                running = self._running[recording] = RunningRecording(
                    self.directory, summary.label, partial(self._read_entry, summary)
                )
            running.follow()
            entry = running.entry
            if entry is None or entry.status not in UNFINISHED or entry.label != summary.label:
                del self._running[recording]
            if entry is None:
                return None
            moment.entries[recording] = entry
            self._schemas |= running.schemas
            now = summary_of(entry, summary.look)
            if now != summary:
                moment.snapshot = snapshot.with_changes([now], {now.topics: running.topics})
                if now.topics != summary.topics:
                    self._reset_meanings()
                if entry.status not in UNFINISHED:
                    self._invalidate_tables(entry)
                if self._latest.snapshot is snapshot:
                    self._latest = _Moment(moment.snapshot)
            return entry

    # The catalog.

    @lazy
    def catalog(self) -> Catalog:
        """Recordings, channels, chunks and schemas."""
        return open_catalog(self.directory)

    @property
    def _files(self) -> StoreFiles:
        return StoreFiles(self.directory, self.catalog, self.repairs)

    def snapshot(self) -> Snapshot:
        """All recordings in short, at the moment."""
        return self._snapshot_of(self._moment)

    def _snapshot_of(self, moment: _Moment) -> Snapshot:
        if moment.snapshot is not None:
            return moment.snapshot
        with self._following:  # or a thread might keep an older state than `_changed` says
            if moment.snapshot is not None:
                return moment.snapshot
            begun = time.monotonic()
            mends, self._is_opened = self._recovers and not self._is_opened, True
            self._changed = self.directory.changed()
            self._names = self.directory.names()
            try:
                found = self._files.look_at_all(mends=mends)
            except DiskFullError as error:
                # The store remains readable, and recordings can be removed.
                self.repairs.disk_full = error
                self.catalog.close()
                self.catalog = open_catalog(self.directory, in_memory=True)
                found = self._files.look_at_all(mends=mends)
            moment.snapshot = found
            ended = time.monotonic()
            self._looks_at = ended
            if ended - begun > _LONG_LOOK_S:  # in a store of thousands
                self._looks_at += min((ended - begun) / _LOOK_SHARE, _MAX_BETWEEN_LOOKS_S)
            return found

    def recordings(self) -> list[RecordingEntry]:
        """All recordings, oldest first. Reads the whole catalog; see `snapshot`."""
        return [*self.entries(self.snapshot().summaries)]

    def entries(self, summaries: Iterable[RecordingSummary]) -> Iterator[RecordingEntry]:
        """The entries of some recordings, without those that were removed meanwhile."""
        for summary in summaries:
            entry = self._entry_of(summary)
            if entry is not None:
                yield entry

    def entry_of(self, summary: RecordingSummary) -> RecordingEntry:
        """The entry of a recording of the snapshot, compared with its files once.

        Raises:
            TopicError: it was removed.
            StoreError: its files cannot be read.
        """
        found = self._entry_of(summary)
        if found is None:
            raise _gone(summary.label)
        return found

    def _entry_of(self, summary: RecordingSummary) -> RecordingEntry | None:
        moment = self._moment
        snapshot = self._snapshot_of(moment)
        place = snapshot.by_id.get(summary.id)
        if summary.id in moment.entries:
            return moment.entries[summary.id]
        if place is not None and snapshot.summaries[place].status in UNFINISHED:
            return self._follow(moment, summary.id)
        found = self._read_entry(summary)
        if found is not None:
            moment.entries[summary.id] = found
        return found

    def _read_entry(self, summary: RecordingSummary) -> RecordingEntry | None:
        """The entry of what is sealed of a recording."""
        found = None if summary.status in UNFINISHED else self._entries.get(summary.id)
        if found is None:
            entry = self._current(summary)
            for _ in range(_TRIES):
                if entry is not None and entry.id == summary.id:
                    break
                # Another process may have renamed it.
                now = self._files.look_at_all()
                if summary.id not in now.by_id:
                    return None
                entry = self._current(now.summaries[now.by_id[summary.id]])
            if entry is None or entry.id != summary.id:
                return None
            if entry.status in UNFINISHED:
                return entry
            found = self._entries.setdefault(summary.id, entry)
        return found

    def _current(self, summary: RecordingSummary) -> RecordingEntry | None:
        try:
            entry, is_new = self._files.current_entry(summary)
        except StoreError:
            if self.directory.has(summary.label):
                raise
            return None  # another process has just renamed or removed it
        if entry is not None and is_new:
            # The index may have what the files had before.
            self._stale.add(entry.id)
            self._is_indexed = False
        return entry

    def entry(self, recording: str) -> RecordingEntry:
        """The entry of a recording, by its id or its label.

        Raises:
            TopicError: it does not exist.
        """
        snapshot = self.snapshot()
        place = snapshot.by_id.get(recording, snapshot.by_label.get(recording))
        if place is None:
            raise _gone(recording)
        return self.entry_of(snapshot.summaries[place])

    def chosen(self, question: Question) -> NDArray[np.intp]:
        """Positions in the snapshot of the recordings of a question, oldest first.

        Raises:
            TopicError: a recording does not exist any more.
        """
        snapshot = self.look(question.recordings)
        if question.recordings is None:
            return snapshot.having(question.topics)
        places = [snapshot.by_id.get(recording, -1) for recording in question.recordings]
        gone = places.count(-1)
        if gone:
            raise TopicError(
                f"{gone} of the recordings asked about were removed from the store. Make the "
                "query again."
            )
        return np.array(sorted(places), np.intp)

    def doubtful(self, question: Question) -> list[RecordingEntry]:
        """The recordings of a question that may lack messages, oldest first."""
        places = self.chosen(question).tolist()
        summaries = self.snapshot().summaries
        found = []
        for place in places:
            summary = summaries[place]
            entry = self._moment.entries.get(summary.id) or self._entries.get(summary.id)
            is_complete = not summary.has_losses and summary.status == "complete"
            if entry is None and is_complete and not self.directory.lost_of(summary.label):
                continue
            entry = entry or self.entry_of(summary)
            if entry.status != "complete" or entry.end.get("losses"):
                found.append(entry)
        return found

    def select(self, names: Iterable[str | RecordingEntry] | None) -> list[RecordingEntry]:
        """Recordings by label, name, id, or the beginning of one of these; None for all.

        Raises:
            TopicError: no recording matches, or several do.
        """
        if names is None:
            return self.recordings()
        snapshot = self.snapshot()
        return [self.entry_of(snapshot.summaries[place]) for place in self.named(names)]

    def as_now(self, entries: Iterable[RecordingEntry]) -> list[RecordingEntry]:
        """Recordings as they are now, oldest first; those that are gone are left out."""
        snapshot = self.snapshot()
        places = sorted(snapshot.by_id.get(entry.id, -1) for entry in entries)
        return [self.entry_of(snapshot.summaries[place]) for place in places if place >= 0]

    def named(self, names: Iterable[str | RecordingEntry]) -> list[int]:
        """Positions of recordings in the snapshot, each once, in the order of the names.

        Raises:
            TopicError: no recording matches a name, or several do.
        """
        snapshot = self.snapshot()
        chosen: dict[int, None] = {}
        for given in names:
            wanted = given if isinstance(given, str) else given.id
            name = self.repairs.copies.get(wanted, wanted)
            found = snapshot.named(name)
            if len(found) != 1:
                shown = found or range(len(snapshot))
                candidates = listed(snapshot.summaries[n].label for n in shown)
                problem = "is ambiguous" if found else "is not in the store"
                raise TopicError(f"Recording {name!r} {problem}. There are: {candidates}.")
            chosen[found[0]] = None
        return list(chosen)

    def topics(self) -> list[str]:
        """Names of all topics, sorted; includes those whose messages are all lost."""
        return self.look().topics

    def channels(self, recording: RecordingEntry) -> list[RecordedChannel]:
        """The channels of a recording, with their codecs.

        Where a topic has messages, its channels without any are left out: they must not change
        the columns of an answer.
        """
        known = self._channels.get(recording.id)
        found = known[1] if known is not None and known[0] is recording else None
        if found is None:
            by_id = self.definitions(recording)
            stats = {c.id: (c.stats, c.reason) for c in recording.channels}
            counts = recording.messages_by_topic()
            found = [
                RecordedChannel(recording, i, channel, *stats.get(i, (ChannelStats(), None)))
                for i, channel in sorted(by_id.items())
                if not counts[channel.topic] or (i in stats and stats[i][0].messages)
            ]
            self._channels[recording.id] = recording, found
        return found

    def channels_of(
        self, recording: RecordingEntry, topics: Collection[str]
    ) -> list[RecordedChannel]:
        """The channels of some topics in a recording, as of `channels`."""
        known = self._by_topic.get(recording.id)
        if known is None or known[0] is not recording:
            by_topic: dict[str, list[RecordedChannel]] = {}
            for channel in self.channels(recording):
                by_topic.setdefault(channel.channel.topic, []).append(channel)
            known = self._by_topic[recording.id] = recording, by_topic
        found = [channel for topic in topics for channel in known[1].get(topic, ())]
        return sorted(found, key=lambda channel: channel.channel_id)

    def field_types(
        self, topics: Collection[str], recordings: Collection[str] | None
    ) -> dict[str, str] | None:
        """Types of the fields of some topics, by path; None where no definition fixes them.

        Args:
            topics: Full names.
            recordings: Ids; None for all.
        """
        snapshot = self.look(recordings)
        places = snapshot.having(topics)
        if recordings is not None:
            own = (snapshot.by_id.get(recording, -1) for recording in recordings)
            places = np.intersect1d(places, np.array([*own], np.intp))
        # Recordings with equal topics and types have equal fields.
        return field_types(
            tuple(
                channel
                for summary in snapshot.differing(places)
                for channel in self.channels_of(self.entry_of(summary), set(topics))
            )
        )

    def having(
        self, topics: Sequence[str], recordings: Iterable[str | RecordingEntry] | None = None
    ) -> tuple[tuple[str, ...], tuple[str, ...] | None]:
        """Topics, and the ids of the recordings that have any of them.

        Args:
            topics: Full names.
            recordings: Ids, labels, names or entries; None for all.

        Returns:
            The topics, and the ids; None for every recording that has a topic.

        Raises:
            TopicError: no recording has any of the topics.
        """
        ids = None
        if recordings is not None:
            known = self.snapshot().summaries
            ids = [known[place].id for place in self.named(recordings)]
        snapshot = self.look(ids)
        places = snapshot.having(topics)
        if ids is not None:
            own = [snapshot.by_id.get(recording, -1) for recording in ids]
            places = np.intersect1d(places, np.array(own, np.intp))
        if topics and not len(places):
            raise TopicError(f"No recording chosen has {', '.join(sorted(set(topics)))}.")
        if recordings is None:
            return tuple(topics), None
        return tuple(topics), tuple(snapshot.summaries[place].id for place in places.tolist())

    def type_names(self) -> dict[str, str]:
        """Names of all types of messages, by the hash of their schema."""
        snapshot = self.snapshot()
        unknown = snapshot.schemas - self._schemas.keys()
        if unknown:
            self._schemas |= self.catalog.schemas(unknown)
        names = {digest: schema.name for digest, schema in self._schemas.items()}
        if snapshot.schemas <= names.keys():
            return names
        # The catalog has lost a schema; entries have the names, too.
        lost = snapshot.with_schemas(snapshot.schemas - names.keys())
        for summary in snapshot.differing(lost):
            channels = self.entry_of(summary).channels
            names |= {c.schema: c.type for c in channels if c.schema is not None}
        return names

    def resolve(self, names: tuple[str, ...]) -> tuple[tuple[str, ...], tuple[str, ...] | None]:
        """The topics that patterns match, and the recordings that have them.

        Raises:
            TopicError: a pattern matches no topic, or several; lists the candidates.
        """
        self.look()
        return self._resolved(names)

    def _resolve(self, names: tuple[str, ...]) -> tuple[tuple[str, ...], tuple[str, ...] | None]:
        known = self.topics()
        if not names:
            there = f"There are: {listed(known)}." if known else "The store is empty."
            raise TopicError(f"Name a topic. {there}")
        return self.having(resolve(names, known))

    def topics_of(self, recordings: Sequence[str]) -> list[str]:
        """Names of all topics of some recordings, sorted.

        Args:
            recordings: Ids; those that are not there are passed over.
        """
        snapshot = self.look(recordings)
        places = [snapshot.by_id[one] for one in recordings if one in snapshot.by_id]
        return snapshot.topics_at(np.array(places, np.intp))

    def resolve_in(self, names: Sequence[str], recordings: Sequence[str]) -> list[str]:
        """The topics of some recordings that patterns match.

        Raises:
            TopicError: as for `resolve`; also lists other recordings with such a topic.
        """
        known = self.topics_of(recordings)
        snapshot = self.look(recordings)
        try:
            return resolve(names, known)
        except TopicError as error:
            found: list[str] = []
            for name in names:
                with suppress(TopicError):
                    found += resolve([name], snapshot.topics)
            others = snapshot.having({*found}.difference(known)).tolist()
            if not others:
                raise
            labels = listed((snapshot.summaries[place].label for place in others), _MAX_NAMES)
            have = "has" if len(others) == 1 else "have"
            join = " In" if str(error).endswith("?") else "; in"
            raise TopicError(f"{error}{join} the store, {labels} {have} such a topic") from error

    def predicate(
        self, text: str, topics: tuple[str, ...], recordings: tuple[str, ...] | None
    ) -> Predicate:
        """A predicate, or a MongoDB filter as JSON, on some topics of some recordings.

        Raises:
            WhereError: it cannot be parsed, does not fit the fields, or is not allowed.
        """
        return self._parsed(text, topics, recordings)

    def _parse(
        self, text: str, topics: tuple[str, ...], recordings: tuple[str, ...] | None
    ) -> Predicate:
        from hybridlog.query.predicate.mongo_filter import from_json, mongo_filter
        from hybridlog.query.predicate.parser import parse
        from hybridlog.query.predicate.tokens import is_filter
        from hybridlog.query.predicate.types import check

        if is_filter(text):
            return mongo_filter(from_json(text), self.field_types(topics, recordings))
        found = parse(text)
        check(found, self.field_types(topics, recordings))
        return found

    def _reset_meanings(self) -> None:
        """Cache the results for patterns and predicates, which take half of a small count."""
        self._resolved = lru_cache(_MAX_MEANINGS)(self._resolve)
        self._parsed = lru_cache(_MAX_MEANINGS)(self._parse)

    def definitions(self, recording: RecordingEntry) -> Mapping[int, Channel]:
        """All channels of a recording by id, also those without messages."""
        wanted = {c.schema for c in recording.channels if c.schema is not None}
        if not wanted <= self._schemas.keys():
            self._schemas |= self.catalog.schemas(wanted - self._schemas.keys())
        if not wanted <= self._schemas.keys():
            # The catalog has lost a schema.
            return channels_of(take_inventory(self.directory, recording.label).summaries.values())
        return {
            c.id: Channel(
                c.topic,
                c.message_encoding,
                self._schemas[c.schema] if c.schema is not None else None,
                c.metadata,
                has_publish_time=c.has_publish_time,
                is_indexed=c.is_indexed,
            )
            for c in recording.channels
        }

    def chunks(
        self,
        recording: RecordingEntry,
        channels: Sequence[int],
        bounds: tuple[int, int] | None,
        clock: str,
    ) -> list[Chunk]:
        """Chunks that may hold messages of some channels in a time range."""
        found: list[Chunk] = []
        timed = [c.id for c in recording.channels if c.has_publish_time]
        for number, first, last in recording.spans:
            is_beside = bounds is not None and not (
                min(first, END - 1) < bounds[1] and last >= bounds[0]
            )
            if clock == "log" and is_beside:
                continue
            columns, stamps = self._chunk_columns(recording, number, channels)
            found += columns.chunks(columns.within(bounds, clock, stamps=stamps, timed=timed))
        return found

    def chunks_before(
        self, recording: RecordingEntry, channels: Sequence[int], latest: int
    ) -> Iterator[tuple[Chunk, int]]:
        """Chunks that may hold the last message of some channels by a time, ns.

        Yields:
            A chunk, and the greatest log time, ns, that it or any later chunk may hold.
        """
        spans = sorted(recording.spans, key=lambda span: span[1])
        spans = [span for span in spans if span[1] <= latest]
        lasts = [BEGIN, *accumulate((last for _, _, last in spans), max)]
        for place in reversed(range(len(spans))):
            columns, _ = self._chunk_columns(recording, spans[place][0], channels)
            for chunk, last in columns.before(latest):
                yield chunk, max(last, lasts[place])

    def _chunk_columns(
        self, recording: RecordingEntry, number: int, channels: Sequence[int]
    ) -> tuple[ChunkColumns, NDArray[np.void] | None]:
        """The chunks of a segment with some channels, and header stamps of its parts."""
        table, stamps = self._of_catalog(recording, self.catalog.decoded_table, number)
        key = recording.id, number, frozenset(channels)
        known = self._columns.get(key)
        if known is None or known[0] is not table:
            if len(self._columns) >= _MAX_COLUMNS:
                self._columns.clear()
            known = self._columns[key] = table, ChunkColumns(number, table, channels)
        return known[1], stamps

    def chunk_stats(self, recording: RecordingEntry, chunk: Chunk) -> dict[int, ChannelStats]:
        """Statistics of the channels in a chunk."""
        return self._of_catalog(recording, self.catalog.chunk_stats, chunk.segment, chunk.number)

    def _of_catalog(
        self,
        recording: RecordingEntry,
        ask: Callable[Concatenate[RecordingEntry, _P], _T],
        *args: _P.args,
        **kwargs: _P.kwargs,
    ) -> _T:
        """An answer of the catalog; the files are read again if they have changed."""
        try:
            return ask(recording, *args, **kwargs)
        except CatalogError:
            read_again(self.directory, self.catalog, recording)
            return ask(recording, *args, **kwargs)

    def chunk_table(self, recording: RecordingEntry, number: int) -> ChunkTable:
        """The chunks of a segment of a recording."""
        return self._of_catalog(recording, self.catalog.table, number)

    def parts(
        self, recording: RecordingEntry, channels: Collection[int], span: tuple[int, int]
    ) -> Parts:
        """The parts of chunks that may hold messages of some channels in a time range.

        Args:
            recording: The recording.
            channels: Channel ids.
            span: Log time `[begin, end)`, ns.
        """
        ids = np.array([*channels], np.int64)
        found = [np.empty((0, 6), np.int64)]
        for number, first, last in recording.spans:
            if min(first, END - 1) < span[1] and last >= span[0]:
                rows = part_rows(number, self.chunk_table(recording, number))
                inside = (placed(rows[:, 4]) < span[1]) & (rows[:, 5] >= span[0])
                found.append(rows[inside & np.isin(rows[:, 2], ids)])
        return Parts.of(np.concatenate(found))

    def times(
        self, recording: RecordingEntry, segment: int, chunk: int
    ) -> dict[int, NDArray[np.int64]]:
        """Log times of a chunk's messages by channel, ascending; reads no payload.

        Raises:
            SegmentError: They are missing or damaged.
        """
        place = place_of(self.chunk_table(recording, segment), chunk)
        found = self.segment(recording.id, segment).read_times(place)
        if not found.keys() >= {*place.channels}:
            raise StoreError(f"Payloads of {recording.label!r} were deleted meanwhile. Ask again.")
        return found

    def chunk(
        self,
        recording: RecordingEntry,
        segment: int,
        place: ChunkPlace,
        count: Callable[[StoredChunk], None],
    ) -> StoredChunk:
        """A chunk, from the cache if it is there. Its buffer is read-only.

        Args:
            recording: Its recording.
            segment: Number of its segment.
            place: Its position there.
            count: Called with the chunk if it is read.

        Raises:
            SegmentError: It is damaged.
        """

        def read() -> StoredChunk:
            chunk = self.segment(recording.id, segment).read_chunk(place)
            # Arrays of messages share the buffer: changes to them must not change the cache.
            chunk.batch.buffer = memoryview(chunk.batch.buffer).toreadonly()
            count(chunk)
            return chunk

        key = recording.id, segment, place.number, recording.stored.get(str(segment), "")
        return self.cache.made("chunk", *key, make=read, size_of=_size_of)

    def segment(self, recording: str, number: int) -> SegmentReader:
        """The reader of a segment of a recording, by its id. Thread safe."""
        running = self._running.get(recording)
        opened = running.reader(number) if running is not None else None
        if opened is not None:
            return opened
        with self._lock:
            # A segment with expired chunks is another file than before.
            entry = self.entry(recording)
            key = recording, number, entry.stored.get(str(number), "")
            reader = self._segments.get(key)
            if reader is None:
                _make_room(self._segments)
                label = entry.label
                try:
                    reader = self._open_segment(entry, label, number)
                except SegmentError:
                    # Another process may have renamed the recording.
                    known = self._files.look_at_all()
                    place = known.by_id.get(recording)
                    if place is None or known.summaries[place].label == label:
                        raise
                    reader = self._open_segment(entry, known.summaries[place].label, number)
                self._segments[key] = reader
            return reader

    def _open_segment(self, entry: RecordingEntry, label: str, number: int) -> SegmentReader:
        path = self.directory.recording(label)
        return open_segment(path / f"{number:06d}.mcap", number, self._contents_of(path, entry))

    def expired_fields(
        self, recording: RecordingEntry, topic: str, chunks: Collection[tuple[int, int]]
    ) -> TopicTable:
        """The fields of a topic in expired chunks, see `RecordingPayloads.expired_fields`."""
        with self._lock:
            path = self.directory.recording(recording.label)
            contents = self._contents_of(path, recording)
        return contents.expired_fields(topic, chunks, self.tables.opened)

    def _contents_of(self, path: Path, recording: RecordingEntry) -> RecordingPayloads:
        """What is left of expired chunks, shared by the segments of a recording as it is now."""
        key = path, frozenset(recording.stored.items())
        found = self._contents.get(key)
        if found is None:
            _make_room(self._contents)
            found = self._contents[key] = RecordingPayloads(path, cache=self.cache)
        return found

    @lazy
    def tables(self) -> Tables:
        """Parquet tables of topics; pyarrow is loaded for them."""
        from hybridlog.columns.tables import Tables

        return Tables(self.directory.path, self.cache)

    def table(self, recording: RecordingEntry, topic: str) -> TopicTable | None:
        """The table of a topic; None without one. `mend` creates a missing one again."""
        from hybridlog.maintenance.tables import can_be_made

        if recording.status in UNFINISHED:
            return None
        found = self.tables.of(recording, topic)
        key = recording.id, topic
        if found is None and key not in self._tables_tried:
            self._tables_tried.add(key)
            if can_be_made(recording, topic, self.tables):
                self.repairs.noted_tables.add(key)
        return found

    def reject_table(self, recording: RecordingEntry, topic: str) -> None:
        """Drop a table that turned out to be damaged; `mend` makes it again."""
        self.tables.reject(recording, topic)
        self.repairs.noted_tables.add((recording.id, topic))

    def mend(self, seconds: float = math.inf) -> None:
        """Repair what questions met: recordings after a crash, missing and damaged tables.

        Args:
            seconds: What takes longer stays in `repairs.noted` and `repairs.noted_tables`.

        Raises:
            DiskFullError: There is no room.
        """
        if self.directory.is_writable:
            with self._mending:
                self._mend(time.monotonic() + seconds)

    def _mend(self, until: float) -> None:
        from hybridlog.maintenance.tables import make_noted

        repairs = self.repairs
        self.snapshot()  # notes what this process has changed
        mended = self._files.mend(until)
        if mended:
            with self._following:
                for recording in mended:
                    self._running.pop(recording, None)
                self.catch_up(*mended)
        by_recording: dict[str, set[str]] = {}
        for recording, topic in [*repairs.noted_tables]:
            by_recording.setdefault(recording, set()).add(topic)
        snapshot = self.snapshot()
        for recording, topics in by_recording.items():
            place = snapshot.by_id.get(recording)
            entry = None if place is None else self._entry_of(snapshot.summaries[place])
            if entry is None or make_noted(
                self.directory, entry, topics, self.tables, repairs, until=until
            ):
                repairs.noted_tables -= {(recording, topic) for topic in topics}

    def _invalidate_tables(self, recording: RecordingEntry) -> None:
        """Look for the tables of a recording again, now that it has ended."""
        topics = {channel.topic for channel in recording.channels}
        self._tables_tried -= {(recording.id, topic) for topic in topics}
        if "tables" in vars(self):
            self.tables.look_again_for(recording, topics)

    # Changes.

    def catch_up(self, *recordings: str) -> None:
        """See which recordings came, went, or got another name, and how some others are now.

        All else that was read stays, so this costs little in a store of thousands.
        """
        with self._following:
            before = self._latest.snapshot
            if before is None:
                self.invalidate()
                return
            changed, names = self.directory.changed(), self.directory.names()
            labels = {*names}.symmetric_difference(before.by_label)  # copies are among them
            known = [before.by_id[one] for one in recordings if one in before.by_id]
            labels.update(before.summaries[place].label for place in known)
            now = self._files.catch_up(before, labels)
            if now is None or self.directory.names() != names:
                self.invalidate()
                return
            self._changed, self._names = changed, names
            self._begin(_Moment(now))
            places = {before.by_label[label] for label in labels & before.by_label.keys()}
            self._invalidate_recordings({before.summaries[place].id for place in places})

    def _begin(self, moment: _Moment) -> None:
        """Begin a moment, also in a block of this thread that asks about an earlier one."""
        self._latest = moment
        if getattr(self._pinned, "moment", None) is not None:
            self._pinned.moment = moment
        self._is_indexed = False
        self._places = None

    def _invalidate_recordings(self, recordings: Collection[str]) -> None:
        """Drop what was read of some recordings, by their ids."""
        for recording in recordings:
            self._channels.pop(recording, None)
            self._by_topic.pop(recording, None)
            entry = self._entries.pop(recording, None)
            topics = {channel.topic for channel in entry.channels} if entry is not None else set()
            self._tables_tried -= {(recording, topic) for topic in topics}
        with self._lock:
            self._contents.clear()
            for key in [key for key in self._segments if key[0] in recordings]:
                del self._segments[key]
        self._columns.clear()
        self.cache.drop("chunk")
        if "tables" in vars(self):
            self.tables.look_again()
        self._reset_meanings()

    # Closing.

    def write_recordings_file(self) -> None:
        """List the ended recordings for other readers of their tables, if that is possible."""
        if self.directory.is_writable:
            from hybridlog.columns.recordings_file import write_recordings_file

            with suppress(OSError, HybridlogError):
                present = self.snapshot().by_label.keys() & {*self.directory.names()}
                write_recordings_file(self.catalog, present)
                self.catalog.has_changed = False

    def invalidate(self) -> None:
        """Drop everything that was read, so that the next question reads the store again."""
        self.invalidations += 1
        self._begin(_Moment())
        self._entries = {}
        self._channels.clear()
        self._by_topic.clear()
        with self._lock:
            self._contents.clear()
            self._segments.clear()  # each is closed by the last thread that reads from it
        self._columns.clear()
        self.cache.drop("chunk")
        self._tables_tried.clear()
        if "tables" in vars(self):
            self.tables.invalidate()
        self._reset_meanings()

    def close(self) -> None:
        """Close files and connections. May be called more than once."""
        with self._lock:
            for reader in self._segments.values():
                reader.close()
            self._segments.clear()
            self._contents.clear()
        self.cache.drop("chunk")
        self._tables_tried.clear()
        if "tables" in vars(self):
            self.tables.invalidate()
        self.disconnect()
        is_missing = "tables" in vars(self) and not self.catalog.recordings_file.exists()
        if self.catalog.has_changed or is_missing:
            self.write_recordings_file()
        self.catalog.close()


def _gone(recording: str) -> TopicError:
    return TopicError(f"Recording {recording!r} is no longer in the store.")


def _size_of(chunk: StoredChunk) -> int:
    return len(chunk.batch.buffer) + _ROW_BYTES * len(chunk.batch)


def _make_room(opened: dict[Any, Any]) -> None:
    """Drop the file that was opened first, if many are open.

    It is closed when the last thread that reads from it also drops it.
    """
    if len(opened) >= files.most_open(_MAX_OPEN_SEGMENTS):
        del opened[next(iter(opened))]
