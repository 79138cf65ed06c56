"""An open store: its newest state, of which each question takes a moment, and what these share."""

from __future__ import annotations

import os
import threading
import time
from contextlib import ExitStack, suppress
from functools import partial
from typing import TYPE_CHECKING, Any
from weakref import WeakSet

from hybridlog.columns.recording_logs import RecordingRows
from hybridlog.entries import with_marks
from hybridlog.index.access import IndexAccess
from hybridlog.maintenance.opening import StoreFiles
from hybridlog.maintenance.report import RepairReport
from hybridlog.record.marks import MARK_SCHEMA
from hybridlog.session import Session
from hybridlog.snapshot import UNFINISHED, Snapshot
from hybridlog_storage.cache import Cache, lazy
from hybridlog_storage.catalog import Catalog, file_of
from hybridlog_storage.disk import files
from hybridlog_storage.errors import DatabaseError, HybridlogError, UsageError
from hybridlog_storage.messages import schema_hash
from hybridlog_storage.segments.segment_reader import open_log

if TYPE_CHECKING:
    from pathlib import Path

    from hybridlog.columns.tables import Tables
    from hybridlog.maintenance.report import Progress
    from hybridlog.query.question import RecordedChannel
    from hybridlog.record.recorder import RecordReport
    from hybridlog.record.running import RunningRecording
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.disk.directory import StoreDirectory
    from hybridlog_storage.segments.segment_reader import SegmentReader
    from hybridlog_storage.summary import RecordingSummary

_LIST_EVERY_S = 1.0  # between two comparisons of ids: tools that copy may write manifests later
_MAX_OPEN_SEGMENTS = 256


class OpenStore:
    """An open store. Thread safe for reading.

    Attributes:
        repairs: Repairs made when the store was opened.
        cache: What was read or worked out; chunks of single messages are a kind of it.
        schemas: Schemas by hash.
        entries: Entries of ended recordings that were compared with their files, by id.
        following: Held while running recordings are looked at, and while the newest state changes.
        channels: Channels of recordings by id and topic, and the entry that they are of.
        epochs: Where header stamps of recordings start again, by id, and the entry they are of.
    """

    def __init__(
        self, directory: StoreDirectory, mongo: str | None, progress: Progress | None
    ) -> None:
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
        self.index = IndexAccess(self, mongo, progress)
        self._latest: Session | None = None
        self._changed = 0  # as of the latest state, see `StoreDirectory.changed`
        self._names: list[str] = []  # ids of recordings
        self._listed_at = 0.0  # when they were compared last, by `monotonic`
        self.live: WeakSet[Any] = WeakSet()  # recordings that were started by it

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

    def now(self) -> Session:
        """The store at this moment, for one question; no file is read if nothing has changed."""
        self.check_process()
        latest = self._latest
        if latest is None or self._has_names_changed():
            latest = self.catch_up()
        # What running recordings have flushed since is for this question to see.
        return latest.again() if latest.snapshot().unfinished else latest

    def _has_names_changed(self) -> bool:
        """True if recordings have come or gone since the latest state."""
        now = self.directory.changed()
        is_due = time.monotonic() - self._listed_at >= _LIST_EVERY_S
        if now == self._changed and not is_due:
            return False
        self._listed_at = time.monotonic()
        is_same = self.directory.ids() == self._names
        self._changed = now if is_same else 0
        return not is_same

    def replace_latest(self, before: Snapshot, now: Session) -> None:
        """Let later questions begin with what one has seen, unless there is a newer state."""
        if self._latest is not None and self._latest.snapshot() is before:
            self._latest = now.again()

    def catch_up(self, *recordings: str) -> Session:
        """See which recordings came or went, and how some others are now; at first, all.

        All else that was read stays, so this costs little in a store of thousands.
        """
        with self.following:
            before = Snapshot((), {}) if self._latest is None else self._latest.snapshot()
            changed, names = self.directory.changed(), self.directory.ids()
            known = before.by_id.keys()
            ids = (known ^ {*names}) | self.repairs.unreadable.keys() | ({*recordings} & known)
            if self._latest is not None and not ids:
                return self._latest
            self._latest = latest = Session(self, self._files.look(before, ids))
            self._changed, self._names = changed, names
            self.index.note_changes()
            for recording in ids & known:
                self.channels.pop(recording, None)
                self.entries.pop(recording, None)
            self._drop_files()
            self._look_again_for_tables()
            return latest

    def newest(self) -> Snapshot:
        """All recordings; those that look different by now are read again."""
        with self.following:
            known = {one.id: one.look for one in self.now().snapshot().summaries}
            looks = self.directory.looks(list(known))
            changed = [one for one, look in known.items() if looks.get(one) != look]
            if changed or self.directory.ids() != self._names:
                self.catch_up(*changed)
            return self.now().snapshot()

    def invalidate(self) -> None:
        """Drop everything that was read, so that the next question reads the store again."""
        with self.following:
            self._latest = None
            self.index.note_changes()
            self.entries = {}
        self.channels.clear()
        self._drop_files()
        self.cache.drop("column")
        vars(self).pop("tables", None)

    def recover(self) -> None:
        """Finish what crashes and killed commands have left, before this process changes things.

        Questions write nothing: of what a recorder that died has left, they read what is flushed.
        """
        with self.following:
            self.check_process()
            known = self.catch_up().look().summaries
            done = self._files.recover([one.id for one in known if one.status == "unfinished"])
            for recording in done:
                self._running.pop(recording, None)
            if done:
                self.catch_up(*done)

    def recorded(self, report: RecordReport) -> None:
        """See a recording that has ended; if MongoDB is available again, index the rest."""
        self.catch_up(report.entry.id)
        from hybridlog.schema.codecs import unindexed  # loads numpy

        with suppress(HybridlogError):  # its files may have gone already
            report.not_indexed = unindexed(self.now().definitions(report.entry))
        if report.failure is None:
            return
        self.index.disconnect()
        try:
            self.index.connect()
        except HybridlogError as error:
            report.failure = error if isinstance(error, DatabaseError) else report.failure
            return
        report.entry = self.now().entry(report.entry.id)
        report.indexed, report.missed, report.failure = report.entry.documents, 0, None

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

    # Closing.

    def close(self) -> None:
        """End live recordings, close files and connections. May be called more than once."""
        with ExitStack() as held:
            held.callback(self._close)
            for one in [*self.live]:
                held.push(one)

    def _close(self) -> None:
        with self._opening:
            for reader in self._segments.values():
                reader.close()
        self._drop_files()
        self.index.disconnect()
        vars(self).pop("tables", None)
        self.is_closed = True
        self.catalog.close()


def _make_room(opened: dict[Any, Any]) -> None:
    """Drop the file that was opened first, if many are open.

    It is closed when the last thread that reads from it also drops it.
    """
    if len(opened) >= files.most_open(_MAX_OPEN_SEGMENTS):
        del opened[next(iter(opened))]
