"""An open store: its newest state, of which each question takes a moment; recovery; closing."""

from __future__ import annotations

import time
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING, Any, Final
from weakref import WeakSet

from hybridlog.index.access import IndexAccess
from hybridlog.session import Session
from hybridlog.shared import Shared
from hybridlog.snapshot import Snapshot
from hybridlog_storage.errors import HybridlogError

if TYPE_CHECKING:
    from hybridlog.maintenance.report import Progress
    from hybridlog.record.recorder import RecordReport
    from hybridlog_storage.disk.directory import StoreDirectory

_TICK_NS: Final = 50_000_000


class OpenStore(Shared):
    """An open store, of which a `Session` is one moment. Thread safe for reading."""

    index: IndexAccess

    def __init__(
        self, directory: StoreDirectory, mongo: str | None, progress: Progress | None
    ) -> None:
        super().__init__(directory)
        self.index = IndexAccess(self, mongo, progress)
        self.live: WeakSet[Any] = WeakSet()  # recordings that were started by it
        self._changed = -1  # when ids were compared, see `StoreDirectory.changed`
        self._names: list[str] = []  # ids of recordings

    def now(self) -> Session:
        """The store at this moment, for one question; no file is read if nothing has changed."""
        self.check_process()
        changed, latest = self.directory.changed(), self.latest
        if latest is None or changed != self._changed:
            # What comes within a tick of the file system's clock leaves the time as it is.
            self._changed = changed if time.time_ns() - changed > _TICK_NS else -1
            if latest is None or self.directory.ids() != self._names:
                latest = self.catch_up()
        return Session(self, latest)

    def catch_up(self, *recordings: str) -> Snapshot:
        """See which recordings came or went, and how some others are now; at first, all.

        All else that was read stays, so this costs little in a store of thousands.
        """
        with self.following:
            before = self.latest or Snapshot((), {})
            self._names, known = self.directory.ids(), before.by_id.keys()
            unreadable = self.repairs.unreadable.keys()
            ids = (known ^ {*self._names}) | unreadable | ({*recordings} & known)
            if self.latest is not None and not ids:
                return self.latest
            self.latest = latest = self._files.look(before, ids)
            self.index.note_changes()
            for recording in ids & known:
                self.channels.pop(recording, None)
                self._entries.pop(recording, None)
            self._drop_files()
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
            self.latest = None
            self.index.note_changes()
            self._entries = {}
        self.channels.clear()
        self.cache.drop("column")
        vars(self).pop("tables", None)
        self._drop_files()

    def recover(self) -> None:
        """Finish what crashes and killed commands have left, before this process changes things.

        Questions write nothing: of what a recorder that died has left, they read what is flushed.
        """
        with self.following:
            self.check_process()
            known = Session(self, self.catch_up()).look().unfinished
            done = self._files.recover([one.id for one in known if one.status == "unfinished"])
            for recording in done:
                self._running.pop(recording, None)
            if done:
                self.catch_up(*done)

    def recorded(self, report: RecordReport) -> None:
        """See a recording that has ended."""
        self.catch_up(report.entry.id)
        from hybridlog.schema.codecs import unindexed  # loads numpy

        with suppress(HybridlogError):  # its files may have gone already
            report.not_indexed = unindexed(self.now().definitions(report.entry))

    def close(self) -> None:
        """End live recordings, close files and connections. May be called more than once."""
        with ExitStack() as held:
            held.callback(self._close)
            for one in [*self.live]:
                held.push(one)

    def _close(self) -> None:
        vars(self).pop("tables", None)
        self._drop_files()
        self.index.disconnect()
        self.is_closed = True
        self.catalog.close()
