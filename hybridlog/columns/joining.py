"""Joins files of fields of a topic, of which each expiry writes one.

The new file is forced to the disk, read, and compared with the others. Then one change of the
manifest lists it and deletes those.
"""

from __future__ import annotations

from functools import partial
from itertools import count
from typing import TYPE_CHECKING, Any

import pyarrow as pa

from hybridlog.columns import payload_files
from hybridlog.columns.field_files import FieldColumns, FieldFile, newest
from hybridlog.columns.layout import PAYLOAD_PARTS, table_schema_of
from hybridlog.columns.payload_files import RecordingPayloads, next_number
from hybridlog.columns.payload_writer import TopicWriter
from hybridlog_storage.disk import files
from hybridlog_storage.errors import StoreError
from hybridlog_storage.manifests import manifests_at

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from hybridlog_storage.manifest import Fields, Manifest
    from hybridlog_storage.messages import Channel

_SMALL_FILE = 64 << 20  # bytes
_Chunk = tuple[int, int]


def join(path: Path, channels: Iterable[Channel], max_files: int) -> int:
    """Join small files of fields of some topics where there are many.

    Args:
        path: The recording's directory, locked by this process.
        channels: Channels of the topics.
        max_files: Small files that a topic may have.

    Returns:
        Bytes that became free.

    Raises:
        StoreError: A file is damaged, or cannot be written; all is as before.
    """
    freed = 0
    for channel in channels:
        manifest = manifests_at(path).read(path.name)
        columns = FieldColumns(channel)
        beginning = f"{columns.folder}/{table_schema_of(channel)[:8]}-"
        small = [
            file
            for file in manifest.fields
            if file.file.startswith(beginning) and file.bytes < _SMALL_FILE
        ]
        if len(small) > max_files:
            freed += _join(path, manifest, channel, columns, small)
    return freed


def _join(
    path: Path,
    manifest: Manifest,
    channel: Channel,
    columns: FieldColumns,
    old: Sequence[Fields],
) -> int:
    folder = path / PAYLOAD_PARTS
    files.remove_tree(folder)
    readers = _readers(RecordingPayloads(path, old), old)
    numbers = partial(next, count(next_number(manifest)))
    writer = TopicWriter(folder, manifest.id, channel, columns, numbers)
    having: dict[_Chunk, list[FieldFile]] = {}
    for reader in readers:
        for key in reader.places:
            having.setdefault(key, []).append(reader)
    try:
        for segment, chunk in sorted(having):
            digest = having[segment, chunk][0].about.recordings[0].segments[str(segment)]
            for table in _tables(having[segment, chunk], (segment, chunk)):
                writer.add(table, segment, chunk, digest)
        writer.close()
        made = writer.written
        new: dict[_Chunk, list[FieldFile]] = {}
        for reader in _readers(RecordingPayloads(path, made, PAYLOAD_PARTS), made):
            for key in reader.places:
                new.setdefault(key, []).append(reader)
        for key, found in having.items():
            if not _are_same(_tables(found, key), _tables(new.get(key, ()), key)):
                raise StoreError(f"The joined fields of {path} do not come back.")
        payload_files.announce(path, made, [file.file for file in old])
    except BaseException:
        payload_files.take_back(path)
        raise
    return sum(file.bytes for file in old) - sum(file.bytes for file in made)


def _readers(payloads: RecordingPayloads, listed: Sequence[Fields]) -> list[FieldFile]:
    return [payloads.reader(file) for file in listed]


def _tables(having: Sequence[FieldFile], key: _Chunk) -> list[pa.Table]:
    """The rows of a chunk, each once; a table for each set of columns."""
    by_schema: dict[Any, list[pa.Table]] = {}
    for file in newest(having, key):
        table = pa.Table.from_struct_array(file.rows(*key))
        by_schema.setdefault(table.schema, []).append(table)
    return [pa.concat_tables(tables).combine_chunks() for tables in by_schema.values()]


def _are_same(some: Sequence[pa.Table], others: Sequence[pa.Table]) -> bool:
    """True if tables have the same rows."""
    left = [*others]
    for table in some:
        same = next((n for n, one in enumerate(left) if one.equals(table)), None)
        if same is None:
            return False
        del left[same]
    return not left
