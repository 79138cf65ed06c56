"""Writes the tables of a recording during indexing.

Chunks are collected and decoded by columns, 8 MiB at a time. Rows
remain in memory until their segment is sealed, or until there are too many. Then they
become row groups of an unfinished file of their topic. Topics with few rows wait until the
recording has ended, and go to files that recordings share.

Tables are derived. After any failure the recording continues, and a topic has no table.
"""

from __future__ import annotations

import errno
import logging
import shutil
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from hybridlog.columns.layout import (
    POINTS,
    RESERVED,
    SUFFIX,
    Section,
    TopicCounts,
    parts_folder,
    shape_folder,
    table_schema_of,
    type_prefix,
)
from hybridlog.columns.rows import Piece, Places, as_table, columns_from, piece_of
from hybridlog.index.indexing import rows_by_channel
from hybridlog.schema.codec import Codec, no_rows
from hybridlog.schema.codecs import codec_for
from hybridlog.schema.left import LeftFields
from hybridlog.schema.states import State, encoding_of, state_of
from hybridlog_storage.disk import files
from hybridlog_storage.disk.copying import joined
from hybridlog_storage.ordering import order_of
from hybridlog_storage.settings import read_settings

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.columns.fields import FieldShape
    from hybridlog.schema.codec import Decoded
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.messages import Channel
    from hybridlog_storage.segments.chunk import StoredChunk

GROUP_ROWS: Final = 131_072
"""Maximum number of rows in a row group."""
GROUP_BYTES: Final = 32 << 20
"""Maximum bytes of the columns of a row group in memory."""
_ARENA = 8 << 20  # bytes of chunks collected: each topic's part costs a millisecond
_ROWS = 1 << 18  # messages collected
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


def load() -> None:
    """Import what tables need: amid a recording, that would hold up all threads for a while."""
    import pyarrow as pa

    import hybridlog.columns.clouds
    import hybridlog.columns.left_rows
    import hybridlog.columns.parquet_file
    import hybridlog.schema.arrow_columns  # noqa: F401

    pa.array([0]).to_numpy(zero_copy_only=False)  # loads pandas, if it is installed


class _Topic:
    """Messages of one topic and definition."""

    def __init__(self, recording: str, channel: Channel, *, arrays: bool = False) -> None:
        from hybridlog.columns.clouds import PointColumns, is_cloud
        from hybridlog.columns.fields import FieldShape
        from hybridlog.schema.arrow_columns import structs

        self.recording = recording
        self.name = channel.topic
        self.type = channel.schema.name if channel.schema is not None else ""
        self.has_arrays = arrays
        encoding = encoding_of(channel.message_encoding, channel.metadata)
        whole = replace(channel, message_encoding=encoding)
        self.points = PointColumns() if arrays and is_cloud(whole) else None
        reserved = RESERVED if self.points is None else RESERVED | {POINTS}
        self.shape: FieldShape = FieldShape(arrays=arrays, reserved=reserved)
        codec, none = codec_for(whole), no_rows()
        decoded = codec.columns(b"", none, none) if codec.indexed else None
        self.none = structs({}, 0) if decoded is None else self.shape.columns(decoded.arrow())
        """No fields, with the columns that the definition fixes."""
        self.is_wanted = True
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

    def add(self, piece: Piece) -> None:
        """Add rows of the segment in work."""
        self.pieces.append(piece)
        self.rows += piece.rows
        kind = piece.segment, piece.has_arrays
        alike = [one for one in self.pieces if (one.segment, one.has_arrays) == kind]
        if len(alike) >= _PIECES:
            others = [one for one in self.pieces if (one.segment, one.has_arrays) != kind]
            self.pieces = [*others, self.joined(alike)]

    def take(self) -> list[Piece]:
        """Remove and return the rows in memory."""
        found, self.pieces = self.pieces, []
        return found

    def give_up(self) -> None:
        """Make no table of the topic."""
        self.has_failed = self.is_wanted
        self.is_wanted = False
        self.pieces.clear()
        self.finished.clear()
        for file in self.files:
            file.discard()
        self.files.clear()

    def columns(self, decoded: Decoded) -> Any:
        """The fields of decoded messages as columns."""
        from hybridlog.columns.fields import copied

        columns = columns_from(decoded, self.shape)
        if self.points is not None and not isinstance(decoded.records, LeftFields):
            columns = self.points.with_points(columns, decoded.arrow())
        return copied(columns)

    def joined(self, pieces: list[Piece]) -> Piece:
        """Rows as one piece, of the segment of the first one."""
        import pyarrow as pa

        from hybridlog.columns.fields import joined as joined_columns

        missing = (pa.nulls(piece.rows, self.none.type) for piece in pieces)
        found = [
            none if piece.fields is None else piece.fields
            for piece, none in zip(pieces, missing, strict=True)
        ]
        fields = joined_columns([self.none, *found])
        own = {
            name: pa.concat_arrays([piece.own[name] for piece in pieces]) for name in pieces[0].own
        }
        bad = sum(piece.unreadable for piece in pieces)
        return Piece(pieces[0].segment, own, fields, bad, has_arrays=pieces[0].has_arrays)

    def table(self, pieces: list[Piece]) -> Any:
        """Rows in order of log time and arrival."""
        import pyarrow as pa

        piece = self.joined(pieces)
        own = piece.own
        columns = {
            name: pa.repeat(pa.scalar(value), len(own["t"]))
            for name, value in (("recording", self.recording), ("topic", self.name))
        }
        table = as_table(columns | {**own}, piece.fields)
        order = order_of(own["t"].to_numpy(), own["seq"].to_numpy())
        return table if order is None else table.take(pa.array(order))


