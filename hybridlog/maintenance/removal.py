"""Removes recordings; the next opening finishes an interrupted removal."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

from hybridlog.maintenance import tables
from hybridlog.maintenance.index import forget
from hybridlog.maintenance.opening import announce_removal
from hybridlog_storage.disk.directory import LOCK_WAIT_S
from hybridlog_storage.errors import TopicError
from hybridlog_storage.mongo.index_state import IndexState
from hybridlog_storage.remote.store import RemoteDirectory

if TYPE_CHECKING:
    from hybridlog_storage.catalog import Catalog, RecordingEntry
    from hybridlog_storage.disk.directory import StoreDirectory
    from hybridlog_storage.mongo.database import Database


def remove(
    directory: StoreDirectory,
    catalog: Catalog,
    database: Database | None,
    entry: RecordingEntry,
) -> None:
    """Delete a recording.

    The journal announces it first. Then the directory gets a hidden name, and the recording
    is gone; the next opening removes remaining files. In a bucket it is listed no more, and its
    objects stay for those who read them.

    Args:
        directory: The store.
        catalog: Its catalog.
        database: The index; None if it is unavailable: the next connection clears it.
        entry: The recording.

    Raises:
        StoreError: It is being written, or cannot be removed.
        TopicError: It is gone.
        DatabaseError: MongoDB fails; the files are gone, and the next connection clears it.
    """
    with directory.writing(entry.label, entry.id, wait_s=LOCK_WAIT_S) as label:
        if isinstance(directory, RemoteDirectory):
            directory.drop(label)
            catalog.remove(entry.id)
            return
        announce_removal(directory, label)
        tables.announce_removal(directory, entry.id)
        hidden = directory.hide(label)
        try:
            catalog.remove(entry.id)
            with suppress(OSError):  # the next connection removes them
                tables.remove(directory, entry.id, {c.type for c in entry.channels})
            if database is not None:
                _clear(database, entry)
        finally:
            # On a full disk, the space of these files is needed first.
            directory.sweep(hidden)


def _clear(database: Database, entry: RecordingEntry) -> None:
    """Remove a recording from the index."""
    state = IndexState(database)
    indexed = state.one(entry.key)
    if indexed is not None:
        state.put(entry, "removing", turn=indexed.turn + 1)
    forget(database, entry.key, indexed)


def remove_copy(directory: StoreDirectory, label: str, recording: str) -> None:
    """Delete a directory with a copy of a recording; the index stays.

    Raises:
        StoreError: It is being written, or cannot be removed.
        TopicError: It is no copy of the recording any more.
    """
    with directory.writing(label, recording, wait_s=LOCK_WAIT_S) as now:
        if now != label or directory.labels_of(recording) == [label]:
            raise TopicError(f"{label!r} is no longer a copy of another recording.")
        directory.sweep(directory.hide(label))
