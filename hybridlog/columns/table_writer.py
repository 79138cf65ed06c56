"""Writes the tables of a recording during indexing.

Rows remain in memory until their segment is sealed, or until there are too many. Then they
become row groups of an unfinished file of their topic. Topics with few rows wait until the
recording has ended, and go to files that recordings share.

Tables are derived. After any failure the recording continues, and a topic has no table.
"""

from __future__ import annotations

import errno
import logging
import shutil
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import pyarrow as pa
from msgspec.structs import replace

from hybridlog.columns.column_file import ColumnFileWriter
from hybridlog.columns.fields import FieldShape, copied, joined
from hybridlog.columns.folders import Addition, TableFolders
from hybridlog.columns.layout import (
    SUFFIX,
    Section,
    parts_folder,
    shape_folder,
    table_schema_of,
    type_prefix,
)
from hybridlog.columns.left_rows import LeftFields
from hybridlog.columns.rows import Piece, PointColumns, as_table, columns_from, is_cloud, piece_of
from hybridlog.schema.arrow_columns import structs
from hybridlog.schema.codec import no_messages
from hybridlog.schema.codecs import codec_for
from hybridlog.schema.states import encoding_of, state_of
from hybridlog_storage.disk import files
from hybridlog_storage.messages import order_of
from hybridlog_storage.settings import read_settings

if TYPE_CHECKING:
    from hybridlog.index.indexing import Messages
    from hybridlog.schema.codec import Decoded
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.messages import Channel

GROUP_ROWS: Final = 131_072
"""Maximum number of rows in a row group."""
GROUP_BYTES: Final = 32 << 20
"""Maximum bytes of the columns of a row group in memory."""
_PENDING = 16 << 20  # bytes of rows waiting in memory
_LEFT = _PENDING // 4  # bytes of the smallest topics, which continue to wait for more rows
_PIECES = 32  # pieces of a topic that become one: small ones take far more than their bytes
LONG_ROWS = 10_000
"""Number of rows from which a topic has files of its own."""
LONG_BYTES = 1 << 20
"""Bytes of rows in memory from which a topic has files of its own."""
_RESERVE = 256 << 20  # bytes of the disk reserved for segments
_OPEN_FILES = 128  # maximum number of unfinished files
_log = logging.getLogger(__name__)

# Loads pandas, if it is installed: amid a recording, that would hold up all threads for a while.
pa.array([0]).to_numpy(zero_copy_only=False)


class _Topic:
    """Messages of one topic and definition."""

    def __init__(self, recording: str, channel: Channel, *, arrays: bool = False) -> None:
        self.recording = recording
        self.name = channel.topic
        self.type = channel.schema.name if channel.schema is not None else ""
        self.has_arrays = arrays
        encoding = encoding_of(channel.message_encoding, channel.metadata)
        whole = replace(channel, message_encoding=encoding)
        self.shape = FieldShape(arrays=arrays)
        self.points = PointColumns() if arrays and is_cloud(whole) else None
        codec = codec_for(whole)
        decoded = codec.columns_of(no_messages()) if codec.indexed else None
        self.none = structs({}, 0) if decoded is None else self.shape.columns(decoded.arrow())
        """No fields, with the columns that the definition fixes."""
        self.rows = 0
        self.pieces: list[Piece] = []
        """Rows in memory."""
        self.files: list[_File] = []
        """Unfinished files, with rows of segments that are not closed yet."""
        self.finished: list[tuple[str, Path]] = []
        """Folders and paths of finished files."""
        self.has_failed = False

    @property
    def size(self) -> int:
        """Bytes of the rows in memory."""
        return sum(piece.size for piece in self.pieces)

    @property
    def is_long(self) -> bool:
        """True if the rows in memory have a file of their own."""
        return sum(one.rows for one in self.pieces) >= LONG_ROWS or self.size >= LONG_BYTES

    def add(self, piece: Piece) -> None:
        """Add rows."""
        self.pieces.append(piece)
        self.rows += piece.rows
        if len(self.pieces) >= _PIECES:
            self.pieces = [self._joined()]

    def take(self) -> tuple[Piece, pa.Table]:
        """Remove and return the rows in memory, of which there are some, also as a table.

        That is in the order of log time and arrival.
        """
        piece, self.pieces = self._joined(), []
        names = {"recording": self.recording, "topic": self.name}
        columns = {name: pa.repeat(pa.scalar(value), piece.rows) for name, value in names.items()}
        table = as_table({**columns, **piece.own}, piece.fields)
        order = order_of(piece.own["t"].to_numpy(), piece.own["seq"].to_numpy())
        return piece, table if order is None else table.take(pa.array(order))

    def _joined(self) -> Piece:
        pieces = self.pieces
        fields = joined([self.none, *(piece.fields_as(self.none.type) for piece in pieces)])
        own = {
            name: pa.concat_arrays([piece.own[name] for piece in pieces]) for name in pieces[0].own
        }
        return Piece(
            set[int]().union(*(piece.segments for piece in pieces)),
            own,
            fields,
            sum(piece.unreadable for piece in pieces),
        )

    def give_up(self) -> None:
        """Make no table of the topic."""
        self.has_failed, self.rows = True, 0
        self.pieces.clear()
        self.finished.clear()
        for file in self.files:
            file.discard()
        self.files.clear()

    def columns(self, decoded: Decoded) -> Any:
        """The fields of decoded messages as columns."""
        columns = columns_from(decoded, self.shape)
        if self.points is not None and not isinstance(decoded.records, LeftFields):
            columns = self.points.with_points(columns, decoded.arrow())
        return copied(columns)


