"""Bytes that recordings and topics take on the disk, by tier.

Manifests, the sizes of files and one command for each collection of MongoDB suffice: the cost
does not depend on the number of messages. Files that topics share are divided by payload and
by number of messages.
"""

from __future__ import annotations

import os
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from msgspec import Struct

from hybridlog.columns.layout import type_prefix
from hybridlog_storage.mcap.mcap_content import MESSAGE_HEAD
from hybridlog_storage.mongo.index_documents import collection_of

if TYPE_CHECKING:
    from pathlib import Path

    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.disk.directory import StoreDirectory
    from hybridlog_storage.mongo.database import Database


_Key = TypeVar("_Key")
_SUMMED = ("messages", "payload_bytes", "segment_bytes", "column_bytes", "table_bytes")


class Size(Struct, frozen=True):
    """Bytes on the disk.

    Attributes:
        recording: Name of the recording; empty for several.
        topic: Full name; empty for several, and for what belongs to no topic: files without
            messages, and those that are being written.
        messages: Number of messages.
        payload_bytes: Their payloads, uncompressed.
        segment_bytes: Their share of the segments.
        column_bytes: What is left of those that have expired.
        table_bytes: Their share of the tables.
        index_bytes: Their share of MongoDB, estimated; None if it is unavailable.
    """

    recording: str
    topic: str
    messages: int = 0
    payload_bytes: int = 0
    segment_bytes: int = 0
    column_bytes: int = 0
    table_bytes: int = 0
    index_bytes: int | None = 0

    @property
    def total_bytes(self) -> int:
        """Sum of segments, files of rows, tables and MongoDB."""
        return self.segment_bytes + self.column_bytes + self.table_bytes + (self.index_bytes or 0)


class Sizes(Struct, frozen=True):
    """Sizes of recordings.

    Attributes:
        rows: Each topic of each recording, largest first.
    """

    rows: list[Size]

    @property
    def total(self) -> Size:
        """The sum."""
        return _sum("", "", self.rows)

    def by_recording(self) -> list[Size]:
        """The recordings, largest first."""
        return self._by(lambda row: (row.recording, ""))

    def by_topic(self) -> list[Size]:
        """The topics in all recordings, largest first."""
        return self._by(lambda row: ("", row.topic))

    def _by(self, key: Callable[[Size], tuple[str, str]]) -> list[Size]:
        groups: dict[tuple[str, str], list[Size]] = defaultdict(list)
        for row in self.rows:
            groups[key(row)].append(row)
        return _largest_first(_sum(*names, rows) for names, rows in groups.items())


def sizes_of(
    directory: StoreDirectory,
    entries: Sequence[RecordingEntry],
    database: Database | None,
) -> Sizes:
    """Sizes of some recordings."""
    index = None if database is None else _index_bytes(entries, database)
    rows: list[Size] = []
    tables = table_bytes(directory.path, entries)
    for entry in entries:
        segments, messages = _segment_bytes(directory, entry), entry.messages_by_topic()
        columns, payload = Counter[str](), Counter[str]()
        for _, topic, size in entry.rows:
            columns[topic] += size
        for channel in entry.channels:
            payload[channel.topic] += channel.stats.payload_bytes
        rows += [
            Size(
                entry.name,
                topic,
                messages[topic],
                payload[topic],
                segments[topic],
                columns[topic],
                tables.get((entry.id, topic), 0),
                None if index is None else index.get((entry.id, topic), 0),
            )
            for topic in {"", *messages}
        ]
    return Sizes(_largest_first(rows))


def disk_bytes(root: Path) -> int:
    """Bytes that everything below a folder takes; links are not followed."""
    found, folders = 0, [os.fspath(root)]
    while folders:
        with suppress(OSError), os.scandir(folders.pop()) as entries:  # it may go meanwhile
            for entry in entries:
                with suppress(OSError):
                    found += entry.stat(follow_symlinks=False).st_blocks * 512
                    if entry.is_dir(follow_symlinks=False):
                        folders.append(entry.path)
    return found


def _sum(recording: str, topic: str, rows: Sequence[Size]) -> Size:
    index = [row.index_bytes for row in rows if row.index_bytes is not None]
    sums = {name: sum(getattr(row, name) for row in rows) for name in _SUMMED}
    return Size(recording, topic, **sums, index_bytes=sum(index) if index or not rows else None)


def _largest_first(rows: Iterable[Size]) -> list[Size]:
    return sorted(rows, key=lambda row: (-row.total_bytes, row.recording, row.topic))


def _segment_bytes(directory: StoreDirectory, entry: RecordingEntry) -> Counter[str]:
    """Bytes of the segments by topic; the rest under the empty name."""
    manifest, whole = directory.manifests.read(entry.id), Counter[str]()
    for number, log in manifest.logs.items():
        if log.is_here and log.parts and str(number) in entry.digests:
            weights = Counter[str]()
            for channel, part in log.parts.items():
                weights[manifest.channels[channel].topic] += (
                    part.bytes + part.messages * MESSAGE_HEAD.itemsize
                )
            whole.update(_divided(log.bytes, weights))
    columns = sum(size for _, _, size in entry.rows)
    whole[""] += max(0, entry.stored_bytes - columns - whole.total())
    return whole


def table_bytes(root: Path, entries: Sequence[RecordingEntry]) -> Mapping[tuple[str, str], int]:
    """Bytes of the tables by recording and topic: their share of the rows of each file."""
    from hybridlog.columns.folders import files_of

    found: Counter[tuple[str, str]] = Counter()
    types = {type_prefix(channel.type) for entry in entries for channel in entry.channels}
    for file in files_of(root, types):
        rows = Counter[tuple[str, str]]()
        for section in file.about.sections:
            rows[section.id, section.topic] += section.rows
        found.update(_divided(file.size_bytes, rows))
    return found


def _divided(size: int, weights: Mapping[_Key, int]) -> Counter[_Key]:
    """A number of bytes divided by weights, without a rest."""
    names = list(weights)
    ends = np.cumsum([weights[name] for name in names])
    bounds = np.round(ends / ends[-1] * size).astype(np.int64)
    each = np.diff(bounds, prepend=0).tolist()
    return Counter({name: int(share) for name, share in zip(names, each, strict=True)})


def _index_bytes(
    entries: Sequence[RecordingEntry], database: Database
) -> dict[tuple[str, str], int]:
    """Bytes in MongoDB by recording and topic: the documents' share of their collection."""
    documents: dict[str, Counter[tuple[str, str]]] = defaultdict(Counter)
    for entry in entries:
        for channel in entry.channels:
            if channel.is_indexed and channel.stats.messages:
                count = documents[collection_of(channel.topic)]
                count[entry.id, channel.topic] += channel.stats.messages
    found: dict[tuple[str, str], int] = {}
    for collection, counts in documents.items():
        number, size = database.size(collection)
        # Of other recordings, there may be more. After a crash, the count may be too small.
        others = max(0, number - counts.total())
        shares = _divided(size, {**counts, ("", ""): others})
        found.update({key: shares[key] for key in counts})
    return found
