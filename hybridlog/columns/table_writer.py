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
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import pyarrow as pa
from msgspec import Struct, field
from msgspec.structs import replace

from hybridlog.columns.column_file import ColumnFile, ColumnFileWriter
from hybridlog.columns.fields import PointColumns, copied, is_cloud, joined, side_by_side
from hybridlog.columns.layout import (
    SHARED,
    SUFFIX,
    TABLES,
    Section,
    parts_folder,
    shape_folder,
    type_prefix,
)
from hybridlog.columns.rows import LeftFields, columns_from, rows_of
from hybridlog.columns.tables import shared_for, shared_name, shared_times, type_folders
from hybridlog.schema.arrow_types import structs
from hybridlog.schema.codec import Decoded, no_messages
from hybridlog.schema.codecs import codec_for
from hybridlog.schema.states import encoding_of, state_of
from hybridlog_storage.disk import files
from hybridlog_storage.errors import StoreError
from hybridlog_storage.messages import EXPIRED_IDS, Channel, distinct, order_of
from hybridlog_storage.settings import read_settings

if TYPE_CHECKING:
    from hybridlog.index.indexing import Messages
    from hybridlog_storage.catalog import RecordingEntry

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


# Folders of finished tables.
#
# All changes are made under a lock on the folder `tables`. A shared file is replaced by one
# rename, so readers find the old rows or the new ones.
#
# The number in the name of a shared file is when the recording that began it was created; of the
# first file 0. A recording comes to the last file of its time or before, and begins another one if
# that is full. So one that is looked for is in that file, or else in one of those in front.

MAX_SHARED_ROWS: Final = 50_000
"""Maximum number of rows of several recordings in one file."""
MAX_SHARED_BYTES: Final = 4 << 20
"""Size from which a shared file gets no more recordings."""
MAX_SHARED_RECORDINGS: Final = 256
"""Maximum number of recordings in one file: each one that comes costs a look at all of them."""
_Piece = tuple[Section, Any]
"""Rows of a topic of a recording, and what they are."""


class Addition(Struct):
    """Rows of one recording for a folder: pieces of a shared file, and files of long topics."""

    pieces: list[_Piece] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)


class TableFolders:
    """Adds and removes tables of one recording, which this process has locked for writing.

    Without `created` (ns), the recording is looked for in all files.
    """

    def __init__(self, root: Path, recording: str, created: int | None) -> None:
        self._root = root
        self._recording = recording
        self._created = created

    def add(
        self,
        additions: Mapping[str, Addition],
        replaced: Collection[str] = (),
        prefixes: Collection[str] = (),
    ) -> None:
        """Add tables by folder, once older ones of the `replaced` topics are removed.

        `prefixes` are beginnings of the names of folders that may have such tables.
        """
        with suppress(FileExistsError):
            files.make_folder(self._root / TABLES)
        with files.locked_folder(self._root / TABLES):
            if prefixes:
                self._remove(prefixes, replaced.__contains__)
            for name, addition in additions.items():
                files.make_folders(self._root / TABLES / name)
                try:
                    self._add(self._root / TABLES / name, addition)
                except (OSError, MemoryError):
                    raise
                except Exception as error:
                    _log.warning("no table in %s: %s", name, error or repr(error))

    def remove(self, prefixes: Collection[str] = ("",)) -> None:
        """Remove all tables of the recording in folders whose names begin with a prefix."""
        with suppress(FileNotFoundError), files.locked_folder(self._root / TABLES):
            self._remove(prefixes, lambda _: True)

    def _remove(self, prefixes: Collection[str], goes: Callable[[str], bool]) -> None:
        """Remove rows of topics that go; an empty folder is removed."""
        for folder in type_folders(self._root):
            if not folder.startswith(tuple(prefixes)):
                continue
            place = self._root / TABLES / folder
            own = [n for n in files.names(place) if n.startswith(f"{self._recording}-")]
            for reader in _readers(place, sorted(own)):
                if all(goes(one.topic) for one in reader.sections):
                    files.remove_tree(reader.path)
            for reader in self._shared(place):
                if reader.has(self._recording):
                    self._rewrite(reader, (), goes)
                    break
            with suppress(OSError), files.folder(place.parent) as fd:
                files.system.rmdir(folder, dir_fd=fd)

    def _add(self, place: Path, addition: Addition) -> None:
        names, pieces = files.names(place), addition.pieces
        numbered = (f"{self._recording}-{number}{SUFFIX}" for number in count())
        free = (place / name for name in numbered if name not in names)
        for part, path in zip(addition.files, free, strict=False):
            files.rename(part, path)
        first = next(self._shared(place), None)
        own = place / shared_name(0 if first is None else max(self._created or 0, 0))
        is_fit = first is not None and (first.path == own or self._has_room(first, pieces))
        if pieces and first is not None and is_fit:
            self._rewrite(first, pieces, lambda _: False)
        elif pieces:
            self._write(own, pieces)

    def _shared(self, place: Path) -> Iterator[ColumnFile]:
        """The shared files that may have the recording, the likeliest first."""
        return _readers(place, shared_for(shared_times(files.names(place)), self._created))

    def _has_room(self, reader: ColumnFile, pieces: Sequence[_Piece]) -> bool:
        return (
            len({one.id for one in reader.sections}) < MAX_SHARED_RECORDINGS
            and reader.size_bytes < MAX_SHARED_BYTES
            and reader.rows + sum(one.rows for one, _ in pieces) <= MAX_SHARED_ROWS
        )

    def _rewrite(
        self, reader: ColumnFile, new: Sequence[_Piece], goes: Callable[[str], bool]
    ) -> None:
        """Replace a shared file by one with other rows of the recording."""
        pieces, topics = [*new], {section.topic for section, _ in new}
        try:
            table = reader.table()
            for before, section in reader.begins():
                stays = section.topic not in topics and not goes(section.topic)
                if section.id != self._recording or stays:
                    pieces.append((section, table.slice(before, section.rows)))
        except StoreError as error:
            # Its other recordings get their tables again when they are asked about.
            _log.info("%s", error)
        if pieces:
            self._write(reader.path, pieces)
        else:
            files.unlink(reader.path)

    def _write(self, path: Path, pieces: Iterable[_Piece]) -> None:
        """Write a shared file, and give it its name by one rename."""
        pieces = sorted(pieces, key=lambda one: (one[0].id, one[0].topic))
        found = [section for section, _ in pieces]
        schema = pieces[0][1].schema
        table = pa.concat_tables(
            [rows if rows.schema.equals(schema) else rows.cast(schema) for _, rows in pieces]
        ).combine_chunks()
        parts = parts_folder(self._root, self._recording)
        files.make_folders(parts)
        part = parts / f"{SHARED}{SUFFIX}"
        files.remove_tree(part)
        # A reader that knows the footer of the file before finds nothing at its places.
        front = bytes(1 + table.num_rows % 251)
        writer = ColumnFileWriter(part, table.schema, front=front)
        try:
            writer.write(table)
            writer.close(found, sync=True)
        except BaseException:
            writer.discard()
            raise
        files.rename(part, path)


def _readers(place: Path, names: Iterable[str]) -> Iterator[ColumnFile]:
    """Files of tables; one that cannot be read is removed, since all of it can be made again."""
    for path in (place / name for name in names if name.endswith(SUFFIX)):
        try:
            yield ColumnFile(path)
        except FileNotFoundError:
            continue
        except StoreError as error:
            if isinstance(error.__cause__, PermissionError):
                raise error.__cause__ from error
            _log.info("%s", error)
            files.remove_tree(path)
