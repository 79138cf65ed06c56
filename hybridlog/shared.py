"""All that moments of an open store share: the catalog, open files, caches."""

from __future__ import annotations

import os
import threading
from abc import ABC, abstractmethod
from functools import partial
from typing import TYPE_CHECKING, Any

from hybridlog.columns.recording_logs import RecordingRows
from hybridlog.entries import with_marks
from hybridlog.maintenance.opening import StoreFiles
from hybridlog.maintenance.report import RepairReport
from hybridlog.record.marks import MARK_SCHEMA
from hybridlog.snapshot import UNFINISHED
from hybridlog_storage.cache import Cache, lazy
from hybridlog_storage.catalog import Catalog, file_of
from hybridlog_storage.disk import files
from hybridlog_storage.errors import UsageError
from hybridlog_storage.messages import schema_hash
from hybridlog_storage.segments.segment_reader import open_log

if TYPE_CHECKING:
    from pathlib import Path

    from hybridlog.columns.tables import Tables
    from hybridlog.query.question import RecordedChannel
    from hybridlog.record.running import RunningRecording
    from hybridlog.snapshot import Snapshot
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.disk.directory import StoreDirectory
    from hybridlog_storage.segments.segment_reader import SegmentReader
    from hybridlog_storage.summary import RecordingSummary

_MAX_OPEN_SEGMENTS = 256


class Shared(ABC):
    """All that questions to one open store share. Thread safe for reading.

    Attributes:
        index: The index in MongoDB, an `IndexAccess`.
        repairs: Repairs made when the store was opened.
        cache: What was read or worked out; chunks of single messages are a kind of it.
        schemas: Schemas by hash.
        entries: Entries of ended recordings that were compared with their files, by id.
        following: Held while running recordings are looked at, and while the newest state changes.
        channels: Channels of recordings by id and topic, and the entry that they are of.
        epochs: Where header stamps of recordings start again, by id, and the entry they are of.
    """

    index: Any

    def __init__(self, directory: StoreDirectory) -> None:
        self._process = os.getpid()
        self.is_closed = False
        self.directory = directory
        self.repairs = RepairReport()
        self.cache = Cache()
        self.following = threading.RLock()
        self._running: dict[str, RunningRecording] = {}
        self.entries: dict[str, RecordingEntry] = {}
        self.schemas = {schema_hash(MARK_SCHEMA): MARK_SCHEMA}
        self.channels: dict[str, tuple[RecordingEntry, dict[str, list[RecordedChannel]]]] = {}
        self.epochs: dict[str, tuple[RecordingEntry, Any]] = {}
        self._segments: dict[tuple[str, str], SegmentReader] = {}
        self._rows: dict[tuple[Path, frozenset[tuple[str, ...]]], RecordingRows] = {}
        self._opening = threading.Lock()

    @property
    def is_inherited(self) -> bool:
        """True in a child of the process that opened the store."""
        return os.getpid() != self._process

    def check_process(self) -> None:
        """Refuse to go on after closing, or in a child of the process that opened the store."""
        if self.is_closed:
            raise UsageError(f"The store {self.directory.place} is closed: open it again.")
        if self.is_inherited:
            raise UsageError(
                f"The store {self.directory.place} was opened before this process was forked: open "
                "it here, in the child."
            )

    @lazy
    def catalog(self) -> Catalog:
        """Recordings, channels, chunks and schemas."""
        return Catalog(self.directory.path, self.directory.cells)

    @lazy
    def tables(self) -> Tables:
        """Parquet tables of topics; pyarrow is loaded for them."""
        from hybridlog.columns.tables import Tables

        return Tables(self.directory.path, self.cache)

    @lazy
    def _files(self) -> StoreFiles:
        return StoreFiles(self.directory, self.catalog, self.repairs)

    # Moments, of which a `Session` is one.

    @abstractmethod
    def now(self) -> Any:
        """The store at this moment."""

    @abstractmethod
    def catch_up(self, *recordings: str) -> Any:
        """See which recordings came or went, and how some others are now."""

    @abstractmethod
    def recover(self) -> None:
        """Finish what crashes and killed commands have left."""

    @abstractmethod
    def replace_latest(self, before: Snapshot, now: Any) -> None:
        """Let later questions begin with what one has seen, unless there is a newer state."""

    def _look_again_for_tables(self) -> None:
        if "tables" in vars(self):
            self.tables.look_again()

    def _drop_files(self) -> None:
        with self._opening:
            self._rows.clear()
            self._segments.clear()  # each is closed by the last thread that reads from it
        self.cache.drop("chunk")

    # Recordings.

    def followed(self, summary: RecordingSummary) -> RunningRecording:
        """A running recording with what is flushed by now; `following` is held."""
        from hybridlog.record.running import RunningRecording

        running = self._running.get(summary.id)
        if running is None:
            running = self._running[summary.id] = RunningRecording(
                self.directory, summary.id, partial(self.entry, summary)
            )
        running.follow()
        self.schemas |= running.schemas
        entry = running.entry
        if entry is None or entry.status not in UNFINISHED:
            del self._running[summary.id]
            self._look_again_for_tables()  # it may have some now
        return running

    def entry(self, summary: RecordingSummary) -> RecordingEntry | None:
        """The entry of what is sealed of a recording, compared with its files once."""
        found = None if summary.status in UNFINISHED else self.entries.get(summary.id)
        if found is None:
            seen = self._files.see(summary.id)
            if seen is None:
                return None
            if seen.look != summary.look:  # the index may have what the files had before
                self.index.note_changes()
            found = with_marks(seen.entry)
            if found.status not in UNFINISHED:
                found = self.entries.setdefault(summary.id, found)
        return found

    # Files.

    def segment(self, entry: RecordingEntry, number: int) -> SegmentReader:
        """The reader of a sealed segment."""
        with self._opening:
            name = file_of(entry, number)
            key = entry.id, name
            reader = self._segments.get(key)
            if reader is None:
                _make_room(self._segments)
                path = self.directory.recording(entry.id)
                reader = self._segments[key] = open_log(path / name, number, self._rows_of(entry))
            return reader

    def _rows_of(self, entry: RecordingEntry) -> RecordingRows:
        gone = frozenset((name, entry.digests[number]) for number, name in entry.files.items())
        key = self.directory.recording(entry.id), gone
        found = self._rows.get(key)
        if found is None:
            _make_room(self._rows)
            found = self._rows[key] = RecordingRows(key[0], cache=self.cache)
        return found


def _make_room(opened: dict[Any, Any]) -> None:
    """Drop the file that was opened first, if many are open.

    It is closed when the last thread that reads from it also drops it.
    """
    if len(opened) >= files.most_open(_MAX_OPEN_SEGMENTS):
        del opened[next(iter(opened))]