class _File(ColumnFileWriter):
    """An unfinished file of one topic; it counts what a piece counts."""

    def __init__(self, path: Path, schema: pa.Schema) -> None:
        super().__init__(path, schema)
        self.segments: set[int] = set()
        self.unreadable = 0

    def add(self, piece: Piece, table: pa.Table) -> None:
        """Write rows as row groups."""
        rows = max(table.num_rows, 1)
        step = max(min(GROUP_ROWS, rows * GROUP_BYTES // max(table.nbytes, 1)), 1)
        for begin in range(0, table.num_rows, step):
            self.write(table.slice(begin, step))
        self.segments |= piece.segments
        self.unreadable += piece.unreadable


class TableWriter:
    """Writes the tables of one recording, which this process has locked for writing.

    Those of the topics that the store's settings name have arrays in full. Without `topics`, all
    have tables, and there are none yet.
    """

    def __init__(
        self, root: Path, recording: str, name: str, topics: Collection[str] | None = None
    ) -> None:
        self._root = root
        self._recording = recording
        self._name = name
        self._wanted = topics
        self._arrays = frozenset(read_settings(root).arrays)
        self._parts = parts_folder(root, recording)
        self._numbers = 0
        self._has_ended = False
        self.problem = ""  # why no table was written
        self._topics: dict[tuple[str, str], _Topic] = {}
        self._cut: dict[int, str] = {}  # digests of the closed ones

    def add(self, messages: Iterable[Messages]) -> None:
        """Add messages of one segment."""
        if self._has_ended:
            return
        with self._harmless():
            for one in messages:
                if self._wanted is None or one.channel.topic in self._wanted:
                    self._add(one)
            self._spill()

    def cut(self, segment: int, digest: str) -> None:
        """Finish the files of a segment; topics with few rows wait for the next one."""
        if self._has_ended:
            return
        with self._harmless():
            self._cut[segment] = digest
            for topic in self._topics.values():
                with self._only(topic):
                    if topic.is_long or any(segment in one.segments for one in topic.files):
                        self._write(topic)
                    self._finish(topic)

    def close(self, entry: RecordingEntry) -> None:
        """Finish all tables; topics with another number of messages keep an older one."""
        if not self._has_ended:
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

    def _add(self, messages: Messages) -> None:
        """Make rows of messages."""
        channel = messages.channel
        key = channel.topic, table_schema_of(channel)
        topic = self._topics.get(key)
        if topic is None:
            arrays = channel.topic in self._arrays
            topic = self._topics[key] = _Topic(self._recording, channel, arrays=arrays)
        if topic.has_failed:
            return
        with self._only(topic):
            state = state_of(channel.message_encoding)
            found = piece_of(
                messages.placed,
                messages.decoded,
                state,
                has_publish_time=channel.has_publish_time,
                columns=topic.columns,
            )
            topic.add(found)

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

    # From rows in memory to files.

    def _spill(self) -> None:
        """Write rows of the largest topics if too many are waiting in memory."""
        left = sum(topic.size for topic in self._topics.values())
        if left < _PENDING:
            return
        for topic in sorted(self._topics.values(), key=lambda topic: -topic.size):
            if left <= _LEFT:
                return
            left -= topic.size
            opened = sum(len(topic.files) for topic in self._topics.values())
            if opened >= _OPEN_FILES and not topic.files:
                topic.give_up()
                continue
            with self._only(topic):
                self._write(topic)

    def _write(self, topic: _Topic) -> None:
        """Write rows to an unfinished file of a topic."""
        if topic.pieces:
            self._check_room()
            piece, table = topic.take()
            file = next((one for one in topic.files if one.schema == table.schema), None)
            if file is None:
                file = _File(self._new_part(), table.schema)
                topic.files.append(file)
            file.add(piece, table)

    def _new_part(self) -> Path:
        if not self._numbers:
            with suppress(FileNotFoundError):
                files.remove_tree(self._parts)  # left from a crash
            files.make_folders(self._parts)
        self._numbers += 1
        return self._parts / f"{self._recording}-{self._numbers}{SUFFIX}"

    def _check_room(self) -> None:
        if shutil.disk_usage(self._root).free < _RESERVE:
            raise OSError(errno.ENOSPC, f"the disk needs {_RESERVE >> 20} MiB free; make room")

    def _finish(self, topic: _Topic) -> None:
        """Finish a topic's files of closed segments."""
        for file in [one for one in topic.files if one.segments <= self._cut.keys()]:
            topic.files.remove(file)
            file.close([self._section(topic, file)])
            folder = shape_folder(topic.type, file.schema)
            place = self._parts / folder / file.path.name
            files.make_folders(place.parent)
            files.rename(file.path, place)
            topic.finished.append((folder, place))

    def _section(self, topic: _Topic, found: Piece | _File, begin: int = 0) -> Section:
        """The description of rows in their file."""
        digests = {str(number): self._cut[number] for number in sorted(found.segments)}
        counts = found.rows, found.unreadable, topic.has_arrays
        return Section(self._recording, topic.name, begin, digests, *counts)

    def _close(self, entry: RecordingEntry) -> None:
        incomplete = self._incomplete(entry)
        begin = min((first for _, first, _ in entry.spans), default=entry.created)
        additions = defaultdict[str, Addition](Addition)
        for topic in sorted(self._topics.values(), key=lambda topic: topic.name):
            if topic.name in incomplete:
                topic.give_up()
            with self._only(topic):
                if topic.is_long:
                    self._write(topic)
                    self._finish(topic)
                elif topic.pieces:
                    piece, table = topic.take()
                    rows = self._section(topic, piece, begin), table
                    additions[shape_folder(topic.type, table.schema)].pieces.append(rows)
            for folder, path in topic.finished:
                additions[folder].files.append(path)
        replaced: set[str] = set()
        if self._wanted is not None:
            # An older table may be the only copy of fields in a damaged chunk.
            replaced = {*self._wanted} - incomplete
        if additions or replaced:
            self._check_room()
            types = {type_prefix(c.type) for c in entry.channels if c.topic in replaced}
            folders = TableFolders(self._root, self._recording, entry.created)
            folders.add(additions, replaced, types)

    def _incomplete(self, entry: RecordingEntry) -> set[str]:
        """Topics that can have no table."""
        rows: Counter[str] = Counter()
        for topic in self._topics.values():
            rows[topic.name] += topic.rows
        messages = entry.messages_by_topic()
        names = [*rows] if self._wanted is None else self._wanted
        return {name for name in names if rows[name] != messages[name]}
