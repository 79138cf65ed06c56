"""Writes the tables of a recording during indexing.

Payloads of small messages are collected and decoded by columns, 8 MiB at a time. Rows
remain in memory until their segment is sealed, or until there are too many. Then they
become row groups of an unfinished file. A file gets its name once the segment is sealed and
all of its messages are written.

Tables are derived. After any failure the recording continues, and a topic has no table.
"""

from __future__ import annotations

import errno
import logging
import shutil
import threading
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from hybridlog.indexing import rows_by_channel
from hybridlog.schema.codec import Codec
from hybridlog.schema.codecs import codec_for
from hybridlog.tables.layout import (
    IN_TOPIC,
    OWN_FILE_ROWS,
    SMALL,
    SUFFIX,
    TOPIC_COLUMN,
    About,
    parts_folder,
    recording_folder,
    small_file,
    table_schema_of,
    topic_file,
    topic_folder,
)
from hybridlog.tables.rows import REDUCED, WHOLE, Messages, Piece, own_columns
from hybridlog_storage import files
from hybridlog_storage.buffers import buffers
from hybridlog_storage.messages import REDUCED as REDUCED_ENCODING

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.tables.fields import FieldShape
    from hybridlog.tables.parquet_file import ParquetFileWriter
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.chunk import StoredChunk
    from hybridlog_storage.messages import Channel

GROUP_ROWS: Final = 131_072
"""Maximum number of rows in a row group."""
GROUP_BYTES: Final = 32 << 20
"""Maximum bytes of the columns of a row group in memory."""
_ARENA = 8 << 20  # bytes of payloads collected: each topic's part costs a millisecond
_ENOUGH = 4 << 20  # chunk size, bytes, from which a chunk is decoded in place
_ROWS = 1 << 18  # messages collected
_PENDING = 48 << 20  # bytes of rows waiting in memory
_LEFT = _PENDING // 4  # bytes of the smallest topics, which continue to wait for more rows
_RESERVE = 256 << 20  # bytes of the disk reserved for segments
_OPEN_FILES = 128  # maximum number of unfinished files
_log = logging.getLogger(__name__)


class _Topic:
    """Messages of one topic and schema.

    Args:
        channel: One of its channels.
        schema: See `table_schema`.
    """

    def __init__(self, channel: Channel, schema: str) -> None:
        from hybridlog.tables.fields import FieldShape

        self.name = channel.topic
        self.schema = schema
        self.type = channel.schema.name if channel.schema is not None else ""
        self.shape: FieldShape = FieldShape()
        self.is_wanted = True
        self.rows = 0
        self.pieces: list[Piece] = []
        """Rows in memory."""
        self.size = 0
        """Bytes of the rows in memory."""
        self.files: dict[int, list[_File]] = {}
        """Unfinished files of segments that are not closed yet."""
        self.finished: Counter[int] = Counter()
        """Number of finished files, by the segments in their names."""
        self.has_failed = False

    def add(self, piece: Piece) -> None:
        self.pieces.append(piece)
        self.rows += piece.rows
        self.size += piece.size

    def take(self, segments: Collection[int]) -> list[Piece]:
        """Remove and return the rows in memory that belong to some segments."""
        found = [piece for piece in self.pieces if piece.segment in segments]
        self.pieces = [piece for piece in self.pieces if piece.segment not in segments]
        self.size = sum(piece.size for piece in self.pieces)
        return found

    def give_up(self) -> None:
        """Make no table of the topic."""
        self.has_failed = self.is_wanted
        self.is_wanted = False
        self.pieces.clear()
        self.size = 0
        for unfinished in self.files.values():
            for file in unfinished:
                file.discard()
        self.files.clear()


