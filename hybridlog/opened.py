"""An open store: its newest state, of which each question takes a moment; repairs; closing."""

from __future__ import annotations

import math
import threading
import time
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

from hybridlog.index.access import IndexAccess
from hybridlog.session import Session
from hybridlog.shared import Shared
from hybridlog.snapshot import UNFINISHED
from hybridlog_storage.disk import files
from hybridlog_storage.errors import DatabaseError, DiskFullError, HybridlogError

if TYPE_CHECKING:
    from hybridlog.maintenance.report import Progress
    from hybridlog.record.recorder import RecordReport
    from hybridlog.snapshot import Snapshot
    from hybridlog_storage.disk.directory import StoreDirectory
    from hybridlog_storage.summary import RecordingSummary

_LIST_EVERY_S = 1.0  # between two comparisons of ids: tools that copy may write manifests later


class OpenStore(Shared):
    """An open store. Thread safe for reading."""

    index: IndexAccess

    def __init__(
        self,
        directory: StoreDirectory,
        mongo: str | None,
        progress: Progress | None,
        cache_mb: int | None = None,
        *,
        recover: bool = True,
    ) -> None:
        super().__init__(directory)
        self.index = IndexAccess(self, mongo, cache_mb, progress, recovers=recover)
        self._recovers = recover
        self._is_opened = False  # what a crash left was repaired, unless it is left to another
        self._latest: Session | None = None
        self._changed = 0, False  # as of the latest state, see `StoreDirectory.changed`
        self._names: list[str] = []  # ids of recordings
        self._listed_at = 0.0  # when they were compared last, by `monotonic`
        self._mending = threading.Lock()

    def now(self) -> Session:
        """The store at this moment, for one question; no file is read if nothing has changed."""
        self.check_process()
        latest = self._latest
        if latest is None:
            return self._read()
        if self._has_names_changed():
            self.catch_up()
            return self._latest or self._read()
        # What running recordings have flushed since is for this question to see.
        return latest.again() if latest.snapshot().unfinished else latest

    def _read(self) -> Session:
        with self.following:  # or a thread might keep an older state than `_changed` says
            if self._latest is not None:
                return self._latest
            mends, self._is_opened = self._recovers and not self._is_opened, True
            self._changed = self.directory.changed()
            self._names = self.directory.ids()
            try:
                found = replace(self._files, mends=mends).look_at_all()
            except DiskFullError as error:
                # The store remains readable, and recordings can be removed.
                self.repairs.disk_full = error
                found = self._files.look_at_all()
            self._latest = Session(self, found)
            return self._latest

    def _has_names_changed(self) -> bool:
        """True if recordings have come or gone since the latest state."""
        now = self.directory.changed()
        is_due = time.monotonic() - self._listed_at >= _LIST_EVERY_S
        if now == self._changed and not is_due:
            return False
        self._listed_at = time.monotonic()
        is_same = self.directory.ids() == self._names
        self._changed = now if is_same else (0, False)
        return not is_same

    def has_changed(self) -> bool:
        """True if recordings look different by now."""
        latest = self._latest
        return latest is None or self.newest() is not latest.snapshot()

    def replace_latest(self, before: Snapshot, now: Session) -> None:
        """Let later questions begin with what one has seen, unless there is a newer state."""
        if self._latest is not None and self._latest.snapshot() is before:
            self._latest = now.again()

    def catch_up(self, *recordings: str, mends: bool = False) -> None:
        """See which recordings came or went, and how some others are now.

        All else that was read stays, so this costs little in a store of thousands. With `mends`,
        those that a crash has cut short are recovered.
        """
        with self.following:
            if self._latest is None:
                return
            self.catalog.has_changed |= bool(recordings)
            before = self._latest.snapshot()
            changed, names = self.directory.changed(), self.directory.ids()
            known = before.by_id.keys()
            moved = known ^ {*names}  # they came or went
            ids = moved | ({*recordings} & known)
            now = replace(self._files, mends=mends).catch_up(before, ids)
            if now is None or (moved and self.directory.changed()[0] != changed[0]):
                self.invalidate()
                return
            self._changed, self._names = changed, names
            self._latest = Session(self, now)
            self.index.note_changes()
            self._invalidate_recordings(ids & known)

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

    # Repairs.

    def mend(self, seconds: float = math.inf) -> None:
        """Repair what questions met: recordings after a crash, missing and damaged tables.

        Tables that are not made in so many seconds stay in `repairs.noted_tables`.
        """
        self.check_process()
        if self.directory.is_writable:
            with self._mending:
                self._mend(time.monotonic() + seconds)

    def _mend(self, until: float) -> None:
        repairs = self.repairs
        known = self.now().snapshot().summaries
        died = [one.id for one in known if one.status == "unfinished"]
        if died and time.monotonic() < until:
            with self.following:
                for recording in died:
                    self._running.pop(recording, None)
                self.catch_up(*died, mends=True)
        session = self.now()
        for recording in {recording for recording, _ in repairs.noted_tables}:
            from hybridlog.maintenance.tables import missing

            entry = session.entry_if_there(recording)
            topics = set() if entry is None else missing(self.directory, entry, self.tables)
            if entry is not None and topics:
                from hybridlog.follow.follower import make_tables

                try:
                    problem = make_tables(
                        self.directory, self.catalog, entry, topics=topics, until=until
                    )
                except TimeoutError:
                    continue
                if not problem:
                    self.tables.look_again()
                    made = (one for one in sorted(topics) if self.tables.of(entry, one) is not None)
                    repairs.tables += [(entry.name, one) for one in made]
            repairs.noted_tables = {one for one in repairs.noted_tables if one[0] != recording}

    def recorded(self, report: RecordReport) -> None:
        """See a recording that has ended; if MongoDB is available again, index the rest."""
        self.catch_up(report.entry.id)
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

    # Closing.

    def _write_recordings_file(self) -> None:
        """List the ended recordings for other readers of their tables."""
        from hybridlog.columns.recordings_file import write_recordings_file

        ended = self._ended_now()
        write_recordings_file(self.catalog.recordings_file, ended)
        if ended != self._ended_now():  # somebody has changed one meanwhile
            files.unlink(self.catalog.recordings_file)

    def _ended_now(self) -> list[RecordingSummary]:
        """Summaries of all ended recordings."""
        return [one for one in self.newest().summaries if one.status not in UNFINISHED]

    def close(self) -> None:
        """Close files and connections. May be called more than once."""
        with self._opening:
            for reader in self._segments.values():
                reader.close()
        self._drop_files()
        self.index.disconnect()
        is_missing = "tables" in vars(self) and not self.catalog.recordings_file.exists()
        vars(self).pop("tables", None)
        is_written = self.directory.is_writable and not self.catalog.is_in_memory
        if is_written and (self.catalog.has_changed or is_missing):
            with suppress(OSError, HybridlogError):
                self._write_recordings_file()
        self.is_closed = True
        self.catalog.close()
