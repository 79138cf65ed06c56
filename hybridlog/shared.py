"""What moments of an open store share: the catalog, open files, caches.

Beside them are the rows of logs whose payloads are gone.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any, Final

from hybridlog.maintenance.opening import StoreFiles
from hybridlog.maintenance.report import RepairReport
from hybridlog.record.marks import MARK_SCHEMA, with_marks
from hybridlog.snapshot import UNFINISHED, Snapshot
from hybridlog_storage.cache import Cache, lazy
from hybridlog_storage.catalog import Catalog, RecordingEntry, RecordingSummary, file_of
from hybridlog_storage.disk import files
from hybridlog_storage.errors import SegmentError, StoreError, UsageError
from hybridlog_storage.manifests import manifests_at
from hybridlog_storage.messages import Batch, schema_hash
from hybridlog_storage.segments.segment_reader import SegmentReader, open_log

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from hybridlog.columns.rows import RowsFile
    from hybridlog.columns.tables import Tables
    from hybridlog.query.question import RecordedChannel
    from hybridlog.record.running import RunningRecording
    from hybridlog_storage.disk.directory import StoreDirectory
    from hybridlog_storage.manifest import File

_RESTORE: Final = " Restore it from a copy; `hybridlog verify` shows what is affected."


class RecordingRows:
    """The files of rows of one recording; nothing is read before it is needed. Thread safe."""

    def __init__(self, recording: Path, cache: Cache | None = None) -> None:
        self._recording = recording
        self._cache = cache or Cache()
        self._files: dict[int, tuple[list[RowsFile], str]] = {}  # by log, and what is wrong

    @lazy
    def _listed(self) -> Mapping[int, Sequence[File]]:
        """The files that its manifest lists, by number of their log."""
        manifest = manifests_at(self._recording).find(self._recording.name)
        return {} if manifest is None else manifest.rows

    def left(self, log: int, chunk: int) -> tuple[Batch, NDArray[np.int64]]:
        """The rows that remain of a chunk, and the arrival numbers of its messages."""
        from hybridlog.columns.rows import messages_left

        if log not in self._files:
            self._files[log] = self._open(log)
        files, problems = self._files[log]
        try:
            found = [part for file in files for part in file.of_chunk(chunk)]
        except StoreError as error:
            raise SegmentError(f"{error}{_RESTORE}") from error
        if not found:
            problems = problems or f"Rows are in no file of {self._recording}."
            raise SegmentError(f"{problems}{_RESTORE}")
        return messages_left(found)

    def _open(self, log: int) -> tuple[list[RowsFile], str]:
        from hybridlog.columns.rows import RowsFile

        files: list[RowsFile] = []
        problems: list[str] = []
        for listed in self._listed.get(log, ()):
            try:
                files.append(RowsFile(self._recording, listed, self._cache))
            except StoreError as error:
                problems.append(str(error))
        return files, " ".join(problems)


_MAX_OPEN_SEGMENTS: Final = 256


class Shared:
    """All that questions to one open store share. Thread safe for reading.

    Attributes:
        repairs: Repairs made when the store was opened.
        cache: What was read or worked out; chunks of single messages are a kind of it.
        schemas: Schemas by hash.
        channels: Channels of recordings by id and topic, and the entry that they are of.
        epochs: Where header stamps of recordings start again, by id, and the entry they are of.
        following: Held while running recordings are looked at, and while the newest state changes.
        latest: The newest state; None before it is asked for.
        index, now, catch_up, recover: As of `OpenStore`.
    """

    index: Any
    now: Callable[[], Any]
    catch_up: Callable[..., Any]
    recover: Callable[[], None]

    def __init__(self, directory: StoreDirectory) -> None:
        self._process = os.getpid()
        self.latest: Snapshot | None = None
        self.is_closed = False
        self.directory = directory
        self.catalog = Catalog(directory.path, directory.cells)
        self.repairs = RepairReport()
        self._files = StoreFiles(directory, self.catalog, self.repairs)
        self.cache = Cache()
        self.schemas = {schema_hash(MARK_SCHEMA): MARK_SCHEMA}
        self.channels: dict[str, tuple[RecordingEntry, dict[str, list[RecordedChannel]]]] = {}
        self.epochs: dict[str, tuple[RecordingEntry, Any]] = {}
        self.following = threading.RLock()
        self._running: dict[str, RunningRecording] = {}
        self._entries: dict[str, RecordingEntry] = {}  # of ended ones, compared with their files
        most = files.most_open(_MAX_OPEN_SEGMENTS)
        # A file is closed when the last thread that reads from it drops it, too.
        self._opened = lru_cache(most)(self._open)
        self._rows = lru_cache(most)(lambda path, _: RecordingRows(path, cache=self.cache))

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
    def tables(self) -> Tables:
        """Parquet tables of topics; pyarrow is loaded for them."""
        from hybridlog.columns.tables import Tables

        return Tables(self.directory.path, self.cache)

    # Recordings.

    def followed(self, summary: RecordingSummary) -> RecordingEntry | None:
        """A running recording with what is flushed by now, None if gone; `following` is held."""
        from hybridlog.record.running import RunningRecording

        running = self._running.get(summary.id)
        if running is None:
            running = self._running[summary.id] = RunningRecording(
                self.directory, summary.id, partial(self.entry, summary)
            )
        entry = running.follow()
        self.schemas |= running.schemas
        if entry is None or entry.status not in UNFINISHED:
            del self._running[summary.id]
            self._drop_files()  # it may have tables now
        return entry

    def entry(self, summary: RecordingSummary) -> RecordingEntry | None:
        """The entry of what is sealed of a recording, compared with its files once."""
        found = None if summary.status in UNFINISHED else self._entries.get(summary.id)
        if found is None:
            seen = self._files.see(summary.id)
            if seen is None:
                return None
            if seen.look != summary.look:  # the index may have what the files had before
                self.index.note_changes()
            found = with_marks(seen.entry)
            if found.status not in UNFINISHED:
                found = self._entries.setdefault(summary.id, found)
        return found

    def segment(self, entry: RecordingEntry, number: int) -> SegmentReader:
        """The reader of a sealed segment."""
        return self._opened(entry.id, number, file_of(entry, number), entry.manifest.changes)

    def _open(self, recording: str, number: int, name: str, changes: int) -> SegmentReader:
        path = self.directory.recording(recording)
        return open_log(path / name, number, self._rows(path, changes).left)

    def _drop_files(self) -> None:
        self._opened.cache_clear()
        self._rows.cache_clear()
        self.cache.drop("chunk")
        if "tables" in vars(self):
            self.tables.look_again()
