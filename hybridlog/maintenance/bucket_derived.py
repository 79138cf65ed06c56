"""Brings what is derived of recordings to their copies in a bucket, so that few requests answer."""

from __future__ import annotations

import os
import tempfile
from collections import defaultdict
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

from hybridlog.columns.folders import Addition, TableFolders, files_of
from hybridlog.columns.layout import SHARED, SUFFIX, TABLES
from hybridlog.entries import describe, take_inventory
from hybridlog.maintenance.opening import open_catalog
from hybridlog.snapshot import UNFINISHED
from hybridlog_storage.copy_places import read
from hybridlog_storage.disk import files
from hybridlog_storage.errors import StoreError, unreadable

if TYPE_CHECKING:
    from collections.abc import Collection

    from hybridlog.shared import Shared
    from hybridlog_storage.catalog import Catalog, RecordingEntry
    from hybridlog_storage.remote.bucket import Object
    from hybridlog_storage.remote.store import RemoteDirectory

_TRIES: Final = 10  # while others write the catalog, too


def bring_derived(source: Shared, target: RemoteDirectory, recordings: Collection[str]) -> None:
    """Bring the tables and the rows of the catalog of recordings that were copied into a bucket.

    Nothing depends on it: without it answers are the same, and take more requests.
    """
    known = {}
    for recording in recordings:
        entry = source.now().entry_if_there(recording)
        if entry is not None and entry.status not in UNFINISHED:
            known[recording] = entry, _bring_tables(source, target, entry)
    cells = target.source.cells
    for _ in range(_TRIES if known else 0):
        target.manifests.look(now=True)
        catalog = open_catalog(target)
        for recording, (entry, tables) in known.items():
            with suppress(StoreError):  # who asks for it there is told what is wrong
                _describe(source.catalog, entry, target, catalog)
                cells.put_tables(recording, tables)
        if cells.save():
            return
    cells.close()  # a manifest may have been made again


def _describe(
    known: Catalog, entry: RecordingEntry, target: RemoteDirectory, catalog: Catalog
) -> None:
    """Make the row of the catalog from what is there, and from what decoding found out here."""
    for number, digest in entry.digests.items():
        decoded = known.decoded(entry, int(number))
        if decoded is not None:
            catalog.put_decoded(entry.id, int(number), digest, decoded)
    catalog.put_damage(entry.id, known.damage(entry.id))
    catalog.put(describe(catalog, take_inventory(target, entry.id)))


def _bring_tables(source: Shared, target: RemoteDirectory, entry: RecordingEntry) -> list[Object]:
    """Write the tables of a recording; no file of them has another recording."""
    found, numbers = [], dict[str, int]()
    with tempfile.TemporaryDirectory(prefix="hybridlog-") as place:
        for path in _tables(source, entry, Path(place)):
            folder = path.parent.name
            number = numbers[folder] = numbers.get(folder, -1) + 1
            name = f"{TABLES}/{folder}/{entry.id}-{number}{SUFFIX}"
            try:
                fd = files.open_file(path, os.O_RDONLY)
            except OSError as error:
                raise unreadable(error, path) from error
            try:
                size = os.fstat(fd).st_size
                found.append(target.bucket.put(name, size, read(fd, 0, size)))
            finally:
                os.close(fd)
    return found


def _tables(source: Shared, entry: RecordingEntry, root: Path) -> list[Path]:
    """Files with the fields of a recording; of shared ones its rows alone, below `root`."""
    found = []
    shared = defaultdict[str, Addition](Addition)
    for file, begin, section in source.tables.sections_of(entry):
        if not section.segments.items() <= entry.digests.items():
            continue  # they are of what it was before
        if not file.path.name.startswith(SHARED):
            found.append(file.path)
            continue
        with suppress(StoreError):  # what is damaged is left out: messages answer, too
            rows = file.table().slice(begin, section.rows)
            shared[file.path.parent.name].pieces.append((section, rows))
    TableFolders(root, entry.id, entry.created).add(shared)
    return found + [reader.path for reader in files_of(root)]