class _File:
    """An unfinished file of one topic, or of several topics of one type."""

    def __init__(self, path: Path, has_publish_time: Mapping[int, bool]) -> None:
        self.path = path
        self.segments: set[int] = set()
        self.topics: dict[str, int] = {}
        self.bounds: list[tuple[int, int, int, int, int]] = []
        self.unreadable = 0
        self.reduced = 0
        self._has_publish_time = has_publish_time
        self._writer: ParquetFileWriter | None = None
        self._schema: Any = None

    def write(self, topic: str, pieces: list[Piece]) -> None:
        """Write rows of a topic, in order of log time and arrival, as row groups.

        Raises:
            OSError: the rows cannot be written.
            UnfitError: the type of their fields differs from the file's.
        """
        table = self._table(topic, pieces)
        if self._schema is not None and table.schema != self._schema:
            table = self._fitting(table)
        time, seq = (table.column(name).to_numpy() for name in ("t", "seq"))
        for begin, end in self._write(table):
            first, last = ((int(time[row]), int(seq[row])) for row in (begin, end - 1))
            self.bounds.append((end - begin, *first, *last))
        self._count(topic, pieces)

    def write_together(self, topics: Mapping[str, list[Piece]]) -> None:
        """Write the rows of several topics, one topic after the other.

        Raises:
            OSError: the rows cannot be written.
            UnfitError: their fields have no common type.
        """
        import pyarrow as pa

        from hybridlog.tables.fields import alike

        with_fields = [p for pieces in topics.values() for p in pieces if p.fields is not None]
        for piece, fields in zip(with_fields, alike([p.fields for p in with_fields]), strict=True):
            piece.fields = fields
        kind = with_fields[0].fields.type if with_fields else None
        tables = [
            self._table(name, pieces, kind, with_topic=True) for name, pieces in topics.items()
        ]
        for begin, end in self._write(pa.concat_tables(tables)):
            self.bounds.append((end - begin, 0, 0, 0, 0))
        for name, pieces in topics.items():
            self._count(name, pieces)

    def _count(self, topic: str, pieces: list[Piece]) -> None:
        """Count rows of a topic that were written."""
        self.topics[topic] = self.topics.get(topic, 0) + sum(piece.rows for piece in pieces)
        self.segments.update(piece.segment for piece in pieces)
        for piece in pieces:
            self.reduced += piece.rows if piece.state == REDUCED else 0
            self.unreadable += sum(len(rows) for rows, _ in piece.errors)

    def _write(self, table: Any) -> Iterator[tuple[int, int]]:
        """Write row groups; yields the first row of each, and the row after its end."""
        from hybridlog.tables.parquet_file import ParquetFileWriter

        if self._writer is None:
            self._writer = ParquetFileWriter(self.path, table, depth=files.IN_RECORDING)
            self._schema = table.schema
        step = _rows_of_group(table)
        for begin in range(0, table.num_rows, step):
            end = min(begin + step, table.num_rows)
            self._writer.write(table.slice(begin, end - begin))
            yield begin, end

    def _table(
        self, topic: str, pieces: list[Piece], kind: Any = None, *, with_topic: bool = False
    ) -> Any:
        """Rows of a topic in order.

        Args:
            topic: The topic.
            pieces: Its rows.
            kind: Type of their fields; None for their common type.
            with_topic: True to make the topic a column.
        """
        import pyarrow as pa

        from hybridlog.tables.fields import joined

        messages = Messages.joined([piece.messages for piece in pieces])
        segment = np.repeat(
            np.array([piece.segment for piece in pieces], np.int32),
            [piece.rows for piece in pieces],
        )
        with_fields = [piece.fields for piece in pieces if piece.fields is not None]
        fields = None
        if kind is None and with_fields:
            kind = with_fields[0].type
        if kind is not None:
            fields = joined(
                [
                    pa.nulls(piece.rows, kind) if piece.fields is None else piece.fields
                    for piece in pieces
                ]
            )
        columns = own_columns(pieces, messages, segment, fields, self._has_publish_time)
        if with_topic:
            columns[TOPIC_COLUMN] = pa.repeat(pa.scalar(topic), len(segment))
        known = list(map(pa.field, columns, [column.type for column in columns.values()]))
        arrays = list(columns.values())
        if fields is not None:
            known += [fields.type.field(number) for number in range(fields.type.num_fields)]
            arrays += fields.flatten()
        table = pa.Table.from_arrays(arrays, schema=pa.schema(known))
        order = _order(messages.log_time, messages.seq)
        return table if order is None else table.take(pa.array(order))

    def _fitting(self, table: Any) -> Any:
        """Rows with the columns of the file."""
        import pyarrow as pa

        from hybridlog.tables.fields import UnfitError, joined

        kind = pa.struct(list(self._schema))
        fitting = joined([pa.nulls(0, kind), table.to_struct_array().combine_chunks()])
        if fitting.type != kind:
            raise UnfitError("the file has other columns")
        return pa.Table.from_struct_array(fitting).cast(self._schema)

    def close(self, about: About) -> None:
        """Finish the file."""
        assert self._writer is not None
        self._writer.close(about)

    def discard(self) -> None:
        """Delete the unfinished file."""
        if self._writer is not None:
            self._writer.discard()


