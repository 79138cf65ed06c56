"""Writes the tables of a recording during indexing.

Rows remain in memory until there are too many. Then those of the largest topics become row groups
of unfinished files. When the recording has ended, all files get their names, and topics with few
rows go to files that recordings share.

Tables are derived. After any failure the recording continues, and a topic has no table.
"""

from __future__ import annotations

import errno
import logging
import shutil
from collections import Counter, defaultdict
from collections.abc import Collection, Hashable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa
from msgspec.structs import replace

from hybridlog.columns.column_file import ColumnFileWriter
from hybridlog.columns.fields import copied, joined, side_by_side
from hybridlog.columns.folders import Addition, TableFolders
from hybridlog.columns.layout import (
    SUFFIX,
    Section,
    parts_folder,
    shape_folder,
    type_prefix,
)
from hybridlog.columns.left_rows import LeftFields
from hybridlog.columns.rows import PointColumns, columns_from, is_cloud, rows_of
from hybridlog.schema.arrow_columns import structs
from hybridlog.schema.codec import no_messages
from hybridlog.schema.codecs import codec_for
from hybridlog.schema.states import encoding_of, state_of
from hybridlog_storage.disk import files
from hybridlog_storage.messages import EXPIRED_IDS, distinct, order_of
from hybridlog_storage.settings import read_settings

if TYPE_CHECKING:
    from hybridlog.index.indexing import Messages
    from hybridlog.schema.codec import Decoded
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.messages import Channel

_PENDING = 16 << 20  # bytes of rows waiting in memory
_LEFT = _PENDING // 4  # bytes of the smallest topics, which continue to wait for more rows
_PIECES = 32  # pieces of a topic that become one: small ones take far more than their bytes
LONG_ROWS = 10_000
"""Number of rows from which a topic has files of its own."""
LONG_BYTES = 1 << 20
"""Bytes of rows in memory from which a topic has files of its own."""
_RESERVE = 256 << 20  # bytes of the disk reserved for segments
_log = logging.getLogger(__name__)

# Loads pandas, if it is installed: amid a recording, that would hold up all threads for a while.
pa.array([0]).to_numpy(zero_copy_only=False)


class _Topic:
    """Messages of one topic and definition."""

    def __init__(self, channel: Channel, *, arrays: bool) -> None:
        self.name = channel.topic
        self.type = channel.schema.name if channel.schema is not None else ""
        self.has_arrays = arrays
        encoding = encoding_of(channel.message_encoding, channel.metadata)
        whole = replace(channel, message_encoding=encoding)
        self._points = PointColumns() if arrays and is_cloud(whole) else None
        codec = codec_for(whole)
        decoded = codec.columns_of(no_messages()) if codec.indexed else None
        # No rows, with the columns that the definition fixes.
        self._none = structs({}, 0) if decoded is None else columns_from(decoded, arrays=arrays)
        self.rows = self.unreadable = 0
        self.segments: set[int] = set()
        self.waiting: list[Any] = []
        """Rows in memory, without the names of recording and topic."""
        self.files: list[ColumnFileWriter] = []
        """Unfinished files, each with other columns."""

    @property
    def size(self) -> int:
        """Bytes of the rows in memory."""
        return sum(rows.nbytes for rows in self.waiting)

    @property
    def is_long(self) -> bool:
        """True if it has files of its own."""
        return bool(self.files) or self.rows >= LONG_ROWS or self.size >= LONG_BYTES

    def add(self, messages: Messages) -> None:
        """Make rows of messages."""
        own, fields = rows_of(
            messages.placed,
            messages.decoded,
            state_of(messages.channel.message_encoding),
            has_publish_time=messages.channel.has_publish_time,
            columns=self._columns,
        )
        self.waiting.append(side_by_side(own, fields))
        self.segments.update(distinct(messages.placed.segment).tolist())
        self.rows += len(fields)
        self.unreadable += len(fields) - own["error"].null_count
        if len(self.waiting) >= _PIECES:
            self.waiting = [joined(self.waiting)]

    def take(self, recording: str) -> pa.Table:
        """Remove the rows in memory, of which there are some, in order of time and arrival."""
        rows, self.waiting = joined([*self.waiting, self._none]), []
        named = {
            name: pa.repeat(pa.scalar(value), len(rows))
            for name, value in (("recording", recording), ("topic", self.name))
        }
        table = pa.Table.from_struct_array(side_by_side(named, rows))
        order = order_of(table["t"].to_numpy(), table["seq"].to_numpy())
        return table if order is None else table.take(pa.array(order))

    def give_up(self) -> None:
        """Make no table of the topic."""
        self.rows = 0
        self.waiting.clear()
        for file in self.files:
            file.discard()
        self.files.clear()

    def _columns(self, decoded: Decoded) -> Any:
        columns = columns_from(decoded, arrays=self.has_arrays)
        if self._points is not None and not isinstance(decoded.records, LeftFields):
            columns = self._points.with_points(columns, decoded.arrow())
        return copied(columns)


