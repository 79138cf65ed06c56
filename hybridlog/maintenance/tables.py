"""Finds and removes the tables of recordings."""

from __future__ import annotations

from collections.abc import Collection
from contextlib import suppress
from typing import TYPE_CHECKING

from hybridlog.columns.layout import PARTS, parts_folder, topics_of, type_prefix
from hybridlog_storage.disk import files
from hybridlog_storage.errors import StoreError, TopicError

if TYPE_CHECKING:
    from hybridlog.columns.tables import Tables
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.disk.directory import StoreDirectory


def missing(
    directory: StoreDirectory, entry: RecordingEntry, tables: Tables | None = None
) -> set[str]:
    """Topics of which tables lack rows, or have others than the catalog."""
    from hybridlog.columns.tables import Tables

    return (tables or Tables(directory.path)).lacking(entry, topics_of(entry))


def remove(directory: StoreDirectory, recording: str, entry: RecordingEntry | None = None) -> None:
    """Remove all tables of a recording."""
    from hybridlog.columns.folders import TableFolders

    prefixes = [""] if entry is None else {type_prefix(one.type) for one in entry.channels}
    created = None if entry is None else entry.created
    TableFolders(directory.path, recording, created).remove(prefixes)
    with suppress(FileNotFoundError):
        files.remove_tree(parts_folder(directory.path, recording))


def clear(directory: StoreDirectory, gone: Collection[str], known: Collection[str]) -> None:
    """Remove tables of removed recordings, and unfinished files that a crash has left.

    `known` are the recordings that there are. What is impossible now is done the next time.
    """
    unfinished = set(gone)
    with suppress(OSError):
        unfinished.update(name.removeprefix("r") for name in files.names(directory.path / PARTS))
    for recording in sorted(unfinished):
        with suppress(OSError, StoreError, TopicError):
            if recording not in known:
                remove(directory, recording)
                continue
            with directory.writing(recording):
                files.remove_tree(parts_folder(directory.path, recording))
