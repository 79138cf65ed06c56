"""The catalog: a local file that lists recordings, channels and chunks.

It is derived from journals and segment summaries, and may be deleted at any time. It is an
SQLite file, so that listing and choosing recordings, and fetching by topic and time, need
one file and no server. Each row has a checksum. The row of a recording also stores the
state of its files (sizes, times). A row is used only while both are unchanged.
"""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import sqlite3
import stat
from collections import Counter, OrderedDict
from collections.abc import Callable, Collection, Container, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from threading import RLock
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from hybridlog_storage.checksum import crc32
from hybridlog_storage.disk import durability, files
from hybridlog_storage.errors import (
    CatalogError,
    DiskFullError,
    HybridlogError,
    StoreError,
    exhausted,
)
from hybridlog_storage.forks import taken_by_forks
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.ordering import run_starts
from hybridlog_storage.segments.chunk_table import ChunkTable
from hybridlog_storage.segments.segment_reader import ChunkPlace
from hybridlog_storage.summary import (
    RecordingSummary,
    TopicType,
    hash_of,
    topics_from_json,
    topics_to_json,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog_storage.segments.open_segment import Flushed

CATALOG: Final = "catalog.sqlite"
"""Name of the file in the store's directory."""
_JOURNAL: Final = f"{CATALOG}-journal"
_VERSION: Final = 4
_BUSY_S: Final = 1.0
_NO_DAMAGE: Final = frozenset(
    {
        sqlite3.SQLITE_BUSY,
        sqlite3.SQLITE_CANTOPEN,
        sqlite3.SQLITE_FULL,
        sqlite3.SQLITE_INTERRUPT,
        sqlite3.SQLITE_IOERR,
        sqlite3.SQLITE_LOCKED,
        sqlite3.SQLITE_NOMEM,
        sqlite3.SQLITE_PERM,
        sqlite3.SQLITE_READONLY,
    }
)
"""SQLite errors that are independent of the file's content."""
_HEAD: Final = b"SQLite format 3\0\x10\0\1\1"
"""The first bytes of the file, with its page size and rollback journal mode."""
_CACHED_BYTES: Final = 64 << 20  # of chunk tables
_STAMPS = np.dtype(
    [
        ("unreadable", "<u4"),
        ("surplus", "<u4"),
        ("stamped", "<u4"),
        ("first_stamp", "<i8"),
        ("last_stamp", "<i8"),
        ("skew_sum", "<f8"),
        ("skew_min", "<i8"),
        ("skew_max", "<i8"),
    ]
)
"""Results of decoding; one row for each row of `ChunkTable.parts`."""
_TABLES: Final = """
create table meta (key text primary key, value text not null) without rowid;
create table recordings (
    id text primary key, files text not null, entry text not null,
    crc integer not null) without rowid;
create table summaries (
    id text primary key, summary text not null, crc integer not null,
    indexed text not null default '', damage integer not null default 0) without rowid;
create table topics (hash text primary key, topics text not null) without rowid;
create table fingerprints (
    fingerprint text not null, id text not null, primary key (fingerprint, id)) without rowid;
create table segments (
    id text not null, number integer not null, digest text not null, chunks blob not null,
    crc integer not null, primary key (id, number));
create table stamps (
    id text not null, number integer not null, digest text not null, rows blob not null,
    crc integer not null, primary key (id, number));
create table damage (
    id text primary key, chunks text not null, crc integer not null) without rowid;
create table schemas (
    hash text primary key, name text not null, encoding text not null, data blob not null);
"""
_BY_RECORDING: Final = (
    "recordings",
    "summaries",
    "fingerprints",
    "segments",
    "stamps",
    "damage",
)
"""Tables with rows of recordings, by their `id`."""


@dataclass(slots=True)
class ChannelStats:
    """Statistics of the messages of one channel, in a chunk or in a recording.

    Times are nanoseconds; `first` and `last` are both inclusive; None without messages
    or, for stamps, without a header. Skew is log time minus header stamp. `surplus` counts
    messages with bytes left over behind their last field.
    """

    messages: int = 0
    payload_bytes: int = 0
    unreadable: int = 0
    surplus: int = 0
    first: int | None = None
    last: int | None = None
    first_publish: int | None = None
    last_publish: int | None = None
    first_stamp: int | None = None
    last_stamp: int | None = None
    stamped: int = 0
    skew_sum: float = 0.0
    skew_min: int | None = None
    skew_max: int | None = None
    longest: int = 0
    """Longest span of log time of the channel's messages in one chunk."""

    def add(self, other: ChannelStats) -> None:
        """Add the messages of another part of the channel."""
        for name in ("messages", "payload_bytes", "unreadable", "surplus", "stamped", "skew_sum"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        for name in ("first", "first_publish", "first_stamp", "skew_min"):
            setattr(self, name, _least(getattr(self, name), getattr(other, name)))
        for name in ("last", "last_publish", "last_stamp", "skew_max", "longest"):
            setattr(self, name, _greatest(getattr(self, name), getattr(other, name)))


def _values(item: ChannelEntry | ChannelStats) -> dict[str, Any]:
    """The fields of an entry by name."""
    return {name: getattr(item, name) for name in item.__slots__}


@dataclass(slots=True, repr=False)
class ChannelEntry:
    """One channel of a recording."""

    id: int
    topic: str
    message_encoding: str
    schema: str | None
    type: str
    metadata: dict[str, str]
    has_publish_time: bool
    reason: str | None
    """Reason why its fields are not indexed, None if they are."""
    stats: ChannelStats = field(default_factory=ChannelStats)
    is_indexed: bool = True
    """False if its messages get no documents in MongoDB."""

    def __repr__(self) -> str:
        return f"<Channel {self.topic} {self.type}; {self.stats.messages} messages>"

    @property
    def unindexed(self) -> str | None:
        """Reason why MongoDB has no fields of its messages, None if it has."""
        return self.reason if self.is_indexed else "recorded with --no-index"


@dataclass(slots=True, repr=False)
class RecordingEntry:
    """One recording.

    Attributes:
        id: 32 random hexadecimal digits; everything refers to it.
        label: Name of its directory; may change at any time.
        name: Name given by the user.
        tags: Tags given by the user.
        source: The recorded log: path, kind, profile, bytes, fingerprint.
        created: Time of recording, ns.
        status: `open` (being recorded), `unfinished` (cut short by a crash, in a read-only
            store), `complete`, `recovered` (from a crash), `damaged` (the source or a part of
            the recording), or `unproven` (the journal was lost).
        end: The state at its end: losses, damage.
        channels: Its channels.
        stored_bytes: Size of its segments and of its columns of payloads.
        segments: Number of segments.
        chunks: Number of chunks.
        attachments: Number of attachments of its log.
        metadata_records: Number of metadata records of its log.
        notes: Notes of users: `at` (ns) and `text`.
        marks: Marks set after it ended: `time` (ns), `text`, `tags`; those that last, `end` (ns).
        spans: Number, first and last log time (ns) of each segment that has messages.
        digests: Digest of each valid segment, by its number as text.
        is_decoded: Whether messages were decoded. Otherwise header stamps, and messages that
        do not fit their definition, are unknown.
        payloads: Files with columns of payloads: `file`, `bytes`, `digest`, `topic`, `messages`.
        flushed: Content of segments that are not sealed, by number, at one moment; the
            catalog's file does not have it.
    """

    id: str
    label: str
    name: str
    tags: dict[str, str]
    source: dict[str, Any]
    created: int
    status: str
    end: dict[str, Any] = field(default_factory=dict)
    channels: list[ChannelEntry] = field(default_factory=list)
    stored_bytes: int = 0
    segments: int = 0
    chunks: int = 0
    attachments: int = 0
    metadata_records: int = 0
    notes: list[dict[str, Any]] = field(default_factory=list)
    marks: list[dict[str, Any]] = field(default_factory=list)
    spans: list[tuple[int, int, int]] = field(default_factory=list)
    digests: dict[str, str] = field(default_factory=dict)
    is_decoded: bool = False
    payloads: list[dict[str, Any]] = field(default_factory=list)
    flushed: dict[int, Flushed] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"<Recording {self.label}; {len(self.channels)} channels, {self.messages} messages>"

    @property
    def key(self) -> str:
        """The first 64 bits of the id, 16 hexadecimal digits; index documents refer to it."""
        return self.id[:16]

    @property
    def messages(self) -> int:
        """Number of messages in all channels."""
        return sum(c.stats.messages for c in self.channels)

    @property
    def documents(self) -> int:
        """Number of messages that have a document in a complete index."""
        return sum(c.stats.messages for c in self.channels if c.is_indexed)

    def messages_by_topic(self) -> Counter[str]:
        """Number of messages of each topic."""
        found: Counter[str] = Counter()
        for channel in self.channels:
            found[channel.topic] += channel.stats.messages
        return found

    @property
    def span(self) -> tuple[int, int] | None:
        """Log time `[first, last]`, ns, both inclusive; None without messages."""
        firsts = [c.stats.first for c in self.channels if c.stats.first is not None]
        lasts = [c.stats.last for c in self.channels if c.stats.last is not None]
        return (min(firsts), max(lasts)) if firsts else None

    def to_document(self) -> dict[str, Any]:
        """The entry as a mapping of plain values."""
        # `dataclasses.asdict` takes a millisecond for each channel.
        channels = [
            {
                **_values(channel),
                "metadata": dict(channel.metadata),
                "stats": _values(channel.stats),
            }
            for channel in self.channels
        ]
        values = asdict(replace(self, channels=[], flushed={}))
        del values["flushed"]
        return {**values, "channels": channels}

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> RecordingEntry:
        """The entry from such a mapping."""
        values = dict(document)
        values["channels"] = [
            ChannelEntry(**{**c, "stats": ChannelStats(**c["stats"])}) for c in values["channels"]
        ]
        values["spans"] = [tuple(span) for span in values["spans"]]
        return cls(**values)


@dataclass(frozen=True, slots=True)
class ChunkEntry:
    """One chunk: its position and its statistics by channel id.

    Attributes:
        recording: Id of its recording.
        segment: Number of its segment.
        number: Its number in the segment, from 0.
        offset: Byte of the chunk record in the file.
        length: Bytes of the chunk record.
        trailer: Bytes of message indexes and arrival numbers behind it.
        crc: CRC-32 of the stored chunk record.
        trailer_crc: CRC-32 of the trailer.
        first: Least log time, ns.
        last: Greatest log time, ns.
        stats: By channel id.
    """

    recording: str
    segment: int
    number: int
    offset: int
    length: int
    trailer: int
    crc: int
    trailer_crc: int
    first: int
    last: int
    stats: Mapping[int, ChannelStats]

    @property
    def place(self) -> ChunkPlace:
        """Its position, as the segment reader expects it."""
        return ChunkPlace(
            offset=self.offset,
            length=self.length,
            trailer=self.trailer,
            first=self.first,
            last=self.last,
            channels=tuple(self.stats),
            number=self.number,
            crc=self.crc,
            trailer_crc=self.trailer_crc,
        )

    @property
    def messages(self) -> int:
        """Number of its messages."""
        return sum(stats.messages for stats in self.stats.values())


def _damage_crc(db: sqlite3.Connection, recording: str) -> int:
    """Checksum of a recording's list of unreadable chunks; 0 without one."""
    row = db.execute("select crc from damage where id = ?", (recording,)).fetchone()
    if row is None:
        return 0
    return row[0] if isinstance(row[0], int) else -1


def _put_summary(db: sqlite3.Connection, described: Described) -> None:
    entry, text = described.entry, described.summary.to_json()
    topics = described.summary.topics, topics_to_json(described.topics)
    db.execute("insert or replace into topics values (?, ?)", topics)
    row = entry.id, text, _text_crc(text), _damage_crc(db, entry.id)
    db.execute("insert or replace into summaries values (?, ?, ?, '', ?)", row)
    db.execute("delete from fingerprints where id = ?", (entry.id,))
    rows = [(fingerprint, entry.id) for fingerprint in _fingerprints(entry)]
    db.executemany("insert into fingerprints values (?, ?)", rows)


def _fingerprints(entry: RecordingEntry) -> set[str]:
    """Fingerprints of the log of a recording and of its parts."""
    parts = entry.source.get("parts")
    found = [entry.source.get("fingerprint"), *(parts if isinstance(parts, list) else ())]
    return {fingerprint for fingerprint in found if isinstance(fingerprint, str)}


def channel_totals(
    table: ChunkTable, stamps: NDArray[np.void] | None, silent: Container[int] = ()
) -> dict[int, ChannelStats]:
    """Statistics of the channels of a segment.

    Args:
        table: Its chunks.
        stamps: Results of decoding, a row for each of `table.parts`; None before the
        messages are decoded.
        silent: Ids of channels without publish times.
    """
    parts = table.parts
    found: dict[int, ChannelStats] = {}
    order = np.argsort(parts["channel"], kind="stable")
    ids = parts["channel"][order]
    for begin, end in pairwise([*run_starts(ids).tolist(), len(ids)]):
        rows = parts[order[begin:end]]
        channel = int(ids[begin])
        stats = found[channel] = ChannelStats(
            messages=int(rows["messages"].sum()),
            payload_bytes=int(rows["payload_bytes"].sum()),
            first=int(rows["first"].min()),
            last=int(rows["last"].max()),
            longest=int((rows["last"] - rows["first"]).max()),
        )
        if channel not in silent and not table.is_flushed:
            stats.first_publish = int(rows["first_publish"].min())
            stats.last_publish = int(rows["last_publish"].max())
        if stamps is not None:
            _add_stamps(stats, stamps[order[begin:end]])
    return found


def _add_stamps(stats: ChannelStats, rows: NDArray[np.void]) -> None:
    stats.unreadable = int(rows["unreadable"].sum())
    stats.surplus = int(rows["surplus"].sum())
    rows = rows[rows["stamped"] > 0]
    if len(rows):
        stats.stamped = int(rows["stamped"].sum())
        # Exact, so that the order of segments and chunks does not matter.
        stats.skew_sum = math.fsum(rows["skew_sum"].tolist())
        stats.first_stamp = int(rows["first_stamp"].min())
        stats.last_stamp = int(rows["last_stamp"].max())
        stats.skew_min = int(rows["skew_min"].min())
        stats.skew_max = int(rows["skew_max"].max())


def stamps_of(
    table: ChunkTable, chunks: Mapping[int, Mapping[int, ChannelStats]]
) -> NDArray[np.void]:
    """Header stamps and decoding failures of a segment, a row for each row of `table.parts`.

    Args:
        table: The segment's chunks.
        chunks: Statistics by channel, for each chunk number that could be decoded.
    """
    rows = np.zeros(len(table.parts), _STAMPS)
    bounds = table.part_bounds().tolist()
    for number, by_channel in chunks.items():
        for row in range(bounds[number], bounds[number + 1]):
            stats = by_channel.get(int(table.parts["channel"][row]))
            if stats is not None:
                rows[row] = _decoded(stats)
    return rows


def decoded_rows(chunks: Iterable[Mapping[int, ChannelStats]]) -> NDArray[np.void]:
    """The same of a segment whose chunks could all be decoded.

    Args:
        chunks: Statistics by channel, for each chunk of the segment.
    """
    rows = [_decoded(stats) for one in chunks for _, stats in sorted(one.items())]
    return np.array(rows, _STAMPS)


def _decoded(stats: ChannelStats) -> tuple[float, ...]:
    """A row of the results of decoding."""
    return (
        stats.unreadable,
        stats.surplus,
        stats.stamped,
        stats.first_stamp or 0,
        stats.last_stamp or 0,
        stats.skew_sum,
        stats.skew_min or 0,
        stats.skew_max or 0,
    )


@dataclass(frozen=True, slots=True)
class Described:
    """A recording, as read from its files.

    Attributes:
        entry: Its entry.
        summary: Its summary.
        topics: Its topics and their types.
        files: State of the files; the row is used while it is unchanged.
        tables: Chunks of each valid segment, by number.
        channels: By id.
    """

    entry: RecordingEntry
    summary: RecordingSummary
    topics: Collection[TopicType]
    files: str
    tables: Mapping[int, ChunkTable]
    channels: Mapping[int, Channel]


class Catalog:
    """The catalog of a store. Thread safe.

    Args:
        store: The store's directory; None for a catalog in memory, if this user cannot write
        the store.
        store_id: The store's id; the catalog of another store is rebuilt.

    Attributes:
        was_damaged: True if a damaged file was replaced by an empty one.
        locked: The file, if another process keeps it locked; a catalog in memory replaces it.
    """

    def __init__(self, store: Path | None, store_id: str) -> None:
        self.was_damaged = False
        self.locked: Path | None = None
        self._path = store / CATALOG if store is not None else None
        self._store_id = store_id
        self._lock = taken_by_forks(RLock())
        self._file: tuple[int, int] | None = None
        self._tables: OrderedDict[tuple[str, int, str], tuple[ChunkTable, NDArray[np.void] | None]]
        self._tables = OrderedDict()
        self._cached = 0
        self._db = self._open()

    @property
    def is_in_memory(self) -> bool:
        """True if it exists in the memory of this process only."""
        return self._path is None

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._db.close()
            self._forget()

    # Opening.

    def _open(self) -> sqlite3.Connection:
        try:
            return self._connect()
        except sqlite3.Error as error:
            if _is_locked(error):
                self.locked, self._path = self._path, None
                return self._connect()
            if not _is_damage(error) and not self._has_odd_journal():
                raise self._told(error, "opened") from error
            self.was_damaged = True
            self._delete()
        try:
            return self._connect()
        except sqlite3.Error as error:
            raise self._told(error, "made") from error

    def _connect(self) -> sqlite3.Connection:
        if self._path is None:
            db = sqlite3.connect(":memory:", check_same_thread=False, isolation_level=None)
        else:
            # SQLite itself follows only a symlink in place of the file.
            path = Path(os.path.realpath(self._path.parent)) / CATALOG
            try:
                # The group may write it if it may write the store.
                fd = files.open_file(path, os.O_RDWR | os.O_CREAT, depth=files.IN_STORE)
                try:
                    self._file = _identity(os.fstat(fd))
                    head = os.pread(fd, len(_HEAD), 0)
                finally:
                    os.close(fd)
            except IsADirectoryError as error:
                raise sqlite3.DatabaseError("it is a directory") from error
            except OSError as error:
                raise durability.explain(error, self._path, "opening") from error
            if head and (head[:16] != _HEAD[:16] or head[18:] != _HEAD[18:]):
                raise sqlite3.DatabaseError("it is not a catalog")
            db = sqlite3.connect(
                path, timeout=_BUSY_S, check_same_thread=False, isolation_level=None
            )
            ((_, _, opened),) = db.execute("pragma database_list").fetchall()
            if opened != str(path):
                db.close()
                raise StoreError(f"{self._path} is a symlink. Delete it: the catalog is rebuilt.")
        try:
            db.execute("pragma synchronous = off")  # a catalog broken by a power cut is rebuilt
            db.execute("pragma cell_size_check = on")
            # Damaged text invalidates its row, not the whole catalog.
            db.text_factory = partial(str, encoding="utf-8", errors="surrogateescape")
            if not self._is_ours(db):
                self._make(db)
        except BaseException:
            db.close()
            raise
        return db

    def _is_ours(self, db: sqlite3.Connection) -> bool:
        """True if the tables have this version and belong to this store."""
        found = db.execute("select count(*) from sqlite_master where name = 'meta'").fetchone()
        if not found[0]:
            return False
        made = db.execute("select key, value from meta").fetchall()
        return sorted(made) == [("store", self._store_id), ("version", str(_VERSION))]

    def _make(self, db: sqlite3.Connection, *, anew: bool = False) -> None:
        """Create the tables, unless another process has just done so."""
        db.execute("begin immediate")
        try:
            if anew or not self._is_ours(db):
                tables = db.execute("select name from sqlite_master where type = 'table'")
                for (name,) in tables.fetchall():
                    db.execute(f'drop table "{name}"')
                for statement in _TABLES.split(";"):
                    db.execute(statement)
                db.executemany(
                    "insert into meta values (?, ?)",
                    [("version", str(_VERSION)), ("store", self._store_id)],
                )
            db.execute("commit")
        except BaseException:
            with suppress(sqlite3.Error):
                db.execute("rollback")
            raise

    def _delete(self) -> None:
        if self._path is not None:
            for name in (CATALOG, _JOURNAL):
                files.remove_tree(self._path.with_name(name), depth=files.IN_STORE)

    def _has_odd_journal(self) -> bool:
        """True if a directory is in the place of SQLite's journal."""
        if self._path is None:
            return False
        try:
            about = files.status(self._path.with_name(_JOURNAL), depth=files.IN_STORE)
        except OSError:
            return False
        return stat.S_ISDIR(about.st_mode)

    def rebuild(self) -> None:
        """Replace the catalog with an empty one.

        Raises:
            StoreError: It cannot be written.
        """
        with self._lock:
            self._forget()
            self.was_damaged = self._path is not None
            try:
                if self._is_sound():
                    # Other processes may still use the open file.
                    self._make(self._db, anew=True)
                    return
            except sqlite3.Error as error:
                if not _is_damage(error):
                    told = self._told(error, "made")
                    if self._path is None:
                        return
                    raise told from error
            self._db.close()
            self._delete()
            self._db = self._open()

    def mend(self) -> None:
        """Replace the catalog with an empty one, unless only single rows are damaged.

        Writing into a damaged file would damage other rows.

        Raises:
            StoreError: It cannot be read or written.
        """
        with self._lock:
            try:
                if self._is_sound():
                    return
            except sqlite3.Error as error:
                if not _is_damage(error):
                    raise self._told(error, "read") from error
            self.rebuild()

    def is_sound(self) -> bool:
        """True if the file structure is intact; rows are checked when they are read.

        Raises:
            StoreError: It cannot be read.
        """
        with self._lock:
            try:
                return self._is_sound()
            except sqlite3.Error as error:
                if _is_damage(error):
                    return False
                raise self._told(error, "read") from error

    def _is_sound(self) -> bool:
        return bool(self._db.execute("pragma quick_check(1)").fetchone() == ("ok",))

    def _follow(self) -> None:
        """Reopen the file if another process replaced it."""
        if self._path is None:
            return
        try:
            now = _identity(files.status(self._path, depth=files.IN_STORE))
        except OSError:
            now = None
        if now != self._file:
            self._db.close()
            self._forget()
            self._db = self._open()

    def _told(self, error: sqlite3.Error, what: str) -> HybridlogError:
        """Map an SQLite error to a hybridlog error."""
        short = exhausted(_system_error(error), f"using {self._path}")
        if short is not None:
            return short
        if _is_locked(error):
            with self._lock:
                self._db.close()
                self._forget()
                self.locked, self._path = self._path, None
                self._db = self._connect()
            return CatalogError(f"Another process keeps the catalog {self.locked} locked.")
        name = getattr(error, "sqlite_errorname", "")
        if name == "SQLITE_FULL" or "is full" in str(error):
            return DiskFullError(
                f"No space left while writing {self._path}. Free some space and run the "
                "command again."
            )
        if _is_damage(error):
            return CatalogError(
                f"The catalog {self._path} is damaged: {error}. `hybridlog index rebuild` makes "
                "it again."
            )
        return StoreError(
            f"The catalog {self._path} cannot be {what}: {error}. Delete it while no "
            "process uses the store; it is rebuilt."
        )

    @contextmanager
    def _reading(self) -> Iterator[sqlite3.Connection]:
        """A context for reading.

        Raises:
            CatalogError: The file is damaged.
            StoreError: It cannot be read.
        """
        with self._lock:
            try:
                yield self._db
            except sqlite3.Error as error:
                raise self._told(error, "read") from error

    def _change(self, work: Callable[[sqlite3.Connection], None]) -> None:
        """A transaction; a damaged catalog is replaced first.

        The end of a recording must not fail because of data that can be rebuilt.

        Raises:
            DiskFullError: There is no room.
            StoreError: They cannot be written.
        """
        try:
            with self._changing() as db:
                work(db)
        except CatalogError:
            self.rebuild()
            with self._changing() as db:
                work(db)

    def _note(self, work: Callable[[sqlite3.Connection], None]) -> None:
        """A transaction that saves work later; left out if another process writes just now."""
        with self._lock, suppress(sqlite3.Error):
            try:
                self._db.execute("pragma busy_timeout = 0")
                with self._writing() as db:
                    work(db)
            finally:
                self._db.execute(f"pragma busy_timeout = {int(_BUSY_S * 1000)}")

    @contextmanager
    def _changing(self) -> Iterator[sqlite3.Connection]:
        """A transaction.

        Raises:
            CatalogError: The file is damaged.
            DiskFullError: There is no room.
            StoreError: They cannot be written.
        """
        try:
            with self._writing() as db:
                yield db
        except sqlite3.Error as error:
            self._forget()
            raise self._told(error, "written") from error

    @contextmanager
    def _writing(self) -> Iterator[sqlite3.Connection]:
        with self._lock:
            self._follow()
            self._db.execute("begin immediate")
            try:
                yield self._db
            except BaseException:
                with suppress(sqlite3.Error):
                    self._db.execute("rollback")
                raise
            self._db.execute("commit")

    def _forget(self, recording: str | None = None) -> None:
        for key in [k for k in self._tables if recording in {None, k[0]}]:
            table, _ = self._tables.pop(key)
            self._cached -= _size(table)

    # Recordings.

    def put(self, described: Described) -> None:
        """Insert or replace a recording and all its chunks."""
        entry = described.entry
        # In ASCII: a directory's name may not be UTF-8.
        text = json.dumps(entry.to_document(), separators=(",", ":"))
        row = (entry.id, described.files, text)

        def work(db: sqlite3.Connection) -> None:
            self._forget(entry.id)
            db.execute("delete from segments where id = ?", (entry.id,))
            for number, table in described.tables.items():
                part = (entry.id, number, entry.digests[str(number)], table.to_bytes())
                db.execute("insert into segments values (?, ?, ?, ?, ?)", (*part, _crc(*part)))
            db.executemany(
                "insert or replace into schemas values (?, ?, ?, ?)",
                [
                    (schema_hash(s), s.name, s.encoding, s.data)
                    for s in {c.schema for c in described.channels.values()}
                    if s is not None
                ],
            )
            db.execute("insert or replace into recordings values (?, ?, ?, ?)", (*row, _crc(*row)))
            _put_summary(db, described)

        self._change(work)

    def summaries(self, recordings: Collection[str] | None = None) -> list[RecordingSummary]:
        """Summaries of recordings, unordered; without damaged ones.

        Args:
            recordings: Their ids; None for all.

        Raises:
            CatalogError: More than single rows is damaged.
        """
        with self._reading():
            self._follow()
            rows = self._rows("summary, crc, indexed, damage, id", "summaries", recordings)
            lists = self._rows("id, chunks, crc", "damage", recordings)
            whole = {row[0]: row[2] for row in lists if _crc(*row[:2]) == row[2]}
            # The index has the list of unreadable chunks, too.
            good = [
                (text, index if whole.get(recording, 0) == damage else "")
                for text, crc, index, damage, recording in rows
                if _text_crc(text) == crc
            ]
            if len(good) < len(rows) and not self._is_sound():
                raise CatalogError(f"The catalog {self._path} is damaged.")
        values = json.loads(f"[{','.join(text for text, _ in good)}]")
        return [
            RecordingSummary.from_values(row, index)
            for row, (_, index) in zip(values, good, strict=True)
        ]

    def _rows(
        self, columns: str, table: str, recordings: Collection[str] | None
    ) -> list[tuple[Any, ...]]:
        asked = f"select {columns} from {table}"  # noqa: S608 - names of ours
        if recordings is None:
            return self._db.execute(asked).fetchall()
        found = [self._db.execute(f"{asked} where id = ?", (one,)) for one in recordings]
        return [row for rows in found for row in rows]

    def topics(self, digest: str) -> tuple[TopicType, ...]:
        """A set of topics and their types, by its hash.

        Raises:
            CatalogError: The catalog has lost it.
        """
        with self._reading() as db:
            row = db.execute("select topics from topics where hash = ?", (digest,)).fetchone()
        if row is None or type(row[0]) is not str or hash_of(row[0]) != digest:
            raise CatalogError(
                f"The catalog {self._path} has lost the topics of recordings. "
                "`hybridlog index rebuild` rebuilds it."
            )
        return topics_from_json(row[0])

    def recording(self, recording: str) -> tuple[str, RecordingEntry] | None:
        """State of the files and entry of a recording; None if it is missing or damaged."""
        with self._reading() as db:
            asked = "select id, files, entry, crc from recordings where id = ?"
            row = db.execute(asked, (recording,)).fetchone()
        if row is None or _crc(*row[:3]) != row[3]:
            return None
        with suppress(KeyError, TypeError, ValueError):
            return row[1], RecordingEntry.from_document(json.loads(row[2]))
        return None

    def with_fingerprint(self, fingerprint: str) -> RecordingEntry | None:
        """A recording of a log with this content, or of one of which it is a part."""
        with self._reading():
            self._follow()
            asked = "select id from fingerprints where fingerprint = ?"
            rows = self._db.execute(asked, (fingerprint,)).fetchall()
        for (recording,) in rows:
            found = self.recording(recording)
            if found is not None and fingerprint in _fingerprints(found[1]):
                return found[1]
        return None

    def put_look(self, summary: RecordingSummary) -> None:
        """Note that a recording is unchanged although its directory looks different."""
        text = summary.to_json()

        def work(db: sqlite3.Connection) -> None:
            asked = "update summaries set summary = ?, crc = ? where id = ?"
            db.execute(asked, (text, _text_crc(text), summary.id))

        self._note(work)

    def put_indexed(self, recordings: Iterable[str], index: str) -> None:
        """Note which index is complete for recordings.

        Args:
            recordings: Their ids.
            index: The id of the index; empty if none is.
        """

        def work(db: sqlite3.Connection) -> None:
            asked = "update summaries set indexed = ? where id = ?"
            db.executemany(asked, [(index, recording) for recording in recordings])

        self._note(work)

    def remove(self, recording: str) -> None:
        """Remove a recording."""

        def work(db: sqlite3.Connection) -> None:
            self._forget(recording)
            for table in _BY_RECORDING:
                db.execute(f"delete from {table} where id = ?", (recording,))  # noqa: S608

        self._change(work)

    # Results of decoding.

    def put_stamps(
        self, recording: str, stamps: Iterable[tuple[int, str, NDArray[np.void]]]
    ) -> None:
        """Store the decoding results of a recording's segments.

        Args:
            recording: Its id.
            stamps: Number and digest of a segment, and a row for each of the `parts` of its
                chunk table.
        """
        rows_of = [(recording, number, digest, rows.tobytes()) for number, digest, rows in stamps]

        def work(db: sqlite3.Connection) -> None:
            self._forget(recording)
            db.executemany(
                "insert or replace into stamps values (?, ?, ?, ?, ?)",
                [(*row, _crc(*row)) for row in rows_of],
            )

        self._change(work)

    def put_damage(self, recording: str, damage: Mapping[tuple[int, int], str]) -> None:
        """Store the unreadable chunks of a recording: reason by segment and number."""

        def work(db: sqlite3.Connection) -> None:
            db.execute("delete from damage where id = ?", (recording,))
            if damage:
                rows = [(*place, reason) for place, reason in sorted(damage.items())]
                row = (recording, json.dumps(rows))
                db.execute("insert into damage values (?, ?, ?)", (*row, _crc(*row)))
            asked = "update summaries set damage = ? where id = ?"
            db.execute(asked, (_damage_crc(db, recording), recording))

        self._change(work)

    def damage(self, recording: str) -> dict[tuple[int, int], str]:
        """The unreadable chunks of a recording: reason by segment and number.

        Raises:
            CatalogError: The list is damaged.
        """
        with self._reading() as db:
            row = db.execute(
                "select id, chunks, crc from damage where id = ?", (recording,)
            ).fetchone()
        if row is None:
            return {}
        if _crc(*row[:2]) != row[2] or row[0] != recording:
            raise CatalogError(
                f"The catalog's list of damaged chunks of recording {recording} is damaged. "
                "`hybridlog index rebuild` rebuilds it."
            )
        return {(segment, chunk): reason for segment, chunk, reason in json.loads(row[1])}

    def stamps(
        self, entry: RecordingEntry, number: int, table: ChunkTable
    ) -> NDArray[np.void] | None:
        """Decoding results of a segment; None before its messages are decoded."""
        with self._reading() as db:
            row = db.execute(
                "select id, number, digest, rows, crc from stamps where id = ? and number = ?",
                (entry.id, number),
            ).fetchone()
        if row is None or _crc(*row[:4]) != row[4] or row[2] != entry.digests.get(str(number)):
            return None
        if len(row[3]) != len(table.parts) * _STAMPS.itemsize:
            return None
        return np.frombuffer(row[3], _STAMPS)

    # Schemas.

    def schemas(self, hashes: Collection[str]) -> dict[str, Schema]:
        """Schemas by hash, without missing or damaged ones."""
        found: dict[str, Schema] = {}
        with self._reading() as db:
            for digest in hashes:
                row = db.execute(
                    "select name, encoding, data from schemas where hash = ?", (digest,)
                ).fetchone()
                if row is not None and list(map(type, row)) == [str, str, bytes]:
                    schema = Schema(*row)
                    if schema_hash(schema) == digest:
                        found[digest] = schema
        return found

    # Chunks.

    def table(self, entry: RecordingEntry, number: int) -> ChunkTable:
        """The chunks of a segment.

        Raises:
            CatalogError: The catalog has lost them.
        """
        return self.decoded_table(entry, number)[0]

    def decoded_table(
        self, entry: RecordingEntry, number: int
    ) -> tuple[ChunkTable, NDArray[np.void] | None]:
        """The chunks of a segment, and the results of decoding for each row of its parts.

        Raises:
            CatalogError: The catalog has lost them.
        """
        if number in entry.flushed:
            return entry.flushed[number].table, None
        key = entry.id, number, entry.digests.get(str(number), "")
        with self._reading() as db:
            cached = self._tables.get(key)
            if cached is not None:
                self._tables.move_to_end(key)
                return cached
            row = db.execute(
                "select id, number, digest, chunks, crc from segments where id = ? and number = ?",
                key[:2],
            ).fetchone()
            if row is None or _crc(*row[:4]) != row[4] or row[:3] != key:
                raise CatalogError(
                    f"The catalog has lost the chunks of segment {number} of recording "
                    f"{entry.label}. `hybridlog index rebuild` rebuilds it."
                )
            table = ChunkTable.from_bytes(row[3])
            cached = table, self.stamps(entry, number, table)
            if cached[1] is None and entry.is_decoded and len(table.parts):
                # Without its row the next opening reads the recording's files again.
                with suppress(sqlite3.Error):
                    for name in ("recordings", "summaries"):
                        db.execute(f"delete from {name} where id = ?", (entry.id,))  # noqa: S608
            self._tables[key] = cached
            self._cached += _size(table)
            while self._cached > _CACHED_BYTES and len(self._tables) > 1:
                _, (oldest, _) = self._tables.popitem(last=False)
                self._cached -= _size(oldest)
            return cached

    def chunk_stats(
        self, entry: RecordingEntry, segment: int, number: int
    ) -> dict[int, ChannelStats]:
        """Statistics of the channels in a chunk.

        Args:
            entry: The recording.
            segment: Number of the segment.
            number: Number of the chunk in it.

        Raises:
            CatalogError: The catalog has lost them.
        """
        table, stamps = self.decoded_table(entry, segment)
        begin, end = table.part_bounds()[number : number + 2].tolist()
        own = replace(table, chunks=table.chunks[number : number + 1], parts=table.parts[begin:end])
        silent = {c.id for c in entry.channels if not c.has_publish_time}
        return channel_totals(own, None if stamps is None else stamps[begin:end], silent)


def schema_hash(schema: Schema) -> str:
    """SHA-256 of name, encoding and definition, as hex digits."""
    digest = hashlib.sha256()
    for part in (schema.name.encode(), schema.encoding.encode(), bytes(schema.data)):
        digest.update(len(part).to_bytes(8, "little") + part)
    return digest.hexdigest()


def channel_entry(channel_id: int, channel: Channel, reason: str | None) -> ChannelEntry:
    """The catalog entry of a channel without messages."""
    return ChannelEntry(
        id=channel_id,
        topic=channel.topic,
        message_encoding=channel.message_encoding,
        schema=schema_hash(channel.schema) if channel.schema is not None else None,
        type=channel.schema.name if channel.schema is not None else "",
        metadata=dict(channel.metadata),
        has_publish_time=channel.has_publish_time,
        reason=reason,
        is_indexed=channel.is_indexed,
    )


def _crc(*values: object) -> int:
    """Checksum of the values of a row."""
    crc = 0
    for value in values:
        # A value that SQLite stores as another type is a different value.
        kind = type(value).__name__.encode()
        data = value if isinstance(value, bytes) else str(value).encode("utf-8", "surrogatepass")
        crc = crc32(data, crc32(kind + len(data).to_bytes(8, "little"), crc))
    return crc


def _text_crc(text: object) -> int:
    """Checksum of the text of a summary; -1 for a value of another type."""
    return crc32(text.encode("utf-8", "surrogateescape")) if isinstance(text, str) else -1


def _size(table: ChunkTable) -> int:
    return int(table.chunks.nbytes + table.parts.nbytes + table.others.nbytes)


def _is_damage(error: sqlite3.Error) -> bool:
    """True if an error comes from the file's content."""
    code = getattr(error, "sqlite_errorcode", None)
    if code is None:
        return "is full" not in str(error) and "I/O error" not in str(error)
    return code & 0xFF not in _NO_DAMAGE


def _is_locked(error: sqlite3.Error) -> bool:
    """True if another process has kept the file locked for too long."""
    return getattr(error, "sqlite_errorcode", 0) & 0xFF == sqlite3.SQLITE_BUSY


def _system_error(error: sqlite3.Error) -> int | None:
    """The system's error number behind an SQLite error, which does not tell it."""
    code = getattr(error, "sqlite_errorcode", 0) & 0xFF
    if code == sqlite3.SQLITE_NOMEM:
        return errno.ENOMEM
    if code == sqlite3.SQLITE_CANTOPEN:
        try:
            os.close(os.open(os.devnull, os.O_RDONLY))
        except OSError as refused:
            return refused.errno
    return None


def _identity(about: os.stat_result) -> tuple[int, int]:
    return about.st_dev, about.st_ino


def _least(a: int | None, b: int | None) -> int | None:
    return b if a is None else a if b is None else min(a, b)


def _greatest(a: int | None, b: int | None) -> int | None:
    return b if a is None else a if b is None else max(a, b)