class TableWriter:
    """Writes the tables of one recording, which this process has locked for writing.

    Those of the topics that the store's settings name have arrays in full, unless payloads have
    expired. Without `topics`, all have tables, and there are none yet.
    """

    def __init__(
        self, root: Path, entry: RecordingEntry, topics: Collection[str] | None = None
    ) -> None:
        self._root = root
        self._recording = entry.id
        self._name = entry.name
        self._wanted = topics
        expired = {channel.topic for channel in entry.channels if channel.id >= EXPIRED_IDS}
        self._arrays = {*read_settings(root).arrays} - expired
        self._parts = parts_folder(root, entry.id)
        self._numbers = 0
        self._has_ended = False
        self.problem = ""  # why no table was written
        self._topics: dict[Hashable, _Topic] = {}

    def add(self, messages: Iterable[Messages]) -> None:
        """Add messages of the recording; rows of the largest topics go to files if many wait."""
        if self._has_ended:
            return
        with self._harmless():
            for one in messages:
                if self._wanted is None or one.channel.topic in self._wanted:
                    topic = self._topic(one.channel)
                    with self._only(topic):
                        topic.add(one)
            self._spill()

    def close(self, entry: RecordingEntry) -> None:
        """Finish all tables; topics with another number of messages keep an older one."""
        with self._harmless():
            self._close(entry)
        self.discard()

    def discard(self) -> None:
        """Stop writing, and delete all unfinished files."""
        self._has_ended = True
        for topic in self._topics.values():
            topic.give_up()
        self._topics.clear()
        with suppress(OSError):
            files.remove_tree(self._parts)

    @contextmanager
    def _harmless(self) -> Iterator[None]:
        """Continue the recording without tables after any failure."""
        try:
            yield
        except Exception as error:
            self.problem = str(getattr(error, "strerror", None) or error or repr(error))
            _log.warning("No tables of recording %s were written: %s", self._name, self.problem)
            self.discard()

    @contextmanager
    def _only(self, topic: _Topic) -> Iterator[None]:
        """Limit a failure to the table of one topic; a full disk ends all tables."""
        try:
            yield
        except (OSError, MemoryError):
            raise
        except Exception as error:
            _log.warning("no table of %s: %s", topic.name, error or repr(error))
            topic.give_up()

    def _topic(self, channel: Channel) -> _Topic:
        encoding = encoding_of(channel.message_encoding, channel.metadata)
        key = channel.topic, encoding, channel.schema
        if key not in self._topics:
            self._topics[key] = _Topic(channel, arrays=channel.topic in self._arrays)
        return self._topics[key]

    def _spill(self) -> None:
        left = sum(topic.size for topic in self._topics.values())
        if left < _PENDING:
            return
        for topic in sorted(self._topics.values(), key=lambda topic: -topic.size):
            if left > _LEFT:
                left -= topic.size
                with self._only(topic):
                    self._write(topic)

    def _write(self, topic: _Topic) -> None:
        """Write the rows in memory to an unfinished file of a topic."""
        if not topic.waiting:
            return
        self._check_room()
        table = topic.take(self._recording)
        file = next((one for one in topic.files if one.schema == table.schema), None)
        if file is None:
            if not self._numbers:
                with suppress(FileNotFoundError):
                    files.remove_tree(self._parts)  # left from a crash
                files.make_folders(self._parts)
            self._numbers += 1
            file = ColumnFileWriter(self._parts / f"{self._numbers}{SUFFIX}", table.schema)
            topic.files.append(file)
        file.write(table)

    def _check_room(self) -> None:
        if shutil.disk_usage(self._root).free < _RESERVE:
            raise OSError(errno.ENOSPC, f"the disk needs {_RESERVE >> 20} MiB free; make room")

    def _close(self, entry: RecordingEntry) -> None:
        incomplete = self._incomplete(entry)
        additions = defaultdict[str, Addition](Addition)
        for topic in sorted(self._topics.values(), key=lambda topic: topic.name):
            if topic.name in incomplete:
                topic.give_up()
            with self._only(topic):
                self._finish(topic, entry, additions)
        replaced: set[str] = set()
        if self._wanted is not None:
            # An older table may be the only copy of fields in a damaged chunk.
            replaced = {*self._wanted} - incomplete
        if additions or replaced:
            self._check_room()
            types = {type_prefix(c.type) for c in entry.channels if c.topic in replaced}
            folders = TableFolders(self._root, self._recording, entry.created)
            folders.add(additions, replaced, types)

    def _finish(
        self, topic: _Topic, entry: RecordingEntry, additions: Mapping[str, Addition]
    ) -> None:
        """Finish the files of a topic, or take its few rows."""
        digests = {str(number): entry.digests[str(number)] for number in sorted(topic.segments)}
        counts = topic.rows, topic.unreadable, topic.has_arrays
        section = Section(self._recording, topic.name, digests, *counts)
        if topic.is_long:
            self._write(topic)
        elif topic.waiting:
            table = topic.take(self._recording)
            additions[shape_folder(topic.type, table.schema)].pieces.append((section, table))
        for file in topic.files:
            file.close([replace(section, rows=file.rows)])
            section = replace(section, unreadable=0)  # of a table all are told in its first file
        for file in topic.files:
            additions[shape_folder(topic.type, file.schema)].files.append(file.path)

    def _incomplete(self, entry: RecordingEntry) -> set[str]:
        """Topics that can have no table."""
        rows: Counter[str] = Counter()
        for topic in self._topics.values():
            rows[topic.name] += topic.rows
        messages = entry.messages_by_topic()
        names = [*rows] if self._wanted is None else self._wanted
        return {name for name in names if rows[name] != messages[name]}