class TableWriter:
    """Writes the tables of one recording, which this process has locked for writing.

    Args:
        root: The store.
        recording: Id of the recording.
        topics: The topics with tables; None for all.
        is_new: True if the recording has no tables yet. Files of a new recording get their
            names as soon as their segments are closed. Otherwise all files of a topic are
            replaced at the end.
    """

    def __init__(
        self,
        root: Path,
        recording: str,
        *,
        topics: Collection[str] | None = None,
        is_new: bool = True,
    ) -> None:
        self._root = root
        self._recording = recording
        self._wanted = topics
        self._is_new = is_new
        self._parts = parts_folder(root, recording)
        self._has_parts = False
        self._numbers = 0
        self._has_ended = False
        self.has_failed = False
        self._arena: NDArray[np.uint8] | None = None
        self._filled = 0
        self._held: list[Messages] = []
        self._held_rows = 0
        self._held_segment = -1
        self._channels: dict[int, Channel] = {}
        self._met: Mapping[int, Channel] = {}  # the last mapping, and its size
        self._met_count = 0
        self._has_grown = False  # rows were decoded since the last look at their size
        self._topics: dict[tuple[str, str], _Topic] = {}
        self._of_channel: dict[int, tuple[_Topic, Codec, bool]] = {}
        self._has_publish_time: dict[int, bool] = {}
        self._seen: Counter[int] = Counter()  # messages of each segment
        self._sealed: dict[int, tuple[str, int]] = {}  # digest and messages
        self._cut: dict[int, str] = {}  # digests of the closed segments
        self._finished: dict[str, list[tuple[Path, str]]] = {}  # by folder, until the end
        self._lock = threading.Lock()  # protects the sealed segments

    @property
    def rows_in_memory(self) -> int:
        """Number of rows waiting to be written."""
        return self._held_rows + sum(
            piece.rows for topic in self._topics.values() for piece in topic.pieces
        )

    def seal(self, segment: int, digest: str, messages: int) -> None:
        """Register a sealed segment. Thread safe.

        Args:
            segment: Its number.
            digest: Its digest in the catalog.
            messages: Number of its messages.
        """
        with self._lock:
            self._sealed[segment] = digest, messages

    def add(self, chunk: StoredChunk, channels: Mapping[int, Channel]) -> None:
        """Add the messages of a chunk; its buffer is not used afterwards."""
        if self._has_ended:
            return
        with self._harmless():
            self._channels.update(channels)
            self._collect(chunk)
            self._seen[chunk.segment] += len(chunk.batch)
            self._spill()
            self._cut_sealed()

    def cut(self, segment: int, digest: str) -> None:
        """Register that a segment gets no more messages.

        Args:
            segment: Its number.
            digest: Its digest in the catalog.
        """
        if not self._has_ended:
            with self._harmless():
                self._decode()
                self._cut_segment(segment, digest)

    def close(self, entry: RecordingEntry) -> None:
        """Finish all tables.

        Args:
            entry: The complete recording; topics with another number of messages get no table.
        """
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
        self._held_rows = 0
        self._arena = None
        if self._has_parts:
            with suppress(OSError):
                files.remove_tree(self._parts, depth=files.IN_FOLDER)
        self._has_parts = False

    @contextmanager
    def _harmless(self) -> Iterator[None]:
        """Continue the recording without tables after any failure."""
        try:
            yield
        except Exception as error:
            self.has_failed = True
            reason = getattr(error, "strerror", None) or error or repr(error)
            _log.warning("Recording %s has no tables yet: %s", self._recording, reason)
            self.discard()

    # From chunks to rows in memory.

    def _collect(self, chunk: StoredChunk) -> None:
        batch = chunk.batch
        begin, rows = int(batch.offset.min()), len(batch)
        size = int((batch.offset + batch.length).max()) - begin
        is_full = self._filled + size > _ARENA or self._held_rows + rows > _ROWS
        is_enough = size >= min(_ENOUGH, _ARENA)
        if is_enough or is_full or chunk.segment != self._held_segment:
            self._decode()
        self._held_segment = chunk.segment
        data = np.frombuffer(batch.buffer, np.uint8, size, begin)
        self._held.append(Messages.of(chunk, begin - self._filled))
        self._held_rows += rows
        if is_enough:
            self._decode(data)
            return
        if self._arena is None:
            self._arena = buffers.take(_ARENA)
        self._arena[self._filled : self._filled + size] = data
        self._filled += size

    def _decode(self, data: NDArray[np.uint8] | None = None) -> None:
        """Make rows of the collected messages."""
        if not self._held:
            return
        if data is None:
            assert self._arena is not None
            data = self._arena[: self._filled]
        self._has_grown = True
        messages = Messages.joined(self._held)
        self._held.clear()
        self._filled = self._held_rows = 0
        for topic, codec, is_reduced, part in self._by_topic(messages):
            if topic.is_wanted:
                with self._only(topic):
                    topic.add(self._piece(topic, codec, part, data, is_reduced=is_reduced))

    def _by_topic(self, messages: Messages) -> Iterator[tuple[_Topic, Codec, bool, Messages]]:
        """The messages, grouped by topic and encoding."""
        numbers = np.flatnonzero(np.bincount(messages.channel)).tolist()
        found = {number: self._topic_of(number) for number in numbers}
        place: dict[tuple[_Topic, Codec, bool], int] = {}
        for kind in found.values():
            place.setdefault(kind, len(place))
        kinds = list(place)
        if len(kinds) == 1:
            yield *kinds[0], messages
            return
        table = np.zeros(numbers[-1] + 1, np.int32)
        table[numbers] = [place[kind] for kind in found.values()]
        for number, rows in rows_by_channel(table[messages.channel]):
            if kinds[number][0].is_wanted:
                yield *kinds[number], messages.take(rows)

    def _topic_of(self, number: int) -> tuple[_Topic, Codec, bool]:
        found = self._of_channel.get(number)
        if found is None:
            channel = self._channels[number]
            schema = table_schema_of(channel)
            topic = self._topics.get((channel.topic, schema))
            if topic is None:
                topic = self._topics[channel.topic, schema] = _Topic(channel, schema)
                topic.is_wanted = self._wanted is None or channel.topic in self._wanted
            is_reduced = channel.message_encoding == REDUCED_ENCODING
            found = self._of_channel[number] = topic, codec_for(channel), is_reduced
            self._has_publish_time[number] = channel.has_publish_time
        return found

    def _piece(
        self,
        topic: _Topic,
        codec: Codec,
        messages: Messages,
        data: NDArray[np.uint8],
        *,
        is_reduced: bool,
    ) -> Piece:
        state = REDUCED if is_reduced else WHOLE
        piece = Piece(self._held_segment, messages, None, state=state)
        if codec.indexed and not is_reduced:
            self._add_fields(piece, topic, codec, data)
        return piece

    def _add_fields(
        self, piece: Piece, topic: _Topic, codec: Codec, data: NDArray[np.uint8]
    ) -> None:
        from hybridlog.tables.fields import detached, without

        decoded = codec.arrow(data.data, piece.messages.at, piece.messages.length, None)
        for bad in decoded.unreadable:
            reason = f"the payload does not fit {topic.type}: {bad.reason}"
            piece.errors.append((bad.rows, reason))
        if not len(decoded.rows):
            return
        columns = topic.shape.columns(decoded.records)
        begin = data.ctypes.data
        columns = detached(columns, begin, begin + data.nbytes)
        piece.fields = without(columns, decoded.rows, piece.rows)

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

    @property
    def _pending(self) -> int:
        return sum(topic.size for topic in self._topics.values())

    def _spill(self) -> None:
        """Write rows of the largest topics if too many are waiting in memory."""
        if not self._has_grown or self._pending < _PENDING:
            return
        self._has_grown = False
        self._decode()
        left = self._pending
        opened = sum(len(f) for topic in self._topics.values() for f in topic.files.values())
        for topic in sorted(self._topics.values(), key=lambda topic: -topic.size):
            if left <= _LEFT:
                return
            left -= topic.size
            if opened >= _OPEN_FILES and not topic.files:
                topic.give_up()
                continue
            for segment in sorted({piece.segment for piece in topic.pieces}):
                with self._only(topic):
                    # Waiting rows of closed segments have no file to go to.
                    place = segment if segment not in self._cut else max(self._seen)
                    opened += self._write(topic, place, topic.take({segment}))

    def _write(self, topic: _Topic, segment: int, pieces: list[Piece]) -> int:
        """Write rows to the unfinished file of a segment; returns the number of new files."""
        from hybridlog.tables.fields import UnfitError

        if not pieces:
            return 0
        self._check_room()
        unfinished = topic.files.setdefault(segment, [])
        if unfinished:
            try:
                unfinished[-1].write(topic.name, pieces)
            except UnfitError:
                pass
            else:
                return 0
        file = _File(self._new_part(), self._has_publish_time)
        unfinished.append(file)
        file.write(topic.name, pieces)
        return 1

    def _new_part(self) -> Path:
        if not self._has_parts:
            with suppress(FileNotFoundError):
                files.remove_tree(self._parts, depth=files.IN_FOLDER)  # left from a crash
            files.make_folders(self._parts, depth=files.IN_FOLDER)
            self._has_parts = True
        self._numbers += 1
        return self._parts / f"{self._numbers}{SUFFIX}"

    def _check_room(self) -> None:
        if shutil.disk_usage(self._root).free < _RESERVE:
            raise OSError(errno.ENOSPC, "the disk is nearly full")

    def _cut_sealed(self) -> None:
        """Finish files of sealed segments of which all messages have been added."""
        if not self._sealed:
            return
        with self._lock:
            ready = [
                segment
                for segment, (_, messages) in self._sealed.items()
                if self._seen[segment] == messages
            ]
        for segment in sorted(ready):
            if self._held_segment == segment:
                self._decode()
            with self._lock:
                digest, _ = self._sealed.pop(segment)
            self._cut_segment(segment, digest)

    def _cut_segment(self, segment: int, digest: str) -> None:
        """Finish the files of a segment; topics with few rows wait for the next one."""
        self._cut[segment] = digest
        for topic in self._topics.values():
            with self._only(topic):
                rows = sum(piece.rows for piece in topic.pieces if piece.segment in self._cut)
                if rows >= OWN_FILE_ROWS or segment in topic.files:
                    self._write(topic, segment, topic.take(self._cut))
                self._finish(topic)

    def _finish(self, topic: _Topic) -> None:
        """Finish a topic's files of closed segments."""
        for segment in sorted(topic.files.keys() & self._cut.keys()):
            for file in topic.files.pop(segment):
                name = topic_file(topic.schema, segment, topic.finished[segment])
                self._end(file, topic.schema, topic.type)
                topic.finished[segment] += 1
                self._publish(topic_folder(topic.name), file.path, name)

    def _end(self, file: _File, schema: str, type_name: str) -> None:
        file.close(
            About(
                self._recording,
                schema,
                type_name,
                {str(segment): self._cut[segment] for segment in sorted(file.segments)},
                file.topics,
                tuple(file.bounds),
                file.unreadable,
                file.reduced,
            )
        )

    def _publish(self, folder: str, path: Path, name: str) -> None:
        """Give a finished file its name now, or record the name for the end."""
        if not self._is_new:
            self._finished.setdefault(folder, []).append((path, name))
            return
        place = recording_folder(self._root, self._recording) / folder
        files.make_folders(place, depth=IN_TOPIC - 1)
        files.rename(path, place / name, depth=files.IN_RECORDING, new_depth=IN_TOPIC)

    def _close(self, entry: RecordingEntry) -> None:
        self._decode()
        for number in sorted(self._seen.keys() - self._cut.keys()):
            digest = entry.digests.get(str(number))
            if digest is not None:
                self._cut_segment(number, digest)
        incomplete = self._incomplete(entry)
        for topic in self._topics.values():
            if topic.name in incomplete:
                topic.give_up()
            elif topic.finished and topic.pieces:
                with self._only(topic):
                    pieces = topic.take(self._cut)
                    last = max((piece.segment for piece in pieces), default=0)
                    self._write(topic, last, pieces)
                    self._finish(topic)
        self._write_small()
        folder = recording_folder(self._root, self._recording)
        for name in incomplete:
            with suppress(FileNotFoundError):
                files.remove_tree(folder / topic_folder(name), depth=IN_TOPIC - 1)
        for name, finished in self._finished.items():
            self._exchange(folder / name, finished)

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
        return failed | {name for name in rows if rows[name] != messages[name]}

    def _write_small(self) -> None:
        """Write topics with few rows, those of one type into one file."""
        by_schema: dict[str, list[_Topic]] = {}
        for topic in sorted(self._topics.values(), key=lambda topic: topic.name):
            if topic.pieces:
                by_schema.setdefault(topic.schema, []).append(topic)
        for schema, topics in by_schema.items():
            self._check_room()
            file = _File(self._new_part(), self._has_publish_time)
            try:
                file.write_together({topic.name: topic.take(self._cut) for topic in topics})
            except (OSError, MemoryError):
                raise
            except Exception as error:
                _log.warning("no table of %s: %s", topics[0].type, error or repr(error))
                file.discard()
                continue
            self._end(file, schema, topics[0].type)
            self._publish(SMALL, file.path, small_file(topics[0].type, schema))

    def _exchange(self, place: Path, finished: list[tuple[Path, str]]) -> None:
        """Replace existing files with finished ones."""
        files.make_folders(place, depth=IN_TOPIC - 1)
        target = place
        if place.name != SMALL:
            self._numbers += 1
            target = self._parts / f"new-{self._numbers}"
            files.make_folder(target, depth=files.IN_RECORDING)
        for path, name in finished:
            if target == place:
                files.remove_tree(target / name, depth=IN_TOPIC)
            files.rename(path, target / name, depth=files.IN_RECORDING, new_depth=IN_TOPIC)
        if target != place:
            old = self._parts / f"old-{self._numbers}"
            files.rename(place, old, depth=IN_TOPIC - 1, new_depth=files.IN_RECORDING)
            files.rename(target, place, depth=files.IN_RECORDING, new_depth=IN_TOPIC - 1)


def _order(log_time: NDArray[np.int64], seq: NDArray[np.int64]) -> NDArray[np.intp] | None:
    """Order of the rows by log time and arrival; None if they are in order already."""
    later = log_time[1:] > log_time[:-1]
    if not later.all():
        same = log_time[1:] == log_time[:-1]
        if not (later | (same & (seq[1:] > seq[:-1]))).all():
            return np.lexsort((seq, log_time))
    return None


def _rows_of_group(table: Any) -> int:
    rows = max(int(table.num_rows), 1)
    return max(min(GROUP_ROWS, rows * GROUP_BYTES // max(int(table.nbytes), 1)), 1)
