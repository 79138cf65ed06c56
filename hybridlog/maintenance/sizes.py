"""Bytes that recordings and topics take on the disk, by tier.

Manifests and the sizes of files suffice: the cost does not depend on the number of messages. Files
that topics share are divided by payload and by number of messages.
"""

from __future__ import annotations

import os
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from itertools import chain
from typing import TYPE_CHECKING, TypeVar

from msgspec import Struct

from hybridlog.columns.layout import type_prefix
from hybridlog_storage.mcap.mcap_content import MESSAGE_HEAD

if TYPE_CHECKING:
    from pathlib import Path

    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.disk.directory import StoreDirectory


_Key = TypeVar("_Key")
_SUMMED = ("messages", "payload_bytes", "segment_bytes", "table_bytes")


class Size(Struct, frozen=True):
    """Bytes on the disk.

    Attributes:
        recording: Name of the recording; empty for several.
        topic: Full name; empty for several, and for what belongs to no topic: files without
            messages, and those that are being written.
        messages: Number of messages.
        payload_bytes: Their payloads, uncompressed.
        segment_bytes: Their share of the segments, and what is left of those that have expired.
        table_bytes: Their share of the tables.
    """

    recording: str
    topic: str
    messages: int = 0
    payload_bytes: int = 0
    segment_bytes: int = 0
    table_bytes: int = 0

    @property
    def total_bytes(self) -> int:
        """Sum of segments and tables."""
        return self.segment_bytes + self.table_bytes


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


def sizes_of(directory: StoreDirectory, entries: Sequence[RecordingEntry]) -> Sizes:
    """Sizes of some recordings."""
    rows = list[Size]()
    tables = table_bytes(directory.path, entries)
    for entry in entries:
        name, segments, messages = entry.name, _segment_bytes(entry), entry.messages_by_topic()
        payload = Counter[str]()
        for channel in entry.channels:
            payload[channel.topic] += channel.stats.payload_bytes
        rows += (
            Size(name, one, messages[one], payload[one], segments[one], tables[entry.id, one])
            for one in {"", *messages}
        )
    return Sizes(_largest_first(rows))


def disk_bytes(root: Path, but: Collection[str] = ()) -> int:
    """Bytes that everything below a folder takes, without some names; links are not followed."""
    found, folders = 0, [os.fspath(root)]
    while folders:
        with suppress(OSError), os.scandir(folders.pop()) as entries:  # it may go meanwhile
            for entry in (one for one in entries if one.name not in but):
                with suppress(OSError):
                    found += entry.stat(follow_symlinks=False).st_blocks * 512
                    if entry.is_dir(follow_symlinks=False):
                        folders.append(entry.path)
    return found


def _sum(recording: str, topic: str, rows: Sequence[Size]) -> Size:
    sums = {name: sum(getattr(row, name) for row in rows) for name in _SUMMED}
    return Size(recording, topic, **sums)


def _largest_first(rows: Iterable[Size]) -> list[Size]:
    return sorted(rows, key=lambda row: (-row.total_bytes, row.recording, row.topic))


def _segment_bytes(entry: RecordingEntry) -> Counter[str]:
    """Bytes of the segments and files of rows by topic; the rest under the empty name."""
    topics = {number: one.topic for number, one in entry.manifest.channels.items()}
    whole = Counter[str]()
    for log in entry.logs.values():
        if log.is_here and log.parts:
            weights = Counter[str]()
            for number, part in log.parts.items():
                weights[topics[number]] += part.bytes + part.messages * MESSAGE_HEAD.itemsize
            whole.update(_divided(log.bytes, weights))
    for file in chain(*entry.manifest.rows.values()):
        whole[topics[next(iter(file.parts))]] += file.bytes
    whole[""] += max(0, entry.stored_bytes - whole.total())
    return whole


def table_bytes(root: Path, entries: Sequence[RecordingEntry]) -> Counter[tuple[str, str]]:
    """Bytes of the tables by recording and topic: their share of the rows of each file."""
    from hybridlog.columns.tables import files_of

    found: Counter[tuple[str, str]] = Counter()
    types = {type_prefix(channel.type) for entry in entries for channel in entry.channels}
    for file in files_of(root, types):
        rows = Counter[tuple[str, str]]()
        for section in file.sections:
            rows[section.id, section.topic] += section.rows
        found.update(_divided(file.size_bytes, rows))
    return found


def _divided(size: int, weights: Mapping[_Key, int]) -> Counter[_Key]:
    """A number of bytes divided by weights, without a rest."""
    found, left = Counter[_Key](), sum(weights.values())
    for name, weight in weights.items():
        found[name] = size * weight // left if weight else 0
        size, left = size - found[name], left - weight
    return found