def _counts(pieces: Sequence[Piece]) -> TopicCounts:
    return TopicCounts(
        sum(piece.rows for piece in pieces),
        sum(piece.unreadable for piece in pieces),
        sum(piece.rows for piece in pieces if piece.has_arrays),
    )


class _File:
    """An unfinished file of one topic."""

    def __init__(self, path: Path, topic: _Topic, schema: Any) -> None:
        from hybridlog.columns.parquet_file import ParquetFileWriter

        self.path = path
        self.schema = schema
        self.segments: set[int] = set()
        self._topic = topic
        self._counts = TopicCounts(0)
        self._writer = ParquetFileWriter(path, schema)

    def write(self, table: Any, pieces: list[Piece]) -> None:
        """Write rows as row groups."""
        step = _rows_of_group(table)
        for begin in range(0, table.num_rows, step):
            self._writer.write(table.slice(begin, step))
        self.segments.update(piece.segment for piece in pieces)
        self._counts = self._counts.plus(_counts(pieces))

    def close(self, digests: Mapping[int, str]) -> None:
        """Finish the file."""
        segments = {str(number): digests[number] for number in sorted(self.segments)}
        section = Section(self._topic.recording, self._topic.name, 0, segments, self._counts)
        self._writer.close([section])

    def discard(self) -> None:
        """Delete the unfinished file."""
        self._writer.discard()


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
        self._held: list[StoredChunk] = []  # of one segment
        self._channels: dict[int, Channel] = {}
        self._topics: dict[tuple[str, str], _Topic] = {}
        self._of_channel: dict[int, tuple[_Topic, Codec, State]] = {}
        self._cut: dict[int, str] = {}  # digests of the closed ones

    def add(self, chunk: StoredChunk, channels: Mapping[int, Channel]) -> None:
        """Add the messages of a chunk."""
        if self._has_ended:
            return
        with self._harmless():
            self._channels.update(channels)
            self._collect(chunk)

    def cut(self, segment: int, digest: str) -> None:
        """Register that a segment gets no more messages."""
        if not self._has_ended:
            with self._harmless():
                self._decode()
                self._cut_segment(segment, digest)

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
        self._of_channel.clear()
        self._held.clear()
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

    # From chunks to rows in memory.

    def _collect(self, chunk: StoredChunk) -> None:
        if self._held and self._held[0].segment != chunk.segment:
            self._decode()
        self._held.append(chunk)
        batches = [one.batch for one in self._held]
        if sum(len(b.buffer) for b in batches) >= _ARENA or sum(map(len, batches)) >= _ROWS:
            self._decode()

    def _decode(self) -> None:
        """Make rows of the collected messages."""
        if not self._held:
            return
        held, self._held = self._held, []
        batch, places = joined([chunk.batch for chunk in held]), Places.of(held)
        has_publish_time = {n: one.has_publish_time for n, one in self._channels.items()}
        for topic, codec, state, rows in self._by_topic(batch.channel):
            with self._only(topic):
                piece = piece_of(
                    held[0].segment,
                    batch.take(rows),
                    places.take(rows),
                    codec,
                    state,
                    has_publish_time=has_publish_time,
                    columns=topic.columns,
                )
                piece.has_arrays = topic.has_arrays and state is State.WHOLE
                topic.add(piece)
        self._spill()

    def _by_topic(
        self, channel: NDArray[np.int32]
    ) -> Iterator[tuple[_Topic, Codec, State, NDArray[np.intp]]]:
        """Rows of messages, grouped by topic and encoding."""
        found: dict[tuple[_Topic, Codec, State], list[NDArray[np.intp]]] = {}
        for number, rows in rows_by_channel(channel):
            kind = self._topic_of(number)
            if kind[0].is_wanted:
                found.setdefault(kind, []).append(rows)
        for kind, parts in found.items():
            yield *kind, np.concatenate(parts)

    def _topic_of(self, number: int) -> tuple[_Topic, Codec, State]:
        found = self._of_channel.get(number)
        if found is None:
            channel = self._channels[number]
            schema = table_schema_of(channel)
            topic = self._topics.get((channel.topic, schema))
            if topic is None:
                arrays = channel.topic in self._arrays
                topic = _Topic(self._recording, channel, arrays=arrays)
                self._topics[channel.topic, schema] = topic
                topic.is_wanted = self._wanted is None or channel.topic in self._wanted
            state = state_of(channel.message_encoding)
            found = self._of_channel[number] = topic, codec_for(channel), state
        return found

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
        if pieces := topic.take():
            self._check_room()
            table = topic.table(pieces)
            file = next((one for one in topic.files if one.schema == table.schema), None)
            if file is None:
                file = _File(self._new_part(), topic, table.schema)
                topic.files.append(file)
            file.write(table, pieces)

    def _new_part(self) -> Path:
        if not self._numbers:
            with suppress(FileNotFoundError):
                files.remove_tree(self._parts)  # left from a crash
            files.make_folders(self._parts)
        self._numbers += 1
        return self._parts / f"{self._numbers}{SUFFIX}"

    def _check_room(self) -> None:
        if shutil.disk_usage(self._root).free < _RESERVE:
            raise OSError(errno.ENOSPC, f"the disk needs {_RESERVE >> 20} MiB free; make room")

    def _cut_segment(self, segment: int, digest: str) -> None:
        """Finish the files of a segment; topics with few rows wait for the next one."""
        self._cut[segment] = digest
        for topic in self._topics.values():
            with self._only(topic):
                if _are_long(topic.pieces) or any(segment in one.segments for one in topic.files):
                    self._write(topic)
                self._finish(topic)

    def _finish(self, topic: _Topic) -> None:
        """Finish a topic's files of closed segments."""
        for file in [one for one in topic.files if one.segments <= self._cut.keys()]:
            topic.files.remove(file)
            file.close(self._cut)
            folder = shape_folder(topic.type, file.schema)
            place = self._parts / folder / file.path.name
            files.make_folders(place.parent)
            files.rename(file.path, place)
            topic.finished.append((folder, place))

    def _close(self, entry: RecordingEntry) -> None:
        from hybridlog.columns.folders import Addition, TableFolders

        self._decode()
        incomplete = self._incomplete(entry)
        begin = min((first for _, first, _ in entry.spans), default=entry.created)
        additions: dict[str, Addition] = {}
        for topic in sorted(self._topics.values(), key=lambda topic: topic.name):
            if topic.name in incomplete:
                topic.give_up()
            with self._only(topic):
                if _are_long(topic.pieces):
                    self._write(topic)
                    self._finish(topic)
                elif pieces := topic.take():
                    table = topic.table(pieces)
                    numbers = sorted({piece.segment for piece in pieces})
                    digests = {str(number): self._cut[number] for number in numbers}
                    section = Section(self._recording, topic.name, begin, digests, _counts(pieces))
                    folder = shape_folder(topic.type, table.schema)
                    additions.setdefault(folder, Addition()).pieces.append((section, table))
            for folder, path in topic.finished:
                additions.setdefault(folder, Addition()).files.append(path)
        replaced: set[str] = set()
        if self._wanted is not None:
            # An older table may be the only copy of fields in a damaged chunk.
            replaced = {*self._wanted} - incomplete
        if additions or replaced:
            self._check_room()
            types = {type_prefix(c.type) for c in entry.channels if c.topic in replaced}
            folders = TableFolders(self._root, self._recording, entry.created, entry.digests)
            folders.add(additions, replaced, types)

    def _incomplete(self, entry: RecordingEntry) -> set[str]:
        """Topics that can have no table."""
        rows: Counter[str] = Counter()
        failed = set()
        for topic in self._topics.values():
            if topic.is_wanted:
                rows[topic.name] += topic.rows
            elif topic.has_failed:
                failed.add(topic.name)
        messages = entry.messages_by_topic()
        names = [*rows] if self._wanted is None else self._wanted
        return failed | {name for name in names if rows[name] != messages[name]}


def _are_long(pieces: Sequence[Piece]) -> bool:
    """True if rows of a topic have a file of their own."""
    rows, size = sum(piece.rows for piece in pieces), sum(piece.size for piece in pieces)
    return rows >= LONG_ROWS or size >= LONG_BYTES


def _rows_of_group(table: Any) -> int:
    rows = max(int(table.num_rows), 1)
    return max(min(GROUP_ROWS, rows * GROUP_BYTES // max(int(table.nbytes), 1)), 1)
